"""``filters.hag_minima``: height above a coarse terrain of cell minima [W18 section 3.2]."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..base.dimensions import HEIGHT, Dimension
from ..terrain.minima import CELL_M, RESOLUTION_M, check_sizes, hag_minima, terrain_reach
from .base import HEIGHTS_OUTSIDE, Stage, StageContext
from .options import Selection, ignore_option, option
from .points import Points


class HagMinima(Stage):
    """Measure heights above the lowest points of large cells."""

    type = "filters.hag_minima"
    summary = "Height above a coarse terrain: the minima of a grid, interpolated"
    source = "[W18] section 3.2"
    open_ended = True  # an empty cell is filled from the nearest ones, however far away
    where_help = HEIGHTS_OUTSIDE
    in_models = ("cell", "resolution", "ignore", "where")
    cell: float = option(
        "number",
        CELL_M,
        "Side of the coarse cells whose lowest points form the terrain; more than half the width "
        "of the largest building",
        *(0.05, 10_000),
        unit="m",
    )
    resolution: float = option(
        "number", RESOLUTION_M, "Side of the fine cells of the terrain", 0.05, 10_000, unit="m"
    )
    ignore: Selection = ignore_option("Points that do not form the terrain but get heights")

    def check(self) -> None:
        """Refuse options that contradict each other."""
        check_sizes(self.cell, self.resolution)

    def written_dimensions(self) -> Sequence[Dimension]:
        """Return the dimensions that are written."""
        return (HEIGHT,)

    def halo_m(self) -> float:
        """Return how far around a tile points change its results, in meters."""
        # The centers of the four cells around a point are up to 1 cell away. One that is empty is
        # filled from cells within 1.5 cells of its nearest filled one, each of which must be known
        # whole: 4 cells where a cell beside it is filled. Otherwise `reach_of` asks for more.
        return 4.0 * self.cell

    def reach_of(self, points: Points, context: StageContext, box: Sequence[float]) -> float:
        """Return how far around a tile the points lie that decide its results, in meters."""
        used = context.used(points.arrays)
        if used is None:
            return 0.0
        x, y, _ = points.xyz.T
        return terrain_reach(
            x, y, points.usable(self.ignore), used, box, self.cell, self.resolution
        )

    def run(self, points: Points, context: StageContext) -> dict[str, NDArray]:
        """Compute heights above the minima."""
        x, y, z = points.xyz.T
        forms = points.usable(self.ignore)
        if points.mask is not None and not points.mask.any():  # which the report says
            return {}
        wanted = points.wanting("HeightAboveGround", context.created_before)
        heights = hag_minima(
            *(x, y, z),
            cell=self.cell,
            resolution=self.resolution,
            mask=forms,
            wanted=wanted,
            figures=points.report.figures,
        )
        height = np.array(points.arrays["HeightAboveGround"], np.float64)
        height[wanted] = heights[wanted] / points.units.vertical
        return {"HeightAboveGround": height}
