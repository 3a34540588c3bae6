"""The tiles of a run and the outputs put together from them: what each is made of, and what an earlier run finished."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from ..base.version import build
from .file_task import FileTask
from .headrun import RunContext
from .index import CloudIndex
from .outcome import FileJob, TileJob
from .sources import InputSource
from .store import Store, fingerprint
from .survey import Survey
from .tile_task import TileTask
from .tileplan import TilePlan, outputs_for


class Worklist:
    """What a run has to do."""

    def __init__(self, plan: TilePlan, survey: Survey) -> None:
        self.plan, self.survey, self.options = plan, survey, survey.options
        self._tail = [plan.tail, plan.beside, survey.stamps_of(plan.tail)]
        self._common = fingerprint(
            build(),
            plan.head,
            survey.stamps_of(plan.head),
            plan.creates,
            [plan.halo_m, plan.sees_m],
            survey.grid.size,
            self.options.most_points,
            self._tail if survey.per == "tile" else [],
        )
        self._marks: dict[tuple[tuple[int, int], float], str] = {}
        self.messages_before: list[list[str]] = []  #: warnings and notes of the tasks of the rounds before
        self.jobs = self._jobs()  #: tiles with points of their own, row by row
        #: One for each input file; empty where each tile is an output.
        self.outputs = self._outputs() if survey.per == "file" else []

    def _jobs(self) -> list[TileJob]:
        plan, survey = self.plan, self.survey
        jobs = []
        for tile, points in survey.tiles().items():
            near = survey.near(tile, plan.sees_m / survey.unit)
            job = TileJob(tile, survey.grid.name(tile), points, near)
            bad = [s.path for s in near if s.path in survey.unreadable]
            if bad:
                job.state, job.blocked_by = "failed", bad[0]
                job.reason = f"an input here cannot be read: {bad[0]}"
            jobs.append(job)
        if survey.per == "tile":
            named = outputs_for(plan, [job.name for job in jobs], survey.paths)
            for job, paths in zip(jobs, named, strict=True):
                job.outputs = paths
        return jobs

    def mark_of(self, job: TileJob, record: dict[str, Any]) -> str:
        """Fingerprint of all that decides a tile's result: of every input that was read for it too.

        That is known from the record alone, as a tile may be read with a wider halo.
        """
        survey = self.survey
        halo_m = max(float(record.get("halo_m", 0.0)), self.plan.sees_m)
        if (job.tile, halo_m) not in self._marks:
            read = survey.near(job.tile, halo_m / survey.unit)
            seen = [[s.path, survey.stamps[s.path], s.reader] for s in read]
            self._marks[job.tile, halo_m] = fingerprint(self._common, job.tile, seen)
        return self._marks[job.tile, halo_m]

    def output_mark(self, out: FileJob, marks: Mapping[tuple[int, int], str]) -> str:
        """Fingerprint of all that decides an output, given those of its tiles."""
        source = out.source
        mine = [marks[job.tile] for job in out.jobs]
        made_of = [source.path, self.survey.stamps[source.path], source.reader, self._tail, mine]
        return fingerprint(*made_of, out.outputs)

    def _outputs(self) -> list[FileJob]:
        survey = self.survey
        by_tile = {job.tile: job for job in self.jobs}
        named = outputs_for(self.plan, survey.names, survey.paths)
        outputs = []
        for source, paths in zip(survey.sources, named, strict=True):
            out = FileJob(source, paths)
            if source.path in survey.indexes:
                out.points = survey.indexes[source.path].count
                out.jobs = [by_tile[i, j] for i, j, _ in survey.indexes[source.path].tiles]
            if source.path in survey.unreadable:
                out.state, out.blocked_by = "failed", source.path
                out.reason = f"its input cannot be read: {source.path}"
            outputs.append(out)
        return outputs

    def take_over(self, store: Store) -> None:
        """Keep what an earlier run finished; tiles that no output waits for need not be done again."""
        if self.survey.per == "tile":
            for job in self.jobs:
                known = store.written(job.name)
                if job.state == "waiting" and known and known["fingerprint"] == self.mark_of(job, known):
                    job.state, job.record = "kept", known
            return
        records = {job.tile: store.finished(job.name) for job in self.jobs}
        marks = {job.tile: self.mark_of(job, records[job.tile] or {}) for job in self.jobs}
        for out in self.outputs:
            known = store.written(out.source.key)
            if out.state == "waiting" and known and known["fingerprint"] == self.output_mark(out, marks):
                out.state, out.record = "kept", known
        needed = {job.tile for out in self.outputs if out.state == "waiting" for job in out.jobs}
        for job in self.jobs:
            if job.state != "waiting":
                continue
            known = records[job.tile]
            same = known is not None and known["fingerprint"] == marks[job.tile]
            if known is not None and same and (job.tile not in needed or store.has_result(job.name, known)):
                job.state, job.record = "kept", known
            elif job.tile not in needed:
                job.state = "kept"

    def forget_results(self, store: Store) -> None:
        """Remove results whose outputs are all written."""
        needed = {job.tile for out in self.outputs if out.state == "failed" for job in out.jobs}
        for job in self.jobs:
            if job.tile not in needed:
                store.result(job.name).unlink(missing_ok=True)
        if not any(job.state in ("waiting", "failed") for job in self.jobs):
            store.forget_left()
            store.forget_copies()

    def keep(self, store: Store, item: TileJob | FileJob) -> None:
        """Remember what was finished, for runs to come."""
        if isinstance(item, FileJob):
            marks = {job.tile: self.mark_of(job, job.record) for job in item.jobs}
            store.wrote(item.source.key, self.output_mark(item, marks), item.record)
        elif item.outputs is not None:
            store.wrote(item.name, self.mark_of(item, item.record), item.record)
        else:
            store.finish(item.name, self.mark_of(item, item.record), item.record)

    @property
    def farthest(self) -> float:
        """How far around a tile inputs are at hand: it may have to be read with wider surroundings."""
        return max(4 * self.survey.halo_units, self.survey.halo_units + self.survey.grid.size)

    def context(self, store: Store, threads: int) -> RunContext:
        """What all tiles have in common."""
        survey, scratch, most = self.survey, str(store.scratch), self.options.most_points
        if sum(header.count for header in survey.extents.values()) <= most:
            most = 1 << 62  # a wider halo never holds more than all there is, however far they reach
        run = replace(self.plan, readers=[])  # tasks travel, and there may be thousands
        return RunContext(run, survey.grid, survey.unit, survey.bounds, threads, most, scratch)

    def tasks(self, store: Store, threads: int):
        """A function that gives the task of a tile or an output."""
        plan, survey, scratch = self.plan, self.survey, str(store.scratch)
        context = self.context(store, threads)
        far = self.farthest
        before = str(store.tiles) if plan.first is not None and len(self.jobs) > 1 else ""

        def task_of(item: TileJob | FileJob) -> Callable[[], Any]:
            if isinstance(item, FileJob):
                count = survey.indexes[item.source.path].count
                results = [str(store.result(job.name)) for job in item.jobs]
                return FileTask(
                    item.source,
                    count,
                    results,
                    plan.tail,
                    plan.beside,
                    item.outputs,
                    scratch,
                    plan.makes,
                ).run
            sources = survey.near(item.tile, far)
            return TileTask(
                context,
                item.tile,
                [self.with_index(s) for s in sources if s.path not in survey.unreadable],
                math.inf if len(sources) == len(survey.placed) else far * survey.unit,
                str(store.result(item.name)),
                item.outputs,
                before,
            ).run

        return task_of

    def with_index(self, source: InputSource) -> tuple[InputSource, CloudIndex | None]:
        """A source and its index, of which the blocks are all that a worker needs."""
        index = self.survey.indexes.get(source.path)
        return source, index and replace(index, tiles=[])

    def inputs(self) -> set[str]:
        """Inputs whose points tiles read that are to be run."""
        far = self.farthest
        if self.plan.first is not None:
            far += (
                self.plan.first.far_m + self.plan.first.blocks.side + self.plan.first.blocks.reach
            ) / self.survey.unit
            far += self.survey.grid.size
        waiting = [job for job in self.jobs if job.state == "waiting"]
        return {source.path for job in waiting for source in self.survey.near(job.tile, far)}
