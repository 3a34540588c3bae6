"""How dense a cloud is, and sparser copies of it: what a model is trained for, and how it learns to bear less."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import numpy.typing as npt

from ..base.hashing import coordinate_hash
from ..base.runs import begins_run
from ..features.cells import cell_keys
from ..features.index import cell_numbers

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


class DensityOfParts:
    """The same, of a cloud whose points come in parts that share cells at their edges alone."""

    def __init__(self) -> None:
        self._cells: dict[int, int] = {}  # cells by their number of points
        self._edges: list[npt.NDArray[np.int64]] = []  # column, row and points of others' cells

    def add(self, xyz: npt.NDArray[np.float64], box: tuple[float, float, float, float]) -> None:
        """Points of a part, and the ground (min x, min y, max x, max y) on which there are no others."""
        if not len(xyz):
            return
        keys, _ = cell_keys(xyz[:, :2], CELL)
        _, first, counts = np.unique(keys, return_index=True, return_counts=True)
        cells = cell_numbers(xyz[first, :2], CELL)
        low, high = cells * CELL, (cells + 1) * CELL
        own = ((low >= box[:2]) & (high <= box[2:])).all(axis=1)
        self._edges.append(np.column_stack([cells, counts])[~own])
        self._count(counts[own])

    def _count(self, counts: npt.NDArray[np.int64]) -> None:
        for points, cells in zip(*np.unique(counts, return_counts=True), strict=True):
            self._cells[int(points)] = self._cells.get(int(points), 0) + int(cells)

    def density(self) -> float:
        """Points per square meter, when all parts were added."""
        edges = np.concatenate([np.zeros((0, 3), np.int64), *self._edges])
        _, at = np.unique(edges[:, :2], axis=0, return_inverse=True)
        self._edges = []
        self._count(np.bincount(at.reshape(-1), edges[:, 2]).astype(np.int64))
        points = np.array(sorted(self._cells), np.int64)
        up_to = np.cumsum([self._cells[n] for n in points.tolist()])
        if not len(points):
            return 0.0
        middle = points[np.searchsorted(up_to, [(up_to[-1] - 1) // 2, up_to[-1] // 2], side="right")]
        return float(np.mean(middle)) / CELL**2


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


def thinned(
    xyz: npt.NDArray[np.float64], wanted: float, seed: int = 0, there: float | None = None
) -> npt.NDArray[np.int64] | None:
    """Rows of a copy with `wanted` points per square meter, or None where the cloud is hardly denser.

    `there` is the density of the cloud that the points are a part of; by default they are all of it. A point stays or goes
    by a hash of its coordinates: the same ones in any order and in any tile.
    """
    there = density(xyz) if there is None else there
    if wanted >= WORTH * there:
        return None
    limit = np.uint64(min(wanted / there, 1.0) * (2.0**64 - 2048.0))
    return np.flatnonzero(coordinate_hash(xyz, seed) <= limit)
