"""Buildings of cells: roofs that are connected, parted where they part."""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from ..base.jit import njit
from ..terrain.components import number_sets

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


@njit
def planes(z: NDArray, level: NDArray, size: float, reach: float) -> NDArray:
    """The plane, by least squares, through the five by five cells around each cell that lie within `reach` of its level.

    (4, r, c): rise per meter east and north, height above `level` at the cell, and the mean square of how far the cells lie
    from it; NaN where they are fewer than six, or in a row, and where there is no level.
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
    """Cells of roofs and the height of each, meters, from the highest point of a roof in each cell (r, c), NaN for none.

    Empty cells with at least seven of eight neighbors are filled, twice, and what is one cell wide, a wall or a stray point,
    is left out.
    """
    for _ in range(2):
        high = _closed(high)
    return scipy.ndimage.binary_opening(~np.isnan(high), np.ones((2, 2), bool)), high


def continued(high: NDArray, leaves: NDArray, thick: NDArray, size: float, reach: int) -> NDArray:
    """Heights of roofs, gone on into cells of vegetation that lie in their planes: what a classifier took for leaves.

    `high` and `leaves` (r, c) are heights of the highest point of a roof, and of vegetation, in each cell, meters, NaN for
    none; `thick` is how far the lowest point of vegetation lies below. It goes on by `reach` cells of `size` meters.
    """
    for _ in range(reach):
        east, north, above, scatter = planes(
            high, np.where(np.isnan(high), leaves, np.nan), size, 1.0
        )
        steep = east**2 + north**2
        lean = size * np.sqrt(steep)  # the highest point of a cell lies anywhere in it
        added = (
            (scatter <= PLANE**2 + 0.09 * lean**2)
            & (steep <= 4.0)
            & (thick <= SURFACE + 1.5 * lean)
        )
        added &= np.abs(above) - 0.4 * lean <= NEAR
        if not added.any():
            break
        high = np.where(added, leaves, high)
    return high


def covered(high: NDArray, seen: NDArray, reach: int) -> NDArray:
    """Heights of roofs with the holes filled from which nothing came back, neither roof nor ground: dark or wet ones.

    A hole is filled where nearly all around it is roof, at nearly one height, and no cell of it lies more than `reach`
    cells from the rim. `high` (r, c) is the height of a building's highest point, meters, NaN for none; `seen` (r, c) says
    where points of ground or vegetation lie.
    """
    out, empty = high.copy(), np.isnan(high) & ~seen
    holes, count = scipy.ndimage.label(empty)
    deepest = scipy.ndimage.maximum(
        scipy.ndimage.distance_transform_cdt(empty), holes, np.arange(count + 1)
    )
    near = np.zeros(count + 1, bool)
    near[holes[scipy.ndimage.binary_dilation(~np.isnan(high))]] = True
    near[0] = False
    for edge in (0, -1):  # what is seen ends there
        near[holes[edge]] = near[holes[:, edge]] = False
    boxes = scipy.ndimage.find_objects(holes)
    for number in np.flatnonzero(near & (deepest <= reach)).tolist():
        box = tuple(slice(one.start - 1, one.stop + 1) for one in boxes[number - 1])
        hole = holes[box] == number
        levels = high[box][scipy.ndimage.binary_dilation(hole) & ~hole]
        level = np.nanmedian(levels) if not np.isnan(levels).all() else np.nan
        if np.mean(np.abs(levels - level) <= LEVEL) >= RIM:
            out[box][hole] = level
    return out


def _closed(high: NDArray) -> NDArray:
    """Heights with those of empty cells that have at least seven neighbors: the mean of them."""
    known = ~np.isnan(high)
    around = np.ones((3, 3))
    count = scipy.ndimage.correlate(known.astype(np.float64), around, mode="constant")
    total = scipy.ndimage.correlate(np.where(known, high, 0.0), around, mode="constant")
    return np.where(~known & (count >= 7), total / np.maximum(count, 1), high)


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
    number[mask] = _sets(
        np.concatenate([a for a, _ in pairs]), np.concatenate([b for _, b in pairs]), count
    )
    return number


def _sets(a: NDArray, b: NDArray, count: int) -> NDArray[np.int64]:
    """Of each of `count` members the number of its set, in the order of their first members; a and b are joined."""
    number = np.empty(count, np.int64)
    number_sets(a, b, number)
    return number


def building_parts(
    mask: NDArray[np.bool_], z: NDArray, *, step: float, smallest: int
) -> NDArray[np.int64]:
    """Number of each cell's building, from 0 in the order of their first cells; -1 outside.

    Connected cells whose heights differ by at most 1 m are a roof. Roofs of fewer than `smallest` cells (dormers,
    chimneys) go with the neighbor that they share the longest border with. Then two roofs are of one building where their
    heights (measured beyond rims and walls) differ by at most `step` along at least a third of their border. A `step`
    of 0 parts nothing.
    """
    if step <= 0:
        return connected(mask, np.inf, z)
    number = connected(mask, min(1.0, step), z)
    while True:
        a, b, length, _ = _borders(number)
        size = np.bincount(number[number >= 0])
        a, b, length = np.r_[a, b], np.r_[b, a], np.r_[length, length]
        order = np.lexsort(
            (b, -length, a)
        )  # the longest border; of equal ones the part that begins first
        order = order[size[a[order]] < smallest]
        small, first = np.unique(a[order], return_index=True)
        if not len(small):
            break
        number = _renamed(number, small, b[order][first])
    z = np.where(mask, z, np.nan)
    surface = z, *planes(z, z, 1.0, 1.0)[:3]
    while True:
        a, b, length, near = _borders(number, surface, step)
        meets = near >= _SHARE * length
        if not meets.any():
            return number
        number = _renamed(number, a[meets], b[meets])


def _borders(
    number: NDArray[np.int64], surface: tuple[NDArray, ...] | None = None, step: float = np.inf
) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Neighboring parts, the lower number first; how long their border is, in cells, and how much of it is within step."""
    pairs, near = [], []
    for down, right in ((1, 0), (0, 1)):
        one, other = number[: len(number) - down, : number.shape[1] - right], number[down:, right:]
        at = np.array(np.nonzero((one >= 0) & (other >= 0) & (one != other)))
        pairs.append(np.sort([one[tuple(at)], other[tuple(at)]], axis=0))
        if surface is None:
            near.append(np.ones(at.shape[1]))
            continue
        way = np.array([[down], [right]])
        levels = [
            _roof_level(number, surface, at, -way),
            _roof_level(number, surface, at + way, way),
        ]
        near.append(np.abs(levels[0] - levels[1]) <= step)
    both, which, length = np.unique(
        np.concatenate(pairs, axis=1), axis=1, return_inverse=True, return_counts=True
    )
    return *both, length, np.bincount(which.ravel(), np.concatenate(near), len(length))


def _roof_level(
    number: NDArray, surface: tuple[NDArray, ...], at: NDArray, way: NDArray
) -> NDArray:
    """Heights of roofs at their border: at the outer side of cells there, whose inner neighbors lie `way`.

    The cell itself and the next may hold the rim of a flat roof, or the wall of a higher one: so it is the plane through
    the cells around the `INSIDE`-th beyond it, carried on to the border.
    """
    shape, inside = np.array(number.shape)[:, None], np.zeros(at.shape[1], np.int64)
    for far in range(1, INSIDE + 1):
        there = at + far * way
        within = ((there >= 0) & (there < shape)).all(axis=0)
        inside[within & (number[tuple(there % shape)] == number[tuple(at)])] = far
    z, east, north, above = (values[tuple(at + inside * way)] for values in surface)
    return z + np.nan_to_num(above - (inside + 0.5) * (north * way[0] + east * way[1]))


def _renamed(number: NDArray[np.int64], a: NDArray, b: NDArray) -> NDArray[np.int64]:
    """Numbers of parts after parts `a` and `b` were put together, pair by pair."""
    return np.where(number >= 0, _sets(a, b, int(number.max()) + 1)[number], -1)


def roof_planes(z: NDArray[np.float64], size: float) -> tuple[int, float, float]:
    """How many planes a roof has, their mean slope in degrees, and the share of its cells that lie in one.

    Parameters
    ----------
    z : (r, c) float64
        Heights of the roof's cells, NaN elsewhere; meters.
    size : float
        Side of a cell, meters.
    """
    east, north, _, scatter = planes(z, z, size, 1.5)
    part = connected(scatter < SMOOTH**2, TILT, east, north)
    cells = np.bincount(part.ravel() + 1)[1:]
    large = np.append(cells * size * size >= SMALLEST, False)
    taken = large[part]
    if not taken.any():
        return 0, 0.0, 0.0
    slope = np.degrees(np.arctan(np.hypot(east[taken], north[taken])))
    return (
        int(large.sum()),
        float(slope.mean()),
        float(taken.sum() / np.count_nonzero(~np.isnan(z))),
    )
