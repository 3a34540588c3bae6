"""Buildings of cells: roofs that are connected, parted where they part."""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from ..base.jit import device, njit

#: Scatter of a roof's plane that is gone on from, and how near to it vegetation is of the roof, meters.
PLANE, NEAR = 0.12, 0.2
#: How far apart, up and down, the points of a cell lie at most where a roof was taken for leaves, meters.
SURFACE = 0.5
#: So many cells inside its border a roof's height is measured where two roofs are compared.
INSIDE = 2
#: Within how many meters the rim of a hole in a roof is at one height, and how much of the rim.
LEVEL, RIM = 1.0, 0.65
#: Cells of a roof's plane: how far those around scatter from it, meters; how much its gradient changes from one cell to the
#: next; and the smallest plane that counts, m2.
SMOOTH, TILT, SMALLEST = 0.25, 0.2, 3.0
#: The share of the border of two roofs along which their heights meet where they are of one building.
_SHARE = 0.34


@device
def plane_around(z, r, c, size, level, reach, flat):
    """The plane through the five by five cells around a cell that lie within `reach` of a level, by least squares.

    Returns how many they are, the rise per meter east and north, the height above `level` at the cell, and the mean
    square of how far they lie from it; NaN where they are fewer than six, or in a row (a determinant below `flat`).
    """
    n, x, y, h, xx, yy, xy, xh, yh, hh = 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(max(r - 2, 0), min(r + 3, z.shape[0])):
        for j in range(max(c - 2, 0), min(c + 3, z.shape[1])):
            d = z[i, j] - level
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
        return n, np.nan, np.nan, np.nan, np.nan
    xx, yy, xy = xx - x * x / n, yy - y * y / n, xy - x * y / n
    xh, yh, hh = xh - x * h / n, yh - y * h / n, hh - h * h / n
    det = xx * yy - xy * xy
    if det < max(1e-9, flat * n * n * size**4):
        return n, np.nan, np.nan, np.nan, np.nan
    a, b = (xh * yy - yh * xy) / det, (yh * xx - xh * xy) / det
    return n, a, b, (h - a * x - b * y) / n, (hh - a * xh - b * yh) / n


def roof_cells(
    high: NDArray, ground: NDArray, lowest: float
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Cells of roofs and the height of each, meters.

    Cells of which the highest point lies `lowest` above the ground; empty ones with at least seven of eight neighbors are
    filled, twice, and what is one cell wide, a wall or a stray point, is left out.

    Parameters
    ----------
    high : (r, c) float64
        Height of the highest point of a building in each cell, NaN where there is none.
    ground : (r, c) float64
        NaN where it is not known: then every height will do.
    lowest : float
        Meters.
    """
    with np.errstate(invalid="ignore"):
        taken = ~np.isnan(high) & ~(high - ground < lowest)
    high = np.where(taken, high, np.nan)
    for _ in range(2):
        high = _closed(high)
    return opened(~np.isnan(high)), high


@device
def _leaning(z, r, c, size, level, thick):
    """How far `level` lies from the plane through the five by five cells around a cell that lie within a meter of it,
    meters; NaN where they are too few or scatter, or where the cell's points, `thick` apart, are no surface."""
    _, a, b, above, scatter = plane_around(z, r, c, size, level, 1.0, 1e-3)
    if np.isnan(a):
        return np.nan
    steep = a * a + b * b
    # The highest point of a cell lies anywhere in it.
    if scatter > PLANE * PLANE + steep * (0.3 * size) ** 2 or steep > 4.0:
        return np.nan
    if thick > SURFACE + 1.5 * size * np.sqrt(steep):
        return np.nan
    return max(0.0, abs(above) - 0.4 * size * np.sqrt(steep))


@njit
def continued(high: NDArray, leaves: NDArray, thick: NDArray, size: float, reach: int) -> NDArray:
    """Heights of roofs, gone on into cells of vegetation that lie in their planes: what a classifier took for leaves.

    Parameters
    ----------
    high, leaves : (r, c) float64
        Height of the highest point of a roof, and of vegetation, in each cell; NaN where there is none.
    thick : (r, c) float64
        How far the lowest point of vegetation in each cell lies below the highest.
    size : float
        Side of a cell, meters.
    reach : int
        How many cells far at most.
    """
    out = high.copy()
    rows, columns = np.nonzero(np.isnan(high) & ~np.isnan(leaves))
    added = np.empty(len(rows), np.bool_)
    for _ in range(reach):
        for n in range(len(rows)):
            level = leaves[rows[n], columns[n]]
            off = _leaning(out, rows[n], columns[n], size, level, thick[rows[n], columns[n]])
            added[n] = off <= NEAR
        if not added.any():
            break
        for k in np.flatnonzero(added):
            out[rows[k], columns[k]] = leaves[rows[k], columns[k]]
        rows, columns, added = rows[~added], columns[~added], added[~added]
    return out


def covered(high: NDArray, seen: NDArray, reach: int) -> NDArray:
    """Heights of roofs with the holes filled from which nothing came back, neither roof nor ground: dark or wet ones.

    A hole is filled where nearly all around it is roof, at nearly one height, and no cell of it lies more than `reach`
    cells from the rim.

    Parameters
    ----------
    high : (r, c) float64
        Height of the highest point of a building in each cell, NaN where there is none.
    seen : (r, c) bool
        Whether points of the ground or of vegetation lie in the cell.
    reach : int
    """
    out = high.copy()
    holes, _ = scipy.ndimage.label(np.isnan(high) & ~seen)
    boxes = scipy.ndimage.find_objects(holes)
    for number in np.unique(holes[scipy.ndimage.binary_dilation(~np.isnan(high))]).tolist():
        if number == 0:
            continue
        rows, columns = boxes[number - 1]
        top, left = rows.start - 1, columns.start - 1
        box = np.s_[top : rows.stop + 1, left : columns.stop + 1]
        hole = holes[box] == number if top >= 0 and left >= 0 else np.empty((0, 0), bool)
        if hole.shape != (rows.stop - rows.start + 2, columns.stop - columns.start + 2):
            continue  # at the edge of what is seen
        levels = high[box][scipy.ndimage.binary_dilation(hole) & ~hole]
        level = np.nanmedian(levels) if not np.isnan(levels).all() else np.nan
        rim = np.mean(np.abs(levels - level) <= LEVEL) >= RIM and max(hole.shape) <= 12 * reach
        if rim and scipy.ndimage.distance_transform_cdt(hole).max() <= reach:
            out[box][hole] = level
    return out


def _closed(high: NDArray) -> NDArray:
    """Heights with those of empty cells that have at least seven neighbors: the mean of them."""
    known = ~np.isnan(high)
    around = np.ones((3, 3))
    count = scipy.ndimage.correlate(known.astype(np.float64), around, mode="constant")
    total = scipy.ndimage.correlate(np.where(known, high, 0.0), around, mode="constant")
    return np.where(~known & (count >= 7), total / np.maximum(count, 1), high)


def opened(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells of the mask that lie in a square of two by two of it."""
    return scipy.ndimage.binary_opening(mask, np.ones((2, 2), bool))


def connected(mask: NDArray, step: float, *values: NDArray) -> NDArray[np.int64]:
    """Number of each cell's part, from 0 in the order of their first cells; -1 outside the mask.

    Two cells side by side are of one part where their values, in sum, differ by at most `step`.
    """
    number = np.full(mask.shape, -1, np.int64)
    count = int(np.count_nonzero(mask))
    number[mask] = np.arange(count)
    pairs = []
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        with np.errstate(invalid="ignore"):
            joined = mask[a] & mask[b] & ~(sum(np.abs(v[a] - v[b]) for v in values) > step)
        pairs.append((number[a][joined], number[b][joined]))
    number[mask] = _sets(np.concatenate([a for a, _ in pairs]), np.concatenate([b for _, b in pairs]), count)
    return number


def _sets(a: NDArray, b: NDArray, count: int) -> NDArray[np.int64]:
    """Of each of `count` members the number of its set, in the order of their first members; a and b are joined."""
    pairs = scipy.sparse.coo_matrix((np.ones(len(a), np.bool_), (a, b)), (count, count))
    _, of = scipy.sparse.csgraph.connected_components(pairs, directed=False)
    _, first, at = np.unique(of, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[at]


@device
def _roof_level(part, z, r, c, dr, dc):
    """Height of a part's roof at its border: at the outer side of a cell there, whose inner neighbor lies in a direction.

    The cell itself and the next may hold the rim of a flat roof, or the wall of a higher one: so it is the plane through
    the cells around the `INSIDE`-th beyond it, carried on to the border.
    """
    inside = INSIDE
    while inside > 0:
        i, j = r + inside * dr, c + inside * dc
        if 0 <= i < z.shape[0] and 0 <= j < z.shape[1] and part[i, j] == part[r, c]:
            break
        inside -= 1
    level = z[r + inside * dr, c + inside * dc]
    _, a, b, above, _ = plane_around(z, r + inside * dr, c + inside * dc, 1.0, level, 1.0, 1e-3)
    if np.isnan(a):
        return level
    return level + above - (inside + 0.5) * (a * dc + b * dr)


@njit
def _borders(part: NDArray, z: NDArray, step: float) -> NDArray:
    """Every pair of cells side by side in different parts: (n, 3), the numbers of both, the lower first, and whether
    their roofs lie within `step` there."""
    rows, columns = part.shape
    count = 0
    for turn in range(2):
        out = np.empty((count, 3), np.int64)
        count = 0
        for r in range(rows):
            for c in range(columns):
                if part[r, c] < 0:
                    continue
                for way in range(2):
                    rr, cc = r + way, c + 1 - way
                    if rr >= rows or cc >= columns or part[rr, cc] < 0 or part[rr, cc] == part[r, c]:
                        continue
                    if turn == 1:
                        a, b = part[r, c], part[rr, cc]
                        out[count, 0], out[count, 1], out[count, 2] = min(a, b), max(a, b), 1
                        if step < np.inf:
                            one = _roof_level(part, z, r, c, -way, way - 1)
                            other = _roof_level(part, z, rr, cc, way, 1 - way)
                            out[count, 2] = 0 if abs(one - other) > step else 1
                    count += 1
    return out


def building_parts(mask: NDArray[np.bool_], z: NDArray, *, step: float, smallest: int) -> NDArray[np.int64]:
    """Number of each cell's building, from 0 in the order of their first cells; -1 outside.

    Connected cells whose heights differ by at most 1 m are a roof. Roofs of fewer than `smallest` cells (dormers,
    chimneys) go with the neighbor that they share the longest border with. Then two roofs are of one building where their
    heights (measured beyond rims and walls) differ by at most `step` along at least a third of their border. A `step`
    of 0 parts nothing.
    """
    if step <= 0:
        return connected(mask, np.inf, z)
    number = _absorbed(connected(mask, min(1.0, step), z), z, smallest)
    return _joined(number, z, step)


def _absorbed(number: NDArray[np.int64], z: NDArray, smallest: int) -> NDArray[np.int64]:
    """Parts without the small ones that have a neighbor."""
    while True:
        a, b, length, _ = _shared(number, z, np.inf)
        size = np.bincount(number[number >= 0])
        a, b, length = np.r_[a, b], np.r_[b, a], np.r_[length, length]
        order = np.lexsort((b, -length, a))  # the longest border; of equal ones the part that begins first
        order = order[size[a[order]] < smallest]
        small, first = np.unique(a[order], return_index=True)
        if not len(small):
            return number
        number = _renamed(number, _sets(small, b[order][first], len(size)))


def _joined(number: NDArray[np.int64], z: NDArray, step: float) -> NDArray[np.int64]:
    """Parts with those put together whose heights meet along enough of their border."""
    while True:
        a, b, length, near = _shared(number, z, step)
        meets = near >= _SHARE * length
        if not meets.any():
            return number
        number = _renamed(number, _sets(a[meets], b[meets], int(number.max()) + 1))


def _shared(number: NDArray[np.int64], z: NDArray, step: float) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Neighboring parts, the lower number first; how long their border is, in cells, and how much of it is within step."""
    pairs = _borders(number, z, step)
    both, which, length = np.unique(pairs[:, :2], axis=0, return_inverse=True, return_counts=True)
    return (
        both[:, 0],
        both[:, 1],
        length,
        np.bincount(which.ravel(), weights=pairs[:, 2], minlength=len(both)),
    )


def _renamed(number: NDArray[np.int64], name: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.where(number >= 0, name[number], -1)


@njit
def _gradients(z: NDArray, size: float) -> tuple[NDArray, NDArray, NDArray]:
    """Rise per meter east and north of the plane through each cell and its neighbors, and how far they lie from it."""
    rows, columns = z.shape
    east, north = np.full(z.shape, np.nan), np.full(z.shape, np.nan)
    off = np.full(z.shape, np.inf)
    for r in range(rows):
        for c in range(columns):
            if np.isnan(z[r, c]):
                continue
            _, a, b, _, scatter = plane_around(z, r, c, size, z[r, c], 1.5, 0.0)
            if not np.isnan(a):
                east[r, c], north[r, c], off[r, c] = a, b, np.sqrt(max(scatter, 0.0))
    return east, north, off


def roof_planes(z: NDArray[np.float64], size: float) -> tuple[int, float, float]:
    """How many planes a roof has, their mean slope in degrees, and the share of its cells that lie in one.

    Parameters
    ----------
    z : (r, c) float64
        Heights of the roof's cells, NaN elsewhere; meters.
    size : float
        Side of a cell, meters.
    """
    east, north, off = _gradients(z, size)
    part = connected(off < SMOOTH, TILT, east, north)
    cells = np.bincount(part.ravel() + 1)[1:]
    large = np.append(cells * size * size >= SMALLEST, False)
    taken = large[part]
    if not taken.any():
        return 0, 0.0, 0.0
    slope = np.degrees(np.arctan(np.hypot(east[taken], north[taken])))
    return int(large.sum()), float(slope.mean()), float(taken.sum() / np.count_nonzero(~np.isnan(z)))
