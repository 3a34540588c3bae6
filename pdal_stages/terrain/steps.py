"""Steps of the ground filter: what each makes of a raster, and how far around a cell it looks.

What must be read around a tile, a block or a piece follows from the steps alone: a chain adds up
how far they look (:meth:`Chain.reach`), and needs no cell beyond (:meth:`Chain.run`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..base.grid import GridWindow
from .filter_options import Keep
from .minimum_grid import GroundPoints
from .surface import GroundRaster

#: What steps look at that read no earlier step.
POINTS = "points"
#: Makes more of a raster: at least of the cells of a window of it, which alone matter afterwards.
Run = Callable[[GroundPoints, GroundRaster, GridWindow], GroundRaster]


@dataclass(frozen=True)
class FilterStep:
    """A step of the ground filter; distances in cells, along either axis."""

    name: str
    run: Run
    #: Of each earlier step that this one reads, or of POINTS, the distance within which a change
    #: there changes what this step makes of a cell: {"openings": 3} reads that raster up to three
    #: cells away.
    reach: Mapping[str, int]
    #: What it made, as a raster (h, w): NaN or HOLE where that is nothing.
    shows: Callable[[GroundRaster], NDArray]
    #: Across how many cells without points it sees from one point to another.
    gap: int = 0


@dataclass(frozen=True)
class Chain:
    """Steps, each after those that it reads."""

    steps: tuple[FilterStep, ...]

    def __add__(self, more: Chain) -> Chain:
        """Return the chain of both."""
        return Chain(self.steps + more.steps)

    @property
    def last(self) -> str:
        """Return the name of the last step."""
        return self.steps[-1].name

    @property
    def gap(self) -> int:
        """Return across how many cells without points any step sees."""
        return max(step.gap for step in self.steps)

    def reach(self, first: str = POINTS, last: str = "") -> int:
        """Return how far away what one step made can change a cell of a later one, in cells.

        That is the longest way between both; by default from the points to whatever is farthest.
        """
        away = {first: 0}
        for step in self.steps:
            ways = [away[name] + cells for name, cells in step.reach.items() if name in away]
            if ways:
                away[step.name] = max(ways)
        return away.get(last, 0) if last else max(away.values())

    def run(
        self,
        points: GroundPoints,
        raster: GroundRaster,
        wanted: GridWindow | None = None,
        keep: Keep | None = None,
    ) -> GroundRaster:
        """Run the steps; return the `wanted` cells as the last one leaves them.

        Each step gets the cells alone that it and those after it still look at.
        """
        for step in self.steps:
            window = raster.window
            if wanted is not None:
                window = wanted.padded(self.reach(step.name, self.last)).intersect(window)
            raster = step.run(points, raster, window).cut(window)
            if keep is not None:
                values = np.where(np.isfinite(step.shows(raster)), step.shows(raster), np.nan)
                keep(step.name, window, values.astype(np.float32))
        return raster
