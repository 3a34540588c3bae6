"""Dimensions of the points that serve as features: which are needed, who makes them, are they fit."""

from __future__ import annotations

import pkgutil
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import DimensionError
from ..features import returns

#: What every point has: the feature engine takes these from the coordinates.
COORDINATES = ("X", "Y", "Z")
#: What a model is trained on by default: always this, and these where points have them.
ALWAYS = ("HeightAboveGround",)
WHERE_THERE = ("Ground", "HeightAboveOpening_5", "HeightAboveOpening_17")
#: 1 where a person has checked a point's class.
CHECKED = "Checked"

_READ = "It comes from the reader; this source has none. Use a model trained without it"
_MAKERS = {
    "HeightAboveGround": (
        "In Python filtered_ground(xyz) makes it; in a pipeline put filters.hag_morphological before this stage, or "
        "what the model was trained with"
    ),
    **dict.fromkeys(("Intensity", *returns.SOURCES), _READ),
}


def required(names: Iterable[str]) -> tuple[str, ...]:
    """Dimensions the cloud must have for these dimension features."""
    return tuple(
        dict.fromkeys(name for name in names if name not in COORDINATES and returns.parse(name) is None)
    )


def welcome(names: Iterable[str]) -> tuple[str, ...]:
    """Dimensions that these features can do without but use where the cloud has them."""
    return returns.SOURCES if any(returns.parse(name) is not None for name in names) else ()


def known(
    names: Iterable[str],
    dimensions: Mapping[str, npt.ArrayLike],
    n: int,
    rows: npt.NDArray[np.int64] | None = None,
    where: str | None = None,
) -> list[npt.NDArray[Any]]:
    """Values (n,) of the dimensions that these features need, checked as by :func:`gather`, and of those that they use."""
    found = [*required(names), *(name for name in welcome(names) if name in dimensions)]
    for name in found:
        gather((name,), dimensions, n, rows, where)  # one after the other: it may be a copy
    return [np.asarray(dimensions[name]) for name in found]


def with_returns(
    names: Iterable[str],
    xyz: npt.NDArray[np.float64],
    dimensions: Mapping[str, npt.ArrayLike],
    threads: int | None = None,
) -> Mapping[str, npt.ArrayLike]:
    """The dimensions and those of `names` that are made of return numbers and the points around."""
    made = returns.return_features(names, xyz, dimensions, threads)
    return {**dimensions, **made} if made else dimensions


def gather(
    names: Iterable[str],
    dimensions: Mapping[str, npt.ArrayLike],
    n: int,
    rows: npt.NDArray[np.int64] | None = None,
    where: str | None = None,
) -> dict[str, npt.NDArray[Any]]:
    """The values (len(rows),) of dimension features at some of n points, all by default, by name.

    `dimensions` are (n,) values of the whole cloud, see :func:`with_returns`; `where` is the cloud, for error texts.
    DimensionError where one is missing, of another length, or not finite somewhere.
    """
    out = {}
    for name in names:
        if name in COORDINATES:
            continue
        if name not in dimensions:
            cure = _MAKERS.get(name, f"Put the stage that creates {name} before this one")
            raise DimensionError(f"the dimension {name} is missing", where=where, cure=cure)
        values = np.asarray(dimensions[name])
        if values.shape != (n,) or values.dtype.kind not in "fiub":
            raise DimensionError(
                f"the dimension {name} must have one value per point",
                where=where,
                found=f"{values.dtype} of shape {values.shape}",
            )
        out[name] = values if rows is None else values[rows]
        if values.dtype.kind == "f" and (bad := np.count_nonzero(~np.isfinite(out[name]))):
            raise DimensionError(
                f"the dimension {name} is not finite at some points",
                where=where,
                found=f"{bad:,} points",
                cure=f"Remove them before this stage. {_MAKERS.get(name, '')}",
            )
    return out


def preparing() -> Any:
    """The module that knows the stages which make dimensions; it stands above this room, and is imported when asked for."""
    return pkgutil.resolve_name("pdal_stages.stages.preparation")
