"""What a window of the absolute grid shows: heights, ground and roofs, and as much around it as objects need."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import NDArray

from . import crowns, roofs
from .cells import GROUND_CELLS, MM, Cells, Kind, unpack
from .found import ObjectSettings
from .measure import Body
from .rasters import GROUND_REACH, Window

#: Meters around a place that decide about it, but for the extent of buildings, spans and decks.
MARGIN = GROUND_REACH + 2 * crowns.REACH
#: How far a roof goes on into what a classifier took for leaves, meters.
GROWTH = 3.0
#: How far the cells of a roof from which nothing came back lie from its rim at most, meters.
DARK = 6.0
#: A cell and its eight neighbors.
AROUND = np.ones((3, 3), bool)
#: Cells of a window beyond which no more is looked at around a block: objects that reach farther are cut, and say so.
MOST_CELLS = 64_000_000


def widened(core: Window, margin: int) -> Window:
    margin += margin % GROUND_CELLS
    return Window(core.row - margin, core.column - margin, core.rows + 2 * margin, core.columns + 2 * margin)


def extent_of(cells: Cells) -> Window:
    """The rectangle that holds all cells, and an empty rim."""
    kind, row, column = unpack(cells.key)
    wide = np.where(kind == Kind.GROUND, GROUND_CELLS, 1)
    lows = [int((v * wide).min()) - 8 for v in (row, column)]
    lows = [v - v % GROUND_CELLS for v in lows]
    sizes = [int(((v + 1) * wide).max()) + 8 - low for v, low in zip((row, column), lows, strict=True)]
    return Window(*lows, *(n + n % GROUND_CELLS for n in sizes))


def _common(a: Window, b: Window) -> Window:
    row, column = max(a.row, b.row), max(a.column, b.column)
    rows = min(a.row + a.rows, b.row + b.rows) - row
    return Window(row, column, rows, min(a.column + a.columns, b.column + b.columns) - column)


class CellView:
    """What the cells of a window hold, as arrays of the part of it that has any; what several kinds need is made once."""

    def __init__(self, cells: Cells, window: Window, extent: Window, chosen: ObjectSettings) -> None:
        self.cells, self.seen, self.extent, self.chosen = cells, window, extent, chosen
        self.window = _common(window, extent)
        self._held: dict[Kind, tuple[Cells, NDArray, NDArray]] = {}
        self._places: dict[Kind, NDArray[np.int32]] = {}

    def wider(self, margin: int) -> CellView:
        """The same with more around it."""
        return CellView(self.cells, widened(self.seen, margin), self.extent, self.chosen)

    def held(self, kind: Kind) -> tuple[Cells, NDArray[np.int64], NDArray[np.int64]]:
        """The cells of a kind, and their rows and columns in the window."""
        if kind not in self._held:
            inside = self.window.of(self.cells, kind)
            _, row, column = unpack(inside.key)
            self._held[kind] = inside, row - self.window.row, column - self.window.column
        return self._held[kind]

    def column(self, kind: Kind, name: str, empty: float) -> NDArray[np.float64]:
        """What cells of a kind hold, `empty` where there is none."""
        inside, row, column = self.held(kind)
        out = np.full((self.window.rows, self.window.columns), empty)
        out[row, column] = inside.columns[name]
        return out

    def high(self, kind: Kind) -> NDArray[np.float64]:
        """Height of the highest point of a kind, meters; NaN where there is none."""
        return self.column(kind, "high", np.nan) / MM

    @cached_property
    def ground(self) -> NDArray[np.float64]:
        """Height of the ground, meters; NaN where it is not known."""
        return self.window.ground(self.cells)

    @cached_property
    def roofs(self) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """Cells of roofs, gone on into vegetation in their planes and over gaps of sparse ones, and their heights."""
        chosen = self.chosen
        leaves = self.high(Kind.TREE)
        seen = self.window.has_ground(self.cells)
        seen |= ~np.isnan(leaves) | (self.column(Kind.OTHER, "count", 0.0) > 0)
        with np.errstate(invalid="ignore"):
            leaves[leaves - self.ground < chosen.building_height] = np.nan
        thick = leaves - self.column(Kind.TREE, "low", np.nan) / MM
        reach = round(GROWTH / chosen.cell)
        high = roofs.continued(self.high(Kind.BUILDING), leaves, thick, chosen.cell, reach)
        high = np.where(high - self.ground < chosen.building_height, np.nan, high)
        high = roofs.covered(high, seen, round(DARK / chosen.cell))
        return roofs.roof_cells(high, self.ground, chosen.building_height)

    def _place(self, kind: Kind) -> NDArray[np.int32]:
        """Where among the cells of a kind each of the window is, -1 for those that are not."""
        if kind not in self._places:
            inside, row, column = self.held(kind)
            self._places[kind] = np.full((self.window.rows, self.window.columns), -1, np.int32)
            self._places[kind][row, column] = np.arange(len(inside))
        return self._places[kind]

    def body(self, kind: Kind, r: NDArray, c: NDArray, z: NDArray) -> Body:
        """An object's cells, of which rows and columns in the window are given, with heights `z` of the window."""
        known, at = self.held(kind)[0], self._place(kind)[r, c]
        there = at >= 0

        def held(name: str, empty: float) -> NDArray:
            return np.where(there, known.columns[name][at], empty)

        return Body(
            r + self.window.row,
            c + self.window.column,
            z[r, c],
            held("low", np.nan) / MM,
            self.ground[r, c],
            held("count", 0).astype(np.int64),
            held("sure", 0.0),
            held("told", 0).astype(np.int64),
        )


def _part(window: Window, part: Window) -> tuple[slice, slice]:
    """Where in a window's arrays another lies."""
    common = _common(window, part)
    row, column = common.row - window.row, common.column - window.column
    return slice(row, row + max(common.rows, 0)), slice(column, column + max(common.columns, 0))


def whole(
    near: CellView, core: Window, masked: Callable[[CellView], NDArray[np.bool_]], beside: bool = True
) -> tuple[CellView, NDArray[np.bool_], Window]:
    """A block's view with as much around it as it takes for all that reaches into the block to be whole.

    The last is the window within which they are: only objects larger than a window may be go beyond it. `beside`: cells
    beside an object are looked at, too, so objects a cell apart reach as far as both.
    """
    margin = round(MARGIN / near.chosen.cell)
    view, around = near, near.seen.rows - core.rows >> 1
    while True:
        mask = masked(view)
        first, _ = scipy.ndimage.label(scipy.ndimage.binary_dilation(mask, AROUND) if beside else mask)
        first -= 1
        sure = widened(view.seen, -margin)
        reached = np.zeros(mask.size + 1, bool)  # the last: no part
        reached[first[_part(view.window, core)]] = True
        first[_part(view.window, sure)] = -1
        if not reached[first[first >= 0]].any() or mask.size > MOST_CELLS:
            return view, mask, sure
        more = max(margin, around // 2)
        view, around = view.wider(more), around + more
