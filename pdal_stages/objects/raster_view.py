"""What a window of the absolute grid shows: heights, ground and roofs, and as much around it as objects need."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from . import crowns, roofs
from .attributes import Body
from .cells import GROUND_CELLS, MM, Cells, Kind, unpack
from .results import ObjectSettings

#: How far the ground is looked for, meters: half the width of the largest building.
GROUND_REACH = 120.0
#: Meters around a place that decide about it, but for the extent of buildings, spans and decks.
MARGIN = GROUND_REACH + 2 * crowns.REACH
#: How far a roof goes on into what a classifier took for leaves, meters.
GROWTH = 3.0
#: How far the cells of a roof from which nothing came back lie from its rim at most, meters.
DARK = 6.0
#: A cell and its eight neighbors.
AROUND = np.ones((3, 3), bool)


class Window(NamedTuple):
    """A rectangle of cells; all numbers are even, so it holds whole cells of the ground."""

    row: int
    column: int
    rows: int
    columns: int

    @property
    def shape(self) -> tuple[int, int]:
        return self.rows, self.columns

    def widened(self, margin: int) -> Window:
        margin += margin % GROUND_CELLS
        return Window(
            self.row - margin,
            self.column - margin,
            self.rows + 2 * margin,
            self.columns + 2 * margin,
        )

    def common(self, other: Window) -> Window:
        row, column = max(self.row, other.row), max(self.column, other.column)
        rows = min(self.row + self.rows, other.row + other.rows) - row
        columns = min(self.column + self.columns, other.column + other.columns) - column
        return Window(row, column, max(rows, 0), max(columns, 0))

    def part(self, other: Window) -> tuple[slice, slice]:
        """Where in this window's arrays another lies."""
        both = self.common(other)
        row, column = both.row - self.row, both.column - self.column
        return slice(row, row + both.rows), slice(column, column + both.columns)

    def holds(self, row: int, column: int) -> bool:
        return (
            self.row <= row < self.row + self.rows
            and self.column <= column < self.column + self.columns
        )


def _extent(parts: Mapping[Kind, Cells]) -> Window:
    """The rectangle that holds the cells of all kinds, of which there must be one, and an empty rim."""
    places = [np.stack(unpack(part.key)[1:]) * _width(kind) for kind, part in parts.items()]
    low, high = (end(np.concatenate(places, axis=1), axis=1) for end in (np.min, np.max))
    low, high = (
        end // GROUND_CELLS * GROUND_CELLS for end in (low - 8, high + 8 + 2 * GROUND_CELLS)
    )
    return Window(*low.tolist(), *(high - low).tolist())


def _width(kind: Kind) -> int:
    return GROUND_CELLS if kind == Kind.GROUND else 1


class CellView:
    """What the cells of a window hold, as arrays of the part of it that has any; what several kinds need is made once."""

    def __init__(self, cells: Cells, window: Window, chosen: ObjectSettings) -> None:
        self.cells, self.seen, self.chosen = cells, window, chosen
        self.inside = {
            kind: cells.within(kind, *(n // _width(kind) for n in window)) for kind in Kind
        }
        self.window = window.common(_extent(self.inside))
        self.held, self.surface = cache(self._held), cache(self._surface)

    def _held(self, kind: Kind) -> tuple[Cells, NDArray[np.int32]]:
        """The cells of a kind, and where among them each of the window is, -1 for those that are not.

        Those of the ground in a window of its own, wider cells.
        """
        first_row, first_column, *shape = (n // _width(kind) for n in self.window)
        inside = self.inside[kind]
        _, row, column = unpack(inside.key)
        place = np.full(shape, -1, np.int32)
        place[row - first_row, column - first_column] = np.arange(len(inside))
        return inside, place

    def column(self, kind: Kind, name: str, empty: float) -> NDArray[np.float64]:
        """What cells of a kind hold, `empty` where there is none."""
        inside, place = self.held(kind)
        return np.append(inside.columns[name].astype(np.float64), empty)[place]

    def high(self, kind: Kind) -> NDArray[np.float64]:
        """Height of the highest point of a kind, meters; NaN where there is none."""
        return self.column(kind, "high", np.nan) / MM

    @cached_property
    def ground(self) -> NDArray[np.float64]:
        """Height of the ground, meters; NaN where none is within reach."""
        mean = (
            self.column(Kind.GROUND, "sum", np.nan) / self.column(Kind.GROUND, "count", np.nan) / MM
        )
        return _wide(fill_gaps(mean, round(GROUND_REACH / (self.cells.size * GROUND_CELLS))))

    def _surface(self, kind: Kind) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """Cells of decks and their heights; or of roofs, gone on into vegetation in their planes and over gaps."""
        if kind != Kind.BUILDING:
            return roofs.roof_cells(self.high(kind))
        chosen, leaves = self.chosen, self.high(Kind.TREE)
        seen = (
            _wide(self.held(Kind.GROUND)[1] >= 0)
            | ~np.isnan(leaves)
            | (self.held(Kind.OTHER)[1] >= 0)
        )
        with np.errstate(invalid="ignore"):
            leaves[leaves - self.ground < chosen.building_height] = np.nan
        thick = leaves - self.column(Kind.TREE, "low", np.nan) / MM
        reach = round(GROWTH / chosen.cell)
        high = roofs.continued(self.high(Kind.BUILDING), leaves, thick, chosen.cell, reach)
        high = np.where(high - self.ground < chosen.building_height, np.nan, high)
        return roofs.roof_cells(roofs.covered(high, seen, round(DARK / chosen.cell)))

    def body(self, kind: Kind, r: NDArray, c: NDArray, z: NDArray) -> Body:
        """An object's cells, of which rows and columns in the window are given, with heights `z` of the window."""
        known, place = self.held(kind)
        at = place[r, c]

        def held(name: str, empty: float) -> NDArray:
            return np.where(at >= 0, known.columns[name][at], empty)

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

    def whole(
        self, core: Window, masked: Callable[[CellView], NDArray[np.bool_]], beside: bool = True
    ) -> tuple[CellView, NDArray[np.bool_]]:
        """The view with as much around a block as it takes for all that reaches into the block to be whole; its mask.

        `beside`: cells beside an object are looked at, too, so objects a cell apart reach as far as both.
        """
        margin, view = round(MARGIN / self.chosen.cell), self
        while True:
            mask = masked(view)
            part, count = scipy.ndimage.label(
                scipy.ndimage.binary_dilation(mask, AROUND) if beside else mask
            )
            reached = np.zeros(count + 1, bool)
            reached[part[view.window.part(core)]] = True
            reached[0] = False
            part[view.window.part(view.seen.widened(-margin))] = 0
            if not reached[part].any():
                return view, mask
            more = max(margin, (view.seen.rows - core.rows) // 4)
            view = CellView(self.cells, view.seen.widened(more), self.chosen)


def _wide(values: NDArray) -> NDArray:
    """Values of cells of the ground for the cells in them."""
    return np.repeat(np.repeat(values, GROUND_CELLS, axis=0), GROUND_CELLS, axis=1)


def fill_gaps(z: NDArray, reach: int) -> NDArray:
    """Values where there are none (NaN), from the nearest along rows and columns, weighed by one over the distance.

    Two that lie opposite give what a line between them does, so a slope goes on below a building. What lies farther
    than `reach` cells does not count: the surroundings of a place decide, whatever the extent of the array.
    """
    total, weight = np.zeros(z.shape), np.zeros(z.shape)
    for turned in (np.s_[:, :], np.s_[:, ::-1]):
        for values, sums, weights in ((z, total, weight), (z.T, total.T, weight.T)):
            values, place = values[turned], np.arange(values.shape[1])
            last = np.maximum.accumulate(np.where(np.isnan(values), -1, place), axis=1)
            away = place - last
            near = (last >= 0) & (away > 0) & (away <= reach)
            sums[turned] += np.where(
                near, np.take_along_axis(values, last, axis=1) / np.maximum(away, 1), 0.0
            )
            weights[turned] += np.where(near, 1.0 / np.maximum(away, 1), 0.0)
    return np.where(np.isnan(z) & (weight > 0.0), total / np.maximum(weight, 1e-12), z)
