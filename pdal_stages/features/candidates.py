"""Candidates of a radius: the points of the cells a neighborhood can touch, copied into flat scratch arrays.

All queries of a cell share them. The list depends on (cloud, cell, radius) only: cells that lie wholly inside
the cylinder for *every* query of the cell come first, then the others; within either, rows of cells ascend,
then columns, then the coordinates of the points. Both parts are padded with points infinitely far for all practical
purposes to a whole number of vectors, so that loops over them have no scalar tail.
"""

from __future__ import annotations

import numpy as np
from llvmlite import ir

from ..base.jit import device, intrinsic
from .index import SPARE

#: Coordinates of padding points: the square is still finite, and larger than any squared radius.
FAR = 1e150
LANES = SPARE

#: With no more rows of cells than this between center and rim, sharing the inner cells costs more than it saves.
INNER_FROM = 2


@intrinsic
def order_bits(types, value):
    """The bits of a float64 as an int64 that orders like the float (integer minima vectorize, float ones do not)."""

    def codegen(context, builder, signature, args):
        i64 = ir.IntType(64)
        bits = builder.bitcast(args[0], i64)
        sign = builder.ashr(bits, ir.Constant(i64, 63))
        return builder.xor(bits, builder.and_(sign, ir.Constant(i64, 2**63 - 1)))

    return types.int64(types.float64), codegen


@intrinsic
def from_order_bits(types, value):
    """The float64 whose :func:`order_bits` are given."""

    def codegen(context, builder, signature, args):
        i64 = ir.IntType(64)
        sign = builder.ashr(args[0], ir.Constant(i64, 63))
        bits = builder.xor(args[0], builder.and_(sign, ir.Constant(i64, 2**63 - 1)))
        return builder.bitcast(bits, ir.DoubleType())

    return types.float64(types.int64), codegen


def half_widths(radius, cell):
    """Cells a neighborhood of `radius` can touch, and cells it surely covers, row by row.

    A cell is half open, so one whose nearest border is `radius` away holds no member: its points are farther, be
    it by less than rounding shows.

    Returns
    -------
    (2, 2 R + 1) int64 array
        For the rows -R..R of cells round a query's own cell: the largest column offset that some query in
        the cell may reach, and the largest one that every query in the cell covers wholly (-1: none).
    """
    r2 = radius * radius
    reach = int(np.ceil(radius / cell)) + 1
    while reach > 0 and ((reach - 1) * cell) * ((reach - 1) * cell) >= r2:
        reach -= 1
    widths = np.empty((2, 2 * reach + 1), np.int64)
    for row in range(-reach, reach + 1):
        near, far = max(abs(row) - 1, 0), abs(row) + 1
        outer = reach
        while outer > 0 and (near**2 + (outer - 1) ** 2) * cell**2 >= r2:
            outer -= 1
        inner = -1
        if reach > INNER_FROM:
            while (far**2 + (inner + 2) ** 2) * cell**2 <= r2:
                inner += 1
        widths[0, row + reach], widths[1, row + reach] = outer, inner
    return widths


@device(forceinline=True)
def _lower(values, first, last, wanted):
    """First position in the sorted ``values[first:last]`` whose value is not below `wanted`."""
    while first < last:
        middle = (first + last) >> 1
        if values[middle] < wanted:
            first = middle + 1
        else:
            last = middle
    return first


@device
def fill_strip(cell_ix, cell_start, row_iy, row_start, iy, left, reach, columns, strip):
    """Make a dense table of where points begin, for the rows ``iy - reach .. iy + reach``.

    ``strip[k, c]`` becomes the first point of row ``iy - reach + k`` whose column is not below ``left + c``, for
    c in 0..columns: the points of columns a..b are ``strip[k, a - left]`` to ``strip[k, b + 1 - left]``.
    """
    row = _lower(row_iy, np.int64(0), len(row_iy), iy - reach)
    for k in range(2 * reach + 1):
        if row >= len(row_iy) or row_iy[row] != iy - reach + k:
            strip[k, : columns + 1] = 0
            continue
        at, end = row_start[row], row_start[row + 1]
        at = _lower(cell_ix, at, end, left)
        c = 0
        while at < end and cell_ix[at] <= left + columns:
            upto, start = cell_ix[at] - left, cell_start[at]
            while c <= upto:
                strip[k, c] = start
                c += 1
            at += 1
        start = cell_start[at]  # the last one belongs to the next row, or is the number of points
        while c <= columns:
            strip[k, c] = start
            c += 1
        row += 1


@intrinsic
def _copy8(types, target, i, source, j):
    """Eight float64 at once, as one or a few vector registers."""
    signature = types.void(target, types.int64, source, types.int64)

    def codegen(context, builder, signature, args):
        vector = ir.VectorType(ir.DoubleType(), LANES).as_pointer()

        def place(kind, array, index):
            data = context.make_array(kind)(context, builder, array).data
            return builder.bitcast(builder.gep(data, [index]), vector)

        value = builder.load(place(signature.args[2], args[2], args[3]), align=8)
        builder.store(value, place(signature.args[0], args[0], args[1]), align=8)
        return context.get_dummy_value()

    return signature, codegen


@device(forceinline=True)
def _copy(x, y, z, first, last, px, py, pz, at):
    """Append the points first..last; what a whole vector copies too much is overwritten by the next."""
    n = last - first
    for i in range(0, n, LANES):
        _copy8(px, at + i, x, first + i)
        _copy8(py, at + i, y, first + i)
        _copy8(pz, at + i, z, first + i)
    return at + n


@device(forceinline=True)
def _pad(px, py, pz, at):
    while at % LANES:
        px[at], py[at], pz[at] = FAR, FAR, 0.0
        at += 1
    return at


@device
def count_candidates(strip, reach, width, own, column):
    """How many points :func:`gather` would copy (without padding)."""
    total = 0
    for k in range(2 * own + 1):
        line, w = k + reach - own, width[0, k]
        total += strip[line, column + w + 1] - strip[line, column - w]
    return total


@device
def gather(x, y, z, strip, reach, width, own, column, px, py, pz):
    """Copy the candidates of one radius: the wholly covered cells first, then the others, each padded.

    Parameters
    ----------
    x, y, z : (n + SPARE,) float64 arrays
        The sorted cloud and a vector to spare.
    strip, reach : array, int
        :func:`fill_strip`'s table and the reach it was made for.
    width, own : (2, 2 own + 1) int64 array, int
        :func:`half_widths` of the radius, and its own reach.
    column : int
        The column of the queries' cell, counted from the strip's left.
    px, py, pz : float64 arrays
        Scratch, with room for the candidates and three more vectors.

    Returns
    -------
    inner, end : int
        ``[0, inner)`` is covered by every query's cylinder, ``[inner, end)`` has to be tested.
    """
    at = 0
    if own > INNER_FROM:
        for k in range(2 * own + 1):
            v = width[1, k]
            if v >= 0:
                line = k + reach - own
                at = _copy(x, y, z, strip[line, column - v], strip[line, column + v + 1], px, py, pz, at)
        at = _pad(px, py, pz, at)
    inner = at
    for k in range(2 * own + 1):
        w, v, line = width[0, k], width[1, k], k + reach - own
        if v < 0:
            at = _copy(x, y, z, strip[line, column - w], strip[line, column + w + 1], px, py, pz, at)
        else:
            at = _copy(x, y, z, strip[line, column - w], strip[line, column - v], px, py, pz, at)
            at = _copy(x, y, z, strip[line, column + v + 1], strip[line, column + w + 1], px, py, pz, at)
    return inner, _pad(px, py, pz, at)
