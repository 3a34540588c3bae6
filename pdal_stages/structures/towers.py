"""Towers and poles: slender things that stand where wires hang.

Wires are what a classifier found; without any there is nothing to do. Points are counted in cubes
of the absolute grid, so that their order does not matter, and any tile that holds what lies within
:attr:`TowerRules.reach_m` has the same bits.

1. Cubes higher than a share of the lowest wire near are linked to *heads*. Trees below wires are
   cut off so, and what grows at a tower's feet.
2. A head is a tower's where it touches wires, is slender, begins near that height and reaches the
   highest wire near. Trees that grow into a line do not.
3. Of what is left, cubes higher than a share of the highest wire are linked and judged so, with
   one share after the other: towers that stand beside crowns and roofs come free of them higher up.
4. With a head goes what stands under its middle.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.grid import cell_keys, cell_numbers, compact_keys, places_among
from ..terrain.components import number_sets


@dataclass(frozen=True)
class TowerRules:
    """Thresholds of towers; lengths and heights above ground in meters.

    Chosen on the one labeled tower (AHN4) and its copies in other surveys (docs/trials.md).
    """

    cube_m: float = 1.0  #: side of the cubes; distances between cubes are those of their corners
    min_height_m: float = 3.0  #: what is lower stays what it is: shrubs, cars and fences
    near_m: float = 10.0  #: wires so far away, in plan, are near: half the widest tower
    #: share of the lowest wire's height above which a cube is part of a head, ...
    head_ratio: float = 0.4
    higher_ratios: tuple[float, ...] = (0.5, 0.7)  #: ... and then shares of the highest wire's
    touch_m: float = 2.5  #: from a wire to what it hangs at: insulators, gaps between echoes
    #: gaps that cubes are linked across, in distances between points as the density has them, ...
    link_spacings: float = 8.0
    min_link_m: float = 2.0  #: ... at least
    max_link_m: float = 6.0  #: ... and at most
    density_m: float = 8.0  #: side of the cells that points are counted in for the density
    max_width_m: float = 20.0  #: of a head: arms of high-voltage lines
    min_slenderness: float = 1.5  #: top of a head over its width: crowns are as wide as high
    min_points: int = 6  #: of a head
    #: top of a head over the highest wire near: 0.85 to 0.95 find the same; of the trees in AHN4's
    #: line, which its authors moved there, the highest has 0.8
    min_top_ratio: float = 0.9
    max_bottom_ratio: float = 0.25  #: how far above the cut a head may begin, over its top, ...
    max_bottom_m: float = 6.0  #: ... where that is higher than this: poles have few echoes
    core_ratio: float = 0.1  #: radius of what stands under a head, over its width, ...
    min_core_m: float = 1.5  #: ... and at least

    @property
    def reach_m(self) -> float:
        """Distance in meters up to which other points decide whether a point is of a tower."""
        core = max(self.min_core_m, self.core_ratio * self.max_width_m)
        told_by = max(self.near_m, self.touch_m, math.sqrt(2.0) * self.density_m)
        return core + self.max_width_m + self.max_link_m + told_by + 4.0 * self.cube_m


RULES = TowerRules()
#: Columns and rows along which the width of heads is measured, and the length of a step there.
_DIRECTIONS = (((1, 0), 1.0), ((0, 1), 1.0), ((1, 1), np.sqrt(2.0)), ((1, -1), np.sqrt(2.0)))


def find_towers(
    xyz: NDArray[np.float64],
    height: NDArray[np.float64],
    usable: NDArray[np.bool_],
    wire: NDArray[np.bool_],
    rules: TowerRules = RULES,
) -> NDArray[np.bool_]:
    """Return which points (n,) are of towers.

    Parameters
    ----------
    xyz : (n, 3) float64
        Coordinates in meters, finite.
    height : (n,) float64
        Height above ground in meters.
    usable : (n,) bool
        Points that are not ignored.
    wire : (n,) bool
        Points of wires.
    rules : TowerRules
    """
    is_tower = np.zeros(len(xyz), np.bool_)
    near = _rows_near(xyz, usable, wire & usable, rules)
    standing = near[~wire[near] & (height[near] > rules.min_height_m)]
    wires = near[wire[near]]
    if not len(standing):
        return is_tower
    places = _cubes(xyz[near], rules)
    keys = _Keys.enclosing(places, int(np.ceil(max(rules.near_m, rules.max_link_m)) + 1))
    cubes = _Cubes.group(keys, _cubes(xyz[standing], rules), height[standing])
    wire_places = _cubes(xyz[wires], rules)
    touching = np.zeros(len(cubes.key), np.bool_)
    wire_keys = np.unique(keys.pack(wire_places))
    for _, _, near_wire in _steps(keys, wire_keys, rules.touch_m, cubes.key, rules):
        touching[near_wire] = True
    lowest, highest = _wires_near(keys, cubes, wire_places, height[wires], rules)
    chosen = np.zeros(len(cubes.key), np.bool_)
    lowest_cut = np.maximum(rules.min_height_m, rules.head_ratio * lowest)
    higher = (np.maximum(lowest_cut, ratio * highest) for ratio in rules.higher_ratios)
    for cut in (lowest_cut, *higher):
        head = np.flatnonzero(~chosen & (cubes.top > cut))
        if not touching[head].any():
            continue
        link = _link_lengths(xyz[near, :2], cubes.place[head], rules)
        label = _link(keys, cubes.key[head], link, rules)
        chosen |= _judge(cubes, head, label, (cut[head], highest[head]), touching[head], rules)
    is_tower[standing] = chosen[cubes.of_point]
    return is_tower


@dataclass(frozen=True)
class _Keys:
    """One number for each cube of a box, and for steps between cubes."""

    first: NDArray[np.int64]  #: (3,) column, row and layer of the box's first cube
    lengths: NDArray[np.int64]  #: (3,) how many cubes it has along each axis

    @classmethod
    def enclosing(cls, places: NDArray[np.int64], margin: int) -> _Keys:
        """Return the keys of a box around cubes (n, 3), with a margin of more cubes."""
        first = places.min(axis=0) - margin
        return cls(first, places.max(axis=0) + margin + 1 - first)

    def pack(self, places: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the keys (n,) of cubes (n, 3)."""
        return self.steps(places - self.first)

    def steps(self, offsets: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return what leads from a key to that of the cube an offset (n, 3) away."""
        return (offsets[:, 0] * self.lengths[1] + offsets[:, 1]) * self.lengths[2] + offsets[:, 2]

    def columns(self, places: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the keys (n,) of the lowest cubes of the box in the columns of cubes (n, 3)."""
        return self.pack(np.column_stack([places[:, :2], np.full(len(places), self.first[2])]))


class _Cubes(NamedTuple):
    """Cubes with standing points, ascending by their keys."""

    key: NDArray[np.int64]  #: (k,)
    place: NDArray[np.int64]  #: (k, 3) column, row, layer
    top: NDArray[np.float64]  #: (k,) height above ground of the highest point
    bottom: NDArray[np.float64]  #: (k,) the same of the lowest
    points: NDArray[np.int64]  #: (k,) how many points they hold
    of_point: NDArray[np.int64]  #: (n,) the cube of each point

    @classmethod
    def group(cls, keys: _Keys, places: NDArray[np.int64], height: NDArray[np.float64]) -> _Cubes:
        """Return the cubes of points with these places (n, 3) and heights (n,)."""
        key, first, of_point, points = np.unique(
            keys.pack(places), return_index=True, return_inverse=True, return_counts=True
        )
        of_point = of_point.reshape(-1)
        top, bottom = np.full(len(key), -np.inf), np.full(len(key), np.inf)
        np.maximum.at(top, of_point, height)
        np.minimum.at(bottom, of_point, height)
        return cls(key, places[first], top, bottom, points, of_point)


def _cubes(xyz: NDArray[np.float64], rules: TowerRules) -> NDArray[np.int64]:
    """Return column, row and layer (n, 3) of the cubes of points (n, 3)."""
    return np.column_stack([cell_numbers(axis, rules.cube_m) for axis in xyz.T])


def _rows_near(
    xyz: NDArray[np.float64],
    usable: NDArray[np.bool_],
    wire: NDArray[np.bool_],
    rules: TowerRules,
) -> NDArray[np.int64]:
    """Return the rows, ascending, of usable points that may matter: all within `reach_m` of wires.

    `usable` and `wire` are masks (n,).
    """
    if not wire.any():
        return np.zeros(0, np.int64)
    keys, offsets = compact_keys(xyz[:, :2], rules.reach_m)
    near = np.unique(np.add.outer(np.add.outer(np.unique(keys[wire]), offsets), (-1, 0, 1)))
    return np.flatnonzero(places_among(near, keys)[1] & usable)


def _ball(radius: float, axes: int) -> NDArray[np.int64]:
    """Return the offsets (m, 3) up to a radius in cubes; along two axes those of a disk."""
    side = int(radius)
    span = np.arange(-side, side + 1)
    upward = span if axes == 3 else np.zeros(1, np.int64)
    grid = np.stack(np.meshgrid(span, span, upward, indexing="ij"), axis=-1).reshape(-1, 3)
    return grid[(grid**2).sum(axis=1) <= radius**2]


def _steps(
    keys: _Keys,
    start: NDArray[np.int64],
    radius_m: float,
    among: NDArray[np.int64],
    rules: TowerRules,
    axes: int = 3,
) -> Iterator[tuple[float, NDArray[np.int64], NDArray[np.int64]]]:
    """Yield pairs of cubes that lie within a radius of each other, offset by offset.

    Parameters
    ----------
    keys : _Keys
    start, among : (n,), (m,) int64
        Keys of cubes; `among` ascend.
    radius_m : float
    rules : TowerRules
    axes : int
        3, or 2 for distances in plan between columns.

    Yields
    ------
    distance : float
        In meters.
    from, to : (k,), (k,) int64
        Indices of cubes in `start` and in `among`.
    """
    offsets = _ball(radius_m / rules.cube_m, axes)
    distances = rules.cube_m * np.sqrt((offsets**2).sum(axis=1))
    for step, distance in zip(keys.steps(offsets), distances, strict=True):
        place, present = places_among(among, start + step)
        yield float(distance), np.flatnonzero(present), place[present]


def _wires_near(
    keys, cubes, wire_places, wire_height, rules
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the heights (k,) above ground of the lowest and the highest wire near each cube.

    They are infinite, and minus infinite, where no wire is. `wire_places` (w, 3) and `wire_height`
    (w,) are of the points of wires.
    """
    start, of_wire = np.unique(keys.columns(wire_places), return_inverse=True)
    among, of_cube = np.unique(keys.columns(cubes.place), return_inverse=True)
    pairs = list(_steps(keys, start, rules.near_m, among, rules, axes=2))
    out = []
    for sign in (1.0, -1.0):
        height = np.full(len(start), np.inf)
        np.minimum.at(height, of_wire.reshape(-1), sign * wire_height)
        least = np.full(len(among), np.inf)
        for _, wire, near in pairs:
            least[near] = np.minimum(least[near], height[wire])
        out.append(sign * least[of_cube.reshape(-1)])
    return out[0], out[1]


def _link_lengths(xy, place, rules) -> NDArray[np.float64]:
    """Return the gap (h,) that each cube is linked across, by the density of points (n, 2)."""

    def cells(axes):
        return cell_keys(*(cell_numbers(axis, rules.density_m) for axis in axes))

    cell, points = np.unique(cells(xy.T), return_counts=True)
    here = cells((place[:, axis] + 0.5) * rules.cube_m for axis in (0, 1))
    index, _ = places_among(cell, here)
    spacing = rules.density_m / np.sqrt(points[index])
    return np.clip(rules.link_spacings * spacing, rules.min_link_m, rules.max_link_m)


def _link(keys, key, link, rules) -> NDArray[np.int64]:
    """Return the number (h,) of the head that each cube is part of.

    `key` (h,) are those of the cubes, `link` (h,) the gaps that they are linked across.
    """
    first, second = [], []
    for distance, low, high in _steps(keys, key, float(link.max()), key, rules):
        linked = (low < high) & (distance <= np.maximum(link[low], link[high]))
        first.append(low[linked])
        second.append(high[linked])
    label = np.empty(len(key), np.int64)
    number_sets(np.concatenate(first), np.concatenate(second), label)
    return label


def _judge(cubes, head, label, limits, touching, rules) -> NDArray[np.bool_]:
    """Return which cubes (k,) are of towers: heads that are, and what stands under them.

    Of the cubes of heads (h,) `head` are their rows, `label` the heads that they are part of,
    `limits` the height above which they are and that of the highest wire near, `touching` which
    touch wires.
    """
    count = int(label.max()) + 1
    place, top = cubes.place[head], cubes.top[head]

    def lowest(values):
        out = np.full(count, np.inf)
        np.minimum.at(out, label, values)
        return out

    size, highest, bottom = np.bincount(label), -lowest(-top), lowest(cubes.bottom[head])
    cut, high_wire = lowest(limits[0]), -lowest(-limits[1])
    width = np.zeros(count)
    for (column, row), length in _DIRECTIONS:
        along = column * place[:, 0] + row * place[:, 1]
        width = np.maximum(width, (-lowest(-along) - lowest(along)) / length)
    width = (width + 1.0) * rules.cube_m
    begin = cut + rules.max_bottom_ratio * highest
    good = (
        (np.bincount(label, touching) > 0)
        & (np.bincount(label, cubes.points[head]) >= rules.min_points)
        & (width <= rules.max_width_m)
        & (highest >= rules.min_slenderness * width)
        & (highest >= rules.min_top_ratio * high_wire)
        & (bottom <= np.maximum(rules.max_bottom_m, begin))
    )
    chosen = np.zeros(len(cubes.key), np.bool_)
    chosen[head[good[label]]] = True
    middle = np.column_stack([np.bincount(label, place[:, axis]) / size for axis in (0, 1)])
    radius = np.maximum(rules.min_core_m, rules.core_ratio * width) / rules.cube_m
    for tower in np.flatnonzero(good):
        away = ((cubes.place[:, :2] - middle[tower]) ** 2).sum(axis=1)
        chosen |= (away <= radius[tower] ** 2) & (cubes.top <= bottom[tower] + rules.cube_m)
    return chosen
