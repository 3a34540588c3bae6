"""Outlines of objects: along their cells, or straight along walls; in shapely's geometries (extra ``vector``).

Straight outlines follow the main direction of what stands wall to wall. All outlines of a group of buildings are simplified
together, so that neighbors share their wall. Then the corners are adjusted: walls that run nearly along or across the main
direction get the same coordinate at both ends, the median of what their cells show.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from ..base.vector import vector
from .results import Table

#: Holes smaller than this are closed, m2.
SMALLEST_HOLE = 4.0
#: How far a wall may lie from the cells' boundary, and walls that become one from each other, cells.
_TOLERANCE = 1.6
#: A wall whose ends are off the main direction by no more cells, or that is no longer, is turned into it.
_SLACK, _SHORT = 2.5, 6.0
#: Corners lie on a grid so fine that moving a shape changes no bit, cells.
_GRID = 1.0 / 1024.0
#: The least that straight outlines of a group, and each of it, have in common with the cells: intersection over union.
_LIKENESS, _LEAST = 0.75, 0.4


def raw_outlines(table: Table, size: float, *, hole: float = SMALLEST_HOLE) -> list[Any]:
    """The union of each object's cells, in numbers of cells; holes smaller than `hole` m2 closed."""
    shapely = vector("shapely")
    return [_of_cells(shapely, *table.cells_of(n)[:2], hole / size**2) for n in range(len(table))]


def _of_cells(shapely: Any, row: NDArray, column: NDArray, hole: float) -> Any:
    """The polygon of cells, which are given row by row."""
    begins = np.flatnonzero(np.r_[True, (np.diff(column) != 1) | (np.diff(row) != 0)])
    ends = np.r_[begins[1:], len(row)] - 1
    runs = shapely.box(column[begins], row[begins], column[ends] + 1, row[ends] + 1)
    parts = []
    for part in shapely.get_parts(shapely.simplify(shapely.union_all(runs), 0.0)):
        holes = [ring for ring in part.interiors if shapely.Polygon(ring).area >= hole]
        parts.append(shapely.Polygon(part.exterior, holes))
    return parts[0] if len(parts) == 1 else shapely.union_all(parts)


def straight_outlines(raw: list[Any], size: float) -> list[Any]:
    """Outlines along walls; all in numbers of cells.

    Parameters
    ----------
    raw : list of shapely Polygon
        By :func:`raw_outlines`.
    size : float
        Side of a cell, meters.

    Returns
    -------
    list of shapely Polygon or MultiPolygon
        Valid ones, in the same order; the simplified or raw one where no straight one is like it.
    """
    shapely = vector("shapely")
    out = np.array([*raw, None], object)[:-1]
    for group in _touching(shapely, raw):
        corner = np.floor(
            shapely.total_bounds(out[group])[:2]
        )  # near 0, so that places are exact numbers
        local = shapely.transform(out[group], lambda xy, by=corner: xy - by)
        made = _straight(shapely, local)
        if not _good(shapely, made, local):
            made = shapely.coverage_simplify(local, _TOLERANCE)
        if not _good(shapely, made, local):
            made = local
        out[group] = shapely.transform(made, lambda xy, by=corner: xy + by)
    return list(out)


def _touching(shapely: Any, shapes: list[Any]) -> list[NDArray[np.int64]]:
    """Groups of shapes with an edge in common, by their numbers."""
    if not shapes:
        return []
    a, b = shapely.STRtree(shapes).query(shapes, predicate="touches")
    all_shapes = np.array(shapes, object)
    shared = shapely.length(shapely.intersection(all_shapes[a], all_shapes[b])) > 0
    pairs = scipy.sparse.coo_matrix(
        (np.ones(shared.sum()), (a[shared], b[shared])), (len(shapes),) * 2
    )
    count, group = scipy.sparse.csgraph.connected_components(pairs, directed=False)
    order = np.argsort(group, kind="stable")
    return np.split(order, np.searchsorted(group[order], np.arange(1, count)))


def _good(shapely: Any, made: NDArray, shapes: NDArray) -> bool:
    """Whether all were made, are valid, and have enough in common with the shapes."""
    if shapely.is_missing(made).any() or not shapely.is_valid(made).all():
        return False
    shared = shapely.area(shapely.intersection(made, shapes))
    union = shapely.area(made) + shapely.area(shapes) - shared
    return bool((shared >= _LEAST * union).all() and shared.sum() >= _LIKENESS * union.sum())


def _straight(shapely: Any, shapes: NDArray) -> NDArray:
    """Straight outlines of shapes that stand wall to wall: corners that neighbors share move together; or None."""
    fine = shapely.segmentize(shapes, 1.0)  # so that neighbors have all corners in common
    edges = shapely.get_parts(shapely.line_merge(shapely.union_all(shapely.boundary(fine))))
    kept = shapely.get_coordinates(shapely.simplify(edges, _TOLERANCE, preserve_topology=False))
    rings, of_shape = shapely.get_rings(fine, return_index=True)
    xy, ring = shapely.get_coordinates(rings, return_index=True)
    stays = np.isin(xy @ [1, 1j], kept @ [1, 1j])
    if np.bincount(ring[stays], minlength=len(rings)).min() < 4 or len(np.unique(of_shape)) < len(
        shapes
    ):
        return np.full(len(shapes), None, object)
    rings = shapely.linearrings(xy[stays], indices=ring[stays])
    corners, number = np.unique(shapely.get_coordinates(rings), axis=0, return_inverse=True)
    number = number.ravel()
    walls = np.unique(np.sort(_steps(shapely, rings, number), axis=1), axis=0)
    steps = _steps(shapely, shapely.get_rings(fine), xy).mean(axis=1)
    nearest = shapely.STRtree(shapely.linestrings(corners[walls])).nearest(shapely.points(steps))
    angle = main_direction(np.diff(corners[walls], axis=1)[:, 0])
    order = np.argsort(nearest, kind="stable")
    of_wall = np.split(
        _turned(steps, angle)[order], np.searchsorted(nearest[order], np.arange(1, len(walls)))
    )
    moved = _turned(_adjusted(_turned(corners, angle), walls, of_wall), -angle)
    rings = shapely.set_coordinates(rings, np.round(moved[number] / _GRID) * _GRID)
    out = shapely.polygons(rings, indices=of_shape)
    return (
        shapely.coverage_simplify(out, 0.1) if shapely.is_valid(out).all() else out
    )  # no corners on walls


def _steps(shapely: Any, rings: NDArray, values: NDArray) -> NDArray:
    """Values (n, 2, ...) at both ends of all pieces of rings; `values` (m, ...) are of their coordinates."""
    ring = shapely.get_coordinates(rings, return_index=True)[1]
    return np.stack([values[:-1], values[1:]], axis=1)[ring[1:] == ring[:-1]]


def _adjusted(
    corners: NDArray, walls: NDArray[np.int64], of_wall: list[NDArray]
) -> NDArray[np.float64]:
    """Corners (n, 2), in the frame of the main direction, with those walls (n, 2: corners) along its axes that nearly are.

    Longest first; `of_wall`: places of the cells' boundary along each.
    """
    same = np.tile(
        np.arange(len(corners)), (2, 1)
    )  # by axis: corners that have a coordinate in common
    value, weight = corners.T.copy(), np.zeros((2, len(corners)))
    lengths = np.hypot(*(corners[walls[:, 1]] - corners[walls[:, 0]]).T)
    for n in np.argsort(-np.round(lengths, 6), kind="stable"):
        (a, b), places = walls[n], of_wall[n]
        off = np.abs(corners[b] - corners[a])
        across, short = int(off[0] >= off[1]), lengths[n] < _SHORT
        if (off[across] > _SLACK and not short) or not len(places):
            continue  # a wall on a slant
        for axis in (across, 1 - across) if short else (across,):
            one, other = same[axis, a], same[axis, b]
            heavy = weight[axis, one] > 0 and weight[axis, other] > 0
            if heavy and abs(value[axis, one] - value[axis, other]) > _TOLERANCE:
                continue  # it would move a longer wall
            parts = [(weight[axis, k], value[axis, k]) for k in {int(one), int(other)}]
            if axis == across:
                parts.append((lengths[n], float(np.median(places[:, axis]))))
            else:
                parts.append((1e-3, float(places[:, axis].mean())))
            total = sum(w for w, _ in parts)
            same[axis][same[axis] == other] = one
            value[axis, one], weight[axis, one] = sum(w * v for w, v in parts) / total, total
            break
    return np.column_stack([value[axis][same[axis]] for axis in (0, 1)])


def _turned(xy: NDArray, angle: float) -> NDArray[np.float64]:
    c, s = math.cos(angle), math.sin(angle)
    return np.column_stack([xy[:, 0] * c + xy[:, 1] * s, xy[:, 1] * c - xy[:, 0] * s])


def main_direction(walls: NDArray) -> float:
    """The angle, radians in [0, pi/2), along and across which walls (n, 2), as vectors, run.

    The one in which all walls together, long ones more, extend least along both axes.
    """
    x, y = (walls * np.hypot(*walls.T)[:, None]).T
    angles = np.radians(np.arange(0.0, 90.0, 0.2))[:, None]
    c, s = np.cos(angles), np.sin(angles)
    extents = (np.abs(c * x + s * y) + np.abs(c * y - s * x)).sum(axis=1)
    return float(angles[np.argmin(np.round(extents, 6)), 0])


def crown_outlines(raw: list[Any]) -> list[Any]:
    """Crowns with smoother edges, which neighbors share; in numbers of cells."""
    shapely = vector("shapely")
    if not raw:
        return []
    fine = [shapely.segmentize(shape, 1.0) for shape in raw]
    made = shapely.coverage_simplify(fine, 1.5)
    return [m if m.is_valid and not m.is_empty else r for m, r in zip(made, raw, strict=True)]
