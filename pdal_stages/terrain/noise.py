"""Noise: points and small clusters detached from everything, below the ground or above all there
is.

Echoes from below (multiple reflections), birds, clouds, the sun. All is decided on an absolute
grid, by counts and extremes, so that no order of points and no tile matters:

1. A point is suspect if it is of a small cluster that nothing joins to the rest: a component of
voxels that touch, by a
   corner at least, with few points and little extent. In thin clouds voxels are widened until they
   hold several spacings of points. A cluster that lies under others in nearly all of its columns
   may have any number of points, or be taller. What is not suspect gives every column of the grid
   its lowest and its highest point.
2. A suspect is high noise if it lies above all that is near, by a gap. The thinner the cloud, the
wider the gap and the
   way looked: a tree, or a mast, may be a single point there. What hangs in line with others, as
   wires do, stays.
3. A suspect is low noise if it lies below the ground (:mod:`.low_outliers`).
"""

from __future__ import annotations

import math
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..base.asprs import NOISE
from ..base.grid import begins_run, cell_numbers
from ..base.jit import device, njit
from .cells import HIGHEST, columns, sums_around, usable
from .components import longest_sides, number_sets
from .low_outliers import RULES as LOW_RULES
from .low_outliers import below_ground
from .low_outliers import reach as below_reach
from .pieces import patches

LOW, HIGH = NOISE
#: Side of a voxel in meters.
SIDE = 1.5
#: Columns along the side of a block in which the density is measured.
BLOCK = 8
#: Levels of voxels above and below 0.
LEVELS = 1 << 21
#: Bits of a level in a key.
BITS = 22


class DetachedRules(NamedTuple):
    """Thresholds of detached clusters, which kernels take as they are."""

    extent: float = 3.0  #: voxels that a cluster is long, at most, where a column holds few points
    extent_growth: float = 0.3  #: and so many more per point in a column: dense clusters touch more
    max_extent: int = 10  #: voxels that no cluster is longer than
    scales: int = 2  #: times that voxels are doubled in width in thin clouds
    spacings: float = 1.6  #: of points, which a voxel is wide then
    gap_growth: float = 10.0  #: meters that the gap of high noise grows per meter of spacing
    dense_m: float = 0.55  #: beyond this spacing: about 3 points/m2
    min_columns: int = 12  #: around high noise that hold what it lies above
    aside: int = 3  #: columns around within which nothing is as high as high noise, at least
    spacings_aside: float = 2.5  #: and so many spacings of points
    hanging_m: float = 5.0  #: height above the lowest point of a column from which points hang
    beneath: int = 2  #: empty voxels below what hangs
    far: int = 20  #: columns within which others of a line are looked for: a span of wires
    strung: int = 4  #: places of three columns along a line that hold others: a wire
    strung_share: float = 0.3  #: of all suspects near: two wires hang side by side at pylons
    covered: float = 0.8  #: share of a low cluster's voxels that others lie above
    steep: float = 0.5  #: rise per meter of a low cluster of few points, which ground hardly has


RULES = DetachedRules()
#: How far away, in meters, points can decide whether a point is of a small cluster: a component in
#: full and its density.
CLUSTER_REACH = (RULES.max_extent + 3 * BLOCK + 2) * SIDE
#: How far away, in meters, points can change what a point is: the halo a tile needs.
REACH = (below_reach(SIDE) + RULES.far + 2) * SIDE + CLUSTER_REACH


def detached_noise(
    x: ArrayLike,
    y: ArrayLike | None = None,
    z: ArrayLike | None = None,
    *,
    mask: ArrayLike | None = None,
    cluster: int = 60,
    gap: float = 2.5,
    depth: float = 1.0,
) -> NDArray[np.uint8]:
    """Which points are noise: 7 below the ground, 18 above everything, 0 all others.

    Parameters
    ----------
    x, y, z : array_like, shape (n,)
        Coordinates in meters; or `x` alone, of shape (n, 3).
    mask : array_like of bool, shape (n,), optional
        Points to look at; the others are as good as not there, and get 0.
    cluster : int, default 60
        The most points of a cluster of noise; one that others lie above may have more.
    gap : float, default 2.5
        How far above everything near high noise lies at least, meters; more in clouds below 3
        points/m2.
    depth : float, default 1.0
        How far below the ground low noise lies at least, meters; more where that is rough.

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
    use = usable(x, y, z, mask=mask)
    codes = np.zeros(len(x), np.uint8)
    codes[use & (z >= HIGHEST)] = HIGH
    codes[use & (z <= -HIGHEST)] = LOW
    use &= codes == 0
    inside = slice(None) if use.all() else np.flatnonzero(use)
    x, y, z = x[inside], y[inside], z[inside]
    if len(x):
        column, row = cell_numbers(x, SIDE), cell_numbers(y, SIDE)
        found = np.zeros(len(x), np.uint8)
        for points, own in patches(column, row, math.ceil(REACH / SIDE), 3 * BLOCK + 2):
            if len(x[points]) > LOW_RULES.min_columns:  # fewer tell nothing
                near = x[points], y[points], z[points], column[points], row[points]
                marks = _judge(*near, cluster, gap, depth)
                found[points if isinstance(points, slice) else points[own]] = marks[own]
        codes[inside] = found
    return codes


def _judge(x, y, z, column, row, cluster, gap, depth):
    """Codes of points, on one raster round them."""
    # One empty column on every side at least, and whole blocks.
    whole = BLOCK << RULES.scales
    left, bottom = (int(v.min() - 1) // whole * whole for v in (column, row))
    w, h = (
        -(-(int(v.max()) + 2 - start) // whole) * whole
        for v, start in ((column, left), (row, bottom))
    )
    voxels, voxel = Voxels.of(row - bottom, column - left, cell_numbers(z, SIDE), w)
    usual, spacing = surroundings(voxels)
    suspect, number = small_clusters(voxels, usual, spacing, cluster)
    place = voxels.keys >> BITS
    lowest, highest = np.full(len(place), np.inf), np.full(len(place), -np.inf)
    np.minimum.at(lowest, voxel, z)
    np.maximum.at(highest, voxel, z)
    top, base, low = np.full(h * w, -np.inf), np.full(h * w, np.inf), np.full(h * w, np.inf)
    large = _covered(voxels, number, spacing, h * w, cluster)
    plain = ~(suspect | large)
    np.minimum.at(base, place[plain], lowest[plain])
    np.maximum.at(top, place[~suspect], highest[~suspect])
    # The highest voxel of a column hangs, with nothing close beneath it, as a wire does.
    begins = np.append(begins_run(place), True)
    hangs = begins[1:] & (begins[:-1] | (np.diff(voxels.keys, prepend=0) > RULES.beneath))
    hangs &= suspect | (highest - base[place] > RULES.hanging_m)
    hung, hung_suspect = np.full(h * w, np.nan), np.zeros(h * w, bool)
    hung[place[hangs]], hung_suspect[place[hangs]] = highest[hangs], suspect[hangs]
    verdict = np.zeros(len(place), np.uint8)
    rasters = (a.reshape(h, w) for a in (top, hung, hung_suspect))
    _high(place, lowest, suspect, spacing, *rasters, gap, RULES, verdict)
    suspect = (suspect | large) & (verdict == 0)
    np.minimum.at(low, place[suspect], lowest[suspect])
    limit = below_ground(low.reshape(h, w), base.reshape(h, w), SIDE, depth)
    low = suspect & (highest < limit.ravel()[place])
    verdict[low] = LOW
    return verdict[voxel]


class Voxels(NamedTuple):
    """Voxels that hold points, by row, column and level."""

    keys: NDArray[np.int64]  #: (n,) ascending
    counts: NDArray[np.int64]  #: (n,) points in each
    width: int  #: columns of the raster, whose rim is empty

    @classmethod
    def of(cls, row, column, level, width: int, counts=None) -> tuple[Voxels, NDArray[np.int64]]:
        """Voxels of points, or of others with `counts` of them; and the number of each one's
        voxel."""
        keys, voxel = np.unique(
            ((row * width + column) << BITS) + level + LEVELS, return_inverse=True
        )
        return cls(keys, np.bincount(voxel, counts).astype(np.int64), width), voxel

    @property
    def places(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Rows, columns and levels."""
        return (*np.divmod(self.keys >> BITS, self.width), (self.keys & ((1 << BITS) - 1)) - LEVELS)


def surroundings(voxels: Voxels) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Around each voxel the usual number of points in a column, and their spacing in meters, over 3
    x 3 blocks."""
    row, column, _ = voxels.places
    wide = voxels.width // BLOCK
    block = (row // BLOCK) * wide + column // BLOCK
    size = -(-(int(block.max()) + 1) // wide) * wide
    points = np.bincount(block, voxels.counts, size).astype(np.int64).reshape(-1, wide)
    full = np.bincount(block[begins_run(voxels.keys >> BITS)], minlength=size).reshape(-1, wide)
    points, full, blocks = (sums_around(v, 1).ravel()[block] for v in (points, full, full > 0))
    return points / full, np.sqrt(blocks * (BLOCK * SIDE) ** 2 / points)


def _small(
    voxels: Voxels, usual: NDArray[np.float64], most: int, extent: int
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Find the voxels (n,) of small components, and number the components.

    Numbers (n,) are -1 where a component is as wide as `extent`, in voxels.
    """
    keys, number = voxels.keys, len(voxels.keys)
    ahead = np.array(
        [(dj * voxels.width + di) << BITS for dj, di in ((0, 1), (1, -1), (1, 0), (1, 1))]
    )
    # Above, and in columns ahead.
    spans = np.array([[1, 1], *zip(ahead - 1, ahead + 1, strict=True)])
    pairs = np.empty((2, _touching(keys, spans, np.empty((2, 0), np.int64))), np.int64)
    _touching(keys, spans, pairs)
    label = np.empty(number, np.int64)
    count = number_sets(*pairs, label)
    size = np.bincount(label, voxels.counts)
    first = np.empty(count, np.int64)
    first[label[::-1]] = np.arange(number)[::-1]  # a component's first voxel stands for it
    widest = np.minimum(RULES.extent + RULES.extent_growth * usual[first], RULES.max_extent)
    small = (size <= most) & (longest_sides(label, voxels.places, count) < widest)
    wide = longest_sides(label, voxels.places[:2], count) >= extent
    return small[label], np.where(wide[label], -1, label)


@njit
def _touching(keys, spans, pairs):
    """Fill `pairs` (2, n), where there is room, with numbers of voxels and of those whose keys are
    in the spans beyond.

    How many there are.
    """
    count, room = 0, pairs.shape[1]
    for first, last in spans:
        start = 0
        for k in range(len(keys)):
            while start < len(keys) and keys[start] < keys[k] + first:
                start += 1
            other = start
            while other < len(keys) and keys[other] <= keys[k] + last:
                if count < room:
                    pairs[0, count], pairs[1, count] = k, other
                count += 1
                other += 1
    return count


def small_clusters(
    voxels: Voxels, usual: NDArray[np.float64], spacing: NDArray[np.float64], most: int
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Find the voxels (n,) of clusters of at most `most` points that nothing joins to the rest.

    Also number (n,) the clusters that are not wide, whatever their size; -1 for none. `usual` and
    `spacing` (n,) are of :func:`surroundings`.
    """
    small, number = _small(voxels, usual, most, RULES.max_extent)
    row, column, level = voxels.places
    for scale in range(1, RULES.scales + 1):
        thin = small & (spacing * RULES.spacings > SIDE * 2 ** (scale - 1))
        if not thin.any():
            break
        # With one empty column on every side.
        width = (voxels.width >> scale) + 2
        wider, of = Voxels.of(
            (row >> scale) + 1, (column >> scale) + 1, level, width, voxels.counts
        )
        still, numbers = _small(wider, np.ones(len(wider.keys)), most, RULES.max_extent >> scale)
        small[thin] = still[of[thin]]
        number[thin] = np.where(numbers < 0, -1, numbers + number.max() + 1)[of[thin]]
    return small, number


def _covered(voxels, number, spacing, columns, most):
    """Voxels of clusters that others lie above in nearly all of their columns: of more than `most`
    points, or taller than small ones and steeper than ground is."""
    place = voxels.keys >> BITS
    top = np.full(columns, -1)
    top[place] = np.arange(len(place))  # the last of a column is its highest
    asked = np.flatnonzero(number >= 0)
    place, number_of, within = (
        place[asked],
        number[asked],
        spacing[asked] * RULES.spacings / SIDE + 0.5,
    )
    row, column, level = voxels.places
    above = np.zeros(len(asked), bool)
    for dj, di in product(range(-2, 3), repeat=2):
        other = top[np.clip(place + dj * voxels.width + di, 0, columns - 1)]
        near = max(abs(dj), abs(di)) < within
        above |= near & (other >= 0) & (number[other] != number_of) & (level[other] > level[asked])
    size = np.bincount(number_of, voxels.counts[asked])
    wide = longest_sides(number_of, (row[asked], column[asked]), len(size))
    tall = longest_sides(number_of, (level[asked],), len(size))
    mostly = np.bincount(number_of, above) >= RULES.covered * np.bincount(number_of)
    mostly &= (size > most) | (tall > RULES.extent) & (tall >= RULES.steep * wide)
    covered = np.zeros(len(number), bool)
    covered[asked] = mostly[number_of]
    return covered


@njit
def _high(place, lowest, suspect, spacing, top, hung, hung_suspect, gap, rules, verdict):
    """Say which suspects are above all that is near, and not of a line."""
    h, w = top.shape
    u, v, dz = np.empty((3, (2 * rules.far + 1) ** 2))
    for k in range(len(place)):
        if not suspect[k]:
            continue
        j, i = place[k] // w, place[k] % w
        least = gap + rules.gap_growth * max(0.0, spacing[k] - rules.dense_m)
        r = min(max(rules.aside, int(np.ceil(rules.spacings_aside * spacing[k] / SIDE))), rules.far)
        while True:
            seen, highest = 0, -np.inf
            for b in range(max(j - r, 0), min(j + r + 1, h)):
                for a in range(max(i - r, 0), min(i + r + 1, w)):
                    if (b - j) ** 2 + (a - i) ** 2 <= r * r and top[b, a] > -np.inf:
                        seen += 1
                        highest = max(highest, top[b, a])
            if seen >= rules.min_columns or r == rules.far:
                break
            r = min(2 * r, rules.far)
        if seen >= rules.min_columns and lowest[k] - highest >= least:
            verdict[k] = (
                0 if _in_line(hung, hung_suspect, j, i, lowest[k], u, v, dz, rules) else HIGH
            )


@device
def _in_line(hung, hung_suspect, j, i, z, u, v, dz, rules):
    """Whether others that hang are strung along a line through a place, as wires are, or single
    points of them."""
    h, w = hung.shape
    n = suspects = 0
    for b in range(max(j - rules.far, 0), min(j + rules.far + 1, h)):
        for a in range(max(i - rules.far, 0), min(i + rules.far + 1, w)):
            square = (b - j) ** 2 + (a - i) ** 2
            if 4 < square <= rules.far * rules.far and abs(
                hung[b, a] - z
            ) <= 1.0 + 0.3 * SIDE * np.sqrt(square):
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
                places |= 1 << int((part + rules.far) / 3.0)
        number = 0
        while places > 0:
            number += places & 1
            places >>= 1
        if number >= rules.strung and along > rules.strung_share * suspects:
            return True
    return False
