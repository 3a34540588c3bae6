"""Noise: what is detached from everything, high in the air or below the ground.

Echoes from below (multiple reflections), birds, clouds, rain, the sun. A point is noise if neither
it nor a small cluster that it belongs to is held by anything (:mod:`.detached`): high noise if it
stands above the plane through what is around, low noise if it lies below this plane and there is
land around it, but none as deep (:mod:`.low_outliers`).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..base.asprs import NOISE
from ..base.grid import cell_numbers
from .cells import columns, usable
from .detached import LOOSE, SOLID, UNJUDGED, find_detached
from .detached import REACH as DETACHED_REACH
from .low_outliers import RULES as LOW_RULES
from .low_outliers import find_levels
from .low_outliers import reach as low_reach
from .pieces import patches

LOW: int = NOISE[0]
HIGH: int = NOISE[1]
#: Side in meters of the columns whose lowest solid points tell where the ground is.
SIDE = 1.5
#: Height in meters above the plane from which what is loose is high noise: lower it may be ground
#: under a canopy. Not tuned.
ABOVE_M = 2.5
#: Low noise has land above it, and the lowest points of crowns differ too much to be land. Of 0.25,
#: 0.33, 0.4 and 0.5, that which leaves nearly all noise below a town to be found, and spares ground
#: that is seen in single points below real canopies.
BELOW_RULES = LOW_RULES._replace(min_land=0.33)
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
        The most points of a cluster of noise; in clouds of more than 15 points/m2 it may hold more,
        as many as lie on 2 m2 of ground.
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
            if len(x[points]) > LOW_RULES.min_columns:  # fewer show no surface
                near = x[points], y[points], z[points]
                state = find_detached(*near, cluster, gap, threads)
                marks = _judge(near[2], column[points], row[points], state, depth, threads)
                rows = points if isinstance(points, slice) else points[core]
                results[:, rows] = marks[core], state[core]
        judged[:, inside] = results
    return judged[0], judged[1]


def _judge(z, column, row, state, depth, threads) -> NDArray[np.uint8]:
    """Return the codes (n,) of points by their states."""
    left, bottom = column.min() - 1, row.min() - 1
    shape = int(row.max() - bottom + 2), int(column.max() - left + 2)
    place = (row - bottom) * shape[1] + column - left
    base, low = np.full((2, *shape), np.inf)
    solid, detached = np.flatnonzero(state == SOLID), np.flatnonzero(state)
    np.minimum.at(base.ravel(), place[solid], z[solid])
    place, z, loose = place[detached], z[detached], state[detached] == LOOSE
    np.minimum.at(low.ravel(), place, z)
    has_loose = np.zeros(shape, np.bool_)
    has_loose.ravel()[place[loose]] = True
    levels = find_levels(low, base, SIDE, depth, BELOW_RULES, threads, has_loose)
    plane, limit = (level.ravel()[place] for level in levels)
    codes = np.zeros(len(state), np.uint8)
    codes[detached[z < limit]] = LOW
    codes[detached[loose & (z >= plane + ABOVE_M)]] = HIGH
    return codes
