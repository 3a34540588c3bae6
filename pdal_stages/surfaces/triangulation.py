"""The Delaunay triangulation of ground points that is the same wherever a survey is cut.

Coordinates are whole numbers, so that which points lie in which circle is decided exactly
(startinpy, with robust predicates). Points on one circle have several Delaunay triangulations; here
the first of them is joined to all others.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from ..base.errors import optional_import
from ..base.grid import begins_run
from ..base.jit import njit

Integers = NDArray[np.int64]
#: West, south, east, north.
Box = tuple[float, float, float, float]
#: Relative error of a determinant in doubles, rounded up (Shewchuk 1997: about 1.1e-15).
_ROUNDING = 1e-14
#: Part of the reach within which points are read at once.
NEAR = 1 / 8
#: Beyond it they are read around open cells, in pieces that need no wider box, if that is at least
#: so many reaches wide.
SPLIT = 2.5
#: State of a triangle whose circle reaches beyond the known points.
UNKNOWN = 0
#: State of one that gives heights.
VALID = 1
#: State of one that is too wide, so there is no height.
TOO_WIDE = 2
#: A place lies outside a triangle.
OUTSIDE = 0
#: A place lies inside a triangle.
INSIDE = 1
#: A place lies on a side, which belongs to both of its triangles.
ON_SIDE = 2


def triangulate(xy: Integers) -> Integers:
    """Return the triangles (m, 3) of points, as ascending numbers of points.

    Parameters
    ----------
    xy : (n, 2) int64
        Different points, in an order that follows from coordinates alone; rows of points that lie
        side by side make it fast.
    """
    return np.sort(_fan_circles(xy, _any_triangles(xy)), axis=1)


def _any_triangles(xy: Integers) -> Integers:
    """Return triangles (m, 3) of an exact Delaunay triangulation of points (n, 2)."""
    startinpy = optional_import("startinpy", "raster", "a terrain model")
    network = startinpy.DT()
    network.snap_tolerance = 1e-6
    if len(xy) >= 3:
        heights = np.zeros(len(xy))
        network.insert(np.column_stack([xy - xy.min(axis=0), heights]).astype(np.float64))
    triangles = np.asarray(network.triangles, np.int64).reshape(-1, 3)
    return triangles - 1  # number 0 is the point at infinity


def _fan_circles(xy: Integers, triangles: Integers) -> Integers:
    """Replace triangles (m, 3) on one circle by a fan from the first of its points."""
    if not len(triangles):
        return triangles
    sides = np.concatenate([triangles[:, [1, 2]], triangles[:, [2, 0]], triangles[:, [0, 1]]])
    opposite, owner = triangles.T.reshape(-1), np.tile(np.arange(len(triangles)), 3)
    key = sides.min(axis=1) * len(xy) + sides.max(axis=1)
    order = np.argsort(key, kind="stable")
    shared = np.flatnonzero(~begins_run(key[order]))
    left, right = order[shared - 1], order[shared]
    on_circle = _on_one_circle(xy, triangles[owner[left]], opposite[right])
    left, right = left[on_circle], right[on_circle]
    count = len(triangles)
    pairs = coo_array((np.ones(len(left)), (owner[left], owner[right])), shape=(count, count))
    circle = connected_components(pairs, directed=False)[1]
    # Each circle's first point is joined to the sides of its polygon, which lie in no two of its
    # triangles.
    first = np.full(count, len(xy))
    np.minimum.at(first, circle, triangles.min(axis=1))
    several, outer = np.bincount(circle)[circle] > 1, np.ones(len(owner), bool)
    outer[left] = outer[right] = False
    apex = first[circle[owner]]
    fan = outer & several[owner] & (sides != apex[:, None]).all(axis=1)
    return np.concatenate([triangles[~several], np.column_stack([apex, sides])[fan]])


def _on_one_circle(xy: Integers, triangle: Integers, point: Integers) -> NDArray[np.bool_]:
    """Return which points (k,) lie exactly on the circles of triangles (k, 3)."""
    away = xy[triangle] - xy[point][:, None]
    value, size = _in_circle(away.astype(np.float64))
    zero = np.abs(value) <= _ROUNDING * size
    exact, _ = _in_circle(away[zero].astype(object))  # integers of any length
    zero[zero] = exact == 0
    return zero


def _in_circle(away: NDArray) -> tuple[NDArray, NDArray]:
    """Return the determinant (k,) that is 0 where three points (k, 3, 2) and 0 lie on a circle.

    The second value is the sum of its terms' sizes.
    """
    x, y = away[..., 0], away[..., 1]
    lift = x * x + y * y
    value, size = 0, 0
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        value = value + lift[:, i] * (x[:, j] * y[:, k] - x[:, k] * y[:, j])
        size = size + lift[:, i] * (abs(x[:, j] * y[:, k]) + abs(x[:, k] * y[:, j]))
    return value, size  # type: ignore[return-value]


def circles(xy: Integers, triangles: Integers) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return centers (m, 2) and radii (m,) of the circles of triangles (m, 3)."""
    a = xy[triangles[:, 0]]
    b, c = ((xy[triangles[:, k]] - a).astype(np.float64) for k in (1, 2))
    area = 2.0 * (b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0])
    bb, cc = (b**2).sum(axis=1), (c**2).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        x = (c[:, 1] * bb - b[:, 1] * cc) / area
        y = (b[:, 0] * cc - c[:, 0] * bb) / area
    return a + np.column_stack([x, y]), np.hypot(x, y)


def heights_at(
    centers: tuple[NDArray[np.float64], NDArray[np.float64]],
    reach: float,
    bounds: Box,
    points_in: Callable[[Box], Integers],
    near: float = 0.0,
    widest: float = 0.0,
) -> NDArray[np.float64]:
    """Return heights (rows, columns) of the triangulation at the centers of cells; NaN for none.

    Triangles count if the radius of their circle is at most half of `reach`: within that distance
    lie all points that decide a cell. Most are decided by points much nearer; others are read
    around the cells that are still open.

    Parameters
    ----------
    centers : pair of (columns,) and (rows,) float64
        Ascending x and y, evenly spaced.
    reach : float
    bounds : tuple of float
        West, south, east, north of all points there are.
    points_in : callable
        Returns the points (n, 3) in a box, different in x and y, in the order of
        :func:`triangulate`.
    near : float
        Distance around the centers within which points are read first, if not :data:`NEAR` of
        `reach`.
    widest : float
        Widest box from which points are read later; if 0, that from which they are read first. It
        holds if it is at least :data:`SPLIT` times `reach`.
    """
    x, y = centers
    west, south, east, north = bounds
    distance, out = near or NEAR * reach, np.full((len(y), len(x)), np.nan)
    box = _widened(centers, distance)
    points = points_in(box)
    triangles = triangulate(points[:, :2])
    middle, radius = circles(points[:, :2], triangles)
    # Where all points lie inside, a side of the box hides nothing.
    low = np.where(np.less_equal(box[:2], (west, south)), -math.inf, box[:2])
    high = np.where(np.greater_equal(box[2:], (east, north)), math.inf, box[2:])
    r = radius[:, None] * (1 + 1e-9) + 1.0
    known = (distance == reach) | ((middle - r >= low) & (middle + r <= high)).all(axis=1)
    kind = np.where(known, np.where(radius <= reach / 2, VALID, TOO_WIDE), UNKNOWN)
    is_open = _fill(points.astype(np.float64), triangles, kind, x, y, out)
    if distance < reach and np.isfinite([low, high]).any():
        step = x[1] - x[0] if len(x) > 1 else reach
        widest = widest or max(box[2] - box[0], box[3] - box[1])
        room = widest - 2 * reach if widest >= SPLIT * reach else math.inf
        split = partial(_groups, width=2 * int(distance / step) + 1, most=room / step)
        for rows, columns in split(is_open):
            part = x[columns], y[rows]
            is_open[rows, columns] &= _in_hull(part, points_in(_widened(part, reach)))
        for rows, columns in split(is_open):
            part, farther = (x[columns], y[rows]), min(3 * distance, reach)
            out[rows, columns] = heights_at(part, reach, bounds, points_in, farther, widest)
    return out


def _widened(centers: tuple[NDArray[np.float64], NDArray[np.float64]], distance: float) -> Box:
    """Return the box that reaches a distance beyond the centers of cells."""
    x, y = centers
    return x[0] - distance, y[0] - distance, x[-1] + distance, y[-1] + distance


def _groups(mask: NDArray[np.bool_], width: int, most: float) -> Iterator[tuple[slice, slice]]:
    """Yield boxes of cells of a mask, of at most so many a side.

    Those within a width of each other are in one, or in neighbors that were cut.
    """
    label = np.where(mask, ndimage.label(ndimage.maximum_filter(mask, width))[0], 0)
    each = max(1, int(min(most, max(mask.shape))))
    for box in ndimage.find_objects(label):
        for corner in product(*(range(side.start, side.stop, each) for side in box)):
            ends = (min(at + each, side.stop) for at, side in zip(corner, box, strict=True))
            rows, columns = map(slice, corner, ends)
            if mask[rows, columns].any():
                yield rows, columns


def _in_hull(
    centers: tuple[NDArray[np.float64], NDArray[np.float64]], points: Integers
) -> NDArray[np.bool_]:
    """Return which centers (rows, columns) may lie within the convex hull of points.

    No triangle of points holds another.
    """
    x, y = centers
    if len(points) < 3:
        return np.zeros((len(y), len(x)), bool)
    try:
        sides = ConvexHull((points[:, :2] - points[0, :2]).astype(np.float64)).equations
    except QhullError:  # all on a line
        return np.ones((len(y), len(x)), bool)
    away = np.full((len(y), len(x)), -math.inf)
    for east, north, offset in sides:
        away = np.maximum(
            away, east * (x - points[0, 0]) + (north * (y - points[0, 1]) + offset)[:, None]
        )
    return away <= 1.0


@njit
def _fill(points, triangles, kind, x, y, out):
    """Write the heights of triangles into `out`; return which cells no known one decides.

    On a common side or corner the height follows from its two or one points alone, so that it does
    not depend on the triangle.
    """
    height, width = out.shape
    decided = np.zeros((height, width), np.bool_)
    for t in range(len(triangles)):
        if kind[t] == UNKNOWN:
            continue
        a, b, c = triangles[t]
        low = min(points[a, 0], points[b, 0], points[c, 0])
        high = max(points[a, 0], points[b, 0], points[c, 0])
        first, last = np.searchsorted(x, low), np.searchsorted(x, high, "right")
        low = min(points[a, 1], points[b, 1], points[c, 1])
        high = max(points[a, 1], points[b, 1], points[c, 1])
        for j in range(np.searchsorted(y, low), np.searchsorted(y, high, "right")):
            for i in range(first, last):
                z, place = _height_in(points, a, b, c, x[i], y[j])
                if place != OUTSIDE and kind[t] == VALID:
                    out[j, i] = z
                if place == INSIDE or (place == ON_SIDE and kind[t] == VALID):
                    decided[j, i] = True
    return ~decided


@njit
def _height_in(points, a, b, c, x, y):
    """Return the height at a place in a triangle (a < b < c), and how it lies to the triangle."""
    # Twice the areas of the place with each side, from the lower number to the higher: the same for
    # both triangles of a side.
    ab = _area(points, a, b, x, y)
    bc = _area(points, b, c, x, y)
    ac = _area(points, a, c, x, y)
    if not ((ab >= 0 and bc >= 0 and ac <= 0) or (ab <= 0 and bc <= 0 and ac >= 0)):
        return 0.0, OUTSIDE
    for left, right, area in ((a, b, ab), (b, c, bc), (a, c, ac)):
        if area == 0:
            dx, dy = points[right, 0] - points[left, 0], points[right, 1] - points[left, 1]
            part = (x - points[left, 0]) / dx if abs(dx) >= abs(dy) else (y - points[left, 1]) / dy
            return points[left, 2] + part * (points[right, 2] - points[left, 2]), ON_SIDE
    whole = ab + bc - ac
    rise = -ac * (points[b, 2] - points[a, 2]) + ab * (points[c, 2] - points[a, 2])
    return points[a, 2] + rise / whole, INSIDE


@njit
def _area(points, left, right, x, y):
    """Return twice the signed area of two points and a place."""
    return (points[right, 0] - points[left, 0]) * (y - points[left, 1]) - (
        points[right, 1] - points[left, 1]
    ) * (x - points[left, 0])
