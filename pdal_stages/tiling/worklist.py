"""The tiles of a run and the outputs put together from them: what each is made of, and what an earlier run finished."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from ..base.version import __version__
from ..stages import registry
from .assemble import FileTask
from .headrun import Recipe
from .outcome import Job, Output
from .settings import TilingOptions
from .sources import Source
from .store import Store, fingerprint
from .survey import Survey
from .tileplan import TilePlan, outputs_for
from .tilework import TileTask


class Worklist:
    """What a run has to do.

    Attributes
    ----------
    jobs : list of Job
        Tiles with points of their own, row by row.
    outputs : list of Output
        One for each input file; empty where each tile is an output.
    """

    def __init__(self, plan: TilePlan, survey: Survey) -> None:
        self.plan, self.survey = plan, survey
        self.jobs = self._jobs()
        self.outputs = self._outputs() if survey.per == "file" else []

    def _jobs(self) -> list[Job]:
        plan, survey = self.plan, self.survey
        jobs = []
        for tile, points in survey.tiles().items():
            near = survey.near(survey.grid.box(tile), survey.margin)
            job = Job(tile, survey.grid.name(tile), points, near)
            bad = [s.path for s in near if s.path in survey.unreadable]
            if bad:
                job.state, job.blocked_by = "failed", bad[0]
                job.reason = f"an input here cannot be read: {bad[0]}"
            jobs.append(job)
        tail: list[Any] = []
        if survey.per == "tile":
            named = outputs_for(plan, [job.name for job in jobs], survey.paths)
            for job, paths in zip(jobs, named, strict=True):
                job.outputs = paths
            tail = [plan.tail, _files_of(plan.tail)]
        common = fingerprint(
            __version__, plan.head, _files_of(plan.head), plan.creates, plan.halo, survey.grid.size, tail
        )
        for job in jobs:
            job.mark = fingerprint(common, job.tile, [[s.path, s.stamp(), s.reader] for s in job.sources])
        return jobs

    def _outputs(self) -> list[Output]:
        survey = self.survey
        by_tile = {job.tile: job for job in self.jobs}
        named = outputs_for(self.plan, [source.stem for source in survey.sources], survey.paths)
        tail = [self.plan.tail, _files_of(self.plan.tail)]
        outputs = []
        for source, paths in zip(survey.sources, named, strict=True):
            out = Output(source, paths)
            if source.path in survey.indexes:
                out.jobs = [by_tile[i, j] for i, j, _ in survey.indexes[source.path].tiles]
            if source.path in survey.unreadable:
                out.state, out.blocked_by = "failed", source.path
                out.reason = f"its input cannot be read: {source.path}"
            marks = [job.mark for job in out.jobs]
            out.mark = fingerprint(source.path, source.stamp(), source.reader, tail, marks)
            outputs.append(out)
        return outputs

    def take_over(self, store: Store) -> None:
        """Keep what an earlier run finished; tiles that no output waits for need not be done again."""
        if self.survey.per == "tile":
            for job in self.jobs:
                if job.state == "waiting" and (known := store.written(job.name, job.mark)) is not None:
                    job.state, job.report = "kept", known
            return
        for out in self.outputs:
            if out.state == "waiting" and (known := store.written(out.source.key, out.mark)) is not None:
                out.state, out.report = "kept", known
        needed = {job.tile for out in self.outputs if out.state == "waiting" for job in out.jobs}
        for job in self.jobs:
            if job.state != "waiting":
                continue
            known = store.finished(job.name, job.mark)
            if known is not None and (job.tile not in needed or store.result(job.name).exists()):
                job.state, job.report = "kept", known
            elif job.tile not in needed:
                job.state = "kept"

    def forget_results(self, store: Store) -> None:
        """Remove results whose outputs are all written."""
        needed = {job.tile for out in self.outputs if out.state == "failed" for job in out.jobs}
        for job in self.jobs:
            if job.tile not in needed:
                store.result(job.name).unlink(missing_ok=True)

    def tasks(self, store: Store, threads: int, options: TilingOptions):
        """A function that gives the task of a tile or an output."""
        plan, survey = self.plan, self.survey
        recipe = Recipe(
            grid=survey.grid,
            unit=survey.unit,
            bounds=survey.bounds,
            head=plan.head,
            later=plan.later,
            tail=plan.tail,
            halo=plan.halo,
            creates=plan.creates,
            threads=threads,
            most_points=options.most_points,
            scratch=str(store.scratch),
        )
        # Farther inputs too: a tile may have to be read with wider surroundings.
        far = max(4 * survey.margin, survey.margin + survey.grid.size)

        def task_of(item: Job | Output) -> TileTask | FileTask:
            if isinstance(item, Output):
                count = survey.indexes[item.source.path].count
                results = [str(store.result(job.name)) for job in item.jobs]
                return FileTask(item.source, count, results, plan.tail, item.paths, recipe.scratch)
            sources = survey.near(survey.grid.box(item.tile), far)
            return TileTask(
                recipe,
                item.tile,
                [self._with_index(s) for s in sources if s.path not in survey.unreadable],
                item.mark,
                str(store.result(item.name)),
                str(store.done(item.name)),
                item.outputs,
            )

        return task_of

    def _with_index(self, source: Source):
        index = self.survey.indexes.get(source.path)
        return source, None if index is None else replace(
            index, tiles=[]
        )  # blocks are all that a worker needs


def _files_of(stages: list[dict[str, Any]]) -> list[Any]:
    """Size and time of change of files that stages of ours read, e.g. models."""
    found = []
    for stage in stages:
        if stage["type"] not in registry.stages():
            continue
        for name, value in stage.items():
            if isinstance(value, str) and Path(value).is_file():
                stat = Path(value).stat()
                found.append([name, stat.st_size, stat.st_mtime_ns])
    return found
