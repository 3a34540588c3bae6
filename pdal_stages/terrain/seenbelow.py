"""What is seen below and beside a line in the air: a wire hides nothing, an eave, a cornice or a balcony does."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from ..base.jit import njit
from .minima import cell_numbers

#: Side of the cells, and half the length of the line that is looked for; meters.
CELL, HALF = 1.0, 12.0
#: What lies `UNDER` meters below the line is counted up to `STRIP` meters from it, and to each side from `STRIP_FROM` to
#: `STRIP_TO`: below are so many of all that is not higher on the fuller side, for the same area, and to either side so many
#: of what is below on the other.
UNDER, STRIP, STRIP_FROM, STRIP_TO, SEEN, EITHER = 1.0, 0.6, 1.2, 3.6, 0.55, 0.2
#: Cells beside the high points' raster from which the ground near lines may be seen.
_MARGIN = int((HALF + STRIP_TO) / CELL) + 1


@njit
def _held(column, row, use, left, bottom, h, w):
    """Cells of a raster (h * w) with a point."""
    out = np.zeros(h * w, np.bool_)
    for p in range(len(use)):
        i, j = column[p] - left, row[p] - bottom
        if use[p] and 0 <= i < w and 0 <= j < h:
            out[j * w + i] = True
    return out


@njit
def _near_lines(cells, h, w, good):
    """Cells of a raster wider by `_MARGIN` on all sides whose points count for what is seen below a line."""
    wide = w + 2 * _MARGIN
    out = np.zeros((h + 2 * _MARGIN) * wide, np.bool_)
    for n in range(len(good)):
        if good[n]:
            j, i = cells[n] // w, cells[n] % w
            for b in range(j, j + 2 * _MARGIN + 1):
                out[b * wide + i : b * wide + i + 2 * _MARGIN + 1] = True
    return out


@njit
def _inside(column, row, use, near, left, bottom, h, w):
    """Numbers of the points in cells `near` lines, ascending, and these cells."""
    wide, tall = w + 2 * _MARGIN, h + 2 * _MARGIN
    points, cell = np.empty(len(use), np.int64), np.empty(len(use), np.int64)
    n = 0
    for p in range(len(use)):
        i, j = column[p] - left, row[p] - bottom
        if use[p] and 0 <= i < wide and 0 <= j < tall and near[j * wide + i]:
            points[n], cell[n] = p, j * wide + i
            n += 1
    return points[:n].copy(), cell[:n].copy()


@njit
def _seen_through(place, cells, h, w, good, line, x, y, z, cell, column, row, on, order):
    """The same lines, those that hide nothing: of points in the wider raster, in whose order by cell `order` has them;
    some are `on` such lines.
    """
    wide = w + 2 * _MARGIN
    begin = np.zeros((h + 2 * _MARGIN) * wide + 1, np.int64)
    for p in range(len(cell)):
        begin[cell[p] + 1] += 1
    for k in range(len(begin) - 1):
        begin[k + 1] += begin[k]
    out = good.copy()
    for n in range(len(good)):
        if not good[n]:
            continue
        j, i = cells[n] // w + _MARGIN, cells[n] % w + _MARGIN
        below = right = left = right_below = left_below = 0
        for b in range(j - _MARGIN, j + _MARGIN + 1):
            # Of the row, the columns near to the line.
            low, high = i - _MARGIN, i + _MARGIN + 1
            if abs(line[n, 1]) > 0.1:
                middle, around = (
                    i + (b - j) * line[n, 0] / line[n, 1],
                    (STRIP_TO + 2.0) / abs(line[n, 1]) + 1.0,
                )
                low, high = max(low, int(middle - around)), min(high, int(middle + around) + 2)
            if low >= high:
                continue
            for q in range(begin[b * wide + low], begin[b * wide + high]):
                p = order[q]
                dx = (cell[p] % wide - i) * CELL + (x[p] - column[p] * CELL) - place[n, 0]
                dy = (b - j) * CELL + (y[p] - row[p] * CELL) - place[n, 1]
                along, aside = dx * line[n, 0] + dy * line[n, 1], dy * line[n, 0] - dx * line[n, 1]
                if abs(along) > HALF or abs(aside) > STRIP_TO:
                    continue
                above = z[p] - place[n, 2] - line[n, 2] * along
                if abs(aside) <= STRIP:
                    below += above < -UNDER
                elif abs(aside) > STRIP_FROM and above < UNDER and not on[p]:
                    right += aside < 0.0
                    left += aside > 0.0
                    right_below += aside < 0.0 and above < -UNDER
                    left_below += aside > 0.0 and above < -UNDER
        out[n] = below * (STRIP_TO - STRIP_FROM) >= SEEN * 2.0 * STRIP * max(right, left)
        out[n] &= min(right_below, left_below) >= EITHER * max(right_below, left_below)
    return out


class SeenBelow:
    """All points, of which those below and beside lines are asked for."""

    def __init__(self, xyz: NDArray[np.float64], use: NDArray[np.bool_], high: NDArray[np.int64]) -> None:
        self._xyz, self._use, self._high = xyz, use, high

    @functools.cached_property
    def _places(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        return cell_numbers(self._xyz[:, 0], CELL), cell_numbers(self._xyz[:, 1], CELL)

    def held(self, raster) -> NDArray[np.bool_]:
        """Which cells of a raster (h * w) hold a point."""
        return _held(*self._places, self._use, *raster)

    def seen_through(self, good, line, place, cells, raster, at, level) -> NDArray[np.bool_]:
        """Which levels are `good` and hide nothing; the points `at` of the high ones are of the levels `level`."""
        left, bottom, h, w = raster
        near = _near_lines(cells, h, w, good)
        points, cell = _inside(*self._places, self._use, near, left - _MARGIN, bottom - _MARGIN, h, w)
        on = np.zeros(len(self._use), bool)
        on[self._high[at]] = good[level]
        x, y, z = (np.ascontiguousarray(axis) for axis in self._xyz[points].T)
        order = np.argsort(cell, kind="stable")
        columns, rows = (places[points] for places in self._places)
        return _seen_through(place, cells, h, w, good, line, x, y, z, cell, columns, rows, on[points], order)
