"""A surface through scattered ground heights: planes on a pyramid of blocks, coarse to fine.

Every block of the pyramid (a cell, 2 x 2 cells, 4 x 4, ...; anchored to absolute coordinates) has a plane at
its center: a least squares fit to the ground of the 3 x 3 blocks round it, held by what the planes of the
four nearest blocks of the next coarser level say there. Where ground is dense the finest level decides;
across a hole the finest level that sees its rim does. The reach is bounded (:func:`reach`), sums are taken
in a fixed tree, so the same ground gives the same bits whatever lies further away.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..base.jit import any_of, device, njit
from .moments import moments_of_blocks, moments_of_blocks_again, moments_of_cells, moments_of_cells_again

#: Weight of the coarser gradient per ground cell, for a lever of one block: it decides where all
#: ground of a fit lies to one side or on a line.
_STIFFNESS = 0.02
#: Weight of the coarser height, in ground cells.
_HOLD = 0.1
#: Blocks of a row that are done at once; and of those with others on both sides, and on one.
_SPAN = 64
_WINDOW, _BESIDE = _SPAN + 2, _SPAN + 1


def reach(levels: int) -> int:
    """How far ground changes the surface, in cells."""
    # A block's parents lie up to 1.5 blocks away, level by level; the coarsest sees 3 x 3 of its blocks.
    return 3 * 2**levels


@device
def blend(planes, i, j, s, t, size):
    """Height and gradient of the four planes round a place, weighted by nearness; NaN where none is known.

    The place lies `s` and `t` (0 to 1) blocks of `size` cells beyond the center of block (j, i): given apart, so that
    rounding does not depend on where the array begins.
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


@njit
def _coarsest(floor, raster, left, bottom, level, out, out_left, out_bottom):
    """Level planes at the mean of `floor` over the measured cells of 3 x 3 blocks."""
    h, w = out.shape[:2]
    sums = np.zeros((h, w, 2))
    for j in range(raster.shape[0]):
        row = sums[((j + bottom) >> level) - out_bottom]
        i = 0
        while i < raster.shape[1]:
            block = ((i + left) >> level) - out_left
            end = min(((block + out_left + 1) << level) - left, raster.shape[1])
            total, n = row[block, 0], row[block, 1]
            for k in range(i, end):
                there = np.isfinite(raster[j, k])
                total += floor[j, k] if there else np.float32(0.0)
                n += 1.0 if there else 0.0
            row[block, 0], row[block, 1] = total, n
            i = end
    for j in range(h):
        for i in range(w):
            total, n = 0.0, 0.0
            for b in range(max(j - 1, 0), min(j + 2, h)):
                for a in range(max(i - 1, 0), min(i + 2, w)):
                    weight = (1.0 - 0.5 * abs(b - j)) * (1.0 - 0.5 * abs(a - i))
                    total += weight * sums[b, a, 0]
                    n += weight * sums[b, a, 1]
            out[j, i, 0] = total / n if n > 0 else np.nan
            out[j, i, 1] = out[j, i, 2] = 0.0


@device
def _add_row(m, size, dy, near, sums):
    """Add to `_SPAN` sums of moments those of the blocks of a row beside, in front, and behind, whose row lies at dy.

    Sums are one after the other, as moments are, at places that the compiler knows, and there are no branches, so that it
    does several at a time: blocks without ground have zeros, which change nothing.
    """
    for i in range(_SPAN):
        n, x, y, z = sums[i], sums[i + _SPAN], sums[i + 2 * _SPAN], sums[i + 6 * _SPAN]
        xx, xy, yy = sums[i + 3 * _SPAN], sums[i + 4 * _SPAN], sums[i + 5 * _SPAN]
        xz, yz = sums[i + 7 * _SPAN], sums[i + 8 * _SPAN]
        for a in range(3):
            at, dx, weight = i + a, (a - 1) * size, near * (0.5 if a != 1 else 1.0)
            k, mx, my, mz = m[at], m[at + _WINDOW], m[at + 2 * _WINDOW], m[at + 6 * _WINDOW]
            n += weight * k
            x += weight * (mx + k * dx)
            y += weight * (my + k * dy)
            xx += weight * (m[at + 3 * _WINDOW] + 2 * dx * mx + k * dx * dx)
            xy += weight * (m[at + 4 * _WINDOW] + dx * my + dy * mx + k * dx * dy)
            yy += weight * (m[at + 5 * _WINDOW] + 2 * dy * my + k * dy * dy)
            z += weight * mz
            xz += weight * (m[at + 7 * _WINDOW] + dx * mz)
            yz += weight * (m[at + 8 * _WINDOW] + dy * mz)
        sums[i], sums[i + _SPAN], sums[i + 2 * _SPAN], sums[i + 6 * _SPAN] = n, x, y, z
        sums[i + 3 * _SPAN], sums[i + 4 * _SPAN], sums[i + 5 * _SPAN] = xx, xy, yy
        sums[i + 7 * _SPAN], sums[i + 8 * _SPAN] = xz, yz


@device
def _correct(sums, size, planes):
    """Correct `_SPAN` planes, given one after the other as heights and gradients, by sums of moments."""
    for i in range(_SPAN):
        n, x, y, z = sums[i], sums[i + _SPAN], sums[i + 2 * _SPAN], sums[i + 6 * _SPAN]
        xx, xy, yy = sums[i + 3 * _SPAN], sums[i + 4 * _SPAN], sums[i + 5 * _SPAN]
        xz, yz = sums[i + 7 * _SPAN], sums[i + 8 * _SPAN]
        height, across, along = planes[i], planes[i + _SPAN], planes[i + 2 * _SPAN]
        # Residuals of the coarser plane; the offset is eliminated, two unknowns are left.
        r = z - n * height - across * x - along * y
        rx = xz - height * x - across * xx - along * xy
        ry = yz - height * y - across * xy - along * yy
        n_held = n + _HOLD
        stiff = _STIFFNESS * n * size * size
        xx = xx + stiff - x * x / n_held
        xy -= x * y / n_held
        yy = yy + stiff - y * y / n_held
        rx -= x * r / n_held
        ry -= y * r / n_held
        determinant = xx * yy - xy * xy
        gx = (rx * yy - ry * xy) / determinant
        gy = (ry * xx - rx * xy) / determinant
        up = height + (r - x * gx - y * gy) / n_held
        planes[i] = up if n > 0.0 else height
        planes[i + _SPAN] = across + gx if n > 0.0 else across
        planes[i + 2 * _SPAN] = along + gy if n > 0.0 else along


@device
def _copy(source, first, last, target, at):
    for i in range(last - first):
        target[at + i] = source[first + i]


@njit
def _fit(moments, size, needed, planes):
    """Correct the needed planes (given: what the coarser level says) by the ground of 3 x 3 blocks."""
    h, w = needed.shape
    window, sums, some = np.zeros(9 * _WINDOW), np.empty(9 * _SPAN), np.zeros(3 * _SPAN)
    for j in range(h):
        for begin in range(0, w, _SPAN):
            end = min(begin + _SPAN, w)
            if not any_of(needed[j, begin:end]):
                continue
            first, last = max(begin - 1, 0), min(end + 1, w)
            if last - first < _WINDOW:
                window[:] = 0.0
            sums[:] = 0.0
            for b in range(max(j - 1, 0), min(j + 2, h)):
                for q in range(9):
                    _copy(moments[b, q], first, last, window, q * _WINDOW + first - begin + 1)
                _add_row(window, size, (b - j) * size, 1.0 - 0.5 * abs(b - j), sums)
            for i in range(begin, end):
                plane, at = planes[j, i], i - begin
                some[at], some[at + _SPAN], some[at + 2 * _SPAN] = plane[0], plane[1], plane[2]
            _correct(sums, size, some)
            for i in range(begin, end):
                plane, at = planes[j, i], i - begin
                plane[0], plane[1], plane[2] = some[at], some[at + _SPAN], some[at + 2 * _SPAN]


def _needed_parents(
    needed: np.ndarray, left: int, bottom: int, shape: tuple[int, int], out_left: int, out_bottom: int
) -> np.ndarray:
    """Blocks of twice the size, on a raster of that `shape`, whose planes are asked for those of the needed ones."""
    h, w = shape
    j, i = bottom - 2 * out_bottom + 1, left - 2 * out_left + 1
    padded = np.zeros((2 * h + 2, 2 * w + 2), bool)
    padded[j : j + needed.shape[0], i : i + needed.shape[1]] = needed
    rows = padded[0:-2:2] | padded[1:-2:2]
    rows |= padded[2::2]
    rows |= padded[3::2]
    out = rows[:, 0:-2:2] | rows[:, 1:-2:2]
    out |= rows[:, 2::2]
    out |= rows[:, 3::2]
    return out


@device
def _shared(parents, size, s, t, out):
    """As `blend`, at a place between each two of `_SPAN` + 1 parents in two rows, all known: weights add up to 1.

    `parents` are heights and gradients, one after the other, as in `_add_row`.
    """
    for i in range(_SPAN):
        height, across, along = 0.0, 0.0, 0.0
        for b in range(2):
            for a in range(2):
                at, weight = i + a + b * _BESIDE, (s if a else 1.0 - s) * (t if b else 1.0 - t)
                p1, p2 = parents[at + 2 * _BESIDE], parents[at + 4 * _BESIDE]
                height += weight * (parents[at] + size * (p1 * (s - a) + p2 * (t - b)))
                across += weight * p1
                along += weight * p2
        out[i], out[i + _SPAN], out[i + 2 * _SPAN] = height, across, along


@njit
def _from_parents(parents, parents_left, parents_bottom, size, left, bottom, needed, planes):
    """What the planes of blocks of twice the `size` say at the centers of the needed blocks of `size`, and others near."""
    h, w = needed.shape
    rows, columns = parents.shape[:2]
    some, one, other = np.zeros(6 * _BESIDE), np.zeros(3 * _SPAN), np.zeros(3 * _SPAN)
    start = ((left + 1) >> 1) - 1 - parents_left
    for j in range(h):
        # A left child lies 3/4 of the way from the block before its parent's, a right one 1/4 beyond its parent.
        t = 0.25 + 0.5 * (1 - ((j + bottom) & 1))
        below = ((j + bottom + 1) >> 1) - 1 - parents_bottom
        for before in range(start, ((left + w) >> 1) - parents_left, _SPAN):
            first = 2 * (before + parents_left) + 1 - left  # of the two between it and the next parent
            begin, end = max(first, 0), min(first + 2 * _SPAN, w)
            if not any_of(needed[j, begin:end]):
                continue
            last = before + (end - 1 - first) // 2 + 2
            known = below >= 0 and below + 2 <= rows and before >= 0 and last <= columns
            if known:
                for b in range(2):
                    for k in range(before, last):
                        plane, at = parents[below + b, k], b * _BESIDE + k - before
                        known = known and plane[0] == plane[0]
                        some[at] = plane[0]
                        some[at + 2 * _BESIDE], some[at + 4 * _BESIDE] = plane[1], plane[2]
            if known:
                _shared(some, 2.0 * size, 0.25, t, one)
                _shared(some, 2.0 * size, 0.75, t, other)
                for k in range(begin, end):
                    found, at = other if (k - first) & 1 else one, (k - first) >> 1
                    plane = planes[j, k]
                    plane[0], plane[1], plane[2] = found[at], found[at + _SPAN], found[at + 2 * _SPAN]
                continue
            for k in range(begin, end):
                if needed[j, k]:
                    s = 0.75 if (k - first) & 1 else 0.25
                    planes[j, k, 0], planes[j, k, 1], planes[j, k, 2] = blend(
                        parents, before + ((k - first) >> 1), below, s, t, 2.0 * size
                    )


@njit
def _through_ground(ground, place, planes):
    """Shift the planes of ground cells so that they hold their cell's ground."""
    for j in range(ground.shape[0]):
        for i in range(ground.shape[1]):
            if ground[j, i]:
                x, y, z = place[j, i, 0], place[j, i, 1], place[j, i, 2]
                planes[j, i, 0] = z - x * planes[j, i, 1] - y * planes[j, i, 2]


class Planes(NamedTuple):
    """Of blocks of 2 x 2 cells."""

    values: np.ndarray  #: (h, w, 3) at their centers, where asked for: height, gradient per cell
    left: int  #: number of the first column
    bottom: int  #: of the first row


class GroundPyramid:
    """Blocks of cells, and blocks of these, and what they know of the ground; arguments as of :func:`surface`.

    `ground` may be added to: the cells that are ground since are given to :meth:`add`.
    """

    def __init__(
        self,
        ground: np.ndarray,
        place: np.ndarray,
        floor: np.ndarray,
        raster: np.ndarray,
        left: int,
        bottom: int,
        levels: int,
    ) -> None:
        self._ground, self._place = ground, place
        h, w = ground.shape
        spans = [(left, bottom, w, h)]
        for _ in range(levels):
            a, b, w, h = spans[-1]
            low_a, low_b = (a >> 1) - 1, (b >> 1) - 1
            spans.append((low_a, low_b, ((a + w - 1) >> 1) + 2 - low_a, ((b + h - 1) >> 1) + 2 - low_b))
        self._spans = spans
        # Memory that is zero and never touched costs nothing: empty land is not gone over with all its numbers.
        self._moments = [np.zeros((h, 9, w)) for _, _, w, h in spans[1:]]
        self._held = [np.zeros((h, w), bool) for _, _, w, h in spans[1:]]
        self._planes = [np.zeros((h, w, 3)) for _, _, w, h in spans[1:]]
        for level in range(1, levels + 1):
            into = self._moments[level - 1], self._held[level - 1], *spans[level][:2]
            if level == 1:
                moments_of_cells(ground, place, left, bottom, *into)
            else:
                fine = self._moments[level - 2], self._held[level - 2], *spans[level - 1][:2]
                moments_of_blocks(*fine, 2.0 ** (level - 1), *into)
        self._floor, self._raster = floor, raster
        self._coarsest: dict[int, np.ndarray] = {}

    def add(self, cells: np.ndarray) -> None:
        """Cells (n,), numbered row by row, have become ground."""
        left, bottom, width, _ = self._spans[0]
        fine: tuple = ()
        for level in range(1, len(self._spans)):
            into = self._moments[level - 1], self._held[level - 1], *self._spans[level][:2]
            if level == 1:
                moments_of_cells_again(cells, self._ground, self._place, left, bottom, *into)
            else:
                moments_of_blocks_again(cells, width, left, bottom, level, *fine, *into)
            fine = into

    def planes(self, needed: np.ndarray, levels: int | None = None) -> Planes:
        """Planes of blocks of 2 x 2 cells, where cells (h, w) that are `needed` ask for them; good until the next call.

        As of a pyramid of so many `levels`, by default all.
        """
        wanted = [needed]
        for before, span in zip(self._spans, self._spans[1:], strict=False):
            a, b, w, h = span
            wanted.append(_needed_parents(wanted[-1], *before[:2], (h, w), a, b))
        top = len(self._planes) if levels is None else levels
        if top not in self._coarsest:
            self._coarsest[top] = np.empty_like(self._planes[top - 1])
            origin, coarsest = self._spans[0][:2], self._coarsest[top]
            _coarsest(self._floor, self._raster, *origin, top, coarsest, *self._spans[top][:2])
        for level in range(top, 0, -1):
            planes, span = self._planes[level - 1], self._spans[level]
            if level == top:
                planes[:] = self._coarsest[top]
            else:
                coarser = self._planes[level], *self._spans[level + 1][:2]
                _from_parents(*coarser, 2.0**level, *span[:2], wanted[level], planes)
            _fit(self._moments[level - 1], 2.0**level, wanted[level], planes)
        return Planes(self._planes[0], *self._spans[1][:2])


@device
def plane_of_cell(blocks, blocks_left, blocks_bottom, column, row):
    """Height at the center of a cell and gradient, of the planes of blocks of 2 x 2 cells."""
    s, t = 0.25 + 0.5 * (1 - (column & 1)), 0.25 + 0.5 * (1 - (row & 1))
    before, below = ((column + 1) >> 1) - 1 - blocks_left, ((row + 1) >> 1) - 1 - blocks_bottom
    return blend(blocks, before, below, s, t, 2.0)


def surface(
    ground: np.ndarray,
    place: np.ndarray,
    floor: np.ndarray,
    raster: np.ndarray,
    left: int,
    bottom: int,
    levels: int,
    needed: np.ndarray,
    planes: np.ndarray | None = None,
) -> np.ndarray:
    """Planes at the centers of all cells (h, w, 3): height, gradient per cell; NaN beyond the reach of all measured cells.

    `ground` (h, w) says which cells hold ground, `place` (h, w, 3) where it is: from the cell's center, in cells, and its
    height; `floor` (h, w) is the level to take where no ground is near, `raster` (h, w) is not finite where nothing was
    measured. `left` and `bottom` number the first column and row from the origin of the coordinates. There are
    `levels` coarser levels, at least 1. `needed` (h, w) says at which cells planes are wanted; elsewhere stands none.
    They are put into `planes` where that is given: those at the same cells, made before.
    """
    blocks = GroundPyramid(ground, place, floor, raster, left, bottom, levels).planes(needed)
    if planes is None:
        planes = np.zeros((*ground.shape, 3))
    _from_parents(blocks.values, blocks.left, blocks.bottom, 1.0, left, bottom, needed, planes)
    _through_ground(ground, place, planes)
    return planes
