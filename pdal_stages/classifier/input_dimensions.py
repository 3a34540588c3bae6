"""Dimensions that classifiers read: which a cloud must have, and their values."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import numpy.typing as npt

from ..base.errors import DimensionError
from ..base.threads import map_blocks
from ..features import return_features
from ..features.gap_below import NAME as GAP_BELOW
from ..features.gap_below import gap_below

#: Dimensions of every point; the feature engine takes them from the coordinates.
COORDINATES = ("X", "Y", "Z")
#: Dimensions that a model is trained on by default.
DEFAULT_DIMENSIONS = ("HeightAboveGround",)
#: Dimensions that a model is trained on as well where the points have them: what `PREPARATION` in
#: stages/preprocessing.py makes. Widths of 5 and 17 m: what they gain is in docs/trials.md. Models
#: name their dimensions, so changing these changes only models trained from then on.
OPTIONAL_DIMENSIONS = ("Ground", "HeightAboveOpening_5", "HeightAboveOpening_17")
#: Dimension that is 1 where a person has checked a point's class.
CHECKED = "Checked"

_FROM_READER = "It comes from the reader; this source has none. Use a model trained without it"
_FROM_HEIGHTS = (
    "In a pipeline put filters.hag_morphological before this stage, or what the model was trained "
    "with; in Python leave all heights out, or filtered_ground(xyz) makes this one"
)
#: Dimension -> what to do where it is missing.
_CURES = {
    **dict.fromkeys((*DEFAULT_DIMENSIONS, *OPTIONAL_DIMENSIONS), _FROM_HEIGHTS),
    **dict.fromkeys(("Intensity", *return_features.SOURCES), _FROM_READER),
}


def required_dimensions(names: Iterable[str]) -> tuple[str, ...]:
    """Return the dimensions among feature names that a cloud must have.

    These are neither coordinates nor what :func:`add_surroundings` computes.
    """
    known = (*COORDINATES, *return_features.NAMES, GAP_BELOW)
    return tuple(dict.fromkeys(name for name in names if name not in known))


def optional_dimensions(names: Iterable[str]) -> tuple[str, ...]:
    """Return dimensions that features use where a cloud has them: return numbers."""
    used = any(name in return_features.NAMES for name in names)
    return return_features.SOURCES if used else ()


def list_values(
    names: Iterable[str],
    dimensions: Mapping[str, npt.ArrayLike],
    n: int,
    rows: npt.NDArray[np.int64] | npt.NDArray[np.bool_] | None = None,
    where: str | None = None,
) -> list[npt.NDArray]:
    """Return the values (n,) of the dimensions that features use.

    Optional ones may be missing. Values are checked at `rows`, as by :func:`take_dimensions`.
    """
    names = tuple(names)
    optional = (name for name in optional_dimensions(names) if name in dimensions)
    read = [*required_dimensions(names), *optional]
    for name in read:  # one after the other: it may be a copy
        take_dimensions((name,), dimensions, n, rows, where)
    return [np.asarray(dimensions[name]) for name in read]


def add_surroundings(
    names: Iterable[str],
    xyz: npt.NDArray[np.float64],
    dimensions: Mapping[str, npt.ArrayLike],
    threads: int | None = None,
) -> Mapping[str, npt.ArrayLike]:
    """Return the dimensions (n,) with the return features and the gap below among `names`.

    These are computed from return numbers and the points (n, 3) around.
    """
    wanted = {*names}
    together = [wanted & {*group} for group in (*return_features.BY_SCALE, (GAP_BELOW,))]

    def compute(group: set[str]) -> dict[str, npt.NDArray]:
        return return_features.return_features(group, xyz, dimensions) | gap_below(group, xyz)

    out = dict(dimensions)
    for columns in map_blocks(compute, [*filter(None, together)], threads):
        out |= columns
    return out


def take_dimensions(
    names: Iterable[str],
    dimensions: Mapping[str, npt.ArrayLike],
    n: int,
    rows: npt.NDArray[np.int64] | npt.NDArray[np.bool_] | None = None,
    where: str | None = None,
) -> dict[str, npt.NDArray]:
    """Return by name, but for coordinates, the dimensions at some rows of a cloud of n points.

    Parameters
    ----------
    names : iterable of str
    dimensions : mapping of str to (n,) array
        See :func:`add_surroundings`.
    rows : (m,) int64 or (n,) bool, optional
        All n by default.
    where : str, optional
        The cloud's name, for messages.

    Raises
    ------
    DimensionError
        Where a dimension is missing, has another length, or is not finite at one of the rows.
    """
    out = {}
    for name in names:
        if name in COORDINATES:
            continue
        if name not in dimensions:
            cure = _CURES.get(name, f"Put the stage that creates {name} before this one")
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
                cure=f"Remove them before this stage. {_CURES.get(name, '')}",
            )
    return out
