"""Planes of a roof, of the heights of its cells."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..base.jit import device, njit

#: Smallest plane that counts, m2.
SMALLEST = 3.0


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


@njit
def _grown(
    z: NDArray, east: NDArray, north: NDArray, seeds: NDArray, size: float, tilt: float, away: float
) -> NDArray:
    """Number of each cell's plane, from 0; -1 outside. Planes grow from the flattest places on."""
    rows, columns = z.shape
    plane = np.full(z.shape, -1, np.int32)
    stack = np.empty(rows * columns, np.int64)
    count = 0
    for n in seeds:
        r0, c0 = n // columns, n % columns
        if plane[r0, c0] >= 0:
            continue
        a, b, h = east[r0, c0], north[r0, c0], z[r0, c0]
        plane[r0, c0] = count
        stack[0], top = n, 1
        while top > 0:
            top -= 1
            r, c = stack[top] // columns, stack[top] % columns
            for i in range(max(r - 1, 0), min(r + 2, rows)):
                for j in range(max(c - 1, 0), min(c + 2, columns)):
                    if plane[i, j] >= 0 or np.isnan(z[i, j]):
                        continue
                    line = h + a * (j - c0) * size + b * (i - r0) * size
                    span = np.sqrt((i - r0) ** 2.0 + (j - c0) ** 2.0) * size
                    if abs(z[i, j] - line) > away + 0.03 * span:
                        continue
                    if np.isnan(east[i, j]) or abs(east[i, j] - a) + abs(north[i, j] - b) > tilt:
                        continue
                    plane[i, j] = count
                    stack[top] = i * columns + j
                    top += 1
        count += 1
    return plane


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
    cells = int(np.count_nonzero(~np.isnan(z)))
    order = np.argsort(off, axis=None, kind="stable")
    seeds = order[off.ravel()[order] < 0.25]
    if cells == 0 or seeds.size == 0:
        return 0, 0.0, 0.0
    plane = _grown(z, east, north, seeds, size, 0.35, 0.3)
    inside = plane >= 0
    many = np.bincount(plane[inside])
    large = many * size * size >= SMALLEST
    if not large.any():
        return 0, 0.0, 0.0
    taken = inside & large[np.where(inside, plane, 0)]
    known = taken & ~np.isnan(east)
    slope = np.degrees(np.arctan(np.hypot(east[known], north[known])))
    return int(large.sum()), float(slope.mean()), float(taken.sum() / cells)
