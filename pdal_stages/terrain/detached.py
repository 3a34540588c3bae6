"""Noise: points and small clusters detached from everything, below the ground or above all there is.

Echoes from below (multiple reflections), birds, clouds, the sun. All is decided on an absolute grid, by counts and
extremes, so that no order of points and no tile matters:

1. A point is suspect if it is of a small cluster that nothing joins to the rest (:mod:`.clusters`). What is not suspect
   gives every column of the grid its lowest and its highest point.
2. A suspect is high noise if it lies above all that is near, by a gap. The thinner the cloud, the wider the gap and the
   way looked: a tree, or a mast, may be a single point there. What hangs as high as wires near by, or in line with
   others, stays.
3. A suspect is low noise if it lies below a plane under its surroundings, by more than these scatter about the plane,
   unless ground as deep is near: then it is a courtyard or a well of light (:mod:`.envelope`). Under a
   closed canopy some of that is the ground, of which it lets single points through (:mod:`.canopy`).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..base.asprs import NOISE
from ..base.errors import StageError
from ..base.jit import device, njit
from .canopy import more_than_noise, seen_through_canopy
from .canopy import reach as canopy_reach
from .clusters import BITS, BLOCK, CLUSTER_REACH, SCALES, SIDE, find, small_clusters, surroundings, voxels
from .columns import columns
from .envelope import (
    ENOUGH,
    WIDER,
    has_company,
    plane_under,
    reach_of_company,
    supported_columns,
)
from .minima import cell_numbers
from .patches import patches

LOW, HIGH = NOISE
#: The gap in meters grows by this with each point of a cluster, and with the spacing of points beyond DENSE meters.
GAP_OF_POINT, GAP_GROWTH, DENSE = 0.1, 10.0, 0.55
#: The least columns within which nothing is as high, and so many spacings of points.
ASIDE, SPACINGS_ASIDE = 3, 2.5
#: Columns within which wires are looked for, so many of which show one, and how high they hang at least, meters.
IN_LINE, WIRES, HANGING = 14, 4, 5.0
#: Columns within which others of a line are looked for.
FAR = 20
#: A line has others at so many places of three columns each, and such a share of all that is suspect near: two
#: wires hang side by side, as over pylons.
STRUNG, STRUNG_SHARE = 4, 0.3
#: How far below the plane a suspect lies at least, in units of the scatter.
SCATTERS = 4.0
#: How much higher ground may be that shows that a deep place is ground, per meter of distance.
ROOM = 0.15
#: Heights beyond this, in meters, are noise whatever else there is.
_HIGHEST = 1e6


def detached_noise(
    x: ArrayLike,
    y: ArrayLike | None = None,
    z: ArrayLike | None = None,
    *,
    mask: ArrayLike | None = None,
    cluster: int = 60,
    gap: float = 2.5,
    depth: float = 1.0,
    figures: dict[str, Any] | None = None,
) -> NDArray[np.uint8]:
    """Which points are noise: 7 below the ground, 18 above everything, 0 all others.

    Parameters
    ----------
    x, y, z : array_like, shape (n,)
        Coordinates in meters; or `x` alone, of shape (n, 3).
    mask : array_like of bool, shape (n,), optional
        Points to look at; the others are as good as not there, and get 0.
    cluster : int, default 60
        The most points of a cluster of noise.
    gap : float, default 2.5
        How far above everything near high noise lies at least, meters; more in clouds below 3 points/m2.
    depth : float, default 1.0
        How far below the ground low noise lies at least, meters; more where that is rough.
    figures : dict, optional
        Receives the counts ``low`` and ``high``.

    Returns
    -------
    ndarray of uint8, shape (n,)
        0, 7 or 18. Points whose coordinates are not finite get 0.

    Raises
    ------
    StageError
        If shapes differ.
    """
    x, y, z = columns(x, y, z)
    use = np.ones(len(x), bool) if mask is None else np.array(mask, bool)
    if use.shape != x.shape:
        raise StageError("'mask' must have one value per point", found=f"{use.shape}, {len(x):,} points")
    use &= np.isfinite(x) & np.isfinite(y) & np.isfinite(z)
    codes = np.zeros(len(x), np.uint8)
    codes[use & (z >= _HIGHEST)] = HIGH
    codes[use & (z <= -_HIGHEST)] = LOW
    use &= codes == 0
    inside = slice(None) if use.all() else np.flatnonzero(use)
    x, y, z = x[inside], y[inside], z[inside]
    if len(x):
        column, row = cell_numbers(x, SIDE), cell_numbers(y, SIDE)
        found = np.zeros(len(x), np.uint8)
        for points, own in patches(column, row, math.ceil(REACH / SIDE), 3 * BLOCK + 2):
            marks = _judge(x[points], y[points], z[points], column[points], row[points], cluster, gap, depth)
            found[points if isinstance(points, slice) else points[own]] = marks[own]
        codes[inside] = found
    if figures is not None:
        figures["low"], figures["high"] = (int(np.count_nonzero(codes == code)) for code in NOISE)
    return codes


#: How far away, in meters, points can change what a point is: the halo a tile needs.
REACH = (canopy_reach(SIDE) + max(reach_of_company(SIDE) + 2, FAR) + 2) * SIDE + CLUSTER_REACH


def _judge(x, y, z, column, row, cluster, gap, depth):
    """Codes of points, on one raster round them."""
    # One empty column on every side at least, and whole blocks.
    whole = BLOCK << SCALES
    left, bottom = (int(v.min() - 1) // whole * whole for v in (column, row))
    w, h = (-(-(int(v.max()) + 2 - start) // whole) * whole for v, start in ((column, left), (row, bottom)))
    voxel, keys, counts, table = voxels(column, row, cell_numbers(z, SIDE), left, bottom, w)
    usual, spacing = surroundings(keys, counts, w, h)
    suspect, size = small_clusters(keys, counts, table, usual, spacing, w, h, cluster)
    extremes = np.empty((len(keys), 2))
    top, base = np.full((h, w), -np.inf), np.full((h, w), np.inf)
    _fill(z, voxel, keys, suspect, top, base, extremes)
    verdict = np.zeros(len(keys), np.uint8)
    hung = np.full((h, w), np.nan)
    _hanging(keys, table, suspect, extremes, top, base, hung)
    _high(keys, suspect, size, extremes, top, hung, spacing, gap, verdict)
    _keep_lines(keys, extremes, np.full((h, w), np.inf), verdict)
    supported = np.zeros((h, w), bool)
    supported_columns(base, supported)
    _low(keys, suspect, extremes, base, supported, reach_of_company(SIDE), depth, verdict)
    low, column = verdict == LOW, keys >> BITS
    if low.any():
        lowest = np.full((h, w), np.inf)
        np.minimum.at(lowest.ravel(), column[low], extremes[low, 0])
        lows, points = (np.bincount(column[of], counts[of], h * w).reshape(h, w) for of in (low, slice(None)))
        ground = seen_through_canopy(lowest, base, supported, SIDE) | more_than_noise(lows, points)
        verdict[low & ground.ravel()[column]] = 0
    return verdict[voxel]


@njit
def _fill(z, voxel, keys, suspect, top, base, extremes):
    """Highest and lowest of what is no suspect in each column; of suspects in each voxel."""
    w = top.shape[1]
    for k in range(len(keys)):
        extremes[k, 0], extremes[k, 1] = np.inf, -np.inf
    for p in range(len(z)):
        k = voxel[p]
        if z[p] < extremes[k, 0]:
            extremes[k, 0] = z[p]
        if z[p] > extremes[k, 1]:
            extremes[k, 1] = z[p]
    for k in range(len(keys)):
        if not suspect[k]:
            place = keys[k] >> BITS
            j, i = place // w, place % w
            base[j, i] = min(base[j, i], extremes[k, 0])
            top[j, i] = max(top[j, i], extremes[k, 1])


@njit
def _hanging(keys, table, suspect, extremes, top, base, hung):
    """Fill `hung` with the top of each column whose highest voxel has nothing close beneath it, such as a wire."""
    w = top.shape[1]
    for k in range(len(keys)):
        place = keys[k] >> BITS
        j, i = place // w, place % w
        if not suspect[k] and extremes[k, 1] >= top[j, i] and top[j, i] - base[j, i] > HANGING:  # noqa: SIM102
            if find(table, keys, keys[k] - 1) < 0 and find(table, keys, keys[k] - 2) < 0:
                hung[j, i] = top[j, i]


@device
def _hangs_in_line(hung, j, i, z):
    h, w = hung.shape
    company = 0
    for b in range(max(j - IN_LINE, 0), min(j + IN_LINE + 1, h)):
        for a in range(max(i - IN_LINE, 0), min(i + IN_LINE + 1, w)):
            square = (b - j) ** 2 + (a - i) ** 2
            if square <= IN_LINE * IN_LINE and abs(hung[b, a] - z) <= 1.0 + 0.2 * SIDE * np.sqrt(square):
                company += 1
    return company >= WIRES


@njit
def _high(keys, suspect, size, extremes, top, hung, spacing, gap, verdict):
    h, w = top.shape
    for k in range(len(keys)):
        if not suspect[k]:
            continue
        place = keys[k] >> BITS
        j, i = place // w, place % w
        apart = spacing[j // BLOCK, i // BLOCK]
        least = gap + GAP_OF_POINT * size[k] + GAP_GROWTH * max(0.0, apart - DENSE)
        r = min(max(ASIDE, int(np.ceil(SPACINGS_ASIDE * apart / SIDE))), FAR)
        while True:
            seen, highest = 0, -np.inf
            for b in range(max(j - r, 0), min(j + r + 1, h)):
                for a in range(max(i - r, 0), min(i + r + 1, w)):
                    if (b - j) ** 2 + (a - i) ** 2 <= r * r and top[b, a] > -np.inf:
                        seen += 1
                        highest = max(highest, top[b, a])
            if seen >= ENOUGH or r == FAR:
                break
            r = min(2 * r, FAR)
        z = extremes[k, 0]
        if seen >= ENOUGH and z - highest >= least and not _hangs_in_line(hung, j, i, z):
            verdict[k] = HIGH


@njit
def _keep_lines(keys, extremes, spread, verdict):
    """Take back what is strung along a line: wires of which a thin cloud has but single points."""
    h, w = spread.shape
    for k in range(len(keys)):
        if verdict[k] == HIGH:
            place = keys[k] >> BITS
            spread[place // w, place % w] = min(spread[place // w, place % w], extremes[k, 0])
    size = (2 * FAR + 1) ** 2
    u, v, dz = np.empty(size), np.empty(size), np.empty(size)
    for k in range(len(keys)):
        if verdict[k] != HIGH:
            continue
        place = keys[k] >> BITS
        j, i = place // w, place % w
        n = 0
        for b in range(max(j - FAR, 0), min(j + FAR + 1, h)):
            for a in range(max(i - FAR, 0), min(i + FAR + 1, w)):
                square = (b - j) ** 2 + (a - i) ** 2
                if 4 < square <= FAR * FAR and spread[b, a] < np.inf:
                    u[n], v[n], dz[n] = a - i, b - j, spread[b, a] - extremes[k, 0]
                    if abs(dz[n]) <= 1.0 + 0.3 * SIDE * np.sqrt(square):
                        n += 1
        for a in range(n):
            far = np.sqrt(u[a] * u[a] + v[a] * v[a])
            along, places = 0, 0
            for b in range(n):
                part = (u[a] * u[b] + v[a] * v[b]) / far
                aside = abs(u[a] * v[b] - v[a] * u[b]) / far
                if aside <= 1.0 and abs(dz[b] - part / far * dz[a]) <= 2.0:
                    along += 1
                    places |= 1 << int((part + FAR) / 3.0)
            number = 0
            while places > 0:
                number += places & 1
                places >>= 1
            if number >= STRUNG and along > STRUNG_SHARE * n:
                verdict[k] = 0
                break


@njit
def _low(keys, suspect, extremes, base, supported, far, depth, verdict):
    w = base.shape[1]
    size = (2 * WIDER + 1) ** 2
    u, v, zs, weight = np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    for k in range(len(keys)):
        if not suspect[k] or verdict[k] != 0:
            continue
        place = keys[k] >> BITS
        j, i = place // w, place % w
        n, height, across, along, scatter = plane_under(base, j, i, u, v, zs, weight)
        z = extremes[k, 1]
        if (
            n >= ENOUGH
            and height - z > depth + SCATTERS * scatter
            and not has_company(base, supported, SIDE, far, ROOM, 0.0, j, i, z, height, across, along)
        ):
            verdict[k] = LOW
