"""A window of the grid as rasters: heights, ground, roofs, and what objects need around it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache, cached_property

import numpy as np
import scipy
from numpy.typing import NDArray

from ..base.grid import GridWindow, split_keys
from . import crowns, roofs
from .attributes import ObjectCells
from .cells import GROUND_WIDTH, MM, Cells, Kind
from .results import ObjectSettings

# Values without a reason are not tuned.
#: Farthest that ground is interpolated from, meters: the middle of a building wider than twice this
#: has no ground.
GROUND_REACH = 120.0
#: Surroundings that decide about a place, meters, but for how far its building, span or deck goes.
MARGIN = GROUND_REACH + 2 * crowns.REACH
#: Farthest that a roof is extended into what a classifier took for leaves, meters.
ROOF_GROWTH = 3.0
#: Farthest that cells of a hole in a roof (dark or wet, without returns) lie from its rim, meters.
MAX_HOLE_DEPTH = 6.0
#: Empty cells around what a view holds, so that filters of roofs, which reach 2, see no edge.
EMPTY_RIM = 8
#: A cell and its eight neighbors.
NEIGHBORS = np.ones((3, 3), bool)


def pad_evenly(window: GridWindow, cells: int) -> GridWindow:
    """Return a window with `cells` more on every side, rounded up to whole cells of the ground."""
    return window.padded(cells + cells % GROUND_WIDTH)


def _width(kind: Kind) -> int:
    return GROUND_WIDTH if kind == Kind.GROUND else 1


def _occupied_window(parts: Mapping[Kind, Cells]) -> GridWindow:
    """Return the even window of the cells of all kinds (at least one) and an empty rim."""
    places = [np.stack(split_keys(part.key)[:2]) * _width(kind) for kind, part in parts.items()]
    low, high = (end(np.concatenate(places, axis=1), axis=1) for end in (np.min, np.max))
    low = (low - EMPTY_RIM) // GROUND_WIDTH * GROUND_WIDTH
    high = (high + EMPTY_RIM + 2 * GROUND_WIDTH) // GROUND_WIDTH * GROUND_WIDTH
    return GridWindow(*low.tolist(), *(high - low).tolist())


class CellView:
    """Rasters of the records in a window, cut to the part that holds any.

    Parameters
    ----------
    cells : Cells
        Records of the whole area.
    requested : GridWindow
        The window; all its numbers are even, so it holds whole cells of the ground.
    settings : ObjectSettings
    """

    def __init__(self, cells: Cells, requested: GridWindow, settings: ObjectSettings) -> None:
        self.cells, self.requested, self.settings = cells, requested, settings
        self._records = {
            kind: cells.in_window(kind, GridWindow(*(n // _width(kind) for n in requested)))
            for kind in Kind
        }
        self.window = requested.intersect(_occupied_window(self._records))
        self.indices, self.roof_or_deck = cache(self._indices), cache(self._roof_or_deck)

    def _indices(self, kind: Kind) -> NDArray[np.int32]:
        """Return a raster of a kind's indices of records, -1 for none; ground in wider cells."""
        left, bottom, width, height = (n // _width(kind) for n in self.window)
        key = self._records[kind].key
        column, row, _ = split_keys(key)
        raster = np.full((height, width), -1, np.int32)
        raster[row - bottom, column - left] = np.arange(len(key))
        return raster

    def _column(self, kind: Kind, name: str) -> NDArray[np.float64]:
        """Return a raster of one column of a kind's records; NaN where there are none."""
        values = self._records[kind].columns[name]
        return np.append(values.astype(np.float64), np.nan)[self.indices(kind)]

    def highest(self, kind: Kind) -> NDArray[np.float64]:
        """Return a raster of the highest point of a kind, meters; NaN where there is none."""
        return self._column(kind, "high") / MM

    @cached_property
    def ground(self) -> NDArray[np.float64]:
        """Raster of the height of the ground, meters; NaN where none is within reach."""
        mean = self._column(Kind.GROUND, "sum") / self._column(Kind.GROUND, "count") / MM
        return _repeat(fill_gaps(mean, round(GROUND_REACH / (self.cells.size * GROUND_WIDTH))))

    def _roof_or_deck(self, kind: Kind) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """Return the cells of decks, or of roofs, and their heights.

        Roofs are extended into vegetation that lies in their planes, and over holes without
        returns.
        """
        if kind != Kind.BUILDING:
            return roofs.roof_cells(self.highest(kind))
        settings, leaves = self.settings, self.highest(Kind.TREE)
        occupied = _repeat(self.indices(Kind.GROUND) >= 0) | ~np.isnan(leaves)
        occupied |= self.indices(Kind.OTHER) >= 0
        with np.errstate(invalid="ignore"):
            leaves[leaves - self.ground < settings.building_height] = np.nan
        thickness = leaves - self._column(Kind.TREE, "low") / MM
        high = roofs.extend_roofs(
            self.highest(Kind.BUILDING),
            leaves,
            thickness,
            settings.cell,
            round(ROOF_GROWTH / settings.cell),
        )
        high = np.where(high - self.ground < settings.building_height, np.nan, high)
        filled = roofs.fill_holes(high, occupied, round(MAX_HOLE_DEPTH / settings.cell))
        return roofs.roof_cells(filled)

    def ground_below(
        self, kind: Kind, core: GridWindow
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the keys (n,) of a kind's cells in a block, and the ground's height there."""
        place = self._slices(core)
        index, ground = self.indices(kind)[place], self.ground[place]
        inside = index >= 0
        return self._records[kind].key[index[inside]], ground[inside]

    def object_cells(self, kind: Kind, r: NDArray, c: NDArray, z: NDArray) -> ObjectCells:
        """Return the cells of an object at rows `r`, columns `c` of the view, at heights `z`."""
        columns, index = self._records[kind].columns, self.indices(kind)[r, c]

        def values(name: str, missing: float) -> NDArray:
            return np.where(index >= 0, columns[name][index], missing)

        return ObjectCells(
            row=r + self.window.bottom,
            column=c + self.window.left,
            z=z[r, c],
            low=values("low", np.nan) / MM,
            ground=self.ground[r, c],
            points=values("count", 0).astype(np.int64),
            reliability=values("reliability", 0.0),
            rated=values("rated", 0).astype(np.int64),
        )

    def widened_to_whole(
        self,
        core: GridWindow,
        mask_of: Callable[[CellView], NDArray[np.bool_]],
    ) -> tuple[CellView, NDArray[np.bool_]]:
        """Return a view in which all objects that reach into a block are whole, and its mask.

        Objects a cell apart, also at a corner, count as one.

        Parameters
        ----------
        core : GridWindow
            The block.
        mask_of : function of a view
            Returns the cells of objects.
        """
        margin, view = round(MARGIN / self.settings.cell), self
        while True:
            mask = mask_of(view)
            part, count = scipy.ndimage.label(scipy.ndimage.binary_dilation(mask, NEIGHBORS))
            reaches_core = np.zeros(count + 1, bool)
            reaches_core[part[view._slices(core)]] = True
            reaches_core[0] = False
            part[view._slices(pad_evenly(view.requested, -margin))] = 0
            if not reaches_core[part].any():
                return view, mask
            more = max(margin, (view.requested.height - core.height) // 4)
            view = CellView(self.cells, pad_evenly(view.requested, more), self.settings)

    def _slices(self, window: GridWindow) -> tuple[slice, slice]:
        return window.intersect(self.window).slices_in(self.window)


def _repeat(values: NDArray) -> NDArray:
    """Return a raster of cells of the ground as one of the smaller cells."""
    return np.repeat(np.repeat(values, GROUND_WIDTH, axis=0), GROUND_WIDTH, axis=1)


def fill_gaps(z: NDArray, reach: int) -> NDArray:
    """Fill cells without a value (NaN) from the nearest ones along rows and columns.

    Weights are 1 / distance. Two opposite values give what a line between them gives, so a slope
    continues below a building. Values farther than `reach` cells do not count: the surroundings of
    a place decide, whatever the extent of the array.
    """
    total, weight = np.zeros(z.shape), np.zeros(z.shape)
    for direction in (np.s_[:, :], np.s_[:, ::-1]):
        for values, sums, weights in ((z, total, weight), (z.T, total.T, weight.T)):
            values, place = values[direction], np.arange(values.shape[1])
            last = np.maximum.accumulate(np.where(np.isnan(values), -1, place), axis=1)
            away = place - last
            near = (last >= 0) & (away > 0) & (away <= reach)
            share = np.where(near, 1.0 / np.maximum(away, 1), 0.0)
            known = np.take_along_axis(values, last, axis=1) / np.maximum(away, 1)
            sums[direction] += np.where(near, known, 0.0)
            weights[direction] += share
    return np.where(np.isnan(z) & (weight > 0.0), total / np.maximum(weight, 1e-12), z)
