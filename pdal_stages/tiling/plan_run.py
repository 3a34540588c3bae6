"""The jobs of a plan: its tiles and outputs, what each depends on, and what of them is there."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from functools import cached_property, partial
from itertools import chain

from ..base.hashing import fingerprint
from ..base.messages import Message
from ..base.version import build
from ..pipeline.workers import Task, Workers
from .inputs import Survey
from .jobs import OutputJob, Store, TiledRun, TileJob, WritingJob, messages_of, summarize
from .plan import RunContext, TilePlan, outputs_for
from .run_tile import run_tile
from .survey_run import SurveyRun
from .write_outputs import write_file


class PlanRun(SurveyRun):
    """The state of a run of a plan: jobs that are to be done, and that are done."""

    def __init__(
        self, plan: TilePlan, survey: Survey, store: Store, workers: Workers, show: bool | None
    ) -> None:
        super().__init__(survey, store, workers, show)
        self.plan = plan
        self.tiles: list[TileJob] = []  #: with points of their own, row by row
        self.squares: list[list[TileJob]] = []  #: of each round before the last
        #: one for each input file; empty where each tile is an output
        self.outputs: list[OutputJob] = []
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
            **summarize(self.tiles, [*chain(*self.squares)], self.cpu_seconds, seconds),
            "peak_mb_of_a_worker": self.peak_mb,
        }
        most = survey.options.most_points
        inputs = [*survey.messages, *survey.warnings_of_boxes()]
        messages = messages_of(self.tiles, self.squares, inputs, most)
        changed = survey.changed()
        return TiledRun(self.tiles, self.outputs, survey.faults, changed, messages, summary)

    # ---- tiles and outputs -----------------------------------------------------------------------

    def square_of(self, job: TileJob) -> tuple[int, int]:
        """Return the square that a tile lies in."""
        factor = self.survey.tiles_per_square
        return job.tile[0] // factor, job.tile[1] // factor

    def inputs_of_waiting(self, squares: Collection[tuple[int, int]]) -> set[str]:
        """Return the inputs whose points waiting tiles, some squares and their rounds read."""
        far = len(self.plan.rounds) * (self.farthest + self.survey.squares.size)
        if blocks := self.plan.blocks:
            far += (self.plan.sees_m + blocks.side + blocks.reach) / self.survey.unit
        waiting = [
            job.tile
            for job in self.tiles
            if job.state == "waiting" or self.square_of(job) in squares
        ]
        return {source.path for tile in waiting for source in self.survey.near(tile, far)}

    def find_jobs(self) -> None:
        """Find all tiles and outputs; those with unreadable inputs fail.

        A job's digest is a fingerprint of everything that affects its result, including every input
        that may be read for it.
        """
        plan, survey, grid = self.plan, self.survey, self.survey.grid
        sees = plan.sees_m / survey.unit
        count, per_tile = len(plan.in_tiles), survey.options.per == "tile"
        writing = [plan.per_output, plan.extra_dims, survey.stamps_of(plan.files[count:])]
        common = fingerprint(
            build(),
            [plan.in_tiles, survey.stamps_of(plan.files[:count]), plan.creates, plan.halo_m, sees],
            [plan.shared_fields(), survey.system, vars(grid), survey.options.most_points],
            writing if per_tile else [],
        )
        for tile, points in survey.tiles().items():
            job = TileJob(grid.name(tile), points, tile)
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
            out = OutputJob(f"file-{source.key}", source=source, outputs=paths)
            if index := source.index:
                out.points, out.needs = index.count, [by_tile[i, j] for i, j, _ in index.tiles]
            digests = [job.digest for job in out.needs]
            out.digest = fingerprint(source.content, writing, digests, paths)
            if source.fault:
                out.fail(f"its input cannot be read: {source.path}", blocked=True)
            self.outputs.append(out)

    def take_over(self) -> None:
        """Keep the results of an earlier run.

        Tiles that no output needs run again only where their record is lost, unless what they gave
        was edited since.
        """
        needed = {job.name for out in self.unkept(self.outputs) for job in out.needs}
        self.unkept(job for job in self.tiles if job.outputs is not None or job.name in needed)
        edited_outputs = [out for out in self.outputs if {*self.edited} & {*(out.outputs or ())}]
        edited = {job.name for out in edited_outputs for job in out.needs}
        jobs: list[WritingJob] = [*self.tiles, *self.outputs]
        outputs = {path for job in jobs for path in job.outputs or ()}
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
                known = self.store.record(job.name, job.digest)
                if known or job.name in edited:
                    job.keep(known or {})

    @cached_property
    def context(self) -> RunContext:
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

    def make_outputs(self, finished: Callable[[WritingJob], None] | None = None) -> None:
        """Run all waiting tiles, and outputs as soon as their last tile is done.

        `finished` is called with outputs.
        """
        context, store = self.context, self.store
        waiting = deque[WritingJob](job for job in self.tiles if job.state == "waiting")
        users: dict[str, list[OutputJob]] = {}
        for out in self.outputs:
            _make_ready(out, waiting)
            for job in out.needs:
                users.setdefault(job.name, []).append(out)

        def task_of(job: WritingJob) -> Task:
            if isinstance(job, TileJob):
                return self.tile_task(len(self.plan.rounds) - 1, job)
            assert job.outputs is not None
            results = [store.path(each.name) for each in job.needs]
            plan, scratch = context.plan, context.scratch
            return partial(write_file, plan, job.source, results, job.outputs, scratch)

        for job in self.do("tiles", waiting, task_of):
            has_written = job.record is not None and job.record.written is not None
            if finished is not None and has_written:
                finished(job)
            for out in users.get(job.name, ()):
                _make_ready(out, waiting)

    def tile_task(self, number: int, job: TileJob) -> Task:
        """Return the task that runs a round on a tile or square."""
        survey = self.survey
        box = self.context.grid_of(number).box(job.tile, self.farthest)
        sources = survey.near_box(box)
        complete = math.inf if len(sources) == len(survey.placed) else self.farthest * survey.unit
        target = self.store.path(job.name)
        readable = [source for source in sources if not source.fault]
        return partial(
            run_tile, self.context, number, job.tile, readable, complete, target, job.outputs
        )

    def forget(self) -> None:
        """Remove files that no job needs any more."""
        needed = {
            f"{job.name}.npz" for out in self.outputs if out.state == "failed" for job in out.needs
        }
        if any(job.state == "failed" for job in self.tiles):
            for pattern in ("*.block.npz", "*.round*.npz"):
                needed |= {path.name for path in self.store.kept.glob(pattern)}
        self.store.remove(".npz", needed)


def _name_outputs(what: str, paths: Sequence[str]) -> list[Message]:
    """Return a message about outputs, if there are any."""
    more = f" and {len(paths) - 3:,} more" if len(paths) > 3 else ""
    return [Message(f"{what}: {', '.join(paths[:3])}{more}")] if paths else []


def _make_ready(out: OutputJob, waiting: deque[WritingJob]) -> None:
    """Queue an output when its last tile is done."""
    if out.state != "waiting" or any(job.state == "waiting" for job in out.needs):
        return
    failed = [job for job in out.needs if job.state == "failed"]
    if failed:
        others = f", and {len(failed) - 1} more of its tiles" if len(failed) > 1 else ""
        blocked = all(job.blocked for job in failed)
        out.fail(f"tile {failed[0].name} failed{others}", blocked)
    else:
        out.state = "ready"
        waiting.appendleft(out)
