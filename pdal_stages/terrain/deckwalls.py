"""Walls below what may be a bridge deck: of ramps, dams and roofs.

Beams come aslant: below the rim of a deck they reach the ground and nothing between, below that of a wall its face.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..base.jit import njit
from .cells import sums_around
from .walkable import DOWN, DROP, RIGHT, ROUGH, UP

#: Deeper than so many meters below the rim, and so many above the ground, lies what is neither deck nor ground; a drop is
#: tall enough to show it from so many meters on. The ground is looked for so many cells ahead, faces so many.
_UNDER, _OVER, _TALL, _GROUND, _FACE = 2.5, 1.0, 4.5, 4, 2
#: Walls are where, in squares that go so many cells to all sides, so many drops are tall, such a share of these have a face
#: below, and at most such a share of all show the ground below the deck.
WINDOW, WALL_RIM, FACED, SHOWN = 10, 10, 0.4, 0.35
#: So many cells from there, rims too low for faces are walls' where so few show the ground.
LOW, SHOWN_LOW = 64, 0.45
#: How far away cells matter.
REACH = 2 * WINDOW + LOW + _GROUND


def without_walls(z, start, h, w, kind, end, deck) -> NDArray[np.bool_]:
    """The levels (n,) of decks but for those near rims below which walls are seen."""
    if not deck.any():
        return deck
    drops = _drops(z, start, h, w, kind, end, deck)
    count, shown, faces, tall = np.moveaxis(sums_around(drops, WINDOW), -1, 0)
    walls = (tall >= WALL_RIM) & (faces >= FACED * tall) & (shown <= SHOWN * count)
    low = (count >= WALL_RIM) & (2 * tall < count) & (shown <= SHOWN_LOW * count)
    walls |= low & (sums_around(walls, LOW) > 0)
    return deck & ~np.repeat(walls.ravel(), np.diff(start))


@njit
def _drops(z, start, h, w, kind, end, deck):
    """Of the decks' drops straight ahead, but for those of trucks on them, by cell (h, w, 4): how many there are, how many
    show the ground below, how many have something rough between, how many are tall."""
    out = np.zeros((h, w, 4), np.int32)
    for k in range(h * w):
        for n in range(start[k], start[k + 1]):
            for d in range(0, 8, 2):
                if not deck[n] or end[n, d] != DOWN:
                    continue
                low, face, shown, truck = 0.0, False, False, False
                for turn in range(2):
                    for s in range(_FACE + 1 if turn else _GROUND + 1):
                        b, a = k // w + s * UP[d], k % w + s * RIGHT[d]
                        if b < 0 or a < 0 or b >= h or a >= w:
                            break
                        for m in range(start[b * w + a], start[b * w + a + 1]):
                            deep = z[m] - z[n]
                            if turn == 0:
                                truck |= deck[m] and deep < -_OVER
                                low = min(low, deep) if s > 0 else low
                            elif low + _OVER < deep < -_UNDER:
                                face |= kind[m] == ROUGH  # no bank
                                shown &= s > 0
                    if turn == 0:
                        under = z[start[k]] - z[n]
                        shown = under < -DROP and under < low + _OVER
                if not truck:
                    own = out[k // w, k % w]
                    own[0] += 1
                    own[1] += shown
                    own[2] += face
                    own[3] += low < -_TALL
    return out
