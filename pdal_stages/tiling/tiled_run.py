"""A tiled run: reading the inputs, the first round, tiles, and outputs that are assembled from
them.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from ..base import las_check
from ..base.errors import DependencyError, StageError
from ..base.files import sweep
from ..base.jit import count_cached_kernels
from ..base.messages import print_messages
from ..base.progress import Progress
from ..base.version import build
from ..pipeline.json_source import Override, PipelineSource
from ..pipeline.las_output import files_with_flags_to_split
from ..pipeline.run import Pipeline
from ..pipeline.workers import ThisProcess, WorkerProcesses, run_tasks
from .checkpoint import Store, fingerprint
from .first_round import block_name, blocks_around, make_block, square_name
from .inputs import CloudIndex, IndexedSource, Survey
from .jobs import (
    InterruptedRun,
    Job,
    TiledRun,
    messages_of,
    messages_on_folders,
    summarize,
)
from .options import TilingOptions, worker_bytes
from .plan import RunContext, TilePlan, make_plan, outputs_for
from .run_tile import run_first_round, run_tile
from .sorted_points import TEMPORARY, is_intact, sort_points
from .write_outputs import write_file

#: A run stops when this many tiles failed for the same reason and none succeeded.
_HOPELESS = 10
#: Bytes on disk for a point until its output is written; in the first round, for a point and for a
#: raster cell.
_KEPT, _KEPT_BEFORE, _KEPT_OF_CELL = 60, 33, 112


def run_tiled(
    source: str | Path | list | dict | Pipeline,
    tile: float | TilingOptions,
    overrides: Iterable[Override] = (),
    *,
    dry_run: bool = False,
    progress: bool | None = None,
    **options: Any,
) -> TiledRun:
    """Run a pipeline in tiles.

    Parameters
    ----------
    source : str, Path, list, dict or Pipeline
        As for :class:`pdal_stages.Pipeline`, or such an object.
    tile : float or TilingOptions
        Side of the tiles, in the unit of the coordinates; or all options.
    overrides : iterable of Override
    dry_run : bool
        Only find the tiles: only headers are read, and nothing is written.
    progress : bool, optional
        Whether to show progress on stderr.
    **options
        The other fields of :class:`TilingOptions`.

    Returns
    -------
    TiledRun
        Failures of tiles do not raise: see :attr:`TiledRun.failures`.

    Raises
    ------
    StageError
        For errors before any tile, or in every tile.
    InterruptedRun
        A KeyboardInterrupt with what was done until then.
    """
    chosen = tile if isinstance(tile, TilingOptions) else TilingOptions(tile, **options)
    pipeline = source if isinstance(source, Pipeline) else Pipeline(source, overrides, whole=False)
    plan = make_plan(pipeline, chosen.buffer)
    return run_plan(plan, chosen, dry_run=dry_run, progress=progress, source=pipeline.source)


def run_plan(
    plan: TilePlan,
    chosen: TilingOptions,
    *,
    dry_run: bool = False,
    progress: bool | None = None,
    finished: Callable[[Job], None] | None = None,
    source: PipelineSource | None = None,
) -> TiledRun:
    """Run a plan; see :func:`run_tiled`. `finished` is called with every output that was written.

    `source`: the user's pipeline, which is first validated on one input.
    """
    started = time.monotonic()
    folder = Path(plan.writers[0]["filename"]).absolute().parent
    resumed = chosen.resume and chosen.tile is None
    known = Store(folder).note("run") if resumed else {}
    survey = Survey(plan, chosen, known if "square" in known else None)
    if survey.per == "tile":  # whose outputs have points of all readers
        files_with_flags_to_split([*plan.readers, *plan.tail])
    if source is not None:
        _try_on_an_input(source, survey, len(plan.readers))
    if dry_run:
        return estimate(plan, survey)
    if not folder.is_dir():
        raise StageError(
            "the folder of the output does not exist", found=str(folder), cure="Create it first"
        )
    if plan.makes and progress is not False and not chosen.scheduler and not count_cached_kernels():
        print_messages("compiling for this processor first, once: it takes a minute or two")
    folders = {folder, *(Path(path).parent for paths in survey.outputs for path in paths)}
    with Store(folder) as store:
        if not chosen.resume:
            store.clear()
        store.finish("run", "", survey.layout)
        try:
            with _workers(survey.options, str(store.folder)) as workers:
                run = _Run(plan, survey, store, workers, progress)
                run.read_inputs()
                run.find_jobs()
                files = [file for job in (*run.tiles, *run.outputs) for file in job.outputs or ()]
                survey.messages += messages_on_folders(files, survey.paths, chosen.resume)
                if chosen.resume:
                    run.take_over()
                    run.read_inputs(run.inputs_of_waiting())
                interrupted = True
                with contextlib.suppress(KeyboardInterrupt):
                    run.make_ground()
                    run.make_outputs(finished)
                    run.forget()
                    interrupted = False
        finally:
            for each in (*folders, store.kept):
                sweep(each)  # left by workers that were killed
    summary = survey.figures(plan) | {
        "workers": workers.slots,
        "threads_per_worker": workers.threads,
    }
    summary |= summarize(run.tiles, run.cpu_seconds, time.monotonic() - started)
    summary["peak_mb_of_a_worker"] = run.peak_mb
    messages = survey.messages + messages_of(run.tiles, run.messages_before, chosen.most_points)
    found = TiledRun(run.tiles, run.outputs, survey.unreadable, survey.changed(), messages, summary)
    if interrupted:
        raise InterruptedRun(found)
    return found


def _workers(options: TilingOptions, folder: str) -> Any:
    """The workers of a run whose working folder is `folder`."""
    if options.scheduler:
        from .dask_workers import Cluster

        return Cluster(options.scheduler, folder)
    workers, threads = options.local_workers, options.threads
    return WorkerProcesses(workers, threads) if workers else ThisProcess(threads)


def _try_on_an_input(source: PipelineSource, survey: Survey, readers: int) -> None:
    """Let PDAL prepare the pipeline on one input, so that missing dimensions and unknown options
    fail before any tile.
    """
    inputs = [s for s in survey.sources if s.path not in survey.unreadable and s.kind == "las"]
    if not inputs:
        return
    reader: dict[str, Any] = {**inputs[0].reader, "type": "readers.las", "filename": inputs[0].path}
    tags = [stage.get("tag") for stage in source.stages[:readers]]
    stages = [{**reader, "tag": tag} if tag else dict(reader) for tag in tags]
    with contextlib.suppress(DependencyError):  # the program pdal is not there to ask
        Pipeline(replace(source, stages=[*stages, *source.stages[readers:]]), whole=False).prepare()


class _Run:
    """The state of a run: jobs that are to be done, and that are done."""

    def __init__(
        self, plan: TilePlan, survey: Survey, store: Store, workers: Any, show: bool | None
    ) -> None:
        self.plan, self.survey, self.store, self.workers, self.show = (
            plan,
            survey,
            store,
            workers,
            show,
        )
        self.tiles: list[Job] = []  #: with points of their own, row by row
        self.outputs: list[Job] = []  #: one for each input file; empty where each tile is an output
        self.cpu_seconds = 0.0  #: of tasks, including failed ones
        self.peak_mb = 0.0  #: peak memory of a process
        self.messages_before: list[list[str]] = []  #: warnings and notes of the first round
        #: How far around a tile, in units of the coordinates, inputs are available: its halo may
        #: have to grow.
        self.farthest = max(4 * survey.halo_units, survey.halo_units + survey.grid.size)

    def _do(
        self, what: str, waiting: deque[Job], task_of: Callable[[Job], Callable[[], Any]]
    ) -> Iterator[Job]:
        """Run jobs as workers become free, save their records, and yield each; outputs may be added
        after every one.

        StageError where the first ones all fail for the same reason.
        """
        for job in waiting:
            self.store.forget(job.name)
        counted = [job for job in waiting if not job.is_output]
        done, failures = 0, []
        with Progress(sum(job.points for job in counted), what, enabled=self.show) as progress:
            for job, answer in run_tasks(self.workers, waiting, task_of):
                self.cpu_seconds += answer.cost.get("cpu_seconds", 0.0)
                self.peak_mb = max(self.peak_mb, answer.cost.get("peak_mb", 0.0))
                if answer.reason:
                    job.fail(answer.reason)
                else:
                    job.state, job.record = "done", answer.result | answer.cost
                    with contextlib.suppress(OSError):  # no room: a later run does it again
                        self.store.finish(job.name, job.mark, job.record)
                if not job.is_output:
                    done += not answer.reason
                    failures += [answer.reason] if answer.reason else []
                    failed = f", {len(failures)} failed" if failures else ""
                    progress.label = f"{what}, {done} of {len(counted)}{failed}"
                    progress.update(job.points)
                if job.outputs:
                    progress.clear()  # messages about it start on a new line
                yield job
                if not done and len(failures) >= _HOPELESS and len(set(failures)) == 1:
                    raise StageError(
                        f"the first {len(failures)} tiles all failed for the same reason, so the "
                        "run was stopped",
                        found=failures[0],
                    )

    # ---- inputs ----------------------------------------------------------------------------------------------

    def read_inputs(self, needed: Collection[str] | None = None) -> None:
        """Read LAS and LAZ files once, sort their points by location, and save their index.

        Files that an earlier run read are read again where they changed, or where their points are
        `needed` (paths) and the copy of these is gone or damaged.
        """
        survey, store = self.survey, self.store
        waiting: deque[Job] = deque()
        for source in survey.sources:
            if source.kind != "las" or source.path in survey.unreadable:
                continue
            name = fingerprint(source.path, vars(survey.grid))
            copy = store.path(name, ".points")
            # Without a valid record it is read again.
            with contextlib.suppress(ValueError, TypeError, KeyError, OverflowError):
                index = CloudIndex.parse(store.note(name), copy)
                wanted = source.path in (needed or ())
                known = source.path in survey.indexes or index.is_of(source.path)
                if known and (not wanted or is_intact(index)):
                    survey.indexes[source.path] = index
                    continue
            waiting.append(Job(name, survey.extents[source.path].count, source=source, mark=copy))

        def task_of(job: Job) -> Callable[[], Any]:
            assert job.source is not None
            return partial(sort_points, job.source.path, survey.grid, job.mark)

        for job in self._do("reading the inputs", waiting, task_of):
            assert job.source is not None
            path = job.source.path
            if f"the {TEMPORARY} file" in job.reason:  # the input is not the cause
                raise StageError(job.reason)
            if job.reason:
                survey.unreadable[path] = job.reason
                continue
            index = survey.indexes[path] = CloudIndex.parse(job.record, job.mark)
            if index.count and (odd := las_check.beyond_box(path, index.box)):
                survey.messages.append(odd)
        survey.place()

    def inputs_of_waiting(self) -> set[str]:
        """Inputs whose points are read by waiting tiles."""
        far = self.farthest
        if first := self.plan.first:
            far += (self.plan.sees_m + first.blocks.side + first.blocks.reach) / self.survey.unit
            far += self.survey.squares.size
        waiting = [job.tile for job in self.tiles if job.state == "waiting"]
        return {source.path for tile in waiting for source in self.survey.near(tile, far)}

    # ---- tiles and outputs -----------------------------------------------------------------------------------

    def find_jobs(self) -> None:
        """Find all tiles and outputs; those with unreadable inputs fail.

        Their marks are fingerprints of everything that affects a result, including every input that
        may be read for it.
        """
        plan, survey, grid = self.plan, self.survey, self.survey.grid
        sees = plan.sees_m / survey.unit
        tail = [plan.tail, plan.extra_dims, survey.stamps_of(plan.tail)]
        common = fingerprint(
            build(),
            [plan.head, survey.stamps_of(plan.head), plan.creates, plan.halo_m, sees],
            [vars(grid), survey.options.most_points],
            tail if survey.per == "tile" else [],
        )
        for tile, points in survey.tiles().items():
            job = Job(grid.name(tile), points, tile)
            job.mark = fingerprint(
                common, tile, survey.seen(survey.near(tile, max(sees, self.farthest)))
            )
            if bad := [s.path for s in survey.near(tile, sees) if s.path in survey.unreadable]:
                job.fail(f"an input here cannot be read: {bad[0]}", bad[0])
            self.tiles.append(job)
        if survey.per == "tile":
            named = outputs_for(plan, survey.paths, [job.name for job in self.tiles])
            for job, paths in zip(self.tiles, named, strict=True):
                job.outputs = paths
            return
        by_tile = {job.tile: job for job in self.tiles}
        for source, paths in zip(survey.sources, survey.outputs, strict=True):
            out = Job(f"file-{source.key}", source=source, outputs=paths)
            if index := survey.indexes.get(source.path):
                out.points, out.jobs = index.count, [by_tile[i, j] for i, j, _ in index.tiles]
            out.mark = fingerprint(
                survey.seen([source]), tail, [job.mark for job in out.jobs], paths
            )
            if source.path in survey.unreadable:
                out.fail(f"its input cannot be read: {source.path}", source.path)
            self.outputs.append(out)

    def take_over(self) -> None:
        """Keep the results of an earlier run; tiles that no output needs are not run again."""
        needed = {job.name for out in self._unkept(self.outputs) for job in out.jobs}
        self._unkept(job for job in self.tiles if job.outputs is not None or job.name in needed)
        for job in self.tiles:
            if job.state == "waiting" and job.outputs is None and job.name not in needed:
                known = self.store.note(job.name)
                job.state, job.record = (
                    "kept",
                    known if known.get("fingerprint") == job.mark else {},
                )

    def _unkept(self, jobs: Iterable[Job]) -> deque[Job]:
        """The waiting jobs that no earlier run has finished."""
        waiting = deque(job for job in jobs if job.state == "waiting")
        for job in waiting:
            if known := self.store.finished(job.name, job.mark):
                job.state, job.record = "kept", known
        return deque(job for job in waiting if job.state == "waiting")

    def _context(self) -> RunContext:
        """The context of all tiles."""
        survey, most = self.survey, self.survey.options.most_points
        if survey.density.points <= most:
            most = 1 << 62  # all points fit, however wide the halo
        plan = replace(self.plan, readers=[])  # tasks travel, and there may be thousands
        threads, scratch = self.workers.threads, str(self.store.scratch)
        grids = survey.grid, survey.squares
        return RunContext(plan, *grids, survey.unit, survey.bounds, threads, most, scratch)

    def make_outputs(self, finished: Callable[[Job], None] | None = None) -> None:
        """Run all waiting tiles, and outputs as soon as their last tile is done. `finished` is
        called with outputs.
        """
        survey, store, context = self.survey, self.store, self._context()
        if self.plan.first is not None and len(self.tiles) > 1:
            context = replace(context, rasters=str(store.kept))
        waiting = deque(job for job in self.tiles if job.state == "waiting")
        users: dict[str, list[Job]] = {}
        for out in self.outputs:
            _make_ready(out, waiting)
            for job in out.jobs:
                users.setdefault(job.name, []).append(out)

        def task_of(job: Job) -> Callable[[], Any]:
            if job.source is not None:
                results = [store.path(each.name) for each in job.jobs]
                assert job.outputs is not None
                plan, scratch = context.plan, context.scratch
                return partial(
                    write_file, plan, job.source, job.points, results, job.outputs, scratch
                )
            sources = survey.near(job.tile, self.farthest)
            complete = (
                math.inf if len(sources) == len(survey.placed) else self.farthest * survey.unit
            )
            given = survey.readable(sources)
            result = store.path(job.name)
            return partial(run_tile, context, job.tile, given, complete, result, job.outputs)

        for job in self._do("tiles", waiting, task_of):
            if (
                finished is not None
                and job.state == "done"
                and job.outputs
                and job.record["outputs"]
            ):
                finished(job)
            for out in users.get(job.name, ()):
                _make_ready(out, waiting)

    def forget(self) -> None:
        """Remove files that no job needs any more."""
        needed = {
            f"{job.name}.npz" for out in self.outputs if out.state == "failed" for job in out.jobs
        }
        if any(job.state == "failed" for job in self.tiles):
            needed |= {
                path.name for path in self.store.kept.glob("*.[bf]*.npz")
            }  # blocks and first rounds
        self.store.remove(".npz", needed)
        self.store.remove(".points")

    # ---- the first round, before the tiles ---------------------------------------------------------------------------

    def make_ground(self) -> None:
        """Make what waiting tiles need and an earlier run has not left; jobs that depend on failed
        ones fail, too.
        """
        first, survey, store = self.plan.first, self.survey, self.store
        if first is None or len(self.tiles) == 1:
            return
        unit, context, squares = survey.unit, self._context(), survey.squares
        by_tile = {job.tile: job for job in self.tiles}
        points: Counter[tuple[int, int]] = Counter()  # of squares
        factor = round(squares.size / survey.grid.size)
        for (i, j), job in by_tile.items():
            points[i // factor, j // factor] += job.points
        boxes = {tile: survey.grid.box(tile) for tile in by_tile}
        spill = first.blocks.spill
        places = {b for box in boxes.values() for b in blocks_around(context, box, spill)}
        # Blocks and tiles left by an earlier run with other inputs must not be used.
        store.remove(".block.npz", [f"{block_name(block)}.npz" for block in places])
        store.remove(".first.npz", [f"{square_name(squares, each)}.npz" for each in points])
        around = self.farthest * unit + first.blocks.margin
        wanted = {
            job.name: places.intersection(blocks_around(context, boxes[tile], around))
            for tile, job in by_tile.items()
            if job.state == "waiting"
        }
        near: dict[tuple[int, int], list[tuple[int, int]]] = {
            b: [] for b in sorted(set().union(*wanted.values()))
        }
        for square in points:
            box = squares.box(square)
            for block in near.keys() & blocks_around(context, box, first.blocks.reach):
                near[block].append(square)
        head = self.plan.head[: first.at + 1]
        common = [
            build(),
            head,
            survey.stamps_of(head),
            survey.layout,
            first.halo_m,
            unit,
            first.kept,
        ]

        def sources(square: tuple[int, int]) -> list[IndexedSource]:
            return survey.readable(survey.near_box(squares.box(square, first.halo_m / unit)))

        def first_task(job: Job) -> Callable[[], Any]:
            return partial(
                run_first_round, context, job.tile, sources(job.tile), store.path(job.name)
            )

        firsts: dict[tuple[int, int], Job] = {}
        for square in sorted({square for each in near.values() for square in each}):
            mark = fingerprint(common, square, survey.seen([s for s, _ in sources(square)]))
            firsts[square] = Job(square_name(squares, square), points[square], square, mark=mark)
        for job in self._do("lowest points of cells", self._unkept(firsts.values()), first_task):
            self.messages_before.append(job.record.get("messages", []))

        def block_task(job: Job) -> Callable[[], Any]:
            left = [store.path(firsts[square].name) for square in near[job.tile]]
            return partial(make_block, context.plan, job.tile, left, store.path(job.name))

        blocks: dict[tuple[int, int], Job] = {}
        for block, around_it in near.items():
            mark = fingerprint(common, block, [firsts[square].mark for square in around_it])
            job = blocks[block] = Job(block_name(block), 1, block, mark=mark)
            job.fail_with(firsts[square] for square in around_it)
        for _ in self._do("ground by blocks", self._unkept(blocks.values()), block_task):
            pass
        for job in self.tiles:
            job.fail_with(blocks[block] for block in sorted(wanted.get(job.name, ())))


def _make_ready(out: Job, waiting: deque[Job]) -> None:
    """Queue an output when its last tile is done."""
    if out.state != "waiting" or any(job.state == "waiting" for job in out.jobs):
        return
    failed = [job for job in out.jobs if job.state == "failed"]
    if failed:
        others = f", and {len(failed) - 1} more of its tiles" if len(failed) > 1 else ""
        blocked = failed[0].blocked_by if all(job.blocked_by for job in failed) else ""
        out.fail(f"tile {failed[0].name} failed{others}", blocked)
    else:
        out.state = "ready"
        waiting.appendleft(out)


def estimate(plan: TilePlan, survey: Survey) -> TiledRun:
    """What a run would do: tiles, points, memory and disk, estimated from the headers of the inputs
    (``--dry-run``).
    """
    grid, options, density = survey.grid, survey.options, survey.density
    tiles = [Job(grid.name(tile), points, tile) for tile, points in survey.tiles().items()]
    if survey.per == "tile":
        outputs_for(plan, survey.paths, [job.name for job in tiles])
    count, read = density.points, density.read_by(grid.size, survey.halo_units)
    kept = float(count * _KEPT)
    if plan.first is not None:
        cells = density.area * (survey.unit / plan.first.blocks.cell) ** 2
        kept += count * _KEPT_BEFORE + cells * _KEPT_OF_CELL
    largest = density.largest if survey.per == "file" else 0
    summary = survey.figures(plan) | {
        "workers": options.local_workers,
        "threads_per_worker": options.threads,
        "points": count,
        "points_read_by_a_tile": read,
        "memory_mb_of_a_worker": worker_bytes(read, largest, survey.block_bytes) / 2**20,
        "disk_gb": kept / 1e9,
        "states": {"waiting": len(tiles)},
    }
    return TiledRun(tiles, [], survey.unreadable, [], survey.messages, summary)
