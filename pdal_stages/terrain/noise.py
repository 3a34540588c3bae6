"""Noise: what is detached from everything, high in the air or below the ground.

Echoes from below (multiple reflections), birds, clouds, rain, the sun. A point is noise if neither
it nor a small cluster that it belongs to is held by anything (:mod:`.detached`): high noise if it
stands above what is around, low noise if it lies below the ground (:mod:`.low_outliers`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..base.asprs import NOISE
from ..base.grid import cell_keys, cell_numbers, places_among
from ..base.jit import njit
from .cells import columns, usable
from .detached import HEAVY, HELD, LOOSE, SOLID, UNJUDGED, find_detached, sum_around
from .detached import REACH as DETACHED_REACH
from .low_outliers import limits_below_ground
from .low_outliers import reach as low_reach
from .pieces import patches

LOW: int = NOISE[0]
HIGH: int = NOISE[1]
#: Side in meters of the columns whose lowest solid points tell where the ground is.
SIDE = 1.5
#: The same of those that tell what lies under others, which takes some 2 points/m2.
SMALL = 1.0


class NoiseRules(NamedTuple):
    """Thresholds of high noise; a NamedTuple, as kernels read it. Not tuned."""

    above_m: float = 2.5  #: height above the lowest around: lower it may be ground under a canopy
    aside: int = 3  #: columns around in which that is looked for ...
    far: int = 20  #: ... or up to so many, until enough hold points
    min_columns: int = 12  #: columns with points: below fewer nothing is judged
    buried: float = 0.8  #: share of heavy points that solid ones lie above, at least, in low noise


RULES = NoiseRules()
#: How far away, in meters, points can change what a point is, the halo a tile needs.
REACH = DETACHED_REACH + low_reach(SIDE) * SIDE


def detached_noise(
    x: ArrayLike,
    y: ArrayLike | None = None,
    z: ArrayLike | None = None,
    *,
    mask: ArrayLike | None = None,
    cluster: int = 30,
    gap: float = 1.85,
    depth: float = 1.0,
    threads: int | None = None,
) -> NDArray[np.uint8]:
    """Find noise: return 7 for points below the ground, 18 for those in the air, else 0.

    Parameters
    ----------
    x, y, z : array_like, shape (n,)
        Coordinates in meters; or `x` alone, of shape (n, 3).
    mask : array_like of bool, shape (n,), optional
        Points to look at; the others are ignored, and get 0.
    cluster : int, default 30
        The most points of a cluster of noise; in clouds of more than 10 points/m2 it may hold more,
        as many as lie on 3 m2 of ground.
    gap : float, default 1.85
        Distance in meters from everything else, at 10 points/m2: it grows with the cube root of
        the area per point, from 1 to 6 m.
    depth : float, default 1.0
        Least depth of low noise below the ground, meters.
    threads : int, optional
        By default every core. The result does not depend on it.

    Returns
    -------
    ndarray of uint8, shape (n,)
        0, 7 or 18. Points whose coordinates are not finite get 0.

    Raises
    ------
    StageError
        If shapes differ.
    """
    return judge_noise(x, y, z, mask, cluster, gap, depth, threads)[0]


def judge_noise(
    x: ArrayLike,
    y: ArrayLike | None,
    z: ArrayLike | None,
    mask: ArrayLike | None,
    cluster: int,
    gap: float,
    depth: float,
    threads: int | None,
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the codes (n,) of :func:`detached_noise`, and the states (n,) that they come from."""
    x, y, z = columns(x, y, z)
    use = usable(x, y, z, mask=mask)
    judged = np.zeros((2, len(x)), np.uint8)
    judged[1] = UNJUDGED
    inside = slice(None) if use.all() else np.flatnonzero(use)
    x, y, z = x[inside], y[inside], z[inside]
    if len(x):
        results = judged[:, inside]
        column, row = cell_numbers(x, SIDE), cell_numbers(y, SIDE)
        link = math.ceil(DETACHED_REACH / SIDE)
        for points, core in patches(column, row, math.ceil(REACH / SIDE), link):
            if len(x[points]) > RULES.min_columns:  # fewer show no surface
                near = x[points], y[points], z[points]
                state = find_detached(*near, cluster, gap, threads)
                marks = _judge(*near, column[points], row[points], state, depth, threads)
                rows = points if isinstance(points, slice) else points[core]
                results[:, rows] = marks[core], state[core]
        judged[:, inside] = results
    return judged[0], judged[1]


def _judge(x, y, z, column, row, state, depth, threads) -> NDArray[np.uint8]:
    """Return the codes (n,) of points by their states."""
    left, bottom = column.min() - 1, row.min() - 1
    shape = int(row.max() - bottom + 2), int(column.max() - left + 2)
    place = (row - bottom) * shape[1] + column - left
    base, low, solid, heavy = np.full((4, *shape), np.inf)
    buried = _find_buried(x, y, z, place, state, shape)
    codes = np.zeros(len(z), np.uint8)
    _lowest(place, z, state, SOLID, SOLID, solid.ravel())
    detached = np.flatnonzero(state)
    place, z, state = place[detached], z[detached], state[detached]
    _lowest(place, z, state, HEAVY, HEAVY, heavy.ravel())
    np.minimum(solid, heavy, out=base)
    marks = np.where(_stand_above(place, z, state, base, RULES), HIGH, 0)
    _lowest(place, z, np.where(marks == HIGH, SOLID, state), HELD, LOOSE, low.ravel())
    limit = limits_below_ground(low, base, SIDE, depth, threads).ravel()
    marks[(marks == 0) & (state != HEAVY) & (z < limit[place])] = LOW
    if np.isfinite(heavy).any():
        limit = limits_below_ground(heavy, solid, SIDE, depth, threads).ravel()
        marks[buried[detached] & (z < limit[place])] = LOW
    codes[detached] = marks
    return codes


def _find_buried(x, y, z, place, state, shape) -> NDArray[np.bool_]:
    """Return which points (n,) are heavy and lie under solid ones, as nearly all heavy ones near.

    Ground in a courtyard or a pit has no roof; echoes from below have the ground above them.
    """
    buried = np.zeros(len(z), np.bool_)
    heavy = np.flatnonzero(state == HEAVY)
    if not len(heavy):
        return buried
    count, under = np.zeros((2, shape[0] * shape[1]), np.int64)
    np.add.at(count, place[heavy], 1)
    above = np.flatnonzero((count[place] > 0) & (state == SOLID))
    small = [cell_keys(*(cell_numbers(a[k], SMALL) for a in (x, y))) for k in (heavy, above)]
    keys = np.unique(small[0])
    at, there = places_among(keys, small[1])
    top = np.full(len(keys), -np.inf)
    np.maximum.at(top, at[there], z[above[there]])
    is_under = z[heavy] < top[np.searchsorted(keys, small[0])]
    np.add.at(under, place[heavy[is_under]], 1)
    sums = [each.reshape(shape) for each in (count, under)]
    for _ in range(RULES.aside):
        sums = [sum_around(each) for each in sums]
    buried[heavy] = (sums[1] >= RULES.buried * sums[0]).ravel()[place[heavy]]
    return buried


@njit
def _lowest(place, z, state, first, last, lowest):
    """Lower `lowest` to the heights of the points whose state is one of `first` to `last`."""
    for k in range(len(z)):
        if first <= state[k] <= last:
            lowest[place[k]] = min(lowest[place[k]], z[k])


@njit
def _stand_above(place, z, state, base, rules):
    """Tell which loose points (n,) are high above the lowest solid points around."""
    h, w = base.shape
    above = np.zeros(len(z), np.bool_)
    for k in range(len(z)):
        if state[k] != LOOSE:
            continue
        j, i = place[k] // w, place[k] % w
        r = rules.aside
        while True:
            seen, lowest = 0, np.inf
            for b in range(max(j - r, 0), min(j + r + 1, h)):
                for a in range(max(i - r, 0), min(i + r + 1, w)):
                    if (b - j) ** 2 + (a - i) ** 2 <= r * r and base[b, a] < np.inf:
                        seen += 1
                        lowest = min(lowest, base[b, a])
            if seen >= rules.min_columns or r == rules.far:
                break
            r = min(2 * r, rules.far)
        above[k] = seen >= rules.min_columns and z[k] - lowest >= rules.above_m
    return above
