"""Cut points into pieces whose rasters are small wherever points lie.

Pieces are groups far apart, and squares with surroundings.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator

import numpy as np
from numpy.typing import NDArray

from ..base.errors import StageError
from ..base.grid import GridWindow, cell_keys, group_by_key, key_offset, places_among
from ..base.las_check import CURE_OF_DAMAGE
from .components import number_sets

#: Cells of the largest raster that is made in one piece: it bounds memory. Neither this nor the
#: numbers below are tuned: results do not depend on them.
LARGEST_RASTER = 2100 * 2100
#: Side in cells of the squares that larger rasters are cut into; it need not equal `BLOCK_SIDE`.
SQUARE_SIDE = 1024
#: Rasters up to this size are never searched for empty land, in cells.
SMALL_RASTER = 1 << 16
#: Nor are larger ones with at most this many cells more per point.
MAX_CELLS_PER_POINT = 32
#: Blocks of the coarse grid that finds groups, per `link`.
BLOCKS_PER_LINK = 4
#: Places with a single point beyond which a cloud is refused, if most places have one.
MAX_ALONE = 4000


def patches(
    column: NDArray[np.int64], row: NDArray[np.int64], reach: int, link: int, largest: int = 0
) -> Iterator[tuple[NDArray[np.int64] | slice, NDArray[np.bool_] | slice]]:
    """Yield the points of a piece with those around that matter, and which belong to the piece.

    Both are indices or masks, or a slice for all points.

    Every point belongs to one piece. Points more than `reach` cells away, along either axis, do not
    matter; nor do points that no chain of others connects with steps of at most `link` cells. One
    piece, all points, where the whole has no more than the `largest` number of cells, or
    `LARGEST_RASTER`.
    """
    window = GridWindow.enclosing(column, row)
    largest = max(LARGEST_RASTER, largest)
    if window.width * window.height <= min(
        largest, SMALL_RASTER + MAX_CELLS_PER_POINT * len(column)
    ):
        yield slice(None), slice(None)
        return
    groups = _groups(column, row, link)
    refuse_scattered([len(group) for group in groups])
    for group in groups:
        c, r = column[group], row[group]
        window = GridWindow.enclosing(c, r)
        if window.width * window.height <= largest:
            yield group, slice(None)
            continue
        for members in group_by_key(cell_keys(c // SQUARE_SIDE, r // SQUARE_SIDE)):
            inside = GridWindow.enclosing(c[members], r[members]).padded(reach).contains(c, r)
            near, core = np.flatnonzero(inside), np.zeros(len(c), bool)
            core[members] = True
            for part in _groups(c[near], r[near], link):
                if core[near[part]].any():
                    yield group[near[part]], core[near[part]]


def refuse_scattered(counts: Collection[int]) -> None:
    """Refuse points that are alone in most of their places: each costs milliseconds for nothing.

    `counts` are the points of each place.
    """
    alone = sum(n == 1 for n in counts)
    if alone > MAX_ALONE and 2 * alone > len(counts):
        raise StageError(
            "thousands of points lie alone, far from any other",
            found=f"{alone:,} of {sum(counts):,} points",
            cure="Look whether the file's scale and unit are right: pdal info --summary FILE. "
            f"{CURE_OF_DAMAGE}",
        )


def _groups(
    column: NDArray[np.int64], row: NDArray[np.int64], link: int
) -> list[NDArray[np.int64]]:
    """Group points: all within `link` cells of each other, and few a little farther apart."""
    side = -(-link // BLOCKS_PER_LINK)
    rings = -(-link // side)
    blocks, block = np.unique(cell_keys(column // side, row // side), return_inverse=True)
    pairs = []
    for b in range(rings + 1):
        for a in range(-rings if b else 1, rings + 1):
            at, there = places_among(blocks, blocks + key_offset(a, b))
            pairs.append([np.flatnonzero(there), at[there]])
    label = np.empty(len(blocks), np.int64)
    number_sets(*np.concatenate(pairs, axis=1), label)
    return group_by_key(label[block])
