"""A balanced k-d tree over a cloud, for neighbor searches whose cost does not depend on how points lie.

A grid suits an airborne cloud, but not a facade (thousands of points over one cell), a mobile scan, a stray
point at 1e9 m or ten million copies of one point. This tree does: every node halves its points along
the longest side of their bounding box, so it has the same depth everywhere. Only a permutation (4 bytes a
point) and the boxes of the nodes are stored (about 6 bytes a point).

Searches are made for *groups* of nearby queries: one traversal gathers every point within reach of the
group's bounding box into a flat scratch, which all queries of the group then scan with vector instructions.

Which points are gathered never depends on rounding: a box is skipped only if the distance computed to it is
larger than the reach, and computed distances are monotone in the coordinates.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ..base.jit import device, njit

#: A leaf holds at most this many points.
LEAF = 24

#: Room for the traversal: a depth-first stack holds at most one node a level and its sibling.
STACK = 80


class KdTree(NamedTuple):
    """A cloud and the tree over it, as kernels take it.

    Attributes
    ----------
    x, y, z : ndarray of float64, shape (n,)
        The cloud itself, in the caller's order (not copied).
    perm : ndarray of uint32, shape (n,)
        Positions in the cloud, leaf by leaf.
    boxes : ndarray of float64, shape (nodes, 6)
        Bounding boxes xmin, ymin, zmin, xmax, ymax, zmax; node i has the children 2i + 1 and 2i + 2.
    depth : int
        Levels below the root; all leaves lie on the last.
    """

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    perm: np.ndarray
    boxes: np.ndarray
    depth: int


def build_tree(
    x: np.ndarray, y: np.ndarray, z: np.ndarray, run: Callable[[Callable, list], object] | None = None
) -> KdTree:
    """Build the tree over a cloud of at least one point.

    Parameters
    ----------
    x, y, z : ndarray, shape (n,)
        Coordinates, finite.
    run : callable, optional
        ``run(function, blocks)`` calls ``function(block)`` for every block, e.g. in threads.

    Raises
    ------
    ValueError
        Where the cloud is empty, or larger than 2**32 - 1 points.
    """
    x, y, z = (np.ascontiguousarray(v, dtype=np.float64) for v in (x, y, z))
    n = len(x)
    if not 1 <= n < 2**32:
        raise ValueError(f"a tree needs 1 to 2**32 - 1 points, not {n}")
    depth = 0
    while (n >> depth) >= LEAF:
        depth += 1
    perm = np.arange(n, dtype=np.uint32)
    boxes = np.empty((2 ** (depth + 1) - 1, 6))
    keys = np.empty(n)
    tasks = [(0, 0, n, 0)]
    if run is not None and n > 100_000:
        for level in range(2):  # the upper nodes one by one, then four subtrees at once
            upper = []
            for node, lo, hi, _ in tasks:
                mid = _split_node(x, y, z, perm, keys, boxes, node, lo, hi, False)
                upper += [(2 * node + 1, lo, mid, level + 1), (2 * node + 2, mid, hi, level + 1)]
            tasks = upper
        run(lambda t: _build_below(x, y, z, perm, keys, boxes, t[0], t[1], t[2], depth - t[3]), tasks)
    else:
        _build_below(x, y, z, perm, keys, boxes, 0, 0, n, depth)
    return KdTree(x, y, z, perm, boxes, depth)


@device
def select_nth(keys, perm, lo, hi, nth):
    """Reorder keys[lo:hi], and perm with it, so that `nth` holds what sorting would put there.

    Hoare's partition stops at equal keys, so many equal ones still halve.
    """
    hi -= 1
    while hi > lo:
        if hi - lo < 12:
            for i in range(lo + 1, hi + 1):
                key, item = keys[i], perm[i]
                j = i - 1
                while j >= lo and keys[j] > key:
                    keys[j + 1] = keys[j]
                    perm[j + 1] = perm[j]
                    j -= 1
                keys[j + 1] = key
                perm[j + 1] = item
            return
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


@device
def bounding_box(x, y, z, perm, lo, hi):
    """Bounding box xmin, ymin, zmin, xmax, ymax, zmax of the points perm[lo:hi]."""
    x0 = y0 = z0 = np.inf
    x1 = y1 = z1 = -np.inf
    for i in range(lo, hi):
        p = perm[i]
        a, b, c = x[p], y[p], z[p]
        x0 = a if a < x0 else x0
        x1 = a if a > x1 else x1
        y0 = b if b < y0 else y0
        y1 = b if b > y1 else y1
        z0 = c if c < z0 else z0
        z1 = c if c > z1 else z1
    return x0, y0, z0, x1, y1, z1


@device
def halve(x, y, z, perm, keys, lo, hi, box):
    """Reorder perm[lo:hi] so that its halves lie on either side along the longest side of `box`."""
    dx, dy, dz = box[3] - box[0], box[4] - box[1], box[5] - box[2]
    mid = (lo + hi) // 2
    along = x if dx >= dy and dx >= dz else (y if dy >= dz else z)
    for i in range(lo, hi):
        keys[i] = along[perm[i]]
    select_nth(keys, perm, lo, hi, mid)
    return mid


@njit
def _split_node(x, y, z, perm, keys, boxes, node, lo, hi, leaf):
    """Fill a node's box and, where it is no leaf, halve its points."""
    box = bounding_box(x, y, z, perm, lo, hi)
    for i in range(6):
        boxes[node, i] = box[i]
    return hi if leaf else halve(x, y, z, perm, keys, lo, hi, box)


@njit
def _build_below(x, y, z, perm, keys, boxes, node, lo, hi, depth):
    """The subtree of `node`, which has `depth` levels below it."""
    stack = np.empty((STACK, 4), np.int64)
    stack[0, 0], stack[0, 1], stack[0, 2], stack[0, 3] = node, lo, hi, depth
    top = 1
    while top > 0:
        top -= 1
        node, lo, hi, depth = stack[top, 0], stack[top, 1], stack[top, 2], stack[top, 3]
        mid = _split_node(x, y, z, perm, keys, boxes, node, lo, hi, depth == 0)
        if depth == 0:
            continue
        stack[top, 0], stack[top, 1], stack[top, 2], stack[top, 3] = 2 * node + 2, mid, hi, depth - 1
        top += 1
        stack[top, 0], stack[top, 1], stack[top, 2], stack[top, 3] = 2 * node + 1, lo, mid, depth - 1
        top += 1


@device(forceinline=True)
def _gap(lo, hi, low, high):
    """Distance along one axis between the intervals lo..hi and low..high."""
    a, b = lo - high, low - hi
    gap = a if a > b else b
    return gap if gap > 0.0 else 0.0


@device
def farthest2(tree, box):
    """Squared distance no pair of a point of the cloud and a point of `box` exceeds."""
    total = 0.0
    for i in range(3):
        a, b = tree.boxes[0, 3 + i] - box[i], box[3 + i] - tree.boxes[0, i]
        far = a if a > b else b
        total += far * far
    return total


@device
def gather(tree, box, reach2, copies, limit, stack, cx, cy, cz, ci):
    """Collect the points within sqrt(`reach2`) of `box` into the scratch cx, cy, cz, ci.

    Of points that all coincide at most about `copies` are taken, a leaf's worth more where they share
    leaves with others.

    Returns
    -------
    int
        How many were collected, or -1 if they are more than `limit`.
    """
    x, y, z, perm, boxes = tree.x, tree.y, tree.z, tree.perm, tree.boxes
    x0, y0, z0, x1, y1, z1 = box
    # Unsigned: what may be negative is looked up with a detour.
    count, one = np.uint64(0), np.uint64(1)
    stack[0, 0], stack[0, 1], stack[0, 2], stack[0, 3] = 0, 0, len(perm), tree.depth
    top = 1
    while top > 0:
        top -= 1
        node, lo, hi, depth = stack[top, 0], stack[top, 1], stack[top, 2], stack[top, 3]
        n = np.uint64(node)
        a0, b0, c0, a1, b1, c1 = boxes[n, 0], boxes[n, 1], boxes[n, 2], boxes[n, 3], boxes[n, 4], boxes[n, 5]
        dx, dy, dz = _gap(x0, x1, a0, a1), _gap(y0, y1, b0, b1), _gap(z0, z1, c0, c1)
        if dx * dx + dy * dy + dz * dz > reach2:
            continue
        if a0 == a1 and b0 == b1 and c0 == c1 and hi - lo > copies:
            hi = lo + copies
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
                count += one if dx * dx + dy * dy + dz * dz <= reach2 else np.uint64(0)
            continue
        mid = (lo + hi) // 2
        stack[top, 0], stack[top, 1], stack[top, 2], stack[top, 3] = 2 * node + 2, mid, hi, depth - 1
        top += 1
        stack[top, 0], stack[top, 1], stack[top, 2], stack[top, 3] = 2 * node + 1, lo, mid, depth - 1
        top += 1
    return np.int64(count)
