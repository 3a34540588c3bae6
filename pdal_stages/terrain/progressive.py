"""Which cells of a minimum grid are objects: openings with growing windows, and what each lowers [P13]."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import NamedTuple

import numpy as np

from ..base.jit import device, njit
from .fewcells import are_few, objects_among
from .openings import HOLE, dilate, erode_step, opening_radii, room_for, square_steps

#: Drops beyond this are objects however large the window: halls are not higher for being wider.
LARGEST_DROP = 3.5
#: What only windows of a larger radius show, in meters, is a hall, or it is land that the rim of the cloud cuts off uphill.
WIDE = 24.0


#: Numbers of heights: of none, of the highest that is numbered, and of holes.
_NOTHING, _HIGHEST, _HOLE = np.uint16(0), 65_534, np.uint16(65_535)


#: Cells of a row that are looked at at once.
_SPAN = 128


@njit
def _numbered(raster, lowest, scale, heights, numbers):
    """Number heights, `scale` numbers per meter from `lowest` on; False where two would have one number."""
    for j in range(raster.shape[0]):
        for i in range(raster.shape[1]):
            height = raster[j, i]
            if height == HOLE:
                numbers[j, i] = _HOLE
                continue
            number = 1 + int((height - lowest) * scale)
            if heights[number] != height:
                if heights[number] != HOLE:
                    return False
                heights[number] = height
            numbers[j, i] = number
    return True


class Numbered(NamedTuple):
    """Heights in numbers of 16 bits, in their order: minima and maxima of numbers are those of heights."""

    grid: np.ndarray  #: (h, w) numbers, `_HOLE` in holes
    heights: np.ndarray  #: by number
    scale: float  #: numbers per meter, but for one more or less

    def least(self, drop: float) -> np.uint16:
        """By how much numbers differ where heights differ by more than this."""
        return np.uint16(min(max(int(drop * self.scale) - 2, 0), _HIGHEST))


def numbered(raster: np.ndarray) -> Numbered | None:
    """A minimum grid in numbers, None where it has too many heights: in centimeters there may be 640 m of them."""
    measured = raster[raster != HOLE]
    lowest, highest = (float(measured.min()), float(measured.max())) if measured.size else (0.0, 0.0)
    scale = (_HIGHEST - 1) / max(highest - lowest, 1.0)
    heights, numbers = np.full(int(_HOLE) + 1, HOLE), np.empty(raster.shape, np.uint16)
    if not _numbered(raster, lowest, scale, heights, numbers):
        return None
    heights[_NOTHING] = -HOLE
    return Numbered(numbers, heights, scale)


@njit
def _mark(before, after, drop, settled, floor):
    h, w = settled.shape
    for j in range(h):
        for i in range(w):
            if not settled[j, i] and before[j, i] - after[j, i] > drop:
                settled[j, i] = True
                floor[j, i] = after[j, i]


@device
def _some_lowered(before, after, settled, least):
    """Whether any of `_SPAN` that is not settled is lowered by more than `least`; looked at all at once."""
    found = False
    for i in range(_SPAN):
        high = before[i] if before[i] > after[i] else after[i]
        found |= (np.uint16(high - after[i]) > least) & (not settled[i])
    return found


@njit
def _mark_numbered(before, after, heights, least, drop, settled, floor):
    """As `_mark`, of numbers, which differ by more than `least` where heights do by more than `drop`."""
    h, w = settled.shape
    for j in range(h):
        for begin in range(0, w, _SPAN):
            end = min(begin + _SPAN, w)
            if end - begin == _SPAN and not _some_lowered(
                before[j, begin:end], after[j, begin:end], settled[j, begin:end], least
            ):
                continue
            for i in range(begin, end):
                if (before[j, i] > after[j, i] + least) & (not settled[j, i]):  # few, so told at once
                    level = heights[after[j, i]]
                    if heights[before[j, i]] - level > drop:
                        settled[j, i] = True
                        floor[j, i] = level


def objects_of(
    raster: np.ndarray, cell: float, slope: float, window: int, keep: Collection[int] = ()
) -> tuple[np.ndarray, np.ndarray, Mapping[int, np.ndarray], np.ndarray]:
    """Cells that an opening lowers by more than `slope` times its radius, or than `LARGEST_DROP`.

    `raster` is the minimum grid (h, w), float32, with holes; it and `cell`, a cell's side, are in meters. `window` is the
    largest radius and `keep` lists radii whose openings are wanted, in cells. Returned are the objects (h, w), what the
    opening that showed an object left there (elsewhere the cell's own height), the openings of `keep`, and which objects
    only windows beyond `WIDE` show.
    """
    h, w = raster.shape
    radii = set(opening_radii(window))
    wanted = {
        radius: min(radius, h + w) for radius in keep
    }  # a window of that radius holds all of the raster
    keep = set(wanted.values())
    largest = min(max(radii.union(keep)), h + w)
    drops = {radius: np.float32(min(slope * radius * cell, LARGEST_DROP)) for radius in sorted(radii)}
    narrowest = min((radius for radius in radii if radius * cell > WIDE), default=largest + 1)  # of the wide
    if are_few(int(np.count_nonzero(raster != HOLE)), h, w, largest):
        drops = {r: d for r, d in drops.items() if r <= largest}
        objects, floor, openings, wide = objects_among(raster, drops, keep, narrowest)
        return objects, floor, {radius: openings[held] for radius, held in wanted.items()}, wide
    settled, floor, openings = raster == HOLE, raster.copy(), {}
    narrow = settled
    coded = numbered(raster)
    grid = raster if coded is None else coded.grid
    hole, nothing = (HOLE, -HOLE) if coded is None else (_HOLE, _NOTHING)
    eroded, other, before, after = grid.copy(), np.empty_like(grid), grid.copy(), np.empty_like(grid)
    room = np.empty(room_for(largest, h, w), grid.dtype)
    for radius in range(1, largest + 1):
        squares = square_steps(radius)
        erode_step(eroded, other, squares > square_steps(radius - 1), hole)
        eroded, other = other, eroded
        if radius in radii or radius in keep:
            dilate(eroded, grid, radius, squares, hole, nothing, room, after)
        if radius in keep:
            openings[radius] = after.copy() if coded is None else coded.heights[after]
        if radius == narrowest:
            narrow = settled.copy()
        if radius in radii:
            if coded is None:
                _mark(before, after, drops[radius], settled, floor)
            else:
                least = coded.least(float(drops[radius]))
                _mark_numbered(before, after, coded.heights, least, drops[radius], settled, floor)
            before, after = after, before
    wide = settled & ~narrow
    settled &= raster != HOLE
    return settled, floor, {radius: openings[held] for radius, held in wanted.items()}, wide
