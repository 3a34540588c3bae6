"""Decks too long to be judged as a whole: stretch by stretch, in blocks of an absolute grid."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.jit import njit
from .deckrims import (
    LINK,
    LINK_THROUGH,
    OUTWARD,
    THROUGH,
    WALLS,
    goes_on,
    is_land,
    leads_on,
    no_ends,
    spread,
    step_on,
)
from .walkable import ACROSS, DOWN, DROP, NOTHING, WALLED

#: Blocks in which long decks are judged, cells, and how many blocks away land must be seen at an end.
BLOCK, FAR_ENDS = 64, 3
#: So many cells are at a drop near what is wider than one sees; there, for each way that ends at nothing, so many end at
#: something else, as lamps, cars and the deck itself are before what lies askew.
LONG_RIM, OVER_NOTHING = 100, 1.0


def stretches(z, start, h, w, kind, end, long, left, bottom) -> NDArray[np.bool_]:
    """Levels (n,) of long parts whose rim, in the 3 x 3 blocks around, is drops, and that end at land near."""
    if not long.any():
        return long
    number = np.where(long, 0, -1)
    low_a, low_b = left // BLOCK - 1, bottom // BLOCK - 1
    shape = (bottom + h) // BLOCK + 2 - low_b, (left + w) // BLOCK + 2 - low_a
    sums, block = np.zeros((*shape, 9), np.int64), np.full((len(z), 2), -1, np.int64)
    leads = np.zeros(len(z), np.int8)
    _count_blocks(z, start, h, w, kind, end, number, left, bottom, low_a, low_b, sums, block, leads)
    clear = (sums[..., 6] >= THROUGH * sums[..., 7]) & (sums[..., 7] > 0)
    link = np.where(clear, LINK_THROUGH, LINK)
    leading = (leads > 0) & (leads <= link[block[:, 0], block[:, 1]])
    near = _around(sums, 1)
    # Over nothing, such as a wide river, drops are seen farther away.
    far = _around(sums, FAR_ENDS)[..., 2] >= LONG_RIM
    ways, cells = near[..., 0] + far * near[..., 4], near[..., 2] + far * near[..., 5]
    walls = np.where(far & (near[..., 4] > near[..., 0]), OVER_NOTHING, WALLS)
    good = (ways > 0) & (near[..., 1] <= walls * ways) & (near[..., 3] <= OUTWARD * cells)
    ends_here = np.zeros(shape, np.int64)
    land, seen = np.empty((len(z), 3), np.int64), np.full(len(z), -1, np.int64)
    for stamp, (b, a) in enumerate(np.argwhere((sums[..., 3] > 0) | (clear & (sums[..., 8] > 0)))):
        over = no_ends()
        own = leading & (block[:, 0] == b) & (block[:, 1] == a)
        low = max((b + low_b) * BLOCK - bottom, 0), max((a + low_a) * BLOCK - left, 0)
        cells = _land_of_block(z, start, h, w, kind, number, own, *low, land, seen, stamp, link[b, a])
        cells = spread(z, start, h, w, kind, end, number, land, seen, stamp, cells, over)
        ends_here[b, a] = is_land(cells, over, bool(clear[b, a]))
    good &= (_around(ends_here[..., None], FAR_ENDS)[..., 0] > 0) | _passed(sums[..., 2] + sums[..., 5] > 0)
    return long & good[block[:, 0], block[:, 1]]


def _passed(there: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Blocks beyond which a part goes on as far as one looks, to both sides: no roof is that long."""
    far = FAR_ENDS
    out = np.zeros_like(there)
    padded = np.pad(there, far)
    for b, a in np.argwhere(there):
        window = padded[b : b + 2 * far + 1, a : a + 2 * far + 1]
        across, along = window[:, [0, -1]].any(axis=0), window[[0, -1]].any(axis=1)
        out[b, a] = np.all(across) or np.all(along)
    return out


def _around(values: NDArray[np.int64], reach: int) -> NDArray[Any]:
    """Sums over (2 reach + 1) x (2 reach + 1) blocks."""
    h, w = values.shape[:2]
    padded = np.pad(values, ((reach, reach), (reach, reach), (0, 0)))
    steps = range(2 * reach + 1)
    return sum((padded[b : b + h, a : a + w] for b in steps for a in steps), np.zeros_like(values))


@njit
def _count_blocks(z, start, h, w, kind, end, number, left, bottom, low_a, low_b, sums, block, leads):
    """Of each block: ways that end at a drop, and at something else; cells at a drop, and cells that lead on; ways that
    end at nothing, and cells at nothing but no drop; of those at no drop, cells that show what lies below, and all; cells
    that lead on across more.
    """
    for j in range(h):
        for i in range(w):
            for n in range(start[j * w + i], start[j * w + i + 1]):
                if number[n] < 0:
                    continue
                block[n, 0], block[n, 1] = (j + bottom) // BLOCK - low_b, (i + left) // BLOCK - low_a
                own = sums[block[n, 0], block[n, 1]]
                drop = nothing = False
                for d in range(8):
                    if end[n, d] == DOWN or end[n, d] == ACROSS:
                        own[0] += 1
                        drop = True
                    elif end[n, d] == WALLED and not goes_on(start, h, w, number, j, i, n, d):
                        own[1] += 1
                    elif end[n, d] == NOTHING:
                        own[4] += 1
                        nothing = True
                own[2] += drop
                own[5] += nothing and not drop
                if not drop:
                    own[6] += z[start[j * w + i]] < z[n] - DROP
                    own[7] += 1
                if leads_on(z, start, h, w, kind, number, j, i, n, LINK):
                    leads[n] = LINK
                    own[3] += 1
                elif leads_on(z, start, h, w, kind, number, j, i, n, LINK_THROUGH):
                    leads[n] = LINK_THROUGH
                    own[8] += 1


@njit
def _land_of_block(z, start, h, w, kind, number, own, low_j, low_i, land, seen, stamp, link):
    """What the cells `own` of a block lead on to, as :func:`first_land` has it."""
    length = 0
    for j in range(low_j, min(low_j + BLOCK, h)):
        for i in range(low_i, min(low_i + BLOCK, w)):
            for n in range(start[j * w + i], start[j * w + i + 1]):
                if own[n]:
                    length = step_on(z, start, h, w, kind, number, j, i, n, land, seen, stamp, length, link)
    return length
