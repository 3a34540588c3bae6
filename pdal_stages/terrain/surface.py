"""A surface through scattered ground heights: planes on a pyramid of blocks, coarse to fine.

Every block of the pyramid (a cell, 2 x 2 cells, 4 x 4, ...; anchored to absolute coordinates) has a
plane at its center: a least squares fit to the ground of the 3 x 3 blocks round it, held by what
the planes of the four nearest blocks of the next coarser level say there; the coarsest planes lie
at the mean of what is below objects. Where ground is dense the finest level decides; across a hole
the finest level that sees its rim does. The reach is bounded (:func:`reach`), sums are taken in a
fixed tree, so the same ground gives the same bits whatever lies further away.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.grid import GridWindow
from ..base.jit import device, njit
from ..base.threads import map_blocks
from .cells import HOLE
from .openings import highest_around

#: Weight of the coarser gradient per ground cell, for a lever of one block: it decides where all
#: ground of a fit lies to one side or on a line. Not tuned, as the two below.
_STIFFNESS = 0.02
#: Weight of the coarser height, in ground cells.
_HOLD = 0.1
#: Weight of the blocks beside one, of 1, in its fit; of those at its corners the square.
_BESIDE = 0.5
#: Rows that a thread takes at a time; results do not depend on it.
_BAND = 64


@dataclass(frozen=True)
class GroundSurface:
    """A surface through the ground of a raster: of its planes only those of blocks are held.

    The planes of cells are computed for some rows at a time, as all of them would take more memory
    than all else.
    """

    window: GridWindow  #: which cells
    blocks: NDArray[np.float64]  #: (h / 2, w / 2, 3) planes of blocks of 2 x 2 cells
    corner: tuple[int, int]  #: first column and row of these blocks
    needed: NDArray[np.bool_]  #: (h, w) cells whose planes points blend
    ground: NDArray[np.bool_]  #: (h, w), as of :class:`GroundRaster`
    place: NDArray[np.float64]  #: (h, w, 3), likewise

    def planes(self, rows: slice) -> NDArray[np.float64]:
        """Return the planes (n, w, 3) of some rows: height and gradient per cell.

        They are NaN where they are not needed, and beyond the reach of all measured cells.
        """
        needed, place = self.needed[rows], self.place[rows]
        planes = np.full((*needed.shape, 3), np.nan)
        left, bottom = self.window[:2]
        _finer(self.blocks, *self.corner, 1.0, left, bottom + rows.start, needed, planes)
        # Those of ground cells hold their cell's ground.
        j, i = np.nonzero(self.ground[rows] & needed)
        rise = place[j, i, :2] * planes[j, i, 1:]
        planes[j, i, 0] = place[j, i, 2] - rise[:, 0] - rise[:, 1]
        return planes


@dataclass(frozen=True)
class LevelSurface:
    """A raster of heights that is a surface."""

    window: GridWindow  #: which cells
    heights: NDArray[np.float32]  #: (h, w), meters; not finite where there is none

    def planes(self, rows: slice) -> NDArray[np.float64]:
        """Return the level planes (n, w, 3) of some rows, NaN where there is no height."""
        heights = self.heights[rows]
        planes = np.zeros((*heights.shape, 3))
        planes[..., 0] = np.where(np.isfinite(heights), heights, np.nan)
        return planes


@dataclass(frozen=True)
class GroundRaster:
    """A minimum grid, and which of its cells are ground."""

    window: GridWindow  #: which cells
    #: (h, w) heights of the lowest points, meters; HOLE where there is none, or a low outlier
    lowest: NDArray[np.float32]
    #: (h, w, 3) where ground is in its cell, from the middle, in cells; its height
    place: NDArray[np.float64]
    ground: NDArray[np.bool_]  #: (h, w)
    floor: NDArray[np.float32]  #: (h, w) what lies below objects
    opened: Mapping[int, NDArray[np.float32]]  #: (h, w) openings by their radius
    surface: GroundSurface | LevelSurface | None = None  #: through the ground, once it is fitted
    is_ground: NDArray[np.bool_] | None = (
        None  #: (n,) which points are ground, once they are judged
    )
    #: (2, n) heights of points above the provisional surface, and how high they may be as ground;
    #: where they are wanted
    judged: NDArray[np.float64] | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.ground.shape

    def cut(self, window: GridWindow) -> GroundRaster:
        """Return the cells of a window: a copy, or all of it."""
        if window == self.window:
            return self
        part = window.slices_in(self.window)
        rasters = {name: getattr(self, name) for name in _RASTERS}
        cells = {name: values[part].copy() for name, values in rasters.items()}
        opened = {radius: values[part].copy() for radius, values in self.opened.items()}
        return replace(self, window=window, opened=opened, **cells)


#: Fields of a :class:`GroundRaster` that have a value for each cell.
_RASTERS = ("lowest", "place", "ground", "floor")


def reach(levels: int) -> int:
    """Return how far away ground changes the surface, in cells.

    Halos of tiles and margins of blocks follow from it: if it is too small, tiles no longer get the
    bits of the whole cloud.
    """
    # Centers of a block's parents lie up to 1.5 of its sides away: 1.5 * (1 + 2 + ... + half of
    # 2**levels) cells in all, and the coarsest block sees 1.5 * 2**levels: together less than this.
    return 3 * 2**levels


@device
def blend(planes, i, j, s, t, size):
    """Return height and gradient of four planes around a place, by nearness; NaN if none is known.

    The place lies `s` and `t` (0 to 1) blocks of `size` cells beyond the center of block (j, i):
    given apart, so that rounding does not depend on where the array begins.
    """
    height, across, along, total = 0.0, 0.0, 0.0, 0.0
    for b in range(2):
        wv = t if b else 1.0 - t
        if j + b < 0 or j + b >= planes.shape[0] or wv == 0.0:
            continue
        for a in range(2):
            wu = s if a else 1.0 - s
            if i + a < 0 or i + a >= planes.shape[1] or wu == 0.0:
                continue
            plane = planes[j + b, i + a]
            if np.isnan(plane[0]):
                continue
            weight = wu * wv
            height += weight * (plane[0] + size * (plane[1] * (s - a) + plane[2] * (t - b)))
            across += weight * plane[1]
            along += weight * plane[2]
            total += weight
    if total == 0.0:
        return np.nan, np.nan, np.nan
    return height / total, across / total, along / total


@device
def from_parents(parents, parents_left, parents_bottom, column, row, size):
    """Evaluate the planes of blocks of twice the `size` at the center of a block of `size`."""
    # A left child lies 3/4 of the way from the block before its parent's, a right one 1/4 beyond
    # its parent.
    s, t = 0.25 + 0.5 * (1 - (column & 1)), 0.25 + 0.5 * (1 - (row & 1))
    before, below = ((column + 1) >> 1) - 1 - parents_left, ((row + 1) >> 1) - 1 - parents_bottom
    return blend(parents, before, below, s, t, 2.0 * size)


@device
def _add(total, m, dx, dy, weight):
    """Add moments (n, x, y, xx, xy, yy, z, xz, yz) about a center that lies at (dx, dy)."""
    n, x, y, z = weight * m[0], weight * m[1], weight * m[2], weight * m[6]
    total[0] += n
    total[1] += x + n * dx
    total[2] += y + n * dy
    total[3] += weight * m[3] + 2 * dx * x + n * dx * dx
    total[4] += weight * m[4] + dx * y + dy * x + n * dx * dy
    total[5] += weight * m[5] + 2 * dy * y + n * dy * dy
    total[6] += z
    total[7] += weight * m[7] + dx * z
    total[8] += weight * m[8] + dy * z


@device
def _sum_around(moments, j, i, size, sums):
    """Sum the moments of the 3 x 3 blocks around one, about its center: nearer ones weigh more."""
    sums[:] = 0.0
    for b in range(max(j - 1, 0), min(j + 2, moments.shape[0])):
        for a in range(max(i - 1, 0), min(i + 2, moments.shape[1])):
            if moments[b, a, 0] > 0:
                weight = (1.0 if b == j else _BESIDE) * (1.0 if a == i else _BESIDE)
                _add(sums, moments[b, a], (a - i) * size, (b - j) * size, weight)


@njit
def _moments_of_cells(held, place, height, level, corner, out, out_corner):
    """Add up the moments of the held cells of each block of a level, about its center.

    The cells (n,) are numbered row by row.

    Corners are the first column and row of the cells and of the blocks `out` (h, w, 9).
    """
    size, width = 1 << level, height.shape[1]
    (left, bottom), (out_left, out_bottom) = corner, out_corner
    for cell in held:
        j, i = cell // width, cell % width
        x = place[j, i, 0] + ((i + left) & (size - 1)) - (0.5 * size - 0.5)
        y = place[j, i, 1] + ((j + bottom) & (size - 1)) - (0.5 * size - 0.5)
        z = np.float64(height[j, i])
        block = out[((j + bottom) >> level) - out_bottom, ((i + left) >> level) - out_left]
        values = (1.0, x, y, x * x, x * y, y * y, z, x * z, y * z)
        for k in range(len(values)):
            block[k] += values[k]


@njit
def _moments_of_blocks(fine, size, left, bottom, out, out_left, out_bottom):
    """Add up the moments of blocks of twice the `size` from those of their four parts."""
    for j in range(fine.shape[0]):
        for i in range(fine.shape[1]):
            if fine[j, i, 0] > 0:
                block = out[((j + bottom) >> 1) - out_bottom, ((i + left) >> 1) - out_left]
                dx, dy = (((i + left) & 1) - 0.5) * size, (((j + bottom) & 1) - 0.5) * size
                _add(block, fine[j, i], dx, dy, 1.0)


@njit
def _mark_parents(needed, left, bottom, parents, parents_left, parents_bottom):
    """Mark the coarser blocks (h, w) that `from_parents` blends for needed blocks (h, w)."""
    for j in range(needed.shape[0]):
        for i in range(needed.shape[1]):
            if needed[j, i]:
                b = ((j + bottom + 1) >> 1) - 1 - parents_bottom
                a = ((i + left + 1) >> 1) - 1 - parents_left
                for row in range(max(b, 0), min(b + 2, parents.shape[0])):
                    for column in range(max(a, 0), min(a + 2, parents.shape[1])):
                        parents[row, column] = True


@njit
def _coarsest(moments, size, needed, planes):
    """Lay level planes at the mean of the floor of 3 x 3 blocks, where they are needed."""
    h, w = moments.shape[:2]
    sums = np.empty(9)
    for j in range(h):
        for i in range(w):
            if not needed[j, i]:
                continue
            _sum_around(moments, j, i, size, sums)
            planes[j, i, 0] = sums[6] / sums[0] if sums[0] > 0.0 else np.nan
            planes[j, i, 1], planes[j, i, 2] = 0.0, 0.0


@njit
def _finer(parents, parents_left, parents_bottom, size, left, bottom, needed, planes):
    """Evaluate planes of blocks of 2 `size` cells at centers of needed ones of `size` cells."""
    for j in range(needed.shape[0]):
        for i in range(needed.shape[1]):
            if needed[j, i]:
                planes[j, i, 0], planes[j, i, 1], planes[j, i, 2] = from_parents(
                    parents, parents_left, parents_bottom, i + left, j + bottom, size
                )


@njit
def _fit(moments, size, needed, planes, first, last):
    """Correct the needed planes, as the coarser level has them, by the ground of 3 x 3 blocks."""
    sums = np.empty(9)
    for j in range(first, last):
        for i in range(moments.shape[1]):
            if not needed[j, i]:
                continue
            _sum_around(moments, j, i, size, sums)
            n, x, y = sums[0], sums[1], sums[2]
            if n == 0.0:
                continue
            height, across, along = planes[j, i, 0], planes[j, i, 1], planes[j, i, 2]
            # Residuals of the coarser plane; the offset is eliminated, two unknowns are left.
            r = sums[6] - n * height - across * x - along * y
            rx = sums[7] - height * x - across * sums[3] - along * sums[4]
            ry = sums[8] - height * y - across * sums[4] - along * sums[5]
            n_held = n + _HOLD
            stiff = _STIFFNESS * n * size * size
            xx, yy = sums[3] + stiff - x * x / n_held, sums[5] + stiff - y * y / n_held
            xy = sums[4] - x * y / n_held
            rx -= x * r / n_held
            ry -= y * r / n_held
            determinant = xx * yy - xy * xy
            gx, gy = (rx * yy - ry * xy) / determinant, (ry * xx - rx * xy) / determinant
            planes[j, i, 0] = height + (r - x * gx - y * gy) / n_held
            planes[j, i, 1] = across + gx
            planes[j, i, 2] = along + gy


def planes_of_blocks(
    raster: GroundRaster, levels: int, needed: NDArray[np.bool_], threads: int | None = 1
) -> tuple[NDArray[np.float64], tuple[int, int]]:
    """Fit planes of blocks of 2 x 2 cells through the ground of a raster.

    Returns height and gradient per cell at the blocks' centers (h, w, 3), NaN where nothing is
    known, and the first column and row of blocks.

    There are `levels` coarser levels, at least 1. Only the planes that cells `needed` (h, w) blend
    have values: a thin cloud costs what its points do, not what its area does.
    """
    moments: list[np.ndarray] = []
    spans, wanted = [raster.window[:2]], [needed]
    for level in range(1, levels + 1):
        (a, b), (h, w) = spans[-1], wanted[-1].shape
        low_a, low_b = (a >> 1) - 1, (b >> 1) - 1
        h, w = ((b + h - 1) >> 1) + 2 - low_b, ((a + w - 1) >> 1) + 2 - low_a
        sums = np.zeros((h, w, 9))
        if level == 1:
            held, heights = np.flatnonzero(raster.ground), raster.place[..., 2]
            _moments_of_cells(held, raster.place, heights, 1, (a, b), sums, (low_a, low_b))
        else:
            _moments_of_blocks(moments[-1], 2.0 ** (level - 1), a, b, sums, low_a, low_b)
        wanted.append(np.zeros((h, w), bool))
        _mark_parents(wanted[-2], a, b, wanted[-1], low_a, low_b)
        moments.append(sums)
        spans.append((low_a, low_b))
    planes = np.empty((h, w, 3))
    sums = np.zeros((h, w, 9))
    middle = np.broadcast_to(0.0, (*raster.shape, 2))
    measured = np.flatnonzero(raster.lowest != HOLE)
    _moments_of_cells(measured, middle, raster.floor, levels, spans[0], sums, spans[levels])
    _coarsest(sums, 2.0**levels, wanted[levels], planes)
    for level in range(levels, 0, -1):
        sums = moments.pop()
        coarser, planes = planes, planes if level == levels else np.empty((*sums.shape[:2], 3))
        parents = None if level == levels else _Parents(coarser, *spans[level + 1])
        _fit_level(sums, 2.0**level, wanted[level], spans[level], parents, planes, threads)
    return planes, spans[1]


class _Parents(NamedTuple):
    """Planes of the next coarser level."""

    planes: NDArray[np.float64]  #: (h, w, 3)
    left: int  #: the first column ...
    bottom: int  #: ... and row


def _fit_level(
    sums: NDArray[np.float64],
    size: float,
    needed: NDArray[np.bool_],
    corner: tuple[int, int],
    parents: _Parents | None,
    planes: NDArray[np.float64],
    threads: int | None,
) -> None:
    """Compute the needed planes of the blocks of one level, from those of the next coarser one.

    A thread takes some rows. There are no `parents` where the planes have been evaluated.
    """

    def fit(first: int) -> None:
        rows = slice(first, min(first + _BAND, len(needed)))
        if parents is not None:
            left, bottom = corner[0], corner[1] + first
            _finer(*parents, size, left, bottom, needed[rows], planes[rows])
        _fit(sums, size, needed, planes, rows.start, rows.stop)

    list(map_blocks(fit, range(0, len(needed), _BAND), threads))


def fit_surface(
    raster: GroundRaster, levels: int, needed: NDArray[np.bool_], threads: int | None
) -> GroundSurface:
    """Fit a surface through the ground of a raster for the `needed` cells (h, w).

    There are `levels` levels of blocks, at least 1.
    """
    blocks, corner = planes_of_blocks(raster, levels, needed, threads)
    return GroundSurface(raster.window, blocks, corner, needed, raster.ground, raster.place)


@njit
def planes_at(cells, width, left, bottom, blocks, corner):
    """Return the planes (n, 3) at the centers of cells (n,) that are no ground.

    Cells are numbered row by row in a raster of some `width`, whose first column and row are `left`
    and `bottom`; `blocks` and `corner` are those of :func:`planes_of_blocks`.
    """
    planes = np.empty((len(cells), 3))
    for k in range(len(cells)):
        j, i = cells[k] // width, cells[k] % width
        planes[k, 0], planes[k, 1], planes[k, 2] = from_parents(
            blocks, corner[0], corner[1], i + left, j + bottom, 1.0
        )
    return planes


@njit
def _heights_above(points, x, y, z, cell, corner, planes, out):
    """Compute the height of some points (m,) of all (n,) above planes (h, w, 3), and the slope."""
    left, bottom = corner
    for p in points:
        u, v = x[p] / cell - 0.5, y[p] / cell - 0.5
        i, j = np.floor(u), np.floor(v)
        level, across, along = blend(planes, int(i) - left, int(j) - bottom, u - i, v - j, 1.0)
        out[0, p] = z[p] - level
        out[1, p] = np.sqrt(across * across + along * along) / cell


def heights_above(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    z: NDArray[np.float64],
    row: NDArray[np.int64],
    surface: GroundSurface | LevelSurface,
    cell: float,
    threads: int | None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the heights of points (n,) above a surface, and its gradients there; NaN outside.

    `row` are the rows of the points' cells, whose side is `cell` meters. A thread takes the points
    of some rows.
    """
    out = np.empty((2, len(x)))
    left, bottom, _, count = surface.window
    bands = -(-count // _BAND)
    band = np.clip((row - bottom) // _BAND, 0, max(bands - 1, 0)).astype(np.uint16)
    order = np.argsort(band, kind="stable")
    ends = np.cumsum(np.bincount(band, minlength=bands))

    def measure(number: int) -> None:
        members = order[(ends[number - 1] if number else 0) : ends[number]]
        if len(members):  # points blend the four cells around them
            rows = slice(max(number * _BAND - 1, 0), min((number + 1) * _BAND + 1, count))
            corner, planes = (left, bottom + rows.start), surface.planes(rows)
            _heights_above(members, x, y, z, cell, corner, planes, out)

    list(map_blocks(measure, range(bands), threads))
    return out[0], out[1]


def cells_around(
    window: GridWindow, wanted: GridWindow, column: NDArray, row: NDArray
) -> NDArray[np.bool_]:
    """Mark the cells (h, w) of a window that points of wanted cells blend: theirs and around."""
    held = np.zeros(window.shape, bool)
    inside = wanted.contains(column, row)
    held.ravel()[window.flat_index(column[inside], row[inside])] = True
    return highest_around(held, 1, 0)
