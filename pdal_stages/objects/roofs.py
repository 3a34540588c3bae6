"""Buildings of cells: roofs that are connected, parted where they part."""

from __future__ import annotations

import heapq

import numpy as np
from numpy.typing import NDArray

from ..base.jit import device, njit
from ..base.unionfind import root as root_of
from .planes import plane_around

#: Scatter of a roof's plane that is gone on from, and how near to it vegetation is of the roof, meters.
PLANE, NEAR = 0.12, 0.2
#: How far apart, up and down, the points of a cell lie at most where a roof was taken for leaves, meters.
SURFACE = 0.5
#: So many cells inside its border a roof's height is measured where two roofs are compared.
INSIDE = 2
#: Within how many meters the rim of a roof without points is at one height.
LEVEL = 1.0
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


@njit
def covered(high: NDArray, seen: NDArray, reach: int) -> NDArray:
    """Heights of roofs with the cells filled from which nothing came back, neither roof nor ground: dark or wet ones.

    A cell is filled where, going out in eight directions, the first cell in which anything was seen is of the roof in at
    least seven of them, at nearly one height.

    Parameters
    ----------
    high : (r, c) float64
        Height of the highest point of a building in each cell, NaN where there is none.
    seen : (r, c) bool
        Whether points of the ground or of vegetation lie in the cell.
    reach : int
        How many cells away at most.
    """
    rows, columns = high.shape
    out = high.copy()
    found = np.empty(8)
    for r in range(rows):
        for c in range(columns):
            if seen[r, c] or not np.isnan(high[r, c]):
                continue
            n = 0
            for way in range(8):
                if n < way - 1:
                    break
                dr, dc = (0, 0, 1, -1, 1, -1, 1, -1)[way], (1, -1, 0, 0, 1, -1, -1, 1)[way]
                level = _first_roof(high, seen, r, c, dr, dc, reach)
                if not np.isnan(level):
                    found[n] = level
                    n += 1
            if n < 7:
                continue
            level = np.median(found[:n])
            if np.sum(np.abs(found[:n] - level) <= LEVEL) >= 7:
                out[r, c] = level
    return out


@device
def _first_roof(high, seen, r, c, dr, dc, reach):
    """Height of the first roof from a cell in a direction, NaN where something else comes before.

    The ground is known by cells twice as wide, so what is seen in the two cells before a roof may lie outside it.
    """
    left = reach
    for k in range(1, reach + 1):
        i, j = r + k * dr, c + k * dc
        if i < 0 or j < 0 or i >= high.shape[0] or j >= high.shape[1]:
            break
        if not np.isnan(high[i, j]):
            return high[i, j]
        if dr != 0 and dc != 0 and not np.isnan(high[i - dr, j]) and not np.isnan(high[i, j - dc]):
            return high[i - dr, j]  # through a corner
        left = min(left - 1, 1 if seen[i, j] else left)
        if left < 0:
            break
    return np.nan


@njit
def _closed(high: NDArray) -> NDArray:
    """Heights with those of empty cells that have at least seven neighbors: the mean of them."""
    rows, columns = high.shape
    out = high.copy()
    for r in range(rows):
        for c in range(columns):
            if not np.isnan(high[r, c]):
                continue
            total, count, missing = 0.0, 0, 0
            for i in range(r - 1, r + 2):
                for j in range(c - 1, c + 2):
                    if i < 0 or j < 0 or i >= rows or j >= columns or np.isnan(high[i, j]):
                        missing += 1  # the cell itself is one
                    else:
                        total += high[i, j]
                        count += 1
                if missing > 2:
                    break
            if count >= 7:
                out[r, c] = total / count
    return out


def dilated(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells in or beside (eight neighbors) the mask."""
    wide = np.pad(mask, 1)
    rows = wide[:-2] | wide[1:-1] | wide[2:]
    return rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]


def opened(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells of the mask that lie in a square of two by two of it."""
    square = mask[:-1, :-1] & mask[1:, :-1] & mask[:-1, 1:] & mask[1:, 1:]
    out = np.zeros_like(mask)
    for r in (0, 1):
        for c in (0, 1):
            out[r : mask.shape[0] - 1 + r, c : mask.shape[1] - 1 + c] |= square
    return out


@device
def _unite(parent, a, b):
    a, b = root_of(parent, a), root_of(parent, b)
    if a < b:
        parent[b] = a
    elif b < a:
        parent[a] = b


@njit
def connected(mask: NDArray, z: NDArray, step: float) -> NDArray:
    """The first cell (row by row) of each cell's part, -1 outside the mask.

    Two cells side by side are of one part where their heights differ by at most `step`.
    """
    rows, columns = mask.shape
    parent = np.arange(rows * columns)
    for r in range(rows):
        for c in range(columns):
            if not mask[r, c]:
                continue
            n = r * columns + c
            if c + 1 < columns and mask[r, c + 1] and not abs(z[r, c] - z[r, c + 1]) > step:
                _unite(parent, n, n + 1)
            if r + 1 < rows and mask[r + 1, c] and not abs(z[r, c] - z[r + 1, c]) > step:
                _unite(parent, n, n + columns)
    out = np.full((rows, columns), -1, np.int64)
    for r in range(rows):
        for c in range(columns):
            if mask[r, c]:
                out[r, c] = root_of(parent, r * columns + c)
    return out


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
    chimneys) go with the neighbor that they share the longest border with, the smallest first. Then two roofs are of
    one building where their heights (measured beyond rims and walls) differ by at most `step` along at least a
    third of their border, the most equal first. A `step` of 0 parts nothing.
    """
    if step <= 0:
        return numbered(connected(mask, z, np.inf))
    number = absorbed(numbered(connected(mask, z, min(1.0, step))), z, smallest)
    return joined(number, z, step)


def numbered(first: NDArray[np.int64]) -> NDArray[np.int64]:
    """Parts numbered from 0 in the order of what they are called; below 0 is nothing."""
    inside = first >= 0
    if not inside.any():
        return np.full(first.shape, -1, np.int64)
    known = np.zeros(int(first.max()) + 1, bool)
    known[first[inside]] = True
    place = np.cumsum(known, dtype=np.int32) - 1
    return np.where(inside, place[first], np.int64(-1))


def absorbed(number: NDArray[np.int64], z: NDArray, smallest: int) -> NDArray[np.int64]:
    """Parts without the small ones that have a neighbor."""
    size, shared = np.bincount(number[number >= 0]).tolist(), _shared(number, z, np.inf)
    into = list(range(len(size)))
    waiting = [(n, part) for part, n in enumerate(size) if n < smallest]
    heapq.heapify(waiting)
    while waiting:
        n, part = heapq.heappop(waiting)
        if into[part] != part or n != size[part] or not shared[part]:
            continue
        # The longest border; of equal ones the part that begins first.
        other = min(shared[part], key=lambda p: (-shared[part][p][0], p))
        keep = _merge(part, other, into, size, shared)
        if size[keep] < smallest:
            heapq.heappush(waiting, (size[keep], keep))
    return _renamed(number, into)


def joined(number: NDArray[np.int64], z: NDArray, step: float) -> NDArray[np.int64]:
    """Parts with those put together whose heights meet along enough of their border."""
    size, shared = np.bincount(number[number >= 0]).tolist(), _shared(number, z, step)
    into = list(range(len(size)))

    def entry(a: int, b: int) -> tuple[float, int, int, int, int]:
        length, near = shared[a][b]
        return -near / length, min(a, b), max(a, b), length, near

    waiting = [entry(a, b) for a in range(len(size)) for b in shared[a] if a < b]
    heapq.heapify(waiting)
    while waiting:
        near, a, b, *state = heapq.heappop(waiting)
        if into[a] != a or into[b] != b or shared[a].get(b) != tuple(state) or -near < _SHARE:
            continue
        keep = _merge(a, b, into, size, shared)
        for other in shared[keep]:
            heapq.heappush(waiting, entry(keep, other))
    return _renamed(number, into)


def _shared(number: NDArray[np.int64], z: NDArray, step: float) -> list[dict[int, tuple[int, int]]]:
    """Of each part its neighbors: how long the border is, in cells, and along how much of it heights are within step."""
    shared: list[dict[int, tuple[int, int]]] = [{} for _ in range(int(number.max(initial=-1)) + 1)]
    pairs = borders(number, z, step)
    if len(pairs):
        pair = pairs[:, 0] * len(shared) + pairs[:, 1]
        ends, which, length = np.unique(pair, return_inverse=True, return_counts=True)
        near = np.bincount(which, weights=pairs[:, 2]).astype(np.int64)
        for both, n, m in zip(ends.tolist(), length.tolist(), near.tolist(), strict=True):
            a, b = divmod(both, len(shared))
            shared[a][b] = shared[b][a] = (n, m)
    return shared


def _merge(a: int, b: int, into: list[int], size: list[int], shared: list[dict[int, tuple[int, int]]]) -> int:
    """Put two parts together; the one that begins first stays."""
    keep, gone = min(a, b), max(a, b)
    into[gone] = keep
    size[keep] += size[gone]
    for p, (n, m) in shared[gone].items():
        del shared[p][gone]
        if p != keep:
            before = shared[keep].get(p, (0, 0))
            shared[keep][p] = shared[p][keep] = before[0] + n, before[1] + m
    return keep


def _renamed(number: NDArray[np.int64], into: list[int]) -> NDArray[np.int64]:
    for part in range(len(into)):  # a part goes into one that begins before it
        into[part] = into[into[part]]
    return numbered(np.where(number >= 0, np.array([*into, -1], np.int64)[number], -1))
