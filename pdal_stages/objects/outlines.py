"""Outlines of objects: along their cells, or straight along walls; in shapely's geometries (extra ``vector``).

Straight outlines follow the main direction of what stands wall to wall. All boundaries of a group of buildings, of which
neighbors share one, are simplified (Douglas, Peucker 1973). Then the corners are adjusted: walls that run nearly along or
across the main direction get the same coordinate at both ends, the median of what their cells show.
"""

from __future__ import annotations

import ctypes
import importlib
import itertools
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from ..base.errors import DependencyError, StageError, how_to_add
from ..base.ownprocess import in_own_process
from .found import Table

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


def vector(name: str) -> Any:
    """shapely, pyogrio or pyproj; an error says how to get it."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise DependencyError(
            f"outlines need {name}",
            found=str(error),
            cure=f"Install the extra: {how_to_add('vector')}",
        ) from None


@contextmanager
def reading(path: str) -> Iterator[None]:
    """What GDAL, GEOS and PROJ raise over a file, as an error of ours."""
    try:
        yield
    except (StageError, MemoryError):
        raise
    except Exception as error:  # each package has its own
        raise StageError(
            "the vector file cannot be read",
            where=path,
            found=f"{type(error).__name__}: {error}",
            cure="See whether ogrinfo -al reads it; ogr2ogr -makevalid new.gpkg FILE often mends what can be mended",
        ) from error


def with_vector(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function that uses the extra ``vector``, in its own process inside a program that is linked to GEOS or GDAL.

    On Linux the libraries of the program itself come first for all that it loads. A Python package with a GEOS or GDAL of
    its own would mix both and crash. So it is in the program `pdal`; Python is linked to neither.
    """
    linked = sys.platform.startswith("linux") and any(
        hasattr(ctypes.CDLL(None), name) for name in ("GEOSversion", "GDALVersionInfo")
    )
    return in_own_process(function, *arguments) if linked else function(*arguments)


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
        corner = np.floor(shapely.total_bounds(out[group])[:2])  # near 0, so that places are exact numbers
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
    pairs = scipy.sparse.coo_matrix((np.ones(shared.sum()), (a[shared], b[shared])), (len(shapes),) * 2)
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
    """Straight outlines of shapes that stand wall to wall; None where nothing is left of one."""
    edges = shapely.line_merge(shapely.union_all(shapely.boundary(shapes)))
    numbers: dict[tuple[float, ...], int] = {}
    walls, lines = [], []
    for edge in shapely.get_parts(edges):
        xy = shapely.get_coordinates(edge)
        if (xy[0] == xy[-1]).all():  # a ring begins at the corner farthest from its middle
            far = int(np.argmax(np.round(np.hypot(*(xy[:-1] - xy[:-1].mean(axis=0)).T), 6)))
            xy = np.roll(xy[:-1], -far, axis=0)
            xy = np.vstack([xy, xy[:1]])
        kept = shapely.get_coordinates(
            shapely.simplify(shapely.LineString(xy), _TOLERANCE, preserve_topology=False)
        )
        at = 0
        ends: list[int] = []
        for place in kept:
            at += (
                int(np.flatnonzero((xy[at:] == place).all(axis=1))[0])
                if not ends
                else (1 + int(np.flatnonzero((xy[at + 1 :] == place).all(axis=1))[0]))
            )
            ends.append(at)
        line = [numbers.setdefault(tuple(place), len(numbers)) for place in kept.tolist()]
        lines.append(line)
        walls += [
            (a, b, _middles(xy[i : j + 1]))
            for (a, b), (i, j) in zip(itertools.pairwise(line), itertools.pairwise(ends), strict=True)
        ]
    angle = main_direction([places for *_, places in walls])
    corners = _adjusted(_turned(np.array(list(numbers)), angle), walls, angle)
    corners = _turned(corners, -angle)
    drawn = shapely.union_all([shapely.LineString(corners[line]) for line in lines], grid_size=_GRID)
    faces = shapely.get_parts(shapely.polygonize(shapely.get_parts(drawn)))
    out = np.full(len(shapes), None, object)
    if not len(faces):
        return out
    shared = shapely.area(shapely.intersection(faces[:, None], shapes[None]))
    owner = np.where(2 * shared.sum(axis=1) >= shapely.area(faces), shared.argmax(axis=1), -1)
    for n in np.unique(owner[owner >= 0]):
        out[n] = shapely.union_all(faces[owner == n])
    if shapely.is_missing(out).any():
        return out
    return shapely.coverage_simplify(out, 0.1)  # no corners on straight walls


def _adjusted(corners: NDArray, walls: list[tuple[int, int, NDArray]], angle: float) -> NDArray[np.float64]:
    """Corners (n, 2), in the frame of the main direction, with those walls along its axes that nearly are; longest first."""
    same = np.tile(np.arange(len(corners)), (2, 1))  # by axis: corners that have a coordinate in common
    value, weight = corners.T.copy(), np.zeros((2, len(corners)))
    lengths = np.array([np.hypot(*(corners[b] - corners[a])) for a, b, _ in walls])
    for n in np.argsort(-np.round(lengths, 6), kind="stable"):
        a, b, places = walls[n]
        off = np.abs(corners[b] - corners[a])
        across = int(off[0] >= off[1])
        short = lengths[n] < _SHORT
        if off[across] > _SLACK and not short:
            continue  # a wall on a slant
        inner = _turned(places[1:-1] if len(places) > 4 else places, angle)
        for axis in (across, 1 - across) if short else (across,):
            one, other = same[axis, a], same[axis, b]
            heavy = weight[axis, one] > 0 and weight[axis, other] > 0
            if heavy and abs(value[axis, one] - value[axis, other]) > _TOLERANCE:
                continue  # it would move a longer wall
            both = {int(one), int(other)}
            parts = [(weight[axis, k], value[axis, k]) for k in both] + [
                (lengths[n], float(np.median(inner[:, axis])))
            ]
            if axis != across:
                parts[-1] = 1e-3, float(inner[:, axis].mean())
            total = sum(w for w, _ in parts)
            same[axis][same[axis] == other] = one
            value[axis, one] = sum(w * v for w, v in parts) / total
            weight[axis, one] = total
            break
    return np.column_stack([value[axis][same[axis]] for axis in (0, 1)])


def _middles(corners: NDArray) -> NDArray[np.float64]:
    """Middles (m, 2) of the unit steps of a boundary along cells, of which corners (n, 2) are given."""
    away = np.diff(corners, axis=0)
    many = np.maximum(np.rint(np.abs(away).max(axis=1)).astype(np.int64), 1)
    step = np.arange(many.sum()) - np.repeat(np.cumsum(many) - many, many)
    share = (step + 0.5) / np.repeat(many, many)
    return np.repeat(corners[:-1], many, axis=0) + share[:, None] * np.repeat(away, many, axis=0)


def _turned(xy: NDArray, angle: float) -> NDArray[np.float64]:
    c, s = math.cos(angle), math.sin(angle)
    return np.column_stack([xy[:, 0] * c + xy[:, 1] * s, xy[:, 1] * c - xy[:, 0] * s])


def main_direction(walls: list[NDArray]) -> float:
    """The angle, radians in [0, pi/2), along and across which walls run; each is given by places (n, 2) along it.

    The one in which all walls together, long ones more, extend least along both axes.
    """
    ways = np.array([_way(places) for places in walls if len(places) > 2] or np.zeros((1, 2)))
    angles = np.radians(np.arange(0.0, 90.0, 0.2))[:, None]
    c, s = np.cos(angles), np.sin(angles)
    extents = (np.abs(c * ways[:, 0] + s * ways[:, 1]) + np.abs(c * ways[:, 1] - s * ways[:, 0])).sum(axis=1)
    return float(angles[np.argmin(np.round(extents, 6)), 0])


def _way(places: NDArray) -> tuple[float, float]:
    """The main axis of places, as long as the square of how many they are."""
    x, y = (places - places.mean(axis=0)).T
    angle = 0.5 * math.atan2(2.0 * float(x @ y), float(x @ x - y @ y))
    return len(places) ** 2 * math.cos(angle), len(places) ** 2 * math.sin(angle)


def crown_outlines(raw: list[Any]) -> list[Any]:
    """Crowns with smoother edges, which neighbors share; in numbers of cells."""
    shapely = vector("shapely")
    if not raw:
        return []
    fine = [shapely.segmentize(shape, 1.0) for shape in raw]
    made = shapely.coverage_simplify(fine, 1.2)
    return [m if m.is_valid and not m.is_empty else r for m, r in zip(made, raw, strict=True)]
