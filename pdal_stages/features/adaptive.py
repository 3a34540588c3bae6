"""All neighborhoods of a plan whose size adapts to the points: k nearest, kopt, ropt, copt.

The counterpart of ``fixed.FixedRadius``: prepared once for a grid, called by the engine for every block.
"""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass

import numpy as np

from ..base.jit import njit
from ..base.threads import map_blocks
from .bins import ShapeBins
from .index import CellGrid
from .kdtree import KdTree, build_tree
from .moments import BATCH, FEATURES, MOMENTS, WIDTH, finish
from .names import MOMENT_FEATURES, SHAPE_FEATURES, SURFACES
from .nearest import agreement_block, nearest_block, store_surfaces, surfaces_block
from .neighborhoods import AROUND, LEAST_RADIUS
from .optimal import kopt_block
from .plan import Columns, FeaturePlan
from .ropt import COPT_RADII, copt_block, curvature_block, radii_of, ropt_block
from .shapes import Shapes, count_shapes, list_shapes, no_shapes, point_seeds
from .surfaces import WIDTH as SURFACE

#: Queries computed at a time when curvatures of a whole cloud are.
CHUNK = 16_384

#: Estimated cost of one query on one core, nanoseconds, to cut blocks of about equal time.
NS_QUERY = {"knn": 2000.0, "kopt": 4500.0, "ropt": 3500.0, "copt": 5500.0}
NS_SHAPES = 2000.0
NS_SURFACES = 200.0

Point = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class _Spec:
    token: str
    kind: str
    parameters: tuple[float, ...]
    columns: np.ndarray  # (13,) int64: of the moment features and Radius, or -1
    shape_columns: np.ndarray  # (50,) int64, or -1
    surface_columns: np.ndarray  # (4,) int64, or -1
    shaped: bool
    surfaced: bool
    unbounded: bool


class AdaptiveNeighborhoods:
    """A tree over a grid's cloud, built by `threads`, and the adaptive neighborhoods of a plan."""

    def __init__(self, grid: CellGrid, plan: FeaturePlan, threads: int | None = None) -> None:
        self.grid, self.halo_m, self.least = grid, plan.halo_m, plan.least_members
        fixed = ("cylinder", "sphere")
        self.specs = [_spec(c) for c in plan.layout if c.at and c.neighborhood.kind not in fixed]
        #: In the plan's order: what `few` and `far` of :meth:`fill` count for.
        self.tokens = [spec.token for spec in self.specs]
        #: Estimated cost of one query, and memory of one call of :meth:`fill` besides its rows.
        self.query_ns = sum(
            NS_QUERY[s.kind] * _load(s) + NS_SHAPES * s.shaped + NS_SURFACES * s.surfaced for s in self.specs
        )
        largest = max((s.parameters[-1] for s in self.specs if s.parameters), default=0.0)
        self.scratch_bytes = 2_000_000 + int(500 * largest)
        nearest = [
            n
            for n, spec in enumerate(self.specs)
            if spec.kind == "knn" and (spec.surfaced or not spec.shaped)
        ]
        nearest.sort(key=lambda n: self.specs[n].parameters[0])
        #: Places in `specs` of nearest neighbors, which one search of the largest k serves; where shapes are wanted too,
        #: for their surfaces alone.
        self._nearest = nearest
        self._tree: KdTree | None = None
        #: Surfaces of the cloud's points, in the order of the grid, and which of them are there; under the lock.
        count = len(grid) if any(spec.surfaced for spec in self.specs) else 0
        self._surfaces, self._known = np.empty((count, SURFACE), np.float32), np.zeros(count, np.uint8)
        self._lock = threading.Lock()
        if len(grid):
            self._tree = build_tree(grid.x, grid.y, grid.z, lambda f, b: list(map_blocks(f, b, threads)))
            self._touch(len(plan.names))

    def __len__(self) -> int:
        return len(self.specs)

    def _touch(self, columns: int) -> None:
        """Compile what the plan, of so many columns, needs, on one point, before threads do."""
        one = self.grid.x[:1], self.grid.y[:1], self.grid.z[:1]
        copies, counted = np.ones(1, np.int64), np.zeros((2, len(self.specs)), np.int64)
        out = np.zeros((1, columns), np.float32)
        if self._nearest:
            self._fill_nearest(*one, copies, counted[0], counted[1], out)
            self._surfaces_of(np.zeros(len(self._known[:1]), np.uint32))
        for number, spec in enumerate(self.specs):
            if number in self._nearest and not spec.shaped:
                continue
            shapes = count_shapes(np.zeros((5, 9)), 1) if spec.shaped else no_shapes()
            table, radius, _ = self._compute(spec, *one, 0, 0.0, shapes)
            if number not in self._nearest:
                nowhere = np.full(len(spec.columns), -1, np.int64)
                write_columns(table, radius, one[2], np.zeros(1, np.int64), copies, nowhere, out)

    def curvatures(self, threads: int | None = None) -> np.ndarray:
        """The curvature of every point of the cloud, in the order of the grid, (n,) float64 [H17]."""
        grid = self.grid
        curvatures = np.empty(len(grid))

        def compute(start: int) -> None:
            part = slice(start, start + CHUNK)
            x, y, z = grid.x[part], grid.y[part], grid.z[part]
            curvature_block(self._tree, x, y, z, self.least, no_shapes(), curvatures[part])

        for _ in map_blocks(compute, range(0, len(grid), CHUNK), threads):
            pass
        return curvatures

    def shape_values(self, token: str, points: Point, seed: int, copt_threshold: float | None) -> np.ndarray:
        """Metrics of all pulls of a neighborhood for a few points, (m, 5, 255) float32, comparable."""
        spec = self.specs[self.tokens.index(token)]
        shapes = list_shapes(len(points[0]))
        self._compute(spec, *points, seed, copt_threshold, shapes)
        return shapes.values

    def fill(
        self,
        qx: np.ndarray,
        qy: np.ndarray,
        qz: np.ndarray,
        copies: np.ndarray,
        bins: ShapeBins | None,
        seed: int,
        copt_threshold: float | None,
        few: np.ndarray,
        far: np.ndarray,
        out: np.ndarray,
    ) -> None:
        """Compute the columns of these neighborhoods in `out` (m, F) for a block of queries, neighbors at best.

        Each query stands for so many `copies` of the user's. `bins` are needed where shapes are wanted, the threshold for
        copt. For each neighborhood, `few` is raised by the number of queries with fewer than three points, and `far` by
        that of queries whose result depends on points farther than the plan's halo.
        """
        if self._nearest:
            self._fill_nearest(qx, qy, qz, copies, few, far, out)
        for number, spec in enumerate(self.specs):
            done = number in self._nearest
            if done and not spec.shaped:
                continue
            if spec.shaped:
                assert bins is not None
                shapes = count_shapes(bins.comparable([spec.token])[0], len(qx))
            else:
                shapes = no_shapes()
            table, radius, reach = self._compute(spec, qx, qy, qz, seed, copt_threshold, shapes)
            if not done:
                write_columns(table, radius, qz, few[number : number + 1], copies, spec.columns, out)
            if spec.shaped:
                wanted = spec.shape_columns >= 0
                out[:, spec.shape_columns[wanted]] = shapes.counts[:, wanted]
            if spec.unbounded and not done:
                far[number] += int(copies[reach > self.halo_m].sum())

    def _fill_nearest(
        self,
        qx: np.ndarray,
        qy: np.ndarray,
        qz: np.ndarray,
        copies: np.ndarray,
        few: np.ndarray,
        far: np.ndarray,
        out: np.ndarray,
    ) -> None:
        """What :meth:`fill` does, for all of ``_nearest``; of shaped ones all but their shapes."""
        specs = [self.specs[number] for number in self._nearest]
        mine = [int(spec.parameters[0]) for spec in specs]
        surfaced = [n for n, spec in enumerate(specs) if spec.surfaced]
        ks = np.array(sorted({*mine, AROUND} if surfaced else mine), np.int64)
        place = np.searchsorted(ks, mine)
        columns = np.full((len(ks), FEATURES), -1, np.int64)
        columns[place] = [spec.columns[:FEATURES] for spec in specs]
        most = min(max((mine[n] + 1 for n in surfaced), default=0), len(self.grid))
        near, own = np.empty((len(qx), most), np.uint32), np.empty((len(qx), SURFACE))
        counted = np.zeros((2, len(ks)), np.int64)
        nearest_block(
            self._tree, qx, qy, qz, copies, ks, columns, self.halo_m, near, own, counted[0], counted[1], out
        )
        few[self._nearest] += counted[0, place]
        reached = counted[1, place]
        if surfaced:
            with self._lock:  # what others have written is seen behind it
                missing = store_surfaces(near, own, self._surfaces, self._known)
            self._surfaces_of(missing)
            wanted = np.array(surfaced)
            agree = np.zeros(len(wanted), np.int64)
            agreement_block(
                self._tree, qx, qy, qz, copies, np.array(mine, np.int64)[wanted],
                np.stack([specs[n].surface_columns for n in surfaced]), self.halo_m, near, own, self._surfaces,
                agree, out,
            )  # fmt: skip
            reached[wanted] = agree
        far[self._nearest] += reached

    def _surfaces_of(self, missing: np.ndarray) -> None:
        """Put the surfaces of some points, which may be made elsewhere at the same time, into the table."""
        if not len(missing):
            return
        found = np.empty((len(missing), SURFACE))
        surfaces_block(
            self._tree, *(axis[missing] for axis in (self.grid.x, self.grid.y, self.grid.z)), found
        )
        with self._lock:
            self._surfaces[missing] = found
            self._known[missing] = 1

    def _compute(
        self,
        spec: _Spec,
        qx: np.ndarray,
        qy: np.ndarray,
        qz: np.ndarray,
        seed: int,
        threshold: float | None,
        shapes: Shapes,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Moments (12, m), radii (m,) and reaches (m,); shapes go where `shapes` says."""
        m = len(qx)
        table, radius, reach = np.empty((MOMENTS, m)), np.empty(m), np.zeros(m)
        seeds = point_seeds(qx, qy, qz, seed, spec.token) if spec.shaped else np.zeros(0, np.uint64)
        if spec.kind in ("knn", "kopt"):
            k_min, k_max = int(spec.parameters[0]), int(spec.parameters[-1])
            kopt_block(self._tree, qx, qy, qz, k_min, k_max, math.inf, table, radius, reach, seeds, shapes)
        elif spec.kind == "ropt":
            radii = radii_of(*spec.parameters)
            ropt_block(self._tree, qx, qy, qz, radii, self.least, table, radius, seeds, shapes)
        else:
            assert threshold is not None
            copt_block(
                self._tree, qx, qy, qz, threshold, radii_of(*COPT_RADII), self.least, table, radius, seeds, shapes,
                no_shapes(),
            )  # fmt: skip
        return table, radius, reach


@njit
def write_columns(table, radius, heights, few, copies, columns, out):
    """Write the features of neighborhoods with individual radii from their moments.

    Parameters
    ----------
    table : (12, m) float64 array
        Moments about the queries.
    radius, heights : (m,) float64 arrays
        Of the neighborhoods, and z of the queries.
    few : (1,) int64 array
        Raised by the number of queries with fewer than three members.
    copies : (m,) int64 array
    columns : (14,) int64 array
        Where in `out` each feature of ``moments.finish`` goes, and the radius; -1: nowhere.
    out : (m, F) float32 array
    """
    volumes, moments = np.empty(BATCH), np.empty((MOMENTS, WIDTH))
    for start in range(0, len(radius), BATCH):
        count = min(BATCH, len(radius) - start)
        for j in range(count):
            r = max(radius[start + j], LEAST_RADIUS)
            volumes[j] = 4.0 / 3.0 * math.pi * r * r * r
            for row in range(MOMENTS):
                moments[row, j] = table[row, start + j]
        part = slice(start, start + count)
        values = finish(moments, count, volumes, 0.0, heights[part], few, copies[part])
        for f in range(FEATURES):
            if columns[f] >= 0:
                for j in range(count):
                    out[start + j, columns[f]] = values[f, j]
        if columns[FEATURES] >= 0:
            for j in range(count):
                out[start + j, columns[FEATURES]] = radius[start + j]


def _spec(columns: Columns) -> _Spec:
    one = columns.neighborhood

    def at(names) -> np.ndarray:
        return np.array([columns.at.get(name, -1) for name in names], np.int64)

    moments, shapes = at((*MOMENT_FEATURES, "Radius")), at(SHAPE_FEATURES)
    surfaces, unbounded = at(SURFACES), one.reach is None
    surfaced = bool((surfaces >= 0).any())
    return _Spec(
        one.token, one.kind, one.parameters, moments, shapes, surfaces, columns.shapes, surfaced, unbounded
    )


def _load(spec: _Spec) -> float:
    """Cost relative to the usual parameters: neighbors, or the area of the largest radius."""
    if spec.kind in ("knn", "kopt"):
        return max(spec.parameters[-1], 20.0) / 100.0
    return max(spec.parameters[1] / 2.0, 0.5) ** 2 if spec.kind == "ropt" else 1.0
