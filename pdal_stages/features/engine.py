"""Features of a cloud, block by block: one index, any queries, bounded memory, every core busy."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ..base import checks
from ..base.errors import DimensionError, OptionError, StageError, suggest
from ..base.progress import Progress
from ..base.report import Report
from ..base.threads import map_blocks, resolve_threads
from .plan import DEFAULT_FEATURES, DEFAULT_NEIGHBORHOODS, FeaturePlan
from .point_grid import CellGrid, build_grid, check_xyz
from .shape_distributions import SAMPLES, Fitted, ShapeBins, smallest_hashes

if TYPE_CHECKING:
    from .adaptive import AdaptiveNeighborhoods
    from .fixed_radius import FixedRadius


#: Rows of a block, whatever the memory allows: Ctrl-C waits for the blocks in work.
MOST_ROWS = 4096
#: Fewest distinct queries of a block.
LEAST_ROWS = 64
#: Bytes of a row besides its features.
ROW_BYTES = 200
#: Bytes of a row for each neighborhood.
NEIGHBORHOOD_BYTES = 130

#: The queries' own dimensions: (m,) values each, or what gives those of a block's queries, named
#: by their indices.
Given = Mapping[str, npt.ArrayLike] | Callable[[np.ndarray], Mapping[str, np.ndarray]] | None

#: Counts of a block: by kind, then by neighborhood.
Tally = dict[str, dict[str, int]]


@dataclass
class FeatureTable:
    """Features of queries: an array with names, which NumPy and scikit-learn take as it is.

    pandas, too: ``pandas.DataFrame(table, columns=list(table))``.
    """

    values: np.ndarray  #: (m, F) float32
    names: tuple[str, ...]  #: of the columns
    #: As given or fitted, both; hand them to another call to get comparable features.
    bins: ShapeBins | None = None
    copt_threshold: float | None = None
    report: Report = field(default_factory=Report)  #: see :class:`FeatureEngine`

    def __len__(self) -> int:
        """Return the number of queries."""
        return len(self.values)

    @property
    def shape(self) -> tuple[int, ...]:
        """Numbers of queries and features."""
        return self.values.shape

    def __array__(self, dtype=None, copy=None) -> np.ndarray:
        """Return the values, for NumPy."""
        return np.array(self.values, dtype) if copy else np.asarray(self.values, dtype)

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names, as a data frame does."""
        return iter(self.names)

    def __contains__(self, name: object) -> bool:
        """Return whether there is a feature of that name."""
        return name in self.names

    def __getitem__(self, name: str | list[str]) -> np.ndarray:
        """Return the column of a name, a view; or those of several names, (m, names)."""
        if isinstance(name, list):
            return np.stack([self[each] for each in name], axis=1)
        if name not in self.names:
            raise KeyError(
                f"no feature '{name}' in this table. {suggest(name, self.names)}".strip()
            )
        return self.values[:, self.names.index(name)]


class FeatureEngine:
    """Computes the features of a plan for queries against one cloud.

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
        As given or fitted.
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
    A result is the same to the last bit for any order of the points, any queries asked beside it,
    any number of threads, any block size, and in a tile whose halo is ``plan.halo_m`` meters or
    more.

    Memory over the cloud's own: 28 bytes a point for the index (about 52 while it is being
    sorted), about 10 more with neighborhoods of k points, 21 more with their surfaces, and the
    block budget of :meth:`blocks`.
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
        if not isinstance(plan, FeaturePlan):
            raise OptionError(
                "'plan' must be a FeaturePlan",
                found=type(plan).__name__,
                cure="Use FeaturePlan.parse",
            )
        resolve_threads(threads)
        self.plan, self.seed, self.threads = (
            plan,
            checks.whole("'seed'", seed, 0, 2**63 - 1),
            threads,
        )
        self.bins, self.copt_threshold = bins, copt_threshold
        self.cloud = check_xyz(xyz)
        self.grid = build_grid(self.cloud, plan.cell) if grid is None else grid
        self._lock = threading.RLock()
        self._parts: tuple[FixedRadius, AdaptiveNeighborhoods | None] | None = None
        self.report = Report({"points": len(self.grid), "queries": 0, "fewer_than_three": {}})

    def __len__(self) -> int:
        """Return the number of points of the cloud."""
        return len(self.grid)

    @property
    def fitted(self) -> Fitted:
        """Values that were passed in or fitted, as the kernels take them."""
        return Fitted(self.bins, self.copt_threshold, self.seed)

    # ---- fitting
    # -------------------------------------------------------------------------------------------

    def fit(self) -> FeatureEngine:
        """Fit what the plan needs and was not given: shape thresholds and the threshold of copt.

        Samples are the 500 points with the smallest hash of (seed, coordinates), so they do not
        depend on the order of the points. Called by :meth:`blocks` when needed; a second call does
        nothing. For several clouds see :func:`fit_clouds`.

        Raises
        ------
        StageError
            Where the cloud is empty, so that there is nothing to fit to.
        """
        with self._lock:
            needs_copt = self.copt_threshold is None and self.plan.copt
            needs_bins = self.bins is None and self.plan.shapes
            if (needs_copt or needs_bins) and not len(self):
                raise StageError("the cloud has no points to fit shape thresholds or copt to")
            if needs_copt:
                from .adaptive import curvature_threshold

                self.copt_threshold = curvature_threshold(self.curvatures())
            if needs_bins:
                self.bins = ShapeBins.fit(
                    self.shape_values(smallest_hashes(self.cloud, self.seed)[1])
                )
        return self

    def curvatures(self) -> np.ndarray:
        """Return the curvature of the points, in the order of the cloud, (n,) float64 [H17 eq. 1].

        The plan must have an adaptive neighborhood.
        """
        adaptive = self.neighborhoods()[1]
        assert adaptive is not None
        out = np.empty(len(self))
        out[self.grid.order] = adaptive.curvatures(self.plan.least_members, self.threads)
        return out

    def shape_values(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        """Return by token the metrics of all pulls round points of the cloud, comparable.

        (m, METRICS, PULLS) float32 for m `rows`.
        """
        x, y, z = np.ascontiguousarray(self.cloud[rows].T)
        values: dict[str, np.ndarray] = {}
        for group in filter(None, self.neighborhoods()):
            values |= group.shape_values((x, y, z), self.fitted)
        shaped = (c.neighborhood.token for c in self.plan.layout if c.shapes)
        return {token: values[token] for token in shaped}

    def neighborhoods(self) -> tuple[FixedRadius, AdaptiveNeighborhoods | None]:
        """Return the plan's neighborhoods, prepared for the cloud once."""
        with self._lock:
            if self._parts is None:
                from .fixed_radius import FixedRadius

                adaptive = None
                fixed = ("cylinder", "sphere")
                if any(c.at and c.neighborhood.kind not in fixed for c in self.plan.layout):
                    from .adaptive import AdaptiveNeighborhoods

                    adaptive = AdaptiveNeighborhoods(self.grid, self.plan, self.threads)
                self._parts = FixedRadius(self.grid, self.plan), adaptive
            return self._parts

    # ---- computing
    # -----------------------------------------------------------------------------------------

    def blocks(
        self,
        queries: npt.ArrayLike | None = None,
        *,
        dimensions: Given = None,
        threads: int | None = None,
        memory_mb: float = 512,
        progress: Progress | bool | None = None,
    ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Compute features block by block, on every core.

        :meth:`run` is for more work on each block in its thread.

        Parameters
        ----------
        queries : array, optional
            ``None``: every point of the cloud; an array of indices into the cloud; or (m, 3)
            coordinates.
        dimensions : mapping of str to (m,) array, or function
            One value per query for each of ``plan.dimensions``. X, Y and Z need not be given. A
            function is called in the worker's thread with a block's `rows` and gives their values:
            no copy of all is needed.
        threads : int, optional
            The engine's where not given.
        memory_mb : float
            Memory that blocks may take in all, over the cloud and its index.
        progress : Progress or bool, optional
            A progress to update, or ``True`` for one of its own.

        Yields
        ------
        rows : (b,) int64 array
            Where the queries are points of the cloud (``None`` or indices): their indices in the
            cloud. Where they are coordinates: their row numbers. Every query comes once, in the
            order of the grid.
        values : (b, len(plan.names)) float32 array, C-contiguous

        Raises
        ------
        DimensionError
            Where a dimension of the plan is not given, or has not one value per query.
        """
        run = self.run(queries, dimensions=dimensions, threads=threads, memory_mb=memory_mb)
        for block in run.computed(progress):
            yield block.rows, block.values

    def run(
        self,
        queries: npt.ArrayLike | None = None,
        *,
        dimensions: Given = None,
        threads: int | None = None,
        memory_mb: float = 512,
    ) -> Run:
        """Return the blocks of queries to compute; parameters as for :meth:`blocks`.

        A classifier computes a block's features and classifies it in one thread, so that the whole
        matrix is never held. Its function `classify` calls ``run.compute``::

            for block, classes in map_blocks(classify, run.ranges, run.threads):
                run.count(block)
        """
        return Run(self, queries, dimensions, threads, memory_mb)

    def table(
        self,
        queries: npt.ArrayLike | None = None,
        *,
        dimensions: Mapping[str, npt.ArrayLike] | None = None,
        threads: int | None = None,
        memory_mb: float = 512,
        progress: Progress | bool | None = None,
    ) -> FeatureTable:
        """Return the features of all queries as one table, row i for query i.

        Parameters as for :meth:`blocks`.
        """
        run = self.run(queries, dimensions=dimensions, threads=threads, memory_mb=memory_mb)
        values = np.empty((len(run.grid), len(self.plan.names)), np.float32)
        for block in run.computed(progress):
            values[block.positions] = block.values
        return FeatureTable(values, self.plan.names, self.bins, self.copt_threshold, self.report)


class FeatureBlock(NamedTuple):
    """Features of some queries."""

    positions: np.ndarray  #: (b,) int64: which of the queries, in the user's order
    rows: np.ndarray  #: (b,) int64: which points of the cloud; positions where they are coordinates
    values: np.ndarray  #: (b, features) float32
    tally: Tally


class Run:
    """A run over queries, sorted like the cloud and cut into blocks.

    Arguments as of :meth:`FeatureEngine.blocks`.
    """

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
        self.dimensions = (
            dimensions if callable(dimensions) else _dimensions(self.plan, dimensions, count)
        )
        self.grid = engine.grid if coordinates is None else build_grid(coordinates, self.plan.cell)
        checks.number("'memory_mb'", memory_mb, 16)
        self.threads = resolve_threads(engine.threads if threads is None else threads)
        #: Sorted queries that are no copies of the one before.
        self.distinct = np.zeros(0, np.int64)
        #: First distinct query of each block, and the first behind it.
        self.ranges: list[tuple[int, int]] = []
        if not count:
            return
        if not len(engine):
            raise StageError("the cloud has no points", found=f"{count} queries")
        engine.fit()
        self.fixed, self.adaptive = engine.neighborhoods()
        self.reaches = [0.0]  # of the blocks: how far away the farthest neighbors lie
        x, y, z = self.grid.x, self.grid.y, self.grid.z
        new = np.ones(count, np.bool_)
        new[1:] = (x[1:] != x[:-1]) | (y[1:] != y[:-1]) | (z[1:] != z[:-1])
        self.distinct = np.append(np.flatnonzero(new), count)
        # Two results per thread may wait (map_blocks) and one is being computed; copies of points
        # double a block.
        row = NEIGHBORHOOD_BYTES * len(self.plan.neighborhoods) + ROW_BYTES
        row += 8 * len(self.plan.names)
        rows = min(
            memory_mb * 2**20 / ((2 * self.threads + 1) * row),
            MOST_ROWS,
            count / (4 * self.threads),
        )
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
        values = np.empty((len(at), width), np.float32)
        few = self.fixed.fill(points, copies, engine.fitted, values)
        tally: Tally = {"fewer_than_three": dict(zip(self.fixed.tokens, few.tolist(), strict=True))}
        if self.adaptive is not None:
            tokens = self.adaptive.tokens
            few, far, reach = self.adaptive.fill(points, copies, engine.fitted, values)
            tally["fewer_than_three"].update(zip(tokens, few.tolist(), strict=True))
            self.reaches.append(reach)
            tally["beyond_halo"] = {
                token: n for token, n in zip(tokens, far.tolist(), strict=True) if n
            }
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
            given_values = dimensions.get(name)
            if given_values is None:
                given_values = axes[name][first:last]
            values[:, column] = given_values
        return FeatureBlock(positions, rows, values, tally)

    def computed(self, progress: Progress | bool | None = None) -> Iterator[FeatureBlock]:
        """Yield all blocks, counted, as threads finish them."""
        bar = Progress(len(self.grid), "features") if progress is True else progress or None
        try:
            for block in map_blocks(self.compute, self.ranges, self.threads):
                self.count(block)
                if bar is not None:
                    bar.update(len(block.rows))
                yield block
        finally:
            if progress is True and bar is not None:
                bar.close()

    def count(self, block: FeatureBlock) -> None:
        """Add a block to the engine's report; by one thread only."""
        report = self.engine.report
        report.figures["queries"] += len(block.rows)
        report.reach = max(report.reach, *self.reaches)
        totals = {"beyond_halo": report.beyond_halo, **report.figures}
        for key, counts in block.tally.items():
            for token, n in counts.items():
                totals[key][token] = totals[key].get(token, 0) + n


def _queries(queries, cloud: np.ndarray) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Return indices into the cloud, or None; and coordinates, None for the whole cloud."""
    if queries is None:
        return None, None
    array = np.asarray(queries)
    if array.ndim == 2:
        return None, check_xyz(array, "queries")
    if array.ndim != 1 or (array.size and array.dtype.kind not in "iu"):
        raise OptionError(
            "'queries' must be indices of points or (m, 3) coordinates",
            found=f"dtype {array.dtype}, shape {array.shape}",
            cure="Use np.flatnonzero(mask)" if array.dtype.kind == "b" else None,
        )
    array = array.astype(np.int64, copy=False)
    if outside := np.count_nonzero((array < 0) | (array >= len(cloud))):
        raise OptionError(
            f"'queries' has indices outside the cloud of {len(cloud)} points", found=outside
        )
    return array, cloud[array]


def _dimensions(
    plan: FeaturePlan, dimensions: Mapping[str, npt.ArrayLike] | None, count: int
) -> dict[str, np.ndarray]:
    """Return the plan's dimensions of `count` queries; DimensionError for a missing one."""
    dimensions = dimensions or {}
    columns = {}
    for name in plan.dimensions:
        if name not in dimensions:
            if name in ("X", "Y", "Z"):
                continue
            raise DimensionError(
                f"the dimension '{name}' is needed as a feature but missing",
                found=", ".join(map(str, dimensions)) or "none",
                cure=f"Give dimensions={{'{name}': values}}, or leave it out of the plan",
            )
        values = np.asarray(dimensions[name])
        if values.shape != (count,) or values.dtype.kind not in "fiub":
            raise DimensionError(
                f"the dimension '{name}' must have one number per query",
                found=f"shape {values.shape}, dtype {values.dtype}, for {count} queries",
            )
        columns[name] = values
    return columns


def compute_features(
    xyz: npt.ArrayLike,
    queries: npt.ArrayLike | None = None,
    neighborhoods=DEFAULT_NEIGHBORHOODS,
    feature_set=DEFAULT_FEATURES,
    *,
    dimensions: Mapping[str, npt.ArrayLike] | None = None,
    memory_mb: float = 512,
    progress: Progress | bool | None = None,
    **settings: Any,
) -> FeatureTable:
    """Compute multi-scale features of a point cloud.

    Parameters
    ----------
    xyz : (n, 3) array
        The cloud, float64, in meters.
    queries : array, optional
        Whose features: ``None`` for every point, an array of indices into the cloud, or (m, 3)
        coordinates.
    neighborhoods : str or list of str
        Presets and tokens, e.g. ``"weinmann2018"`` or ``"c1, s2, kopt"``.
    feature_set : str or list of str
        Groups (``all``, ``covariance``, ``geometric``, ``shapes``, ``surfaces``, ``A3``, ``D1`` ..
        ``D4``) or single features. The defaults of both are those of
        ``filters.multiscalefeatures``.
    dimensions : mapping of str to (m,) array
        The queries' own dimensions that the plan uses as features (HeightAboveGround for
        weinmann2018).
    memory_mb : float
        Memory that blocks may take, over the cloud, its index and the table.
    progress : Progress or bool, optional
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
    clouds: Sequence[npt.ArrayLike], plan: FeaturePlan, *, seed: int = 0, threads: int | None = None
) -> tuple[ShapeBins | None, float | None]:
    """Shape thresholds and the threshold of copt, fitted to several clouds as if to one.

    Curvatures of all points of all clouds are parted together [H17 eq. 3], and the 500 sample
    neighborhoods [B16 3.2.2] are those round the points with the smallest hashes of all. A
    neighborhood lies within its own cloud. Of one cloud the result is :meth:`FeatureEngine.fit`'s;
    the order of the clouds (n, 3), in meters, does not matter. None where the plan has no shapes,
    or no copt.
    """
    if not (plan.shapes or plan.copt):
        return None, None
    if len(clouds) == 1:
        engine = FeatureEngine(clouds[0], plan, seed=seed, threads=threads).fit()
        return engine.bins, engine.copt_threshold
    threshold = None
    if plan.copt:
        from .adaptive import curvature_threshold

        each = [FeatureEngine(cloud, plan, threads=threads).curvatures() for cloud in clouds]
        threshold = curvature_threshold(np.concatenate(each))
    if not plan.shapes:
        return None, threshold
    samples = [smallest_hashes(np.asarray(cloud), seed) for cloud in clouds]
    hashes = np.sort(np.concatenate([of_cloud for of_cloud, _ in samples]))
    last = hashes[min(SAMPLES, len(hashes)) - 1]
    values: dict[str, list[np.ndarray]] = {}
    for cloud, (of_cloud, rows) in zip(clouds, samples, strict=True):
        rows = rows[of_cloud <= last]  # a thinned copy's points tie, and all stay
        if len(rows):
            engine = FeatureEngine(
                cloud, plan, copt_threshold=threshold, seed=seed, threads=threads
            )
            for token, metrics in engine.shape_values(rows).items():
                values.setdefault(token, []).append(metrics)
            del engine  # one index at a time
    joined = {token: np.concatenate(parts) for token, parts in values.items()}
    return ShapeBins.fit(joined), threshold


def warmup() -> None:
    """Compile every kernel and fill the cache, e.g. at installation."""
    xyz = np.random.default_rng(0).uniform(0.0, 3.0, (60, 3))
    compute_features(xyz, None, "c1,s1,k5,kopt(2,5),ropt,copt", "all,surfaces", threads=1)
    compute_features(xyz, np.zeros((1, 3)), neighborhoods="c1", feature_set="covariance", threads=1)
