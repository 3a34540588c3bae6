"""Features of several numbers of nearest neighbors at once, from one search for the largest.

Moments are summed in the order of distance, for eight queries side by side (``abreast.py``), and become features a batch
at a time: what is held is a batch, however many queries a block has. The bits are those of ``optimal.kopt_block`` for each
k by itself.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..base.jit import device, njit
from ..base.lending import lent
from .knn import CROWD, ROOM, make_rows, make_scratch, next_rows, start_search
from .lanes import LANES, SUMS, add_members
from .moments import BATCH, FEATURES, MOMENTS, SX, WIDTH, N, finish
from .neighborhoods import AROUND, LEAST_RADIUS
from .surfaces import MADE, REACH, UP, VARIATION, agreement, surfaces_of


class Batch(NamedTuple):
    """Queries whose neighbors are found and whose features are not made yet: at most BATCH, s numbers of neighbors."""

    query: np.ndarray  # (BATCH + LANES,) int64
    moments: np.ndarray  # (s, 12, WIDTH) float64
    radius: np.ndarray  # (s, WIDTH) float64
    reach: np.ndarray  # (s, WIDTH) float64
    apart: np.ndarray  # (WIDTH,) float64: squared distance to the nearest point, 0 for a point of the cloud
    sums: np.ndarray  # (SUMS, LANES) float64
    state: np.ndarray  # (3,) int64: queries in it; those that coincide with its last: from, to


@device
def make_batch(count):
    return Batch(
        np.empty(WIDTH, np.int64), np.empty((count, MOMENTS, WIDTH)), np.empty((count, WIDTH)),
        np.empty((count, WIDTH)), np.empty(WIDTH), np.empty((SUMS, LANES)), np.zeros(3, np.int64),
    )  # fmt: skip


@device
def fill_batch(tree, search, ks, need, scratch, rows, batch, near):
    """Add queries until the batch is full or none is left; the scratch, to be passed next time.

    The rows of `near` (m, w) uint32 get the nearest points of queries.
    """
    state, order = batch.state, search.order
    state[0] = 0
    while state[0] <= BATCH - LANES:
        n = state[0]
        if state[1] < state[2]:  # queries that coincide with one before, which the last column keeps
            while state[1] < state[2] and n < BATCH:
                copy_query(batch, near, WIDTH - 1, n, np.int64(order[state[1]]))
                state[1] += 1
                n += 1
            state[0] = n
            continue
        lo, hi, count, scratch = next_rows(tree, search, need, math.inf, scratch, rows)
        if lo < 0:
            return scratch
        sum_rows(ks, count, rows, batch)
        for r in range(count):
            q = order[lo + r]
            batch.query[n + r] = q
            batch.apart[n + r] = rows.d2[0, r]
            found = rows.found[r]
            for j in range(len(ks)):
                last = min(ks[j], found - 1)
                radius = math.sqrt(rows.d2[last, r])
                batch.radius[j, n + r] = radius
                batch.reach[j, n + r] = radius if last == ks[j] else math.inf
            for i in range(near.shape[1]):
                near[q, i] = rows.at[i, r]
        state[0] = n + count
        if hi > lo + count:
            state[1], state[2] = lo + count, hi
            copy_query(batch, near, n, WIDTH - 1, np.int64(order[lo]))
    return scratch


@device
def sum_rows(ks, count, rows, batch):
    """Moments of all rows and numbers of neighbors, behind what the batch holds."""
    sums, moments, n = batch.sums, batch.moments, batch.state[0]
    sums[:] = 0.0
    sums[SUMS - 2] = math.inf
    sums[SUMS - 1] = -math.inf
    first = np.int64(0)
    for j in range(len(ks)):
        end = min(ks[j] + 1, len(rows.d2))
        add_members(rows.x, rows.y, rows.z, rows.height, first, end, sums)
        first = end
        for r in range(LANES):
            moments[j, N, n + r] = min(end, rows.found[r])
        for row in range(SUMS):
            for r in range(LANES):
                moments[j, SX + row, n + r] = sums[row, r]


@device
def copy_query(batch, near, source, target, query):
    """Query number `query`, of which the same is true as of another, in column `target`."""
    batch.moments[:, :, target] = batch.moments[:, :, source]
    batch.radius[:, target] = batch.radius[:, source]
    batch.reach[:, target] = batch.reach[:, source]
    batch.apart[target] = batch.apart[source]
    near[query] = near[batch.query[source]]
    batch.query[target] = query


@njit
def nearest_block(tree, qx, qy, qz, copies, ks, columns, halo, near, own, few, far, out):
    """Write the features of several numbers of nearest neighbors for a block of queries.

    Parameters
    ----------
    tree : KdTree
    qx, qy, qz : ndarray of float64, shape (m,)
        Queries, usually points of the cloud.
    copies : ndarray of int64, shape (m,)
        How many queries of the user's each stands for.
    ks : ndarray of int64, shape (s,)
        Neighbors besides the point itself, ascending.
    columns : ndarray of int64, shape (s, 13)
        Where in `out` each feature of ``moments.finish`` goes; -1: nowhere.
    halo : float
        Meters from a query that count as near.
    near : ndarray of uint32, shape (m, w)
        Gets the nearest points of each query, at most as many as the cloud has; w = 0 where no surfaces are wanted.
    own : ndarray of float64, shape (m, surfaces.WIDTH)
        With these, gets the surface of each query, for which AROUND is among `ks`.
    few, far : ndarray of int64, shape (s,)
        Raised by the number of queries with fewer than three members, and of those that reach farther than `halo`.
    out : ndarray of float32, shape (m, F)
    """
    need = ks[len(ks) - 1] + 1
    search, scratch = start_search(qx, qy, qz), make_scratch(CROWD * need + ROOM)
    rows, batch = make_rows(need), make_batch(len(ks))
    volumes, heights, counts = np.empty(BATCH), np.empty(BATCH), np.empty(BATCH, np.int64)
    cloud, places = lent(tree), lent(near)
    while True:
        scratch = fill_batch(cloud, lent(search), ks, need, scratch, lent(rows), lent(batch), places)
        count = batch.state[0]
        if count == 0:
            return
        for i in range(count):
            heights[i], counts[i] = qz[batch.query[i]], copies[batch.query[i]]
        for j in range(len(ks)):
            for i in range(count):
                r = max(batch.radius[j, i], LEAST_RADIUS)
                volumes[i] = 4.0 / 3.0 * math.pi * r * r * r
            values = finish(batch.moments[j], count, volumes, 0.0, heights, few[j : j + 1], counts)
            for f in range(FEATURES):
                column = columns[j, f]
                if column >= 0:
                    for i in range(count):
                        out[batch.query[i], column] = values[f, i]
            for i in range(count):
                far[j] += counts[i] if batch.reach[j, i] > halo else 0
            if near.shape[1] > 0 and ks[j] == AROUND:
                write_surfaces(batch, j, own)


@device
def write_surfaces(batch, j, out):
    """Write the surfaces of a batch, from the moments of its AROUND nearest, to the rows of `out` (m, WIDTH) float64.

    Of points of the cloud, which others look at, they are rounded as a table of float32 holds them; of other queries the
    reach is negative.
    """
    made = surfaces_of(batch.moments[j], batch.state[0])
    for i in range(batch.state[0]):
        q, cloud = batch.query[i], batch.apart[i] == 0.0
        for column in range(VARIATION + 1):
            value = made[column, i]
            out[q, column] = np.float64(np.float32(value)) if cloud else value
        out[q, REACH] = batch.reach[j, i] * UP if cloud else -batch.reach[j, i]


@njit
def surfaces_block(tree, qx, qy, qz, out):
    """Write the surfaces of points of the cloud, of the AROUND nearest of each, to `out` (m, surfaces.WIDTH) float64."""
    ks, need = np.array([AROUND]), AROUND + 1
    search, scratch = start_search(qx, qy, qz), make_scratch(CROWD * need + ROOM)
    rows, batch = make_rows(need), make_batch(1)
    cloud, nowhere = lent(tree), np.empty((len(qx), 0), np.uint32)
    while True:
        scratch = fill_batch(cloud, lent(search), ks, need, scratch, lent(rows), lent(batch), lent(nowhere))
        if batch.state[0] == 0:
            return
        write_surfaces(batch, 0, out)


@njit
def store_surfaces(near, own, surfaces, known):
    """Put the queries' own surfaces into the cloud's table; which points beside them have none there, (u,) uint32."""
    count = 0
    missing = np.empty(near.size, np.uint32)
    for q in range(len(near)):
        if own[q, REACH] >= 0.0:
            for column in range(surfaces.shape[1]):
                surfaces[near[q, 0], column] = own[q, column]
            known[near[q, 0]] = 1
    for q in range(len(near)):
        for i in range(near.shape[1]):
            p = near[q, i]
            if known[p] == 0:
                known[p] = 2  # listed
                missing[count] = p
                count += 1
    for i in range(count):
        known[missing[i]] = 0
    return missing[:count].copy()


@njit
def agreement_block(tree, qx, qy, qz, copies, ks, columns, halo, near, own, surfaces, far, out):
    """Write what neighbors' surfaces make; parameters as of :func:`nearest_block`, of the numbers `ks` of neighbors.

    Parameters
    ----------
    columns : ndarray of int64, shape (s, surfaces.MADE)
        Where in `out` they go; -1: nowhere.
    near, own : ndarray
        As :func:`nearest_block` left them.
    surfaces : ndarray of float32, shape (n, surfaces.WIDTH)
        Of the cloud, with all that is in `near`.
    """
    made, d2 = np.empty(MADE), np.empty(near.shape[1])
    places, mine, table = lent(near), lent(own), lent(surfaces)
    for q in range(len(qx)):
        at = places[q]
        for i in range(len(at)):
            x, y, z = tree.x[at[i]] - qx[q], tree.y[at[i]] - qy[q], tree.z[at[i]] - qz[q]
            d2[i] = x * x + y * y + z * z
        for j in range(len(ks)):
            reach = agreement(table, at, d2, min(ks[j] + 1, len(at)), mine[q], made)
            reach = math.inf if ks[j] >= len(tree.perm) else max(reach, -own[q, REACH])
            far[j] += copies[q] if reach > halo else 0
            for f in range(MADE):
                if columns[j, f] >= 0:
                    out[q, columns[j, f]] = made[f]
