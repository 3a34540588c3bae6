"""Height above a coarse terrain: the minima of a grid, interpolated [W18 section 3.2].

The terrain is the lowest point of each cell of a coarse grid, interpolated bilinearly between cell
centers and evaluated on a fine grid; a point's height is its z minus the value of the fine cell it
falls in. Both grids are anchored to absolute coordinates, so every tile of a survey sees the same
cells. No raster is held: one stray coordinate costs one cell.

[W18] Weinmann, Blomley, Weinmann, Jutzi (2018), Investigations on the potential of binary and
multi-class classification for object extraction from airborne laser scanning point clouds, DGPF.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..base import checks
from ..base.errors import NoTerrainError, OptionError
from ..base.grid import cell_keys, cell_numbers, places_among
from ..base.json_types import JsonObject
from .cells import columns, usable

#: Side in meters of the cells whose lowest points form the terrain [W18 section 3.2].
CELL_M = 20.0
#: Side in meters of the cells that it is interpolated to.
RESOLUTION_M = 0.5


def _filled(
    keys: NDArray[np.int64], minima: NDArray[np.float64], wanted: NDArray[np.int64]
) -> tuple[NDArray[np.float64], int, float]:
    """Return the values of cells; empty ones from the filled ones about as near as the nearest.

    Also how many were empty, and the largest distance to a filled one, in cells. Weights are one
    over the fourth power of the distance between cell centers. [W18] does not say what becomes of
    empty cells.
    """
    place, there = places_among(keys, wanted)
    values, empty, farthest = minima[place], np.flatnonzero(~there), 0.0
    if empty.size:
        from scipy.spatial import cKDTree  # most clouds have no gaps: not loaded at start

        filled_at, wanted_at = _places(keys), _places(wanted[empty])
        tree = cKDTree(filled_at)
        nearest = tree.query(wanted_at)[0]
        # All filled cells within reach of the nearest one: a set, so the outcome does not depend
        # on how a search tree orders equal distances.
        for at, center, radius in zip(empty, wanted_at, nearest + _FILL, strict=True):
            near = np.sort(tree.query_ball_point(center, radius))
            weight = 1.0 / ((filled_at[near] - center) ** 2).sum(axis=1) ** 2
            values[at] = np.dot(weight, minima[near]) / weight.sum()
        farthest = float(nearest.max())
    return values, int(empty.size), farthest


#: An empty cell is filled from those at most this much farther away than the nearest one, in cells.
#: Not tuned.
_FILL = 1.5


def _corners(x, y, cell: float, resolution: float):
    """Return keys (4, n) of the coarse cells around fine cells, and where between these lie."""
    u, v = ((np.floor(axis / resolution) + 0.5) * (resolution / cell) - 0.5 for axis in (x, y))
    i, j = cell_numbers(u, 1.0), cell_numbers(v, 1.0)
    return np.array([cell_keys(i + a, j + b) for b in (0, 1) for a in (0, 1)]), u - i, v - j


def _places(keys: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the columns and rows (n, 2) of keys."""
    return np.column_stack([(keys & 0xFFFFFFFF) - 2**31, keys >> 32]).astype(np.float64)


def hag_minima(
    x: ArrayLike,
    y: ArrayLike | None = None,
    z: ArrayLike | None = None,
    *,
    cell: float = CELL_M,
    resolution: float = RESOLUTION_M,
    mask: ArrayLike | None = None,
    wanted: ArrayLike | None = None,
    figures: JsonObject | None = None,
) -> NDArray[np.float64]:
    """Compute the height of every point above the coarse terrain of the cloud [W18 section 3.2].

    Parameters
    ----------
    x, y, z : array_like, shape (n,)
        Coordinates in one unit, that of `cell` and `resolution`; or `x` alone, of shape (n, 3).
    cell, resolution : float
        Sides of the coarse cells whose lowest points form the terrain, and of the fine ones.
    mask, wanted : array_like of bool, shape (n,), optional
        Points that may form the terrain, e.g. all but noise; points whose heights are wanted.
    figures : dict, optional
        Receives ``cells`` (with points), ``interpolated_cells`` (empty ones that were needed),
        ``farthest_fill`` (largest distance of these to a filled one), ``unused_points``.

    Returns
    -------
    ndarray of float64, shape (n,)
        z minus terrain; NaN where a coordinate is not finite, and for points that are not wanted.

    Raises
    ------
    OptionError, StageError
        For wrong sizes and shapes, and where no point may form the terrain.
    """
    check_sizes(cell, resolution)
    x, y, z = columns(x, y, z)
    use, rows = usable(x, y, z, mask=mask), usable(x, y, mask=wanted)
    key = cell_keys(cell_numbers(x[use], cell), cell_numbers(y[use], cell))
    keys, number = np.unique(key, return_inverse=True)
    minima = np.full(len(keys), np.inf)
    np.minimum.at(minima, number, z[use])
    counts = {} if figures is None else figures
    counts |= {"cells": len(keys), "interpolated_cells": 0, "farthest_fill": 0.0}
    counts["unused_points"] = int(np.count_nonzero(~use))
    out = np.full(x.shape, np.nan)
    if not rows.any():
        return out
    if not len(keys):
        raise NoTerrainError(
            "no terrain: none of the points may form one",
            found=f"{x.size:,} points, all of them not finite, noise, or outside 'where'",
            cure="Relax 'ignore' or 'where'",
        )
    corners, s, t = _corners(x[rows], y[rows], cell, resolution)
    needed, place = np.unique(corners, return_inverse=True)
    values, counts["interpolated_cells"], farthest = _filled(keys, minima, needed)
    counts["farthest_fill"] = farthest * cell
    south, north = (a + (b - a) * s for a, b in values[place.reshape(2, 2, -1)])
    out[rows] = z[rows] - (south + (north - south) * t)
    return out


def terrain_reach(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    forms: NDArray[np.bool_],
    wanted: NDArray[np.bool_],
    box: Sequence[float],
    cell: float,
    resolution: float,
) -> float:
    """Return how far around a box all lies that decides the terrain under the wanted points.

    A height takes the four coarse cells around a point; an empty one is filled from all cells
    within its nearest filled one's distance and 1.5 cells. All of these must be known whole. What
    is found with too few points bounds the true reach from above. `forms` and `wanted` (n,) are the
    points that form the terrain, and those whose heights matter; the box is (min x, min y, max x,
    max y). In the unit of x and y; 0 where the box suffices.
    """
    from scipy.spatial import cKDTree

    if not wanted.any():
        return 0.0
    if not forms.any():  # farther than what was read
        beyond = max(box[0] - x.min(), box[1] - y.min(), x.max() - box[2], y.max() - box[3], 0.0)
        return float(beyond + box[2] - box[0])
    filled = _places(
        np.unique(cell_keys(cell_numbers(x[forms], cell), cell_numbers(y[forms], cell)))
    )
    cells = _places(np.unique(_corners(x[wanted], y[wanted], cell, resolution)[0]))
    nearest = cKDTree(filled).query(cells)[0]
    radius = np.where(nearest > 0, nearest + _FILL, 0.0)[:, None] + 0.5  # whole cells around it
    center = cells + 0.5
    below = np.asarray(box[:2]) - (center - radius) * cell
    above = (center + radius) * cell - np.asarray(box[2:])
    return float(max(0.0, below.max(), above.max()))


def check_sizes(cell: float, resolution: float) -> None:
    """Refuse sizes that are not positive, and fine cells that are larger than coarse ones."""
    for name, value in (("cell", cell), ("resolution", resolution)):
        checks.number(f"'{name}'", value, 0, above=True)
    if resolution > cell:
        raise OptionError(
            "'resolution' must not be larger than 'cell'",
            found=f"resolution {resolution:g}, cell {cell:g}",
            cure="Swap them, or lower 'resolution'",
        )
