"""The ground raster of ground that is given: surveyed, edited, or found by another program."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.grid import GridWindow
from .cells import HOLE
from .low_outliers import outlier_reach
from .openings import FILL_RINGS, fill_holes, openings_of
from .pieces import patches
from .smrf import (
    FAR,
    NEAR,
    CellMeans,
    FilterOptions,
    GroundPoints,
    add_ground,
    means_of,
    minimum_grid,
)
from .surface import GroundRaster
from .surface import reach as planes_reach


def reach_of_given(options: FilterOptions) -> int:
    """Return how far away, in cells, points can change a point's height above given ground, or an
    opening's."""
    surfaces = sum(planes_reach(options.levels(block)) for block in (NEAR, FAR))
    if not options.opening_radii:
        return surfaces + 4
    openings = 2 * max(options.opening_radii) + 2 * FILL_RINGS + outlier_reach(options.cell)
    return max(surfaces, openings) + 4


def given_pieces(
    points: GroundPoints, options: FilterOptions, ground: NDArray[np.bool_]
) -> Iterator[tuple[Any, Any, GroundRaster, CellMeans]]:
    """Yield pieces of the cloud with the raster of the points (n,) that are `ground`.

    Numbers of the piece's points, which of them are its own, the raster, and the means of its
    ground points by cell.
    """
    margin = 2 + FILL_RINGS + max([0, *options.opening_radii])
    for of, own in patches(points.column, points.row, reach_of_given(options), options.link):
        part = points.some(of)
        window = GridWindow.enclosing(part.column, part.row).padded(margin)
        shape = window.height, window.width
        count, place = np.zeros(shape, np.int64), np.zeros((*shape, 3))
        add_ground(
            part.x, part.y, part.z, ground[of], part.column, part.row,
            options.cell, window.left, window.bottom, count, place,
        )  # fmt: skip
        held = means_of(count, place)
        heights = np.where(held, place[..., 2], HOLE).astype(np.float32)
        opened = _openings(part, options, window)
        yield of, own, GroundRaster(window, heights, place, held, heights, opened), (held, place)


def _openings(
    points: GroundPoints, options: FilterOptions, window: GridWindow
) -> dict[int, NDArray[np.float32]]:
    """Return radius in cells -> opening (h, w) of the minimum grid of all points, low outliers left
    out; meters."""
    if not options.opening_radii:
        return {}
    _, raster, _ = minimum_grid(points, window, options.cell)
    return dict(openings_of(fill_holes(raster), {*options.opening_radii}))
