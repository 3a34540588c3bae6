"""Run a plan in tiles: read the inputs, run rounds and tiles, assemble outputs from them."""

from __future__ import annotations

import contextlib
import math
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from ..base import las_check
from ..base.errors import DependencyError, StageError
from ..base.files import sweep
from ..base.hashing import fingerprint
from ..base.jit import count_cached_kernels
from ..base.json_types import StageJson
from ..base.messages import print_messages
from ..base.progress import Progress
from ..base.version import build
from ..pipeline.json_source import Override
from ..pipeline.pdal_facts import check_flags, check_inputs, check_units
from ..pipeline.run import Pipeline
from ..pipeline.spatial_reference import NO_REFERENCE
from ..pipeline.workers import ThisProcess, WorkerProcesses, run_tasks
from ..stages.points import METERS_ASSUMED
from .earlier_rounds import block_name, blocks_near, make_block, square_name
from .inputs import CloudIndex, Survey
from .jobs import InterruptedRun, Job, Store, TiledRun, messages_of, summarize
from .options import Box, TileGrid, TilingOptions, worker_bytes
from .plan import RunContext, TilePlan, make_plan, outputs_for
from .run_tile import run_tile
from .sorted_points import TEMPORARY, sort_points
from .write_outputs import write_file

#: A run stops when this many tiles failed for the same reason and none succeeded (not tuned).
_HOPELESS = 10
# These estimate a dry run's need of disk; the true number depends on the dimensions of the stages.
#: Bytes on disk for the results of a point of each round.
_KEPT = 60
#: Bytes on disk for a cell of the raster of a far-reaching stage.
_KEPT_OF_CELL = 112


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
    pipeline = source if isinstance(source, Pipeline) else Pipeline(source, overrides)
    plan = make_plan(pipeline, chosen.buffer)
    return run_plan(plan, chosen, dry_run=dry_run, progress=progress, pipeline=pipeline)


def run_plan(
    plan: TilePlan,
    chosen: TilingOptions,
    *,
    dry_run: bool = False,
    progress: bool | None = None,
    finished: Callable[[Job], None] | None = None,
    pipeline: Pipeline | None = None,
) -> TiledRun:
    """Run a plan; see :func:`run_tiled`.

    `finished` is called with every output that was written. `pipeline` is first validated on one
    input.
    """
    started = time.monotonic()
    folder = Path(plan.writers[0]["filename"]).absolute().parent
    resumed = chosen.resume and chosen.tile is None
    known = Store(folder).note("run") if resumed else {}
    survey = Survey(plan, chosen, known if "square" in known else None)
    plan = replace(plan, copied=plan.copied and chosen.per == "file")
    if not plan.copied:
        _refuse_misread(plan, survey, chosen.per == "tile")
    if pipeline is not None and not plan.copied:
        _try_on_an_input(pipeline, survey, len(plan.readers))
    if dry_run:
        return estimate(plan, survey)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        what = "the folder of the output cannot be created"
        raise StageError(what, found=f"{folder}: {error.strerror}") from None
    if plan.makes and progress is not False and not chosen.scheduler and not count_cached_kernels():
        print_messages("compiling for this processor first, once: it takes a minute or two")
    folders = {folder, *(Path(path).parent for paths in survey.outputs for path in paths)}
    with Store(folder) as store:
        if not chosen.resume:
            store.clear()
        store.finish("run", "", survey.layout)
        try:
            with workers_of(survey.options, str(store.folder)) as workers:
                run = _Run(plan, survey, store, workers, progress)
                run.read_inputs()
                run.find_jobs()
                if chosen.resume:
                    run.take_over()
                    run.read_inputs(run.inputs_of_waiting())
                interrupted = True
                with contextlib.suppress(KeyboardInterrupt):
                    run.make_rounds()
                    run.make_outputs(finished)
                    run.forget()
                    interrupted = False
        finally:
            for each in (*folders, store.kept):
                sweep(each)  # left by workers that were killed
    result = run.result(time.monotonic() - started)
    if interrupted:
        raise InterruptedRun(result)
    return result


def _refuse_misread(plan: TilePlan, survey: Survey, together: bool) -> None:
    """Refuse inputs that PDAL would misread, `together` or one by one, before the plan's tail."""
    readers = [{**source.reader, "filename": source.path} for source in survey.readable()]
    for stages in [readers] if together else [[reader] for reader in readers]:
        for check in (check_inputs, check_units, check_flags):
            check([*stages, *plan.tail])


def workers_of(options: TilingOptions, folder: str) -> Any:
    """Return the workers of a run whose working folder is `folder`."""
    if options.scheduler:
        from .dask_workers import Cluster

        return Cluster(options.scheduler, folder)
    workers, threads = options.local_workers, options.threads
    return WorkerProcesses(workers, threads) if workers else ThisProcess(threads)


def _try_on_an_input(pipeline: Pipeline, survey: Survey, readers: int) -> None:
    """Let PDAL prepare the pipeline on one input: what is wrong fails before any tile."""
    source = pipeline.source
    inputs = survey.readable()
    reader: StageJson = {**inputs[0].reader, "filename": inputs[0].path}
    tags = [stage.get("tag") for stage in source.stages[:readers]]
    stages = [{**reader, "tag": tag} if tag else dict(reader) for tag in tags]
    with contextlib.suppress(DependencyError):  # the program pdal is not there to ask
        trial = replace(source, stages=[*stages, *source.stages[readers:]])
        Pipeline(trial, ready=pipeline.expanded.ours).prepare()


class SurveyRun:
    """A survey, the working folder and the workers of a run; it reads inputs and runs jobs."""

    def __init__(self, survey: Survey, store: Store, workers: Any, show: bool | None) -> None:
        self.survey, self.store = survey, store
        self.workers, self.show = workers, show
        self.edited: list[str] = []  #: outputs that a person changed since an earlier run
        self.cpu_seconds = 0.0  #: of tasks, including failed ones
        self.peak_mb = 0.0  #: peak memory of a process

    def do(
        self, what: str, waiting: deque[Job], task_of: Callable[[Job], Callable[[], Any]]
    ) -> Iterator[Job]:
        """Run jobs as workers become free, save their records, and yield each.

        Outputs may be added after every one. StageError where the first ones all fail for the same
        reason.
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
                        self.store.finish(job.name, job.digest, job.record)
                if not job.is_output:
                    done += not answer.reason
                    failures += [answer.reason] if answer.reason else []
                    failed = f", {len(failures)} failed" if failures else ""
                    progress.label = f"{what}, {done} of {len(counted)}{failed}"
                    progress.update(job.points)
                if job.outputs:
                    progress.clear()  # messages about it start on a new line
                yield job
                if not done:
                    _stop_if_hopeless(failures)

    def read_inputs(self, needed: Collection[str] = ()) -> None:
        """Read files once, sort their points by location, and save their index.

        Files that an earlier run read are read again where they changed, or where their points are
        `needed` (paths).
        """
        survey, store = self.survey, self.store
        waiting: deque[Job] = deque()
        for source in survey.readable():
            if source.index and (source.index.copy or source.path not in needed):
                continue
            name = fingerprint(source.path, vars(survey.grid))
            # Without a valid record it is read again.
            with contextlib.suppress(ValueError, TypeError, KeyError, OverflowError):
                index = CloudIndex.parse(store.note(name))
                if source.path not in needed and index.is_of(source.path):
                    source.index = index
                    continue
            assert source.extent is not None
            waiting.append(Job(name, source.extent.count, source=source))

        def copy_of(job: Job) -> str:
            return str(store.scratch / f"{job.name}.points")

        def task_of(job: Job) -> Callable[[], Any]:
            assert job.source is not None
            return partial(sort_points, job.source.path, survey.grid, copy_of(job))

        for job in self.do("reading the inputs", waiting, task_of):
            assert job.source is not None
            if f"the {TEMPORARY} file" in job.reason:  # the input is not the cause
                raise StageError(job.reason)
            job.source.fault = job.reason
            if not job.reason:
                job.source.index = index = CloudIndex.parse(job.record, copy_of(job))
                if index.count:
                    survey.messages += filter(
                        None, [las_check.beyond_box(job.source.path, index.box)]
                    )
        survey.place()

    def unkept(self, jobs: Iterable[Job]) -> deque[Job]:
        """Return the waiting jobs that no earlier run has finished."""
        waiting = deque(job for job in jobs if job.state == "waiting")
        for job in waiting:
            if known := self.store.finished(job.name, job.digest):
                job.state, job.record = "kept", known
            elif not self.survey.options.overwrite and (paths := self.store.edited(job.name)):
                job.state, job.record = "kept", self.store.note(job.name)
                self.edited += paths
        return deque(job for job in waiting if job.state == "waiting")


class _Run(SurveyRun):
    """The state of a run of a plan: jobs that are to be done, and that are done."""

    def __init__(
        self, plan: TilePlan, survey: Survey, store: Store, workers: Any, show: bool | None
    ) -> None:
        super().__init__(survey, store, workers, show)
        self.plan = plan
        self.tiles: list[Job] = []  #: with points of their own, row by row
        self.squares: list[Job] = []  #: of the rounds before the last
        self.outputs: list[Job] = []  #: one for each input file; empty where each tile is an output
        self.messages_before: list[list[str]] = []  #: of the rounds before the last
        #: How far around a tile, in units of the coordinates, inputs are available: its halo may
        #: have to grow (four halos are room for that, not tuned).
        halo_units = max(part.halo_m for part in plan.rounds) / survey.unit
        self.farthest = max(4 * survey.halo_units, halo_units + survey.grid.size)

    def result(self, seconds: float) -> TiledRun:
        """Return what was done in a time."""
        survey = self.survey
        summary = survey.figures(self.plan) | {
            "workers": self.workers.slots,
            "threads_per_worker": self.workers.threads,
            **summarize(self.tiles, self.squares, self.cpu_seconds, seconds),
            "peak_mb_of_a_worker": self.peak_mb,
        }
        most = survey.options.most_points
        messages = messages_of(self.tiles, self.squares, self.messages_before, most)
        if any(NO_REFERENCE in text for text in survey.messages):  # it tells what is assumed
            messages = [text for text in messages if METERS_ASSUMED not in text]
        messages = survey.messages + messages
        changed = survey.changed()
        return TiledRun(self.tiles, self.outputs, survey.faults, changed, messages, summary)

    # ---- tiles and outputs -----------------------------------------------------------------------

    def inputs_of_waiting(self) -> set[str]:
        """Return the inputs whose points waiting tiles and their rounds read."""
        far = len(self.plan.rounds) * (self.farthest + self.survey.squares.size)
        if blocks := self.plan.blocks:
            far += (self.plan.sees_m + blocks.side + blocks.reach) / self.survey.unit
        waiting = [job.tile for job in self.tiles if job.state == "waiting"]
        return {source.path for tile in waiting for source in self.survey.near(tile, far)}

    def find_jobs(self) -> None:
        """Find all tiles and outputs; those with unreadable inputs fail.

        A job's digest is a fingerprint of everything that affects its result, including every input
        that may be read for it.
        """
        plan, survey, grid = self.plan, self.survey, self.survey.grid
        sees = plan.sees_m / survey.unit
        head_end, per_tile = len(plan.head), survey.options.per == "tile"
        tail = [plan.tail, plan.extra_dims, survey.stamps_of(plan.files[head_end:])]
        common = fingerprint(
            build(),
            [plan.head, survey.stamps_of(plan.files[:head_end]), plan.creates, plan.halo_m, sees],
            [vars(grid), survey.options.most_points],
            tail if per_tile else [],
        )
        for tile, points in survey.tiles().items():
            job = Job(grid.name(tile), points, tile)
            near = survey.near(tile, max(sees, self.farthest))
            job.digest = fingerprint(common, tile, [source.content for source in near])
            if bad := [source.path for source in survey.near(tile, sees) if source.fault]:
                job.fail(f"an input here cannot be read: {bad[0]}", blocked=True)
            self.tiles.append(job)
        self.plan = plan.adapt(len(self.tiles), survey.tiles_per_square)
        if per_tile:
            named = outputs_for(plan, survey.paths, [job.name for job in self.tiles])
            for job, paths in zip(self.tiles, named, strict=True):
                job.outputs = paths
            return
        by_tile = {job.tile: job for job in self.tiles}
        for source, paths in zip(survey.sources, survey.outputs, strict=True):
            out = Job(f"file-{source.key}", source=source, outputs=paths)
            if index := source.index:
                out.points, out.jobs = index.count, [by_tile[i, j] for i, j, _ in index.tiles]
            out.digest = fingerprint(source.content, tail, [job.digest for job in out.jobs], paths)
            if source.fault:
                out.fail(f"its input cannot be read: {source.path}", blocked=True)
            self.outputs.append(out)

    def take_over(self) -> None:
        """Keep the results of an earlier run; tiles that no output needs are not run again."""
        needed = {job.name for out in self.unkept(self.outputs) for job in out.jobs}
        self.unkept(job for job in self.tiles if job.outputs is not None or job.name in needed)
        outputs = {path for job in (*self.tiles, *self.outputs) for path in job.outputs or ()}
        self.survey.messages += [
            *_name_outputs(
                "outputs edited since they were written are kept (--overwrite replaces them)",
                self.edited,
            ),
            *_name_outputs(
                "outputs of inputs that are not among those of this run",
                self.store.left_over(outputs),
            ),
        ]
        for job in self.tiles:
            if job.state == "waiting" and job.outputs is None and job.name not in needed:
                known = self.store.note(job.name)
                job.state, job.record = (
                    "kept",
                    known if known.get("fingerprint") == job.digest else {},
                )

    @cached_property
    def _context(self) -> RunContext:
        """Return the context of all tasks."""
        survey, most = self.survey, self.survey.options.most_points
        if survey.density.points <= most:
            most = 1 << 62  # all points fit, however wide the halo
        plan = replace(self.plan, readers=[])  # tasks travel, and there may be thousands
        return RunContext(
            plan,
            grid=survey.grid,
            squares=survey.squares,
            unit=survey.unit,
            bounds=survey.bounds,
            threads=self.workers.threads,
            most_points=most,
            wkt=survey.reference.wkt,
            scratch=str(self.store.scratch),
            kept=str(self.store.kept),
        )

    def make_outputs(self, finished: Callable[[Job], None] | None = None) -> None:
        """Run all waiting tiles, and outputs as soon as their last tile is done.

        `finished` is called with outputs.
        """
        context, store = self._context, self.store
        waiting = deque(job for job in self.tiles if job.state == "waiting")
        users: dict[str, list[Job]] = {}
        for out in self.outputs:
            _make_ready(out, waiting)
            for job in out.jobs:
                users.setdefault(job.name, []).append(out)

        def task_of(job: Job) -> Callable[[], Any]:
            if job.source is None:
                return self._tile_task(len(self.plan.rounds) - 1, job)
            results = [store.path(each.name) for each in job.jobs]
            assert job.outputs is not None
            plan, scratch = context.plan, context.scratch
            return partial(write_file, plan, job.source, results, job.outputs, scratch)

        for job in self.do("tiles", waiting, task_of):
            written = job.state == "done" and job.outputs and job.record["outputs"]
            if finished is not None and written:
                finished(job)
            for out in users.get(job.name, ()):
                _make_ready(out, waiting)

    def _tile_task(self, number: int, job: Job) -> Callable[[], Any]:
        """Return the task that runs a round on a tile or square."""
        survey = self.survey
        box = self._context.grid_of(number).box(job.tile, self.farthest)
        sources = survey.near_box(box)
        complete = math.inf if len(sources) == len(survey.placed) else self.farthest * survey.unit
        target = self.store.path(job.name)
        readable = [source for source in sources if not source.fault]
        return partial(
            run_tile, self._context, number, job.tile, readable, complete, target, job.outputs
        )

    def forget(self) -> None:
        """Remove files that no job needs any more."""
        needed = {
            f"{job.name}.npz" for out in self.outputs if out.state == "failed" for job in out.jobs
        }
        if any(job.state == "failed" for job in self.tiles):
            for pattern in ("*.block.npz", "*.round*.npz"):
                needed |= {path.name for path in self.store.kept.glob(pattern)}
        self.store.remove(".npz", needed)

    # ---- rounds before the last ------------------------------------------------------------------

    def make_rounds(self) -> None:
        """Run the rounds that waiting tiles need and an earlier run has not left.

        Jobs that depend on failed ones fail, too.
        """
        waiting = [job for job in self.tiles if job.state == "waiting"]
        users = waiting
        layers: list[tuple[list[Job], list[Job]]] = []
        for number in reversed(range(len(self.plan.rounds) - 1)):
            layers.insert(0, self._layer(number, users))
            users = layers[0][0]
        for number, (squares, blocks) in enumerate(layers):
            for job in squares:
                job.fail_with(job.jobs)
            label = f"round {number + 1}"
            task_of = partial(self._tile_task, number)
            for job in self.do(label, self.unkept(squares), task_of):
                self.messages_before.append(job.record.get("messages", []))
            for job in blocks:
                job.fail_with(job.jobs)
            for _ in self.do(f"{label}, blocks", self.unkept(blocks), self._block_task):
                pass
            self.squares += squares
        for job in waiting:
            job.fail_with(job.jobs)
        _stop_if_hopeless([job.reason for job in waiting])

    @cached_property
    def _points_of_squares(self) -> dict[tuple[int, int], int]:
        """Return the squares that have points, and how many."""
        points: Counter[tuple[int, int]] = Counter()
        factor = self.survey.tiles_per_square
        for job in self.tiles:
            points[job.tile[0] // factor, job.tile[1] // factor] += job.points
        return points

    def _layer(self, number: int, users: list[Job]) -> tuple[list[Job], list[Job]]:
        """Return jobs for the squares of a round, and for blocks, that `users` need (their jobs).

        What an earlier run with other inputs left is removed.
        """
        context, survey, part = self._context, self.survey, self.plan.rounds[number]
        grid, every, unit = context.grid_of(number + 1), self._points_of_squares, survey.unit
        names = {square: f"{square_name(context, number, square)}.npz" for square in every}
        self.store.remove(f".round{number}.npz", names.values())
        squares: dict[tuple[int, int], Job] = {}
        blocks: dict[tuple[int, int], Job] = {}

        def squares_in(box: Box) -> list[Job]:
            places = sorted(every.keys() & survey.squares.covering(box))
            for place in places:
                squares[place] = squares.get(place) or self._square_job(number, place)
            return [squares[place] for place in places]

        far = self.farthest if self.plan.rounds[number + 1].halo_m else 0.0
        for job in users:
            box = grid.box(job.tile, far)
            job.jobs = squares_in(box) if part.kept else []
        if part.blocks is None:
            return list(squares.values()), []
        boxes = [survey.grid.box(job.tile) for job in self.tiles]
        places = {b for box in boxes for b in blocks_near(context, box, part.blocks.spill)}
        self.store.remove(".block.npz", [f"{block_name(place)}.npz" for place in places])
        distance_m = self.farthest * unit + part.blocks.margin
        for job in users:
            near = blocks_near(context, grid.box(job.tile), distance_m)
            for place in sorted(places.intersection(near)):
                if place not in blocks:
                    # One meter more, as the box may be rounded.
                    box_m = TileGrid(part.blocks.side).box(place, part.blocks.reach + 1.0)
                    x0, y0, x1, y1 = (side / unit for side in box_m)
                    needed = squares_in((x0, y0, x1, y1))
                    digest = fingerprint(place, part.blocks, [each.digest for each in needed])
                    blocks[place] = Job(block_name(place), 1, place, jobs=needed, digest=digest)
                job.jobs.append(blocks[place])
        return list(squares.values()), list(blocks.values())

    def _square_job(self, number: int, square: tuple[int, int]) -> Job:
        """Return the job of a square; its digest tells of all inputs that may matter."""
        survey, part = self.survey, self.plan.rounds[number]
        head = self.plan.head[: part.end + (part.blocks is not None)]
        far = max(self.plan.sees_m / survey.unit if number else 0.0, self.farthest)
        box = survey.squares.box(square, far)
        digest = fingerprint(
            [build(), head, survey.stamps_of(self.plan.files[: len(head)])],
            [survey.layout, survey.unit, vars(part), square],
            [source.content for source in survey.near_box(box) if not source.fault],
        )
        name = square_name(self._context, number, square)
        return Job(name, self._points_of_squares[square], square, digest=digest)

    def _block_task(self, job: Job) -> Callable[[], Any]:
        """Return the task that computes a block."""
        squares = [self.store.path(each.name) for each in job.jobs]
        return partial(make_block, self._context, job.tile, squares, self.store.path(job.name))


def _stop_if_hopeless(reasons: list[str]) -> None:
    """Stop the run where all tiles failed for the same reason (``""``: one did not fail)."""
    if len(reasons) >= _HOPELESS and len(set(reasons)) == 1 and reasons[0]:
        raise StageError(
            f"the first {len(reasons)} tiles all failed for the same reason: the run was stopped",
            found=reasons[0],
        )


def _name_outputs(what: str, paths: Sequence[str]) -> list[str]:
    """Return a message about outputs, if there are any."""
    more = f" and {len(paths) - 3:,} more" if len(paths) > 3 else ""
    return [f"{what}: {', '.join(paths[:3])}{more}"] if paths else []


def _make_ready(out: Job, waiting: deque[Job]) -> None:
    """Queue an output when its last tile is done."""
    if out.state != "waiting" or any(job.state == "waiting" for job in out.jobs):
        return
    failed = [job for job in out.jobs if job.state == "failed"]
    if failed:
        others = f", and {len(failed) - 1} more of its tiles" if len(failed) > 1 else ""
        blocked = all(job.blocked for job in failed)
        out.fail(f"tile {failed[0].name} failed{others}", blocked)
    else:
        out.state = "ready"
        waiting.appendleft(out)


def estimate(plan: TilePlan, survey: Survey) -> TiledRun:
    """Estimate a run from the headers of inputs: tiles, points, memory and disk (``--dry-run``)."""
    grid, options, density = survey.grid, survey.options, survey.density
    tiles = [Job(grid.name(tile), points, tile) for tile, points in survey.tiles().items()]
    if options.per == "tile":
        outputs_for(plan, survey.paths, [job.name for job in tiles])
    count, read = density.points, density.read_by(grid.size, survey.halo_units)
    kept = float(count * _KEPT * len(plan.rounds))
    if plan.blocks is not None:
        kept += density.area * (survey.unit / plan.blocks.cell) ** 2 * _KEPT_OF_CELL
    largest = density.largest if options.per == "file" else 0
    summary = survey.figures(plan) | {
        "workers": options.local_workers,
        "threads_per_worker": options.threads,
        "points": count,
        "points_read_by_a_tile": read,
        "memory_mb_of_a_worker": worker_bytes(read, largest, survey.block_bytes) / 2**20,
        "disk_gb": kept / 1e9,
        "states": {"waiting": len(tiles)},
    }
    return TiledRun(tiles, [], survey.faults, [], survey.messages, summary)
