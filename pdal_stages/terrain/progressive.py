"""Which cells of a minimum grid are objects: openings with growing windows, and what each lowers [P13]."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from ..base.jit import njit
from .fewcells import are_few, objects_among
from .openings import HOLE, dilate, erode_step, opening_radii, square_steps

#: Drops beyond this are objects however large the window: halls are not higher for being wider.
LARGEST_DROP = 3.5


@njit
def _mark(before, after, raster, drop, objects, floor):
    h, w = raster.shape
    for j in range(h):
        for i in range(w):
            if raster[j, i] != HOLE and not objects[j, i] and before[j, i] - after[j, i] > drop:
                objects[j, i] = True
                floor[j, i] = after[j, i]


def objects_of(
    raster: np.ndarray, cell: float, slope: float, window: int, keep: Collection[int] = ()
) -> tuple[np.ndarray, np.ndarray, Mapping[int, np.ndarray]]:
    """Cells that an opening lowers by more than `slope` times its radius, or than `LARGEST_DROP`.

    `raster` is the minimum grid (h, w), float32, with holes; it and `cell`, a cell's side, are in meters. `window` is the
    largest radius and `keep` lists radii whose openings are wanted, in cells. Returned are the objects (h, w), what the
    opening that showed an object left there (elsewhere the cell's own height), and the openings of `keep`.
    """
    h, w = raster.shape
    radii = set(opening_radii(window))
    wanted = {
        radius: min(radius, h + w) for radius in keep
    }  # a window of that radius holds all of the raster
    keep = set(wanted.values())
    largest = min(max(radii.union(keep)), h + w)
    drops = {radius: np.float32(min(slope * radius * cell, LARGEST_DROP)) for radius in sorted(radii)}
    if are_few(int(np.count_nonzero(raster != HOLE)), h, w, largest):
        objects, floor, openings = objects_among(
            raster, {r: d for r, d in drops.items() if r <= largest}, keep
        )
        return objects, floor, {radius: openings[held] for radius, held in wanted.items()}
    eroded, other = raster.copy(), np.empty_like(raster)
    before, after = raster.copy(), np.empty_like(raster)
    objects, floor = np.zeros((h, w), bool), raster.copy()
    pad = 2 * (largest + 1)
    one, two = np.empty((2, (h + pad) * (w + pad)), np.float32)
    openings = {}
    for radius in range(1, largest + 1):
        squares = square_steps(radius)
        erode_step(eroded, other, squares > square_steps(radius - 1))
        eroded, other = other, eroded
        if radius in radii or radius in keep:
            dilate(eroded, raster, radius, squares, one, two, after)
        if radius in keep:
            openings[radius] = after.copy()
        if radius in radii:
            _mark(before, after, raster, drops[radius], objects, floor)
            before, after = after, before
    return objects, floor, {radius: openings[held] for radius, held in wanted.items()}
