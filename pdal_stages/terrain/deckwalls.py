"""Roads on banks between upright walls, such as the ramps before a bridge, and dams: walls show where a deck has air.

Beams come aslant: below the rim of a deck they reach the ground and nothing between, below that of a wall its face.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..base.jit import device, njit
from .walkable import DOWN, DROP, RIGHT, ROUGH, UP

#: Deeper than so many meters below the rim, and so many above the ground, lies what is neither deck nor ground; a drop is
#: tall enough to show it from so many meters on. The ground is looked for so many cells ahead, faces so many.
_UNDER, _OVER, _TALL, _GROUND, _FACE = 2.5, 1.0, 4.5, 4, 2
#: Half the side of the square whose drops say whether there are walls, and of the one that says where they end, in cells;
#: how many tall ones there must be.
WINDOW, _CLOSE, _MANY, _FEW = 20, 8, 60, 10
#: Where walls are, so many of tall drops at least have a face below, and so many of all drops at most show the ground below
#: the deck; and near such places. So many cells from there, rims too low for faces are walls' where so few show the ground.
_SURE, _NEAR, LOW, _OPEN_LOW = (0.45, 0.25), (0.35, 0.35), 64, 0.45


@device
def _drop(z, start, h, w, kind, deck, j, i, n, d):
    """Of a level's drop in a direction: whether it is one of a deck and not of a truck on it; whether the ground shows below
    the level and nothing between, whether something rough lies between, and whether the drop is tall.
    """
    low = 0.0
    for s in range(_GROUND + 1):
        b, a = j + s * UP[d], i + s * RIGHT[d]
        if b < 0 or a < 0 or b >= h or a >= w:
            break
        for m in range(start[b * w + a], start[b * w + a + 1]):
            if deck[m] and z[m] < z[n] - _OVER:
                return False, False, False, False
            if s > 0:
                low = min(low, z[m] - z[n])
    face = False
    shown = z[start[j * w + i]] < z[n] - DROP and z[start[j * w + i]] - z[n] < low + _OVER
    for s in range(_FACE + 1):
        b, a = j + s * UP[d], i + s * RIGHT[d]
        if b < 0 or a < 0 or b >= h or a >= w:
            break
        for m in range(start[b * w + a], start[b * w + a + 1]):
            if low + _OVER < z[m] - z[n] < -_UNDER:
                face |= kind[m] == ROUGH  # no bank
                shown &= s > 0
    return True, shown, face, low < -_TALL


@njit
def _drops(z, start, h, w, kind, end, deck, box):
    """Of the decks' drops straight ahead, by cell of a box (first row, last, first column, last; 4): how many there are, how
    many show the ground below, how many have something between, how many are tall.
    """
    out = np.zeros((box[1] - box[0] + 1, box[3] - box[2] + 1, 4), np.int32)
    for j in range(box[0], box[1] + 1):
        for i in range(box[2], box[3] + 1):
            own = out[j - box[0], i - box[2]]
            for n in range(start[j * w + i], start[j * w + i + 1]):
                if not deck[n]:
                    continue
                for d in range(0, 8, 2):
                    if end[n, d] == DOWN:
                        counts, shown, face, tall = _drop(z, start, h, w, kind, deck, j, i, n, d)
                        own[0] += counts
                        own[1] += shown
                        own[2] += face
                        own[3] += tall
    return out


def around(values: NDArray[np.int32], reach: int) -> NDArray[np.int32]:
    """Sums over squares of cells (h, w, ...) that go `reach` cells to all sides."""
    for axis in (0, 1):
        length = values.shape[axis]
        total = np.cumsum(values, axis=axis, dtype=np.int32)
        total = np.concatenate([np.zeros_like(np.take(total, [0], axis)), total], axis=axis)
        at = np.arange(length)
        high, low = np.minimum(at + reach + 1, length), np.maximum(at - reach, 0)
        values = np.take(total, high, axis) - np.take(total, low, axis)
    return values


def _are_walls(near, least, faced, open_):
    """Of each cell (h, w), whether walls are below the rims `near` it, and whether there is enough to say so."""
    count, shown, faces, tall = near
    enough = tall >= least
    return enough & (faces >= faced * tall) & (shown <= open_ * count), enough


def without_walls(raster, deck) -> NDArray[np.bool_]:
    """The decks (n,) but for what stands on walls, and their low ends."""
    z, start, h, w, kind, end = raster
    row, column = np.divmod(np.repeat(np.arange(h * w, dtype=np.int32), np.diff(start))[deck], np.int32(w))
    box = np.array([row.min(), row.max(), column.min(), column.max()])
    drops = _drops(z, start, h, w, kind, end, deck, box)
    near = np.moveaxis(around(drops, WINDOW), -1, 0)
    walls, _ = _are_walls(near, _MANY, *_SURE)
    if not walls.any():
        return deck
    close, enough = _are_walls(np.moveaxis(around(drops, _CLOSE), -1, 0), _FEW, *_NEAR)
    walls = np.where(enough, close & (around(walls.astype(np.int32), WINDOW) > 0), walls)
    count, shown, _, tall = near
    low = (count >= _FEW) & (2 * tall < count) & (shown <= _OPEN_LOW * count)
    walls |= low & (around(walls.astype(np.int32), LOW) > 0)
    out = deck.copy()
    out[deck] = ~walls[row - box[0], column - box[2]]
    return out
