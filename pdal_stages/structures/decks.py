"""Detect bridge decks: narrow surfaces that drop at both sides and lead on to ground at both ends.

After the profiles of Sithole and Vosselman [S06], on a raster of vertical layers in cells of a
meter:

1. A layer is solid if most of the cells around hold a layer that one can step on to. 2. In eight
directions one walks from a solid layer to the next until there is none ahead. Such an edge is a
drop (something
   lies lower ahead), open (nothing lies ahead, as over water without returns), or a wall. What lies
   beyond the survey is not known, and counts as a wall.
3. Layers with drops or open edges at two opposite sides, close together, are narrow. Layers beside
them that are not ground
   belong to them.
4. Narrow layers that hang together are a deck if they lead on to ground at two opposite ends,
across their width, and drop
   at both sides between these.

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
    """Thresholds of the detector; kernels take them as they are. Most were set on a bridge of 57
    points/m2 (LiDAR HD) and hold from half to twice their value there; none marks anything but a
    bridge in 30 labeled surveys."""

    max_step_m: float = 0.35  #: from one cell to another: a curb
    max_grade: float = 0.25  #: and so much more per meter: ramps of footbridges
    max_gap: int = 5  #: cells without a solid layer that one walks across: a car
    min_neighbors: int = (
        5  #: of the 8 cells around a solid layer: what those on a straight edge have
    )
    max_width: int = 40  #: cells: a motorway has 30 m
    max_length: int = 250  #: cells along either axis; tiles read farther than that around
    min_cells: int = 20  #: fewer tell no direction
    min_drop_m: float = 2.0  #: to something lower right ahead: two steps of stairs and more
    min_wall_slope: float = (
        1.25  #: rise over run of that drop: banks of 45 degrees are walls of nothing
    )
    min_clearance_m: float = (
        1.2  #: to something lower in sight, such as water in a canal or the other bank
    )
    headroom_m: float = 1.5  #: leaves and lamps higher than that beside an edge hide nothing
    #: cells from a place without points to others in all four quadrants; else the survey ends there
    max_water: int = 60
    sight: int = 30  #: cells within which something lower is looked for, 45 degrees to either side
    grown: int = (
        3  #: times that layers beside become narrow, up to `link` cells on: abutments under leaves
    )
    link: int = 2  #: cells across which layers hang together
    min_end_ratio: float = (
        0.5  #: layers that lead on to ground at an end, per cell of the deck's width
    )
    min_side_ratio: float = 0.25  #: layers at a drop at a side, per cell of the deck's length
    max_wall_ratio: float = (
        0.3  #: layers at a wall at a side, per cell of both sides: crowns have many
    )
    surface_m: float = (
        0.4  #: points of the deck lie so near to its layers: crossfall, noise, parapets' feet
    )
    beside: int = (
        2  #: cells from a layer to points of the deck: its edge, where the lowest layer is below
    )

    @property
    def reach_m(self) -> float:
        """How far away points can change whether a point is of a deck."""
        grown = self.grown * self.link + self.link
        edge = self.max_width + self.max_gap + max(self.sight, self.max_water)
        return (self.beside + self.max_length + grown + edge + 2) * CELL_M


RULES = DeckRules()
#: How a walk ends.
_WALL, _DROP, _OPEN, _GOES_ON = range(4)
#: The eight directions, by column and row.
_EAST, _NORTH = np.array([1, 1, 0, -1, -1, -1, 0, 1]), np.array([0, 1, 1, 1, 0, -1, -1, -1])
_FAR = np.float32(1e9)


class _Layers(NamedTuple):
    """Vertical layers of a raster, in the order of their cells."""

    z: NDArray[np.float64]  #: (n,) height of the lowest point, meters
    start: NDArray[np.int64]  #: (height * width + 1) the first layer of each cell
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

    Coordinates in meters, finite; `ground` is what a ground filter calls ground, decks among it or
    not; points that are not to `use` are not seen.
    """
    out, used = np.zeros(len(x), bool), np.flatnonzero(use)
    if not len(used):
        return out
    column, row = (cell_numbers(axis[used], CELL_M) for axis in (x, y))
    link = max(rules.sight, rules.max_water) + 1
    for part, own in patches(column, row, int(rules.reach_m / CELL_M), link):
        points = used[part]
        found = _find(column[part], row[part], z[points], ground[points], rules)
        out[points[own]] = found[own]
    return out


def _find(column, row, z, ground, rules) -> NDArray[np.bool_]:
    """Find the decks among the points (n,) of a piece."""
    window = GridWindow.enclosing(column, row)
    cell = window.flat_index(column, row)
    order, begins = levels(z, cell)
    first = np.flatnonzero(begins)
    lowest = order[first]
    start = np.searchsorted(cell[lowest], np.arange(window.width * window.height + 1))
    layers = _Layers(z[lowest], start, window.height, window.width)
    on_ground = np.logical_or.reduceat(ground[order], first)
    solid = _solid(layers, rules)
    deck = _deck_layers(layers, solid, on_ground, rules)
    if not deck.any():
        return np.zeros(len(z), bool)
    return _points_of(z, column - window.left, row - window.bottom, layers, deck, solid, rules)


def _deck_layers(layers, solid, ground, rules) -> NDArray[np.bool_]:
    """Find the layers (n,) of decks."""
    held = (np.diff(layers.start) > 0).reshape(layers.height, layers.width)
    far, end, edge = _walks(layers, solid, _within_survey(held, rules.max_water), rules)
    left, right = end[:, :4], end[:, 4:]
    over = ((left == _DROP) | (left == _OPEN)) & ((right == _DROP) | (right == _OPEN))
    narrow = (over & (far[:, :4] + far[:, 4:] <= rules.max_width)).any(axis=1)
    rim = narrow
    for _ in range(rules.grown):
        _, other = _steps(layers, solid, rim, rules)
        rim = np.zeros(len(narrow), bool)
        rim[other] = True
        rim &= ~narrow & ~ground
        narrow = narrow | rim
    one, other = _steps(layers, solid, narrow, rules)
    layer, number = np.flatnonzero(narrow), np.cumsum(narrow) - 1
    inside, part = narrow[other], np.empty(len(layer), np.int64)
    number_sets(number[one[inside]], number[other[inside]], part)
    out = np.zeros(len(narrow), bool)
    if len(layer):
        leads = np.bincount(one[~inside & ground[other]], minlength=len(narrow))[layer] > 0
        cell = np.repeat(np.arange(held.size), np.diff(layers.start))[layer]
        out[layer] = _are_decks(part, *np.divmod(cell, layers.width), leads, edge[layer], rules)[
            part
        ]
    return out


def _are_decks(part, row, column, leads, edge, rules) -> NDArray[np.bool_]:
    """Judge the parts that narrow layers (k,) belong to by their ends and sides.

    `leads` tells the layers that lead on to ground, `edge` (k, 8) their edges by direction.
    """
    size = np.bincount(part)

    def sums(values):
        return np.bincount(part, values, len(size))

    drop = edge == _DROP
    # The deck runs across its drops. Places from its middle, times the size: whole numbers,
    # wherever the raster begins.
    xx, xy, yy = (
        sums((drop * by).sum(axis=1)) for by in (_EAST * _EAST, _EAST * _NORTH, _NORTH * _NORTH)
    )
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
    aside = (_NORTH * cos[:, None] - _EAST * sin[:, None]) / np.hypot(_EAST, _NORTH)
    for side in (aside > 0.8, aside < -0.8):
        good &= sums((drop & side).any(axis=1)) >= rules.min_side_ratio * length
    walls = sums(((edge == _WALL) & (np.abs(aside) > 0.8)).any(axis=1))
    return good & (walls <= rules.max_wall_ratio * 2 * length)


@device
def _most(column, row, rules):
    """Return the highest step to a cell so many columns and rows away, meters."""
    return rules.max_step_m + rules.max_grade * np.sqrt(float(column * column + row * row))


@njit
def _solid(layers, rules):
    """Find the layers (n,) that most cells around continue."""
    z, start, h, w = layers
    out = np.zeros(len(z), np.bool_)
    for j in range(h):
        for i in range(w):
            for n in range(start[j * w + i], start[j * w + i + 1]):
                near = 0
                for b in range(max(j - 1, 0), min(j + 2, h)):
                    for a in range(max(i - 1, 0), min(i + 2, w)):
                        if a == i and b == j:
                            continue
                        for m in range(start[b * w + a], start[b * w + a + 1]):
                            if abs(z[m] - z[n]) <= _most(a - i, b - j, rules):
                                near += 1
                                break
                out[n] = near >= rules.min_neighbors
    return out


@njit
def _within_survey(held, reach):
    """Find the cells (h, w) that have held ones in all four quadrants, `reach` cells away at most
    along either axis."""
    h, w = held.shape
    out = np.ones((h, w), np.bool_)
    for up in range(2):
        for right in range(2):
            far = np.full((h + 2, w + 2), reach + 1)  # with a rim
            for jj in range(h):
                j = jj if up else h - 1 - jj
                for ii in range(w):
                    i = ii if right else w - 1 - ii
                    b, a = (j if up else j + 2), (i if right else i + 2)
                    near = min(far[b, i + 1], far[j + 1, a], far[b, a])
                    far[j + 1, i + 1] = 0 if held[j, i] else 1 + near
                    out[j, i] &= far[j + 1, i + 1] <= reach
    return out


@njit
def _walks(layers, solid, within, rules):
    """Walk from each layer in eight directions: how far it is to an edge and which (n, 8); and the
    layer's own edges (n, 8).

    Where an edge is farther than the widest deck, the distance is endless.
    """
    z, start, h, w = layers
    far, end = np.full((len(z), 8), _FAR, np.float32), np.full((len(z), 8), _WALL, np.int8)
    edge = np.full((len(z), 8), _GOES_ON, np.int8)
    for d in range(8):
        di, dj = _EAST[d], _NORTH[d]
        step = np.sqrt(float(di * di + dj * dj))
        for jj in range(h):
            j = h - 1 - jj if dj > 0 else jj
            for ii in range(w):
                i = w - 1 - ii if di > 0 else ii
                for n in range(start[j * w + i], start[j * w + i + 1]):
                    if not solid[n]:
                        continue
                    found = -1
                    for s in range(1, int(rules.max_gap / step + 0.5) + 1):
                        y, x = j + s * dj, i + s * di
                        if y < 0 or x < 0 or y >= h or x >= w:
                            break
                        nearest = _most(s * di, s * dj, rules)
                        for m in range(start[y * w + x], start[y * w + x + 1]):
                            if solid[m] and abs(z[m] - z[n]) <= nearest:
                                found, nearest = m, abs(z[m] - z[n])
                        if found >= 0:
                            if far[found, d] + s * step <= rules.max_width:
                                far[n, d] = far[found, d] + s * step
                                end[n, d] = end[found, d]
                            break
                    if found < 0:
                        edge[n, d] = _edge(layers, solid, within, j, i, di, dj, z[n], rules)
                        far[n, d], end[n, d] = 0.0, edge[n, d]
    return far, end, edge


@device
def _edge(layers, solid, within, j, i, di, dj, level, rules):
    """Tell what lies ahead of a layer where no walk goes on."""
    z, start, h, w = layers
    step = np.sqrt(float(di * di + dj * dj))
    ahead = int(rules.max_gap / step + 0.5)
    blocked = False
    for s in range(1, ahead + 1):
        for side in range(-1, 2):
            y, x = j + s * dj + side * di, i + s * di - side * dj
            if not (0 <= y < h and 0 <= x < w):
                continue
            for m in range(start[y * w + x], start[y * w + x + 1]):
                if side == 0 and z[m] < level - max(
                    rules.min_drop_m, rules.min_wall_slope * s * step
                ):
                    return _DROP
                near = level - rules.min_clearance_m < z[m] < level + rules.headroom_m
                blocked |= s > 1 and (solid[m] or near)
    if blocked:
        return _WALL
    y, x = j + ahead * dj, i + ahead * di
    if not (0 <= y < h and 0 <= x < w and within[y, x]):
        return _WALL
    reach = rules.sight
    for b in range(max(j - reach, 0) - j, min(j + reach + 1, h) - j):
        for a in range(max(i - reach, 0) - i, min(i + reach + 1, w) - i):
            along, squared = a * di + b * dj, a * a + b * b
            if along <= 0 or squared > reach * reach:
                continue
            if 2 * along * along < squared * (di * di + dj * dj):
                continue
            m = start[(j + b) * w + i + a]
            if m < start[(j + b) * w + i + a + 1] and z[m] < level - rules.min_clearance_m:
                return _DROP
    return _OPEN


@njit
def _steps(layers, solid, some, rules):
    """Pairs (k,), (k,) of some layers and of solid ones up to `link` cells away that one can step
    on to."""
    z, start, h, w = layers
    one, other, count = np.empty(1024, np.int64), np.empty(1024, np.int64), 0
    for j in range(h):
        for i in range(w):
            for n in range(start[j * w + i], start[j * w + i + 1]):
                if not some[n]:
                    continue
                for b in range(max(j - rules.link, 0), min(j + rules.link + 1, h)):
                    for a in range(max(i - rules.link, 0), min(i + rules.link + 1, w)):
                        for m in range(start[b * w + a], start[b * w + a + 1]):
                            step = abs(z[m] - z[n])
                            if m == n or not solid[m] or step > _most(a - i, b - j, rules):
                                continue
                            if count == len(one):
                                one = np.concatenate((one, one))
                                other = np.concatenate((other, other))
                            one[count], other[count] = n, m
                            count += 1
    return one[:count], other[:count]


@njit
def _points_of(z, column, row, layers, deck, solid, rules):
    """Find the points (n,) whose nearest solid layer, of those about as high, is a deck's."""
    heights, start, h, w = layers
    out = np.zeros(len(z), np.bool_)
    for p in range(len(z)):
        nearest = 2 * (rules.beside + 1) ** 2
        for b in range(max(row[p] - rules.beside, 0), min(row[p] + rules.beside + 1, h)):
            for a in range(max(column[p] - rules.beside, 0), min(column[p] + rules.beside + 1, w)):
                far = (a - column[p]) ** 2 + (b - row[p]) ** 2
                for m in range(start[b * w + a], start[b * w + a + 1]):
                    if not solid[m] or abs(heights[m] - z[p]) > rules.surface_m:
                        continue
                    if far < nearest or (far == nearest and deck[m]):
                        nearest, out[p] = far, deck[m]
    return out
