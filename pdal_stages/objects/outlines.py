"""Outlines of objects: along their cells, or straight along walls; in shapely's geometries (extra ``vector``).

Straight outlines follow the main direction of what stands wall to wall. The boundary of all its cells together is cut into
edges (Douglas, Peucker), each is turned along or across the main direction where its ends are little off it, and put where
the middle of its cells' steps lies. Walls between buildings are drawn once, so neighbors share them.
"""

from __future__ import annotations

import ctypes
import importlib.util
import itertools
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.apart import apart
from ..base.errors import DependencyError, StageError, how_to_add
from ..base.lean import imported
from .boundaries import polygon
from .found import Table
from .measure import median
from .walls import blunted, main_direction, middles, peucker

#: Holes smaller than this are closed, m2.
SMALLEST_HOLE = 4.0
#: How far an edge may lie from the cells' boundary, cells.
_TOLERANCE = 1.6
#: The least that a straight outline has in common with the cells: intersection over union.
_LIKENESS = 0.85
#: The same of a rectangle, which is then taken.
_BOXLIKE = 0.82
_GRID = 1.0 / 1024.0
#: A wall whose ends are off the main direction by no more cells is turned into it.
_SLACK = 2.5


def vector(name: str) -> Any:
    """shapely, pyogrio or pyproj; an error says how to get it."""
    try:
        return imported(name)
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


#: A function of the C library that each of these packages brings.
_SYMBOLS = {"shapely": ("GEOS", "GEOSversion"), "pyogrio": ("GDAL", "GDALVersionInfo")}


def with_vector(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function that uses the extra ``vector``, in a process apart where its libraries clash with the program's.

    On Linux, what the program itself is linked to comes first for all that it loads: a package with a GEOS or GDAL of its
    own would call functions of the program's library beside those of its own, and crash. So it is in the program `pdal`;
    Python is linked to neither, and what it loads sees its own.
    """
    return apart(function, *arguments) if any(map(_clashes, _SYMBOLS)) else function(*arguments)


def _clashes(name: str) -> bool:
    """Whether a package brings a library which the program is linked to as well."""
    library, symbol = _SYMBOLS[name]
    if not sys.platform.startswith("linux") or not hasattr(ctypes.CDLL(None), symbol):
        return False
    found = importlib.util.find_spec(name)
    places = found.submodule_search_locations if found is not None else None
    return any(any(Path(place + ".libs").glob(f"lib{library.lower()}*")) for place in places or ())


def raw_outlines(table: Table, size: float, *, hole: float = SMALLEST_HOLE) -> list[Any]:
    """The union of each object's cells, in numbers of cells; holes smaller than `hole` m2 closed."""
    shapely = vector("shapely")
    return [polygon(shapely, *table.cells_of(number)[:2], hole / size**2) for number in range(len(table))]


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
        Valid ones, in the same order; the raw one where no straight one is like it.
    """
    shapely = vector("shapely")
    groups = _touching(shapely, raw)
    if not groups:
        return []
    # Every group in a frame of its own, so that places are exact numbers.
    corner = np.empty((len(raw), 2))
    lows = shapely.bounds(raw)[:, :2]
    for group in groups:
        corner[group] = np.floor(lows[group].min(axis=0))
    local = _moved(shapely, np.array(raw, object), -corner)
    wholes = [shapely.union_all(local[group]) if len(group) > 1 else local[group[0]] for group in groups]
    angles = [main_direction(np.concatenate([_middles(r) for r in _rings(shapely, w)])) for w in wholes]
    outers = _outers(shapely, wholes, angles, size)
    out = np.empty(len(raw), object)
    for group, outer, angle in zip(groups, outers, angles, strict=True):
        out[group] = _straight(shapely, list(local[group]), outer, angle) if len(group) > 1 else outer
    return list(_moved(shapely, out, corner))


def _moved(shapely: Any, shapes: NDArray, by: NDArray) -> NDArray:
    """Shapes (n,), each moved by (n, 2)."""
    away = np.repeat(by, shapely.get_num_coordinates(shapes), axis=0)
    return shapely.transform(shapes, lambda xy: xy + away)


def _touching(shapely: Any, shapes: list[Any]) -> list[list[int]]:
    """Groups of shapes with an edge in common, by their numbers."""
    parent = list(range(len(shapes)))

    def root(n: int) -> int:
        while parent[n] != n:
            n = parent[n]
        return n

    if shapes:
        tree = shapely.STRtree(shapes)
        for a, b in zip(*tree.query(shapes, predicate="touches").tolist(), strict=True):
            if a < b and shapes[a].intersection(shapes[b]).length > 0:
                low, high = sorted((root(a), root(b)))
                parent[high] = low
    groups: dict[int, list[int]] = {}
    for n in range(len(shapes)):
        groups.setdefault(root(n), []).append(n)
    return list(groups.values())


def _outers(shapely: Any, wholes: list[Any], angles: list[float], size: float) -> list[Any]:
    """Straight outlines of all that stands wall to wall, of which main directions are given."""
    parts, which = shapely.get_parts(wholes, return_index=True)
    made = np.full(len(parts), None, object)
    for n, part in enumerate(parts):
        angle = angles[which[n]]
        holes = [straight_ring(_middles(r), angle) for r in part.interiors]
        made[n] = _polygon(shapely, straight_ring(_middles(part.exterior), angle), holes)
    boxes = shapely.oriented_envelope(parts)  # which the cells' corners make too large
    area, length = shapely.area(boxes), shapely.length(boxes)
    boxes = shapely.buffer(
        boxes, -np.maximum(0.0, area - shapely.area(parts)) / length, quad_segs=16, join_style="mitre"
    )
    there = ~shapely.is_missing(made)
    alike = np.where(there, _likeness(shapely, np.where(there, made, parts), parts), -1.0)
    boxlike = np.where(shapely.get_num_interior_rings(parts) == 0, _likeness(shapely, boxes, parts), -1.0)
    box = boxlike >= np.maximum(_BOXLIKE, alike - 0.03)
    made, alike = np.where(box, boxes, made), np.where(box, boxlike, alike)
    made = np.where(alike < _LIKENESS, shapely.simplify(parts, _TOLERANCE), made)
    polygons = shapely.get_type_id(made) == shapely.GeometryType.POLYGON
    made = np.where(polygons & shapely.is_valid(made) & (shapely.area(made) > 0), made, parts)
    alone = np.bincount(which) == 1
    out = np.empty(len(wholes), object)
    out[alone] = shapely.union_all(made[alone[which], None], axis=1)
    for n in np.flatnonzero(~alone).tolist():
        out[n] = shapely.union_all(made[which == n])
    return list(out)


def _straight(shapely: Any, shapes: list[Any], outer: Any, angle: float) -> list[Any]:
    """Straight outlines of shapes that stand wall to wall, of which the one around all is given."""
    walls = []
    for a, one in enumerate(shapes):
        for other in shapes[a + 1 :]:
            between = one.boundary.intersection(other.boundary)
            if between.length > 0:
                walls += [w for w in shapely.get_parts(shapely.line_merge(between)) if w.length > 0]
    corners = np.concatenate([np.array(ring.coords)[:-1] for ring in _rings(shapely, outer)])
    lines = [_attached(_straight_wall(np.array(w.coords), angle), corners) for w in walls]
    parts = _divided(shapely, outer, lines, shapes)
    if not _good(shapely, parts, shapes):
        parts = _shared_out(shapely, outer, shapes)
    return parts if _good(shapely, parts, shapes) else shapes


def _good(shapely: Any, parts: list[Any], shapes: list[Any]) -> bool:
    there = not shapely.is_missing(parts).any() and shapely.is_valid(parts).all()
    return bool(there and (_likeness(shapely, parts, shapes) >= 0.5).all())


def _shared_out(shapely: Any, outer: Any, shapes: list[Any]) -> list[Any]:
    """An outline shared out among the shapes in it: each what it covers, and what is left beside it."""
    parts = [_polygons(shapely, shapely.intersection(outer, shape, grid_size=_GRID)) for shape in shapes]
    left = shapely.difference(outer, shapely.union_all(parts, grid_size=_GRID), grid_size=_GRID)
    more: list[list[Any]] = [[part] for part in parts]
    # However small: between a wall and the steps of the cells there is one at each step.
    pieces = [piece for piece in shapely.get_parts(left) if piece.geom_type == "Polygon"]
    shared = np.zeros((len(pieces), len(parts)))
    near = shapely.STRtree(pieces)
    for n, part in enumerate(parts):
        beside = near.query(part)
        shared[beside, n] = shapely.length(
            shapely.intersection(shapely.boundary(near.geometries[beside]), part.boundary)
        )
    for piece, most, most_shared in zip(pieces, shared.argmax(axis=1), shared.max(axis=1), strict=True):
        if most_shared > 0:
            more[most].append(piece)
    whole = [_polygons(shapely, shapely.union_all(one, grid_size=_GRID)) for one in more]
    inner = shapely.coverage_simplify(whole, _TOLERANCE, simplify_boundary=False)
    return list(shapely.coverage_simplify(inner, 0.1))  # corners on straight walls, where cells crossed them


def _polygons(shapely: Any, shape: Any) -> Any:
    """A shape without lines and points."""
    kept = [part for part in shapely.get_parts(shape) if part.geom_type == "Polygon" and part.area > 0.5]
    return kept[0] if len(kept) == 1 else shapely.MultiPolygon(kept)


def _divided(shapely: Any, outer: Any, lines: list[NDArray], shapes: list[Any]) -> list[Any]:
    """An outline divided by lines, for each shape what is nearest to it; None where nothing is."""
    edges = [outer.boundary, *(shapely.LineString(line) for line in lines)]
    owned: list[list[Any]] = [[] for _ in shapes]
    for face in shapely.get_parts(shapely.polygonize(shapely.get_parts(shapely.union_all(edges)))):
        inside = face.representative_point()
        if not outer.contains(inside):
            continue
        shared = [face.intersection(shape).area for shape in shapes]
        nearest = [shape.distance(inside) for shape in shapes] if not any(shared) else []
        owned[int(np.argmin(nearest) if nearest else np.argmax(shared))].append(face)
    return [shapely.union_all(one) if one else None for one in owned]


def _rings(shapely: Any, shape: Any) -> list[Any]:
    return [ring for part in shapely.get_parts(shape) for ring in (part.exterior, *part.interiors)]


def _likeness(shapely: Any, a: Any, b: Any) -> NDArray[np.float64]:
    """Intersection over union of each of shapes (n,) with its fellow."""
    shared = shapely.area(shapely.intersection(a, b))
    return shared / np.maximum(shapely.area(a) + shapely.area(b) - shared, 1e-9)


def _polygon(shapely: Any, shell: NDArray | None, holes: list[NDArray | None]) -> Any:
    if shell is None:
        return None
    shape = shapely.Polygon(shell, [hole for hole in holes if hole is not None])
    return shape if shape.is_valid else None


def _middles(ring: Any) -> NDArray[np.float64]:
    """Middles of the unit steps of a boundary along cells (n, 2)."""
    return middles(np.rint(vector("shapely").get_coordinates(ring)))


def _turned(xy: NDArray, angle: float) -> NDArray[np.float64]:
    c, s = math.cos(angle), math.sin(angle)
    return np.column_stack([xy[:, 0] * c + xy[:, 1] * s, xy[:, 1] * c - xy[:, 0] * s])


def straight_ring(places: NDArray, angle: float) -> NDArray[np.float64] | None:
    """Corners (k, 2) of a ring of walls along or across a direction, or on a slant; None where fewer than three remain.

    Parameters
    ----------
    places : (n, 2) float64
        Along the boundary, in order, in numbers of cells.
    angle : float
        Of the main direction, radians.
    """
    if len(places) < 8:
        return None
    xy = _turned(places, angle)
    # Begun at a corner: the place farthest from the middle.
    xy = np.roll(xy, -int(np.argmax(np.round(np.hypot(*(xy - xy.mean(axis=0)).T), 6))), axis=0)
    closed = np.vstack([xy, xy[:1]])
    at = peucker(closed, _TOLERANCE)
    lines = [_line(closed[a : b + 1]) for a, b in itertools.pairwise(at)]
    lines = _one_after_the_other(lines)
    if len(lines) < 3:
        return None
    corners: list[NDArray] = []
    for n, line in enumerate(lines):
        corners += _meeting(lines[n - 1], line)
    return _turned(blunted(np.array(corners)), -angle)


class _Wall(NamedTuple):
    """An edge of an outline: a line, and where on the boundary it ends (None where it was put in between)."""

    place: NDArray
    way: NDArray  # unit vector
    length: float
    end: NDArray | None


def _line(xy: NDArray) -> _Wall:
    """The wall that places lie along."""
    away, end = xy[-1] - xy[0], xy[-1]
    length = float(math.hypot(*away))
    inner = xy[1:-1] if len(xy) > 4 else xy
    along, across = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    east, north = abs(away[0]), abs(away[1])
    if north < east and north <= _SLACK:
        return _Wall(np.array([xy[:, 0].mean(), median(inner[:, 1])]), along, length, end)
    if east <= north and east <= _SLACK:
        return _Wall(np.array([median(inner[:, 0]), xy[:, 1].mean()]), across, length, end)
    if length < 6.0:  # a short slant is a corner cut by the grid
        return _Wall(xy.mean(axis=0), along if east >= north else across, length, end)
    middle = inner.mean(axis=0)
    u, v = (inner - middle).T
    slant = 0.5 * math.atan2(2.0 * float(u @ v), float(u @ u - v @ v))  # of the places' main axis
    return _Wall(middle, np.array([math.cos(slant), math.sin(slant)]), length, end)


def _one_after_the_other(lines: list[_Wall]) -> list[_Wall]:
    """Walls round a ring, of which none goes on in the direction of the one before: joined, or with a short wall between."""
    walls = list(lines)
    n = 0
    while len(walls) > 3 and n < len(walls):
        before, line = walls[n - 1], walls[n]
        if not _parallel(before, line) or _apart(before, line) > _TOLERANCE:
            n += 1
            continue
        share = line.length / max(line.length + before.length, 1e-9)
        way = line.way if share >= 0.5 else before.way
        middle = before.place + share * (line.place - before.place)
        walls[n] = _Wall(middle, way, before.length + line.length, line.end)
        del walls[n - 1]  # the last one where n is 0
        n = max(n - 1, 0)
    out: list[_Wall] = []
    for n, line in enumerate(walls):
        before = walls[n - 1]
        if _parallel(before, line):
            across = np.array([-line.way[1], line.way[0]])
            middle = before.end if before.end is not None else 0.5 * (before.place + line.place)
            out.append(_Wall(middle, across, _apart(before, line), None))
        out.append(line)
    return out


def _apart(a: _Wall, b: _Wall) -> float:
    """How far parallel walls lie from each other."""
    return abs(float((b.place - a.place) @ np.array([-a.way[1], a.way[0]])))


def _parallel(a: _Wall, b: _Wall) -> bool:
    return abs(float(a.way @ b.way)) > 0.995


def _meeting(a: _Wall, b: _Wall) -> list[NDArray]:
    """Where two walls meet; where that is far from where the first ends on the boundary, the places on both beside it."""
    cross = float(a.way[0] * b.way[1] - a.way[1] * b.way[0])
    away = b.place - a.place
    if abs(cross) > 0.05:
        corner = a.place + a.way * float((away[0] * b.way[1] - away[1] * b.way[0]) / cross)
        if a.end is None or b.end is None or math.hypot(*(corner - a.end)) <= 4.0:
            return [corner]
    end = a.end if a.end is not None else 0.5 * (a.place + b.place)
    return [wall.place + wall.way * float((end - wall.place) @ wall.way) for wall in (a, b)]


def _straight_wall(corners: NDArray, angle: float) -> NDArray[np.float64]:
    """A wall between two buildings: few corners, its edges along or across the direction where they nearly are."""
    steps = []
    for (x0, y0), (x1, y1) in itertools.pairwise(corners):
        n = max(1, round(max(abs(x1 - x0), abs(y1 - y0))))
        t = (np.arange(n) + 0.5)[:, None] / n
        steps.append(np.array([x0, y0]) + t * np.array([x1 - x0, y1 - y0]))
    xy = _turned(np.concatenate([corners[:1], *steps, corners[-1:]]), angle)
    at = peucker(xy, _TOLERANCE)
    lines = [_line(xy[a : b + 1]) for a, b in itertools.pairwise(at)]
    if len(lines) == 1:
        place, way, length, _ = lines[0]
        sign = 1.0 if float(way @ (xy[-1] - xy[0])) >= 0 else -1.0
        half = 0.5 * sign * length * way
        return _turned(np.array([place - half, place + half]), -angle)
    return _turned(xy[at], -angle)


def _attached(xy: NDArray, corners: NDArray) -> NDArray[np.float64]:
    """A line whose ends lie at corners near them, or else go on."""
    out = np.array(xy, np.float64)
    for end, before in ((0, 1), (-1, -2)):
        away = np.hypot(*(corners - out[end]).T)
        if away.min() <= 2.5:
            out[end] = corners[int(np.argmin(away))]
            continue
        way = out[end] - out[before]
        length = math.hypot(*way)
        if length > 0:
            out[end] = out[end] + way * (4.0 / length)
    return out


def crown_outlines(raw: list[Any]) -> list[Any]:
    """Crowns with smoother edges, which neighbors share; in numbers of cells."""
    shapely = vector("shapely")
    if not raw:
        return []
    fine = [shapely.segmentize(shape, 1.0) for shape in raw]
    made = shapely.coverage_simplify(fine, 1.2)
    return [m if m.is_valid and not m.is_empty else r for m, r in zip(made, raw, strict=True)]
