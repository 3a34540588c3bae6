"""Moments of the ground in blocks of cells, each from its four parts: what planes are fitted to (:mod:`.planes`).

Sums are taken in a fixed tree, part by part, so the same ground gives the same bits whatever lies further away. A raster of
blocks is an array (h, 9, w): the rows of a moment lie in one piece, as those who fit planes go along them.
"""

from __future__ import annotations

from ..base.jit import device, njit


@device
def _add_cell(target, k, place, dx, dy):
    """Add to the moments of block k of a row those of a cell whose center lies at (dx, dy)."""
    x, y, z = place[0], place[1], place[2]
    target[0, k] += 1.0
    target[1, k] += x + dx
    target[2, k] += y + dy
    target[3, k] += x * x + 2 * dx * x + dx * dx
    target[4, k] += x * y + dx * y + dy * x + dx * dy
    target[5, k] += y * y + 2 * dy * y + dy * dy
    target[6, k] += z
    target[7, k] += x * z + dx * z
    target[8, k] += y * z + dy * z


@device
def _add_block(target, k, m, i, dx, dy):
    """The same of those of block i of a row."""
    n, x, y, z = m[0, i], m[1, i], m[2, i], m[6, i]
    target[0, k] += n
    target[1, k] += x + n * dx
    target[2, k] += y + n * dy
    target[3, k] += m[3, i] + 2 * dx * x + n * dx * dx
    target[4, k] += m[4, i] + dx * y + dy * x + n * dx * dy
    target[5, k] += m[5, i] + 2 * dy * y + n * dy * dy
    target[6, k] += z
    target[7, k] += m[7, i] + dx * z
    target[8, k] += m[8, i] + dy * z


@njit
def moments_of_cells(ground, place, left, bottom, out, held, out_left, out_bottom):
    """n, x, y, xx, xy, yy, z, xz, yz of the ground of each block of 2 x 2 cells, about its center; which hold any."""
    for j in range(ground.shape[0]):
        dy, row = ((j + bottom) & 1) - 0.5, ((j + bottom) >> 1) - out_bottom
        target, here = out[row], held[row]
        for i in range(ground.shape[1]):
            if ground[j, i]:
                k = ((i + left) >> 1) - out_left
                here[k] = True
                _add_cell(target, k, place[j, i], ((i + left) & 1) - 0.5, dy)


@njit
def moments_of_blocks(fine, held_fine, left, bottom, size, out, held, out_left, out_bottom):
    """The same of blocks of twice the `size`, from their four parts."""
    for j in range(held_fine.shape[0]):
        dy, row = (((j + bottom) & 1) - 0.5) * size, ((j + bottom) >> 1) - out_bottom
        target, here, m = out[row], held[row], fine[j]
        for i in range(held_fine.shape[1]):
            if held_fine[j, i]:
                k = ((i + left) >> 1) - out_left
                here[k] = True
                _add_block(target, k, m, i, (((i + left) & 1) - 0.5) * size, dy)


@njit
def moments_of_cells_again(cells, ground, place, left, bottom, out, held, out_left, out_bottom):
    """Moments of the blocks round these cells (n,), numbered row by row, anew: in the same order, to the same bits."""
    h, w = ground.shape
    for cell in cells:
        row, k = ((cell // w + bottom) >> 1) - out_bottom, ((cell % w + left) >> 1) - out_left
        out[row, :, k] = 0.0
        held[row, k] = True
        for b in range(2):
            for a in range(2):
                j, i = 2 * (row + out_bottom) + b - bottom, 2 * (k + out_left) + a - left
                if 0 <= j < h and 0 <= i < w and ground[j, i]:
                    _add_cell(out[row], k, place[j, i], a - 0.5, b - 0.5)


@njit
def moments_of_blocks_again(
    cells,
    width,
    left,
    bottom,
    shift,
    fine,
    held_fine,
    fine_left,
    fine_bottom,
    out,
    held,
    out_left,
    out_bottom,
):
    """The same of blocks of 2 ** `shift` cells, from their four parts; `width`, `left`, `bottom` are those of the cells."""
    h, w = held_fine.shape
    size = 2.0 ** (shift - 1)
    for cell in cells:
        row = ((cell // width + bottom) >> shift) - out_bottom
        k = ((cell % width + left) >> shift) - out_left
        out[row, :, k] = 0.0
        held[row, k] = True
        for b in range(2):
            for a in range(2):
                j, i = 2 * (row + out_bottom) + b - fine_bottom, 2 * (k + out_left) + a - fine_left
                if 0 <= j < h and 0 <= i < w and held_fine[j, i]:
                    _add_block(out[row], k, fine[j], i, (a - 0.5) * size, (b - 0.5) * size)
