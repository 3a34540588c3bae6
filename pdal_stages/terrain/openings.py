"""Morphological openings of a raster with holes, by octagons of growing radius.

A hole is ``+inf``: erosion passes over it, and no window is centered on one, so an opening is the highest
level that a window centered on measured cells reaches. Octagons (squares and diamonds taken in turn) treat
ridges alike whatever their direction, as discs do, but fall apart into lines, so an opening costs the
logarithm of its radius.
"""

from __future__ import annotations

import numpy as np

from ..base.jit import device, njit

HOLE = np.float32(np.inf)
_NOTHING = np.float32(-np.inf)
#: Share of squares among the steps of a regular octagon, tan(22.5 degrees).
_SQUARES = 0.41421356


def square_steps(radius: int) -> int:
    """How many of the steps to an octagon of `radius` cells are squares; the others are diamonds."""
    return int(_SQUARES * radius)


def opening_radii(largest: int) -> list[int]:
    """Radii in cells: each one up to 16, then every other one."""
    return sorted({*range(1, min(largest, 16) + 1), *range(18, largest, 2), largest})


@device
def _higher(a, b, out):
    """Element by element maximum; a function of its own, or the compiler does not vectorize it."""
    for i in range(len(out)):
        out[i] = a[i] if a[i] > b[i] else b[i]


@device
def _copy(source, out):
    for i in range(len(out)):
        out[i] = source[i]


@device
def _lowest_of_three(a, b, c, out):
    for i in range(len(out)):
        low = a[i] if a[i] < b[i] else b[i]
        out[i] = low if low < c[i] else c[i]


@device
def _highest_of_cross(a, b, c, d, e, out):
    for i in range(len(out)):
        high = a[i] if a[i] > b[i] else b[i]
        also = c[i] if c[i] > d[i] else d[i]
        high = high if high > also else also
        out[i] = high if high > e[i] else e[i]


@njit
def erode_step(source, target, square):
    """Minimum over the 3 x 3 cells round each cell, or over the cross of five."""
    h, w = source.shape
    column = np.empty(w + 2, source.dtype)
    middle = np.empty(w, source.dtype)
    column[0] = column[-1] = HOLE
    for j in range(h):
        above, here, below = source[max(j - 1, 0)], source[j], source[min(j + 1, h - 1)]
        _lowest_of_three(above, here, below, middle)
        _copy(middle if square else here, column[1:-1])
        _lowest_of_three(column[:-2], middle, column[2:], target[j])


@device
def _line_maximum(one, two, dy, dx, length):
    """Running maximum of `length` cells along (dy, dx), starting at each cell, in `one`.

    Doubling: a maximum of 2m cells is that of two of m cells. Returns the buffer that holds it and
    the other one; what lies beyond the array is left out.
    """
    h, w = one.shape
    done = 1
    while done < length:
        step = min(done, length - done)
        sy, sx = dy * step, dx * step
        for j in range(h):
            if 0 <= j + sy < h:
                _higher(one[j][: w - sx], one[j + sy][sx:], two[j][: w - sx])
                _copy(one[j][w - sx :], two[j][w - sx :])
            else:
                _copy(one[j], two[j])
        one, two = two, one
        done += step
    return one, two


@njit
def dilate(eroded, raster, radius, squares, one, two, target):
    """Maximum over the octagon round each cell of `eroded` at measured cells of `raster`.

    `one` and `two` are flat buffers of at least the raster's size with `radius` + 1 cells more on every side.
    """
    h, w = eroded.shape
    pad = radius + 1
    height, width = h + 2 * pad, w + 2 * pad
    one, two = one[: height * width].reshape(height, width), two[: height * width].reshape(height, width)
    for j in range(height):
        row = one[j]
        for i in range(width):
            row[i] = _NOTHING
        if pad <= j < pad + h:
            inner, e, f = row[pad : pad + w], eroded[j - pad], raster[j - pad]
            for i in range(w):
                inner[i] = _NOTHING if f[i] == HOLE else e[i]
    # Running maxima look ahead; `top` and `left` say how far the middle of the window lies behind.
    side = 2 * squares + 1
    top, left = squares, squares
    diamonds = radius - squares
    # Rows and columns: a square. A cross, then both diagonals: a full diamond.
    for dy, dx, length in ((0, 1, side), (1, 0, side), (1, 1, diamonds), (-1, 1, diamonds)):
        one, two = _line_maximum(one, two, dy, dx, length)
    left += max(diamonds - 1, 0)
    for j in range(h):
        y, x, out = j + pad - top, pad - left, target[j]
        here = one[y][x : x + w]
        if diamonds > 0:
            before, after = one[y][x - 1 : x - 1 + w], one[y][x + 1 : x + 1 + w]
            _highest_of_cross(one[y - 1][x : x + w], one[y + 1][x : x + w], before, after, here, out)
        else:
            _copy(here, out)
