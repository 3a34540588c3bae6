"""Pits of the minimum grid: cells whose lowest point is an echo from below the ground, alone or in clusters.

What is asked of ground is a way to it: cells are linked across what may be a slope, and those that hang together with few
others are an island. One that lies below a plane under its surroundings, by more than these scatter about the plane, is a
low outlier, unless ground as deep is near, as a street is to a courtyard, below the plane by more than terrain slopes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..base.jit import device, njit
from .canopy import reach as canopy_reach
from .canopy import seen_through_canopy
from .envelope import (
    ENOUGH,
    NEAR,
    WIDER,
    envelope,
    has_company,
    reach_of_company,
    supported_columns,
)
from .linked import linked_cells
from .openings import HOLE

#: How far apart cells are linked, in cells, and across which step: so many meters, and so many per meter of distance.
LINK, STEP, GRADE = 3, 0.35, 0.15
#: An island has at most so many cells, and is no longer, in cells, along either axis.
MOST, EXTENT = 30, 20
#: One of so few cells, so many meters deep, is no ground whatever is near, where its surroundings are so smooth, in meters.
FEW, DROP, SMOOTH = 6, 3.0, 0.3
#: It lies so many meters below the plane, and so many times the scatter about it; deeper, by so much per meter of the
#: spacing of cells with points beyond WIDE, where a ditch may be a few cells.
DEPTH, SCATTERS, GROWTH, WIDE = 1.0, 4.0, 1.8, 0.7
#: Ground that shows that a deep place is ground may be so much higher, and is so much deeper than the plane, per meter.
ROOM, CURVE = 0.05, 0.15
#: Nothing but islands is lower, or higher by less than that, within so many cells; within more where few hold points.
BELOW, BESIDE, FARTHER = 0.5, 2, 4
_DISC = sum(b * b + a * a <= NEAR * NEAR for b in range(-NEAR, NEAR + 1) for a in range(-NEAR, NEAR + 1))


def reach(cell: float) -> int:
    """How far away cells change what is a pit: others, company, what supports it, and whether that is an island."""
    return canopy_reach(cell) + max(reach_of_company(cell) + 2, WIDER) + EXTENT + LINK


@device
def _lies_lowest(base, j, i, z, around, least):
    """Whether all that is no island around a cell is higher, and whether there is enough of it."""
    h, w = base.shape
    n = 0
    for b in range(max(j - around, 0), min(j + around + 1, h)):
        for a in range(max(i - around, 0), min(i + around + 1, w)):
            if base[b, a] < HOLE:
                n += 1
                if base[b, a] < z + BELOW:
                    return False, True
    return True, n >= least


@njit
def _mark_deep(raster, base, few, supported, cell, far, out):
    h, w = raster.shape
    size = (2 * WIDER + 1) ** 2
    u, v, zs, weight = np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    for j in range(h):
        for i in range(w):
            z = raster[j, i]
            if z == HOLE or base[j, i] < HOLE:
                continue
            lowest, enough = _lies_lowest(base, j, i, z, BESIDE, ENOUGH)
            if lowest and not enough:
                lowest, enough = _lies_lowest(base, j, i, z, FARTHER, 0)
            if not lowest:
                continue
            n, height, across, along, scatter = envelope(base, j, i, NEAR, u, v, zs, weight)
            spacing = cell / np.sqrt(-np.log(1.0 - min((n + 1) / _DISC, 0.95)))
            if n < ENOUGH or scatter > SMOOTH:
                wide = envelope(base, j, i, WIDER, u, v, zs, weight)
                if n < ENOUGH or wide[4] < scatter:
                    n, height, across, along, scatter = wide
            depth = height - z - SCATTERS * scatter
            if n >= ENOUGH and depth > DEPTH + GROWTH * max(spacing - WIDE, 0.0):
                alone = few[j, i] and depth > DROP and scatter <= SMOOTH
                out[j, i] = alone or not has_company(
                    base, supported, cell, far, ROOM, CURVE, j, i, z, height, across, along
                )


def pits(raster: NDArray[np.float32], cell: float) -> NDArray[np.bool_]:
    """Cells (h, w) of a minimum grid whose lowest point is a low outlier, from float32 heights, holes ``inf``; in meters."""
    number, size, side = linked_cells(raster, LINK, lambda away: STEP + GRADE * cell * away)
    small = (size <= MOST) & (side < EXTENT)
    out = np.zeros(raster.shape, bool)
    if small.any():
        base = np.where(small[number] & (number >= 0), HOLE, raster)
        few = (size <= FEW)[number]
        supported = np.zeros(raster.shape, bool)
        supported_columns(base, supported)
        _mark_deep(raster, base, few, supported, cell, reach_of_company(cell), out)
        if out.any():
            base = np.where(out, HOLE, raster)
            supported[:] = False
            supported_columns(base, supported)
            out &= ~seen_through_canopy(np.where(out, raster, HOLE), base, supported, cell)
    return out
