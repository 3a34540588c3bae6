"""Detect wires: long thin lines that hang in the air.

1. A cell's points above the ground are parted into vertical layers. Those with few others beside
   them may be of a wire.
2. Most pieces of a straight line through such a layer, of `half_m` to both sides, hold others, and
   hardly any layers are close around it.
3. A line hides nothing: below it as much is seen as on either side, which parts wires from eaves,
   cornices and facades.
4. Connected lines are wires if they are long.

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
    """Thresholds of the wire detector, a named tuple because compiled kernels read it.

    They were set on a power line of 14 points/m2 (AHN4) and on roof edges of surveys without one.
    What some are worth is in docs/results/ablation.md.
    """

    min_height_m: float = 4.0  #: above the ground: hedges and fences are lower
    #: layers about as high in the cells around a lone one: three wires and more. 24 finds as many
    #: wires and takes twice as long, any number 3.7 times (docs/results/ablation.md)
    max_neighbors: int = 18
    neighbor_cells: int = 2  #: cells to every side in which those layers lie: 5 x 5
    same_height_m: float = 2.0  #: layers up to this much higher or lower are neighbors
    half_m: float = 12.0  #: half the length of a line: a wire bends by decimeters over it
    piece_m: float = 2.0  #: length of a line's pieces: points of a wire are nearer to each other
    near_m: float = 0.35  #: points of a line lie this far above or below it: noise and sag
    beside_m: float = 1.0  #: and this far beside it: wind, a layer's mean
    min_run_m: float = 5.0  #: between two layers that give a line its direction
    max_slope: float = 0.6  #: rise over run of a line: wires to a tower on a slope
    #: pieces of a line that hold lone layers; of 2 * `half_m` / `piece_m`, 12. It does not follow
    #: when these change
    min_filled: int = 8
    #: the air is empty from `near_m` + `clear_m`, 0.8 m, above and below a line, and beside it from
    #: `beside_m` + `clear_m`, 1.45 m
    clear_m: float = 0.45
    #: to this far above and below, and 2.25 m beside: the next wire but one hangs 2.4 m beside
    around_m: float = 1.6
    #: layers there, per layer on the line. At 0.1 roofs need no test of what is hidden, but wires
    #: at the top of a tower go (AHN4)
    max_around_ratio: float = 0.34
    under_m: float = 1.0  #: what lies this much lower than a line is seen below it
    strip_m: float = 0.6  #: half the width of the strip below a line
    side_from_m: float = 1.2  #: the strips at its sides begin this far from it
    side_to_m: float = 3.6  #: and end this far from it
    #: points seen below a line, per point on the fuller side, for the same area
    min_seen_ratio: float = 0.55
    #: points seen below a line's height on one side, per point on the other
    min_side_ratio: float = 0.2
    #: of the layers on a line that hide nothing: trees and roofs stand close to wires. Without this
    #: test 0.54 % of Seville's points are wires
    min_clear_share: float = 0.3
    min_length_m: float = 30.0  #: of connected lines: ridges and cables on masts are shorter
    hop_m: float = 6.0  #: gaps in a wire, and how far it goes on into a tree or a tower
    #: more of `reach_m`, for the 5 x 5 cells around a layer and for whole cells; not tuned
    reach_margin_m: float = 6.0

    @property
    def reach_m(self) -> float:
        """Distance in meters up to which other points decide whether a point is of a wire."""
        return self.min_length_m + 3 * self.half_m + 2 * self.hop_m + self.reach_margin_m


RULES = WireRules()
#: Parts of a meter in which places are summed up, as whole numbers.
PARTS = 1024
#: Layers near one through which its line is searched, at most: 9 in each cell of a circle of 12 m.
#: Further ones, in the northern rows, are not seen.
MAX_NEAR = 4096


class _MeanLayers(NamedTuple):
    """Vertical layers of a raster by their mean places, in the order of their cells."""

    place: NDArray[np.float64]  #: (n, 3) mean place: x and y from the cell's corner, z; meters
    cell: NDArray[np.int64]  #: (n,) number of its cell, row by row
    start: NDArray[np.int64]  #: (height * width + 1,) the first layer of each cell
    height: int
    width: int


def find_wires(
    xyz: NDArray[np.float64],
    height: NDArray[np.float64],
    use: NDArray[np.bool_],
    rules: WireRules = RULES,
) -> NDArray[np.bool_]:
    """Return which points (n,) are of wires.

    Coordinates (n, 3) and heights above ground (n,) are in meters, finite; points that are not in
    `use` (n,) are ignored.
    """
    is_wire = np.zeros(len(xyz), bool)
    high = np.flatnonzero(use & (height > rules.min_height_m))
    if not len(high):
        return is_wire
    column, row = (cell_numbers(xyz[:, axis], CELL_M) for axis in (0, 1))
    reach, link = (int(length / CELL_M) for length in (rules.reach_m, rules.min_length_m))
    for points, inner in patches(column[high], row[high], reach, link):
        at = high[points]
        window = GridWindow.enclosing(column[at], row[at]).padded(_sides_reach(rules))
        near_piece = np.flatnonzero(use & window.contains(column, row))
        cell = window.flat_index(column, row)
        wires = _find_in_piece(xyz, cell, at, near_piece, window, rules)
        is_wire[at[inner]] = wires[inner]
    return is_wire


def _in_cells(xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return x and y from the corners of the cells that points (n, 3) fall in, and z."""
    return xyz - np.floor(xyz / CELL_M) * [CELL_M, CELL_M, 0.0]


def _find_in_piece(cloud, cell_of, high, near, window, rules) -> NDArray[np.bool_]:
    """Return which points (k,) of a piece, all `high` above the ground, are of wires.

    `cell_of` (n,) numbers all points' cells in the window; `near` are the points in it.
    """
    xyz, cell = cloud[high], cell_of[high]
    order, begins = levels(xyz[:, 2], cell)
    layer = np.empty(len(xyz), np.int64)
    layer[order] = np.cumsum(begins) - 1
    cells = cell[order[begins]]
    # From the corners of cells, and sums of whole numbers: neither where the raster begins nor
    # order matters.
    sums = [np.bincount(layer, np.rint(axis * PARTS)) for axis in _in_cells(xyz).T]
    place = np.column_stack(sums) / np.bincount(layer)[:, None] / PARTS
    h, w = window.shape
    layers = _MeanLayers(place, cells, np.searchsorted(cells, np.arange(h * w + 1)), h, w)
    line = np.zeros((len(cells), 3))
    good = _find_lines(layers, _find_lone(layers, rules), line, rules)
    if not good.any():
        return good[layer]
    near_all = near[np.argsort(cell_of[near], kind="stable")]
    begin = np.searchsorted(cell_of[near_all], np.arange(h * w + 1))
    on_line = np.zeros(len(cloud), bool)
    on_line[high] = good[layer]
    places = _in_cells(cloud[near_all])
    clear = _hide_nothing(layers, good, line, places, begin, on_line[near_all], rules)
    first, second, away = _pair_on_lines(layers, good, line, rules)
    seen, count = good[second], len(good)
    on_line_of = np.bincount(first[seen], None, count)
    share = np.bincount(first[seen], clear[second[seen]], count) / np.maximum(on_line_of, 1)
    good &= share >= rules.min_clear_share
    near_pair = (away <= rules.hop_m) & good[first]
    first, second = first[near_pair], second[near_pair]
    linked = good[second]
    part = np.empty(len(good), np.int64)
    parts = number_sets(first[linked], second[linked], part)
    length = longest_sides(part, np.divmod(cells, w), parts) * CELL_M
    good &= (length >= rules.min_length_m)[part]
    good[second[good[first]]] = True
    return good[layer]


@njit
def _find_lone(layers, rules):
    """Return which layers (n,) have few others around."""
    place, cells, start, h, w = layers
    lone, reach = np.zeros(len(cells), np.bool_), rules.neighbor_cells
    for n in range(len(cells)):
        j, i = cells[n] // w, cells[n] % w
        others = 0
        for b in range(max(j - reach, 0), min(j + reach + 1, h)):
            for a in range(max(i - reach, 0), min(i + reach + 1, w)):
                for m in range(start[b * w + a], start[b * w + a + 1]):
                    others += m != n and abs(place[m, 2] - place[n, 2]) <= rules.same_height_m
        lone[n] = others <= rules.max_neighbors
    return lone


@njit
def _find_lines(layers, lone, line, rules):
    """Return which layers (n,) have a line; fill `line` (n, 3): direction x, y, rise over run."""
    place, cells, start, h, w = layers
    good = np.zeros(len(lone), np.bool_)
    length = rules.half_m
    reach, half = int(length / CELL_M) + 1, int(length / rules.piece_m)
    near, near_lone = np.empty((MAX_NEAR, 3)), np.empty(MAX_NEAR, np.bool_)
    filled = np.zeros(2 * half, np.bool_)
    for n in range(len(lone)):
        if not lone[n]:
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
                        near_lone[count] = lone[m]
                        count += 1
        best, most = 0, 0
        for c in range(count):
            run = np.sqrt(near[c, 0] ** 2 + near[c, 1] ** 2)
            if not near_lone[c] or run < rules.min_run_m or abs(near[c, 2]) > rules.max_slope * run:
                continue
            ux, uy, rise = near[c, 0] / run, near[c, 1] / run, near[c, 2] / run
            if ux < 0.0 or (ux == 0.0 and uy < 0.0):
                ux, uy, rise = -ux, -uy, -rise
            filled[:] = False
            members, crowd = 1, 0
            for m in range(count):
                along = near[m, 0] * ux + near[m, 1] * uy
                aside = abs(near[m, 1] * ux - near[m, 0] * uy)
                away = max(aside - rules.beside_m + rules.near_m, abs(near[m, 2] - rise * along))
                if away <= rules.near_m:
                    members += near_lone[m]
                    piece = min(int((along + length) / rules.piece_m), 2 * half - 1)
                    filled[piece] |= near_lone[m]
                elif rules.near_m + rules.clear_m < away <= rules.around_m:
                    crowd += 1
            score = filled.sum()
            better = score > best or (score == best and members > most)
            clear = crowd <= rules.max_around_ratio * members
            if score >= rules.min_filled and better and clear:
                best, most = score, members
                line[n, 0], line[n, 1], line[n, 2] = ux, uy, rise
                good[n] = True
    return good


@device
def _sides_reach(rules):
    """Return how many cells away the ground beside a line may be seen."""
    return int((rules.half_m + rules.side_to_m) / CELL_M) + 1


@njit
def _hide_nothing(layers, good, line, places, begin, on_line, rules):
    """Return the layers (n,) with lines below which as much is seen as on either side.

    `places` (m, 3) are all points in the order of their cells, which begin at `begin`; `on_line`
    (m,) says which of them are on such lines.
    """
    place, cells, _, _, w = layers
    clear, reach = good.copy(), _sides_reach(rules)
    for n in range(len(good)):
        if not good[n]:
            continue
        j, i = cells[n] // w, cells[n] % w
        below, sides, under = 0, np.zeros(2, np.int64), np.zeros(2, np.int64)
        for b in range(j - reach, j + reach + 1):
            for a in range(i - reach, i + reach + 1):
                for p in range(begin[b * w + a], begin[b * w + a + 1]):
                    dx = (a - i) * CELL_M + places[p, 0] - place[n, 0]
                    dy = (b - j) * CELL_M + places[p, 1] - place[n, 1]
                    along = dx * line[n, 0] + dy * line[n, 1]
                    aside = dy * line[n, 0] - dx * line[n, 1]
                    if abs(along) > rules.half_m or abs(aside) > rules.side_to_m:
                        continue
                    above = places[p, 2] - place[n, 2] - line[n, 2] * along
                    if abs(aside) <= rules.strip_m:
                        below += above < -rules.under_m
                    elif (
                        abs(aside) > rules.side_from_m and above < rules.under_m and not on_line[p]
                    ):
                        sides[int(aside > 0.0)] += 1
                        under[int(aside > 0.0)] += above < -rules.under_m
        wide = rules.side_to_m - rules.side_from_m
        clear[n] = below * wide >= rules.min_seen_ratio * 2.0 * rules.strip_m * sides.max()
        clear[n] &= under.min() >= rules.min_side_ratio * under.max()
    return clear


@njit
def _pair_on_lines(layers, good, line, rules):
    """Return pairs (k,), (k,) of layers with lines and of those on them, themselves included.

    Their distances (k,) along the line, in meters, come third: at most `half_m`.
    """
    place, cells, start, h, w = layers
    first, second = np.empty(1024, np.int64), np.empty(1024, np.int64)
    distance = np.empty(1024)
    count, reach = 0, int(rules.half_m / CELL_M) + 1
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
                    if abs(above) > rules.near_m:
                        continue
                    if count == len(first):
                        first = np.concatenate((first, first))
                        second = np.concatenate((second, second))
                        distance = np.concatenate((distance, distance))
                    first[count], second[count], distance[count] = n, m, away
                    count += 1
    return first[:count], second[:count], distance[:count]
