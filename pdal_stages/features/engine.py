"""Features of a cloud, block by block: one index, any queries, bounded memory, every core busy."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ..base import checks
from ..base.errors import DimensionError, StageError, suggest
from ..base.messages import Report
from ..base.progress import Progress
from ..base.threads import map_blocks, resolve_threads
from .plan import DEFAULT_FEATURES, DEFAULT_NEIGHBORHOODS, FeaturePlan
from .point_grid import CellGrid, build_grid, check_xyz
from .shape_distributions import (
    SAMPLES,
    Fitted,
    NeighborhoodGroup,
    ShapeBins,
    smallest_hashes,
)

#: Rows of a block, whatever the memory allows: large enough that a block's calls cost little, small
#: enough that Ctrl-C, which waits for the blocks in work, comes at once. Not tuned.
MOST_ROWS = 4096
#: Fewest distinct queries of a block: large enough that a block's calls cost little. Not tuned.
LEAST_ROWS = 64
#: Bytes of a row besides its features: coordinates, indices and groups take about 80, twice that
#: where each point has a copy. Rounded up, not measured.
ROW_BYTES = 200
#: Bytes of a row for each neighborhood: 14 moments, a curvature and a seed of 8 bytes each.
NEIGHBORHOOD_BYTES = 130

#: The queries' own dimensions: (m,) values each, or what gives those of a block's queries, named
#: by their indices.
Given = Mapping[str, npt.ArrayLike] | Callable[[np.ndarray], Mapping[str, np.ndarray]] | None


@dataclass
class FeatureTable:
    """Features of queries: an array with names. ``table["Linearity_c1"]`` is a column of it."""

    values: np.ndarray  #: (m, F) float32
    names: tuple[str, ...]  #: of the columns
    #: As passed in or fitted, both; hand them to another call to get comparable features.
    bins: ShapeBins | None = None
    copt_threshold: float | None = None
    report: Report = field(default_factory=Report)  #: see :class:`FeatureEngine`

    def __getitem__(self, name: str) -> np.ndarray:
        """Return the column of a name, a view."""
        if name not in self.names:
            raise KeyError(
                f"no feature '{name}' in this table. {suggest(name, self.names)}".strip()
            )
        return self.values[:, self.names.index(name)]


class FeatureEngine:
    """Computes the features of a plan for queries, which are points of one cloud.

    Parameters
    ----------
    xyz : (n, 3) array
        The cloud, float64, in meters.
    plan : FeaturePlan
    bins : ShapeBins, optional
        Thresholds of the shape distributions; fitted to this cloud where absent and needed.
    copt_threshold : float, optional
        Curvature that parts scattered from regular points (copt); fitted where absent and needed.
    seed : int
        Of the random pulls of the shape distributions.
    threads : int, optional
        ``None`` or 0: every core this process may use.
    grid : CellGrid, optional
        What :func:`build_grid` makes of the cloud and ``plan.cell``, where it is there already.

    Attributes
    ----------
    bins, copt_threshold
        As passed in or fitted.
    report : Report
        So far: ``points`` of the cloud, ``queries`` computed, ``fewer_than_three`` (by
        neighborhood, queries whose neighborhood had fewer than three points, so that
        eigen-features are 0); and, beyond ``plan.halo_m``, queries whose k nearest reach farther.

    Raises
    ------
    StageError
        For coordinates that are not a finite (n, 3) array of numbers.

    Notes
    -----
    A result is the same to the last bit for any order of the points, any queries beside it, any
    number of threads, any block size, and in a tile whose halo is ``plan.halo_m`` meters or more.

    Memory over the cloud's own: 28 bytes a point for the index (about 52 while it is being
    sorted), about 10 more with neighborhoods of k points, 21 more with their surfaces, and the
    block budget of :meth:`run`.
    """

    def __init__(
        self,
        xyz: npt.ArrayLike,
        plan: FeaturePlan,
        *,
        bins: ShapeBins | None = None,
        copt_threshold: float | None = None,
        seed: int = 0,
        threads: int | None = None,
        grid: CellGrid | None = None,
    ) -> None:
        self.plan, self.threads = plan, resolve_threads(threads)
        self.seed = checks.whole("'seed'", seed, 0, 2**63 - 1)
        self.bins, self.copt_threshold = bins, copt_threshold
        self.cloud = check_xyz(xyz)
        self.grid = build_grid(self.cloud, plan.cell) if grid is None else grid
        self._lock = threading.RLock()
        self._groups: list[NeighborhoodGroup] = []
        self.report = Report({"points": len(self.grid.order), "queries": 0, "fewer_than_three": {}})

    def __len__(self) -> int:
        """Return the number of points of the cloud."""
        return len(self.grid.order)

    @property
    def fitted(self) -> Fitted:
        """Values that were passed in or fitted, as the kernels take them."""
        return Fitted(self.bins, self.copt_threshold, self.seed)

    def fit(self) -> FeatureEngine:
        """Fit what the plan needs and was not passed in: thresholds of shapes and of copt.

        Samples are the 500 points with the smallest hash of (seed, coordinates), so they do not
        depend on the order of the points. Called by :meth:`run` when needed; a second call does
        nothing. For several clouds see :func:`fit_clouds`.

        Raises
        ------
        StageError
            Where the cloud is empty, so that there is nothing to fit to.
        """
        with self._lock:
            self.bins, self.copt_threshold = _fit([self.cloud], lambda _: self, self)
        return self

    def curvatures(self) -> np.ndarray:
        """Return the curvature of the points, in the order of the cloud, (n,) float64 [H17 eq. 1].

        The plan must have an adaptive neighborhood.
        """
        out = np.empty(len(self))
        from .adaptive import AdaptiveNeighborhoods

        groups = self.neighborhoods()
        (adaptive,) = (group for group in groups if isinstance(group, AdaptiveNeighborhoods))
        out[self.grid.order] = adaptive.curvatures(self.threads)
        return out

    def shape_values(self, rows: np.ndarray, threshold: float | None) -> dict[str, np.ndarray]:
        """Return metrics (m, METRICS, PULLS) float32 of all pulls round m `rows`, by token.

        `threshold` is the curvature from which on `copt` takes a point for scattered.
        """
        x, y, z = np.ascontiguousarray(self.cloud[rows].T)
        values: dict[str, np.ndarray] = {}
        for group in self.neighborhoods():
            values |= group.shape_values((x, y, z), Fitted(None, threshold, self.seed))
        shaped = (c.neighborhood.token for c in self.plan.layout if c.shapes)
        return {token: values[token] for token in shaped}

    def neighborhoods(self) -> list[NeighborhoodGroup]:
        """Return the plan's neighborhoods, prepared for the cloud once: fixed, then adaptive."""
        with self._lock:
            if not self._groups:
                from .fixed_radius import FixedRadius

                self._groups.append(FixedRadius(self.grid, self.plan))
                if any(c.at and not c.neighborhood.fixed for c in self.plan.layout):
                    from .adaptive import AdaptiveNeighborhoods

                    self._groups.append(AdaptiveNeighborhoods(self.grid, self.plan, self.threads))
            return self._groups

    def run(self, queries: npt.ArrayLike | None = None, **options: Any) -> Run:
        """Return the blocks of queries to compute.

        ``run.computed()`` computes them on every core. A classifier computes a block's features
        and classifies it in one thread, so that the whole matrix is never held: its function
        `classify` calls ``run.compute``::

            for block, classes in map_blocks(classify, run.ranges, run.threads):
                run.count(block)

        Parameters
        ----------
        queries : array, optional
            Indices into the cloud; ``None``: every point of it.
        dimensions : mapping of str to (m,) array, or function
            One value per query for each of ``plan.dimensions``; X, Y and Z are known. A function
            is called in the worker's thread with a block's `rows` and returns their values: no
            copy of all is needed.
        memory_mb : float
            Memory that blocks may take in all, over the cloud and its index.

        Raises
        ------
        DimensionError
            Where a dimension of the plan is missing, or has not one value per query.
        """
        return Run(self, queries, **options)

    def table(
        self,
        queries: npt.ArrayLike | None = None,
        *,
        progress: Progress | None = None,
        **options: Any,
    ) -> FeatureTable:
        """Return the features of all queries as one table, row i for query i.

        Parameters as for :meth:`run`.
        """
        run = self.run(queries, **options)
        values = np.full((len(run.grid.order), len(self.plan.names)), np.nan, np.float32)
        for block in run.computed(progress):
            values[block.positions] = block.values
        return FeatureTable(values, self.plan.names, self.bins, self.copt_threshold, self.report)


class FeatureBlock(NamedTuple):
    """Features of some queries."""

    positions: np.ndarray  #: (b,) int64: which of the queries, in the user's order
    rows: np.ndarray  #: (b,) int64: which points of the cloud
    values: np.ndarray  #: (b, features) float32
    few: dict[str, int]  #: by neighborhood, queries with fewer than three points
    far: dict[str, int]  #: by neighborhood, queries whose result reaches beyond the halo
    reach: float  #: meters to the farthest point that matters to adaptive neighborhoods


class Run:
    """A run over queries, sorted like the cloud and cut into blocks.

    Arguments are those of :meth:`FeatureEngine.run`.
    """

    def __init__(
        self,
        engine: FeatureEngine,
        queries: npt.ArrayLike | None,
        dimensions: Given = None,
        memory_mb: float = 512,
    ) -> None:
        self.engine, self.plan, self.threads = engine, engine.plan, engine.threads
        self.indices = None if queries is None else np.arange(len(engine))[queries]  # type: ignore[index]
        self.grid = engine.grid
        if self.indices is not None:
            self.grid = build_grid(engine.cloud[self.indices], self.plan.cell)
        count = len(self.grid.order)
        self.dimensions = (
            dimensions if callable(dimensions) else _dimensions(self.plan, dimensions, count)
        )
        checks.number("'memory_mb'", memory_mb, 16)
        #: Sorted queries that are no copies of the one before.
        self.distinct = np.zeros(0, np.int64)
        #: First distinct query of each block, and the first behind it.
        self.ranges: list[tuple[int, int]] = []
        if not count:
            return
        engine.fit()
        engine.neighborhoods()  # prepared here, once, with all threads
        x, y, z = self.grid.x, self.grid.y, self.grid.z
        new = np.ones(count, np.bool_)
        new[1:] = (x[1:] != x[:-1]) | (y[1:] != y[:-1]) | (z[1:] != z[:-1])
        self.distinct = np.append(np.flatnonzero(new), count)
        # Two results per thread may wait (`ahead` of map_blocks) and one is being computed. A
        # feature is a float32, and copies of points double a block. Four blocks or more for each
        # thread let threads finish together.
        row = NEIGHBORHOOD_BYTES * len(self.plan.neighborhoods) + ROW_BYTES
        row += 8 * len(self.plan.names)
        budget = memory_mb * 2**20 / ((2 * self.threads + 1) * row)
        rows = min(budget, MOST_ROWS, count / (4 * self.threads))
        starts = np.arange(0, len(self.distinct) - 1, max(int(rows), LEAST_ROWS))
        self.ranges = list(pairwise([*starts.tolist(), len(self.distinct) - 1]))

    def compute(self, block: tuple[int, int]) -> FeatureBlock:
        """Compute a block, one of `ranges`; may be called in several threads at a time."""
        begin, end = block
        plan, grid, engine = self.plan, self.grid, self.engine
        at = self.distinct[begin:end]
        first, last = at[0], self.distinct[end]
        copies = np.diff(at, append=last)
        points = grid.x[at], grid.y[at], grid.z[at]
        width = len(plan.names)
        values = np.full((len(at), width), np.nan, np.float32)  # a column that no kernel writes
        few: dict[str, int] = {}
        far: dict[str, int] = {}
        reach = 0.0
        for group in engine.neighborhoods():
            shapes = group.shapes(points, engine.fitted)
            counts = group.fill(points, copies, engine.fitted, shapes, values)
            few, far, reach = few | counts[0], far | counts[1], max(reach, counts[2])
        if len(at) < last - first:
            values = np.repeat(values, copies, axis=0)
        positions = grid.order[first:last].astype(np.int64)
        rows = positions if self.indices is None else self.indices[positions]
        if callable(self.dimensions):
            dimensions = self.dimensions(rows)
        else:
            dimensions = {name: column[positions] for name, column in self.dimensions.items()}
        axes = {"X": grid.x, "Y": grid.y, "Z": grid.z}
        for column, name in enumerate(plan.dimensions, width - len(plan.dimensions)):
            known = dimensions.get(name)
            values[:, column] = axes[name][first:last] if known is None else known
        return FeatureBlock(positions, rows, values, few, far, reach)

    def computed(self, progress: Progress | None = None) -> Iterator[FeatureBlock]:
        """Yield all blocks, counted, as threads finish them, in the order of the grid."""
        for block in map_blocks(self.compute, self.ranges, self.threads):
            self.count(block)
            if progress is not None:
                progress.update(len(block.rows))
            yield block

    def count(self, block: FeatureBlock) -> None:
        """Add a block to the engine's report; by one thread only."""
        report = self.engine.report
        report.figures["queries"] += len(block.rows)
        report.reach = max(report.reach, block.reach)
        for totals, counts in (
            (report.figures["fewer_than_three"], block.few),
            (report.beyond_halo, block.far),
        ):
            for token, n in counts.items():
                totals[token] = totals.get(token, 0) + n


def _dimensions(
    plan: FeaturePlan, dimensions: Mapping[str, npt.ArrayLike] | None, count: int
) -> dict[str, np.ndarray]:
    """Return the plan's dimensions of `count` queries; DimensionError for a missing one."""
    columns = {name: np.asarray(values) for name, values in (dimensions or {}).items()}
    for name in plan.dimensions:
        if name not in columns and name not in ("X", "Y", "Z"):
            raise DimensionError(
                f"the dimension '{name}' is needed as a feature but missing",
                found=", ".join(map(str, columns)) or "none",
                cure=f"Give dimensions={{'{name}': values}}, or leave it out of the plan",
            )
        if name in columns and columns[name].shape != (count,):
            raise DimensionError(
                f"the dimension '{name}' must have one number for each of {count} queries",
                found=f"shape {columns[name].shape}",
            )
    return {name: columns[name] for name in plan.dimensions if name in columns}


def compute_features(
    xyz: npt.ArrayLike,
    queries: npt.ArrayLike | None = None,
    neighborhoods=DEFAULT_NEIGHBORHOODS,
    feature_set=DEFAULT_FEATURES,
    *,
    dimensions: Mapping[str, npt.ArrayLike] | None = None,
    memory_mb: float = 512,
    progress: Progress | None = None,
    **settings: Any,
) -> FeatureTable:
    """Compute multi-scale features of a point cloud.

    Parameters
    ----------
    xyz : (n, 3) array
        The cloud, float64, in meters.
    queries : array, optional
        Indices of the points whose features are computed; ``None`` for every point.
    neighborhoods : str or list of str
        Presets and tokens, e.g. ``"weinmann2018"`` or ``"c1, s2, kopt"``.
    feature_set : str or list of str
        Groups (``all``, ``covariance``, ``geometric``, ``shapes``, ``surfaces``, ``he2017``,
        ``A3``, ``D1`` .. ``D4``) or single features. The defaults of both are those of
        ``filters.multiscalefeatures``.
    dimensions : mapping of str to (m,) array
        The queries' own dimensions that the plan uses as features (HeightAboveGround for
        weinmann2018).
    memory_mb : float
        Memory that blocks may take, over the cloud, its index and the table.
    progress : Progress, optional
    **settings
        ``bins``, ``copt_threshold``, ``seed`` and ``threads`` of :class:`FeatureEngine`.

    Returns
    -------
    FeatureTable

    Examples
    --------
    >>> import numpy as np
    >>> xyz = np.random.default_rng(0).uniform(0, 20, (1000, 3)) * [1, 1, 0]  # a flat field
    >>> table = compute_features(xyz, neighborhoods="c2,s3", feature_set="covariance")
    >>> float(table["SurfaceVariation_s3"].max())
    0.0
    """
    names = tuple(dimensions) if dimensions else ()
    plan = FeaturePlan.parse(neighborhoods, feature_set, names)
    engine = FeatureEngine(xyz, plan, **settings)
    return engine.table(queries, dimensions=dimensions, memory_mb=memory_mb, progress=progress)


def fit_clouds(
    clouds: Sequence[npt.ArrayLike],
    plan: FeaturePlan,
    *,
    copt_threshold: float | None = None,
    seed: int = 0,
    threads: int | None = None,
) -> tuple[ShapeBins | None, float | None]:
    """Shape thresholds and the threshold of copt, fitted to several clouds as if to one.

    Curvatures of all points of all clouds are parted together [H17 eq. 3], and the 500 sample
    neighborhoods [B16 3.2.2] are those round the points with the smallest hashes of all. A
    neighborhood lies within its own cloud. Of one cloud the result is :meth:`FeatureEngine.fit`'s;
    the order of the clouds (n, 3), in meters, does not matter. None where the plan has no shapes,
    or no copt; a `copt_threshold` that is given stays.
    """

    def engine_of(number: int) -> FeatureEngine:  # one index at a time
        return FeatureEngine(clouds[number], plan, seed=seed, threads=threads)

    like = FeatureEngine(np.zeros((0, 3)), plan, copt_threshold=copt_threshold, seed=seed)
    return _fit(clouds, engine_of, like)


def _fit(
    clouds: Sequence[npt.ArrayLike], engine_of: Callable[[int], FeatureEngine], like: FeatureEngine
) -> tuple[ShapeBins | None, float | None]:
    """Fit what an engine with the plan and the thresholds of `like` lacks, to all clouds."""
    plan, bins, threshold = like.plan, like.bins, like.copt_threshold
    needs_copt, needs_bins = plan.copt and threshold is None, plan.shapes and bins is None
    if (needs_copt or needs_bins) and not any(len(np.asarray(cloud)) for cloud in clouds):
        raise StageError("the cloud has no points to fit shape thresholds or copt to")
    if needs_copt:
        from .searches import curvature_threshold

        each = [engine_of(number).curvatures() for number in range(len(clouds))]
        threshold = curvature_threshold(np.concatenate(each))
    if needs_bins:
        samples = [smallest_hashes(np.asarray(cloud), like.seed) for cloud in clouds]
        hashes = np.sort(np.concatenate([of_cloud for of_cloud, _ in samples]))
        last = hashes[min(SAMPLES, len(hashes)) - 1]
        values: dict[str, list[np.ndarray]] = {}
        for number, (of_cloud, rows) in enumerate(samples):
            rows = rows[of_cloud <= last]  # a thinned copy's points tie, and all stay
            if len(rows):
                for token, metrics in engine_of(number).shape_values(rows, threshold).items():
                    values.setdefault(token, []).append(metrics)
        bins = ShapeBins.fit({token: np.concatenate(parts) for token, parts in values.items()})
    return bins, threshold


def warmup() -> None:
    """Compile every kernel and fill the cache, e.g. at installation."""
    xyz = np.random.default_rng(0).uniform(0.0, 3.0, (60, 3))
    compute_features(xyz, None, "c1,s1,k5,kopt(2,5),ropt,rdim,copt", "all,surfaces", threads=1)
    compute_features(xyz, [0], neighborhoods="c1", feature_set="covariance", threads=1)
