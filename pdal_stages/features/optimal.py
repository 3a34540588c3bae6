"""The k nearest neighbors and ``kopt``: the k with the lowest eigenentropy [B16 eq. 1-2].

The neighborhood of k nearest neighbors is the point and its k nearest: n = k + 1 members, as in
Weinmann et al. 2015, whose structure tensor sums from 0 to k. Members are added in the order of distance
and the moments kept after each, so all k of a range cost one pass.

Which candidate wins is decided in two steps. A vectorized closed form estimates all entropies to 1e-7; those
within ``MARGIN`` of the lowest are computed again by the exact method of the features. Entropies that then
lie within ``TIE`` of each other count as equal, and the smallest neighborhood wins: in a perfect plane or
line rounding noise would decide otherwise.

A candidate needs ``LEAST`` members that do not all coincide. Where no candidate qualifies (a lone point,
copies of one point, a cloud of two points), the largest neighborhood is taken; its eigen-features then say
"no structure". A cloud with fewer points than k_min + 1 gives the neighborhood of all its points.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..base.jit import FAST, device, njit
from .candidates import from_order_bits, order_bits
from .eigen import eigenentropy, eigenvalues3, log_fast
from .knn import CROWD, ROOM, make_rows, make_scratch, next_rows, start_search
from .moments import COINCIDENT, HIGH, LOW, SX, SXX, SXY, SXZ, SY, SYY, SYZ, SZ, SZZ, N
from .shapes import COUNTS, VALUES, shape_counts, shape_values

#: Estimated entropies are off by less than half of this.
MARGIN = 2e-6

#: Entropies closer than this are equal.
TIE = 1e-9

#: Members a neighborhood needs to be a candidate.
LEAST = 3

#: Entropy of what is no candidate.
NEVER = 9.0


class Sums(NamedTuple):
    """Moments about the query of nested neighborhoods: element j belongs to the j-th of them."""

    n: np.ndarray
    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    xx: np.ndarray
    xy: np.ndarray
    xz: np.ndarray
    yy: np.ndarray
    yz: np.ndarray
    zz: np.ndarray
    entropy: np.ndarray


class Members(NamedTuple):
    """Members of the largest neighborhood of a query, nearest first: offsets from the query, and heights."""

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    height: np.ndarray  # int64 that orders like z
    record: np.ndarray  # (room, 4) float32 offsets, for the shapes


@device
def make_sums(count):
    return Sums(
        np.empty(count), np.empty(count), np.empty(count), np.empty(count), np.empty(count), np.empty(count),
        np.empty(count), np.empty(count), np.empty(count), np.empty(count), np.empty(count),
    )  # fmt: skip


@device
def make_members(room):
    return Members(
        np.empty(room),
        np.empty(room),
        np.empty(room),
        np.empty(room, np.int64),
        np.empty((room, 4), np.float32),
    )


@device(fastmath=set(FAST), forceinline=True)
def estimate_entropy(xx, xy, xz, yy, yz, zz, noise):
    """Eigenentropy of a covariance matrix to 1e-7, in closed form and without a branch.

    ``NEVER`` where the trace is not above `noise`.

    With unit trace, the eigenvalues are 1/3 + 2 p cos(phi + 2 pi i / 3), cos(3 phi) = r. For r >= 0 the
    squared sine of phi is (1 - r) times a smooth function of r, here a polynomial of degree 8 (fitted at
    Chebyshev nodes, error 7e-10); r < 0 is its mirror image.
    """
    trace = xx + yy + zz
    some = trace > noise
    scale = 1.0 / (trace if some else 1.0)
    third = 1.0 / 3.0
    a, b, c = xx * scale - third, yy * scale - third, zz * scale - third
    d, e, f = xy * scale, xz * scale, yz * scale
    pp = (a * a + b * b + c * c + 2.0 * (d * d + e * e + f * f)) * (1.0 / 6.0)
    det = a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)
    p = math.sqrt(pp)
    round_ = pp > 1e-24
    r = 0.5 * det / (pp * p if round_ else 1.0)
    sign = 1.0 if r >= 0.0 else -1.0
    r = abs(r)
    r = r if r < 1.0 else 1.0
    g = r * 0.0001390659792811512 - 0.0008013499216350227
    g = g * r + 0.0022057097588815584
    g = g * r - 0.004110695181066391
    g = g * r + 0.0063985863615792496
    g = g * r - 0.00981107968361836
    g = g * r + 0.01687699899962807
    g = g * r - 0.038675012833058346
    g = g * r + 0.2499999992783597
    ss = (1.0 - r) * g
    cosine = sign * p * math.sqrt(1.0 - ss)
    sine = 1.7320508075688772 * p * math.sqrt(ss)
    one = third + 2.0 * cosine
    two = third - cosine + sine
    three = third - cosine - sine
    one = one if one > 1e-16 else 1e-16
    two = two if two > 1e-16 else 1e-16
    three = three if three > 1e-16 else 1e-16
    entropy = -(one * log_fast(one) + two * log_fast(two) + three * log_fast(three))
    return entropy if some else NEVER


@device(forceinline=True)
def _covariance(s, j):
    w = 1.0 / s.n[j]
    x, y, z = s.x[j] * w, s.y[j] * w, s.z[j] * w
    return (
        s.xx[j] * w - x * x,
        s.xy[j] * w - x * y,
        s.xz[j] * w - x * z,
        s.yy[j] * w - y * y,
        s.yz[j] * w - y * z,
        s.zz[j] * w - z * z,
    )


@device
def estimate_entropies(n, x, y, z, xx, xy, xz, yy, yz, zz, entropy, first, last, least):
    """Estimate the eigenentropies of the candidates first..last - 1 of at least `least` members."""
    for j in range(first, last):
        w = 1.0 / n[j]
        a, b, c = x[j] * w, y[j] * w, z[j] * w
        value = estimate_entropy(
            xx[j] * w - a * a, xy[j] * w - a * b, xz[j] * w - a * c, yy[j] * w - b * b, yz[j] * w - b * c,
            zz[j] * w - c * c, COINCIDENT * w * (xx[j] + yy[j] + zz[j]),
        )  # fmt: skip
        entropy[j] = value if n[j] >= least else NEVER


@device
def lowest_entropy(s, first, last, least_members):
    """The candidate of first..last - 1 with the lowest eigenentropy; last - 1 where none qualifies.

    Parameters
    ----------
    s : Sums
        Moments of the candidates, in ascending size; n > 0.
    least_members : int
        Members a candidate needs.
    """
    if last - first <= 1:
        return last - 1
    entropy = s.entropy
    estimate_entropies(
        s.n, s.x, s.y, s.z, s.xx, s.xy, s.xz, s.yy, s.yz, s.zz, entropy, first, last, least_members
    )
    least = NEVER
    for j in range(first, last):
        least = min(least, entropy[j])
    if least >= NEVER:
        return last - 1
    limit = least + MARGIN
    count, only = 0, first
    for j in range(first, last):
        if entropy[j] <= limit:
            count += 1
            only = j
    if count == 1:
        return only
    least = NEVER
    for j in range(first, last):
        if entropy[j] > limit:
            entropy[j] = NEVER
            continue
        xx, xy, xz, yy, yz, zz = _covariance(s, j)
        l1, l2, l3 = eigenvalues3(xx, xy, xz, yy, yz, zz)
        entropy[j] = eigenentropy(l1, l2, l3)
        least = min(least, entropy[j])
    for j in range(first, last):
        if entropy[j] <= least + TIE:
            return j
    return last - 1


@device
def take_members(tree, index, count, qx, qy, qz, members):
    """Offsets from the query and heights of the points index[:count]."""
    for i in range(count):
        p = index[i]
        z = tree.z[p]
        members.x[i] = tree.x[p] - qx
        members.y[i] = tree.y[p] - qy
        members.z[i] = z - qz
        members.height[i] = order_bits(z)


@device
def take_row(rows, row, count, members):
    """The first `count` neighbors of one of ``knn.Rows``."""
    for i in range(count):
        members.x[i], members.y[i], members.z[i] = rows.x[i, row], rows.y[i, row], rows.z[i, row]
        members.height[i] = order_bits(rows.height[i, row])


@device
def running_sums(x, y, z, count, s):
    """Moments of the first 1, 2, ... `count` members."""
    sx = sy = sz = sxx = sxy = sxz = syy = syz = szz = 0.0
    for i in range(count):
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
        s.n[i] = i + 1.0
        s.x[i], s.y[i], s.z[i] = sx, sy, sz
        s.xx[i], s.xy[i], s.xz[i] = sxx, sxy, sxz
        s.yy[i], s.yz[i], s.zz[i] = syy, syz, szz


@device
def write_moments(s, j, members, count, table, column):
    """One column of the moment table: the sums `j`, and lowest and highest of the first `count` members."""
    table[N, column] = s.n[j]
    table[SX, column], table[SY, column], table[SZ, column] = s.x[j], s.y[j], s.z[j]
    table[SXX, column], table[SXY, column], table[SXZ, column] = s.xx[j], s.xy[j], s.xz[j]
    table[SYY, column], table[SYZ, column], table[SZZ, column] = s.yy[j], s.yz[j], s.zz[j]
    low, high = np.int64(2**63 - 1), -np.int64(2**63 - 1)
    height = members.height
    for i in range(count):
        low = min(low, height[i])
        high = max(high, height[i])
    table[LOW, column], table[HIGH, column] = from_order_bits(low), from_order_bits(high)


@device
def write_shapes(members, count, s, j, seed, shapes, column):
    """The shapes of the first `count` members."""
    record = members.record
    for i in range(count):
        record[i, 0], record[i, 1], record[i, 2], record[i, 3] = members.x[i], members.y[i], members.z[i], 0.0
    w = 1.0 / s.n[j]
    gx, gy, gz = np.float32(s.x[j] * w), np.float32(s.y[j] * w), np.float32(s.z[j] * w)
    if shapes.mode == COUNTS:
        shape_counts(record, count, gx, gy, gz, seed, shapes.thresholds, shapes.work, shapes.counts[column])
    else:
        shape_values(record, count, gx, gy, gz, seed, shapes.work, shapes.values[column])


@njit
def kopt_block(tree, qx, qy, qz, k_min, k_max, cap2, table, radius, reach, seeds, shapes):
    """Moments, radius and shapes of the best k in k_min..k_max for a block of queries.

    With k_min = k_max the neighborhood is the k nearest.

    Parameters
    ----------
    tree : KdTree
    qx, qy, qz : ndarray of float64, shape (m,)
        Queries, usually points of the cloud.
    k_min, k_max : int
        Neighbors besides the point itself.
    cap2 : float
        Neighbors lie within this squared distance, infinity for no bound; where fewer than k_min do, all that
        do are taken.
    table : ndarray of float64, shape (12, m)
        Out: moments about the query, in the rows of ``moments``.
    radius : ndarray of float64, shape (m,)
        Out: distance to the farthest member, meters.
    reach : ndarray of float64, shape (m,)
        Out: distance to the k_max-th neighbor, on which the result depends; infinity where there are fewer.
    seeds : ndarray of uint64, shape (m,)
        See :func:`shapes.point_seeds`; not used without shapes.
    shapes : Shapes
        What to make of shapes.
    """
    kopt_into(tree, qx, qy, qz, np.arange(len(qx)), k_min, k_max, cap2, table, radius, reach, seeds, shapes)


@device
def kopt_into(tree, qx, qy, qz, target, k_min, k_max, cap2, table, radius, reach, seeds, shapes):
    """:func:`kopt_block` for the queries `target` (ndarray of int64) only; the others are left alone."""
    need = k_max + 1
    search = start_search(qx[target], qy[target], qz[target])
    scratch = make_scratch(CROWD * need + ROOM)
    rows = make_rows(need, False)
    members = make_members(need)
    s = make_sums(need)
    while True:
        lo, hi, count, scratch = next_rows(tree, search, need, cap2, scratch, rows)
        if lo < 0:
            return
        for row in range(count):
            q = target[search.order[lo + row]]
            found = rows.found[row]
            reach[q] = math.sqrt(rows.d2[found - 1, row]) if found == need else math.inf
            if found == 0:  # a query that is no point of the cloud, farther than the bound from all
                write_nothing(table, radius, shapes, q)
                continue
            if len(rows.x):
                take_row(rows, row, found, members)
            else:
                take_members(tree, rows.at[:, row], found, qx[q], qy[q], qz[q], members)
            running_sums(members.x, members.y, members.z, found, s)
            best = lowest_entropy(s, min(k_min, found - 1), found, LEAST)
            write_moments(s, best, members, best + 1, table, q)
            radius[q] = math.sqrt(rows.d2[best, row])
            if shapes.mode:
                write_shapes(members, best + 1, s, best, seeds[q], shapes, q)
        for j in range(lo + count, hi):  # queries that coincide with the first
            q = target[search.order[j]]
            copy_column(table, radius, shapes, target[search.order[lo]], q)
            reach[q] = reach[target[search.order[lo]]]


@device
def write_nothing(table, radius, shapes, column):
    """The result of a neighborhood without points."""
    table[:, column] = 0.0
    radius[column] = 0.0
    if shapes.mode == COUNTS:
        shapes.counts[column, :] = 0.0
    elif shapes.mode == VALUES:
        shapes.values[column, :, :] = np.nan


@device
def copy_column(table, radius, shapes, source, target):
    """Give query `target` the results of query `source`."""
    for i in range(table.shape[0]):
        table[i, target] = table[i, source]
    radius[target] = radius[source]
    if shapes.mode == COUNTS:
        shapes.counts[target] = shapes.counts[source]
    elif shapes.mode == VALUES:
        shapes.values[target] = shapes.values[source]
