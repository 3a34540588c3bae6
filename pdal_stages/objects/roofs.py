"""Buildings of cells: roofs that are connected, parted where they part."""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from ..base.jit import device, njit
from .planes import plane_around

#: Scatter of a roof's plane that is gone on from, and how near to it vegetation is of the roof, meters.
PLANE, NEAR = 0.12, 0.2
#: How far apart, up and down, the points of a cell lie at most where a roof was taken for leaves, meters.
SURFACE = 0.5
#: So many cells inside its border a roof's height is measured where two roofs are compared.
INSIDE = 2
#: Within how many meters the rim of a hole in a roof is at one height, and how much of the rim.
LEVEL, RIM = 1.0, 0.65
#: The share of the border of two roofs along which their heights meet where they are of one building.
_SHARE = 0.34


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
    roof = ~np.isnan(high)
    holes, _ = scipy.ndimage.label(~roof & ~seen)
    out, rows, columns = high.copy(), *high.shape
    boxes, beside = scipy.ndimage.find_objects(holes), np.unique(holes[scipy.ndimage.binary_dilation(roof)])
    for number in beside[beside > 0].tolist():
        box = boxes[number - 1]
        (top, bottom), (left, right) = ((part.start - 1, part.stop + 1) for part in box)
        if (
            top < 0
            or left < 0
            or bottom > rows
            or right > columns
            or max(bottom - top, right - left) > 12 * reach
        ):
            continue
        part = slice(top, bottom), slice(left, right)
        hole = holes[part] == number
        rim = scipy.ndimage.binary_dilation(hole) & ~hole
        levels = high[part][rim & roof[part]]
        if len(levels) < RIM * np.count_nonzero(rim):
            continue
        level = np.median(levels)
        if (
            np.mean(np.abs(levels - level) <= LEVEL) < RIM
            or scipy.ndimage.distance_transform_cdt(hole).max() > reach
        ):
            continue
        out[part][hole] = level
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


def connected(mask: NDArray, z: NDArray, step: float) -> NDArray[np.int64]:
    """Number of each cell's part, from 0 in the order of their first cells; -1 outside the mask.

    Two cells side by side are of one part where their heights differ by at most `step`.
    """
    number = np.full(mask.shape, -1, np.int64)
    count = int(np.count_nonzero(mask))
    number[mask] = np.arange(count)
    pairs = []
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        with np.errstate(invalid="ignore"):
            joined = mask[a] & mask[b] & ~(np.abs(z[a] - z[b]) > step)
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
def borders(part: NDArray, z: NDArray, step: float) -> NDArray:
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
        return connected(mask, z, np.inf)
    number = absorbed(connected(mask, z, min(1.0, step)), z, smallest)
    return joined(number, z, step)


def absorbed(number: NDArray[np.int64], z: NDArray, smallest: int) -> NDArray[np.int64]:
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


def joined(number: NDArray[np.int64], z: NDArray, step: float) -> NDArray[np.int64]:
    """Parts with those put together whose heights meet along enough of their border."""
    while True:
        a, b, length, near = _shared(number, z, step)
        meets = near >= _SHARE * length
        if not meets.any():
            return number
        number = _renamed(number, _sets(a[meets], b[meets], int(number.max()) + 1))


def _shared(number: NDArray[np.int64], z: NDArray, step: float) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Neighboring parts, the lower number first; how long their border is, in cells, and how much of it is within step."""
    pairs = borders(number, z, step)
    both, which, length = np.unique(pairs[:, :2], axis=0, return_inverse=True, return_counts=True)
    return (
        both[:, 0],
        both[:, 1],
        length,
        np.bincount(which.ravel(), weights=pairs[:, 2], minlength=len(both)),
    )


def _renamed(number: NDArray[np.int64], name: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.where(number >= 0, name[number], -1)
