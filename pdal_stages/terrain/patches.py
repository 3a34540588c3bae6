"""Points cut into squares of cells with their surroundings, so that rasters stay small wherever points lie."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

#: The largest raster that is made in one piece, in cells; else squares of this side plus the reach.
LARGEST, SIDE = 2048 * 2048, 1024


def patches(
    column: NDArray[np.int64], row: NDArray[np.int64], reach: int
) -> Iterator[tuple[NDArray[np.int64] | slice, NDArray[np.bool_] | slice]]:
    """Yield (points, own): the points of a square and of `reach` cells round it, and which of them are its own.

    Every point is some square's own. One piece, all points, where the whole is small enough.
    """
    spans = [int(v.max()) - int(v.min()) + 1 for v in (column, row)]
    if spans[0] * spans[1] <= LARGEST:
        yield slice(None), slice(None)
        return
    across, along = column // SIDE, row // SIDE
    across, along = across - across.min() + 1, along - along.min() + 1
    stride = int(across.max()) + 2
    key = along * stride + across
    order = np.argsort(key, kind="stable")
    keys, starts = np.unique(key[order], return_index=True)
    ends = np.append(starts[1:], len(key))
    rings = -(-reach // SIDE)
    for at, number in enumerate(keys):
        own = order[starts[at] : ends[at]]
        left, bottom = column[own[0]] // SIDE * SIDE, row[own[0]] // SIDE * SIDE
        near = [own]
        for b in range(-rings, rings + 1):
            low, high = np.searchsorted(keys, [number + b * stride - rings, number + b * stride + rings + 1])
            for k in range(low, high):
                if k != at:
                    these = order[starts[k] : ends[k]]
                    c, r = column[these] - left, row[these] - bottom
                    inside = (np.minimum(c, r) >= -reach) & (np.maximum(c, r) < SIDE + reach)
                    near.append(these[inside])
        mine = np.zeros(sum(map(len, near)), bool)
        mine[: len(own)] = True
        yield np.concatenate(near), mine
