"""Roofs of buildings: their cells, their extension into vegetation, and holes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from ..base.jit import njit


@dataclass(frozen=True)
class RoofRules:
    """Thresholds of roofs; lengths in meters, areas in m2.

    Values without a reason are not tuned.
    """

    # Vegetation that belongs to a roof (`extend_roofs`)
    max_scatter: float = 0.12  #: standard deviation of a roof's heights from its plane
    plane_reach: float = 1.0  #: height from the vegetation up to which roof cells make its plane
    max_plane_distance: float = 0.2  #: of vegetation from that plane
    max_thickness: float = 0.5  #: between points of a cell: a roof is a surface, a crown is not
    max_slope: float = 2.0  #: rise per meter: 63 degrees
    # What the roof's rise across a cell adds to these, as a point lies anywhere in its cell
    scatter_in_cell: float = 0.09  #: times the rise squared; a uniform place has a variance of 1/12
    thickness_in_cell: float = 1.5  #: times the rise; along the diagonal of a cell it is 1.41
    offset_in_cell: float = 0.4  #: times the rise; from the middle to the edge of a cell it is 0.5
    # Holes without returns (`fill_holes`)
    level_tolerance: float = 1.0  #: of a hole's rim around its median height
    min_level_share: float = 0.65  #: cells of the rim within that tolerance


RULES = RoofRules()


@njit
def planes(z: NDArray, level: NDArray, size: float, reach: float) -> NDArray:
    """Fit a plane, by least squares, to the 5 x 5 cells around each cell.

    Parameters
    ----------
    z : (r, c) float64
        Heights, meters; NaN for none.
    level : (r, c) float64
        Height around which cells count, meters; NaN where no plane is wanted.
    size : float
        Side of a cell, meters.
    reach : float
        Farthest that a cell lies above or below the level, meters.

    Returns
    -------
    (4, r, c) float64
        Rise per meter east and north, height above `level` at the cell, and mean squared distance
        from the plane; NaN where cells are fewer than six, or in a row, and where there is no
        level.
    """
    out = np.full((4, *z.shape), np.nan)
    for r in range(z.shape[0]):
        for c in range(z.shape[1]):
            if np.isnan(level[r, c]):
                continue
            n, x, y, h, xx, yy, xy, xh, yh, hh = 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for i in range(max(r - 2, 0), min(r + 3, z.shape[0])):
                for j in range(max(c - 2, 0), min(c + 3, z.shape[1])):
                    d = z[i, j] - level[r, c]
                    if not abs(d) <= reach:
                        continue
                    u, v = (j - c) * size, (i - r) * size
                    n += 1
                    x += u
                    y += v
                    h += d
                    xx += u * u
                    yy += v * v
                    xy += u * v
                    xh += u * d
                    yh += v * d
                    hh += d * d
            if n < 6:
                continue
            xx, yy, xy = xx - x * x / n, yy - y * y / n, xy - x * y / n
            xh, yh, hh = xh - x * h / n, yh - y * h / n, hh - h * h / n
            det = xx * yy - xy * xy
            if det < 1e-3 * n * n * size**4:
                continue
            a, b = (xh * yy - yh * xy) / det, (yh * xx - xh * xy) / det
            out[:, r, c] = a, b, (h - a * x - b * y) / n, max(hh - a * xh - b * yh, 0.0) / n
    return out


def roof_cells(high: NDArray) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Return the cells of roofs and their heights, (r, c) each.

    Empty cells with at least seven of eight neighbors are filled, twice; parts one cell wide, a
    wall or a stray point, are left out.

    Parameters
    ----------
    high : (r, c) float64
        Highest point of a roof in each cell, meters; NaN for none.
    """
    for _ in range(2):
        high = _close(high)
    return scipy.ndimage.binary_opening(~np.isnan(high), np.ones((2, 2), bool)), high


def extend_roofs(
    high: NDArray, leaves: NDArray, thickness: NDArray, size: float, reach: int
) -> NDArray[np.float64]:
    """Return heights of roofs extended into vegetation that lies in their planes.

    Parameters
    ----------
    high, leaves : (r, c) float64
        Highest point of a roof, and of vegetation, in each cell, meters; NaN for none.
    thickness : (r, c) float64
        Height between the lowest and highest point of vegetation, meters.
    size : float
        Side of a cell, meters.
    reach : int
        Farthest extension, cells.
    """
    for _ in range(reach):
        empty = np.where(np.isnan(high), leaves, np.nan)
        east, north, above, scatter = planes(high, empty, size, RULES.plane_reach)
        steepness = east**2 + north**2
        rise = size * np.sqrt(steepness)
        added = scatter <= RULES.max_scatter**2 + RULES.scatter_in_cell * rise**2
        added &= steepness <= RULES.max_slope**2
        added &= thickness <= RULES.max_thickness + RULES.thickness_in_cell * rise
        added &= np.abs(above) - RULES.offset_in_cell * rise <= RULES.max_plane_distance
        if not added.any():
            break
        high = np.where(added, leaves, high)
    return high


def fill_holes(high: NDArray, occupied: NDArray, reach: int) -> NDArray[np.float64]:
    """Return heights of roofs with holes without returns filled: dark or wet roofs.

    A hole is filled where nearly all around it is roof, at nearly one height, and it does not
    reach the raster's edge.

    Parameters
    ----------
    high : (r, c) float64
        Highest point of a roof in each cell, meters; NaN for none.
    occupied : (r, c) bool
        Cells with ground, vegetation or other points.
    reach : int
        Farthest that a cell of a hole lies from its rim, cells.
    """
    out, empty = high.copy(), np.isnan(high) & ~occupied
    holes, count = scipy.ndimage.label(empty)
    depth = scipy.ndimage.maximum(
        scipy.ndimage.distance_transform_cdt(empty), holes, np.arange(count + 1)
    )
    beside_roof = np.zeros(count + 1, bool)
    beside_roof[holes[scipy.ndimage.binary_dilation(~np.isnan(high))]] = True
    beside_roof[0] = False
    for edge in (0, -1):
        beside_roof[holes[edge]] = beside_roof[holes[:, edge]] = False
    boxes = scipy.ndimage.find_objects(holes)
    for number in np.flatnonzero(beside_roof & (depth <= reach)).tolist():
        box = tuple(slice(axis.start - 1, axis.stop + 1) for axis in boxes[number - 1])
        hole = holes[box] == number
        rim = high[box][scipy.ndimage.binary_dilation(hole) & ~hole]
        level = np.nanmedian(rim) if not np.isnan(rim).all() else np.nan
        if np.mean(np.abs(rim - level) <= RULES.level_tolerance) >= RULES.min_level_share:
            out[box][hole] = level
    return out


def _close(high: NDArray) -> NDArray:
    """Return heights with empty cells of seven or eight neighbors set to the neighbors' mean."""
    known, kernel = ~np.isnan(high), np.ones((3, 3))
    count = scipy.ndimage.correlate(known.astype(np.float64), kernel, mode="constant")
    total = scipy.ndimage.correlate(np.where(known, high, 0.0), kernel, mode="constant")
    return np.where(~known & (count >= 7), total / np.maximum(count, 1), high)
