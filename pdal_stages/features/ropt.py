"""``ropt`` and ``copt``: radii chosen point by point [H17].

``ropt`` takes the radius with the lowest eigenentropy. ``copt`` first looks at the curvature (surface
variation) of the sphere of 1 m round the point: where it is at least c_t the point is *scattered* and takes
the best k of 10..50 within 3 m, otherwise it is *regular* and takes the best radius of 0.5..2 m. The
threshold c_t follows from the curvatures of the whole cloud.

A radius is a candidate where it holds at least ``neighborhoods.LEAST_MEMBERS`` points that do not all coincide;
where no radius does, the largest is taken. The curvature of a sphere with fewer is 1/3. Radii that hold the same
points are equal, and the smallest wins.

The tree must be built over a cloud in canonical order (``index.CellGrid``): sums run over the members in the
order of their shell, then of the cloud.
"""

from __future__ import annotations

import math

import numpy as np

from ..base.jit import device, njit
from .eigen import eigenvalues3
from .kdtree import bounding_box, gather
from .knn import make_groups, make_scratch
from .moments import COINCIDENT
from .optimal import (
    copy_column,
    kopt_into,
    lowest_entropy,
    make_members,
    make_sums,
    take_members,
    write_moments,
    write_nothing,
    write_shapes,
)

#: Radius of the sphere whose curvature is looked at, meters [H17].
CURVATURE_RADIUS = 1.0

#: Curvature where there are too few neighbors to tell [H17].
SCATTERED = 1.0 / 3.0

#: Regular points: first and last radius and step, meters [H17].
COPT_RADII = (0.5, 2.0, 0.05)

#: Scattered points: fewest and most neighbors, and how far they may be, meters [H17].
COPT_K = (10, 50)
COPT_CAP = 3.0

#: Candidates there is room for at first.
FIRST_ROOM = 4096


def radii_of(first: float, last: float, step: float) -> np.ndarray:
    """The radii first, first + step, ... up to `last`, rounded to nanometers.

    >>> radii_of(0.25, 0.4, 0.05).tolist()
    [0.25, 0.3, 0.35, 0.4]
    """
    count = math.floor((last - first) / step + 1e-9) + 1
    return np.round(first + step * np.arange(count), 9)


def curvature_threshold(curvatures: np.ndarray) -> float:
    """The curvature from which on a point is scattered [H17 eq. 1-3].

    Two means, started at the smallest and the largest value, give the centers cur1 and cur2 of two groups of
    n1 and n2 = n - n1 values; c_t = cur1 + (cur2 - cur1) n2 / n. Where all values are equal that is the
    value, and all points are scattered, which needs no radius to hold enough points.

    Parameters
    ----------
    curvatures : ndarray, shape (n,)
        See :func:`curvature_block`; NaN is refused.

    Raises
    ------
    ValueError
        Where there is no value, or one is not finite.
    """
    values = np.sort(np.asarray(curvatures, dtype=np.float64).ravel())
    n = len(values)
    if not n or not np.isfinite(values[-1]) or not np.isfinite(values[0]):
        raise ValueError("curvatures must be finite numbers, at least one")
    sums = np.concatenate(([0.0], np.cumsum(values)))
    low, high = values[0], values[-1]
    split = -1
    while low < high:
        before, split = split, int(np.searchsorted(values, 0.5 * (low + high), side="right"))
        split = min(max(split, 1), n - 1)
        if split == before:
            break
        low, high = sums[split] / split, (sums[n] - sums[split]) / (n - split)
    return float(low + (high - low) * (n - split) / n) if low < high else float(low)


@device
def _gather_sorted(tree, order, qx, qy, qz, lo, hi, reach2, scratch):
    """Points within reach of the queries order[lo:hi], ascending in the cloud; how many, and the scratch."""
    box = bounding_box(qx, qy, qz, order, lo, hi)
    n = len(tree.perm)
    while True:
        room, cx, cy, cz, ci = len(scratch.d), scratch.cx, scratch.cy, scratch.cz, scratch.ci
        count = gather(tree, box, reach2, n, room, scratch.stack, cx, cy, cz, ci)
        if count >= 0:
            break
        scratch = make_scratch(4 * len(scratch.d))
    scratch.ci[:count].sort()
    for i in range(count):
        p = scratch.ci[i]
        scratch.cx[i], scratch.cy[i], scratch.cz[i] = tree.x[p], tree.y[p], tree.z[p]
    return count, scratch


@device
def _shells(qx, qy, qz, radii, scratch, count, ends):
    """Sort the candidates of a query by shell, into scratch.pos; ends[s] is how many lie within radii[s]."""
    cx, cy, cz, pos = scratch.cx, scratch.cy, scratch.cz, scratch.pos
    d2, d, bins = scratch.d2, scratch.d, scratch.bins
    shells = len(radii)
    first = radii[0]
    inverse = (shells - 1) / (radii[shells - 1] - first) if shells > 1 else 0.0
    for i in range(count):
        dx, dy, dz = cx[i] - qx, cy[i] - qy, cz[i] - qz
        square = dx * dx + dy * dy + dz * dz
        d2[i] = square
        guess = (math.sqrt(square) - first) * inverse + 1.0
        guess = guess if guess > 0.0 else 0.0
        d[i] = guess if guess < shells else float(shells)
    ends[:] = 0
    for i in range(count):
        square = d2[i]
        s = int(d[i])
        # The guess is right but for rounding.
        while s > 0 and square <= radii[s - 1] * radii[s - 1]:
            s -= 1
        while s < shells and square > radii[s] * radii[s]:
            s += 1
        bins[i] = s
        ends[s] += 1
    start = 0
    for s in range(shells + 1):
        size = ends[s]
        ends[s] = start
        start += size
    for i in range(count):
        s = bins[i]
        pos[ends[s]] = i
        ends[s] += 1


@device
def _shell_sums(x, y, z, radii, ends, s):
    """Moments of the members within each radius."""
    sx = sy = sz = sxx = sxy = sxz = syy = syz = szz = 0.0
    i = 0
    for shell in range(len(radii)):
        for i in range(ends[shell - 1] if shell > 0 else 0, ends[shell]):
            a, b, c = x[i], y[i], z[i]
            sx += a
            sy += b
            sz += c
            sxx += a * a
            sxy += a * b
            sxz += a * c
            syy += b * b
            syz += b * c
            szz += c * c
        s.n[shell] = ends[shell]
        s.x[shell], s.y[shell], s.z[shell] = sx, sy, sz
        s.xx[shell], s.xy[shell], s.xz[shell] = sxx, sxy, sxz
        s.yy[shell], s.yz[shell], s.zz[shell] = syy, syz, szz


@device
def ropt_into(tree, qx, qy, qz, target, radii, least, table, radius, seeds, shapes):
    """:func:`ropt_block` for the queries `target` (ndarray of int64) only; the others are left alone."""
    tx, ty, tz = qx[target], qy[target], qz[target]
    order, starts = make_groups(tx, ty, tz)
    scratch = make_scratch(FIRST_ROOM)
    members = make_members(FIRST_ROOM)
    index = np.empty(FIRST_ROOM, np.uint32)
    s = make_sums(len(radii))
    ends = np.empty(len(radii) + 1, np.int64)
    reach = radii[len(radii) - 1]
    for group in range(len(starts) - 1):
        lo, end = starts[group], starts[group + 1]
        box = bounding_box(tx, ty, tz, order, lo, end)
        one = box[0] == box[3] and box[1] == box[4] and box[2] == box[5]
        apart = max(box[3] - box[0], box[4] - box[1], box[5] - box[2]) > reach
        while lo < end:
            hi = lo + 1 if apart else end
            count, scratch = _gather_sorted(tree, order, tx, ty, tz, lo, hi, reach * reach, scratch)
            if count > len(index):
                members = make_members(len(scratch.d))
                index = np.empty(len(scratch.d), np.uint32)
            for j in range(lo, lo + 1 if one else hi):
                q = target[order[j]]
                _shells(qx[q], qy[q], qz[q], radii, scratch, count, ends)
                inside = ends[len(radii) - 1]
                if inside == 0:
                    write_nothing(table, radius, shapes, q)
                    radius[q] = reach
                    continue
                for i in range(inside):
                    index[i] = scratch.ci[scratch.pos[i]]
                take_members(tree, index, inside, qx[q], qy[q], qz[q], members)
                _shell_sums(members.x, members.y, members.z, radii, ends, s)
                best = lowest_entropy(s, 0, len(radii), least)
                write_moments(s, best, members, ends[best], table, q)
                radius[q] = radii[best]
                if shapes.mode:
                    write_shapes(members, ends[best], s, best, seeds[q], shapes, q)
            if one:
                for j in range(lo + 1, hi):
                    copy_column(table, radius, shapes, target[order[lo]], target[order[j]])
            lo = hi


@njit
def ropt_block(tree, qx, qy, qz, radii, least, table, radius, seeds, shapes):
    """Moments, radius and shapes of the best of `radii` for a block of queries.

    Parameters
    ----------
    tree : KdTree
        Over a cloud in canonical order.
    qx, qy, qz : ndarray of float64, shape (m,)
    radii : ndarray of float64, shape (r,)
        Ascending and evenly spaced, meters; see :func:`radii_of`.
    least : int
        Members a radius must hold to be a candidate.
    table, radius, seeds, shapes
        As for :func:`optimal.kopt_block`; `radius` becomes the chosen one.
    """
    ropt_into(tree, qx, qy, qz, np.arange(len(qx)), radii, least, table, radius, seeds, shapes)


@device
def curvature_of(table, j, least):
    """Surface variation of column j of a moment table; 1/3 for fewer than `least` or coinciding points."""
    n = table[0, j]
    if n < least:
        return SCATTERED
    w = 1.0 / n
    x, y, z = table[1, j] * w, table[2, j] * w, table[3, j] * w
    xx, xy, xz = table[4, j] * w, table[5, j] * w, table[6, j] * w
    yy, yz, zz = table[7, j] * w, table[8, j] * w, table[9, j] * w
    l1, l2, l3 = eigenvalues3(xx - x * x, xy - x * y, xz - x * z, yy - y * y, yz - y * z, zz - z * z)
    total = l1 + l2 + l3
    return l3 / total if total > COINCIDENT * (xx + yy + zz) else SCATTERED


@njit
def curvature_block(tree, qx, qy, qz, least, shapes, out):
    """Curvature (surface variation of the sphere of 1 m) of a block of queries [H17].

    Parameters
    ----------
    tree, qx, qy, qz, least
        As for :func:`ropt_block`.
    shapes : Shapes
        :func:`shapes.no_shapes`.
    out : ndarray of float64, shape (m,)
        Out: 0 to 1/3; 1/3 where there are fewer than `least` points or all coincide.
    """
    table, radius = np.empty((12, len(qx))), np.empty(len(qx))
    radii = np.array([CURVATURE_RADIUS])
    none = np.empty(0, np.uint64)
    ropt_into(tree, qx, qy, qz, np.arange(len(qx)), radii, least, table, radius, none, shapes)
    for j in range(len(qx)):
        out[j] = curvature_of(table, j, least)


@njit
def copt_block(tree, qx, qy, qz, threshold, radii, least, table, radius, seeds, shapes, none):
    """Moments, radius and shapes of the curvature-adaptive neighborhoods of a block of queries [H17].

    Parameters
    ----------
    tree, qx, qy, qz, least, table, radius, seeds, shapes
        As for :func:`ropt_block`; scattered points get the distance to the farthest member as radius.
    threshold : float
        See :func:`curvature_threshold`.
    radii : ndarray of float64, shape (r,)
        ``radii_of(*COPT_RADII)``.
    none : Shapes
        :func:`shapes.no_shapes`.

    Returns
    -------
    ndarray of bool, shape (m,)
        Which queries are scattered.
    """
    curvature = np.empty(len(qx))
    curvature_block(tree, qx, qy, qz, least, none, curvature)
    scattered = curvature >= threshold
    few, many = COPT_K
    cap2, reach, which = COPT_CAP * COPT_CAP, np.empty(len(qx)), np.flatnonzero(scattered)
    kopt_into(tree, qx, qy, qz, which, few, many, cap2, table, radius, reach, seeds, shapes)
    ropt_into(tree, qx, qy, qz, np.flatnonzero(~scattered), radii, least, table, radius, seeds, shapes)
    return scattered
