"""Cylinders and spheres of fixed radii: masked sums over the points of the cells that a neighborhood can touch.

All queries of a cell share these candidates, whose list depends on (cloud, cell, radius) only:
rows of cells ascend, then columns, then the coordinates of the points. Members are the points
where the squared distance is ``<= r * r``.
"""

from __future__ import annotations

import math

import numpy as np

from ..base.jit import device, njit
from .moments import ROWS, SX, SY, SZ, N, distance2, finish, height_key, sums_within
from .plan import FeaturePlan, columns_of
from .point_grid import CellGrid
from .registry import MOMENT_FEATURES
from .shape_bins import ShapeBins
from .shape_distributions import Axes, shapes_of, write_shapes

#: Candidates are filled up to a multiple of so many, by points so far away, meters: a vector loop
#: leaves none over.
LANES, FAR = 8, 1e150


class FixedRadius:
    """The fixed-radius neighborhoods of `plan` on `grid`, the sorted cloud; :meth:`fill` computes a block."""

    def __init__(self, grid: CellGrid, plan: FeaturePlan) -> None:
        self.grid = grid
        fixed = [c for c in plan.layout if c.neighborhood.kind in ("cylinder", "sphere") and c.at]
        self.chosen = sorted(fixed, key=lambda c: c.neighborhood.parameters[0])
        self.shaped = any(c.shapes for c in self.chosen)
        self.tokens = [c.neighborhood.token for c in self.chosen]
        self.radii = np.array([c.neighborhood.parameters[0] for c in self.chosen], np.float64)
        self.spherical = np.array(
            [c.neighborhood.kind == "sphere" for c in self.chosen], np.float64
        )
        self.columns = columns_of(self.chosen, MOMENT_FEATURES)
        self.widths = widths_of(self.radii, grid.cell)

    def __len__(self) -> int:
        return len(self.chosen)

    def shape_values(self, points: Axes, seed: int) -> dict[str, np.ndarray]:
        """By neighborhood the metrics of all pulls round a few points, (m, 5, 255) float32, comparable."""
        if not self.shaped:
            return {}
        shapes = shapes_of(self.chosen, points, seed, None)
        self._run(points, shapes, np.empty((len(points[0]), 0), np.float32))
        return {
            c.neighborhood.token: shapes.values[k] for k, c in enumerate(self.chosen) if c.shapes
        }

    def fill(
        self,
        points: Axes,
        copies: np.ndarray,
        bins: ShapeBins | None,
        seed: int,
        few: np.ndarray,
        out: np.ndarray,
    ) -> None:
        """Compute the columns of these neighborhoods in `out` (m, F) for queries, those of one cell one after the other.

        Each stands for so many `copies` of the user's. `few` (neighborhoods,) is raised by the
        number with fewer than three points. `bins` are needed where shapes are wanted.
        """
        shapes = shapes_of(self.chosen, points, seed, bins) if self.shaped else None
        table = self._run(points, shapes, out)
        for k, (radius, spherical) in enumerate(zip(self.radii, self.spherical, strict=True)):
            volume = 4.0 / 3.0 * math.pi * radius**3 if spherical else math.pi * radius * radius
            finish(table[k], volume, points[2], few[k : k + 1], copies, self.columns[k], out)

    def _run(self, points: Axes, shapes, out: np.ndarray) -> np.ndarray:
        """Moments (neighborhoods, ROWS, m); shapes go where `shapes` says."""
        table = np.empty((len(self), ROWS, len(points[0])))
        fixed_block(
            self.grid.tables(), self.grid.cell, *points, self.radii, self.spherical, self.widths, shapes, table, out
        )  # fmt: skip
        return table


def widths_of(radii: np.ndarray, cell: float) -> np.ndarray:
    """Cells a neighborhood of each radius can touch, (radii, 2 R + 1) int64.

    For the rows -R..R of cells round a query's own, the largest column offset that some query in
    the cell may reach; -1: none. A cell is half open, so one whose nearest border is the radius
    away holds no member.
    """
    reach = int(np.ceil(radii.max(initial=0.0) / cell)) + 1
    away = (
        np.maximum(np.abs(np.arange(-reach, reach + 1)) - 1, 0) * cell
    )  # of a row, or column, at least
    touched = away[:, None] ** 2 + away**2 < radii[:, None, None] ** 2
    touched = touched[:, touched.any(axis=(0, 2))]
    return np.ascontiguousarray(
        touched[:, :, reach:].sum(axis=2) - 1
    )  # as of one radius: a kernel for both


@njit
def fixed_block(grid, cell, qx, qy, qz, radii, spherical, widths, shapes, table, out):
    """Moments and shapes of cylinders and spheres for a block of queries.

    Parameters
    ----------
    grid : tuple
        ``CellGrid.tables()`` of the cloud.
    cell : float
        Edge of a grid cell, meters.
    qx, qy, qz : (m,) float64 arrays
    radii, spherical, widths : (k,) float64, (k,) float64 and (k, rows) int64 arrays
        Ascending, meters; 1 for spheres, 0 for cylinders; :func:`widths_of` the radii.
    shapes : Shapes or None
        None compiles to a kernel without them, in half the time.
    table : (k, ROWS, m) float64 array
        Out: moments about the queries.
    out : (m, F) float32 array
        Out: shapes.
    """
    reach, starts = widths.shape[1] // 2, grid[4]
    window = np.empty((len(radii), 2 * reach + 1, 2), np.int64)
    px, py, pz, keys = np.empty(0), np.empty(0), np.empty(0), np.empty(0, np.int64)
    record = np.empty((1, 4), np.float32)
    line, left = np.int64(0), np.int64(2**62)
    a = 0
    while a < len(qx):
        ix, iy = math.floor(qx[a] / cell), math.floor(qy[a] / cell)
        b = a + 1
        while b < len(qx) and math.floor(qx[b] / cell) == ix and math.floor(qy[b] / cell) == iy:
            b += 1
        on = iy == line and ix >= left
        move_window(grid[3], grid[5], grid[6], iy, ix, widths, on, window)
        line, left = iy, ix
        count = 0
        for k in range(len(radii)):
            if k == 0 or radii[k] != radii[k - 1]:
                room = 0
                for row in range(2 * reach + 1):
                    room += starts[window[k, row, 1]] - starts[window[k, row, 0]]
                if room + LANES > len(px):
                    size = 2 * room + LANES
                    px, py, pz = np.empty(size), np.empty(size), np.empty(size)
                    keys = np.empty(size, np.int64)
                count = 0
                for row in range(2 * reach + 1):
                    first, last = starts[window[k, row, 0]], starts[window[k, row, 1]]
                    copy_points(grid[0], grid[1], grid[2], first, last, px, py, pz, keys, count)
                    count += last - first
                while count % LANES:
                    px[count], py[count], pz[count], keys[count] = FAR, FAR, FAR, 0
                    count += 1
            r2, sums = radii[k] * radii[k], table[k]
            for q in range(a, b):
                sums_within(px, py, pz, keys, count, qx[q], qy[q], qz[q], spherical[k], r2, sums, q)
                if shapes is not None and shapes.shaped[k]:
                    if count >= len(record):
                        record = np.empty((2 * count + 1, 4), np.float32)
                    n = members(px, py, pz, count, qx[q], qy[q], qz[q], spherical[k], r2, record)
                    w = 1.0 / table[k, N, q]
                    gx, gy, gz = table[k, SX, q] * w, table[k, SY, q] * w, table[k, SZ, q] * w
                    write_shapes(
                        shapes, k, q, record, n, np.float32(gx), np.float32(gy), np.float32(gz), out
                    )
        a = b


@device
def move_window(cell_ix, row_iy, row_start, iy, ix, widths, on, window):
    """Fill `window` (k, rows, 2) with the first cell round (iy, ix) in each row, by the radius, and with the end of them.

    Where it goes `on`, from a cell to the left, cells are followed from those that were found
    there.
    """
    reach = widths.shape[1] // 2
    row = np.searchsorted(row_iy, iy - reach)
    for r in range(2 * reach + 1):
        if row >= len(row_iy) or row_iy[row] != iy - reach + r:
            window[:, r] = 0
            continue
        start, last = row_start[row], row_start[row + 1]
        at = start if on else start + np.searchsorted(cell_ix[start:last], ix - reach)
        for k in range(len(widths)):
            w = widths[k, r]
            if w < 0:
                window[k, r] = 0
                continue
            for side in range(2):
                column = ix + w + 1 if side else ix - w
                place = window[k, r, side] if on else at
                while place < last and cell_ix[place] < column:
                    place += 1
                window[k, r, side] = place
        row += 1


@device(forceinline=True)
def copy_points(x, y, z, first, last, px, py, pz, keys, at):
    """Append the points first..last - 1."""
    # Unsigned: what may be negative is looked up with a detour.
    first, at = np.uint64(first), np.uint64(at)
    for i in range(np.uint64(last) - first):
        px[at + i] = x[first + i]
        py[at + i] = y[first + i]
        pz[at + i] = z[first + i]
        keys[at + i] = height_key(z[first + i])


@device
def members(px, py, pz, count, qx, qy, qz, spherical, r2, record):
    """List the members of one neighborhood in canonical order, as float32 offsets from the query; how many there are."""
    n = 0
    for i in range(count):
        dx, dy, dz = px[i] - qx, py[i] - qy, pz[i] - qz
        record[n, 0], record[n, 1], record[n, 2], record[n, 3] = dx, dy, dz, 0.0
        n += 1 if distance2(dx, dy, dz, spherical) <= r2 else 0
    return n
