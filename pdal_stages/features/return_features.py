"""Features of return numbers: how often pulses go through a point's surroundings.

A pulse that meets a roof gives one return, one that meets a tree several. Two flags say so of a
point: it is one of several returns (`MultipleReturn`), or not the last of its pulse
(`EarlierReturn`). Their means over cells of an absolute grid and those around them say so of its
surroundings: ``MultipleReturn_box2`` over 3 x 3 x 3 cells of 2 m, ``MultipleReturn_column2`` over
3 x 3 columns of any height. All are 0 where a cloud has no return numbers.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import OptionError
from .cell_means import WHOLE, cell_means
from .neighborhoods import SIDES

#: What they are made of.
SOURCES = ("ReturnNumber", "NumberOfReturns")

#: Flag -> what it says.
FLAGS = {
    "MultipleReturn": "the pulse gave several returns (NumberOfReturns > 1)",
    "EarlierReturn": "a later return of the pulse exists (ReturnNumber < NumberOfReturns)",
}

#: The word for all flags, of the point and at three scales: boxes of 3 and 6 m, columns of 6 m. Not
#: tuned.
GROUP = "returns"
SCALES = ("", "_box1", "_box2", "_column2")
NAMES = tuple(flag + scale for scale in SCALES for flag in FLAGS)

_NAME = re.compile(rf"({'|'.join(FLAGS)})(?:_(box|column)(\d+(?:_\d+)?))?")


@dataclass(frozen=True)
class ReturnFeature:
    """One of them; make it with :func:`parse`."""

    flag: str
    #: 3 for boxes, 2 for columns, 0 for the point itself.
    axes: int = 0
    #: Of a cell, meters.
    side: float = 0.0


def parse(name: str) -> ReturnFeature | None:
    """Return the feature of a name such as ``EarlierReturn_box0_5``; None for another name.

    OptionError for a side that is not in :data:`SIDES`.
    """
    match = _NAME.fullmatch(name)
    if match is None:
        return None
    if match[2] is None:
        return ReturnFeature(match[1])
    side = float(match[3].replace("_", "."))
    if side not in SIDES:
        raise OptionError(
            "the cells of a return feature have a side that is a power of two",
            found=name,
            cure=f"Write a side from {SIDES[0]:g} to {SIDES[-1]:g} m: {match[1]}_{match[2]}2",
        )
    return ReturnFeature(match[1], {"box": 3, "column": 2}[match[2]], side)


def reach(names: Iterable[str]) -> float:
    """Return meters, along x or y, to the farthest point that matters to any of these names."""
    return max((2.0 * feature.side for feature in map(parse, names) if feature), default=0.0)


def return_features(
    names: Iterable[str],
    xyz: npt.NDArray[np.float64],
    dimensions: Mapping[str, npt.ArrayLike],
    threads: int | None = None,
) -> dict[str, npt.NDArray[Any]]:
    """Compute those of `names` that are return features, for every point of a cloud.

    (n,) each, from 0 to 1; uint8 for the point itself, float32 for its surroundings.

    Of `dimensions`, ``ReturnNumber`` and ``NumberOfReturns`` are read, (n,) each; without them all
    is 0.
    """
    wanted = {name: feature for name in names if (feature := parse(name)) is not None}
    if not wanted:
        return {}
    number, total = (
        np.asarray(dimensions.get(source, np.zeros(len(xyz), np.uint8))) for source in SOURCES
    )
    flags = np.empty((len(xyz), len(FLAGS)), np.uint16)
    flags[:, 0] = np.where(total > 1, WHOLE, 0)
    flags[:, 1] = np.where((number > 0) & (number < total), WHOLE, 0)
    del number, total
    values: dict[str, npt.NDArray[Any]] = {}
    for axes, side in dict.fromkeys((feature.axes, feature.side) for feature in wanted.values()):
        cell: Any = slice(None)
        means: npt.NDArray[Any] = (flags > 0).view(np.uint8)
        if axes:
            cell, means = cell_means(xyz[:, :axes], flags, side)
        for name, feature in wanted.items():
            if (feature.axes, feature.side) == (axes, side):
                values[name] = means[:, list(FLAGS).index(feature.flag)][cell]
    return {name: values[name] for name in wanted}
