"""Points that come twice, in one file or in several: the first of each counts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from .grid import begins_run, places_among
from .hashing import hash_rows

#: West, south, east, north.
Box = tuple[float, float, float, float]
#: Coordinates are compared in steps of a millionth of their unit: the same ones under another
#: scale and offset differ by rounding.
_STEPS_PER_UNIT = 1e6


class DistinctPoints:
    """Finds points that are the first at their place and time, of a cloud that comes in parts.

    Points without a time (``GpsTime``) have the time 0. Memory: 8 bytes a point.

    Parameters
    ----------
    taken : (n,) uint64
        Keys, sorted, of points that came before the cloud.
    overlaps : sequence of (west, south, east, north)
        Where other clouds may have the same points: the keys there are kept in `shared`.
    """

    def __init__(
        self, taken: NDArray[np.uint64] | None = None, overlaps: Sequence[Box] = ()
    ) -> None:
        self._seen = np.empty(0, np.uint64) if taken is None else taken
        self._overlaps = overlaps
        self._shared: list[NDArray[np.uint64]] = []
        self.repeated = 0  #: points that are not the first

    def first(self, columns: Mapping[str, NDArray]) -> NDArray[np.bool_]:
        """Return which points (n,) of a part are the first at their place and time.

        `columns` have `X`, `Y`, `Z` in the unit of the file and, where it is known, `GpsTime`.
        """
        keys = _keys(columns)
        order = np.argsort(keys, kind="stable")
        ordered = keys[order]
        new = begins_run(ordered) & ~_among(self._seen, ordered)
        out = np.zeros(len(keys), bool)
        out[order[new]] = True
        self.repeated += len(keys) - int(np.count_nonzero(new))
        # Both parts are sorted already, which a stable sort makes use of.
        self._seen = np.sort(np.concatenate([self._seen, ordered[new]]), kind="stable")
        if self._overlaps:
            x, y = columns["X"], columns["Y"]
            near = [
                (x >= west) & (x <= east) & (y >= south) & (y <= north)
                for west, south, east, north in self._overlaps
            ]
            self._shared.append(keys[out & np.any(near, axis=0)])
        return out

    @property
    def shared(self) -> NDArray[np.uint64]:
        """Return the sorted keys (n,) of the points in `overlaps`."""
        return np.sort(np.concatenate([np.empty(0, np.uint64), *self._shared]))


def _keys(columns: Mapping[str, NDArray]) -> NDArray[np.uint64]:
    """Return a key (n,) of each point, which follows from its place and time."""
    steps = [np.rint(np.asarray(columns[axis], np.float64) * _STEPS_PER_UNIT) for axis in "XYZ"]
    times = columns["GpsTime"] if "GpsTime" in columns else np.zeros(len(steps[0]))
    return hash_rows([*steps, times], seed=0)


def count_shared(clouds: Sequence[Mapping[str, NDArray]]) -> dict[tuple[int, int], int]:
    """Return how many points of a cloud an earlier one has, too, by the numbers of both.

    Clouds are columns as of :meth:`DistinctPoints.first`, none of them empty.
    """
    boxes = [
        (*(np.min(cloud[axis]) for axis in "XY"), *(np.max(cloud[axis]) for axis in "XY"))
        for cloud in clouds
    ]
    near = [number for number, meets in enumerate(overlaps_of(boxes)) if meets]
    keys = {number: np.unique(_keys(clouds[number])) for number in near}
    counts = {(a, b): int(_among(keys[a], keys[b]).sum()) for a, b in combinations(near, 2)}
    return {pair: count for pair, count in counts.items() if count}


def _among(known: NDArray[np.uint64], keys: NDArray[np.uint64]) -> NDArray[np.bool_]:
    """Return which keys (n,) are among known ones; both are sorted."""
    return places_among(known, keys)[1] if len(known) else np.zeros(len(keys), bool)


def take_first(keys: Sequence[NDArray[np.uint64]]) -> list[NDArray[np.uint64]]:
    """Return of the sorted keys of each cloud those that a cloud before it has."""
    seen = np.empty(0, np.uint64)
    taken = []
    for each in keys:
        taken.append(each[_among(seen, each)])
        seen = np.sort(np.concatenate([seen, each]), kind="stable")
    return taken


def overlaps_of(boxes: Sequence[Box | None]) -> list[list[Box]]:
    """Return for each box where it meets others, edges included; None is a box without bounds."""
    everywhere = (-np.inf, -np.inf, np.inf, np.inf)
    bounds = np.array([box or everywhere for box in boxes], np.float64).reshape(-1, 4)
    out: list[list[Box]] = []
    for number, box in enumerate(bounds):
        low, high = np.maximum(bounds[:, :2], box[:2]), np.minimum(bounds[:, 2:], box[2:])
        meet = np.flatnonzero((low <= high).all(axis=1))
        out.append([(*low[k], *high[k]) for k in meet if k != number])
    return out
