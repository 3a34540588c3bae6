"""One run of an engine over queries: sorted like the cloud, cut into blocks, computed by threads."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ..base import checks
from ..base.errors import DimensionError, OptionError, StageError
from ..base.progress import Progress
from ..base.threads import map_blocks, resolve_threads
from .index import build_grid, check_xyz
from .plan import FeaturePlan

if TYPE_CHECKING:
    from .engine import FeatureEngine

#: Estimated nanoseconds a block may take on one core: Ctrl-C waits for the blocks in work.
BLOCK_NS = 1.5e8

#: Rows of a block, whatever the memory allows; bytes of a row besides its features, and for each neighborhood.
MOST_ROWS = 16_384
ROW_BYTES, NEIGHBORHOOD_BYTES = 200, 130

#: The queries' own dimensions: (m,) values each, or what gives those of a block's queries, named by their indices.
Given = Mapping[str, npt.ArrayLike] | Callable[[np.ndarray], Mapping[str, np.ndarray]] | None

#: What a block counted: by kind, then by neighborhood.
Tally = dict[str, dict[str, int]]


class Run:
    """One run over queries, sorted like the cloud and cut into blocks; arguments as of ``FeatureEngine.blocks``."""

    def __init__(
        self,
        engine: FeatureEngine,
        queries: npt.ArrayLike | None,
        dimensions: Given,
        threads: int | None,
        memory_mb: float,
    ) -> None:
        self.engine, self.plan = engine, engine.plan
        self.indices, coordinates = _queries(queries, engine.cloud)
        count = len(engine) if coordinates is None else len(coordinates)
        self.dimensions = dimensions if callable(dimensions) else _dimensions(self.plan, dimensions, count)
        self.grid = engine.grid if coordinates is None else build_grid(coordinates, self.plan.cell)
        checks.number("'memory_mb'", memory_mb, 16)
        self.threads = resolve_threads(engine.threads if threads is None else threads)
        #: Sorted queries that are no copies of the one before, and those with which blocks start.
        self.distinct, self.starts = np.zeros(0, np.int64), np.zeros(1, np.int64)
        if not count:
            return
        if not len(engine):
            raise StageError("the cloud has no points", found=f"{count} queries")
        engine.fit()
        self.fixed, self.adaptive = engine.neighborhoods()
        x, y, z = self.grid.x, self.grid.y, self.grid.z
        new = np.ones(count, np.bool_)
        new[1:] = (x[1:] != x[:-1]) | (y[1:] != y[:-1]) | (z[1:] != z[:-1])
        self.distinct = np.append(np.flatnonzero(new), count)
        self._cut(float(memory_mb) * 2**20)

    def _cut(self, budget: float) -> None:
        """Cut the queries into blocks of bounded rows and time; use fewer threads where scratch is large."""
        points = np.diff(self.engine.grid.cell_start).astype(float)
        usual = float(points @ points / points.sum())  # points of the cell that a point lies in
        cost = self.fixed.cost(
            points if self.grid is self.engine.grid else np.full(len(self.grid.cell_ix), usual)
        )
        scratch = float(self.fixed.scratch_bytes(int(usual)))
        if self.adaptive is not None:
            cost = cost + self.adaptive.query_ns
            scratch += self.adaptive.scratch_bytes
        self.threads = int(max(1, min(self.threads, 0.5 * budget // scratch)))
        # Two results per thread may wait (map_blocks) and one is being made; copies of points double a block.
        row = 8 * len(self.plan.names) + ROW_BYTES + NEIGHBORHOOD_BYTES * len(self.plan.neighborhoods)
        rows = min(max((budget - self.threads * scratch) / ((2 * self.threads + 1) * row), 64), MOST_ROWS)
        cells = np.searchsorted(self.distinct, self.grid.cell_start)
        total = float(cost @ np.diff(cells))
        most = min(BLOCK_NS, max(total / (4 * self.threads), 5e6))
        parts = np.append(0.0, np.cumsum(np.maximum(cost / most, 1.0 / rows) * np.diff(cells)))
        inner = np.ceil(np.interp(np.arange(1.0, parts[-1]), parts, cells)).astype(np.int64)
        self.starts = np.unique(np.concatenate(([0], inner, cells[-1:])))

    def compute(self, begin: int, end: int) -> tuple[np.ndarray, np.ndarray, Tally]:
        """Positions (in the user's order) and values of the distinct queries begin..end, and what to report."""
        plan, grid, engine = self.plan, self.grid, self.engine
        at = self.distinct[begin:end]
        first, last = at[0], self.distinct[end]
        copies = np.diff(at, append=last)
        points = grid.x[at], grid.y[at], grid.z[at]
        width = len(plan.names)
        values = np.empty((len(at), width), np.float32)
        few = np.zeros(len(self.fixed), np.int64)
        self.fixed.fill(points, copies, engine.bins, engine.seed, few, values)
        tally: Tally = {"fewer_than_three": dict(zip(self.fixed.tokens, few.tolist(), strict=True))}
        if self.adaptive is not None:
            tokens = self.adaptive.tokens
            few, far = np.zeros(len(tokens), np.int64), np.zeros(len(tokens), np.int64)
            self.adaptive.fill(
                points, copies, engine.bins, engine.seed, engine.copt_threshold, few, far, values
            )
            tally["fewer_than_three"].update(zip(tokens, few.tolist(), strict=True))
            tally["beyond_halo"] = {token: n for token, n in zip(tokens, far.tolist(), strict=True) if n}
        if len(at) < last - first:
            values = np.repeat(values, copies, axis=0)
        positions = grid.order[first:last].astype(np.int64)
        found = self._dimensions_at(positions)
        for column, name in enumerate(plan.dimensions, width - len(plan.dimensions)):
            given = found.get(name)
            values[:, column] = (
                {"X": grid.x, "Y": grid.y, "Z": grid.z}[name][first:last] if given is None else given
            )
        return positions, values, tally

    def _dimensions_at(self, positions: np.ndarray) -> Mapping[str, np.ndarray]:
        if callable(self.dimensions):
            return self.dimensions(positions if self.indices is None else self.indices[positions])
        return {name: values[positions] for name, values in self.dimensions.items()}

    def iterate(
        self,
        compute: Callable[[tuple[int, int]], tuple[np.ndarray, Any, int, Tally]],
        progress: Any,
        count: Callable[[int, Tally], None],
    ) -> Iterator[tuple[np.ndarray, Any]]:
        """Rows and results of the blocks as threads finish them; `count` gets the queries of each, and its tally."""
        blocks = list(zip(self.starts[:-1].tolist(), self.starts[1:].tolist(), strict=True))
        own = Progress(len(self.grid), "features") if progress is True else None
        bar = own if own is not None else progress or None
        try:
            for rows, result, number, tally in map_blocks(compute, blocks, self.threads):
                count(number, tally)
                if bar is not None:
                    bar.update(number)
                yield rows, result
        finally:
            if own is not None:
                own.close()


def _queries(queries, cloud: np.ndarray) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Indices into the cloud (where the queries are such) and coordinates (None: those of the cloud)."""
    if queries is None:
        return None, None
    array = np.asarray(queries)
    if array.ndim == 2:
        return None, check_xyz(array, "queries")
    if array.ndim != 1 or array.dtype.kind not in "iu":
        if array.size == 0 and array.ndim == 1:
            array = array.astype(np.int64)
        else:
            cure = "Use np.flatnonzero(mask)" if array.dtype.kind == "b" else None
            raise OptionError(
                "'queries' must be indices of points or (m, 3) coordinates",
                found=f"dtype {array.dtype}, shape {array.shape}",
                cure=cure,
            )
    array = array.astype(np.int64, copy=False)
    outside = np.count_nonzero((array < 0) | (array >= len(cloud)))
    if outside:
        raise OptionError(f"'queries' has indices outside the cloud of {len(cloud)} points", found=outside)
    return array, cloud[array]


def _dimensions(
    plan: FeaturePlan, given: Mapping[str, npt.ArrayLike] | None, count: int
) -> dict[str, np.ndarray]:
    given = given or {}
    found = {}
    for name in plan.dimensions:
        if name not in given:
            if name in ("X", "Y", "Z"):
                continue
            there = ", ".join(map(str, given)) or "none"
            raise DimensionError(
                f"the dimension '{name}' is needed as a feature but missing",
                found=there,
                cure=f"Give dimensions={{'{name}': values}}, or leave it out of the plan",
            )
        values = np.asarray(given[name])
        if values.shape != (count,) or values.dtype.kind not in "fiub":
            raise DimensionError(
                f"the dimension '{name}' must have one number per query",
                found=f"shape {values.shape}, dtype {values.dtype}, for {count} queries",
            )
        found[name] = values
    return found
