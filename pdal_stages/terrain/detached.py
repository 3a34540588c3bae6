"""Noise: points and small clusters detached from everything, below the ground or above all there is.

Echoes from below (multiple reflections), birds, clouds, the sun. All is decided on an absolute grid, by counts and
extremes, so that no order of points and no tile matters:

1. A point is suspect if it is of a small cluster that nothing joins to the rest (:mod:`.clusters`). What is not suspect
   gives every column of the grid its lowest and its highest point.
2. A suspect is high noise if it lies above all that is near, by a gap. The thinner the cloud, the wider the gap and the
   way looked: a tree, or a mast, may be a single point there. What hangs in line with others, as wires do, stays.
3. A suspect is low noise if it lies below the ground (:mod:`.belowground`).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..base.arrays import begins_run
from ..base.asprs import NOISE
from ..base.errors import StageError
from ..base.jit import device, njit
from .belowground import AROUND, ENOUGH, below_ground
from .belowground import reach as below_reach
from .cells import cell_numbers, columns
from .clusters import BITS, BLOCK, CLUSTER_REACH, SCALES, SIDE, Voxels, small_clusters, surroundings
from .linked import sums_around
from .patches import patches

LOW, HIGH = NOISE
#: The gap in meters grows by this with each point of a cluster, and with the spacing of points beyond DENSE meters.
GAP_OF_POINT, GAP_GROWTH, DENSE = 0.1, 10.0, 0.55
#: The least columns within which nothing is as high, and so many spacings of points.
ASIDE, SPACINGS_ASIDE = 3, 2.5
#: How high what hangs is above the lowest point of its column, where nothing is in so many voxels beneath it.
HANGING, BENEATH = 5.0, 2
#: Columns within which others of a line are looked for.
FAR = 20
#: A line has others at so many places of three columns each, and such a share of all suspects near: two wires hang side
#: by side, as over pylons.
STRUNG, STRUNG_SHARE = 4, 0.3
#: More than such a share of the points and of the columns within so many around, so many columns at least, is no noise.
TOO_MANY, COLUMNS = 0.025, 6
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
REACH = (below_reach(SIDE) + FAR + 2) * SIDE + CLUSTER_REACH


def _judge(x, y, z, column, row, cluster, gap, depth):
    """Codes of points, on one raster round them."""
    # One empty column on every side at least, and whole blocks.
    whole = BLOCK << SCALES
    left, bottom = (int(v.min() - 1) // whole * whole for v in (column, row))
    w, h = (-(-(int(v.max()) + 2 - start) // whole) * whole for v, start in ((column, left), (row, bottom)))
    voxels, voxel = Voxels.of(row - bottom, column - left, cell_numbers(z, SIDE), w)
    usual, spacing = surroundings(voxels)
    suspect, size = small_clusters(voxels, usual, spacing, cluster)
    place = voxels.keys >> BITS
    lowest, highest = np.full(len(place), np.inf), np.full(len(place), -np.inf)
    np.minimum.at(lowest, voxel, z)
    np.maximum.at(highest, voxel, z)
    top, base, low = np.full(h * w, -np.inf), np.full(h * w, np.inf), np.full(h * w, np.inf)
    np.minimum.at(base, place[~suspect], lowest[~suspect])
    np.maximum.at(top, place[~suspect], highest[~suspect])
    # The highest voxel of a column hangs, with nothing close beneath it, as a wire does.
    begins = np.append(begins_run(place), True)
    hangs = begins[1:] & (begins[:-1] | (np.diff(voxels.keys, prepend=0) > BENEATH))
    hangs &= suspect | (highest - base[place] > HANGING)
    hung, hung_suspect = np.full(h * w, np.nan), np.zeros(h * w, bool)
    hung[place[hangs]], hung_suspect[place[hangs]] = highest[hangs], suspect[hangs]
    verdict = np.zeros(len(place), np.uint8)
    rasters = (a.reshape(h, w) for a in (top, hung, hung_suspect))
    _high(place, lowest, suspect, size, spacing, *rasters, gap, verdict)
    suspect &= verdict == 0
    np.minimum.at(low, place[suspect], lowest[suspect])
    limit = below_ground(low.reshape(h, w), base.reshape(h, w), SIDE, depth)
    low = suspect & (highest < limit.ravel()[place])
    # Where more is low than noise is, it is none.
    lows, points = (
        np.bincount(place[of], voxels.counts[of], h * w).reshape(h, w) for of in (low, slice(None))
    )
    share = [
        sums_around(few, AROUND) > TOO_MANY * sums_around(all_, AROUND)
        for few, all_ in ((lows, points), (lows > 0, points > 0))
    ]
    many = share[0] & share[1] & (sums_around(lows > 0, AROUND) >= COLUMNS)
    verdict[low & ~many.ravel()[place]] = LOW
    return verdict[voxel]


@njit
def _high(place, lowest, suspect, size, spacing, top, hung, hung_suspect, gap, verdict):
    """Say which suspects are above all that is near, and not of a line."""
    h, w = top.shape
    u, v, dz = np.empty((3, (2 * FAR + 1) ** 2))
    for k in range(len(place)):
        if not suspect[k]:
            continue
        j, i = place[k] // w, place[k] % w
        least = gap + GAP_OF_POINT * size[k] + GAP_GROWTH * max(0.0, spacing[k] - DENSE)
        r = min(max(ASIDE, int(np.ceil(SPACINGS_ASIDE * spacing[k] / SIDE))), FAR)
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
        if seen >= ENOUGH and lowest[k] - highest >= least:
            verdict[k] = 0 if _in_line(hung, hung_suspect, j, i, lowest[k], u, v, dz) else HIGH


@device
def _in_line(hung, hung_suspect, j, i, z, u, v, dz):
    """Whether others that hang are strung along a line through a place, as wires are, or single points of them."""
    h, w = hung.shape
    n = suspects = 0
    for b in range(max(j - FAR, 0), min(j + FAR + 1, h)):
        for a in range(max(i - FAR, 0), min(i + FAR + 1, w)):
            square = (b - j) ** 2 + (a - i) ** 2
            if 4 < square <= FAR * FAR and abs(hung[b, a] - z) <= 1.0 + 0.3 * SIDE * np.sqrt(square):
                u[n], v[n], dz[n] = a - i, b - j, hung[b, a] - z
                n += 1
                suspects += hung_suspect[b, a]
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
        if number >= STRUNG and along > STRUNG_SHARE * suspects:
            return True
    return False
