"""Roofs of buildings: their cells, extension and holes; buildings that touch; roof planes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from ..base.jit import njit
from ..terrain.components import number_sets


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
    # Buildings that touch (`building_parts`)
    roof_step: float = 1.0  #: height difference of neighboring cells of one roof, of any width
    border_reach: float = 1.0  #: height from a cell up to which others make its plane
    inside: int = 2  #: cells from the border inward: beyond rims and walls
    min_meeting_share: float = 0.34  #: border along which the roofs of one building meet
    # Roof planes (`roof_planes`)
    roof_reach: float = 1.5  #: height from a cell up to which others make its plane
    smooth_scatter: float = 0.25  #: standard deviation of cells' heights from their plane
    max_bend: float = 0.2  #: difference of the gradients of neighboring cells, rise per meter
    min_plane_area: float = 3.0


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


def connected(mask: NDArray, step: float, *values: NDArray) -> NDArray[np.int64]:
    """Return labels of connected cells, from 0 by their first cells; -1 outside the mask.

    Two cells side by side are connected where their values differ, in sum, by at most `step`.
    """
    label = np.full(mask.shape, -1, np.int64)
    count = int(np.count_nonzero(mask))
    label[mask] = np.arange(count)
    pairs = []
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        with np.errstate(invalid="ignore"):
            joined = mask[a] & mask[b] & ~(sum(np.abs(v[a] - v[b]) for v in values) > step)
        pairs.append((label[a][joined], label[b][joined]))
    a, b = np.concatenate(pairs, axis=1)
    label[mask] = _sets(a, b, count)
    return label


def _sets(a: NDArray, b: NDArray, count: int) -> NDArray[np.int64]:
    """Return the set of each of `count` members after pairs are joined, by first members."""
    label = np.empty(count, np.int64)
    number_sets(a, b, label)
    return label


def building_parts(
    mask: NDArray[np.bool_], z: NDArray, *, step: float, smallest: int
) -> NDArray[np.int64]:
    """Return labels of buildings, or of decks, from 0 by their first cells; -1 outside.

    Connected cells whose heights differ by at most `RoofRules.roof_step` are a roof. Roofs of
    fewer than `smallest` cells (dormers, chimneys) join the neighbor with the longest common
    border. Then roofs are of one building where their heights, measured beyond rims and walls,
    differ by at most `step` along at least a third of their border. A `step` of 0 separates
    nothing.
    """
    if step <= 0:
        return connected(mask, np.inf, z)
    label = connected(mask, min(RULES.roof_step, step), z)
    while True:
        a, b, length, _ = _borders(label)
        size = np.bincount(label[label >= 0])
        a, b, length = np.r_[a, b], np.r_[b, a], np.r_[length, length]
        order = np.lexsort((b, -length, a))  # of equal borders the part that begins first
        order = order[size[a[order]] < smallest]
        small, first = np.unique(a[order], return_index=True)
        if not len(small):
            break
        label = _join(label, small, b[order][first])
    z = np.where(mask, z, np.nan)
    # Of a size of 1, so slopes are the rise per cell, as `_border_height` takes them.
    surface = z, *planes(z, z, 1.0, RULES.border_reach)[:3]
    while True:
        a, b, length, meeting = _borders(label, surface, step)
        meets = meeting >= RULES.min_meeting_share * length
        if not meets.any():
            return label
        label = _join(label, a[meets], b[meets])


def _borders(
    label: NDArray[np.int64], surface: tuple[NDArray, ...] | None = None, step: float = np.inf
) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Return pairs of neighboring labels, the lower first, and the length of their border.

    The last array is the length along which heights of `surface` differ by at most `step`.
    """
    pairs, meeting = [], []
    for down, right in ((1, 0), (0, 1)):
        lower, upper = label[: len(label) - down, : label.shape[1] - right], label[down:, right:]
        at = np.array(np.nonzero((lower >= 0) & (upper >= 0) & (lower != upper)))
        pairs.append(np.sort([lower[tuple(at)], upper[tuple(at)]], axis=0))
        if surface is None:
            meeting.append(np.ones(at.shape[1]))
            continue
        across = np.array([[down], [right]])
        heights = (
            _border_height(label, surface, at, -across),
            _border_height(label, surface, at + across, across),
        )
        meeting.append(np.abs(heights[0] - heights[1]) <= step)
    both, which, length = np.unique(
        np.concatenate(pairs, axis=1), axis=1, return_inverse=True, return_counts=True
    )
    return *both, length, np.bincount(which.ravel(), np.concatenate(meeting), len(length))


def _border_height(
    label: NDArray, surface: tuple[NDArray, ...], at: NDArray, inward: NDArray
) -> NDArray:
    """Return heights of roofs at the outer side of their border cells `at` (2, n).

    The cell itself and the next one may hold the rim of a flat roof or the wall of a higher one.
    So the plane is taken around the cell `RoofRules.inside` cells `inward`, and extended to the
    border.
    """
    shape, inside = np.array(label.shape)[:, None], np.zeros(at.shape[1], np.int64)
    for distance in range(1, RULES.inside + 1):
        place = at + distance * inward
        valid = ((place >= 0) & (place < shape)).all(axis=0)
        inside[valid & (label[tuple(place % shape)] == label[tuple(at)])] = distance
    z, east, north, above = (values[tuple(at + inside * inward)] for values in surface)
    return z + np.nan_to_num(above - (inside + 0.5) * (north * inward[0] + east * inward[1]))


def _join(label: NDArray[np.int64], a: NDArray, b: NDArray) -> NDArray[np.int64]:
    """Return labels after parts `a` and `b` are joined, pair by pair."""
    return np.where(label >= 0, _sets(a, b, int(label.max()) + 1)[label], -1)


def roof_planes(z: NDArray[np.float64], size: float) -> tuple[int, float, float]:
    """Return the number of planes of a roof, their mean slope (degrees), and their share of cells.

    Parameters
    ----------
    z : (r, c) float64
        Heights of the roof's cells, NaN elsewhere; meters.
    size : float
        Side of a cell, meters.
    """
    east, north, _, scatter = planes(z, z, size, RULES.roof_reach)
    part = connected(scatter < RULES.smooth_scatter**2, RULES.max_bend, east, north)
    cells = np.bincount(part.ravel() + 1)[1:]
    large = np.append(cells * size * size >= RULES.min_plane_area, False)
    in_plane = large[part]
    if not in_plane.any():
        return 0, 0.0, 0.0
    slope = np.degrees(np.arctan(np.hypot(east[in_plane], north[in_plane])))
    share = in_plane.sum() / np.count_nonzero(~np.isnan(z))
    return int(large.sum()), float(slope.mean()), float(share)
