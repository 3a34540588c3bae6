"""The compiled kernel of the forest: many rows walk its trees at once.

A tree is walked by eight rows in lock step. One step loads a node, which is two numbers side by side (its threshold; its
feature and left child packed into one), compares, and moves to the left child or the one after it. A leaf points at
itself under a threshold that is not a number, so nothing is ever greater, no branch has to be predicted and eight loads are
in flight at a time; the bits that such a number is free to have say which row of the leaf table it is. That is twice
the speed of scikit-learn's descent, row by row, with results that are equal bit for bit: the same comparisons, and
probabilities added in the same order.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..base.jit import njit

#: Rows that walk a tree together.
LANES = 8
#: Of 32 and 64 bits: the type of a node's two numbers, that of its threshold, and the bits of NaN that are free.
WORDS: tuple[tuple[Any, Any, int], ...] = ((np.uint32, np.float32, 22), (np.uint64, np.float64, 51))


@njit
def walk(values, sizes, nodes, limits, shift, child, free, leaf_value, group, out):
    """Add every tree's leaf probabilities to `out`.

    Parameters
    ----------
    values : (n * features,) float32
        Rows of feature values, one after the other.
    sizes : (trees,) int64
    nodes : (2 * nodes,) uint32 or uint64
        Of each node the bits of its threshold (go left where value <= threshold; of a leaf: NaN | row of `leaf_value`),
        and feature << shift | left child within the tree (of a leaf: its own index).
    limits : (2 * nodes,) float32 or float64
        The same memory, for the thresholds.
    shift, child, free : of nodes' type
        See above; the bits of a child, and those of NaN that hold a row.
    leaf_value : (leaves * classes,) float64
    group : int
        Rows that pass over a tree before the next one's turn; a multiple of LANES.
    out : (n, classes) float64
    """
    n = len(out)
    classes, features = np.uint64(out.shape[1]), np.uint64(len(values) // max(n, 1))
    sums = out.reshape(-1)
    one = np.uint64(1)
    at = np.zeros(LANES, np.uint64)
    for first in range(0, n, group):
        last = min(n, first + group)
        whole = last - (last - first) % LANES
        start = 0
        for tree in range(len(sizes)):
            stop = start + sizes[tree]
            pairs = nodes[2 * start : 2 * stop]
            bounds = limits[2 * start : 2 * stop]
            for g in range(first, whole, LANES):
                base = np.uint64(g) * features
                for j in range(LANES):
                    at[j] = 0
                moving = True
                while moving:
                    changed = np.uint64(0)
                    row = base
                    for j in range(LANES):
                        i = at[j]
                        node = pairs[i + i + one]
                        step = values[row + np.uint64(node >> shift)] > bounds[i + i]
                        to = np.uint64(node & child) + np.uint64(step)
                        changed |= to ^ i
                        at[j] = to
                        row += features
                    moving = changed != 0
                total = np.uint64(g) * classes
                for j in range(LANES):
                    leaf = np.uint64(pairs[at[j] + at[j]] & free) * classes
                    for c in range(classes):
                        sums[total + c] += leaf_value[leaf + c]
                    total += classes
            for r in range(whole, last):
                base = np.uint64(r) * features
                i = np.uint64(0)
                while True:
                    node = pairs[i + i + one]
                    step = values[base + np.uint64(node >> shift)] > bounds[i + i]
                    to = np.uint64(node & child) + np.uint64(step)
                    if to == i:
                        break
                    i = to
                leaf = np.uint64(pairs[i + i] & free) * classes
                for c in range(classes):
                    sums[np.uint64(r) * classes + c] += leaf_value[leaf + c]
            start = stop
