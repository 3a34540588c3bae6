"""Morphological openings of a minimum grid, and the objects that growing ones show [P13].

Holes near measured cells are filled first, as SMRF inpaints them: between scattered points of a
slope, an opening would lower each to its lowest neighbor in the window. Other holes are ``+inf``:
erosion passes over them, and no window is centered on one, so an opening is the highest level that
a window centered on known cells reaches. Octagons (squares and diamonds taken in turn) treat ridges
alike whatever their direction, as discs do, but fall apart into lines, so an opening costs the
logarithm of its radius.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from ..base.jit import njit
from ..base.threads import map_blocks
from .cells import HOLE

#: Cells beyond measured ones, along both axes and diagonals, up to which holes are filled. Clips
#: with holes lose 0.3 points with 2, surveys 0.4 with 8, and clips and the ISPRS samples without.
FILL_RINGS = 3
#: Cells of the rows that a thread takes at a time; results do not depend on it.
_BAND_CELLS = 1 << 19


def growing_radii(largest: int) -> list[int]:
    """Return radii in cells, each larger by a fifth, at least 1 and at most 2 cells.

    With larger steps slopes would drop as objects do.
    """
    radii = [1]
    while (radius := radii[-1] + min(max(1, radii[-1] // 5), 2)) < largest:
        radii.append(radius)
    return sorted({*radii, largest})


def _steps(radius: int) -> tuple[int, int]:
    """Return the numbers of squares and diamonds of radius 1 that add up to an octagon.

    tan(22.5 degrees) of them are squares.
    """
    squares = int(0.41421356 * radius)
    return squares, radius - squares


def highest_around(
    raster: NDArray, squares: int, diamonds: int, threads: int | None = 1
) -> NDArray:
    """Return the maximum (h, w) over these numbers of squares and diamonds around each cell.

    A thread takes some rows with those around that matter: what it works on stays in its cache.
    """
    least, pad, h = raster.min(), squares + diamonds + 1, len(raster)
    rows = max(_BAND_CELLS // max(raster.shape[1], 1), 8 * pad)
    out = np.empty_like(raster)

    def fill(first: int) -> None:
        last, low = min(first + rows, h), max(first - pad, 0)
        part = _highest_of_rows(raster[low : last + pad], least, squares, diamonds)
        out[first:last] = part[first - low : last - low]

    list(map_blocks(fill, range(0, h, rows), threads))
    return out


def _highest_of_rows(raster: NDArray, least: float, squares: int, diamonds: int) -> NDArray:
    """Return the maximum (h, w) around each cell of some rows; outside them is the `least` value.

    Each line of an octagon is a running maximum on the flat raster with a margin round it, by
    doubling: a maximum of 2m cells is that of two of m. Two diagonals and a cross of five cells
    make a diamond.
    """
    pad = squares + diamonds + 1
    h, w = raster.shape
    padded = np.full((h + 2 * pad, w + 2 * pad), least, raster.dtype)
    padded[pad : pad + h, pad : pad + w] = raster
    values, stride = padded.ravel(), w + 2 * pad
    spare, n = np.empty_like(values), values.size
    side = 2 * squares + 1
    for step, length in ((1, side), (stride, side), (stride + 1, diamonds), (stride - 1, diamonds)):
        done = 1
        while done < length:
            more = min(done, length - done)
            n -= more * step
            np.maximum(values[:n], values[more * step :][:n], out=spare[:n])
            values, spare = spare, values
            done += more
    start = pad * (stride + 1) - squares * (stride + 1) - max(diamonds - 1, 0) * stride
    size = (h - 1) * stride + w

    def shifted(by: int) -> NDArray:
        return values[start + by : start + by + size]

    out = shifted(0)
    if diamonds:
        out = np.maximum(out, shifted(1), out=spare[:size])
        for by in (-1, stride, -stride):
            np.maximum(out, shifted(by), out=out)
    return np.lib.stride_tricks.as_strided(out, (h, w), (stride * out.itemsize, out.itemsize))


@njit
def _fill_ring(heights, known):
    """Fill the holes that touch `known` cells (n,) with the mean of their known neighbors.

    Returns the filled cells (m,).

    Cells are numbered row by row. Neighbors at an edge count twice those at a corner.
    """
    h, w = heights.shape
    filled, n = np.empty(min(8 * len(known), heights.size - len(known)), np.int64), 0
    for cell in known:
        j, i = cell // w, cell % w
        for b in range(max(j - 1, 0), min(j + 2, h)):
            for a in range(max(i - 1, 0), min(i + 2, w)):
                if heights[b, a] == HOLE:
                    heights[b, a] = -HOLE  # until all means are known
                    filled[n] = b * w + a
                    n += 1
    means = np.empty(n, np.float32)
    for k in range(n):
        j, i = filled[k] // w, filled[k] % w
        total, weights = 0.0, 0
        for b in range(max(j - 1, 0), min(j + 2, h)):
            for a in range(max(i - 1, 0), min(i + 2, w)):
                if np.isfinite(heights[b, a]):
                    weight = 2 if a == i or b == j else 1
                    total += weight * np.float64(heights[b, a])
                    weights += weight
        means[k] = np.float32(total / weights)
    for k in range(n):
        heights[filled[k] // w, filled[k] % w] = means[k]
    return filled[:n]


def fill_holes(raster: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the raster (h, w) in meters, with `FILL_RINGS` rings of holes filled."""
    filled = raster.copy()
    known = np.flatnonzero(raster != HOLE)
    for _ in range(FILL_RINGS):
        known = _fill_ring(filled, known)
    return filled


def openings_of(
    raster: NDArray[np.float32], radii: Iterable[int], threads: int | None = 1
) -> Iterator[tuple[int, NDArray[np.float32]]]:
    """Yield ascending radii in cells and openings (h, w) by octagons in meters."""
    # Erosion is the maximum of what is upended. The ceiling keeps windows from holes.
    ceiling = np.where(raster != HOLE, HOLE, -HOLE)
    lowest_upended = np.where(raster != HOLE, -raster, -HOLE)
    done = 0, 0
    for radius in sorted(radii):
        squares, diamonds = _steps(min(radius, sum(raster.shape)))
        lowest_upended = highest_around(
            lowest_upended, squares - done[0], diamonds - done[1], threads
        )
        done = squares, diamonds
        yield (
            radius,
            highest_around(np.minimum(-lowest_upended, ceiling), squares, diamonds, threads),
        )


def objects_of(
    raster: NDArray[np.float32],
    cell: float,
    slope: float,
    window: int,
    keep: Collection[int] = (),
    threads: int | None = 1,
) -> tuple[NDArray[np.bool_], NDArray[np.float32], dict[int, NDArray[np.float32]]]:
    """Find the cells that an opening lowers by more than `slope` times its radius [P13, 2.2].

    Parameters
    ----------
    raster : (h, w) float32
        The minimum grid, with holes; meters.
    cell : float
        Side of a cell in meters.
    window : int
        Radius of the largest window in cells; windows grow from 1 cell to it.
    keep : collection of int
        Radii in cells whose openings are returned.
    threads : int, optional

    Returns
    -------
    objects : (h, w) bool
    floor : (h, w) float32
        What the first opening that lowered an object left there; elsewhere the cell's own height.
    openings : dict
        Radius -> (h, w) float32, of `keep`.
    """
    measured, openings = raster != HOLE, {}
    filled = fill_holes(raster)
    objects, floor, before = np.zeros(raster.shape, bool), raster.copy(), filled
    # An opening lowers nothing by more than all heights differ.
    range_m = np.ptp(raster[measured]) if measured.any() else 0.0
    drops = {radius: np.float32(slope * radius * cell) for radius in growing_radii(window)}
    drops = {radius: drop for radius, drop in drops.items() if drop < range_m}
    for radius, opened in openings_of(filled, {*drops, *keep}, threads):
        if radius in keep:
            openings[radius] = opened
        if radius in drops:
            lowered = measured & ~objects
            lowered[lowered] = before[lowered] - opened[lowered] > drops[radius]
            objects |= lowered
            floor[lowered] = opened[lowered]
            before = opened
    return objects, floor, openings
