"""Connected components: sets of points, voxels and cells that pairs join, and how long they are."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from ..base.jit import device, njit
from .cells import HOLE


@device
def root_of(parent, member):
    """Return the member that stands for a set, and shorten the path to it."""
    while parent[member] != member:
        parent[member] = parent[parent[member]]
        member = parent[member]
    return member


@njit
def number_sets(first, second, number):
    """Give the members (n,) of each set that pairs join its number; return the number of sets.

    Sets are numbered in the order of their first members.

    By hand: importing scipy.sparse.csgraph takes 0.2 s of CPU time.
    """
    parent = np.arange(len(number))
    for k in range(len(first)):
        a, b = root_of(parent, first[k]), root_of(parent, second[k])
        parent[max(a, b)] = min(a, b)
    count = 0
    for i in range(len(number)):
        root = root_of(parent, i)
        number[i] = count if root == i else number[root]
        count += root == i
    return count


@njit
def _linked(padded, offsets, steps, reach, number):
    """Give the measured cells of each linked set its number; return the number of sets."""
    h, w = number.shape
    parent = np.arange(h * w)
    for j in range(h):
        for i in range(w):
            here, root = padded[j, i + reach], root_of(parent, j * w + i)
            if here == HOLE:
                continue
            for k in range(len(steps)):
                b, a = j + offsets[k, 0], i + offsets[k, 1]
                if (
                    abs(padded[b, a + reach] - here) <= steps[k] and parent[b * w + a] != root
                ):  # nor a hole
                    other = root_of(parent, b * w + a)
                    root, other = min(root, other), max(root, other)
                    parent[other] = root
    count = 0
    for j in range(h):
        for i in range(w):
            if padded[j, i + reach] != HOLE:
                root = root_of(parent, j * w + i)  # the first of its set
                if root == j * w + i:
                    number[j, i] = count
                    count += 1
                else:
                    number[j, i] = number[root // w, root % w]
    return count


def linked_cells(
    raster: NDArray[np.float32],
    reach: float,
    step: Callable[[NDArray[np.float64]], NDArray[np.float64]],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Link cells to sets: return sets (h, w), -1 in holes, sizes and :func:`longest_sides` (n,).

    Cells at most `reach` away from each other are linked across a `step` of meters, by the distance
    in cells.
    """
    side = int(reach)
    j, i = np.mgrid[: side + 1, -side : side + 1]
    away = np.hypot(j, i)
    after = ((j > 0) | (i > 0)) & (away <= reach)
    number = np.full(raster.shape, -1)
    # With holes beside and below, so that no step has to look where the raster ends.
    padded = np.pad(raster, ((0, side), (side, side)), constant_values=HOLE)
    offsets = np.column_stack([j[after], i[after]])
    count = _linked(padded, offsets, step(away[after]).astype(np.float32), side, number)
    rows, columns = np.nonzero(number >= 0)
    sets = number[rows, columns]
    return number, np.bincount(sets, minlength=count), longest_sides(sets, (rows, columns), count)


def longest_sides(
    label: NDArray[np.int64], places: Sequence[NDArray[np.int64]], count: int
) -> NDArray[np.int64]:
    """Return the largest extent along an axis of each of `count` sets of places."""
    sides = np.zeros((len(places), count), np.int64)
    for side, at in zip(sides, places, strict=True):
        first, last = np.full((2, count), at[0] if len(at) else 0)
        first[label] = last[label] = at
        np.minimum.at(first, label, at)
        np.maximum.at(last, label, at)
        side[:] = last - first
    return sides.max(axis=0)
