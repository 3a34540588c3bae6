"""Neighborhoods whose size adapts to the points: the k nearest, ``kopt``, ``ropt``, ``rdim`` and ``copt``.

All are chosen among nested ones, made of a query's neighbors in the order of distance, whose
moments are summed up once. The k nearest are the point and its k nearest: n = k + 1 members, as in
Weinmann et al. 2015. ``kopt`` takes the k, ``ropt`` the radius with the lowest eigenentropy,
``rdim`` the radius with the lowest entropy of dimensionality. ``copt`` looks at the curvature
(surface variation) of the sphere of 1 m first: where it is at least c_t the point is *scattered*
and takes the best k of 10..50 within 3 m, otherwise it is *regular* and takes the best radius of
0.5..2 m [H17]. The threshold c_t follows from the curvatures of the whole cloud.

A candidate needs members that do not all coincide, three of them, among radii
``neighborhoods.LEAST_MEMBERS``. Where none qualifies (a lone point, copies of one point) the
largest is taken; its eigen-features then say "no structure". The curvature of a sphere with fewer
is 1/3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ..base.jit import device, njit
from ..base.threads import map_blocks
from .kdtree import build_tree
from .moments import COINCIDENT, MOMENTS, RADIUS, REACH, ROWS, SX, SY, SZ, N, finish
from .nearest_neighbors import (
    CROWD,
    FIRST2,
    LEAST2,
    MORE,
    ROOM,
    gather_near,
    make_groups,
    make_near,
    sort_near,
)
from .neighbor_surfaces import COLUMNS, FAR, SURFACE, UP, agreement
from .neighborhoods import AROUND, COPT_REACH
from .plan import Columns, FeaturePlan, columns_of
from .point_grid import CellGrid
from .registry import MOMENT_FEATURES, SURFACE_FEATURES
from .scale_selection import (
    add_up,
    eigenvalues_of,
    lowest_dimensionality,
    lowest_entropy,
    write_moments,
)
from .shape_bins import ShapeBins
from .shape_distributions import Axes, shapes_of, write_shapes

#: Members of a candidate among numbers of neighbors.
LEAST = 3

#: Radius of the sphere whose curvature is looked at, meters, and curvature where too few neighbors
#: tell [H17].
CURVATURE_RADIUS, SCATTERED = 1.0, 1.0 / 3.0

#: ``copt``: first and last radius and step of regular points, meters; fewest and most neighbors of
#: scattered ones [H17].
COPT_RADII = (0.5, 2.0, 0.05)
COPT_K = (10, 50)

#: Queries computed at a time for a whole cloud.
CHUNK = 4096


def radii_of(first: float, last: float, step: float) -> np.ndarray:
    """The radii first, first + step, ... up to `last`, rounded to nanometers.

    >>> radii_of(0.25, 0.4, 0.05).tolist()
    [0.25, 0.3, 0.35, 0.4]
    """
    count = math.floor((last - first) / step + 1e-9) + 1
    return np.round(first + step * np.arange(count), 9)


def curvature_threshold(curvatures: np.ndarray) -> float:
    """The curvature from which on a point is scattered [H17 eq. 1-3]; ValueError where there is no finite value (n,).

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


@dataclass(frozen=True)
class Search:
    """Neighborhoods that one search serves."""

    numbers: tuple[int, ...]  # which of a plan's
    radii: np.ndarray  # ascending, meters
    ks: np.ndarray  # neighbors besides the point itself, ascending
    within2: float  # all points within this squared distance are wanted
    cap2: float  # and of those within this one as many as the last of `ks` says
    # (numbers, 4) int64: first and end of the candidates among radii and ks, members they need, and
    # 1 where the entropy of dimensionality chooses, 0 where the eigenentropy does
    choices: np.ndarray
    curved: bool = False  # copt: radii where it is regular


class AdaptiveNeighborhoods:
    """A tree over a grid's cloud, built by `threads`, and the adaptive neighborhoods of a plan.

    Prepared once for a grid; the engine calls :meth:`fill` for every block.
    """

    def __init__(self, grid: CellGrid, plan: FeaturePlan, threads: int | None = None) -> None:
        self.grid, self.halo_m = grid, plan.halo_m
        fixed = ("cylinder", "sphere")
        self.chosen = [c for c in plan.layout if c.at and c.neighborhood.kind not in fixed]
        self.shaped = any(c.shapes for c in self.chosen)
        #: In the plan's order: what `few` and `far` of :meth:`fill` count for.
        self.tokens = [c.neighborhood.token for c in self.chosen]
        self.columns = columns_of(self.chosen, MOMENT_FEATURES)
        self.surface_columns = columns_of(self.chosen, SURFACE_FEATURES)
        self.searches = _searches(self.chosen, plan.least_members)
        self.tree = build_tree(grid.x, grid.y, grid.z, threads)
        self._surfaces = np.zeros((0, SURFACE), np.float32)
        if (self.surface_columns >= 0).any():
            self._surfaces = np.empty((len(grid), SURFACE), np.float32)
            around = _by_number({0: (AROUND, AROUND)}, False)

            def surfaces(part: slice) -> None:
                points, made = self._part(part), self._surfaces[part]
                (table,) = self.choose(around, points)
                finish(
                    table,
                    0.0,
                    points[2],
                    np.zeros(1, np.int64),
                    np.ones(len(made), np.int64),
                    COLUMNS,
                    made,
                )
                made[:, FAR] = table[REACH] * UP

            self._for_all(surfaces, threads)

    def __len__(self) -> int:
        return len(self.chosen)

    def _part(self, part: slice) -> Axes:
        return self.grid.x[part], self.grid.y[part], self.grid.z[part]

    def _for_all(self, function, threads: int | None) -> None:
        parts = [slice(start, start + CHUNK) for start in range(0, len(self.grid), CHUNK)]
        for _ in map_blocks(function, parts, threads):
            pass

    def curvatures(self, least: int, threads: int | None = None) -> np.ndarray:
        """The curvature of every point of the cloud, in the order of the grid, (n,) float64 [H17]."""
        curvatures = np.empty(len(self.grid))
        radius = np.array([CURVATURE_RADIUS])
        search = Search(
            (), radius, np.zeros(0, np.int64), 1.0, 1.0, np.zeros((0, 4), np.int64), True
        )
        self._for_all(
            lambda part: self.choose(
                search, self._part(part), least=least, curvature=curvatures[part]
            ),
            threads,
        )
        return curvatures

    def shape_values(
        self, points: Axes, seed: int, copt_threshold: float | None
    ) -> dict[str, np.ndarray]:
        """By neighborhood the metrics of all pulls round a few points, (m, 5, 255) float32, comparable."""
        if not self.shaped:
            return {}
        shapes = shapes_of(self.chosen, points, seed, None)
        for search in self.searches:
            self.choose(search, points, copt_threshold, shapes)
        return {
            c.neighborhood.token: shapes.values[k] for k, c in enumerate(self.chosen) if c.shapes
        }

    def fill(
        self,
        points: Axes,
        copies: np.ndarray,
        bins: ShapeBins | None,
        seed: int,
        copt_threshold: float | None,
        few: np.ndarray,
        far: np.ndarray,
        out: np.ndarray,
    ) -> float:
        """Compute the columns of these neighborhoods in `out` (m, F) for a block of queries, neighbors at best.

        Each query stands for so many `copies` of the user's. `bins` are needed where shapes are
        wanted, the threshold for copt. For each neighborhood, `few` is raised by the number of
        queries with fewer than three points, and `far` by that of queries whose result depends on
        points farther than the plan's halo. How far the farthest of all lie is returned, meters.
        """
        reach = 0.0
        shapes = shapes_of(self.chosen, points, seed, bins) if self.shaped else None
        for search in self.searches:
            table = self.choose(search, points, copt_threshold, shapes, out)
            for number, rows in zip(search.numbers, table, strict=True):
                finish(
                    rows,
                    0.0,
                    points[2],
                    few[number : number + 1],
                    copies,
                    self.columns[number],
                    out,
                )
                far[number] += int(copies[rows[REACH] > self.halo_m].sum())
                reach = max(reach, float(rows[REACH].max(initial=0.0)))
        return reach

    def choose(
        self,
        search: Search,
        points: Axes,
        threshold=None,
        shapes=None,
        out=None,
        *,
        least=0,
        curvature=None,
    ) -> np.ndarray:
        """Moments (numbers, ROWS, m) of what is chosen; shapes, surfaces and curvatures go where arguments say."""
        m = len(points[0])
        numbers = np.array(search.numbers, np.int64)
        table = np.empty((len(numbers), ROWS, m))
        curvature = np.empty(m if search.curved else 0) if curvature is None else curvature
        least = int(search.choices[0, 2]) if len(numbers) else least
        # Surfaces of neighbors are looked at only where features are written, by a search that
        # finds AROUND of them.
        looked = out is not None and len(numbers) > 0 and search.cap2 == math.inf
        surfaces = self._surfaces if looked else self._surfaces[:0]
        out = np.empty((m, 0), np.float32) if out is None else out
        adaptive_block(
            self.tree, *points, numbers, search.radii, search.ks, search.within2, search.cap2, search.choices,
            search.curved, least, math.nan if threshold is None else threshold, surfaces,
            self.surface_columns, shapes, table, curvature, out,
        )  # fmt: skip
        return table


def _by_number(ranges: dict[int, tuple[int, int]], around: bool) -> Search:
    """One search for several ranges of numbers of neighbors, by the neighborhood's number, and `around` a point."""
    all_ks = {k for first, last in ranges.values() for k in range(first, last + 1)}
    ks = np.array(sorted(all_ks | ({AROUND} if around else set())), np.int64)
    choices = [
        [np.searchsorted(ks, first), np.searchsorted(ks, last) + 1, LEAST, 0]
        for first, last in ranges.values()
    ]
    return Search(
        tuple(ranges), np.zeros(0), ks, 0.0, math.inf, np.array(choices, np.int64).reshape(-1, 4)
    )


def _searches(chosen: list[Columns], least: int) -> list[Search]:
    ranges, found = {}, []
    for number, columns in enumerate(chosen):
        one = columns.neighborhood
        if one.reach is None:
            ranges[number] = int(one.parameters[0]), int(one.parameters[-1])
            continue
        radii = radii_of(*(one.parameters or COPT_RADII))
        within2 = float(radii[-1] * radii[-1])
        choices = np.array([[0, len(radii), least, one.kind == "rdim"]], np.int64)
        search = Search((number,), radii, np.zeros(0, np.int64), within2, within2, choices)
        if one.kind == "copt":
            ks = np.arange(COPT_K[0], COPT_K[1] + 1)
            search = replace(search, ks=ks, cap2=COPT_REACH * COPT_REACH, curved=True)
        found.append(search)
    around = any(name in columns.at for columns in chosen for name in SURFACE_FEATURES)
    return ([_by_number(ranges, around)] if ranges else []) + found


@njit
def adaptive_block(
    tree, qx, qy, qz, numbers, radii, ks, within2, cap2, choices, curved, least, threshold, surfaces,
    surface_columns, shapes, table, curvature, out,
):  # fmt: skip
    """Moments, shapes and surfaces of the best nested neighborhoods of a block of queries.

    Parameters
    ----------
    tree : KdTree
    qx, qy, qz : (m,) float64 arrays
    numbers, radii, ks, within2, cap2, choices, curved
        See :class:`Search`.
    least, threshold : int, float
        Members a sphere needs to have a curvature, and the curvature from which on a point is
        scattered.
    surfaces : (n, SURFACE) float32 array
        Of the cloud's points, n = 0 where none are wanted.
    surface_columns : (k, 4) int64 array
        Where in `out` (m, F) what surfaces make goes; -1: nowhere.
    shapes : Shapes or None
        None compiles to a kernel without them.
    table : (numbers, ROWS, m) float64 array
        Out: moments about the query, radius, and how far away points matter, infinite where there
        are too few.
    curvature : (m,) float64 array
        Out: the curvature where `curved`.
    """
    order, starts = make_groups(qx, qy, qz)
    need = min(ks[-1] + 1 if len(ks) else 0, len(tree.perm))
    near, s = make_near(CROWD * need + ROOM), np.empty((MOMENTS + 1, len(radii) + len(ks)))
    ends, record = np.zeros(len(radii) + len(ks), np.int64), np.empty((0, 4), np.float32)
    # What finish takes for one query (a constant's type would have it compiled once more).
    alone = (
        np.empty((1, SURFACE), np.float32),
        np.empty((ROWS, 1)),
        np.zeros(1, np.int64),
        COLUMNS.copy(),
    )
    done = 0
    while True:
        if shapes is not None:
            record = np.empty((len(near.x), 4), np.float32)
        done = _adaptive(
            tree, qx, qy, qz, numbers, radii, ks, within2, cap2, choices, curved, least, threshold, surfaces,
            surface_columns, shapes, table, curvature, out,
            order, starts, done, need, near, s, ends, record, alone,
        )  # fmt: skip
        if done == len(qx):
            return
        near = make_near(4 * len(near.x))


@device
def _adaptive(
    tree, qx, qy, qz, numbers, radii, ks, within2, cap2, choices, curved, least, threshold, surfaces,
    surface_columns, shapes, table, curvature, out,
    order, starts, done, need, near, s, ends, record, alone,
):  # fmt: skip
    """:func:`adaptive_block` from the query order[done] on, and up to where `near` has no room for the candidates."""
    shells, count, around = len(radii), len(ends), 0
    own, single, none, columns = alone
    for e in range(len(ks)):
        around = e if ks[e] == AROUND else around
    guess = FIRST2
    for group in range(np.searchsorted(starts, done, "right") - 1, len(starts) - 1):
        lo, end = max(starts[group], done), starts[group + 1]
        reach2, farthest2 = min(max(guess, within2), cap2), 0.0
        while lo < end:
            hi, there, reach2 = gather_near(
                tree, qx, qy, qz, order, lo, end, need, within2, cap2, reach2, near
            )
            if there < 0:
                return lo
            while lo < hi:
                q = order[lo]
                x, y, z = qx[q], qy[q], qz[q]
                found = sort_near(near, there, x, y, z, need, within2, cap2, reach2)
                if found < 0:
                    reach2 = min(2.0 * reach2, cap2)
                    break
                lo += 1
                i = 0
                for e in range(shells):
                    while i < found and near.sorted[i] <= radii[e] * radii[e]:
                        i += 1
                    ends[e] = i
                for e in range(len(ks)):
                    ends[shells + e] = min(ks[e] + 1, found)
                add_up(near, x, y, z, ends, 0, shells, s)
                add_up(near, x, y, z, ends, shells, count, s)
                farthest2 = max(
                    farthest2, near.sorted[min(found, need) - 1] if need and found else 0.0
                )
                if curved:
                    at = 0
                    while radii[at] < CURVATURE_RADIUS:
                        at += 1
                    curvature[q] = curvature_of(s, at, least)
                if len(surfaces):
                    if near.sorted[0] == 0.0:
                        for f in range(SURFACE):
                            own[0, f] = surfaces[near.at[near.pos[0]], f]
                    else:  # no point of the cloud
                        write_moments(s, shells + around, single, 0)
                        finish(single, 1.0, qz[q : q + 1], none, none, columns, own)
                        own[0, FAR] = (
                            math.sqrt(near.sorted[AROUND]) * UP if found > AROUND else math.inf
                        )
                for j in range(len(numbers)):
                    first, last, members = choices[j, 0], choices[j, 1], choices[j, 2]
                    if curved and curvature[q] >= threshold:
                        first, last, members = shells, count, LEAST
                    if choices[j, 3]:
                        best = lowest_dimensionality(s, first, last, members)
                    else:
                        best = lowest_entropy(s, first, last, members)
                    n = ends[best]
                    write_moments(s, best, table[j], q)
                    reach = 0.0
                    if best < shells:
                        table[j, RADIUS, q] = radii[best]
                    else:
                        table[j, RADIUS, q] = math.sqrt(near.sorted[n - 1]) if n > 0 else 0.0
                        k = ks[last - 1 - shells]
                        reach = math.sqrt(near.sorted[k]) if k < found else math.inf
                    if len(surfaces):
                        beyond = agreement(
                            surfaces, near, n, own[0], surface_columns[numbers[j]], out[q]
                        )
                        reach = max(reach, beyond)
                    table[j, REACH, q] = 0.0 if curved else reach
                    if shapes is not None and shapes.shaped[numbers[j]]:
                        for i in range(n):
                            p = near.pos[i]
                            record[i, 0], record[i, 1] = near.x[p] - x, near.y[p] - y
                            record[i, 2], record[i, 3] = near.z[p] - z, 0.0
                        w = 1.0 / s[N, best]
                        gx, gy, gz = s[SX, best] * w, s[SY, best] * w, s[SZ, best] * w
                        center = np.float32(gx), np.float32(gy), np.float32(gz)
                        write_shapes(shapes, numbers[j], q, record, n, *center, out)
        guess = max(MORE * farthest2, LEAST2)
    return len(qx)


@device
def curvature_of(s, j, least):
    """Surface variation of the sums `j`; 1/3 for fewer than `least` or coinciding points."""
    if s[N, j] < least:
        return SCATTERED
    l1, l2, l3, spread = eigenvalues_of(s, j)
    total = l1 + l2 + l3
    return l3 / total if total > COINCIDENT * spread else SCATTERED
