"""Neighborhoods whose size adapts to the points: k nearest, ``kopt``, ``ropt``, ``rdim``, ``copt``.

All are chosen among nested ones, made of a query's neighbors in the order of distance, whose
moments are summed up once. The k nearest are the point and its k nearest: n = k + 1 members, as in
Weinmann et al. 2015. ``kopt`` takes the k, ``ropt`` the radius with the lowest eigenentropy,
``rdim`` the radius with the lowest entropy of dimensionality, ``copt`` either by the curvature
(:mod:`.searches`).

A candidate needs members that do not all coincide: three of them where k is chosen
(``moments.STRUCTURE_MEMBERS``), ten where a radius is (``neighborhoods.RADIUS_MEMBERS``). Where
none qualifies (a lone point, copies of one point) the largest is taken; its eigen-features then say
"no structure". The curvature of a sphere with fewer than ten is 1/3.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..base.jit import device, njit
from ..base.threads import map_blocks
from .moments import COINCIDENT, MOMENTS, STRUCTURE_MEMBERS, M, finish
from .nearest_neighbors import (
    CROWD,
    FIRST2,
    LEAST2,
    MORE,
    ROOM,
    Near,
    Wanted,
    build_tree,
    gather_near,
    make_groups,
    make_near,
    sort_near,
)
from .neighbor_surfaces import COLUMNS, UP, S, agreement
from .neighborhoods import AROUND, RADIUS_MEMBERS
from .plan import FeaturePlan, columns_of
from .point_grid import CellGrid
from .registry import SURFACE_FEATURES
from .scale_selection import (
    add_up,
    eigenvalues_of,
    lowest_dimensionality,
    lowest_entropy,
    write_moments,
)
from .searches import (
    CHOICE,
    CURVATURE_RADIUS,
    SCATTERED,
    Search,
    search_of_curvature,
    search_of_numbers,
    searches_for,
)
from .shape_distributions import Axes, Fitted, NeighborhoodGroup, Shapes, write_shapes

#: For searches that need neither bins nor a threshold.
NOTHING_FITTED = Fitted()

#: Queries computed at a time for a whole cloud; see ``engine.MOST_ROWS``.
CHUNK = 4096


class Results(NamedTuple):
    """Arrays that a search fills."""

    table: np.ndarray  # (numbers, len(M), m) float64: moments of what is chosen
    curvature: np.ndarray  # (m,) float64: curvature of the points where the search is curved
    out: np.ndarray  # (m, F) float32: shapes and features of surfaces


class Surfaces(NamedTuple):
    """Surfaces of the cloud's points, and where features of them go."""

    values: np.ndarray  # (n, S) float32; n = 0 where none are wanted
    columns: np.ndarray  # (neighborhoods, features) int64: columns of the output; -1: not wanted


class AdaptiveNeighborhoods(NeighborhoodGroup):
    """A tree over a grid's cloud, and the adaptive neighborhoods of a plan.

    Prepared once for a grid; the engine calls :meth:`fill` for every block.
    """

    def __init__(self, grid: CellGrid, plan: FeaturePlan, threads: int | None = None) -> None:
        super().__init__([c for c in plan.layout if c.at and not c.neighborhood.fixed])
        self.grid, self.halo_m = grid, plan.halo_m
        self.surface_columns = columns_of(self.chosen, SURFACE_FEATURES)
        self.searches = searches_for([columns.neighborhood for columns in self.chosen])
        self.tree = build_tree(grid.x, grid.y, grid.z, threads)
        self._surfaces = np.zeros((0, len(S)), np.float32)
        if (self.surface_columns >= 0).any():
            self._surfaces = self._make_surfaces(threads)

    def _make_surfaces(self, threads: int | None) -> np.ndarray:
        """Return the surface of every point of the cloud, (n, S) float32."""
        surfaces = np.empty((len(self.grid.order), len(S)), np.float32)
        nearest = search_of_numbers({0: (AROUND, AROUND)})

        def fill_part(part: slice) -> None:
            points, out = self._part(part), surfaces[part]
            (table,) = self.choose(nearest, points)
            few, copies = np.zeros(1, np.int64), np.ones(len(out), np.int64)
            finish(table, 0.0, points[2], few, copies, COLUMNS, out)
            out[:, S.FAR] = table[M.REACH] * UP

        self._for_all(fill_part, threads)
        return surfaces

    def _part(self, part: slice) -> Axes:
        return self.grid.x[part], self.grid.y[part], self.grid.z[part]

    def _for_all(self, function, threads: int | None) -> None:
        parts = [slice(start, start + CHUNK) for start in range(0, len(self.grid.order), CHUNK)]
        for _ in map_blocks(function, parts, threads):
            pass

    def curvatures(self, threads: int | None = None) -> np.ndarray:
        """Return the curvature of the cloud's points, in the order of the grid, (n,) [H17]."""
        curvatures = np.empty(len(self.grid.order))
        search = search_of_curvature()
        self._for_all(
            lambda part: self.choose(search, self._part(part), curvature=curvatures[part]), threads
        )
        return curvatures

    def fill(self, points: Axes, copies, fitted, shapes, out):
        """Compute a block of queries; see :meth:`NeighborhoodGroup.fill`."""
        few, far, reach = np.zeros(len(self), np.int64), {}, 0.0
        for search in self.searches:
            table = self.choose(search, points, fitted, shapes, out)
            for k, rows in zip(search.numbers.tolist(), table, strict=True):
                finish(rows, 0.0, points[2], few[k : k + 1], copies, self.columns[k], out)
                if count := int(copies[rows[M.REACH] > self.halo_m].sum()):
                    far[self.tokens[k]] = count
                reach = max(reach, float(rows[M.REACH].max(initial=0.0)))
        return dict(zip(self.tokens, few.tolist(), strict=True)), far, reach

    def choose(
        self,
        search: Search,
        points: Axes,
        fitted: Fitted = NOTHING_FITTED,
        shapes: Shapes | None = None,
        out: np.ndarray | None = None,
        *,
        curvature: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return moments (numbers, len(M), m) of what is chosen for points.

        Features of shapes and surfaces go to `out`, curvatures to `curvature`, where given.
        """
        m = len(points[0])
        if fitted.copt_threshold is not None:
            search = search._replace(threshold=float(fitted.copt_threshold))
        if curvature is None:
            curvature = np.empty(m if search.curved else 0)
        # Surfaces of neighbors are looked at only where features are written.
        surfaces = self._surfaces[:0] if out is None or search.cap2 < math.inf else self._surfaces
        out = np.empty((m, 0), np.float32) if out is None else out
        results = Results(np.empty((len(search.numbers), len(M), m)), curvature, out)
        adaptive_block(
            self.tree, points, search, Surfaces(surfaces, self.surface_columns), shapes, results
        )
        return results.table


# ---- kernels ---------------------------------------------------------------------------------


class Buffers(NamedTuple):
    """Arrays that are used again for every query."""

    near: Near  # candidates for neighbors, and a query's neighbors in the order of distance
    record: np.ndarray  # (candidates, 4) float32: offsets of members, for shapes
    sums: np.ndarray  # (MOMENTS + 1, choices) float64: moments of each nested neighborhood
    ends: np.ndarray  # (choices,) int64: members of each


@njit
def adaptive_block(tree, points, search, surfaces, shapes, results):
    """Compute moments, shapes and surfaces of the best nested neighborhoods of queries.

    Parameters
    ----------
    tree : KdTree
    points : (x, y, z), (m,) float64 each
    search : Search
    surfaces : Surfaces
    shapes : Shapes or None
        None compiles to a kernel without them.
    results : Results
        Moments about the query, radius, and how far away points matter (infinite where there are
        too few); curvatures; shapes and features of surfaces.
    """
    qx, qy, qz = points
    queries, room = make_groups(qx, qy, qz), CROWD * _wanted(tree, search).need + ROOM
    nested, done = len(search.radii) + len(search.ks), 0
    while done < len(qx):
        near = make_near(room)
        record = np.empty((len(near.x) if shapes is not None else 0, 4), np.float32)
        sums, ends = np.empty((MOMENTS + 1, nested)), np.zeros(nested, np.int64)
        buffers = Buffers(near, record, sums, ends)
        done = _serve_groups(tree, queries, search, surfaces, shapes, results, buffers, done)
        room = 4 * len(near.x)


@device(forceinline=True)
def _wanted(tree, search):
    """Return the neighbors that a search needs."""
    need = min(search.ks[-1] + 1 if len(search.ks) else 0, len(tree.perm))
    return Wanted(need, search.within2, search.cap2)


@device
def _serve_groups(tree, queries, search, surfaces, shapes, results, buffers, done):
    """Serve the queries from order[done] on; return up to where there is room for candidates."""
    wanted, near = _wanted(tree, search), buffers.near
    need, within2, cap2 = wanted.need, wanted.within2, wanted.cap2
    starts, guess = queries.starts, FIRST2
    for group in range(np.searchsorted(starts, done, "right") - 1, len(starts) - 1):
        lo, end = max(starts[group], done), starts[group + 1]
        reach2, farthest2 = min(max(guess, within2), cap2), 0.0
        while lo < end:
            hi, there, reach2 = gather_near(tree, queries, lo, end, wanted, reach2, near)
            if there < 0:
                return lo
            while lo < hi:
                q = queries.order[lo]
                point = queries.x[q], queries.y[q], queries.z[q]
                count = sort_near(near, there, point, wanted, reach2)
                if count < 0:
                    reach2 = min(2.0 * reach2, cap2)
                    break
                lo += 1
                if need and count:
                    farthest2 = max(farthest2, near.sorted[min(count, need) - 1])
                _serve_query(q, point, count, search, surfaces, shapes, results, buffers)
        guess = max(MORE * farthest2, LEAST2)
    return len(queries.x)


@device(forceinline=True)
def _serve_query(q, point, count, search, surfaces, shapes, results, buffers):
    """Choose among the nested neighborhoods of a query, and write what is made of the best."""
    near, record, sums, ends = buffers
    sum_nested(count, point, search, buffers)
    curvature = 0.0
    if search.curved:
        curvature = _curvature(sums, search)
        results.curvature[q] = curvature
    for j in range(len(search.numbers)):
        best = _choose(search, j, curvature, buffers)
        table, number, members = results.table[j], search.numbers[j], ends[best]
        write_moments(sums, best, table, q)
        table[M.RADIUS, q], table[M.REACH, q] = _radius_and_reach(search, j, best, count, buffers)
        if len(surfaces.values):
            columns = surfaces.columns[number]
            beyond = agreement(surfaces.values, near, members, columns, results.out[q])
            table[M.REACH, q] = max(table[M.REACH, q], beyond)
        if shapes is not None and shapes.shaped[number]:
            centroid = _record_members(members, point, best, buffers)
            write_shapes(shapes, number, q, record, members, centroid, results.out)


@device(forceinline=True)
def sum_nested(count, point, search, buffers):
    """Find the members of each nested neighborhood among `count` neighbors, and their moments."""
    near, _, sums, ends = buffers
    radii, ks = search.radii, search.ks
    shells, i = len(radii), 0
    for e in range(shells):
        while i < count and near.sorted[i] <= radii[e] * radii[e]:
            i += 1
        ends[e] = i
    for e in range(len(ks)):
        ends[shells + e] = min(ks[e] + 1, count)
    add_up(near, point, ends, 0, shells, sums)
    add_up(near, point, ends, shells, len(ends), sums)


@device
def _curvature(sums, search):
    """Return the surface variation of the sphere of CURVATURE_RADIUS; 1/3 of too few points."""
    j = 0
    while search.radii[j] < CURVATURE_RADIUS:
        j += 1
    if sums[M.N, j] < RADIUS_MEMBERS:
        return SCATTERED
    l1, l2, l3, spread = eigenvalues_of(sums, j)
    total = l1 + l2 + l3
    return l3 / total if total > COINCIDENT * spread else SCATTERED


@device
def _choose(search, j, curvature, buffers):
    """Return the best nested neighborhood for number `j` of a search."""
    first, end = search.choices[j, CHOICE.first], search.choices[j, CHOICE.end]
    members = search.choices[j, CHOICE.members]
    if search.curved and curvature >= search.threshold:
        first, end, members = len(search.radii), len(buffers.ends), STRUCTURE_MEMBERS
    if search.by_dimensionality:
        return lowest_dimensionality(buffers.sums, first, end, members)
    return lowest_entropy(buffers.sums, first, end, members)


@device(forceinline=True)
def _radius_and_reach(search, j, best, count, buffers):
    """Return the radius of the best neighborhood, and how far away points matter to the choice."""
    near, shells, n = buffers.near, len(search.radii), buffers.ends[best]
    if best < shells:
        return search.radii[best], 0.0
    radius = math.sqrt(near.sorted[n - 1]) if n > 0 else 0.0
    if search.curved:
        return radius, 0.0
    k = search.ks[search.choices[j, CHOICE.end] - 1 - shells]
    return radius, math.sqrt(near.sorted[k]) if k < count else math.inf


@device
def _record_members(count, point, best, buffers):
    """List the offsets of the members from the query for pulls; return their centroid."""
    near, record, sums, _ = buffers
    x, y, z = point
    for i in range(count):
        p = near.pos[i]
        record[i, 0], record[i, 1] = near.x[p] - x, near.y[p] - y
        record[i, 2], record[i, 3] = near.z[p] - z, 0.0
    w = 1.0 / sums[M.N, best]
    gx, gy, gz = sums[M.SX, best] * w, sums[M.SY, best] * w, sums[M.SZ, best] * w
    return np.float32(gx), np.float32(gy), np.float32(gz)
