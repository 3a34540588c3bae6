"""Features of return numbers: how often pulses go through a point's surroundings.

A pulse that meets a roof gives one return, one that meets a tree several. Two flags say so of a
point: it is one of several returns (`MultipleReturn`), or not the last of its pulse
(`EarlierReturn`). Their means over cells of an absolute grid and those around them say so of its
surroundings: ``MultipleReturn_box2`` over 3 x 3 x 3 cells of 2 m, ``MultipleReturn_column2`` over
3 x 3 columns of any height. All are 0 where a cloud has no return numbers.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Mapping

import numpy as np
import numpy.typing as npt

from .cell_means import WHOLE, cell_means

#: What they are made of.
SOURCES = ("ReturnNumber", "NumberOfReturns")

#: Flag -> what it says.
FLAGS = {
    "MultipleReturn": "the pulse gave several returns (NumberOfReturns > 1)",
    "EarlierReturn": "a later return of the pulse exists (ReturnNumber < NumberOfReturns)",
}

#: The word for all flags, of the point and at three scales.
GROUP = "returns"
#: Suffix -> axes and side (meters) of its cells: boxes of 3 and 6 m, columns of 6 m. Not tuned.
SCALES = {"": (0, 0.0), "_box1": (3, 1.0), "_box2": (3, 2.0), "_column2": (2, 2.0)}
#: The features of each scale, which are computed together.
BY_SCALE = tuple(tuple(flag + scale for flag in FLAGS) for scale in SCALES)
NAMES = tuple(name for names in BY_SCALE for name in names)


def reach(names: Container[str]) -> float:
    """Return meters, along x or y, to the farthest point that matters to any of these names."""
    sides = (side for scale, (_, side) in SCALES.items() for flag in FLAGS if flag + scale in names)
    return 2.0 * max(sides, default=0.0)


def return_features(
    names: Iterable[str],
    xyz: npt.NDArray[np.float64],
    dimensions: Mapping[str, npt.ArrayLike],
) -> dict[str, npt.NDArray]:
    """Compute those of `names` that are return features, for every point of a cloud.

    The columns (n,) are from 0 to 1: uint8 of the point itself, float32 of its surroundings.

    Of `dimensions`, ``ReturnNumber`` and ``NumberOfReturns`` are read, (n,) each; without them all
    is 0.
    """
    wanted = {name for name in names if name in NAMES}
    if not wanted:
        return {}
    number, total = (
        np.asarray(dimensions.get(source, np.zeros(len(xyz), np.uint8))) for source in SOURCES
    )
    flags = np.empty((len(xyz), len(FLAGS)), np.uint16)
    flags[:, 0] = np.where(total > 1, WHOLE, 0)
    flags[:, 1] = np.where((number > 0) & (number < total), WHOLE, 0)
    del number, total
    values: dict[str, npt.NDArray] = {}
    for (axes, side), columns in zip(SCALES.values(), BY_SCALE, strict=True):
        if wanted.isdisjoint(columns):
            continue
        cell: npt.NDArray | slice = slice(None)
        means: npt.NDArray = (flags > 0).view(np.uint8)
        if axes:
            cell, means = cell_means(xyz[:, :axes], flags, side)
        values |= {name: means[:, k][cell] for k, name in enumerate(columns) if name in wanted}
    return values
