"""Every cylinder and sphere of a block of queries: candidates, moments, features."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..base.jit import device, njit
from .candidates import FAR, LANES, count_candidates, fill_strip, gather, half_widths
from .moments import (
    BATCH,
    FEATURES,
    MOMENTS,
    SX,
    SY,
    SZ,
    WIDTH,
    N,
    add_shared,
    cylinder_sums,
    finish,
    sphere_sums,
)
from .shapes import Work, shape_counts, shape_values

#: Columns of cells whose queries share one table of where points begin.
STRIP = 256

#: More than any squared distance, less than the square of the padding's.
EVERYTHING = 1e290


def width_table(radii: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """:func:`half_widths` of every radius in one (radii, 2, rows) table, and each one's reach in cells."""
    widths = [half_widths(radius, cell) for radius in radii.tolist()]
    reaches = np.array([width.shape[1] // 2 for width in widths])
    table = np.zeros((len(radii), 2, 2 * reaches.max() + 1), np.int64)
    for line, width in zip(table, widths, strict=True):
        line[:, : width.shape[1]] = width
    return table, reaches


class ShapeColumns(NamedTuple):
    """The shape distributions wanted of the k neighborhoods of a plan, where any are."""

    shaped: np.ndarray  # (k,) bool: of which neighborhoods
    columns: np.ndarray  # (k, 50) int64: columns of the output, or -1
    thresholds: np.ndarray  # (k, 5, 9) float32: of the bins, comparable (``ShapeBins.comparable``)
    seeds: np.ndarray  # (k, m) uint64: ``point_seeds`` of the queries, used where `shaped`
    record: np.ndarray  # (room + 4 * LANES, 4) float32: scratch
    counts: np.ndarray  # (50,) float32: scratch
    work: Work


@njit
def count_block(cell_ix, cell_start, row_iy, row_start, iy, ix, width):
    """Candidates of the radius of `width` for the cells (iy, ix), sorted by row and column."""
    reach = (width.shape[1] - 1) // 2
    strip = np.empty((2 * reach + 1, STRIP + 2 * reach + 1), np.int64)
    counts = np.empty(len(ix), np.int64)
    line, left, columns = 0, 0, -1
    for i in range(len(ix)):
        if columns < 0 or iy[i] != line or ix[i] >= left + reach + STRIP:
            line, left = iy[i], ix[i] - reach
            columns = STRIP + 2 * reach
            fill_strip(cell_ix, cell_start, row_iy, row_start, line, left, reach, columns, strip)
        counts[i] = count_candidates(strip, reach, width, reach, ix[i] - left)
    return counts


@njit
def radius_block(
    grid, cell, qx, qy, qz, copies, radii, widths, reaches, wanted, columns, shapes, few, room, out
):  # fmt: skip
    """Fill the features of cylinders and spheres for a block of queries.

    Parameters
    ----------
    grid : tuple
        ``CellGrid.tables()`` of the cloud.
    cell : float
        Edge of a grid cell, meters.
    qx, qy, qz : (m,) float64 arrays
        Queries, in the order of their cells (row, then column).
    copies : (m,) int64 array
        How many queries of the user's each stands for (equal coordinates are computed once).
    radii : (r,) float64 array
        Distinct radii, meters.
    widths, reaches : arrays
        :func:`width_table` of the radii.
    wanted : (r, 2) int64 array
        Number of the cylinder and of the sphere of each radius in `columns`, or -1.
    columns : (k, 13) int64 array
        Column of each neighborhood's features in `out`, or -1.
    shapes : ShapeColumns or None
        None compiles to a kernel without them, in half the time.
    few : (k,) int64 array
        Raised by the number of neighborhoods with fewer than three points.
    room : int
        Candidates that the largest radius has at most, of all queries in the block.
    out : (m, F) float32 array
    """
    x, y, z, cell_ix, cell_start, row_iy, row_start = grid
    reach = reaches[-1]
    strip = np.empty((2 * reach + 1, STRIP + 2 * reach + 1), np.int64)
    size = room + 4 * LANES
    px, py, pz = np.empty(size), np.empty(size), np.empty(size)
    moments = np.empty((len(columns), MOMENTS, WIDTH))
    inner = np.empty((MOMENTS, 1))
    volumes = np.empty(BATCH)
    line, left, right = 0, 1, 0  # row of the strip, columns of the queries it serves (none yet)
    for start in range(0, len(qx), BATCH):
        stop = min(start + BATCH, len(qx))
        a = start
        while a < stop:
            ix, iy = math.floor(qx[a] / cell), math.floor(qy[a] / cell)
            b = a + 1
            while b < stop and math.floor(qx[b] / cell) == ix and math.floor(qy[b] / cell) == iy:
                b += 1
            if iy != line or ix < left or ix > right:
                line, left, right = iy, ix, _last_column(qx, qy, a, cell, iy, ix + STRIP - 1)
                span = right - left + 1 + 2 * reach
                fill_strip(cell_ix, cell_start, row_iy, row_start, iy, left - reach, reach, span, strip)
            for k in range(len(radii)):
                own = reaches[k]
                shared, end = gather(x, y, z, strip, reach, widths[k], own, ix - left + reach, px, py, pz)
                r2 = radii[k] * radii[k]
                c, s = wanted[k, 0], wanted[k, 1]
                if c >= 0:
                    center = (ix + 0.5) * cell, (iy + 0.5) * cell
                    cylinders(px, py, pz, shared, end, qx, qy, qz, a, b, r2, center, inner, moments[c], start)
                if s >= 0:
                    spheres(px[:end], py[:end], pz[:end], qx, qy, qz, a, b, r2, moments[s], start)
                if shapes is not None:
                    for kind in range(2):
                        number = wanted[k, kind]
                        if number >= 0 and shapes.shaped[number]:
                            rows = px[:end], py[:end], pz[:end]
                            write_shapes(
                                shapes, number, rows, qx, qy, qz, a, b, r2, float(kind), moments[number],
                                start, out,
                            )  # fmt: skip
            a = b
        for k in range(len(radii)):
            r = radii[k]
            for kind in range(2):
                number = wanted[k, kind]
                if number >= 0:
                    volumes[:] = math.pi * r * r if kind == 0 else 4.0 / 3.0 * math.pi * r * r * r
                    moved = (
                        r * r if kind == 0 else 0.0
                    )  # points that all queries of a cell share are within r
                    tally = few[number : number + 1]
                    values = finish(
                        moments[number], stop - start, volumes, moved, qz[start:stop], tally,
                        copies[start:stop],
                    )  # fmt: skip
                    for f in range(FEATURES):
                        column = columns[number, f]
                        if column >= 0:
                            for j in range(stop - start):
                                out[start + j, column] = values[f, j]


@device
def _last_column(qx, qy, a, cell, iy, limit):
    """The last column, at most `limit`, of the queries from `a` on that lie in row `iy`."""
    last = math.floor(qx[a] / cell)
    for j in range(a + 1, len(qx)):
        column = math.floor(qx[j] / cell)
        if column > limit or math.floor(qy[j] / cell) != iy:
            break
        last = column
    return last


@device
def cylinders(px, py, pz, shared, end, qx, qy, qz, a, b, r2, center, inner, out, start):
    """Moments of one radius' cylinders for the queries a..b of one cell, whose center is given."""
    cx, cy = center
    cz = 0.0
    rx, ry, rz = px[shared:end], py[shared:end], pz[shared:end]
    if shared:
        n = 0
        for i in range(shared):  # the mean height: the best point to take moments about
            if px[i] < FAR:
                cz += pz[i]
                n += 1
        cz /= n
        zero = np.int64(0)  # not a literal, for which it would be compiled once more
        cylinder_sums(px[:shared], py[:shared], pz[:shared], cx, cy, cz, EVERYTHING, inner, zero)
    for j in range(a, b):
        cylinder_sums(rx, ry, rz, qx[j], qy[j], qz[j], r2, out, j - start)
        if shared:
            add_shared(inner, cx - qx[j], cy - qy[j], cz - qz[j], out, j - start)


@device
def spheres(px, py, pz, qx, qy, qz, a, b, r2, out, start):
    """Moments of one radius' spheres for the queries a..b of one cell."""
    for j in range(a, b):
        sphere_sums(px, py, pz, qx[j], qy[j], qz[j], r2, out, j - start)


@device
def write_shapes(shapes, number, candidates, qx, qy, qz, a, b, r2, spherical, moments, start, out):
    """Shape distributions of one neighborhood for the queries a..b of one cell."""
    px, py, pz = candidates
    record, counts = shapes.record, shapes.counts
    for j in range(a, b):
        n = members(px, py, pz, qx[j], qy[j], qz[j], r2, spherical, record)
        if n == 0:  # a query that is not a point of the cloud
            counts[:] = 0.0
        else:
            gx, gy, gz = centroid(moments, j - start)
            seed, thresholds = shapes.seeds[number, j], shapes.thresholds[number]
            shape_counts(record, n, gx, gy, gz, seed, thresholds, shapes.work, counts)
        for f in range(50):
            column = shapes.columns[number, f]
            if column >= 0:
                out[j, column] = counts[f]


@device
def members(px, py, pz, qx, qy, qz, r2, spherical, record):
    """List the members of one neighborhood in canonical order, as float32 offsets from the query.

    `spherical` is 1 for a sphere and 0 for a cylinder. Returns how many there are; `record` needs one
    row more than there are candidates.
    """
    n = 0
    for i in range(len(px)):
        dx, dy, dz = px[i] - qx, py[i] - qy, pz[i] - qz
        record[n, 0], record[n, 1], record[n, 2], record[n, 3] = dx, dy, dz, 0.0
        n += 1 if dx * dx + dy * dy + spherical * (dz * dz) <= r2 else 0
    return n


@device(forceinline=True)
def centroid(moments, j):
    """Centroid of one neighborhood relative to its query, from its moments."""
    n = moments[N, j]
    return np.float32(moments[SX, j] / n), np.float32(moments[SY, j] / n), np.float32(moments[SZ, j] / n)


@njit
def radius_values(grid, cell, qx, qy, qz, radius, width, spherical, seeds, work, room, out):
    """The shape metrics of every pull for a few queries: what bins are fitted to.

    Parameters are those of :func:`radius_block` for one neighborhood, `width` its :func:`half_widths`; `out` is (m, 5, 255)
    float32, in the comparable form of ``shapes.shape_values``. Neighborhoods that are empty give NaN.
    """
    x, y, z, cell_ix, cell_start, row_iy, row_start = grid
    reach = (width.shape[1] - 1) // 2
    strip = np.empty((2 * reach + 1, 2 * reach + 2), np.int64)
    size = room + 4 * LANES
    px, py, pz = np.empty(size), np.empty(size), np.empty(size)
    record = np.empty((size, 4), np.float32)
    sums = np.empty((MOMENTS, 1))
    r2 = radius * radius
    for j in range(len(qx)):
        ix, iy = math.floor(qx[j] / cell), math.floor(qy[j] / cell)
        fill_strip(cell_ix, cell_start, row_iy, row_start, iy, ix - reach, reach, 2 * reach + 1, strip)
        _, end = gather(x, y, z, strip, reach, width, reach, reach, px, py, pz)
        n = members(px[:end], py[:end], pz[:end], qx[j], qy[j], qz[j], r2, spherical, record)
        if n == 0:
            out[j] = np.nan
            continue
        if spherical > 0.0:
            sphere_sums(px[:end], py[:end], pz[:end], qx[j], qy[j], qz[j], r2, sums, np.int64(0))
        else:
            cylinder_sums(px[:end], py[:end], pz[:end], qx[j], qy[j], qz[j], r2, sums, np.int64(0))
        gx, gy, gz = centroid(sums, np.int64(0))
        shape_values(record, n, gx, gy, gz, seeds[j], work, out[j])
