"""A surface through scattered ground heights: planes on a pyramid of blocks, coarse to fine.

Every block of the pyramid (a cell, 2 x 2 cells, 4 x 4, ...; anchored to absolute coordinates) has a plane at
its center: a least squares fit to the ground of the 3 x 3 blocks round it, held by what the planes of the
four nearest blocks of the next coarser level say there. Where ground is dense the finest level decides;
across a hole the finest level that sees its rim does. The reach is bounded (:func:`reach`), sums are taken
in a fixed tree, so the same ground gives the same bits whatever lies further away.
"""

from __future__ import annotations

import numpy as np

from ..base.jit import device, njit

#: Weight of the coarser gradient per ground cell, for a lever of one block: it decides where all
#: ground of a fit lies to one side or on a line.
_STIFFNESS = 0.02
#: Weight of the coarser height, in ground cells.
_HOLD = 0.1


def reach(levels: int) -> int:
    """How far ground changes the surface, in cells."""
    # A block's parents lie up to 1.5 blocks away, level by level; the coarsest sees 3 x 3 of its blocks.
    return 3 * 2**levels


@device
def _add(total, m, dx, dy, weight):
    """Add moments whose origin lies at (dx, dy)."""
    n = m[0]
    if n > 0:
        total[0] += weight * n
        total[1] += weight * (m[1] + n * dx)
        total[2] += weight * (m[2] + n * dy)
        total[3] += weight * (m[3] + 2 * dx * m[1] + n * dx * dx)
        total[4] += weight * (m[4] + dx * m[2] + dy * m[1] + n * dx * dy)
        total[5] += weight * (m[5] + 2 * dy * m[2] + n * dy * dy)
        total[6] += weight * m[6]
        total[7] += weight * (m[7] + dx * m[6])
        total[8] += weight * (m[8] + dy * m[6])


@njit
def _moments_of_cells(ground, place, left, bottom, out, held, out_left, out_bottom):
    """n, x, y, xx, xy, yy, z, xz, yz of the ground of each block of 2 x 2 cells, about its center; which hold any."""
    one = np.ones(9)
    for j in range(ground.shape[0]):
        for i in range(ground.shape[1]):
            if ground[j, i]:
                x, y, z = place[j, i, 0], place[j, i, 1], place[j, i, 2]
                one[1], one[2], one[3], one[4], one[5] = x, y, x * x, x * y, y * y
                one[6], one[7], one[8] = z, x * z, y * z
                column, row = i + left, j + bottom
                target = out[(row >> 1) - out_bottom, (column >> 1) - out_left]
                held[(row >> 1) - out_bottom, (column >> 1) - out_left] = True
                _add(target, one, (column & 1) - 0.5, (row & 1) - 0.5, 1.0)


@njit
def _moments_of_blocks(fine, held_fine, left, bottom, size, out, held, out_left, out_bottom):
    """The same of blocks of twice the `size`, from their four parts."""
    for j in range(fine.shape[0]):
        for i in range(fine.shape[1]):
            if not held_fine[j, i]:
                continue
            column, row = i + left, j + bottom
            target = out[(row >> 1) - out_bottom, (column >> 1) - out_left]
            held[(row >> 1) - out_bottom, (column >> 1) - out_left] = True
            _add(target, fine[j, i], ((column & 1) - 0.5) * size, ((row & 1) - 0.5) * size, 1.0)


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
        for i in range(raster.shape[1]):
            if np.isfinite(raster[j, i]):
                block = sums[((j + bottom) >> level) - out_bottom, ((i + left) >> level) - out_left]
                block[0] += floor[j, i]
                block[1] += 1.0
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


@njit
def _fit(moments, size, needed, planes):
    """Correct the needed planes (given: what the coarser level says) by the ground of 3 x 3 blocks."""
    h, w = planes.shape[:2]
    for j in range(h):
        for i in range(w):
            if not needed[j, i]:
                continue
            height, across, along = planes[j, i, 0], planes[j, i, 1], planes[j, i, 2]
            if np.isnan(height):
                continue
            # As in _add, but in registers: this is what terrain takes longest for where points are sparse.
            n = x = y = xx = xy = yy = z = xz = yz = 0.0
            for b in range(max(j - 1, 0), min(j + 2, h)):
                dy, near = (b - j) * size, 1.0 - 0.5 * abs(b - j)
                for a in range(max(i - 1, 0), min(i + 2, w)):
                    m = moments[b, a]
                    k = m[0]
                    if k > 0:
                        dx, weight = (a - i) * size, near * (1.0 - 0.5 * abs(a - i))
                        n += weight * k
                        x += weight * (m[1] + k * dx)
                        y += weight * (m[2] + k * dy)
                        xx += weight * (m[3] + 2 * dx * m[1] + k * dx * dx)
                        xy += weight * (m[4] + dx * m[2] + dy * m[1] + k * dx * dy)
                        yy += weight * (m[5] + 2 * dy * m[2] + k * dy * dy)
                        z += weight * m[6]
                        xz += weight * (m[7] + dx * m[6])
                        yz += weight * (m[8] + dy * m[6])
            if n == 0.0:
                continue
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
            planes[j, i, 0] = height + (r - x * gx - y * gy) / n_held
            planes[j, i, 1], planes[j, i, 2] = across + gx, along + gy


@njit
def _needed_parents(needed, left, bottom, out, out_left, out_bottom):
    """Mark the blocks of twice the size whose planes are asked for those of the needed ones."""
    for j in range(needed.shape[0]):
        for i in range(needed.shape[1]):
            if needed[j, i]:
                before, below = ((i + left + 1) >> 1) - 1 - out_left, ((j + bottom + 1) >> 1) - 1 - out_bottom
                for b in range(max(below, 0), min(below + 2, out.shape[0])):
                    for a in range(max(before, 0), min(before + 2, out.shape[1])):
                        out[b, a] = True


@njit
def _from_parents(parents, parents_left, parents_bottom, size, left, bottom, needed, planes):
    """What the planes of blocks of twice the `size` say at the centers of the needed blocks of `size`."""
    for j in range(planes.shape[0]):
        for i in range(planes.shape[1]):
            if not needed[j, i]:
                continue
            # A left child lies 3/4 of the way from the block before its parent's, a right one 1/4 beyond its parent.
            column, row = i + left, j + bottom
            s, t = 0.25 + 0.5 * (1 - (column & 1)), 0.25 + 0.5 * (1 - (row & 1))
            before = ((column + 1) >> 1) - 1 - parents_left
            below = ((row + 1) >> 1) - 1 - parents_bottom
            planes[j, i, 0], planes[j, i, 1], planes[j, i, 2] = blend(
                parents, before, below, s, t, 2.0 * size
            )


@njit
def _through_ground(ground, place, planes):
    """Shift the planes of ground cells so that they hold their cell's ground."""
    for j in range(ground.shape[0]):
        for i in range(ground.shape[1]):
            if ground[j, i]:
                x, y, z = place[j, i, 0], place[j, i, 1], place[j, i, 2]
                planes[j, i, 0] = z - x * planes[j, i, 1] - y * planes[j, i, 2]


def surface(
    ground: np.ndarray,
    place: np.ndarray,
    floor: np.ndarray,
    raster: np.ndarray,
    left: int,
    bottom: int,
    levels: int,
    needed: np.ndarray,
) -> np.ndarray:
    """Planes at the centers of all cells (h, w, 3): height, gradient per cell; NaN beyond the reach of all measured cells.

    `ground` (h, w) says which cells hold ground, `place` (h, w, 3) where it is: from the cell's center, in cells, and its
    height; `floor` (h, w) is the level to take where no ground is near, `raster` (h, w) is not finite where nothing was
    measured. `left` and `bottom` number the first column and row from the origin of the coordinates. There are
    `levels` coarser levels, at least 1. `needed` (h, w) says at which cells planes are wanted; elsewhere stands none.
    """
    h, w = ground.shape
    spans = [(left, bottom, w, h)]
    for _ in range(levels):
        a, b, w, h = spans[-1]
        low_a, low_b = (a >> 1) - 1, (b >> 1) - 1
        spans.append((low_a, low_b, ((a + w - 1) >> 1) + 2 - low_a, ((b + h - 1) >> 1) + 2 - low_b))
    wanted = [needed]
    for level in range(1, levels + 1):
        a, b, w, h = spans[level]
        wanted.append(np.zeros((h, w), bool))
        _needed_parents(wanted[-2], *spans[level - 1][:2], wanted[-1], a, b)
    # Memory that is zero and never touched costs nothing: empty land is not gone over with all its numbers.
    moments, held = [], []
    for level in range(1, levels + 1):
        a, b, w, h = spans[level]
        moments.append(np.zeros((h, w, 9)))
        held.append(np.zeros((h, w), bool))
        before = spans[level - 1][:2]
        if level == 1:
            _moments_of_cells(ground, place, *before, moments[-1], held[-1], a, b)
        else:
            size = 2.0 ** (level - 1)
            _moments_of_blocks(moments[-2], held[-2], *before, size, moments[-1], held[-1], a, b)
    planes = np.empty((0, 0, 3))
    for level in range(levels, -1, -1):
        a, b, w, h = spans[level]
        coarser, planes = planes, np.zeros((h, w, 3))
        if level == levels:
            _coarsest(floor, raster, left, bottom, level, planes, a, b)
        else:
            _from_parents(coarser, *spans[level + 1][:2], 2.0**level, a, b, wanted[level], planes)
        if level == 0:
            _through_ground(ground, place, planes)
        else:
            _fit(moments[level - 1], 2.0**level, wanted[level], planes)
    return planes
