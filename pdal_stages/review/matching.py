"""Which point of one file is which of another, whose points stand in another order."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


def partners(
    before: NDArray[np.float64],
    after: NDArray[np.float64],
    step: float,
    more: Sequence[tuple[NDArray, NDArray]] = (),
    apart: float = 0.0,
) -> NDArray[np.int64]:
    """For each point of `before` its place in `after`, -1 where there is none; each of `after` is taken once.

    Parameters
    ----------
    before, after : (n, 3) and (m, 3) float64
        Coordinates.
    step : float
        What coordinates are whole numbers of, the coarser of both files.
    more : sequence of pairs of arrays
        Values that tell points of one place apart: times, return numbers, then classes. Values that no longer agree only
        change which of them are paired.
    apart : float
        Points that have no partner at their place take the nearest left within this distance.
    """
    out = np.full(len(before), -1, np.int64)
    low = np.minimum(before.min(axis=0), after.min(axis=0)) if len(before) and len(after) else 0.0
    cells = [np.rint((xyz - low) / step).astype(np.int64) for xyz in (before, after)]
    order, place = [], []
    joined = np.concatenate(cells)
    _, name = np.unique(joined, axis=0, return_inverse=True)
    names = name.reshape(-1)[: len(before)], name.reshape(-1)[len(before) :]
    for side, named in enumerate(names):
        keys = [pair[side] for pair in more]
        order.append(np.lexsort((*reversed(keys), named)))
        ordered = named[order[-1]]
        place.append(
            (ordered, np.arange(len(ordered)) - np.searchsorted(ordered, ordered))
        )  # which of its place
    size = int(max((len(before), len(after), 1)))
    mine, theirs = (named * size + number for named, number in place)
    at = np.searchsorted(theirs, mine)
    there = at < len(theirs)
    there[there] = theirs[at[there]] == mine[there]
    out[order[0][there]] = order[1][at[there]]
    if apart > 0:
        _nearest_left(before, after, out, apart)
    return out


def _nearest_left(
    before: NDArray[np.float64], after: NDArray[np.float64], out: NDArray[np.int64], apart: float
) -> None:
    """Pair what is left over, nearest first."""
    from scipy.spatial import cKDTree

    mine = np.flatnonzero(out < 0)
    free = np.ones(len(after), bool)
    free[out[out >= 0]] = False
    theirs = np.flatnonzero(free)
    if not len(mine) or not len(theirs):
        return
    far, near = cKDTree(after[theirs]).query(before[mine], distance_upper_bound=apart)
    good = np.flatnonzero(np.isfinite(far))
    good = good[np.argsort(far[good], kind="stable")]
    _, first = np.unique(near[good], return_index=True)
    chosen = good[first]
    out[mine[chosen]] = theirs[near[chosen]]


def near_any(xyz: NDArray[np.float64], chosen: NDArray[np.bool_], within: float) -> NDArray[np.bool_]:
    """(n,) points that lie `within` so many meters of a chosen one."""
    from scipy.spatial import cKDTree

    if within <= 0 or not chosen.any():
        return chosen.copy()
    low, high = xyz[chosen].min(axis=0) - within, xyz[chosen].max(axis=0) + within
    maybe = np.flatnonzero(((xyz >= low) & (xyz <= high)).all(axis=1))
    far, _ = cKDTree(xyz[chosen]).query(xyz[maybe], distance_upper_bound=np.nextafter(within, np.inf))
    out = chosen.copy()
    out[maybe[np.isfinite(far)]] = True
    return out
