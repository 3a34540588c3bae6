"""Cells of a rectangle as dense arrays, and the ground's surface below them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..base.jit import njit
from .cells import GROUND_CELLS, MM, Cells, Kind, unpack

#: How far the ground is looked for, meters: half the width of the largest building.
GROUND_REACH = 120.0


@dataclass(frozen=True)
class Window:
    """A rectangle of cells; its lower corner lies on a cell of the ground, so both numbers are even."""

    row: int
    column: int
    rows: int
    columns: int

    def dense(self, cells: Cells, name: str, empty: float) -> NDArray:
        """A column of cells, all of one kind, as an array (rows, columns) with `empty` where there is no cell."""
        _, row, column = unpack(cells.key)
        row, column = row - self.row, column - self.column
        keep = (row >= 0) & (row < self.rows) & (column >= 0) & (column < self.columns)
        out = np.full((self.rows, self.columns), empty, np.float64)
        out[row[keep], column[keep]] = cells.columns[name][keep]
        return out

    def of(self, cells: Cells, kind: Kind) -> Cells:
        """The cells of a kind inside."""
        return cells.within(kind, self.row, self.column, self.rows, self.columns)

    def has_ground(self, cells: Cells) -> NDArray[np.bool_]:
        """Whether the ground was seen in the cell of the ground that each cell lies in."""
        half = self._half()
        count = half.dense(
            cells.within(Kind.GROUND, half.row, half.column, half.rows, half.columns), "count", 0.0
        )
        return self._wide(count > 0)

    def _half(self) -> Window:
        """The same in cells of the ground."""
        return Window(
            self.row // GROUND_CELLS,
            self.column // GROUND_CELLS,
            -(-self.rows // GROUND_CELLS),
            -(-self.columns // GROUND_CELLS),
        )

    def _wide(self, values: NDArray) -> NDArray:
        wide = np.repeat(np.repeat(values, GROUND_CELLS, axis=0), GROUND_CELLS, axis=1)
        return wide[: self.rows, : self.columns]

    def ground(self, cells: Cells) -> NDArray[np.float64]:
        """Height of the ground in each cell, meters; NaN where none is within reach."""
        half = self._half()
        inside = cells.within(Kind.GROUND, half.row, half.column, half.rows, half.columns)
        count = half.dense(inside, "count", 0.0)
        mean = np.where(count > 0, half.dense(inside, "sum", 0.0) / np.maximum(count, 1.0), np.nan) / MM
        filled = fill_gaps(mean, round(GROUND_REACH / (cells.size * GROUND_CELLS)))
        return self._wide(filled)


@njit
def fill_gaps(z: NDArray, reach: int) -> NDArray:
    """Values where there are none (NaN), from the nearest in eight directions, weighed by one over the distance.

    Two that lie opposite give what a line between them does, so a slope goes on below a building. What lies farther
    than `reach` cells does not count: the surroundings of a place decide, whatever the extent of the array.
    """
    rows, columns = z.shape
    total, weight = np.zeros((rows, columns)), np.zeros((rows, columns))
    for way in range(8):
        dr, dc = (0, 0, 1, -1, 1, -1, 1, -1)[way], (1, -1, 0, 0, 1, -1, -1, 1)[way]
        last, steps = np.full((rows, columns), np.nan), np.zeros((rows, columns), np.int32)
        length = np.sqrt(2.0) if dr != 0 and dc != 0 else 1.0
        for i in range(rows):
            r = i if dr >= 0 else rows - 1 - i
            for j in range(columns):
                c = j if dc >= 0 else columns - 1 - j
                if not np.isnan(z[r, c]):
                    last[r, c] = z[r, c]
                    continue
                before_r, before_c = r - dr, c - dc
                if before_r < 0 or before_r >= rows or before_c < 0 or before_c >= columns:
                    continue
                away = steps[before_r, before_c] + 1
                if np.isnan(last[before_r, before_c]) or away * length > reach:
                    continue
                last[r, c], steps[r, c] = last[before_r, before_c], away
                w = 1.0 / (away * length)
                total[r, c] += w * last[r, c]
                weight[r, c] += w
    out = z.copy()
    for r in range(rows):
        for c in range(columns):
            if np.isnan(out[r, c]) and weight[r, c] > 0.0:
                out[r, c] = total[r, c] / weight[r, c]
    return out
