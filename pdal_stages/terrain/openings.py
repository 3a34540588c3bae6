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


def by_distance(reach: int) -> tuple[np.ndarray, np.ndarray]:
    """Offsets (row, column) within `reach` cells, nearest first, and their distances."""
    j, i = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    squared = (j * j + i * i).ravel()
    order = np.lexsort((i.ravel(), j.ravel(), squared))
    order = order[(squared[order] > 0) & (squared[order] <= reach * reach)]
    return np.column_stack([j.ravel(), i.ravel()])[order].astype(np.int64), np.sqrt(squared[order])


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
def _raise(out, other):
    for i in range(len(out)):
        out[i] = out[i] if out[i] > other[i] else other[i]


@device
def _row_maximum(row, spare, length):
    """Running maximum of `length` cells of a row, starting at each cell, in place; what lies beyond it is left out.

    Doubling: a maximum of 2m cells is that of two of m cells. A row stays in a core's cache meanwhile.
    """
    w = len(row)
    done = 1
    while done < length:
        step = min(done, length - done)
        if step >= w:
            break
        _copy(row, spare)
        _raise(row[: w - step], spare[step:])
        done += step


@device
def _line_maximum(one, two, dy, dx, length):
    """The same along (dy, dx), in `one`; dy is 1 or -1, dx 0 or 1. `two` is as large, and its content is lost.

    Van Herk's way [H92], row by row: lines are cut into pieces of `length` rows, and a window ends in the piece after the
    one in which it begins. So it is the larger of the maxima to the end of the one and from the begin of the other. Windows
    that end beyond the last column see their own piece alone.

    [H92] van Herk (1992): A fast algorithm for local minimum and maximum filters on rectangular and octagonal kernels.
    Pattern Recognition Letters 13, 517-521.
    """
    h, w = one.shape
    if length < 2:
        return
    start = 0 if dy > 0 else h - 1
    for k in range(h):  # from the begin of the piece
        here = two[start + dy * k]
        _copy(one[start + dy * k], here)
        if k % length:
            _raise(here[dx:], two[start + dy * (k - 1)][: w - dx])
    for k in range(h - 2, -1, -1):  # to its end
        if (k + 1) % length:
            _raise(one[start + dy * k][: w - dx], one[start + dy * (k + 1)][dx:])
    for k in range(h):
        last = min(k + length - 1, h - 1)
        shift = dx * (last - k)
        if last // length != k // length and shift < w:
            _raise(one[start + dy * k][: w - shift], two[start + dy * last][shift:])


@njit
def dilate(eroded, raster, radius, squares, one, two, target):
    """Maximum over the octagon round each cell of `eroded` at measured cells of `raster`.

    `one` and `two` are flat buffers of at least the raster's size with `radius` + 1 cells more on every side.
    """
    h, w = eroded.shape
    pad = radius + 1
    height, width = h + 2 * pad, w + 2 * pad
    one, two = one[: height * width].reshape(height, width), two[: height * width].reshape(height, width)
    # Running maxima look ahead; `top` and `left` say how far the middle of the window lies behind.
    side = 2 * squares + 1
    top, left = squares, squares
    diamonds = radius - squares
    spare = np.empty(width, np.float32)
    for j in range(height):
        row = one[j]
        for i in range(width):
            row[i] = _NOTHING
        if pad <= j < pad + h:
            inner, e, f = row[pad : pad + w], eroded[j - pad], raster[j - pad]
            for i in range(w):
                inner[i] = _NOTHING if f[i] == HOLE else e[i]
            _row_maximum(row, spare, side)
    # Rows and columns: a square. A cross, then both diagonals: a full diamond. Beyond the last of the raster's columns
    # there is nothing in the buffer, and it has more of these than any window.
    _line_maximum(one, two, 1, 0, side)
    _line_maximum(one, two, 1, 1, diamonds)
    _line_maximum(one, two, -1, 1, diamonds)
    left += max(diamonds - 1, 0)
    for j in range(h):
        y, x, out = j + pad - top, pad - left, target[j]
        here = one[y][x : x + w]
        if diamonds > 0:
            before, after = one[y][x - 1 : x - 1 + w], one[y][x + 1 : x + 1 + w]
            _highest_of_cross(one[y - 1][x : x + w], one[y + 1][x : x + w], before, after, here, out)
        else:
            _copy(here, out)
