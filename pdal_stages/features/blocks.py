"""One run of an engine over queries: sorted like the cloud, cut into blocks, computed by threads."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ..base import checks
from ..base.errors import DimensionError, OptionError, StageError
from ..base.lazycolumns import as_column
from ..base.progress import Progress
from ..base.threads import map_blocks, resolve_threads
from .index import CellGrid, build_grid, check_xyz, cut_blocks
from .plan import FeaturePlan

if TYPE_CHECKING:
    from .adaptive import AdaptiveNeighborhoods
    from .bins import ShapeBins
    from .fixed import FixedRadius

#: Estimated nanoseconds a block may take on one core: Ctrl-C waits for the blocks in work.
BLOCK_NS = 1.5e8

#: Rows of a block, whatever the memory allows; bytes of a row besides its features.
MOST_ROWS = 65_536
ROW_BYTES = 1_000


#: The queries' own dimensions: (m,) values each, or what gives those of a block's queries, named by their indices.
Given = Mapping[str, npt.ArrayLike] | Callable[[np.ndarray], Mapping[str, np.ndarray]] | None

#: What a block counted: by kind, then by neighborhood.
Tally = dict[str, dict[str, int]]


@dataclass(frozen=True)
class Fitted:
    """What features are computed with: the neighborhoods of a cloud, and what was fitted or given."""

    fixed: FixedRadius
    adaptive: AdaptiveNeighborhoods | None
    bins: ShapeBins | None
    copt_threshold: float | None
    seed: int


class Run:
    """One run over queries: sorted like the cloud, cut into blocks.

    `grid` is the index of the `cloud`; `fit` gives what was fitted, and is called once the queries are found to be right;
    all else is as for ``FeatureEngine.blocks``.
    """

    def __init__(
        self,
        plan: FeaturePlan,
        cloud: np.ndarray,
        grid: CellGrid,
        fit: Callable[[], Fitted],
        queries: npt.ArrayLike | None,
        dimensions: Given,
        threads: int | None,
        memory_mb: float,
    ) -> None:
        self.plan = plan
        self.indices, coordinates = _queries(queries, cloud)
        count = len(grid) if coordinates is None else len(coordinates)
        self.dimensions = dimensions if callable(dimensions) else _dimensions(plan, dimensions, count)
        self.grid = grid if coordinates is None else build_grid(coordinates, plan.cell)
        checks.number("'memory_mb'", memory_mb, 16)
        self.threads = resolve_threads(threads)
        self.starts = np.zeros(1, np.int64)
        if not count:
            return
        if not len(grid):
            raise StageError("the cloud has no points", found=f"{count} queries")
        self.fitted = fit()
        if len(self.fitted.fixed):
            compile_once("shapes" if self.fitted.fixed.shaped.any() else "fixed")
        self.candidates = self.fitted.fixed.candidates(self.grid.rows_of_cells(), self.grid.cell_ix)
        self._cut(float(memory_mb) * 2**20)

    def _cut(self, budget: float) -> None:
        """Cut the queries into blocks of bounded rows and time; use fewer threads where scratch is large."""
        fixed, adaptive = self.fitted.fixed, self.fitted.adaptive
        cost = fixed.cost(self.candidates) if len(fixed) else np.zeros(len(self.candidates))
        scratch = float(fixed.scratch_bytes(int(self.candidates.max())))
        if adaptive is not None:
            cost = cost + adaptive.query_ns
            scratch += adaptive.scratch_bytes
        cost = cost * self._distinct_share()
        self.threads = int(max(1, min(self.threads, 0.5 * budget // scratch)))
        # Two results per thread may wait (map_blocks) and one is being made; copies of points double a block.
        row = 8 * len(self.plan.names) + ROW_BYTES
        rows = (budget - self.threads * scratch) / ((2 * self.threads + 1) * row)
        total = float(cost @ np.diff(self.grid.cell_start))
        most = min(BLOCK_NS, max(total / (4 * self.threads), 5e6))
        self.starts = cut_blocks(self.grid.cell_start, cost, most, int(min(max(rows, 64), MOST_ROWS)))

    def _distinct_share(self) -> np.ndarray:
        """Of each cell's queries the share that is computed: copies of a query lie side by side and cost nothing."""
        grid = self.grid
        new = _differ(grid.x, grid.y, grid.z)
        if new.all():
            return np.ones(1)
        return np.add.reduceat(new, grid.cell_start[:-1], dtype=np.int64) / np.diff(grid.cell_start)

    def compute(self, first: int, last: int) -> tuple[np.ndarray, np.ndarray, Tally]:
        """Positions (in the user's order) and values of the sorted queries first..last, and what to report."""
        plan, grid, fitted = self.plan, self.grid, self.fitted
        fixed, adaptive = fitted.fixed, fitted.adaptive
        qx, qy, qz = grid.x[first:last], grid.y[first:last], grid.z[first:last]
        at = np.flatnonzero(_differ(qx, qy, qz))
        copies = np.diff(at, append=last - first)
        if len(at) < last - first:
            qx, qy, qz = qx[at], qy[at], qz[at]
        width = len(plan.names)
        values = np.empty((len(at), width), np.float32)
        tally: Tally = {}
        if len(fixed):
            a = np.searchsorted(grid.cell_start, first, "right") - 1
            b = np.searchsorted(grid.cell_start, last, "left")
            few = np.zeros(len(fixed), np.int64)
            fixed.fill(
                qx, qy, qz, copies, fitted.bins, fitted.seed, int(self.candidates[a:b].max()), few, values
            )
            tally["fewer_than_three"] = dict(zip(fixed.tokens, few.tolist(), strict=True))
        if adaptive is not None:
            few = np.zeros(len(adaptive.tokens), np.int64)
            far = np.zeros(len(adaptive.tokens), np.int64)
            adaptive.fill(
                qx, qy, qz, copies, fitted.bins, fitted.seed, fitted.copt_threshold, few, far, values
            )
            tally.setdefault("fewer_than_three", {}).update(zip(adaptive.tokens, few.tolist(), strict=True))
            if plan.unbounded:
                tally["beyond_halo"] = {t: n for t, n in zip(adaptive.tokens, far.tolist(), strict=True) if n}
        if len(at) < last - first:
            values = np.repeat(values, copies, axis=0)
        positions = grid.order[first:last].astype(np.int64)
        found = self._dimensions_at(positions)
        for column, name in enumerate(plan.dimensions, width - len(plan.dimensions)):
            given = found.get(name)
            if given is None:
                values[:, column] = {"X": grid.x, "Y": grid.y, "Z": grid.z}[name][first:last]
            else:
                values[:, column] = given
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


def _differ(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Which of sorted queries are no copies of the one before."""
    new = np.ones(len(x), np.bool_)
    new[1:] = (x[1:] != x[:-1]) | (y[1:] != y[:-1]) | (z[1:] != z[:-1])
    return new


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
        values = as_column(given[name])
        if values.shape != (count,) or values.dtype.kind not in "fiub":
            raise DimensionError(
                f"the dimension '{name}' must have one number per query",
                found=f"shape {values.shape}, dtype {values.dtype}, for {count} queries",
            )
        found[name] = values
    return found


# ---- compilation -------------------------------------------------------------------------------------------

_compiled: set[str] = set()
_compile_lock = threading.Lock()


def compile_once(what: str) -> None:
    """Load or compile a set of kernels on next to no data, before threads want them."""
    with _compile_lock:
        if what in _compiled:
            return
        _COMPILERS[what]()
        _compiled.add(what)


def _compile_index() -> None:
    build_grid(np.zeros((2, 3)), 1.0)


def _compile_fixed(feature: str) -> None:
    from .bins import ShapeBins
    from .fixed import FixedRadius

    grid = build_grid(np.zeros((1, 3)), 1.0)
    none = np.zeros(0)
    fixed = FixedRadius(grid, FeaturePlan.parse("c1,s1", feature))
    bins = ShapeBins(dict.fromkeys(fixed.tokens, np.zeros((5, 9))))
    cut_blocks(grid.cell_start, fixed.cost(fixed.candidates(grid.rows_of_cells(), grid.cell_ix)), 1.0, 1)
    out = np.zeros((0, 20), np.float32)
    fixed.fill(none, none, none, np.zeros(0, np.int64), bins, 0, 1, np.zeros(2, np.int64), out)


_COMPILERS = {
    "index": _compile_index,
    "fixed": lambda: _compile_fixed("Density"),
    "shapes": lambda: _compile_fixed("D1"),
}
