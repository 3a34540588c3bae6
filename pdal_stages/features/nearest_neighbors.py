"""Neighbors of queries, exact and in one well-defined order: by (squared distance, x, y, z).

Squared distances are those of float64 differences, so the answer is a function of the cloud as a
set: neither the order of the points, nor the tile, nor which queries are searched together changes
it. Points with equal coordinates are interchangeable.

Eight queries that lie together share the candidates within a reach, guessed from the queries
before; each sorts those within its own. In the plane the squared distance is uniformly
distributed, so a counting sort by it fills its bins evenly.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..base.jit import device
from .kdtree import STACK, bounding_box, enough2, gather, halve

#: Queries that share one set of candidates.
GROUP = 8

#: Bins of squared distance; behind them what lies beyond the reach.
BINS = 64

#: First guess of the squared reach, square meters.
FIRST2 = 1.0
#: Least squared reach, square meters.
LEAST2 = 1e-6
#: The next guess is larger by this factor than what the last queries needed.
MORE = 1.2

#: A search for `need` neighbors that meets more than CROWD * need + ROOM candidates looks closer.
CROWD = 4
ROOM = 256

#: Squared meters too small to divide by.
TINY = 1e-200


class Queries(NamedTuple):
    """Places of a block whose neighbors are searched, in groups that lie together."""

    x: np.ndarray  # (m,) float64
    y: np.ndarray
    z: np.ndarray
    order: np.ndarray  # (m,) uint32: queries, group by group
    starts: np.ndarray  # (groups + 1,) int64: where groups begin in the order


class Wanted(NamedTuple):
    """The neighbors that a search must not miss."""

    need: int  # at least so many of those within `cap2`
    within2: float  # all within this squared distance, square meters
    cap2: float


class Near(NamedTuple):
    """Candidates of a group of queries, and room to sort them for one."""

    x: np.ndarray  # float64
    y: np.ndarray
    z: np.ndarray
    at: np.ndarray  # uint32: positions in the cloud
    d2: np.ndarray  # float64
    bins: np.ndarray  # int32
    sorted: np.ndarray  # float64: squared distances of the neighbors, in order
    pos: np.ndarray  # uint32: which candidates they are
    hist: np.ndarray  # (BINS + 1,) int64
    stack: np.ndarray


@device(_nrt=True)
def make_near(room):
    """Return room for `room` candidates."""
    f, u = np.float64, np.uint32
    return Near(
        np.empty(room, f), np.empty(room, f), np.empty(room, f), np.empty(room, u),
        np.empty(room, f), np.empty(room, np.int32), np.empty(room, f), np.empty(room, u),
        np.empty(BINS + 1, np.int64), np.empty((STACK, 4), np.int64),
    )  # fmt: skip


@device(_nrt=True)
def make_groups(qx, qy, qz):
    """Return queries in groups of at most GROUP that lie together."""
    m = len(qx)
    order, keys = np.arange(m).astype(np.uint32), np.empty(m)
    starts, count = np.empty(m + 1, np.int64), 0
    stack = np.empty((STACK, 2), np.int64)
    stack[0, 0], stack[0, 1] = 0, m
    top = 1 if m > 0 else 0
    while top > 0:
        top -= 1
        lo, hi = stack[top, 0], stack[top, 1]
        if hi - lo <= GROUP:
            starts[count] = lo
            count += 1
            continue
        middle = halve(qx, qy, qz, order, keys, lo, hi, bounding_box(qx, qy, qz, order, lo, hi))
        stack[top, 0], stack[top, 1] = middle, hi
        top += 1
        stack[top, 0], stack[top, 1] = lo, middle
        top += 1
    starts[count] = m
    return Queries(qx, qy, qz, order, starts[: count + 1])


@device
def gather_near(tree, queries, lo, hi, wanted, reach2, near):
    """Find candidates for the queries order[lo:hi], or for the first alone.

    That happens where candidates are too many or the queries lie too far apart.

    Returns
    -------
    hi : int
        Up to where queries are served.
    count : int
        Number of the candidates in `near`; -1 where these are too many for it.
    reach2 : float
        Squared distance within which no point of the cloud is missing.
    """
    need, within2, cap2 = wanted.need, wanted.within2, wanted.cap2
    room = len(near.x)
    limit = room if within2 > 0.0 else min(room, CROWD * need + ROOM)
    copies = need if within2 == 0.0 else len(tree.perm)
    while True:
        box = bounding_box(queries.x, queries.y, queries.z, queries.order, lo, hi)
        side = max(box[3] - box[0], box[4] - box[1], box[5] - box[2])
        if hi - lo > 1 and side * side > 4.0 * reach2:
            hi = lo + 1
            continue
        count = gather(tree, box, reach2, copies, limit, near)
        if count >= need or (count >= 0 and reach2 >= cap2):
            return hi, count, reach2
        if count >= 0:
            reach2 = min(2.0 * reach2, cap2)
            continue
        if hi - lo > 1:
            hi = lo + 1
            continue
        enough = max(enough2(tree, box, need), within2)
        if reach2 > enough:
            reach2 = enough
        elif limit < room:
            limit = room
        else:
            return hi, -1, reach2


@device(forceinline=True)
def sort_near(near, count, point, wanted, reach2):
    """Sort the neighbors of a point (x, y, z) into near.sorted and near.pos.

    Return how many there are, or -1 where `reach2` is too short.
    """
    x, y, z, d2, bins, hist = near.x, near.y, near.z, near.d2, near.bins, near.hist
    need, within2, cap2 = wanted.need, wanted.within2, wanted.cap2
    px, py, pz = point
    scale = BINS / max(reach2, TINY)
    for i in range(count):
        dx, dy, dz = x[i] - px, y[i] - py, z[i] - pz
        d = dx * dx + dy * dy + dz * dz
        d2[i] = d
        b = d * scale
        b = b if b < BINS - 1 else BINS - 1.0
        bins[i] = np.int32(b if d <= reach2 else float(BINS))
    hist[:] = 0
    for i in range(count):
        hist[bins[i]] += 1
    there = count - hist[BINS]
    if there < need and reach2 < cap2:
        return -1
    most = there if within2 > 0.0 else min(need, there)
    # Where each bin starts; up to which bin they hold enough; the largest number in one.
    end, last, largest = 0, 0, 0
    while end < most:
        size = hist[last]
        hist[last] = end
        end += size
        last += 1
        largest = max(largest, size)
    place, pos = near.sorted, near.pos
    for i in range(count):
        b = bins[i]
        if b < last:
            p = hist[b]
            hist[b] = p + 1
            place[p] = d2[i]
            pos[p] = i
    _shell_sort(place, pos, end, largest, x, y, z)
    if within2 > 0.0 and within2 < reach2:
        most = min(need, there)
        while most < there and place[most] <= within2:
            most += 1
    return most


@device(forceinline=True)
def _before(d, a, e, b, x, y, z):
    """Return whether candidate a at squared distance d comes before candidate b at e."""
    if d != e:
        return d < e
    if x[a] != x[b]:
        return x[a] < x[b]
    if y[a] != y[b]:
        return y[a] < y[b]
    return z[a] < z[b]


@device
def _shell_sort(d, pos, end, largest, x, y, z):
    """Sort the first `end` candidates, at most `largest` places from theirs (Shell 1959, Knuth)."""
    gap = 1
    while 9 * gap < largest:
        gap = 3 * gap + 1
    while gap > 0:
        for i in range(gap, end):
            key, item = d[i], pos[i]
            j = i
            while j >= gap and _before(key, item, d[j - gap], pos[j - gap], x, y, z):
                d[j], pos[j] = d[j - gap], pos[j - gap]
                j -= gap
            d[j], pos[j] = key, item
        gap //= 3
