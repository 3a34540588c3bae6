"""Islands of the minimum grid: a few cells deep below all around them, to which no slope leads.

Echoes from below the ground come in clusters, and many clusters keep each other company. So what is asked of ground is a
way to it: cells are linked across what may be a slope, and those that hang together with few others are an island. One
that lies below a plane under its surroundings, by more than these scatter about the plane, is a low outlier, unless

* ground as deep is near, as a street is to a courtyard, farther below the plane than slopes of terrain are; or
* most of the islands around are as deep, as the ground is that a canopy or old roofs let through.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..base.jit import device, njit
from .envelope import COMPANY, ENOUGH, LEVEL, NEAR, SUPPORT, SUPPORT_SHARE, WIDER, envelope
from .openings import HOLE, by_distance

#: How far apart cells are linked, in cells, and across which step: so many meters, and so many per meter of distance.
LINK, STEP, GRADE = 3, 0.35, 0.15
#: An island has at most so many cells, and is no longer, in cells, along either axis.
MOST, EXTENT = 30, 6
#: It lies so many meters below the plane, and so many times the scatter about it; deeper, by so much per meter of the
#: spacing of cells with points beyond WIDE, where a ditch may be a few cells.
DEPTH, SCATTERS, GROWTH, WIDE = 1.0, 4.0, 2.0, 0.7
#: Nothing but islands is lower, or higher by less than that, within so many cells; within more where few hold points.
BELOW, BESIDE, FARTHER = 0.5, 2, 4
#: How far away ground as deep is looked for, in cells: so much deeper than the plane per meter, and by so much higher.
FAR, CURVE, ROOM = 40, 0.15, 0.05
#: So many other islands in this ring, in cells, are as deep, and such a share of all there.
ISLANDS, ISLANDS_SHARE, RING, RING_FAR = 4, 0.5, 5, 20
#: How far away cells change what is marked, in cells: company, what supports it, and whether that is an island.
REACH = FAR + 2 + EXTENT + LINK
_DISC = sum(b * b + a * a <= NEAR * NEAR for b in range(-NEAR, NEAR + 1) for a in range(-NEAR, NEAR + 1))
_LARGE, _SMALL, _FIRST = 1, 2, 3


#: Offsets of cells that are linked (row, column), nearest first, and their distances.
_OFFSETS, _DISTANCES = by_distance(LINK)


@njit
def _islands(raster, offsets, steps, out):
    """Of each cell whether it hangs together with many (`_LARGE`), with few (`_SMALL`), of which it is the first (`_FIRST`).

    Cells at `offsets` are linked across `steps`. Whatever is marked in `out` is not looked at.
    """
    h, w = raster.shape
    kind = np.zeros((h, w), np.uint8)
    rows, columns = np.empty((2, MOST + 1), np.int64)
    for j in range(h):
        for i in range(w):
            if raster[j, i] == HOLE or out[j, i] or kind[j, i]:
                continue
            rows[0], columns[0] = j, i
            kind[j, i] = _FIRST
            n, at, large = 1, 0, False
            low, left, right = j, i, i
            while at < n and not large:
                b, a = rows[at], columns[at]
                at += 1
                for k in range(len(steps)):
                    y, x = b + offsets[k, 0], a + offsets[k, 1]
                    if y < 0 or x < 0 or y >= h or x >= w or kind[y, x] > _LARGE or out[y, x]:
                        continue
                    if not abs(raster[y, x] - raster[b, a]) <= steps[k]:  # nor a hole
                        continue
                    low, left, right = max(low, y), min(left, x), max(right, x)
                    large = kind[y, x] == _LARGE or n == MOST or low - j >= EXTENT or right - left >= EXTENT
                    if large:
                        break
                    rows[n], columns[n] = y, x
                    kind[y, x] = _SMALL
                    n += 1
            if large:
                for k in range(n):
                    kind[rows[k], columns[k]] = _LARGE
    return kind


@device
def _lies_lowest(raster, kind, j, i, around, least):
    """Whether all that is no island around a cell is higher, if there is enough; and whether there is."""
    h, w = raster.shape
    n = 0
    for b in range(max(j - around, 0), min(j + around + 1, h)):
        for a in range(max(i - around, 0), min(i + around + 1, w)):
            if kind[b, a] == _LARGE:
                n += 1
                if raster[b, a] < raster[j, i] + BELOW:
                    return False, True
    return True, n >= least


@device
def _supported(raster, kind, j, i):
    """Whether enough of what is around a cell and no island is at its level."""
    h, w = raster.shape
    level = seen = 0
    for b in range(max(j - 2, 0), min(j + 3, h)):
        for a in range(max(i - 2, 0), min(i + 3, w)):
            if kind[b, a] == _LARGE:
                seen += 1
                level += abs(raster[b, a] - raster[j, i]) <= LEVEL
    return level > SUPPORT + SUPPORT_SHARE * seen


@device
def _has_company(raster, kind, cell, j, i, height, across, along):
    """Whether ground is as deep as a cell, or most of the islands around are."""
    h, w = raster.shape
    company = others = islands = 0
    z = raster[j, i]
    half = 0.5 * (height - z)
    for b in range(max(j - FAR, 0), min(j + FAR + 1, h)):
        for a in range(max(i - FAR, 0), min(i + FAR + 1, w)):
            if kind[b, a] == 0 or kind[b, a] == _SMALL:
                continue
            squared = (b - j) ** 2 + (a - i) ** 2
            if squared > FAR * FAR:
                continue
            away = cell * np.sqrt(float(squared))
            room = min(half, LEVEL + ROOM * away)
            below = height + across * (a - i) + along * (b - j) - raster[b, a]
            if kind[b, a] == _FIRST:
                if RING * RING < squared <= RING_FAR * RING_FAR and below >= half:
                    islands += 1
                    others += abs(raster[b, a] - z) <= room
            elif (
                below >= max(half, CURVE * away)
                and raster[b, a] <= z + room
                and _supported(raster, kind, b, a)
            ):
                company += 1
                if company == COMPANY:
                    return True
    return others >= ISLANDS and others >= ISLANDS_SHARE * islands


@njit
def _mark_deep(raster, base, cell, kind, mark, out):
    h, w = raster.shape
    size = (2 * WIDER + 1) ** 2
    u, v, zs, weight = np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    for j in range(h):
        for i in range(w):
            if kind[j, i] <= _LARGE:
                continue
            lowest, enough = _lies_lowest(raster, kind, j, i, BESIDE, ENOUGH)
            if lowest and not enough:
                lowest, enough = _lies_lowest(raster, kind, j, i, FARTHER, 0)
            if not lowest:
                continue
            n, height, across, along, scatter = envelope(base, j, i, NEAR, u, v, zs, weight)
            spacing = cell / np.sqrt(-np.log(1.0 - min((n + 1) / _DISC, 0.95)))
            if n < ENOUGH:
                n, height, across, along, scatter = envelope(base, j, i, WIDER, u, v, zs, weight)
            least = DEPTH + GROWTH * max(spacing - WIDE, 0.0) + SCATTERS * scatter
            if (
                n >= ENOUGH
                and height - raster[j, i] > least
                and not _has_company(raster, kind, cell, j, i, height, across, along)
            ):
                out[j, i] = mark


def mark_islands(raster: NDArray[np.float32], cell: float, mark: int, out: NDArray[np.uint8]) -> None:
    """Put `mark` where a low outlier is a cell of an island, into `out` (h, w), whose cells above 0 are left out.

    `raster` (h, w) is a minimum grid, with holes; heights and `cell`, the side of its cells, in meters.
    """
    steps = (STEP + GRADE * cell * _DISTANCES).astype(np.float32)
    kind = _islands(raster, _OFFSETS, steps, out)
    base = np.where(kind == _LARGE, raster, HOLE)
    _mark_deep(raster, base, cell, kind, mark, out)
