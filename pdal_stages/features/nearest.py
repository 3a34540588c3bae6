"""Features of several numbers of nearest neighbors at once, from one search for the largest.

Moments are summed in the order of distance, for eight queries side by side (``abreast.py``), and become features a batch
at a time: what is held is a batch, however many queries a block has. The bits are those of ``optimal.kopt_block`` for each
k by itself.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..base.jit import any_of, device, njit
from ..base.lending import lent
from .knn import CROWD, ROOM, make_rows, make_scratch, next_rows, start_search
from .lanes import LANES, SUMS, add_members
from .moments import BATCH, FEATURES, MOMENTS, SX, WIDTH, N, finish
from .neighborhoods import AROUND, LEAST_RADIUS
from .surfaces import MADE, NX, NY, NZ, agreement, surface, write_surfaces


class Batch(NamedTuple):
    """Queries whose neighbors are found and whose features are not made yet: at most BATCH, s numbers of neighbors."""

    query: np.ndarray  # (BATCH + LANES,) int64
    moments: np.ndarray  # (s, 12, WIDTH) float64
    radius: np.ndarray  # (s, WIDTH) float64
    reach: np.ndarray  # (s, WIDTH) float64
    made: np.ndarray  # (s, WIDTH, MADE) float64
    sums: np.ndarray  # (SUMS, LANES) float64
    state: np.ndarray  # (3,) int64: queries in it; those that coincide with its last: from, to


@device
def make_batch(count):
    return Batch(
        np.empty(WIDTH, np.int64), np.empty((count, MOMENTS, WIDTH)), np.empty((count, WIDTH)),
        np.empty((count, WIDTH)), np.empty((count, WIDTH, MADE)), np.empty((SUMS, LANES)), np.zeros(3, np.int64),
    )  # fmt: skip


@device
def fill_batch(tree, search, ks, need, surfaces, wanted, scratch, rows, batch):
    """Add queries until the batch is full or none is left; the scratch, to be passed next time."""
    some = any_of(wanted)
    state, order = batch.state, search.order
    state[0] = 0
    while state[0] <= BATCH - LANES:
        n = state[0]
        if state[1] < state[2]:  # queries that coincide with one before, which the last column keeps
            while state[1] < state[2] and n < BATCH:
                copy_query(batch, WIDTH - 1, n, np.int64(order[state[1]]))
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
            found = rows.found[r]
            for j in range(len(ks)):
                last = min(ks[j], found - 1)
                radius = math.sqrt(rows.d2[last, r])
                batch.radius[j, n + r] = radius
                batch.reach[j, n + r] = radius if last == ks[j] else math.inf
            if some:
                sum_surfaces(tree, ks, surfaces, wanted, r, rows, batch)
        state[0] = n + count
        if hi > lo + count:
            state[1], state[2] = lo + count, hi
            copy_query(batch, n, WIDTH - 1, np.int64(order[lo]))
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
def sum_surfaces(tree, ks, surfaces, wanted, r, rows, batch):
    """What the surfaces of one query's neighbors make, where it is wanted."""
    n, found = batch.state[0] + r, rows.found[r]
    at, d2 = rows.at[:, r], rows.d2[:, r]
    own = surfaces[at[0]]
    nx, ny, nz = np.float64(own[NX]), np.float64(own[NY]), np.float64(own[NZ])
    around = 0.0
    if d2[0] > 0.0:  # a query that is no point of the cloud
        t = min(AROUND, found - 1)
        sx = sy = sz = sxx = sxy = sxz = syy = syz = szz = 0.0
        for i in range(t + 1):
            a, b, c = rows.x[i, r], rows.y[i, r], rows.z[i, r]
            sx, sy, sz = sx + a, sy + b, sz + c
            sxx, sxy, sxz = sxx + a * a, sxy + a * b, sxz + a * c
            syy, syz, szz = syy + b * b, syz + b * c, szz + c * c
        nx, ny, nz, _ = surface(t + 1.0, sx, sy, sz, sxx, sxy, sxz, syy, syz, szz)
        around = math.sqrt(d2[t]) if t == AROUND else math.inf
    for j in range(len(ks)):
        if wanted[j]:
            far = agreement(surfaces, at, d2, min(ks[j], found - 1) + 1, nx, ny, nz, batch.made[j, n])
            batch.reach[j, n] = max(batch.reach[j, n], far, around)


@device
def copy_query(batch, source, target, query):
    """Query number `query`, of which the same is true as of another, in column `target`."""
    batch.query[target] = query
    batch.moments[:, :, target] = batch.moments[:, :, source]
    batch.radius[:, target] = batch.radius[:, source]
    batch.reach[:, target] = batch.reach[:, source]
    batch.made[:, target] = batch.made[:, source]


@njit
def nearest_block(
    tree, qx, qy, qz, copies, ks, columns, surfaces, wanted, surface_columns, halo, few, far, out
):  # fmt: skip
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
    surfaces : ndarray of float32, shape (n, surfaces.WIDTH)
        Of the cloud, see :func:`surfaces.surface`; not used where none is wanted.
    wanted : ndarray of bool, shape (s,)
        Which numbers of neighbors are summed up by their surfaces.
    surface_columns : ndarray of int64, shape (s, surfaces.MADE)
        Where in `out` these go; -1: nowhere.
    halo : float
        Meters from a query that count as near.
    few, far : ndarray of int64, shape (s,)
        Raised by the number of queries with fewer than three members, and of those whose result depends on points
        farther than `halo`.
    out : ndarray of float32, shape (m, F)
    """
    need = max(ks[len(ks) - 1], AROUND if any_of(wanted) else 0) + 1
    search, scratch = start_search(qx, qy, qz), make_scratch(CROWD * need + ROOM)
    rows, batch = make_rows(need), make_batch(len(ks))
    volumes, heights, counts = np.empty(BATCH), np.empty(BATCH), np.empty(BATCH, np.int64)
    cloud, kept = lent(tree), lent(surfaces)
    while True:
        scratch = fill_batch(
            cloud, lent(search), ks, need, kept, wanted, scratch, lent(rows), lent(batch)
        )  # fmt: skip
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
            if wanted[j]:
                for f in range(MADE):
                    column = surface_columns[j, f]
                    if column >= 0:
                        for i in range(count):
                            out[batch.query[i], column] = batch.made[j, i, f]


@njit
def surfaces_block(tree, qx, qy, qz, none, out):
    """Surfaces (m, surfaces.WIDTH) float32 of queries, of the AROUND nearest of each; `none` is an empty table of them."""
    ks, unwanted, need = np.array([AROUND]), np.zeros(1, np.bool_), AROUND + 1
    search, scratch = start_search(qx, qy, qz), make_scratch(CROWD * need + ROOM)
    rows, batch = make_rows(need), make_batch(1)
    cloud, kept = lent(tree), lent(none)
    while True:
        scratch = fill_batch(
            cloud, lent(search), ks, need, kept, unwanted, scratch, lent(rows), lent(batch)
        )  # fmt: skip
        count = batch.state[0]
        if count == 0:
            return
        write_surfaces(batch.moments[0], batch.reach[0], batch.query, count, out)
