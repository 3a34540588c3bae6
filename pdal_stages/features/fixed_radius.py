"""Cylinders and spheres of fixed radii: masked sums over the points of the cells they can touch.

All queries of a cell share these candidates, whose list depends on (cloud, cell, radius) only: rows
of cells ascend, then columns, then the coordinates of the points. Members are the points where the
squared distance is ``<= r * r``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..base.jit import device, njit
from .moments import Candidates, M, distance2, finish, height_key, sums_within
from .plan import FeaturePlan
from .point_grid import CellGrid
from .shape_distributions import Axes, NeighborhoodGroup, write_shapes

#: Candidates are filled up to a multiple of this number, so that a vector loop leaves none over: a
#: register of AVX-512 holds so many.
LANES = 8
#: Coordinates of the points with which they are filled up, meters: beyond any radius, and their
#: squares are finite.
FAR = 1e150


class Radii(NamedTuple):
    """Cylinders and spheres, as kernels take them."""

    radius: np.ndarray  # (k,) float64, meters, ascending
    spherical: np.ndarray  # (k,) float64: 1 for spheres, 0 for cylinders
    widths: np.ndarray  # (k, rows) int64, see :func:`widths_of`


class FixedRadius(NeighborhoodGroup):
    """The fixed-radius neighborhoods of `plan` on `grid`, the sorted cloud."""

    def __init__(self, grid: CellGrid, plan: FeaturePlan) -> None:
        fixed = [c for c in plan.layout if c.neighborhood.fixed and c.at]
        super().__init__(sorted(fixed, key=lambda c: c.neighborhood.parameters[0]))
        self.grid = grid
        radius = np.array([c.neighborhood.parameters[0] for c in self.chosen], np.float64)
        spherical = [c.neighborhood.kind == "sphere" for c in self.chosen]
        self.radii = Radii(radius, np.array(spherical, np.float64), widths_of(radius, grid.cell))

    def fill(self, points: Axes, copies, fitted, shapes, out):
        """Compute a block of queries; see :meth:`NeighborhoodGroup.fill`."""
        few, table = np.zeros(len(self), np.int64), np.empty((len(self), len(M), len(points[0])))
        fixed_block(self.grid, points, self.radii, shapes, table, out)
        for k, (radius, spherical) in enumerate(zip(*self.radii[:2], strict=True)):
            volume = 4.0 / 3.0 * math.pi * radius**3 if spherical else math.pi * radius * radius
            finish(table[k], volume, points[2], few[k : k + 1], copies, self.columns[k], out)
        return dict(zip(self.tokens, few.tolist(), strict=True)), {}, 0.0


def widths_of(radii: np.ndarray, cell: float) -> np.ndarray:
    """Return the cells that a neighborhood of each radius can touch, (radii, 2 R + 1) int64.

    For the rows -R..R of cells round a query's own, the largest column offset that some query in
    the cell may reach; -1: none. A cell is half open, so one whose nearest border is the radius
    away holds no member.
    """
    reach = int(np.ceil(radii.max(initial=0.0) / cell)) + 1
    # The least distance of a row, or a column, of cells.
    away = np.maximum(np.abs(np.arange(-reach, reach + 1)) - 1, 0) * cell
    touched = away[:, None] ** 2 + away**2 < radii[:, None, None] ** 2
    touched = touched[:, touched.any(axis=(0, 2))]
    # Contiguous as for one radius: one kernel serves both.
    return np.ascontiguousarray(touched[:, :, reach:].sum(axis=2) - 1)


@device(_nrt=True)
def make_candidates(room):
    """Return room for `room` candidates."""
    return Candidates(np.empty(room), np.empty(room), np.empty(room), np.empty(room, np.int64))


@njit
def fixed_block(grid, points, radii, shapes, table, out):
    """Compute moments and shapes of cylinders and spheres for a block of queries.

    Parameters
    ----------
    grid : CellGrid
        The cloud.
    points : (x, y, z), (m,) float64 each
    radii : Radii
    shapes : Shapes or None
        None compiles to a kernel without them, in half the time.
    table : (k, len(M), m) float64 array
        Out: moments about the queries.
    out : (m, F) float32 array
        Out: shapes.
    """
    qx, qy, qz = points
    cell, starts, widths = grid.cell, grid.cell_start, radii.widths
    reach = widths.shape[1] // 2
    window = np.empty((len(widths), 2 * reach + 1, 2), np.int64)
    candidates, record = make_candidates(0), np.empty((1, 4), np.float32)
    line, left = np.int64(0), np.int64(2**62)
    a = 0
    while a < len(qx):
        ix, iy = math.floor(qx[a] / cell), math.floor(qy[a] / cell)
        b = a + 1
        while b < len(qx) and math.floor(qx[b] / cell) == ix and math.floor(qy[b] / cell) == iy:
            b += 1
        goes_on = iy == line and ix >= left
        move_window(grid, iy, ix, widths, goes_on, window)
        line, left = iy, ix
        count = 0
        for k in range(len(widths)):
            if k == 0 or radii.radius[k] != radii.radius[k - 1]:
                room = 0
                for row in range(2 * reach + 1):
                    room += starts[window[k, row, 1]] - starts[window[k, row, 0]]
                if room + LANES > len(candidates.x):
                    candidates = make_candidates(2 * room + LANES)
                count = 0
                for row in range(2 * reach + 1):
                    first, last = starts[window[k, row, 0]], starts[window[k, row, 1]]
                    copy_points(grid, first, last, candidates, count)
                    count += last - first
                while count % LANES:
                    candidates.x[count] = candidates.y[count] = candidates.z[count] = FAR
                    candidates.keys[count] = 0
                    count += 1
            spherical, r2, sums = radii.spherical[k], radii.radius[k] * radii.radius[k], table[k]
            for q in range(a, b):
                point = qx[q], qy[q], qz[q]
                sums_within(candidates, count, point, spherical, r2, sums, q)
                if shapes is not None and shapes.shaped[k]:
                    if count >= len(record):
                        record = np.empty((2 * count + 1, 4), np.float32)
                    n = members(candidates, count, point, spherical, r2, record)
                    w = 1.0 / sums[M.N, q]
                    gx, gy, gz = sums[M.SX, q] * w, sums[M.SY, q] * w, sums[M.SZ, q] * w
                    centroid = np.float32(gx), np.float32(gy), np.float32(gz)
                    write_shapes(shapes, k, q, record, n, centroid, out)
        a = b


@device
def move_window(grid, iy, ix, widths, goes_on, window):
    """Fill `window` (k, rows, 2): by radius and row, the first cell round (iy, ix) and the end.

    Where it `goes_on` from a cell to the left, cells are followed from those that it had there.
    """
    cell_ix, row_iy, row_start = grid.cell_ix, grid.row_iy, grid.row_start
    reach = widths.shape[1] // 2
    row = np.searchsorted(row_iy, iy - reach)
    for r in range(2 * reach + 1):
        if row >= len(row_iy) or row_iy[row] != iy - reach + r:
            window[:, r] = 0
            continue
        start, last = row_start[row], row_start[row + 1]
        at = start if goes_on else start + np.searchsorted(cell_ix[start:last], ix - reach)
        for k in range(len(widths)):
            w = widths[k, r]
            if w < 0:
                window[k, r] = 0
                continue
            for side in range(2):
                column = ix + w + 1 if side else ix - w
                place = window[k, r, side] if goes_on else at
                while place < last and cell_ix[place] < column:
                    place += 1
                window[k, r, side] = place
        row += 1


@device(forceinline=True)
def copy_points(grid, first, last, candidates, at):
    """Copy the points first..last - 1 of the cloud to the candidates from `at` on."""
    x, y, z = grid.x, grid.y, grid.z
    px, py, pz, keys = candidates
    # Unsigned: numba would make a branch for negative indices, which count from the end.
    first, at = np.uint64(first), np.uint64(at)
    for i in range(np.uint64(last) - first):
        px[at + i] = x[first + i]
        py[at + i] = y[first + i]
        pz[at + i] = z[first + i]
        keys[at + i] = height_key(z[first + i])


@device
def members(candidates, count, point, spherical, r2, record):
    """List a neighborhood's members in canonical order, as float32 offsets; return how many."""
    px, py, pz, _ = candidates
    qx, qy, qz = point
    n = 0
    for i in range(count):
        dx, dy, dz = px[i] - qx, py[i] - qy, pz[i] - qz
        record[n, 0], record[n, 1], record[n, 2], record[n, 3] = dx, dy, dz, 0.0
        n += 1 if distance2(dx, dy, dz, spherical) <= r2 else 0
    return n
