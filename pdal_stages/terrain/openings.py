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
#: Columns that are opened at once.
_STRIP = 1024
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
def _copy(source, out):
    for i in range(len(out)):
        out[i] = source[i]


@device
def _lowest_of_three(a, b, c, out):
    """Element by element; a function of its own, or the compiler does not vectorize it."""
    for i in range(len(out)):
        low = a[i] if a[i] < b[i] else b[i]
        out[i] = low if low < c[i] else c[i]


@device
def _higher(a, b, out):
    for i in range(len(out)):
        out[i] = a[i] if a[i] > b[i] else b[i]


@device
def _raise(out, other):
    for i in range(len(out)):
        out[i] = out[i] if out[i] > other[i] else other[i]


@device
def _highest_of_cross(a, b, c, d, e, out):
    for i in range(len(out)):
        high = a[i] if a[i] > b[i] else b[i]
        also = c[i] if c[i] > d[i] else d[i]
        high = high if high > also else also
        out[i] = high if high > e[i] else e[i]


@device
def _measured(values, raster, hole, nothing, out):
    for i in range(len(out)):
        out[i] = nothing if raster[i] == hole else values[i]


@njit
def erode_step(source, target, square, hole):
    """Minimum over the 3 x 3 cells round each cell, or over the cross of five; beyond the raster are holes."""
    h, w = source.shape
    column = np.empty(w + 2, source.dtype)
    middle = np.empty(w, source.dtype)
    column[0] = column[-1] = hole
    for j in range(h):
        above, here, below = source[max(j - 1, 0)], source[j], source[min(j + 1, h - 1)]
        _lowest_of_three(above, here, below, middle)
        _copy(middle if square else here, column[1:-1])
        _lowest_of_three(column[:-2], middle, column[2:], target[j])


@device
def _row_maximum(row, spare, length):
    """Running maximum of `length` cells of a row, starting at each cell; what lies beyond it is left out.

    Doubling: a maximum of 2m cells is that of two of m cells. A row stays in a core's cache meanwhile. Returns the one of
    both rows that holds it.
    """
    w = len(row)
    done = 1
    while done < length:
        step = min(done, length - done, w)
        _higher(row[: w - step], row[step:], spare[: w - step])
        _copy(row[w - step :], spare[w - step :])
        row, spare = spare, row
        done += step
    return row


@device
def _line_maximum(row, at, length, dx, pieces, running, out):
    """Running maximum of `length` cells along (1, dx), row by row: takes row number `at`, gives that `length` - 1 before.

    Van Herk's way [H92]: lines are cut into pieces of `length` rows, and a window ends in the piece after the one in which
    it begins. So it is the larger of the maxima to the end of the one and from the begin of the other. `pieces`
    (2 x length, w) hold the former and the rows of the piece that comes, `running` (2, w) the latter; `dx` is 1, 0 or -1.
    What lies beyond the columns is left out.

    [H92] van Herk (1992): A fast algorithm for local minimum and maximum filters on rectangular and octagonal kernels.
    Pattern Recognition Letters 13, 517-521.
    """
    w = len(row)
    if length == 1:
        _copy(row, out)
        return
    k, piece = at % length, at // length % 2
    come, held = pieces[piece * length :], pieces[(1 - piece) * length :]
    left, right = max(dx, 0), max(-dx, 0)
    _copy(row, come[k])
    here, before = running[at % 2], running[(at + 1) % 2]
    _copy(row, here)
    if k > 0:
        _raise(here[left : w - right], before[right : w - left])
    if k == length - 1:
        for n in range(length - 2, -1, -1):
            _raise(come[n][right : w - left], come[n + 1][left : w - right])
        _copy(come[0], out)
    elif at >= length:
        left, right = min(left * (length - 1), w), min(right * (length - 1), w)
        _copy(held[k + 1], out)
        _raise(out[right : w - left], here[left : w - right])


def room_for(radius: int, height: int, width: int) -> int:
    """Numbers that :func:`dilate` keeps meanwhile."""
    squares = square_steps(radius)
    rows = 2 * (2 * squares + 1) + 4 * (radius - squares) + 3 * 2 + 3 + 4
    return rows * (min(width, _STRIP) + 2 * (radius + 1))


@njit
def dilate(eroded, raster, radius, squares, hole, nothing, room, target):
    """Maximum over the octagon round each cell of `eroded` at measured cells of `raster`, those that are no `hole`.

    Elsewhere is `nothing`, the least of all values. `room` is flat, and its content is lost: see :func:`room_for`. All steps
    are taken row by row, in strips of columns, so that what they need of each other stays in a core's cache.
    """
    h, w = eroded.shape
    side, diamonds, pad = 2 * squares + 1, radius - squares, radius + 1
    for begin in range(0, w, _STRIP):
        end = min(begin + _STRIP, w)
        width = end - begin + 2 * pad
        rows = room[: len(room) // width * width].reshape(-1, width)
        upright, rows = rows[: 2 * side], rows[2 * side :]
        down, rows = rows[: 2 * diamonds], rows[2 * diamonds :]
        up, rows = rows[: 2 * diamonds], rows[2 * diamonds :]
        one, two, three, cross, spare = rows[:2], rows[2:4], rows[4:6], rows[6:9], rows[9:13]
        first, last = max(begin - pad, 0), min(end + pad, w)
        inside = first - begin + pad
        # Rows and columns: a square. Both diagonals, then a cross: a full diamond. Each step looks ahead, to rows that
        # come after and columns that lie right, the second diagonal left: a window's middle is as far behind.
        for at in range(h + 2 * radius):
            row = spare[0]
            row[:] = nothing
            j = at - radius
            if 0 <= j < h:
                mine = row[inside : inside + last - first]
                _measured(eroded[j][first:last], raster[j][first:last], hole, nothing, mine)
                row = _row_maximum(row, spare[1], side)
            _line_maximum(row, at, side, 0, upright, one, spare[2])
            at -= side - 1
            if at < 0:
                continue
            _line_maximum(spare[2], at, diamonds, 1, down, two, spare[3])
            at -= diamonds - 1
            if at < 0:
                continue
            _line_maximum(spare[3], at, diamonds, -1, up, three, cross[(at - diamonds + 1) % 3])
            at -= diamonds - 1
            if at < 2:
                continue
            x, wide = pad - squares, end - begin
            here = cross[(at - 1) % 3]
            _highest_of_cross(
                cross[at % 3][x : x + wide], cross[(at - 2) % 3][x : x + wide],
                here[x - 1 : x - 1 + wide], here[x + 1 : x + 1 + wide], here[x : x + wide],
                target[at - 2][begin:end],
            )  # fmt: skip
