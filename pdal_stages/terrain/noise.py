"""Noise: points and small clusters detached from everything, below the ground or above all else.

Echoes from below (multiple reflections), birds, clouds, the sun. Every decision is made on an
absolute grid, by counts and extremes, so that neither the order of points nor tiles matter:

1. A point is suspect if it belongs to a small cluster that nothing joins to the rest: a component
   of voxels that touch, by a corner at least, with few points and little extent. In thin clouds
   voxels are widened until they hold several spacings of points. What is not suspect gives every
   column of the grid its lowest and its highest point.
2. A suspect is high noise if it lies above everything near, by a gap. What hangs in line with
   others, as wires do, stays.
3. A suspect is low noise if it lies below the ground (:mod:`.low_outliers`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..base.asprs import NOISE
from ..base.grid import begins_run, cell_numbers
from ..base.jit import device, njit
from .cells import HIGHEST, columns, usable
from .components import longest_sides, number_sets
from .low_outliers import RULES as LOW_RULES
from .low_outliers import limits_below_ground
from .low_outliers import reach as low_reach
from .pieces import patches

LOW: int = NOISE[0]
HIGH: int = NOISE[1]
#: Side of a voxel in meters.
SIDE = 1.5
#: Columns along the side of a block; the density is that of 3 x 3 blocks, 36 m. Not tuned.
BLOCK = 8
#: Layers of voxels above and below 0.
LAYERS = 1 << 21
#: Bits of a layer in a key.
BITS = 22


class DetachedRules(NamedTuple):
    """Thresholds of detached clusters; a NamedTuple, as kernels read it.

    Where docs/results/ablation.md has a rule, the error without it is given here, in percent: it is
    0.081 with all of them. The values themselves are not tuned.
    """

    #: a cluster is shorter than this, in voxels, where columns hold few points
    extent: float = 3.0
    #: voxels that a cluster may be longer per point in a column: dense clusters touch more; 0.100
    extent_growth: float = 0.3
    max_extent: int = 10  #: every cluster is shorter than this, in voxels
    scales: int = 2  #: how often the width of voxels is doubled in thin clouds; 0.093
    spacings: float = 1.6  #: spacings of points that a voxel is wide at least
    #: meters that the gap of high noise grows per meter of spacing beyond `dense_m`; 0.083, and 13
    #: times as many good points at 0.3 points/m2
    gap_growth: float = 10.0
    dense_m: float = (
        0.55  #: spacing at some 3 points/m2: in thinner clouds a treetop is a single point
    )
    min_columns: int = 12  #: with points around high noise: below fewer nothing is judged
    aside: int = 3  #: columns around high noise in which nothing is as high
    hanging_m: float = 5.0  #: height above the lowest point of a column from which points hang
    beneath: int = 2  #: empty voxels below a hanging one
    far: int = 20  #: columns within which others of a line are searched: a span of wires
    line_from: int = 2  #: columns: others of a line are farther away than this
    line_step_m: float = 1.0  #: others of a line are at most this much higher or lower
    line_slope: float = 0.3  #: others of a line may be higher or lower by this per meter besides
    line_half: float = 1.0  #: columns from a line to its others
    line_bend_m: float = 2.0  #: heights from a line to its others
    line_place: float = 3.0  #: columns along a line that count as one place
    strung: int = 4  #: places along a line that hold others: a wire; 0.090
    #: share of others on a line, of the suspects near: two wires hang side by side at pylons; 0.089
    strung_share: float = 0.3


RULES = DetachedRules()
#: How far away, in meters, points can change what a point is, the halo a tile needs: what is near,
#: and whether that is of a small cluster, which its component in full and its density tell.
REACH = (low_reach(SIDE) + RULES.far + 2 + RULES.max_extent + 3 * BLOCK + 2) * SIDE


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
    """Find noise: return 7 for points below the ground, 18 for those above everything, else 0.

    Parameters
    ----------
    x, y, z : array_like, shape (n,)
        Coordinates in meters; or `x` alone, of shape (n, 3).
    mask : array_like of bool, shape (n,), optional
        Points to look at; the others are ignored, and get 0.
    cluster : int, default 60
        The most points of a cluster of noise.
    gap : float, default 2.5
        Least height of high noise above everything near, meters.
    depth : float, default 1.0
        Least depth of low noise below the ground, meters.

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
        found_codes = np.zeros(len(x), np.uint8)
        for points, core in patches(column, row, math.ceil(REACH / SIDE), 3 * BLOCK + 2):
            if len(x[points]) > LOW_RULES.min_columns:  # fewer show no surface
                near = x[points], y[points], z[points], column[points], row[points]
                marks = _judge(*near, cluster, gap, depth)
                found_codes[points if isinstance(points, slice) else points[core]] = marks[core]
        codes[inside] = found_codes
    return codes


def _judge(x, y, z, column, row, cluster, gap, depth):
    """Return the codes of points, from one raster around them."""
    # One empty column on every side at least, and whole blocks.
    whole = BLOCK << RULES.scales
    left, bottom = (int(v.min() - 1) // whole * whole for v in (column, row))
    w, h = (
        -(-(int(v.max()) + 2 - start) // whole) * whole
        for v, start in ((column, left), (row, bottom))
    )
    voxels, voxel = Voxels.from_places(row - bottom, column - left, cell_numbers(z, SIDE), w)
    per_column, spacing = density(voxels)
    suspect = small_clusters(voxels, per_column, spacing, cluster)
    place = voxels.keys >> BITS
    lowest, highest = np.full(len(place), np.inf), np.full(len(place), -np.inf)
    np.minimum.at(lowest, voxel, z)
    np.maximum.at(highest, voxel, z)
    top, base, low = np.full(h * w, -np.inf), np.full(h * w, np.inf), np.full(h * w, np.inf)
    np.minimum.at(base, place[~suspect], lowest[~suspect])
    np.maximum.at(top, place[~suspect], highest[~suspect])
    # The highest voxel of a column hangs, with nothing close beneath it, as a wire does.
    begins = np.append(begins_run(place), True)
    hangs = begins[1:] & (begins[:-1] | (np.diff(voxels.keys, prepend=0) > RULES.beneath))
    hangs &= suspect | (highest - base[place] > RULES.hanging_m)
    hung, hung_suspect = np.full(h * w, np.nan), np.zeros(h * w, bool)
    hung[place[hangs]], hung_suspect[place[hangs]] = highest[hangs], suspect[hangs]
    verdict = np.zeros(len(place), np.uint8)
    gaps = gap + RULES.gap_growth * np.maximum(0.0, spacing - RULES.dense_m)
    hanging = hung.reshape(h, w), hung_suspect.reshape(h, w)
    _mark_high(place, lowest, suspect, gaps, top.reshape(h, w), hanging, RULES, verdict)
    suspect &= verdict == 0
    np.minimum.at(low, place[suspect], lowest[suspect])
    limit = limits_below_ground(low.reshape(h, w), base.reshape(h, w), SIDE, depth)
    verdict[suspect & (highest < limit.ravel()[place])] = LOW
    return verdict[voxel]


@dataclass(frozen=True)
class Voxels:
    """Voxels that hold points, by row, column and layer."""

    keys: NDArray[np.int64]  #: (n,) ascending
    counts: NDArray[np.int64]  #: (n,) points in each
    width: int  #: columns of the raster, whose rim is empty

    @classmethod
    def from_places(
        cls, row, column, layer, width: int, counts=None
    ) -> tuple[Voxels, NDArray[np.int64]]:
        """Return the voxels of points, and the index of each one's voxel.

        Instead of points they may be voxels with `counts` points.
        """
        keys, voxel = np.unique(
            ((row * width + column) << BITS) + layer + LAYERS, return_inverse=True
        )
        return cls(keys, np.bincount(voxel, counts).astype(np.int64), width), voxel

    @property
    def places(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Rows, columns and layers (n,)."""
        layer = (self.keys & ((1 << BITS) - 1)) - LAYERS
        return (*np.divmod(self.keys >> BITS, self.width), layer)


def density(voxels: Voxels) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return points per column (n,) and spacing in meters, over 3 x 3 blocks around voxels."""
    row, column, _ = voxels.places
    wide = voxels.width // BLOCK
    block = (row // BLOCK) * wide + column // BLOCK
    size = -(-(int(block.max()) + 1) // wide) * wide
    points = np.bincount(block, voxels.counts, size).astype(np.int64).reshape(-1, wide)
    full = np.bincount(block[begins_run(voxels.keys >> BITS)], minlength=size).reshape(-1, wide)
    points, full, blocks = (_sum_around(v).ravel()[block] for v in (points, full, full > 0))
    return points / full, np.sqrt(blocks * (BLOCK * SIDE) ** 2 / points)


def _sum_around(values: NDArray) -> NDArray[np.int64]:
    """Sum whole numbers (h, w) over the 3 x 3 places around each."""
    (h, w), padded = values.shape, np.pad(values.astype(np.int64), 1)
    return sum((padded[j : j + h, i : i + w] for j in range(3) for i in range(3)), np.int64(0))


def _small(voxels: Voxels, per_column: NDArray[np.float64] | float, most: int) -> NDArray[np.bool_]:
    """Return which voxels (n,) belong to small components.

    `per_column` (n,) is the mean number of points in a column around each voxel.
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
    per_column = np.broadcast_to(per_column, number)[first]
    widest = np.minimum(RULES.extent + RULES.extent_growth * per_column, RULES.max_extent)
    return ((size <= most) & (longest_sides(label, voxels.places, count) < widest))[label]


@njit
def _touching(keys, spans, pairs):
    """Find the voxels whose keys lie in the spans beyond others: return the number of pairs.

    `pairs` (2, n) receives their indices, as far as there is room.
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
    voxels: Voxels, per_column: NDArray[np.float64], spacing: NDArray[np.float64], most: int
) -> NDArray[np.bool_]:
    """Return which voxels (n,) are of clusters of at most `most` points that nothing joins.

    `per_column` and `spacing` (n,) are those of :func:`density`.
    """
    small = _small(voxels, per_column, most)
    row, column, layer = voxels.places
    for scale in range(1, RULES.scales + 1):
        thin = small & (spacing * RULES.spacings > SIDE * 2 ** (scale - 1))
        if not thin.any():
            break
        # With one empty column on every side.
        width = (voxels.width >> scale) + 2
        wider, index = Voxels.from_places(
            (row >> scale) + 1, (column >> scale) + 1, layer, width, voxels.counts
        )
        small[thin] = _small(wider, 1.0, most)[index[thin]]
    return small


@njit
def _mark_high(place, lowest, suspect, gaps, top, hanging, rules, verdict):
    """Mark the suspects that lie above everything near, and are not part of a line.

    `gaps` (n,) are their least distances to other voxels, in meters.
    """
    h, w = top.shape
    near = np.empty((3, (2 * rules.far + 1) ** 2))
    for k in range(len(place)):
        if not suspect[k]:
            continue
        j, i = place[k] // w, place[k] % w
        r = rules.aside
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
        alone = seen >= rules.min_columns and lowest[k] - highest >= gaps[k]
        if alone and not _in_line(hanging, j, i, lowest[k], near, rules):
            verdict[k] = HIGH


@device
def _in_line(hanging, j, i, z, near, rules):
    """Tell whether hanging voxels, as of wires, are strung along a line through a place.

    `hanging` are the heights (h, w) of hanging voxels, and which are suspects; `near` (3, m) is
    working memory.
    """
    (hung, hung_suspect), (u, v, dz) = hanging, near
    h, w = hung.shape
    n = suspects = 0
    for b in range(max(j - rules.far, 0), min(j + rules.far + 1, h)):
        for a in range(max(i - rules.far, 0), min(i + rules.far + 1, w)):
            square = (b - j) ** 2 + (a - i) ** 2
            if not rules.line_from * rules.line_from < square <= rules.far * rules.far:
                continue
            most = rules.line_step_m + rules.line_slope * SIDE * np.sqrt(square)
            if abs(hung[b, a] - z) <= most:
                u[n], v[n], dz[n] = a - i, b - j, hung[b, a] - z
                n += 1
                suspects += hung_suspect[b, a]
    for a in range(n):
        far = np.sqrt(u[a] * u[a] + v[a] * v[a])
        along, places = 0, 0
        for b in range(n):
            part = (u[a] * u[b] + v[a] * v[b]) / far
            aside = abs(u[a] * v[b] - v[a] * u[b]) / far
            bend = abs(dz[b] - part / far * dz[a])
            if aside <= rules.line_half and bend <= rules.line_bend_m:
                along += 1
                places |= 1 << int((part + rules.far) / rules.line_place)
        number = 0
        while places > 0:
            number += places & 1
            places >>= 1
        if number >= rules.strung and along > rules.strung_share * suspects:
            return True
    return False
