"""Detect wires: long thin lines that hang in the air.

1. A cell's points above the ground are parted into vertical layers. Thin layers with few others
beside them may be of a
   wire.
2. A straight line through such a layer is filled by others for `half_m` to both sides, or to one
where the wire ends, and
   the air around it is empty.
3. A line hides nothing: below it as much is seen as on either side. This parts wires from eaves,
cornices and balconies. 4. Lines that hang together are wires if they are long.

Sums are whole numbers and reaches are bounded, so neither the order of points nor the tile matters.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.grid import GridWindow, cell_numbers
from ..base.jit import device, njit
from ..terrain.cells import levels
from ..terrain.components import longest_sides, number_sets
from ..terrain.pieces import patches

#: Side of the cells, meters.
CELL_M = 1.0


class WireRules(NamedTuple):
    """Thresholds of the wire detector, which kernels take as they are; set on a power line of 14
    points/m2 (AHN4) and on roof edges of 13 surveys without one."""

    min_height_m: float = 4.0  #: above the ground: hedges and fences are lower
    max_thickness_m: float = 0.9  #: of a layer in a cell: a bundle of wires
    max_neighbors: int = 24  #: layers about as high in the 5 x 5 cells around: 4 wires
    same_height_m: float = 2.0  #: up to so much higher or lower layers are neighbors
    half_m: float = 12.0  #: half the length of a line: a wire bends by decimeters over it
    piece_m: float = 2.0  #: length of a line's pieces: points of a wire are nearer to each other
    near_m: float = 0.35  #: above or below a line its points lie at most so far: noise and sag
    beside_m: float = 1.0  #: beside a line its points lie at most so far: wind, a layer's mean
    max_bend: float = 0.02  #: and so much more per meter along it
    min_run_m: float = 5.0  #: between two layers that give a line its direction
    max_slope: float = 0.6  #: rise over run of a line: wires to a tower on a slope
    min_filled: int = 8  #: of the 12 pieces of a line
    min_filled_side: int = 5  #: of the 6 pieces to one side, where the wire ends
    clear_m: float = 0.45  #: the air is empty from so much farther from a line
    around_m: float = 1.6  #: to so far from it: the next wire but one may hang 2.4 m beside
    max_around_ratio: float = 0.34  #: layers there, per layer on the line
    under_m: float = 1.0  #: what lies so much lower than the line is seen below it
    strip_m: float = 0.6  #: half the width of the strip below a line
    side_from_m: float = 1.2  #: the strips at its sides begin so far from it
    side_to_m: float = 3.6  #: and end so far from it
    min_seen_ratio: float = (
        0.55  #: points seen below the line, per point on the fuller side, for the same area
    )
    min_side_ratio: float = (
        0.2  #: points seen below the line's height on one side, per point on the other
    )
    min_clear_share: float = (
        0.3  #: of the layers on a line that hide nothing: trees and roofs stand close to wires
    )
    min_length_m: float = (
        30.0  #: of lines that hang together: ridges and cables on masts are shorter
    )
    hop_m: float = 6.0  #: gaps in a wire, and how far it goes on into a tree or its tower

    @property
    def reach_m(self) -> float:
        """How far away points can change whether a point is of a wire."""
        return self.min_length_m + 3 * self.half_m + 2 * self.hop_m + 6.0


RULES = WireRules()
_PARTS = 1024


class _Layers(NamedTuple):
    """Vertical layers of a raster, in the order of their cells."""

    place: NDArray[np.float64]  #: (n, 3) mean place: x and y from the cell's corner, z; meters
    cell: NDArray[np.int64]  #: (n,) number of its cell, row by row
    start: NDArray[np.int64]  #: (height * width + 1) the first layer of each cell
    height: int
    width: int


def find_wires(
    xyz: NDArray[np.float64],
    height: NDArray[np.float64],
    use: NDArray[np.bool_],
    rules: WireRules = RULES,
) -> NDArray[np.bool_]:
    """Return which points (n,) are of wires.

    Coordinates (n, 3) and heights above ground in meters, finite; points that are not to `use` are
    not seen.
    """
    out = np.zeros(len(xyz), bool)
    high = np.flatnonzero(use & (height > rules.min_height_m))
    if not len(high):
        return out
    column, row = cell_numbers(xyz[:, 0], CELL_M), cell_numbers(xyz[:, 1], CELL_M)
    for points, own in patches(
        column[high], row[high], int(rules.reach_m), int(rules.min_length_m)
    ):
        at = high[points]
        window = GridWindow.enclosing(column[at], row[at]).padded(_margin(rules))
        near = np.flatnonzero(use & window.contains(column, row))
        found = _find(xyz, window.flat_index(column, row), near, at, window, rules)
        out[at[own]] = found[own]
    return out


def _find(xyz, cell, every, high, window, rules) -> NDArray[np.bool_]:
    """Find the points of wires among those high above the ground (k,).

    `cell` (n,) numbers all points' cells in the window; `every` are the points in it.
    """
    h, w = window.height, window.width
    order, begins = levels(xyz[high, 2], cell[high])
    layer = np.empty(len(high), np.int64)
    layer[order] = np.cumsum(begins) - 1
    z, first = xyz[high[order], 2], np.flatnonzero(begins)
    cells, thick = cell[high[order[first]]], z[np.r_[first[1:], len(z)] - 1] - z[first]
    # Within cells, and sums of whole numbers: neither where the raster begins nor order matters.
    within = _within_cells(xyz[high])
    sums = [np.bincount(layer, np.rint(axis * _PARTS)) for axis in within.T]
    place = np.column_stack(sums) / np.bincount(layer)[:, None] / _PARTS
    layers = _Layers(place, cells, np.searchsorted(cells, np.arange(h * w + 1)), h, w)
    line = np.zeros((len(cells), 3))
    good = _lines(layers, _thin(layers, thick, rules), line, rules)
    if not good.any():
        return np.zeros(len(high), bool)
    order = every[np.argsort(cell[every], kind="stable")]
    begin = np.searchsorted(cell[order], np.arange(h * w + 1))
    on = np.zeros(len(xyz), bool)
    on[high] = good[layer]
    x, y, z = _within_cells(xyz[order]).T
    clear = _hide_nothing(layers, good, line, x, y, z, begin, on[order], rules)
    one, other, away = _on_lines(layers, good, line, rules)
    count, lines = len(good), good[other]
    seen = np.bincount(one[lines], clear[other[lines]], count)
    good &= seen >= rules.min_clear_share * np.bincount(one[lines], minlength=count)
    near = (away <= rules.hop_m) & good[one]
    linked = near & good[other]
    part = np.empty(count, np.int64)
    parts = number_sets(one[linked], other[linked], part)
    length = longest_sides(part, np.divmod(cells, w), parts) * CELL_M
    good &= (length >= rules.min_length_m)[part]
    good[other[near & good[one]]] = True
    return good[layer]


def _within_cells(xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return x and y from the corners of the cells that points (n, 3) fall in, and z."""
    return xyz - np.floor(xyz / CELL_M) * [CELL_M, CELL_M, 0.0]


@device
def _margin(rules):
    """Return how many cells away the ground near a line may be seen."""
    return int((rules.half_m + rules.side_to_m) / CELL_M) + 1


@njit
def _thin(layers, thick, rules):
    """Find the thin layers (n,) with few others around."""
    place, cells, start, h, w = layers
    out = np.zeros(len(thick), np.bool_)
    for n in range(len(thick)):
        j, i = cells[n] // w, cells[n] % w
        others = 0
        for b in range(max(j - 2, 0), min(j + 3, h)):
            for a in range(max(i - 2, 0), min(i + 3, w)):
                for m in range(start[b * w + a], start[b * w + a + 1]):
                    others += m != n and abs(place[m, 2] - place[n, 2]) <= rules.same_height_m
        out[n] = thick[n] <= rules.max_thickness_m and others <= rules.max_neighbors
    return out


@njit
def _lines(layers, thin, line, rules):
    """Fill `line` (n, 3) with the direction (x, y; rise over run) of each layer's best line; return
    which have one."""
    place, cells, start, h, w = layers
    good = np.zeros(len(thin), np.bool_)
    length = rules.half_m
    reach, half = int(length / CELL_M) + 1, int(length / rules.piece_m)
    near, slim = np.empty((4096, 3)), np.empty(4096, np.bool_)
    filled = np.zeros(2 * half, np.bool_)
    for n in range(len(thin)):
        if not thin[n]:
            continue
        j, i = cells[n] // w, cells[n] % w
        count = 0
        for b in range(max(j - reach, 0), min(j + reach + 1, h)):
            for a in range(max(i - reach, 0), min(i + reach + 1, w)):
                for m in range(start[b * w + a], start[b * w + a + 1]):
                    dx = (a - i) * CELL_M + place[m, 0] - place[n, 0]
                    dy = (b - j) * CELL_M + place[m, 1] - place[n, 1]
                    dz = place[m, 2] - place[n, 2]
                    if m == n or count == len(near) or dx * dx + dy * dy > length * length:
                        continue
                    if abs(dz) <= rules.max_slope * length + rules.around_m:
                        near[count, 0], near[count, 1], near[count, 2] = dx, dy, dz
                        slim[count] = thin[m]
                        count += 1
        best, many = 0, 0
        for c in range(count):
            run = np.sqrt(near[c, 0] ** 2 + near[c, 1] ** 2)
            if not slim[c] or run < rules.min_run_m or abs(near[c, 2]) > rules.max_slope * run:
                continue
            ux, uy, rise = near[c, 0] / run, near[c, 1] / run, near[c, 2] / run
            if ux < 0.0 or (ux == 0.0 and uy < 0.0):
                ux, uy, rise = -ux, -uy, -rise
            filled[:] = False
            on, around = 1, 0
            for m in range(count):
                along = near[m, 0] * ux + near[m, 1] * uy
                aside = abs(near[m, 1] * ux - near[m, 0] * uy)
                away = max(aside - rules.beside_m + rules.near_m, abs(near[m, 2] - rise * along))
                if away <= rules.near_m:
                    on += slim[m]
                    filled[min(int((along + length) / rules.piece_m), 2 * half - 1)] |= slim[m]
                elif rules.near_m + rules.clear_m < away <= rules.around_m:
                    around += 1
            lower, upper = filled[:half].sum(), filled[half:].sum()
            score = lower + upper
            if score < rules.min_filled and max(lower, upper) < rules.min_filled_side:
                continue
            better = score > best or (score == best and on > many)
            if better and around <= rules.max_around_ratio * on:
                best, many = score, on
                line[n, 0], line[n, 1], line[n, 2] = ux, uy, rise
                good[n] = True
    return good


@njit
def _hide_nothing(layers, good, line, x, y, z, begin, on, rules):
    """Find the layers (n,) with lines below which as much is seen as on either side.

    Of all points in the order of their cells, which begin at `begin`: places in these (x, y),
    heights, and whether they are `on` such lines.
    """
    place, cells, _, _, w = layers
    out, margin = good.copy(), _margin(rules)
    for n in range(len(good)):
        if not good[n]:
            continue
        j, i = cells[n] // w, cells[n] % w
        below, sides, under = 0, np.zeros(2, np.int64), np.zeros(2, np.int64)
        for b in range(j - margin, j + margin + 1):
            for a in range(i - margin, i + margin + 1):
                for p in range(begin[b * w + a], begin[b * w + a + 1]):
                    dx = (a - i) * CELL_M + x[p] - place[n, 0]
                    dy = (b - j) * CELL_M + y[p] - place[n, 1]
                    along = dx * line[n, 0] + dy * line[n, 1]
                    aside = dy * line[n, 0] - dx * line[n, 1]
                    if abs(along) > rules.half_m or abs(aside) > rules.side_to_m:
                        continue
                    above = z[p] - place[n, 2] - line[n, 2] * along
                    if abs(aside) <= rules.strip_m:
                        below += above < -rules.under_m
                    elif abs(aside) > rules.side_from_m and above < rules.under_m and not on[p]:
                        sides[int(aside > 0.0)] += 1
                        under[int(aside > 0.0)] += above < -rules.under_m
        wide = rules.side_to_m - rules.side_from_m
        out[n] = below * wide >= rules.min_seen_ratio * 2.0 * rules.strip_m * sides.max()
        out[n] &= under.min() >= rules.min_side_ratio * under.max()
    return out


@njit
def _on_lines(layers, good, line, rules):
    """Pair (k,) layers with lines and (k,) those on them, themselves included; (k,) how far away
    these are, meters."""
    place, cells, start, h, w = layers
    one, other, far = np.empty(1024, np.int64), np.empty(1024, np.int64), np.empty(1024)
    count, reach = 0, int(rules.half_m / CELL_M)
    for n in range(len(good)):
        if not good[n]:
            continue
        j, i = cells[n] // w, cells[n] % w
        for b in range(max(j - reach, 0), min(j + reach + 1, h)):
            for a in range(max(i - reach, 0), min(i + reach + 1, w)):
                for m in range(start[b * w + a], start[b * w + a + 1]):
                    dx = (a - i) * CELL_M + place[m, 0] - place[n, 0]
                    dy = (b - j) * CELL_M + place[m, 1] - place[n, 1]
                    along = dx * line[n, 0] + dy * line[n, 1]
                    aside = dy * line[n, 0] - dx * line[n, 1]
                    above = place[m, 2] - place[n, 2] - line[n, 2] * along
                    away = abs(along)
                    if away > rules.half_m or abs(aside) > rules.beside_m:
                        continue
                    if abs(above) > rules.near_m + rules.max_bend * away:
                        continue
                    if count == len(one):
                        one, other = np.concatenate((one, one)), np.concatenate((other, other))
                        far = np.concatenate((far, far))
                    one[count], other[count], far[count] = n, m, away
                    count += 1
    return one[:count], other[:count], far[:count]
