"""Outlines of objects, along cells or straight, as shapely geometries (extra ``vector``).

Straight outlines are simplified ones whose corners are moved: walls that run nearly along or across
the main direction get the same coordinate at both ends, the median of what their cells show.
Outlines are in numbers of cells until they are written.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..base.vector import vector
from .results import ObjectTable

if TYPE_CHECKING:
    from shapely import MultiPolygon, Polygon

    Polygonal: TypeAlias = Polygon | MultiPolygon


@dataclass(frozen=True)
class OutlineRules:
    """Thresholds of outlines; lengths in cells, areas in m2.

    Values without a reason are not tuned.
    """

    min_hole: float = 4.0  #: smaller holes in buildings and decks are closed
    min_crown_hole: float = 1.0  #: smaller holes in crowns are closed
    #: Distance of a wall from its cells, and of walls that become one. Cells along a slanting wall
    #: form steps, which lie up to a cell's diagonal, 1.41, apart.
    tolerance: float = 1.6
    max_slant: float = 2.5  #: offset of a wall's ends that is turned into the main direction
    short_wall: float = 6.0  #: shorter walls are turned whatever their slant: corners cut by cells
    #: Weight, beside walls' lengths, of a short wall that is turned against its longer direction.
    fallback_weight: float = 1e-3
    corner_tolerance: float = 0.1  #: corners closer to the wall between their neighbors are removed
    crown_tolerance: float = 1.5  #: of a crown's outline; 3 made triangles of small crowns
    #: Of corners: a power of two, so that a shift of the area by whole cells changes no bit.
    precision: float = 1.0 / 1024.0
    min_iou: float = 0.75  #: of a straight outline with its cells
    angle_step: float = 0.2  #: between the main directions that are tried, degrees


RULES = OutlineRules()


def raw_outlines(
    table: ObjectTable, size: float, *, hole: float = RULES.min_hole
) -> list[Polygonal]:
    """Return the union of each object's cells; holes smaller than `hole` m2 are closed."""
    shapely = vector("shapely")
    return [_polygon(shapely, row, column, hole / size**2) for row, column, _ in table.cells]


def _polygon(shapely: ModuleType, row: NDArray, column: NDArray, hole: float) -> Polygonal:
    """Return the polygon of cells in ascending rows, without holes smaller than `hole` cells."""
    begins = np.flatnonzero(np.r_[True, (np.diff(column) != 1) | (np.diff(row) != 0)])
    ends = np.r_[begins[1:], len(row)] - 1
    runs = shapely.box(column[begins], row[begins], column[ends] + 1, row[ends] + 1)
    parts = []
    for part in shapely.get_parts(shapely.simplify(shapely.union_all(runs), 0.0)):
        holes = [ring for ring in part.interiors if shapely.Polygon(ring).area >= hole]
        parts.append(shapely.Polygon(part.exterior, holes))
    return parts[0] if len(parts) == 1 else shapely.union_all(parts)


def straight_outlines(raw: list[Polygonal]) -> list[Polygonal]:
    """Return outlines along walls.

    Parameters
    ----------
    raw : list of shapely Polygon or MultiPolygon
        By :func:`raw_outlines`.

    Returns
    -------
    list of shapely Polygon or MultiPolygon
        Valid ones, in the same order; the simplified or raw one where the straight one differs too
        much from the cells.
    """
    shapely, out = vector("shapely"), []
    for shape in raw:
        corner = np.floor(shapely.bounds(shape)[:2])  # near 0, coordinates are exact
        local = shapely.transform(shape, lambda xy, by=corner: xy - by)
        simple = shapely.simplify(local, RULES.tolerance)
        tried = (_straighten(shapely, simple, local), simple, local)
        outline = next(each for each in tried if _is_faithful(shapely, each, local))
        out.append(shapely.transform(outline, lambda xy, by=corner: xy + by))
    return out


def _is_faithful(shapely: ModuleType, outline: Polygonal, shape: Polygonal) -> bool:
    """Return whether an outline is valid and overlaps the shape enough."""
    if not outline.is_valid:
        return False
    shared = outline.intersection(shape).area
    return bool(shared >= RULES.min_iou * (outline.area + shape.area - shared))


def _straighten(shapely: ModuleType, simple: Polygonal, shape: Polygonal) -> Polygonal:
    """Return a simplified polygon with its corners moved so that walls are straight."""
    rings = shapely.get_rings(simple)
    corners, number = np.unique(shapely.get_coordinates(rings), axis=0, return_inverse=True)
    number = number.ravel()
    walls = _segments(shapely, rings, number)
    fine = shapely.get_rings(shapely.segmentize(shape, 1.0))
    middles = _segments(shapely, fine, shapely.get_coordinates(fine)).mean(axis=1)
    tree = shapely.STRtree(shapely.linestrings(corners[walls]))
    nearest = tree.nearest(shapely.points(middles))
    angle = main_direction(np.diff(corners[walls], axis=1)[:, 0])
    order = np.argsort(nearest, kind="stable")
    ends = np.searchsorted(nearest[order], np.arange(1, len(walls)))
    edge_of_wall = np.split(_rotate(middles, angle)[order], ends)
    moved = _rotate(_adjust(_rotate(corners, angle), walls, edge_of_wall), -angle)
    moved = np.round(moved[number] / RULES.precision) * RULES.precision
    out = shapely.polygons(*np.split(shapely.set_coordinates(rings, moved), [1]))
    # Remove corners that now lie on a wall.
    return shapely.simplify(out[0], RULES.corner_tolerance)


def _segments(shapely: ModuleType, rings: NDArray, values: NDArray) -> NDArray:
    """Return the values (n, 2, ...) at both ends of all segments of rings.

    `values` (m, ...) belong to the coordinates of the rings.
    """
    ring = shapely.get_coordinates(rings, return_index=True)[1]
    return np.stack([values[:-1], values[1:]], axis=1)[ring[1:] == ring[:-1]]


def _adjust(
    corners: NDArray, walls: NDArray[np.int64], edge_of_wall: list[NDArray]
) -> NDArray[np.float64]:
    """Turn walls that run nearly along an axis into it, the longest first.

    Parameters
    ----------
    corners : (n, 2) float64
        In the frame of the main direction.
    walls : (m, 2) int64
        Corners of each wall.
    edge_of_wall : list of (k, 2) arrays
        Places along the edge of the cells, by wall.

    Returns
    -------
    (n, 2) float64
    """
    # For each axis, the corner whose coordinate a corner shares.
    leader = np.tile(np.arange(len(corners)), (2, 1))
    value, weight = corners.T.copy(), np.zeros((2, len(corners)))
    lengths = np.hypot(*(corners[walls[:, 1]] - corners[walls[:, 0]]).T)
    for n in np.argsort(-np.round(lengths, 6), kind="stable"):
        (a, b), places = walls[n], edge_of_wall[n]
        offset = np.abs(corners[b] - corners[a])
        across, short = int(offset[0] >= offset[1]), lengths[n] < RULES.short_wall
        if (offset[across] > RULES.max_slant and not short) or not len(places):
            continue
        for axis in (across, 1 - across) if short else (across,):
            first, second = leader[axis, a], leader[axis, b]
            fixed = weight[axis, first] > 0 and weight[axis, second] > 0
            if fixed and abs(value[axis, first] - value[axis, second]) > RULES.tolerance:
                continue  # it would move a longer wall
            parts = [(weight[axis, k], value[axis, k]) for k in {int(first), int(second)}]
            if axis == across:
                parts.append((lengths[n], float(np.median(places[:, axis]))))
            else:
                parts.append((RULES.fallback_weight, float(places[:, axis].mean())))
            total = sum(w for w, _ in parts)
            leader[axis][leader[axis] == second] = first
            value[axis, first], weight[axis, first] = sum(w * v for w, v in parts) / total, total
            break
    return np.column_stack([value[axis][leader[axis]] for axis in (0, 1)])


def _rotate(xy: NDArray, angle: float) -> NDArray[np.float64]:
    """Return coordinates (n, 2) in axes turned by `angle`, radians."""
    c, s = math.cos(angle), math.sin(angle)
    return np.column_stack([xy[:, 0] * c + xy[:, 1] * s, xy[:, 1] * c - xy[:, 0] * s])


def main_direction(walls: NDArray) -> float:
    """Return the angle, radians in [0, pi/2), along and across which walls (n, 2), as vectors, run.

    It is the one in which all walls, weighted by length, extend least along both axes.
    """
    x, y = (walls * np.hypot(*walls.T)[:, None]).T
    angles = np.radians(np.arange(0.0, 90.0, RULES.angle_step))[:, None]
    c, s = np.cos(angles), np.sin(angles)
    extents = (np.abs(c * x + s * y) + np.abs(c * y - s * x)).sum(axis=1)
    return float(angles[np.argmin(np.round(extents, 6)), 0])


def crown_outlines(raw: list[Polygonal]) -> list[Polygonal]:
    """Return outlines of crowns with smoother edges, which neighbors share."""
    shapely = vector("shapely")
    if not raw:
        return []
    fine = [shapely.segmentize(shape, 1.0) for shape in raw]
    smooth = shapely.coverage_simplify(fine, RULES.crown_tolerance)
    return [s if s.is_valid and not s.is_empty else r for s, r in zip(smooth, raw, strict=True)]
