"""Neighborhoods whose size adapts to the points: k nearest, ``kopt``, ``ropt``, ``rdim``, ``copt``.

All are chosen among nested ones, made of a query's neighbors in the order of distance, whose
moments are summed up once. The k nearest are the point and its k nearest: n = k + 1 members, as in
Weinmann et al. 2015. ``kopt`` takes the k, ``ropt`` the radius with the lowest eigenentropy,
``rdim`` the radius with the lowest entropy of dimensionality. ``copt`` looks at the curvature
(surface variation) of the sphere of 1 m first: where it is at least c_t the point is *scattered*
and takes the best k of 10..50 within 3 m, otherwise it is *regular* and takes the best radius of
0.5..2 m [H17]. The threshold c_t follows from the curvatures of the whole cloud.

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
    Wanted,
    build_tree,
    gather_near,
    make_groups,
    make_near,
    sort_near,
)
from .neighbor_surfaces import COLUMNS, UP, S, agreement
from .neighborhoods import AROUND, COPT_REACH, RADIUS_MEMBERS
from .plan import Columns, FeaturePlan, columns_of
from .point_grid import CellGrid
from .registry import SURFACE_FEATURES, rows_of
from .scale_selection import (
    add_up,
    eigenvalues_of,
    lowest_dimensionality,
    lowest_entropy,
    write_moments,
)
from .shape_distributions import Axes, Fitted, NeighborhoodGroup, Shapes, write_shapes

#: Radius of the sphere whose curvature is looked at, meters [H17]. One of the radii of COPT_RADII:
#: :func:`_curvature` takes it from among them.
CURVATURE_RADIUS = 1.0
#: Curvature of a point with too few neighbors [H17].
SCATTERED = 1.0 / 3.0

#: ``copt``: first and last radius and step of regular points, meters [H17].
COPT_RADII = (0.5, 2.0, 0.05)
#: ``copt``: fewest and most neighbors of scattered points [H17].
COPT_K = (10, 50)

#: For searches that need neither bins nor a threshold.
NOTHING_FITTED = Fitted()

#: Queries computed at a time for a whole cloud; see ``engine.MOST_ROWS``.
CHUNK = 4096

#: Columns of :attr:`Search.choices`: the first candidate among radii and ks, the one behind the
#: last, and the members that a candidate needs.
CHOICE = rows_of("first", "end", "members")


def radii_of(first: float, last: float, step: float) -> np.ndarray:
    """Return the radii first, first + step, ... up to `last`, rounded to nanometers.

    >>> radii_of(0.25, 0.4, 0.05).tolist()
    [0.25, 0.3, 0.35, 0.4]
    """
    count = math.floor((last - first) / step + 1e-9) + 1
    return np.round(first + step * np.arange(count), 9)


def curvature_threshold(curvatures: np.ndarray) -> float:
    """Return the curvature from which on a point is scattered [H17 eq. 1-3].

    ValueError where `curvatures` (n,) are not all finite, or n is 0.

    Two means, started at the smallest and the largest value, give the centers cur1 and cur2 of two
    groups of n1 and n2 = n - n1 values; c_t = cur1 + (cur2 - cur1) n2 / n. Where all values are
    equal that is the value, and all points are scattered, which needs no radius to hold enough
    points.
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


class Search(NamedTuple):
    """Neighborhoods that one search serves, as kernels take them."""

    numbers: np.ndarray  # (n,) int64: which of a plan's
    radii: np.ndarray  # (r,) float64, ascending, meters
    ks: np.ndarray  # (k,) int64: neighbors besides the point itself, ascending
    within2: float  # all points within this squared distance are wanted
    cap2: float  # and of those within this one as many as the last of `ks` says
    choices: np.ndarray  # (n, 3) int64: columns as in CHOICE
    curved: bool = False  # copt: radii where the point is regular, ks where it is scattered
    threshold: float = math.nan  # curvature from which on a point is scattered
    by_dimensionality: bool = False  # rdim: the lowest entropy of dimensionality is taken


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
        self.searches = _searches(self.chosen)
        self.tree = build_tree(grid.x, grid.y, grid.z)
        self._surfaces = np.zeros((0, len(S)), np.float32)
        if (self.surface_columns >= 0).any():
            self._surfaces = self._make_surfaces(threads)

    def _make_surfaces(self, threads: int | None) -> np.ndarray:
        """Return the surface of every point of the cloud, (n, S) float32."""
        surfaces = np.empty((len(self.grid.order), len(S)), np.float32)
        nearest = _by_number({0: (AROUND, AROUND)})

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
        none, radius = np.zeros(0, np.int64), np.array([CURVATURE_RADIUS])
        choices, within2 = np.zeros((0, 3), np.int64), CURVATURE_RADIUS * CURVATURE_RADIUS
        search = Search(none, radius, none, within2, within2, choices, True)
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


def _by_number(ranges: dict[int, tuple[int, int]]) -> Search:
    """Return one search for ranges of numbers of neighbors, by the neighborhood's number."""
    all_ks = {k for first, last in ranges.values() for k in range(first, last + 1)}
    ks = np.array(sorted(all_ks), np.int64)
    choices = [
        [np.searchsorted(ks, first), np.searchsorted(ks, last) + 1, STRUCTURE_MEMBERS]
        for first, last in ranges.values()
    ]
    numbers = np.array(list(ranges), np.int64)
    return Search(numbers, np.zeros(0), ks, 0.0, math.inf, np.array(choices, np.int64))


def _searches(chosen: list[Columns]) -> list[Search]:
    """Return the searches for adaptive neighborhoods: one for all numbers of neighbors first."""
    ranges, searches = {}, []
    for number, columns in enumerate(chosen):
        neighborhood = columns.neighborhood
        if neighborhood.reach is None:
            ranges[number] = int(neighborhood.parameters[0]), int(neighborhood.parameters[-1])
            continue
        radii = radii_of(*(neighborhood.parameters or COPT_RADII))
        within2 = float(radii[-1] * radii[-1])
        choices = np.array([[0, len(radii), RADIUS_MEMBERS]], np.int64)
        ks, numbers = np.zeros(0, np.int64), np.array([number], np.int64)
        search = Search(numbers, radii, ks, within2, within2, choices)
        if neighborhood.kind == "copt":
            ks = np.arange(COPT_K[0], COPT_K[1] + 1)
            search = search._replace(ks=ks, cap2=COPT_REACH * COPT_REACH, curved=True)
        elif neighborhood.kind == "rdim":
            search = search._replace(by_dimensionality=True)
        searches.append(search)
    return ([_by_number(ranges)] if ranges else []) + searches


# ---- kernels ---------------------------------------------------------------------------------


class Scratch(NamedTuple):
    """Arrays that are used again for every query."""

    sums: np.ndarray  # (MOMENTS + 1, candidates) float64
    ends: np.ndarray  # (candidates,) int64: members of each candidate


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
    queries, need = make_groups(qx, qy, qz), _wanted(tree, search).need
    near = make_near(CROWD * need + ROOM)
    candidates = len(search.radii) + len(search.ks)
    scratch = Scratch(np.empty((MOMENTS + 1, candidates)), np.zeros(candidates, np.int64))
    record = np.empty((0, 4), np.float32)
    done = 0
    while True:
        if shapes is not None:
            record = np.empty((len(near.x), 4), np.float32)
        buffers = near, record, scratch
        done = _serve_groups(tree, queries, search, surfaces, shapes, results, buffers, done)
        if done == len(qx):
            return
        near = make_near(4 * len(near.x))


@device(forceinline=True)
def _wanted(tree, search):
    """Return the neighbors that a search needs."""
    need = min(search.ks[-1] + 1 if len(search.ks) else 0, len(tree.perm))
    return Wanted(need, search.within2, search.cap2)


@device
def _serve_groups(tree, queries, search, surfaces, shapes, results, buffers, done):
    """Serve the queries from order[done] on; return up to where there is room for candidates."""
    near, record, scratch = buffers
    wanted = _wanted(tree, search)
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
                sum_candidates(near, count, point, search, scratch)
                if need and count:
                    farthest2 = max(farthest2, near.sorted[min(count, need) - 1])
                if search.curved:
                    results.curvature[q] = _curvature(scratch.sums, search)
                for j in range(len(search.numbers)):
                    best = _choose(
                        search, j, results.curvature[q] if search.curved else 0.0, scratch
                    )
                    _write_reach(near, count, search, (j, best), scratch, results.table[j], q)
                    number, members = search.numbers[j], scratch.ends[best]
                    if len(surfaces.values):
                        columns = surfaces.columns[number]
                        beyond = agreement(surfaces.values, near, members, columns, results.out[q])
                        results.table[j, M.REACH, q] = max(results.table[j, M.REACH, q], beyond)
                    if shapes is not None and shapes.shaped[number]:
                        centroid = _record_members(near, members, point, scratch.sums, best, record)
                        write_shapes(shapes, number, q, record, members, centroid, results.out)
        guess = max(MORE * farthest2, LEAST2)
    return len(queries.x)


@device(forceinline=True)
def sum_candidates(near, count, point, search, scratch):
    """Find the members of each candidate among the first `count` neighbors, and their moments."""
    radii, ks, ends = search.radii, search.ks, scratch.ends
    shells, i = len(radii), 0
    for e in range(shells):
        while i < count and near.sorted[i] <= radii[e] * radii[e]:
            i += 1
        ends[e] = i
    for e in range(len(ks)):
        ends[shells + e] = min(ks[e] + 1, count)
    add_up(near, point, ends, 0, shells, scratch.sums)
    add_up(near, point, ends, shells, len(ends), scratch.sums)


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
def _choose(search, j, curvature, scratch):
    """Return the best candidate for the neighborhood number `j` of a search."""
    first, end = search.choices[j, CHOICE.first], search.choices[j, CHOICE.end]
    members = search.choices[j, CHOICE.members]
    if search.curved and curvature >= search.threshold:
        first, end, members = len(search.radii), len(scratch.ends), STRUCTURE_MEMBERS
    if search.by_dimensionality:
        return lowest_dimensionality(scratch.sums, first, end, members)
    return lowest_entropy(scratch.sums, first, end, members)


@device(forceinline=True)
def _write_reach(near, count, search, choice, scratch, table, q):
    """Write moments and radius of the chosen candidate, and how far away points matter to it."""
    j, best = choice
    shells, n = len(search.radii), scratch.ends[best]
    write_moments(scratch.sums, best, table, q)
    table[M.REACH, q] = 0.0
    if best < shells:
        table[M.RADIUS, q] = search.radii[best]
        return
    table[M.RADIUS, q] = math.sqrt(near.sorted[n - 1]) if n > 0 else 0.0
    if not search.curved:
        k = search.ks[search.choices[j, CHOICE.end] - 1 - shells]
        table[M.REACH, q] = math.sqrt(near.sorted[k]) if k < count else math.inf


@device
def _record_members(near, count, point, sums, best, record):
    """List the offsets of the members from the query for pulls; return their centroid."""
    x, y, z = point
    for i in range(count):
        p = near.pos[i]
        record[i, 0], record[i, 1] = near.x[p] - x, near.y[p] - y
        record[i, 2], record[i, 3] = near.z[p] - z, 0.0
    w = 1.0 / sums[M.N, best]
    gx, gy, gz = sums[M.SX, best] * w, sums[M.SY, best] * w, sums[M.SZ, best] * w
    return np.float32(gx), np.float32(gy), np.float32(gz)
