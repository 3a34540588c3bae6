"""What lies below the ground, as echoes from below do: by a plane under its surroundings.

A low place lies below the plane by more than its surroundings scatter about it. It is ground after all where ground as deep
is near, as a street is to a courtyard, unless one walks from there to land above the place, as on a slope; and under a
closed canopy, where few columns are level with others, if it is not below the plane under the lowest points of wide blocks
around: single points reach the ground, in the wood or beside it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..base.jit import FAST, device, njit
from .cells import HOLE, linked_cells, sums_around
from .openings import highest_around

#: Columns within which a plane is fitted through the ground; how many it needs.
NEAR, ENOUGH = 9, 12
#: How far below the plane a low place lies at least, in units of the scatter.
SCATTERS = 4.0
#: How far away other ground is looked for, in meters, how many columns of it show that a deep place is ground, how much
#: higher these may be per meter of distance; within how many columns their land is not so many meters above the place.
FAR, COMPANY, ROOM, BESIDE, HIGHER = 30.0, 4, 0.05, 4, 2.0
#: A column of ground has so many others of its level, in meters, in the 5 x 5 round it, and such a share of those.
SUPPORT, SUPPORT_SHARE, LEVEL = 2, 0.2, 1.0
#: A canopy is closed where at most such a share of the columns near is level with others; the blocks with which low places
#: there are compared, along either axis, within so many meters.
CLOSED, BLOCKS, OTHERS = 0.4, 9, 45.0
#: Cells of a minimum grid are linked within so many cells, across a step of so many meters, and so many per meter of
#: distance; an island has at most so many, or such a share of them lies under others, so many meters above at least, or
#: beside such a cell; and it is no longer, in cells, along either axis.
LINK, STEP, GRADE, MOST, COVERED, ABOVE, EXTENT = 3, 0.35, 0.15, 30, 0.8, 2.5, 20


def reach(side: float) -> int:
    """How far away columns of a `side` in meters change what lies below the ground, in columns."""
    return math.ceil(max(OTHERS / side, NEAR) + max(FAR / side + 2, NEAR))


@device(_nrt=True, fastmath=set(FAST))
def _plane_under(low, j, i, radius, blocks, inner=-1):
    """Plane (height at the column, per column across, along; scatter below it) under the lowest columns of the blocks round
    one, and how many these are: so many along either axis, but for the inner ones."""
    h, w = low.shape
    u, v, zs = np.empty((3, blocks * blocks))
    zs[:] = np.inf
    block, middle, n = np.arange(2 * radius + 1) * blocks // (2 * radius + 1), blocks // 2, 0
    for b in range(max(-radius, -j), min(radius + 1, h - j)):
        for a in range(max(-radius, -i), min(radius + 1, w - i)):
            k = block[b + radius] * blocks + block[a + radius]
            if low[j + b, i + a] < zs[k]:
                u[k], v[k], zs[k] = a, b, low[j + b, i + a]
    for b in range(-middle, blocks - middle):
        for a in range(-middle, blocks - middle):
            k = (b + middle) * blocks + a + middle
            if inner < b * b + a * a <= middle * middle and zs[k] < np.inf:
                u[n], v[n], zs[n] = u[k], v[k], zs[k]
                n += 1
    if n < ENOUGH:
        return n, -np.inf, 0.0, 0.0, 0.0
    lowest = zs[:n].min()
    zs = zs[:n] - lowest
    weight = np.ones(n)
    p0 = p1 = p2 = scatter = 0.0
    for turn in range(inner < 0, 9):  # of wide blocks what is low is so from their mean plane
        if turn == 1:
            above = zs - p0 - p1 * u[:n] - p2 * v[:n]
            order = np.sort(above)
            weight = np.where((above >= order[n // 10]) & (above <= order[n // 2]), 1.0, 0.01)
        s0 = s1 = s2 = s11 = s12 = s22 = t0 = t1 = t2 = 0.0
        for k in range(n):
            g = weight[k]
            s0 += g
            s1 += g * u[k]
            s2 += g * v[k]
            s11 += g * u[k] * u[k]
            s12 += g * u[k] * v[k]
            s22 += g * v[k] * v[k]
            t0 += g * zs[k]
            t1 += g * u[k] * zs[k]
            t2 += g * v[k] * zs[k]
        s11, s22 = s11 + 1e-3 * s0, s22 + 1e-3 * s0
        # Cramer's rule.
        c0 = s11 * s22 - s12 * s12
        c1 = s12 * s2 - s1 * s22
        c2 = s1 * s12 - s11 * s2
        det = s0 * c0 + s1 * c1 + s2 * c2
        p0 = (t0 * c0 + t1 * c1 + t2 * c2) / det
        p1 = (t0 * c1 + t1 * (s0 * s22 - s2 * s2) + t2 * (s1 * s2 - s0 * s12)) / det
        p2 = (t0 * c2 + t1 * (s1 * s2 - s0 * s12) + t2 * (s0 * s11 - s1 * s1)) / det
        below, number = 0.0, 0.0
        for k in range(n):
            off = zs[k] - p0 - p1 * u[k] - p2 * v[k]
            g = 1.0 / (1.0 + off * off)
            weight[k] = g * g if off < 0.0 else 0.1 * g
            g = weight[k] if off < 0.0 else 0.0
            below += g * off * off
            number += g
        scatter = np.sqrt(below / number) if number > 0.0 else 0.0
    return n, p0 + lowest, p1, p2, scatter


@njit
def _supported(base):
    """Columns with enough others of their level around."""
    h, w = base.shape
    out = np.empty((h, w), np.bool_)
    for j in range(h):
        for i in range(w):
            level, seen = 0, 0
            if base[j, i] < np.inf:
                for b in range(max(j - 2, 0), min(j + 3, h)):
                    for a in range(max(i - 2, 0), min(i + 3, w)):
                        seen += base[b, a] < np.inf
                        level += abs(base[b, a] - base[j, i]) <= LEVEL
            out[j, i] = level > SUPPORT + SUPPORT_SHARE * seen
    return out


@device(_nrt=True)
def _of_land_above(levels, left, deep, side, j, i, height):
    """How many of the `deep` columns (h, w) are of linked sets that come near a place, and lie above a height there.

    `left` are the columns that may be linked; those that were looked at are taken out.
    """
    h, w = left.shape
    queue = np.empty((h * w, 2), np.int64)
    many = 0
    for row in range(max(j - BESIDE, 0), min(j + BESIDE + 1, h)):
        for column in range(max(i - BESIDE, 0), min(i + BESIDE + 1, w)):
            lowest, found, waiting = np.inf, 0, 0
            if left[row, column]:
                left[row, column], queue[0, 0], queue[0, 1], waiting = False, row, column, 1
            while waiting:
                waiting -= 1
                b, a = queue[waiting]
                found += deep[b, a]
                if max(abs(b - j), abs(a - i)) <= BESIDE:
                    lowest = min(lowest, levels[b, a])
                for y in range(max(b - LINK, 0), min(b + LINK + 1, h)):
                    for x in range(max(a - LINK, 0), min(a + LINK + 1, w)):
                        away = np.sqrt(float((y - b) ** 2 + (x - a) ** 2))
                        step = abs(levels[y, x] - levels[b, a])
                        if left[y, x] and away <= LINK and step <= STEP + GRADE * side * away:
                            left[y, x], queue[waiting, 0], queue[waiting, 1] = False, y, x
                            waiting += 1
            many += found * (lowest > height)
    return many


@device(_nrt=True)
def _has_company(base, supported, side, j, i, z, height, across, along):
    """Whether enough other columns are about as deep as z, at least half as far below the plane, and not of land above."""
    far, half, company = int(np.ceil(FAR / side)), 0.5 * (height - z), 0
    bottom, left = max(j - far, 0), max(i - far, 0)
    levels = base[bottom : j + far + 1, left : i + far + 1]
    seen = supported[bottom : j + far + 1, left : i + far + 1].copy()
    j, i = j - bottom, i - left
    deep = np.zeros_like(seen)
    for b in range(seen.shape[0]):
        for a in range(seen.shape[1]):
            if seen[b, a]:
                away = side * np.sqrt(float((b - j) ** 2 + (a - i) ** 2))
                below = height + across * (a - i) + along * (b - j) - levels[b, a]
                most = z + min(half, LEVEL + ROOM * away)
                deep[b, a] = away <= FAR and levels[b, a] <= most and below >= half
                company += deep[b, a]
    return (
        company >= COMPANY
        and company - _of_land_above(levels, seen, deep, side, j, i, z + max(half, HIGHER))
        >= COMPANY
    )


@njit
def _limits(low, base, supported, side, depth, limit):
    """Fill `limit` with the height below which each low place is deep, -inf where it is not or may be ground."""
    for j in range(low.shape[0]):
        for i in range(low.shape[1]):
            if low[j, i] == np.inf:
                continue
            plane = _plane_under(base, j, i, NEAR, 2 * NEAR + 1)
            lowest = plane[1] - depth - SCATTERS * plane[4]
            if low[j, i] < lowest and not _has_company(
                base, supported, side, j, i, low[j, i], *plane[1:4]
            ):
                limit[j, i] = lowest


@njit
def _take_level(every, rows, columns, side, depth, limit):
    """Take the limits of places under a closed canopy that are not below the plane under the lowest of blocks."""
    radius = max(int(OTHERS / side), BLOCKS // 2)
    for j, i in zip(rows, columns):  # noqa: B905 - Numba's has no strict
        n, height, _, _, scatter = _plane_under(every, j, i, radius, BLOCKS, 1)
        if n >= ENOUGH and every[j, i] >= height - depth - SCATTERS * scatter:
            limit[j, i] = -np.inf


def below_ground(
    low: NDArray, base: NDArray, side: float, depth: float = 1.0
) -> NDArray[np.float64]:
    """Heights (h, w) below which low places are below the ground; -inf where they are not.

    `low` (h, w) has the lowest of what may be in each column, `base` that of what is not, both ``inf`` where there is none;
    `side` is that of a column, and what is below the ground is so by `depth` at least; meters.
    """
    limit, supported = np.full(low.shape, -np.inf), _supported(base)
    # Where all around lies lower, no plane through it runs above.
    highest = highest_around(np.where(np.isfinite(base), base, -HOLE).astype(np.float32), NEAR, 0)
    _limits(np.where(low < highest, low, np.inf), base, supported, side, depth, limit)
    deep = limit > -np.inf
    if deep.any():
        every = np.minimum(low, base)
        supported = _supported(np.where(deep, np.inf, every))
        closed = deep & (sums_around(supported, NEAR) <= CLOSED * sums_around(every < np.inf, NEAR))
        _take_level(every, *np.nonzero(closed), side, depth, limit)
    return limit


def pits(
    raster: NDArray[np.float32], highest: NDArray[np.floating], cell: float
) -> NDArray[np.bool_]:
    """Cells (h, w) of a minimum grid whose lowest point is below the ground, of islands from which one walks nowhere.

    `raster` has heights, holes ``inf``; `highest` those of the highest points; `cell` is a cell's side; meters.
    """
    number, size, side = linked_cells(raster, LINK, lambda away: STEP + GRADE * cell * away)
    covered = highest_around(highest > raster + ABOVE, 1, 0)
    share = np.bincount(number[covered & (number >= 0)], minlength=len(size))
    island = np.append(((size <= MOST) | (share >= COVERED * size)) & (side < EXTENT), False)[
        number
    ]
    if not island.any():
        return island
    return (
        below_ground(np.where(island, raster, HOLE), np.where(island, HOLE, raster), cell) > -np.inf
    )


def pits_reach(cell: float) -> int:
    """How far away cells change what is a pit, in cells."""
    return reach(cell) + EXTENT + LINK + 1
