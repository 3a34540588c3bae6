"""Small clusters of points that nothing joins to the rest: by components of voxels, on an absolute grid.

Voxels with points that touch, by a corner at least, are of one component, and one of few points and little extent is
a small cluster. In dense clouds, voxels with next to no points do not join others: they are clusters of their own,
unless they touch a large component. In thin clouds, voxels are widened until they hold several spacings of points.
All is counted in whole numbers, so neither the order of points nor the tile matters.
"""

from __future__ import annotations

import numpy as np

from ..base.jit import device, njit
from ..base.unionfind import root as root_of

#: Side of a voxel, meters.
SIDE = 1.5
#: The greatest extent of a cluster in voxels: it grows with the points in a column, as clusters touch where they are many.
EXTENT, EXTENT_GROWTH, LARGEST_EXTENT = 3, 0.3, 10
#: Columns along the side of a block in which the density is measured.
BLOCK = 8
#: Voxels with fewer points than this share of those in a column of the surroundings join nothing.
WEAK = 0.02
#: Voxels are doubled in width so often, until that is so many spacings of points.
SCALES, SPACINGS = 2, 1.6
#: Levels of voxels above and below 0, and their bits in a key.
LEVELS, BITS = 1 << 21, 22
#: How far away, in meters, points can decide whether a point is of a small cluster: a component in full and its density.
CLUSTER_REACH = (LARGEST_EXTENT + 3 * BLOCK + 2) * SIDE


@device
def _slot(table, keys, key):
    """Where a key is in the table of voxel numbers, or the empty place for it."""
    mask = np.uint64(len(table) - 1)
    at = (np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(20)
    at &= mask
    while table[at] >= 0 and keys[table[at]] != key:
        at = (at + np.uint64(1)) & mask
    return at


@device
def find(table, keys, key):
    return table[_slot(table, keys, key)]


@njit
def voxels(column, row, level, left, bottom, w):
    """Number of each point's voxel, voxels' keys and counts, and the table that finds them."""
    size = 1 << 12
    table = np.full(size, -1, np.int32)
    keys, counts = np.empty(size, np.int64), np.zeros(size, np.int32)
    voxel = np.empty(len(column), np.int32)
    n, last, before = 0, -1, np.int64(-1)
    for p in range(len(column)):
        key = (((row[p] - bottom) * w + (column[p] - left)) << BITS) + (level[p] + LEVELS)
        if key != before or last < 0:
            at = _slot(table, keys, key)
            last = table[at]
            if last < 0:
                if 2 * n >= size:
                    size *= 4
                    more, number = np.empty(size, np.int64), np.zeros(size, np.int32)
                    more[:n], number[:n] = keys[:n], counts[:n]
                    keys, counts = more, number
                    table = np.full(size, -1, np.int32)
                    for k in range(n):
                        table[_slot(table, keys, keys[k])] = k
                    at = _slot(table, keys, key)
                last = n
                keys[n] = key
                table[at] = n
                n += 1
            before = key
        counts[last] += 1
        voxel[p] = last
    return voxel, keys[:n].copy(), counts[:n].copy(), table


@njit
def surroundings(keys, counts, w, h):
    """For each block: the usual number of points in a column, and the spacing of points in meters (over 3 x 3 blocks)."""
    bh, bw = h // BLOCK, w // BLOCK
    points, full = np.zeros((bh, bw), np.int64), np.zeros((bh, bw), np.int64)
    seen = np.zeros((h, w), np.bool_)
    for k in range(len(keys)):
        place = keys[k] >> BITS
        j, i = place // w, place % w
        points[j // BLOCK, i // BLOCK] += counts[k]
        if not seen[j, i]:
            seen[j, i] = True
            full[j // BLOCK, i // BLOCK] += 1
    usual, spacing = np.ones((bh, bw)), np.full((bh, bw), 10.0)
    for j in range(bh):
        for i in range(bw):
            n, c, blocks = 0, 0, 0
            for b in range(max(j - 1, 0), min(j + 2, bh)):
                for a in range(max(i - 1, 0), min(i + 2, bw)):
                    n += points[b, a]
                    c += full[b, a]
                    blocks += full[b, a] > 0
            if n > 0:
                usual[j, i] = n / c
                spacing[j, i] = np.sqrt(blocks * (BLOCK * SIDE) ** 2 / n)
    return usual, spacing


@njit
def _small(keys, counts, table, usual, w, most):
    """Voxels of small components, and weak ones that no large component touches."""
    n = len(keys)
    strong = np.empty(n, np.bool_)
    parent = np.arange(n).astype(np.int32)
    for k in range(n):
        place = keys[k] >> BITS
        strong[k] = counts[k] > int(WEAK * usual[place // w // BLOCK, place % w // BLOCK])
    step = np.empty(13, np.int64)
    m = 0
    for dj in range(-1, 2):
        for di in range(-1, 2):
            for dl in range(-1, 2):
                if dj * 9 + di * 3 + dl > 0:
                    step[m] = ((dj * w + di) << BITS) + dl
                    m += 1
    for k in range(n):
        if strong[k]:
            for s in range(13):
                q = find(table, keys, keys[k] + step[s])
                if q >= 0 and strong[q]:
                    a, b = root_of(parent, k), root_of(parent, q)
                    if keys[a] < keys[b]:  # so that a component's first voxel stands for it
                        parent[b] = a
                    else:
                        parent[a] = b
    total = np.zeros(n, np.int64)
    box = np.empty((n, 6), np.int32)
    for k in range(n):
        r = root_of(parent, k)
        place, level = keys[k] >> BITS, keys[k] & (2 * LEVELS - 1)
        j, i = place // w, place % w
        if total[r] == 0:
            box[r, 0] = box[r, 1] = j
            box[r, 2] = box[r, 3] = i
            box[r, 4] = box[r, 5] = level
        total[r] += counts[k]
        box[r, 0], box[r, 1] = min(box[r, 0], j), max(box[r, 1], j)
        box[r, 2], box[r, 3] = min(box[r, 2], i), max(box[r, 3], i)
        box[r, 4], box[r, 5] = min(box[r, 4], level), max(box[r, 5], level)
    small = np.empty(n, np.bool_)
    size = counts.astype(np.int64)
    for k in range(n):
        if strong[k]:
            r = root_of(parent, k)
            extent = max(box[r, 1] - box[r, 0], box[r, 3] - box[r, 2], box[r, 5] - box[r, 4])
            place = keys[r] >> BITS
            widest = EXTENT + EXTENT_GROWTH * usual[place // w // BLOCK, place % w // BLOCK]
            small[k] = total[r] <= most and extent < min(widest, LARGEST_EXTENT)
            size[k] = total[r]
    for k in range(n):
        if not strong[k]:
            small[k] = True
            for s in range(26):
                q = find(table, keys, keys[k] + (step[s] if s < 13 else -step[s - 13]))
                if q >= 0 and strong[q] and not small[q]:
                    small[k] = False
                    break
    return small, size


def small_clusters(keys, counts, table, usual, spacing, w, h, most):
    """Which voxels are of clusters of at most `most` points that nothing joins to the rest, and points of each one's.

    The voxels, as :func:`voxels` gives them, are on a raster of `h` rows and `w` columns; `usual` and `spacing` are
    what :func:`surroundings` says.
    """
    small, size = _small(keys, counts, table, usual, w, most)
    row, column = np.divmod(keys >> BITS, w)
    level = (keys & ((1 << BITS) - 1)) - LEVELS
    apart = spacing[row // BLOCK, column // BLOCK]
    for scale in range(1, SCALES + 1):
        thin = small & (apart * SPACINGS > SIDE * 2 ** (scale - 1))
        if not thin.any():
            break
        width = (w >> scale) + 2  # with one empty column on every side
        voxel, wider, _, table = voxels((column >> scale) + 1, (row >> scale) + 1, level, 0, 0, width)
        number = np.bincount(voxel, counts).astype(np.int64)
        alike = np.ones(((h >> scale) // BLOCK + 1, width // BLOCK + 1))
        still, total = _small(wider, number, table, alike, width, most)
        small[thin], size[thin] = still[voxel[thin]], total[voxel[thin]]
    return small, size
