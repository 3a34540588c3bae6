"""Neighbors of queries, exact and in one well-defined order: by (squared distance, x, y, z).

Squared distances are those of float64 differences, so the answer is a function of the cloud as a
set: neither the order of the points, nor the tile, nor which queries are searched together changes
it. Points with equal coordinates are interchangeable.

Four queries that lie together share the candidates within a reach, guessed from the queries
before; each sorts those within its own. In the plane the squared distance is uniformly
distributed, so a counting sort by it fills its bins evenly.

They are found in a balanced k-d tree, whose cost does not depend on how points lie: facades, strays
and copies. Every node halves its points along the longest side of their bounding box. Only a
permutation (4 bytes a point) and the nodes' boxes (about 6 bytes a point) are stored. A box is
skipped only if the distance computed to it is larger than the reach, and computed distances are
monotone in the coordinates: which points are gathered never depends on rounding.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np

from ..base.jit import device, njit
from ..base.threads import map_blocks

#: A leaf holds at most this many points: enough that boxes take 4 to 8 bytes a point, few enough
#: that most of a leaf's points are near. Not tuned.
LEAF = 24

#: Levels of a tree whose nodes threads share; below they share the trees. Not tuned.
SHARED_LEVELS = 4
#: Room for a depth-first traversal, which needs 29 entries for 2**32 points: one a level, and one
#: more.
STACK = 80


class KdTree(NamedTuple):
    """A cloud and the tree over it, as kernels take it."""

    x: np.ndarray  # (n,) float64, the cloud itself
    y: np.ndarray
    z: np.ndarray
    perm: np.ndarray  # (n,) uint32: positions in the cloud, leaf by leaf
    # (nodes, 6): xmin, ymin, zmin, xmax, ymax, zmax; node i has the children 2i + 1 and 2i + 2
    boxes: np.ndarray
    depth: int  # levels below the root; all leaves lie on the last


def build_tree(x: np.ndarray, y: np.ndarray, z: np.ndarray, threads: int | None = 1) -> KdTree:
    """Return the tree over a cloud of 1 to 2**32 - 1 points with finite coordinates (n,) each.

    Threads share the nodes of the upper levels, then the trees below these.
    """
    x, y, z = (np.ascontiguousarray(v, dtype=np.float64) for v in (x, y, z))
    n = len(x)
    if not 1 <= n < 2**32:
        raise ValueError(f"a tree needs 1 to 2**32 - 1 points, not {n}")
    depth = (n // LEAF).bit_length()
    boxes = np.empty((2 ** (depth + 1) - 1, 6))
    tree = KdTree(x, y, z, np.arange(n, dtype=np.uint32), boxes, depth)
    keys, parts = np.empty(n), [(0, 0, n)]
    shared = min(depth, SHARED_LEVELS)
    for below in range(depth, depth - shared - 1, -1):
        last = below if below > depth - shared else 0
        list(map_blocks(partial(build_nodes, tree, keys, below, last), parts, threads))
        parts = [half for part in parts for half in _halves(*part)]
    return tree


def _halves(node: int, lo: int, hi: int) -> list[tuple[int, int, int]]:
    """Return the children of a node of the points perm[lo:hi], each with its points."""
    middle = (lo + hi) // 2
    return [(2 * node + 1, lo, middle), (2 * node + 2, middle, hi)]


@njit
def build_nodes(tree, keys, depth, last, part):
    """Make a node of the points perm[lo:hi], and those below it; `part` is (node, lo, hi).

    It has `depth` levels below. Of nodes with `last` levels below the children are not made.
    `keys` (n,) are scratch.
    """
    x, y, z, perm, boxes = tree.x, tree.y, tree.z, tree.perm, tree.boxes
    stack = np.empty((STACK, 4), np.int64)
    top = push(stack, 0, part[0], part[1], part[2], depth)
    while top > 0:
        top -= 1
        node, lo, hi, depth = stack[top, 0], stack[top, 1], stack[top, 2], stack[top, 3]
        box = bounding_box(x, y, z, perm, lo, hi)
        for i in range(6):
            boxes[node, i] = box[i]
        if depth > 0:
            middle = halve(x, y, z, perm, keys, lo, hi, box)
        if depth > last:
            top = push(stack, top, 2 * node + 2, middle, hi, depth - 1)
            top = push(stack, top, 2 * node + 1, lo, middle, depth - 1)


@device(forceinline=True)
def push(stack, top, node, lo, hi, depth):
    """Put a node of the points perm[lo:hi] on a stack; return the size of the stack."""
    stack[top, 0], stack[top, 1], stack[top, 2], stack[top, 3] = node, lo, hi, depth
    return top + 1


@device
def bounding_box(x, y, z, perm, lo, hi):
    """Return the box xmin, ymin, zmin, xmax, ymax, zmax of the points perm[lo:hi]."""
    x0 = y0 = z0 = np.inf
    x1 = y1 = z1 = -np.inf
    for i in range(lo, hi):
        p = perm[i]
        x0, x1 = min(x0, x[p]), max(x1, x[p])
        y0, y1 = min(y0, y[p]), max(y1, y[p])
        z0, z1 = min(z0, z[p]), max(z1, z[p])
    return x0, y0, z0, x1, y1, z1


@device
def halve(x, y, z, perm, keys, lo, hi, box):
    """Reorder perm[lo:hi] so that its halves lie on either side of the box; return the middle."""
    dx, dy, dz = box[3] - box[0], box[4] - box[1], box[5] - box[2]
    along = x if dx >= dy and dx >= dz else (y if dy >= dz else z)
    for i in range(lo, hi):
        keys[i] = along[perm[i]]
    middle = (lo + hi) // 2
    select_nth(keys, perm, lo, hi, middle)
    return middle


@device
def select_nth(keys, perm, lo, hi, nth):
    """Reorder keys[lo:hi], and perm with it, so that `nth` holds what sorting would put there.

    Hoare's partition stops at equal keys, so many equal ones still halve.
    """
    hi -= 1
    while hi > lo:
        a, b, c = keys[lo + (hi - lo) // 4], keys[(lo + hi) // 2], keys[hi - (hi - lo) // 4]
        pivot = max(min(a, b), min(max(a, b), c))
        i, j = lo, hi
        while i <= j:
            while keys[i] < pivot:
                i += 1
            while keys[j] > pivot:
                j -= 1
            if i <= j:
                keys[i], keys[j] = keys[j], keys[i]
                perm[i], perm[j] = perm[j], perm[i]
                i += 1
                j -= 1
        if nth <= j:
            hi = j
        elif nth >= i:
            lo = i
        else:
            return


@device(forceinline=True)
def _gap(lo, hi, low, high):
    """Return the distance along one axis between the intervals lo..hi and low..high."""
    a, b = lo - high, low - hi
    gap = a if a > b else b
    return gap if gap > 0.0 else 0.0


@device(forceinline=True)
def gap2(box, boxes, n):
    """Return the squared distance between a box and that of node n."""
    dx = _gap(box[0], box[3], boxes[n, 0], boxes[n, 3])
    dy = _gap(box[1], box[4], boxes[n, 1], boxes[n, 4])
    dz = _gap(box[2], box[5], boxes[n, 2], boxes[n, 5])
    return dx * dx + dy * dy + dz * dz


@device
def enough2(tree, box, need):
    """Return a squared distance from a query within which `need` points lie, or all.

    `box` is that of the one query, whose corners are equal.
    """
    boxes = tree.boxes
    node, count = 0, len(tree.perm)
    for _ in range(tree.depth):
        if count // 2 < need:
            break
        left = gap2(box, boxes, 2 * node + 1) <= gap2(box, boxes, 2 * node + 2)
        node, count = (2 * node + 1, count // 2) if left else (2 * node + 2, count - count // 2)
    dx = max(boxes[node, 3] - box[0], box[0] - boxes[node, 0])
    dy = max(boxes[node, 4] - box[1], box[1] - boxes[node, 1])
    dz = max(boxes[node, 5] - box[2], box[2] - boxes[node, 2])
    return dx * dx + dy * dy + dz * dz


@device
def gather(tree, box, reach2, most_equal, limit, candidates):
    """Collect the points within sqrt(`reach2`) of `box`; return their number, or -1 above `limit`.

    `candidates` has room for them: arrays x, y, z, at (positions in the cloud) and a stack.

    Of points that all coincide about `most_equal` are taken, up to a leaf's more where they
    share leaves with others.
    """
    x, y, z, perm, boxes = tree.x, tree.y, tree.z, tree.perm, tree.boxes
    x0, y0, z0, x1, y1, z1 = box
    cx, cy, cz, ci = candidates.x, candidates.y, candidates.z, candidates.at
    stack = candidates.stack
    # Unsigned: numba would make a branch for negative indices, which count from the end.
    count, step = np.uint64(0), np.uint64(1)
    top = push(stack, 0, 0, 0, len(perm), tree.depth)
    while top > 0:
        top -= 1
        node, lo, hi, depth = stack[top, 0], stack[top, 1], stack[top, 2], stack[top, 3]
        n = np.uint64(node)
        if gap2(box, boxes, n) > reach2:
            continue
        same = (
            boxes[n, 0] == boxes[n, 3] and boxes[n, 1] == boxes[n, 4] and boxes[n, 2] == boxes[n, 5]
        )
        if same and hi - lo > most_equal:
            hi = lo + most_equal
            depth = 0
        if depth == 0:
            if np.int64(count) + (hi - lo) > limit:
                return -1
            for i in range(lo, hi):
                p = np.uint64(perm[np.uint64(i)])
                a, b, c = x[p], y[p], z[p]
                dx, dy, dz = _gap(x0, x1, a, a), _gap(y0, y1, b, b), _gap(z0, z1, c, c)
                cx[count] = a
                cy[count] = b
                cz[count] = c
                ci[count] = np.uint32(p)
                # Written always, kept if near: no branch to mispredict.
                count += step if dx * dx + dy * dy + dz * dz <= reach2 else np.uint64(0)
            continue
        middle = (lo + hi) // 2
        top = push(stack, top, 2 * node + 2, middle, hi, depth - 1)
        top = push(stack, top, 2 * node + 1, lo, middle, depth - 1)
    return np.int64(count)


# The numbers down to ROOM change how long a search takes, never what it finds. Only their order of
# magnitude matters; none is tuned.

#: Queries that share one set of candidates: enough to share the traversal of the tree, few enough
#: that most candidates are near to each of them.
GROUP = 4

#: Bins of squared distance; behind them what lies beyond the reach. Enough that a bin holds a few
#: of 50 to 100 neighbors, few enough that the counts stay in the fastest cache.
BINS = 64

#: First guess of the squared reach, square meters: the order of 50 neighbors in a survey of today.
FIRST2 = 1.0
#: Least squared reach, square meters: more than 0, which never grows when it is doubled.
LEAST2 = 1e-6
#: The next guess is larger by this factor than what the last queries needed, so that most guesses
#: are large enough at once.
MORE = 1.2

#: A search for `need` neighbors that meets more than CROWD * need + ROOM candidates looks closer:
#: the reach was guessed far too large.
CROWD = 4
ROOM = 256

#: Squared meters too small to divide by: BINS / TINY is finite.
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

    The first is alone where candidates are too many or the queries lie too far apart.

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
    most_equal = need if within2 == 0.0 else len(tree.perm)
    while True:
        box = bounding_box(queries.x, queries.y, queries.z, queries.order, lo, hi)
        side = max(box[3] - box[0], box[4] - box[1], box[5] - box[2])
        if hi - lo > 1 and side * side > 4.0 * reach2:  # more than two reaches apart
            hi = lo + 1
            continue
        count = gather(tree, box, reach2, most_equal, limit, near)
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
    """Sort neighbors of (x, y, z) into near.sorted and near.pos; return how many, or -1.

    The result is -1 where `reach2` is too short.
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
