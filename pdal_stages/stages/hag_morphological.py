"""``filters.hag_morphological``: height above ground of a morphological filter [P13]."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..base.asprs import TERRAIN
from ..base.dimensions import GROUND, HEIGHT, SLOPE, Dimension, is_height, opening
from ..base.errors import NoTerrainError
from ..base.files import check_writable
from ..base.geotiff import rasterio, write_geotiff
from ..base.grid import GridWindow
from ..terrain.cells import HIGHEST
from ..terrain.filter_options import FilterOptions, Keep
from ..terrain.ground_blocks import (
    BLOCK_SIDE,
    GroundCells,
    cells_near,
    cells_of_block,
    reach_near_cells,
    reach_of_block,
    reduced_points,
)
from ..terrain.heights import filtered_ground, spread
from ..terrain.smrf import reach_of_cells, reach_of_given, reach_of_points
from ..terrain.wide_roofs import lowest_of_coarse_cells
from .base import HEIGHTS_OUTSIDE, Blocks, FarReaching, StageContext, inside_block
from .options import Selection, ignore_option, option
from .points import Points

#: The options of the filter.
_FILTER = ("cell", "slope", "window", "threshold", "scalar", "openings")


class HagMorphological(FarReaching, settings=FilterOptions):
    """Measure heights above the ground that a simple morphological filter (SMRF) finds."""

    type = "filters.hag_morphological"
    summary = "Height above ground found by a simple morphological filter (SMRF)"
    source = (
        "after Pingel, Clarke, McBride 2013 (SMRF), ISPRS Journal of Photogrammetry and Remote "
        "Sensing 77, 21-30"
    )
    algorithm_version = 6
    where_help = HEIGHTS_OUTSIDE
    in_models = (*_FILTER, "ignore", "ground", "terrain_slope", "given_ground", "where")
    cell: float
    openings: list[float]
    ignore: Selection = ignore_option("Points that are not ground but still receive heights")
    ground: bool = option(
        "boolean", False, "Also write Ground: 1 where the filter calls the point ground, else 0"
    )
    terrain_slope: bool = option("boolean", False, "Also write Slope: the terrain's, in degrees")
    given_ground: bool = option(
        "boolean",
        False,
        "Points of the classes 2, 9 and 11 (ground, water, road) are the ground: nothing is "
        "filtered, heights are measured from them alone, and Ground is 1 for them and for others "
        "that are as near to the surface as threshold and scalar say",
    )

    keep_rasters: str | None = option(
        "folder",
        None,
        "Write the raster that each step of the filter makes to GeoTIFF files in folders of this "
        "one (extra raster)",
    )

    def check(self) -> None:
        """Refuse options that contradict each other, and a folder that cannot be written."""
        if self.keep_rasters is not None:
            rasterio()
            folder = Path(self.keep_rasters)
            check_writable(folder / "x.tif" if folder.is_dir() else folder, "raster")
        self._filter  # noqa: B018  (it refuses options that contradict each other)

    @cached_property
    def _filter(self) -> FilterOptions:
        return FilterOptions(
            **{name: self.options[name] for name in _FILTER},
            slope_too=self.terrain_slope,
            threads=self.threads,
        )

    def written_dimensions(self) -> Sequence[Dimension]:
        """Return the dimensions that are written."""
        ground, slope = [GROUND] if self.ground else [], [SLOPE] if self.terrain_slope else []
        return [HEIGHT, *ground, *slope, *map(opening, self.openings)]

    def reads(self) -> list[str]:
        """Return the dimensions that the points must have."""
        return ["Classification"] if self.given_ground else []

    def halo_m(self) -> float:
        """Return how far around a tile points change its results, in meters."""
        reach = reach_of_given if self.given_ground else reach_of_points
        return reach(self._filter) * self.cell

    def blocks(self) -> Blocks | None:
        """Return the blocks of the raster; a point's height depends on cells alone."""
        if self.given_ground:
            return None
        cell = self.cell
        reach = (reach_of_block(self._filter) + 1) * cell
        return Blocks(BLOCK_SIDE * cell, reach, reach_of_cells(self._filter) * cell, 2 * cell, cell)

    def reduce_points(self, points: Points) -> dict[str, NDArray[np.float64]]:
        """Return the lowest points that blocks around need, and the points inside each block."""
        x, y, z = points.axes
        usable = points.usable(self.ignore)
        lowest, inside = reduced_points(x, y, z, usable, self._filter)
        return {
            "around": lowest,
            **{inside_block(block): xyz for block, xyz in inside.items()},
        }

    def compute_block(
        self,
        far_points: NDArray[np.float64],
        inside: Iterable[NDArray[np.float64]],
        block: tuple[int, int],
    ) -> dict[str, NDArray]:
        """Compute the cells of a block, in squares."""
        return cells_of_block(far_points, block, self._filter, inside, bool(self.keep_rasters))

    @property
    def reach_near_m(self) -> float:
        """Return how far around points :meth:`cells_near` needs others, not only far ones."""
        return reach_near_cells(self._filter) * self.cell

    def ground_candidates(self, points: Points) -> NDArray[np.float64]:
        """Return the coordinates (3, n), in meters, of the points that may be ground."""
        use = points.usable(self.ignore) & (np.abs(points.axes[2]) < HIGHEST)
        return np.stack([axis[use] for axis in points.axes])

    def reduce_far(self, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the points (m, 3) that stand for candidates (3, n) far away."""
        return lowest_of_coarse_cells(candidates.T, self.cell)

    def cells_near(
        self,
        candidates: NDArray[np.float64],
        far: NDArray[np.float64],
        places: NDArray[np.float64],
        reach_m: float,
    ) -> list[dict[str, NDArray]]:
        """Compute blocks for heights near places (:func:`..terrain.ground_blocks.cells_near`)."""
        return [*cells_near(candidates, far, places, reach_m, self._filter)]

    def _write_rasters(self, points: Points) -> Keep | None:
        """Return a function that writes rasters of steps to files, in the units of the points."""
        if self.keep_rasters is None:
            return None
        folder, cell = Path(self.keep_rasters), self.cell / points.units.horizontal

        def write(name: str, window: GridWindow, values: NDArray[np.float32]) -> None:
            file = f"{window.left}_{window.bottom}_{window.width}x{window.height}.tif"
            corner = window.left * cell, window.bottom * cell
            heights = (values / points.units.vertical).astype(np.float32)
            write_geotiff(folder / name / file, heights, corner, cell, points.wkt)

        return write

    def run(self, points: Points, context: StageContext) -> dict[str, NDArray]:
        """Find the ground, or take the given one, and compute heights above it."""
        usable = points.usable(self.ignore)
        wanted = points.wanting("HeightAboveGround", context.created_before)
        all_wanted = bool(wanted.all())
        ground = usable & np.isin(points.class_codes, TERRAIN) if self.given_ground else None
        if ground is not None and not ground.any():
            raise NoTerrainError(
                "no ground is given: none of the points has class 2, 9 or 11",
                found=f"{points.count:,} points",
                cure="Classify the ground first, or let it be found: without 'given_ground' "
                "(classify: --ground found)",
            )
        observer = context.observer
        keep = self._write_rasters(points) if observer is None else observer.see_raster
        columns = filtered_ground(
            *(points.axes if all_wanted else [axis[wanted] for axis in points.axes]),
            mask=usable if all_wanted else usable[wanted],
            **{**vars(self._filter), "keep": keep, "judged": observer is not None},
            cells=None if context.blocks is None else GroundCells(context.blocks),
            figures=points.report.figures,
            ground=ground if ground is None or all_wanted else ground[wanted],
        )
        if observer is not None:
            each = columns.items()
            observer.see_heights({name: spread(v, wanted, points.count) for name, v in each})
        out = {}
        for name in self.creates():
            values = columns.pop(name)
            if is_height(name) and points.units.vertical != 1.0:
                values = values / points.units.vertical
            # As PDAL will have it; a copy more of each would be the most that this stage holds.
            out[name] = values.astype(points.arrays[name].dtype, copy=False)
            if not all_wanted:
                out[name] = np.array(points.arrays[name])
                out[name][wanted] = values
        return out
