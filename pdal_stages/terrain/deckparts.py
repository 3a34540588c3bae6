"""Parts of what may be decks: levels that hang together, and how long these are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..base.jit import device, njit
from ..base.unionfind import root as root_of
from .deckrims import JOIN
from .walkable import DROP, distance, walkable

#: The longest deck that is judged as a whole, in cells.
LONGEST = 250


@device
def first_like(z, start, k, deck, height, far):
    """The lowest deck of cell k that one at a `height`, so `far` away, leads on to; -1 where none is."""
    for m in range(start[k], start[k + 1]):
        if deck[m] and walkable(z[m] - height, far):
            return m
    return -1


@njit
def amid(z, start, h, w, deck, reach, least):
    """Levels (n,) of decks that lead on to others in at least so many of the cells up to `reach` away, their own included.

    A seam beside them, such as the gap before a roof, parts these.
    """
    out = np.zeros(len(z), np.bool_)
    for j in range(h):
        for i in range(w):
            for n in range(start[j * w + i], start[j * w + i + 1]):
                if not deck[n]:
                    continue
                count = 0
                for b in range(max(j - reach, 0), min(j + reach + 1, h)):
                    for a in range(max(i - reach, 0), min(i + reach + 1, w)):
                        count += first_like(z, start, b * w + a, deck, z[n], distance(a - i, b - j)) >= 0
                out[n] = count >= least
    return out


@device
def _chasm(z, start, w, j, i, a, b, level):
    """Whether on the way to a cell some cells on there is one with nothing but what lies much lower, as between a deck and a
    roof beside it.
    """
    steps = max(abs(a), b)
    for s in range(1, steps):
        k = (j + (2 * b * s + steps) // (2 * steps)) * w + i + (2 * a * s + steps) // (2 * steps)
        if start[k] < start[k + 1] and z[start[k + 1] - 1] < level - DROP:
            return True
    return False


@njit
def parts(z, start, h, w, deck, wide, join=JOIN):
    """Number the parts that hang together (n,), -1 elsewhere; their size and sums of rows and columns; their boxes.

    What is broad hangs together with nothing else; nothing does across more than `join` cells.
    """
    parent = np.arange(len(z))
    for j in range(h):
        for i in range(w):
            for n in range(start[j * w + i], start[j * w + i + 1]):
                if not deck[n]:
                    continue
                for b in range(join + 1):
                    for a in range(-join if b else 1, join + 1):
                        if j + b >= h or i + a < 0 or i + a >= w:
                            continue
                        k = (j + b) * w + i + a
                        for m in range(start[k], start[k + 1]):
                            if not deck[m] or wide[m] != wide[n] or not walkable(z[m] - z[n], distance(a, b)):
                                continue
                            if not _chasm(z, start, w, j, i, a, b, min(z[m], z[n])):
                                one, other = root_of(parent, n), root_of(parent, m)
                                parent[max(one, other)] = min(one, other)
    number = np.full(len(z), -1, np.int64)
    count = 0
    for n in range(len(z)):
        if deck[n]:
            root = root_of(parent, n)
            if root == n:
                number[n] = count
                count += 1
            else:
                number[n] = number[root]
    sums, box = np.zeros((count, 3), np.int64), np.zeros((count, 4), np.int64)
    box[:, 0], box[:, 2] = h, w
    for j in range(h):
        for i in range(w):
            for n in range(start[j * w + i], start[j * w + i + 1]):
                k = number[n]
                if k >= 0:
                    sums[k, 0] += 1
                    sums[k, 1] += j
                    sums[k, 2] += i
                    box[k, 0], box[k, 1] = min(box[k, 0], j), max(box[k, 1], j)
                    box[k, 2], box[k, 3] = min(box[k, 2], i), max(box[k, 3], i)
    return number, sums, box


def extent(box: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.maximum(box[:, 1] - box[:, 0], box[:, 3] - box[:, 2]) + 1
