"""What the surroundings of a cell say of it: is its ground raised, is it at the edge, do its neighbors agree."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from .cells import BUILDING, GROUND, GROUPS, MM, NONE, PARTS, VEGETATION, Records, rows_and_columns

#: How far is looked, meters: for what is close by, for the edge, and for ground that is lower all around.
NEAR, EDGE, FAR = 6.0, 12.0, 32.0
#: Cells of a block that is worked on at once, without its surroundings.
_BLOCK = 512
#: Groups that are judged.
JUDGED = (GROUND, VEGETATION, BUILDING)


@dataclass
class Signals:
    """Values of each cell, (n,) float64, and of each cell and group, (n, 3).

    Attributes
    ----------
    around : (n, 4)
        Share of each group among the points close by.
    rate, rate_around : (n, 3)
        Share of wrong points that reliability and height make expect, here and close by.
    raised : (n,)
        How far the lowest ground point lies above the lowest within 32 m in each of four directions, at least; meters.
    void : (n,)
        Meters to the nearest cell that has ground.
    full : (n,)
        Share of the cells within 12 m that hold points.
    relief : (n,)
        Heights that ground has close by, meters.
    tall : (n,)
        From the lowest to the highest point, meters.
    density : (n,)
        Points per square meter.
    strips, doubtful, unsure, contrary : (n,)
        Shares of the cell's points.
    """

    around: NDArray[np.float64]
    rate: NDArray[np.float64]
    rate_around: NDArray[np.float64]
    raised: NDArray[np.float64]
    void: NDArray[np.float64]
    full: NDArray[np.float64]
    relief: NDArray[np.float64]
    tall: NDArray[np.float64]
    density: NDArray[np.float64]
    strips: NDArray[np.float64]
    doubtful: NDArray[np.float64]
    unsure: NDArray[np.float64]
    contrary: NDArray[np.float64]


def signals(records: Records) -> Signals:
    """The signals of all cells."""
    n, side = len(records), records.side
    points = records.points
    total = points.sum(axis=1)
    expected = records.expected[:, : len(JUDGED)] / PARTS
    around, rate_around = np.zeros((n, len(GROUPS))), np.zeros((n, len(JUDGED)))
    raised, full, relief = np.zeros((3, n))
    void = np.full(n, FAR)
    near, edge, far = (max(1, round(reach / side)) for reach in (NEAR, EDGE, FAR))
    row, column = rows_and_columns(records.key)
    for rows, inner, place, shape in _blocks(row, column, max(near, edge, far)):

        def grid(values: NDArray, empty: float = 0.0, rows=rows, place=place, shape=shape) -> NDArray:
            out = np.full(shape, empty)
            out[place] = values[rows]
            return out

        mine, at = rows[inner], tuple(axis[inner] for axis in place)
        here = [_summed(grid(points[:, g]), near) for g in range(len(GROUPS))]
        everything = np.maximum(sum(here), 1.0)
        for g in range(len(GROUPS)):
            around[mine, g] = (here[g] / everything)[at]
        for g in range(len(JUDGED)):
            wrong = _summed(grid(expected[:, g]), near)
            rate_around[mine, g] = (wrong / np.maximum(here[g], 1.0))[at]
        full[mine] = ndimage.uniform_filter(grid(np.ones(n)), 2 * edge + 1, mode="constant")[at]
        there = records.low < NONE
        low = grid(np.where(there, records.low / MM, np.inf), np.inf)
        known = np.isfinite(low)
        if not known.any():
            continue
        away = ndimage.distance_transform_edt(~known) * side
        void[mine] = np.minimum(away[at], FAR)
        lower = np.max([_lowest(low, axis, way * far) for axis in (0, 1) for way in (-1, 1)], axis=0)
        bump = np.where(known & np.isfinite(lower), low - np.where(np.isfinite(lower), lower, 0.0), 0.0)
        raised[mine] = np.maximum(bump, 0.0)[at]
        bottom = ndimage.minimum_filter(low, 2 * near + 1, mode="constant", cval=np.inf)
        top = ndimage.maximum_filter(
            np.where(known, low, -np.inf), 2 * near + 1, mode="constant", cval=-np.inf
        )
        some = np.isfinite(bottom) & np.isfinite(top)
        relief[mine] = np.where(some, np.where(some, top, 0.0) - np.where(some, bottom, 0.0), 0.0)[at]
    share = 1.0 / np.maximum(total, 1)
    return Signals(
        around,
        expected / np.maximum(points[:, : len(JUDGED)], 1),
        rate_around,
        raised,
        void,
        full,
        relief,
        (records.highest.astype(np.float64) - records.lowest) / MM,
        total / side**2,
        records.disagreeing * share,
        records.doubtful * share,
        records.unsure * share,
        records.contrary * share,
    )


def _blocks(
    row: NDArray[np.int64], column: NDArray[np.int64], margin: int
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.bool_], tuple[NDArray, NDArray], tuple[int, int]]]:
    """For each block of ground: its cells and those around it, which are its own, their places in a grid, and its shape.

    Blocks are of an absolute grid, so that what lies elsewhere changes nothing.
    """
    name = np.stack([row // _BLOCK, column // _BLOCK], axis=1)
    order = np.argsort(row, kind="stable")
    ordered = row[order]
    for down, across in np.unique(name, axis=0).tolist():
        first, last = down * _BLOCK - margin, (down + 1) * _BLOCK + margin
        band = order[np.searchsorted(ordered, first) : np.searchsorted(ordered, last)]
        left = across * _BLOCK - margin
        inside = (column[band] >= left) & (column[band] < left + _BLOCK + 2 * margin)
        rows = np.sort(band[inside])
        place = (row[rows] - first, column[rows] - left)
        own = (name[rows, 0] == down) & (name[rows, 1] == across)
        yield rows, own, place, (_BLOCK + 2 * margin, _BLOCK + 2 * margin)


def _summed(values: NDArray, reach: int) -> NDArray:
    """Sums over squares of 2 `reach` + 1 cells; whole numbers stay exact."""
    padded = np.pad(values, ((reach + 1, reach), (reach + 1, reach)))
    total = padded.cumsum(axis=0).cumsum(axis=1)
    wide = 2 * reach + 1
    return total[wide:, wide:] - total[:-wide, wide:] - total[wide:, :-wide] + total[:-wide, :-wide]


def _lowest(values: NDArray, axis: int, reach: int) -> NDArray:
    """The lowest value among the next `reach` cells along an axis, backward where it is negative."""
    size = abs(reach)
    origin = -(size // 2) if reach > 0 else size // 2 - (size % 2 == 0)
    shifted = ndimage.minimum_filter1d(values, size, axis=axis, mode="constant", cval=np.inf, origin=origin)
    # The window begins at the cell itself: move on by one, so that it is of the others.
    out = np.full_like(values, np.inf)
    to, of = [slice(None)] * 2, [slice(None)] * 2
    to[axis], of[axis] = (slice(None, -1), slice(1, None)) if reach > 0 else (slice(1, None), slice(None, -1))
    out[tuple(to)] = shifted[tuple(of)]
    return out
