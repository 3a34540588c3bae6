"""How dense a cloud is, and sparser copies of it: what a model is trained for, and how it learns to bear less."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import numpy.typing as npt

from ..base.hashing import coordinate_hash
from ..base.runs import begins_run
from ..features.cells import cell_keys

#: Side in meters of the cells that density is measured in.
CELL = 2.0
#: How many times sparser or denser a cloud may be than those trained on before that is said.
TOLERANCE = 2.0
#: A copy is made where it would have less than this share of the points.
WORTH = 0.75


def density(xyz: npt.NDArray[np.float64]) -> float:
    """Points per square meter: the median over the occupied cells of :data:`CELL` meters, 0 for an empty cloud.

    Strays, holes and the cloud's outline do not matter, and the order of the points does not.
    """
    if not len(xyz):
        return 0.0
    keys, _ = cell_keys(xyz[:, :2], CELL)
    keys.sort()
    starts = np.flatnonzero(begins_run(keys))
    return float(np.median(np.diff(np.append(starts, len(keys))))) / CELL**2


def out_of_range(found: float, trained: Mapping[str, float]) -> bool:
    """Whether a cloud is much sparser or denser than those a model was trained on (see :func:`density_range`)."""
    return not trained["low"] / TOLERANCE <= found <= trained["high"] * TOLERANCE


def range_text(trained: Mapping[str, float]) -> str:
    """``0.3 to 46``, or one number where both are alike."""
    low, high = f"{trained['low']:.3g}", f"{trained['high']:.3g}"
    return low if low == high else f"{low} to {high}"


def density_range(densities: Iterable[float]) -> dict[str, float]:
    """Smallest and largest density of some clouds, as a manifest has it; empty ones do not count."""
    found = [one for one in densities if one]
    return {"low": min(found, default=0.0), "high": max(found, default=0.0)}


def thinned(xyz: npt.NDArray[np.float64], wanted: float, seed: int = 0) -> npt.NDArray[np.int64] | None:
    """Rows of a copy with `wanted` points per square meter, or None where the cloud is hardly denser.

    A point stays or goes by a hash of its coordinates: the same ones in any order.
    """
    there = density(xyz)
    if wanted >= WORTH * there:
        return None
    limit = np.uint64(min(wanted / there, 1.0) * (2.0**64 - 2048.0))
    return np.flatnonzero(coordinate_hash(xyz, seed) <= limit)
