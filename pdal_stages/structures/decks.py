"""Detect bridge decks: narrow surfaces that drop at both sides and lead on to ground at both ends.

After the profiles of Sithole and Vosselman [S06], on a raster of vertical layers in cells of a
meter:

1. A layer is solid if most of the cells around it hold a layer that one can step on to.
2. From each solid layer one walks in eight directions to the next until there is none ahead. Such
   an edge is a drop where something lies lower straight ahead, open where no points lie ahead, as
   over water without returns, and a wall otherwise. Beyond the survey all is wall.
3. Layers with drops or open edges at two opposite sides, close together, are narrow. Layers beside
   them that are not ground belong to them.
4. Connected narrow layers are a deck if they lead on to ground at two opposite ends, across their
   width, and drop at both sides between these, with few walls.

Decks that leave the cloud, that are longer or wider than :class:`DeckRules` has it, and bridges
hardly above what they cross are not detected. Below 2 points/m2 cells are too empty.

[S06] Sithole, Vosselman (2006): Bridge detection in airborne laser scanner data. ISPRS Journal of
Photogrammetry and Remote Sensing 61(1), 33-46.
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

#: Side of the cells, meters; lengths that are counted in cells are therefore in meters.
CELL_M = 1.0


class DeckRules(NamedTuple):
    """Thresholds of the detector, a named tuple because compiled kernels read it.

    Most were set on a bridge of 57 points/m2 (LiDAR HD). Of 26 labeled surveys without bridges 25
    have 0.00 % of false points of decks, the bush 0.02 % (docs/results/structures.md). What rules
    are worth, where that was measured, is in docs/results/ablation.md.
    """

    max_step_m: float = 0.35  #: from one cell to another: a curb
    max_grade: float = 0.25  #: that step grows by this much per meter: ramps of footbridges
    max_gap: int = 5  #: cells without a solid layer that one walks across: a car
    #: of the 8 cells around a solid layer: what layers on a straight edge have
    min_neighbors: int = 5
    max_width: int = 40  #: cells: a motorway has 30 m
    max_length: int = 250  #: cells along either axis; tiles read farther than that around
    min_cells: int = 20  #: fewer tell no direction
    min_drop_m: float = 2.0  #: to what lies lower straight ahead; not tuned
    min_wall_slope: float = 1.25  #: rise over run of that drop: a bank of 45 degrees is not one
    #: cells from a place without points to others in all four quadrants: else the survey ends there
    max_water: int = 60
    link: int = 2  #: cells across which layers are connected
    #: times that layers up to `link` cells beside narrow ones become narrow: abutments under leaves
    grow_rounds: int = 3
    min_end_ratio: float = 0.5  #: layers that lead on to ground at an end, per cell of the width
    min_side_ratio: float = 0.25  #: layers at a drop at a side, per cell of the deck's length
    max_wall_ratio: float = 0.3  #: layers at walls, per cell of both sides: crowns have many
    #: height from its layers within which points are of the deck: crossfall, feet of parapets
    surface_m: float = 0.4
    #: cells from a layer to points of the deck: its edge, where the lowest layer is below
    beside: int = 2
    #: more cells of `reach_m`: the neighbors that make a layer solid, and one for rounding
    reach_margin: int = 2

    @property
    def reach_m(self) -> float:
        """Distance in meters up to which other points decide whether a point is of a deck."""
        grown = self.grow_rounds * self.link + self.link
        edge = self.max_width + self.max_gap + self.max_water
        return (self.beside + self.max_length + grown + edge + self.reach_margin) * CELL_M


RULES = DeckRules()
#: What a layer ends at in a direction, where it does.
WALL = 1
DROP = 2
OPEN = 3
#: Columns and rows to the cell ahead in the eight directions.
EAST = np.array([1, 1, 0, -1, -1, -1, 0, 1])
NORTH = np.array([0, 1, 1, 1, 0, -1, -1, -1])
#: Cosine from which on a direction counts as across a deck: within 37 degrees.
ACROSS = 0.8


class _LowestLayers(NamedTuple):
    """Vertical layers of a raster by their lowest points, in the order of their cells."""

    z: NDArray[np.float64]  #: (n,) height of the lowest point, meters
    start: NDArray[np.int64]  #: (height * width + 1,) the first layer of each cell
    height: int
    width: int


def find_decks(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    z: NDArray[np.float64],
    use: NDArray[np.bool_],
    ground: NDArray[np.bool_],
    rules: DeckRules = RULES,
) -> NDArray[np.bool_]:
    """Return which points (n,) are of bridge decks.

    Coordinates (n,) are in meters, finite; `ground` (n,) is what a ground filter calls ground,
    with decks or without; points that are not in `use` (n,) are ignored.
    """
    is_deck, used = np.zeros(len(x), bool), np.flatnonzero(use)
    if not len(used):
        return is_deck
    column, row = (cell_numbers(axis[used], CELL_M) for axis in (x, y))
    for part, inner in patches(column, row, int(rules.reach_m / CELL_M), rules.max_water + 1):
        points = used[part]
        decks = _find_in_piece(column[part], row[part], z[points], ground[points], rules)
        is_deck[points[inner]] = decks[inner]
    return is_deck


def _find_in_piece(column, row, z, ground, rules) -> NDArray[np.bool_]:
    """Return which points (n,) of a piece are of decks."""
    window = GridWindow.enclosing(column, row)
    cell = window.flat_index(column, row)
    order, begins = levels(z, cell)
    first = np.flatnonzero(begins)
    lowest = order[first]
    start = np.searchsorted(cell[lowest], np.arange(window.width * window.height + 1))
    layers = _LowestLayers(z[lowest], start, window.height, window.width)
    solid = _find_solid(layers, rules)
    deck = _find_deck_layers(layers, solid, np.logical_or.reduceat(ground[order], first), rules)
    if not deck.any():
        return np.zeros(len(z), bool)
    return _take_points(z, column - window.left, row - window.bottom, layers, deck, solid, rules)


def _find_deck_layers(layers, solid, ground, rules) -> NDArray[np.bool_]:
    """Return which layers (n,) are of decks; `solid` and `ground` (n,) describe the layers."""
    has_points = (np.diff(layers.start) > 0).reshape(layers.height, layers.width)
    distance, edge = _walk(layers, solid, _lie_in_survey(has_points, rules.max_water), rules)
    narrow = (distance[:, :4] + distance[:, 4:] <= rules.max_width).any(axis=1)
    rim = narrow
    for _ in range(rules.grow_rounds):
        _, beside = _pair_steps(layers, solid, rim, rules)
        rim = np.zeros(len(narrow), bool)
        rim[beside] = True
        rim &= ~narrow & ~ground
        narrow = narrow | rim
    is_deck, layer = np.zeros(len(narrow), bool), np.flatnonzero(narrow)
    if len(layer):
        first, second = _pair_steps(layers, solid, narrow, rules)
        number, inside, part = np.cumsum(narrow) - 1, narrow[second], np.empty(len(layer), int)
        number_sets(number[first[inside]], number[second[inside]], part)
        leads = np.bincount(first[~inside & ground[second]], minlength=len(narrow))[layer] > 0
        cell = np.searchsorted(layers.start, layer, "right") - 1
        row, column = np.divmod(cell, layers.width)
        is_deck[layer] = _judge_parts(part, row, column, leads, edge[layer], rules)[part]
    return is_deck


def _judge_parts(part, row, column, leads, edge, rules) -> NDArray[np.bool_]:
    """Return which parts of narrow layers are decks, judged by their ends and sides.

    `part`, `row` and `column` (k,) place the layers, `leads` (k,) tells those that lead on to
    ground, `edge` (k, 8) what they end at by direction.
    """
    size = np.bincount(part)

    def sums(values):
        return np.bincount(part, values, len(size))

    drop = edge == DROP
    # The deck runs across its drops. Distances from its middle are multiplied by the size: whole
    # numbers, wherever the raster begins.
    products = EAST * EAST, EAST * NORTH, NORTH * NORTH
    xx, xy, yy = (sums((drop * product).sum(axis=1)) for product in products)
    turn = 0.5 * np.arctan2(2 * xy, xx - yy) + np.pi / 2
    cos, sin = np.cos(turn)[part], np.sin(turn)[part]
    north, east = (at * size[part] - sums(at)[part] for at in (row, column))
    along = (east * cos + north * sin) / size[part]
    half = np.zeros(len(size))
    np.maximum.at(half, part, np.abs(along))
    length = 2 * half + 1
    extent = 1 + longest_sides(part, (row, column), len(size))
    good = (size >= rules.min_cells) & (extent <= rules.max_length)
    for end in (along < -0.5 * half[part], along > 0.5 * half[part]):
        good &= sums(leads & end) >= rules.min_end_ratio * size / length
    aside = (NORTH * cos[:, None] - EAST * sin[:, None]) / np.hypot(EAST, NORTH)
    for side in (aside > ACROSS, aside < -ACROSS):
        good &= sums((drop & side).any(axis=1)) >= rules.min_side_ratio * length
    walls = sums(((edge == WALL) & (np.abs(aside) > ACROSS)).any(axis=1))
    return good & (walls <= rules.max_wall_ratio * 2 * length)


@device
def _max_step(columns, rows, rules):
    """Return the highest step, in meters, to a cell so many columns and rows away."""
    return rules.max_step_m + rules.max_grade * np.sqrt(float(columns * columns + rows * rows))


@njit
def _find_solid(layers, rules):
    """Return which layers (n,) most cells around continue."""
    z, start, h, w = layers
    solid = np.zeros(len(z), np.bool_)
    for j in range(h):
        for i in range(w):
            for n in range(start[j * w + i], start[j * w + i + 1]):
                near = 0
                for b in range(max(j - 1, 0), min(j + 2, h)):
                    for a in range(max(i - 1, 0), min(i + 2, w)):
                        if a == i and b == j:
                            continue
                        for m in range(start[b * w + a], start[b * w + a + 1]):
                            if abs(z[m] - z[n]) <= _max_step(a - i, b - j, rules):
                                near += 1
                                break
                solid[n] = near >= rules.min_neighbors
    return solid


@njit
def _lie_in_survey(has_points, reach):
    """Return the cells (h, w) with points in all four quadrants, at most `reach` cells away.

    `has_points` (h, w) tells the cells with points; distances are along either axis.
    """
    h, w = has_points.shape
    inside = np.ones((h, w), np.bool_)
    for up in range(2):
        for right in range(2):
            away = np.full((h + 2, w + 2), reach + 1)  # with a rim
            for jj in range(h):
                j = jj if up else h - 1 - jj
                for ii in range(w):
                    i = ii if right else w - 1 - ii
                    b, a = (j if up else j + 2), (i if right else i + 2)
                    near = min(away[b, i + 1], away[j + 1, a], away[b, a])
                    away[j + 1, i + 1] = 0 if has_points[j, i] else 1 + near
                    inside[j, i] &= away[j + 1, i + 1] <= reach
    return inside


@njit
def _walk(layers, solid, in_survey, rules):
    """Walk from each solid layer in eight directions.

    Return the distance (n, 8) float32 in cells to where the walk ends at a drop or open, infinite
    where it ends at a wall; and DROP, OPEN or WALL (n, 8) int8 where a layer itself is such an end.
    """
    z, start, h, w = layers
    distance = np.full((len(z), 8), np.inf, np.float32)
    edge = np.zeros((len(z), 8), np.int8)
    for d in range(8):
        east, north = EAST[d], NORTH[d]
        step = np.sqrt(float(east * east + north * north))
        for jj in range(h):
            j = h - 1 - jj if north > 0 else jj
            for ii in range(w):
                i = w - 1 - ii if east > 0 else ii
                for n in range(start[j * w + i], start[j * w + i + 1]):
                    if not solid[n]:
                        continue
                    place = j, i, north, east
                    ahead, steps = _look_ahead(layers, solid, in_survey, place, z[n], rules)
                    if ahead >= 0:
                        distance[n, d] = distance[ahead, d] + steps * step
                    else:
                        edge[n, d] = -ahead
                        distance[n, d] = np.inf if ahead == -WALL else 0.0
    return distance, edge


@device
def _look_ahead(layers, solid, in_survey, place, level, rules):
    """Return the next solid layer ahead that one can step on to, and how many steps away it is.

    -DROP, -OPEN or -WALL where there is none. `place` is the row and column of the layer and the
    step in rows and columns; `level` its height.
    """
    z, start, h, w = layers
    j, i, north, east = place
    step, drops, empty = np.sqrt(float(east * east + north * north)), False, True
    steps = int(rules.max_gap / step + 0.5)
    for s in range(1, steps + 1):
        y, x = j + s * north, i + s * east
        if y < 0 or x < 0 or y >= h or x >= w:
            empty = False
            break
        next_layer, least = -1, _max_step(s * east, s * north, rules)
        drop = max(rules.min_drop_m, rules.min_wall_slope * s * step)
        for m in range(start[y * w + x], start[y * w + x + 1]):
            if solid[m] and abs(z[m] - level) <= least:
                next_layer, least = m, abs(z[m] - level)
            drops |= z[m] < level - drop
            empty &= s == 1
        if next_layer >= 0:
            return next_layer, s
    if drops:
        return -DROP, 0
    if empty and in_survey[j + steps * north, i + steps * east]:
        return -OPEN, 0
    return -WALL, 0


@njit
def _pair_steps(layers, solid, chosen, rules):
    """Return pairs (k,), (k,): chosen layers, solid ones a step away within `link` cells."""
    z, start, h, w = layers
    first, second, count = np.empty(1024, np.int64), np.empty(1024, np.int64), 0
    for j in range(h):
        for i in range(w):
            for n in range(start[j * w + i], start[j * w + i + 1]):
                if not chosen[n]:
                    continue
                for b in range(max(j - rules.link, 0), min(j + rules.link + 1, h)):
                    for a in range(max(i - rules.link, 0), min(i + rules.link + 1, w)):
                        for m in range(start[b * w + a], start[b * w + a + 1]):
                            step = abs(z[m] - z[n])
                            if m == n or not solid[m] or step > _max_step(a - i, b - j, rules):
                                continue
                            if count == len(first):
                                first = np.concatenate((first, first))
                                second = np.concatenate((second, second))
                            first[count], second[count] = n, m
                            count += 1
    return first[:count], second[:count]


@njit
def _take_points(z, column, row, layers, deck, solid, rules):
    """Return the points (n,) whose nearest solid layer, of those about as high, is a deck's."""
    heights, start, h, w = layers
    taken = np.zeros(len(z), np.bool_)
    for p in range(len(z)):
        nearest = 2 * (rules.beside + 1) ** 2
        for b in range(max(row[p] - rules.beside, 0), min(row[p] + rules.beside + 1, h)):
            for a in range(max(column[p] - rules.beside, 0), min(column[p] + rules.beside + 1, w)):
                away = (a - column[p]) ** 2 + (b - row[p]) ** 2
                for m in range(start[b * w + a], start[b * w + a + 1]):
                    if not solid[m] or abs(heights[m] - z[p]) > rules.surface_m:
                        continue
                    if away < nearest or (away == nearest and deck[m]):
                        nearest, taken[p] = away, deck[m]
    return taken
