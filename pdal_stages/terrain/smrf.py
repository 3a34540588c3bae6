"""The simple morphological filter [P13], step by step; see :mod:`.heights`.

Cells of a minimum grid are told apart into ground and objects, surfaces are fitted through the
ground. Every step that looks far away works on a raster. In tiles the cells are classified once for
each block of a grid of blocks, from the lowest points of cells, and tiles join the blocks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ..base.grid import GridWindow
from . import regain as regaining
from . import wide_roofs
from .cells import HOLE
from .filter_options import FilterOptions
from .low_outliers import find_low_outliers, outlier_reach
from .minimum_grid import CellMeans, GroundPoints, ground_means, minimum_grid
from .openings import FILL_RINGS, fill_holes, objects_of, openings_of
from .steps import POINTS, Chain, FilterStep, Run
from .surface import GroundRaster, cells_around, fit_surface, heights_above
from .surface import reach as planes_reach
from .wide_roofs import level_below_roofs

# Names of steps.
MINIMUM_GRID = "minimum_grid"
LOW_OUTLIERS = "low_outliers"
OPENINGS = "openings"
WIDE_ROOFS = "wide_roofs"
GIVEN_GROUND = "given_ground"
PROVISIONAL = "provisional_surface"
GROUND_POINTS = "ground_points"
SURFACE = "surface"
#: Cells around its own that a point's height is blended of.
_BLEND = 1


def cell_steps(options: FilterOptions) -> Chain:
    """Return the steps that classify the cells of the minimum grid into ground and objects."""
    radii = [options.radius, *options.requested_radii]
    wide = wide_roofs.RULES.reach(options.cell, options.window)
    steps = [
        *_measured_cells(options),
        _openings_step(partial(_open, options=options), radii),
        FilterStep(
            WIDE_ROOFS,
            partial(_remove_wide_roofs, options=options),
            {OPENINGS: 0, POINTS: wide},
            _floor,
            wide_roofs.RULES.gap(options.cell),
        ),
    ]
    for number in range(1, regaining.ROUNDS + 1):
        reach = regaining.reach(options)
        run = partial(_regain, options=options)
        steps.append(FilterStep(f"round_{number}", run, {steps[-1].name: reach}, _ground, reach))
    return Chain(tuple(steps))


def given_steps(options: FilterOptions, ground: NDArray[np.bool_]) -> Chain:
    """Return the steps that measure heights above points (n,) that are ground."""
    steps = [
        FilterStep(GIVEN_GROUND, partial(_take, ground=ground, options=options), {POINTS: 0}, _mean)
    ]
    if options.openings:
        run = partial(_open_requested, options=options)
        steps = [*_measured_cells(options), _openings_step(run, options.requested_radii), *steps]
    return Chain(tuple(steps)) + surface_steps(options, GIVEN_GROUND, given=True)


def surface_steps(
    options: FilterOptions,
    ground: str,
    means: CellMeans | None = None,
    given: bool = False,
) -> Chain:
    """Return the steps from cells that are ground to the surface that heights are measured from.

    Parameters
    ----------
    options : FilterOptions
    ground : str
        The step that makes the cells.
    means : CellMeans, optional
        Means of the ground points of the cells, where they are known.
    given : bool
        Whether the cells are those of given ground, which the surface goes through.
    """
    judge = partial(_judge, options=options, means=means, given=given)
    near, far = planes_reach(options.near_levels), planes_reach(options.far_levels)
    means_reach = {} if given else {GROUND_POINTS: far}
    return Chain((
        _surface_step(PROVISIONAL, options.near_levels, {ground: near}, options.threads),
        FilterStep(GROUND_POINTS, judge, {PROVISIONAL: _BLEND, POINTS: 0}, _mean, _BLEND),
        _surface_step(SURFACE, options.far_levels, {ground: far, **means_reach}, options.threads),
    ))  # fmt: skip


def ground_filter(options: FilterOptions) -> Chain:
    """Return all steps from points to the surface through the ground that the filter finds."""
    cells = cell_steps(options)
    return cells + surface_steps(options, cells.last)


def reach_of_points(options: FilterOptions) -> int:
    """Return within how many cells points can change a point's results."""
    return ground_filter(options).reach() + _BLEND


def reach_of_given(options: FilterOptions) -> int:
    """Return within how many cells points can change heights above given ground and openings."""
    return given_steps(options, np.zeros(0, bool)).reach() + _BLEND


def reach_of_cells(options: FilterOptions, first: str = GROUND_POINTS) -> int:
    """Return within how many cells around points it must be known what a step made."""
    return ground_filter(options).reach(first) + _BLEND


# ---- what the steps do ---------------------------------------------------------------------------


def holes(window: GridWindow) -> GroundRaster:
    """Return a raster of a window before the first step, without anything."""
    nothing, nowhere = np.broadcast_to(HOLE, window.shape), np.zeros(3)
    ground = np.broadcast_to(False, window.shape)
    place = np.broadcast_to(nowhere, (*window.shape, 3))
    return GroundRaster(window, nothing, place, ground, nothing, {})


def _measured_cells(options: FilterOptions) -> list[FilterStep]:
    """Return the steps to a minimum grid without low outliers."""
    cell = options.cell

    def lowest(points: GroundPoints, raster: GroundRaster, window: GridWindow) -> GroundRaster:
        return minimum_grid(points, raster.window, cell)

    def without_outliers(_: GroundPoints, raster: GroundRaster, window: GridWindow) -> GroundRaster:
        outlier = find_low_outliers(raster.lowest, cell, options.threads)
        heights = np.where(outlier, HOLE, raster.lowest)
        return replace(raster, lowest=heights, floor=heights, ground=raster.ground & ~outlier)

    far = outlier_reach(cell)
    return [
        FilterStep(MINIMUM_GRID, lowest, {POINTS: 0}, _lowest),
        FilterStep(LOW_OUTLIERS, without_outliers, {MINIMUM_GRID: far}, _lowest, far),
    ]


def _openings_step(run: Run, radii: list[int]) -> FilterStep:
    """Return the step that opens the minimum grid, which looks as far as the widest window."""
    radius = max(radii)
    reach = 2 * radius + 2 * FILL_RINGS
    return FilterStep(OPENINGS, run, {LOW_OUTLIERS: reach}, _floor, radius + 2 * FILL_RINGS)


def _surface_step(
    name: str, levels: int, reach: Mapping[str, int], threads: int | None
) -> FilterStep:
    """Return the step that fits a surface through ground where points are."""

    def fit(points: GroundPoints, raster: GroundRaster, window: GridWindow) -> GroundRaster:
        near = window.padded(_BLEND).intersect(raster.window)
        needed = cells_around(raster.window, near, points.column, points.row)
        return replace(raster, surface=fit_surface(raster, levels, needed, threads))

    return FilterStep(name, fit, reach, _height, planes_reach(levels))


def _open(
    points: GroundPoints, raster: GroundRaster, window: GridWindow, options: FilterOptions
) -> GroundRaster:
    """Find the cells that openings with growing windows lower: objects."""
    radii = options.radius, options.requested_radii
    objects, floor, opened = objects_of(
        raster.lowest, options.cell, options.slope, *radii, options.threads
    )
    return replace(raster, ground=raster.ground & ~objects, floor=floor, opened=opened)


def _open_requested(
    points: GroundPoints, raster: GroundRaster, window: GridWindow, options: FilterOptions
) -> GroundRaster:
    """Make the openings above which heights are requested."""
    radii = {*options.requested_radii}
    opened = openings_of(fill_holes(raster.lowest), radii, options.threads)
    return replace(raster, opened=dict(opened))


def _remove_wide_roofs(
    points: GroundPoints, raster: GroundRaster, window: GridWindow, options: FilterOptions
) -> GroundRaster:
    """Turn ground into objects where it stands high above the land around, as roofs do."""
    use = np.flatnonzero(points.use)
    land = level_below_roofs(
        points.column[use], points.row[use], points.z[use], raster.window, options.cell,
        options.window,
    )  # fmt: skip
    roofs, floor = raster.ground.copy(), raster.floor.copy()
    roofs[roofs] = raster.lowest[roofs] - land[roofs] > wide_roofs.RULES.min_height_m
    floor[roofs] = land[roofs]
    return replace(raster, ground=raster.ground & ~roofs, floor=floor)


def _regain(
    points: GroundPoints, raster: GroundRaster, window: GridWindow, options: FilterOptions
) -> GroundRaster:
    """Turn cells among ground, and near the provisional surface, into ground again."""
    return replace(raster, ground=regaining.regain(raster, window, options))


def _take(
    points: GroundPoints,
    raster: GroundRaster,
    window: GridWindow,
    ground: NDArray[np.bool_],
    options: FilterOptions,
) -> GroundRaster:
    """Take the means of given ground (n,) for the ground of cells."""
    held, place = ground_means([(points, ground)], options.cell, raster.window)
    heights = np.where(held, place[..., 2], HOLE).astype(np.float32)
    return replace(raster, lowest=heights, floor=heights, ground=held, place=place)


def _judge(
    points: GroundPoints,
    raster: GroundRaster,
    window: GridWindow,
    options: FilterOptions,
    means: CellMeans | None,
    given: bool,
) -> GroundRaster:
    """Tell which points are ground, by the provisional surface; take their means for cells."""
    assert raster.surface is not None
    x, y, z, _, _, row = points
    above = heights_above(x, y, z, row, raster.surface, options.cell, options.threads)
    is_ground = options.is_ground(points.use, *above)
    if options.judged:
        raster = replace(raster, judged=np.stack([above[0], options.tolerance(above[1])]))
    if given:
        return replace(raster, is_ground=is_ground, surface=None)
    held, place = means or ground_means([(points, is_ground)], options.cell, raster.window)
    return replace(raster, ground=held, place=place, is_ground=is_ground, surface=None)


# ---- what they show ------------------------------------------------------------------------------


def _lowest(raster: GroundRaster) -> NDArray[np.float32]:
    """Return the heights (h, w) of the lowest points of cells."""
    return raster.lowest


def _floor(raster: GroundRaster) -> NDArray[np.float32]:
    """Return the heights (h, w) of cells and, of objects, of what lies below."""
    return raster.floor


def _ground(raster: GroundRaster) -> NDArray[np.float32]:
    """Return the heights (h, w) of the lowest points of cells that are ground, else NaN."""
    return np.where(raster.ground, raster.lowest, np.float32(np.nan))


def _mean(raster: GroundRaster) -> NDArray[np.float64]:
    """Return the mean heights (h, w) of the ground points of cells; NaN where there are none."""
    return np.where(raster.ground, raster.place[..., 2], np.nan)


def _height(raster: GroundRaster) -> NDArray[np.float64]:
    """Return the heights (h, w) of the surface in the middle of cells; NaN away from points."""
    assert raster.surface is not None
    rows, columns = raster.window.slices_in(raster.surface.window)
    return raster.surface.planes(rows)[:, columns, 0]
