"""Small clusters of points that nothing joins to the rest: by components of voxels, on an absolute grid.

Voxels with points that touch, by a corner at least, are of one component, and one of few points and little extent is
a small cluster. In dense clouds, voxels with next to no points do not join others: they are clusters of their own,
unless they touch a large component. In thin clouds, voxels are widened until they hold several spacings of points.
All is counted in whole numbers, so neither the order of points nor the tile matters.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import begins_run
from .linked import longest_sides, number_sets, sums_around

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


class Voxels(NamedTuple):
    """Voxels that hold points, by row, column and level."""

    keys: NDArray[np.int64]  #: (n,) ascending
    counts: NDArray[np.int64]  #: (n,) points in each
    width: int  #: columns of the raster, whose rim is empty

    @classmethod
    def of(cls, row, column, level, width: int, counts=None) -> tuple[Voxels, NDArray[np.int64]]:
        """Voxels of points, or of others with `counts` of them; and the number of each one's voxel."""
        keys, voxel = np.unique(((row * width + column) << BITS) + level + LEVELS, return_inverse=True)
        return cls(keys, np.bincount(voxel, counts).astype(np.int64), width), voxel

    @property
    def places(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Rows, columns and levels."""
        return (*np.divmod(self.keys >> BITS, self.width), (self.keys & ((1 << BITS) - 1)) - LEVELS)


def surroundings(voxels: Voxels) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Around each voxel the usual number of points in a column, and their spacing in meters, over 3 x 3 blocks."""
    row, column, _ = voxels.places
    wide = voxels.width // BLOCK
    block = (row // BLOCK) * wide + column // BLOCK
    size = -(-(int(block.max()) + 1) // wide) * wide
    points = np.bincount(block, voxels.counts, size).astype(np.int64).reshape(-1, wide)
    full = np.bincount(block[begins_run(voxels.keys >> BITS)], minlength=size).reshape(-1, wide)
    points, full, blocks = (sums_around(v, 1).ravel()[block] for v in (points, full, full > 0))
    return points / full, np.sqrt(blocks * (BLOCK * SIDE) ** 2 / points)


def _small(voxels: Voxels, usual: NDArray[np.float64], most: int) -> tuple[NDArray[np.bool_], NDArray]:
    """Voxels of small components, and weak ones that no large component touches; points of each one's component."""
    keys, number = voxels.keys, len(voxels.keys)
    strong = voxels.counts > (WEAK * usual).astype(np.int64)
    pairs = []
    for dj, di, dl in list(product((-1, 0, 1), repeat=3))[14:]:  # those ahead
        wanted = keys + ((dj * voxels.width + di) << BITS) + dl
        at = np.minimum(np.searchsorted(keys, wanted), number - 1)
        touching = np.flatnonzero(keys[at] == wanted)
        pairs.append([touching, at[touching]])
    one, other = np.concatenate(pairs, axis=1)
    both = strong[one] & strong[other]
    label = np.empty(number, np.int64)
    count = number_sets(one[both], other[both], label)
    size = np.bincount(label, voxels.counts).astype(np.int64)
    first = np.empty(count, np.int64)
    first[label[::-1]] = np.arange(number)[::-1]  # a component's first voxel stands for it
    widest = np.minimum(EXTENT + EXTENT_GROWTH * usual[first], LARGEST_EXTENT)
    small = ((size <= most) & (longest_sides(label, voxels.places, count) < widest))[label]
    large = strong & ~small
    small[~strong] = True
    for weak, beside in ((one, other), (other, one)):
        small[weak[~strong[weak] & large[beside]]] = False
    return small, size[label]


def small_clusters(
    voxels: Voxels, usual: NDArray[np.float64], spacing: NDArray[np.float64], most: int
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Which voxels are of clusters of at most `most` points that nothing joins to the rest, and points of each one's.

    `usual` and `spacing` are what :func:`surroundings` says.
    """
    small, size = _small(voxels, usual, most)
    row, column, level = voxels.places
    for scale in range(1, SCALES + 1):
        thin = small & (spacing * SPACINGS > SIDE * 2 ** (scale - 1))
        if not thin.any():
            break
        # With one empty column on every side.
        width = (voxels.width >> scale) + 2
        wider, of = Voxels.of((row >> scale) + 1, (column >> scale) + 1, level, width, voxels.counts)
        still, total = _small(wider, np.ones(len(wider.keys)), most)
        small[thin], size[thin] = still[of[thin]], total[of[thin]]
    return small, size
