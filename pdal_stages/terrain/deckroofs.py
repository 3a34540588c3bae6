"""Roofs beside a deck, as high as it is: they hang on across a gap that crowns or walls fill, and lead nowhere."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..base.jit import njit
from .deckparts import LONGEST, amid, extent, parts
from .deckrims import (
    JOIN,
    SECTORS,
    SMALLEST,
    first_land,
    is_land,
    no_ends,
    opposite_ends,
    rims,
    sector_of,
    spread,
)
from .walkable import ENDLESS, distance, walkable

#: Parts of a deck more than so many cells apart stand apart; cores are in the midst of so many of 3 x 3 cells; of the length
#: of all that hangs together so much is the deck's; the longest that is a roof, in meters, and how much of what lies beside
#: it must lie in one direction.
APART, MIDST, SPANS, ROOF, ONE_SIDE = 2, 7, 0.75, 100, 0.3
#: How far from cores, in squared cells, what hangs on to them is deck where a roof was beside it.
NEXT = 2


@njit
def _contacts(z, start, h, w, number, sums, main):
    """Of each core, by sector: cells near one that is a `main` one (n, SECTORS)."""
    out = np.zeros((len(sums), SECTORS), np.int64)
    reach = JOIN + 2
    for j in range(h):
        for i in range(w):
            for n in range(start[j * w + i], start[j * w + i + 1]):
                k = number[n]
                if k < 0 or main[k]:
                    continue
                beside = False
                for b in range(max(j - reach, 0), min(j + reach + 1, h)):
                    for a in range(max(i - reach, 0), min(i + reach + 1, w)):
                        for m in range(start[b * w + a], start[b * w + a + 1]):
                            if (
                                number[m] >= 0
                                and main[number[m]]
                                and walkable(z[m] - z[n], distance(a - i, b - j))
                            ):
                                beside = True
                out[k, sector_of(j, i, sums[k])] += beside
    return out


@njit
def _regrown(z, start, h, w, deck, number, roof, most):
    """The decks, but for the roofs among their cores, what is nearer to one of these than to another core, and what is more
    than `most` squared cells from any core.
    """
    out = deck.copy()
    for j in range(h):
        for i in range(w):
            for n in range(start[j * w + i], start[j * w + i + 1]):
                if not deck[n]:
                    continue
                if number[n] >= 0:
                    out[n] = not roof[number[n]]
                    continue
                nearest, own = 2 * (JOIN + 1) ** 2, True
                for b in range(max(j - JOIN, 0), min(j + JOIN + 1, h)):
                    for a in range(max(i - JOIN, 0), min(i + JOIN + 1, w)):
                        squared = (a - i) ** 2 + (b - j) ** 2
                        for m in range(start[b * w + a], start[b * w + a + 1]):
                            if number[m] < 0 or not walkable(z[m] - z[n], distance(a - i, b - j)):
                                continue
                            if squared < nearest or (squared == nearest and not roof[number[m]]):
                                nearest, own = squared, not roof[number[m]]
                out[n] = own and nearest <= most
    return out


def without_roofs(raster, deck) -> NDArray[np.bool_]:
    """The decks but for what hangs on at their side and leads on to no land: roofs as high as they are.

    They stand apart, or a seam parts them from a deck that goes on from end to end without them.
    """
    z, start, h, w = raster[:4]
    for core, join in ((deck, APART), (amid(z, start, h, w, deck, 1, MIDST), 1)):
        number, sums, box = parts(z, start, h, w, core, np.zeros(len(deck), bool), join)
        roof = _roofs(raster, deck, number, sums, box)
        if roof.any():
            deck = _regrown(z, start, h, w, deck, number, roof, NEXT if join == 1 else ENDLESS)
    return deck


def _roofs(raster, deck, number, sums, box) -> NDArray[np.bool_]:
    """Which cores, numbered, are of roofs (number of cores,)."""
    z, start, h, w, kind, end = raster
    length, count = extent(box), len(sums)
    roof = (length <= ROOF) & (sums[:, 0] >= SMALLEST)
    if count < 2 or not roof.any():
        return np.zeros(count, bool)
    own = np.where(deck & (number < 0), count, number)  # what is of no core
    outward, cut, _, _ = rims(z, start, h, w, kind, end, own, np.vstack([sums, np.zeros((1, 3), np.int64)]))
    whole, _, around = parts(z, start, h, w, deck, np.zeros(len(deck), bool))
    of = np.zeros(count, np.int64)
    of[number[number >= 0]] = whole[number >= 0]
    # Of what is cut into many cores, as a truss or a deck of a sparse cloud, nothing is told apart.
    spans = length >= SPANS * np.minimum(extent(around)[of], LONGEST)
    leads = outward + cut
    two = np.array([opposite_ends(leads[k], leads[k]) is not None for k in range(count)])
    main = spans & (two | (length > LONGEST))
    near = _contacts(z, start, h, w, number, sums, main)
    turn = 2 * np.pi * (np.arange(SECTORS) + 0.5) / SECTORS
    roof &= np.hypot(near @ np.cos(turn), near @ np.sin(turn)) > ONE_SIDE * near.sum(axis=1)
    roof &= cut[:count].sum(axis=1) == 0
    land, seen = np.empty((len(z), 3), np.int32), np.full(len(z), -1, np.int32)
    everywhere = np.ones(SECTORS, bool)
    for stamp, k in enumerate(np.flatnonzero(roof & (outward[:count].sum(axis=1) > 0))):
        over = no_ends()
        cells = first_land(z, start, h, w, kind, own, sums[k], box[k], k, everywhere, land, seen, stamp)
        cells = spread(z, start, h, w, kind, end, own, land, seen, stamp, cells, over)
        roof[k] = not is_land(cells, over)
    return roof
