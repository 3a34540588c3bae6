"""A run over a survey: it reads the inputs, runs jobs as workers become free, and keeps records."""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import AbstractContextManager
from functools import partial
from typing import Any

from ..base import las_check
from ..base.errors import StageError
from ..base.hashing import fingerprint
from ..base.progress import Progress
from ..pipeline.workers import ThisProcess, WorkerProcesses, Workers, run_tasks
from .inputs import CloudIndex, Survey
from .jobs import Job, Store
from .options import TilingOptions
from .sorted_points import TEMPORARY, sort_points

#: A run stops when this many tiles failed for the same reason and none succeeded (not tuned).
_HOPELESS = 10


def workers_of(options: TilingOptions, folder: str) -> AbstractContextManager[Workers]:
    """Return the workers of a run whose working folder is `folder`."""
    if options.scheduler:
        from .dask_workers import Cluster

        return Cluster(options.scheduler, folder)
    workers, threads = options.local_workers, options.threads
    return WorkerProcesses(workers, threads) if workers else ThisProcess(threads)


class SurveyRun:
    """A survey, the working folder and the workers of a run; it reads inputs and runs jobs."""

    def __init__(self, survey: Survey, store: Store, workers: Workers, show: bool | None) -> None:
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
                    stop_if_hopeless(failures)

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
            grids = survey.grid, survey.lone_grid
            return partial(sort_points, job.source.path, *grids, copy_of(job))

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


def stop_if_hopeless(reasons: list[str]) -> None:
    """Stop the run where all tiles failed for the same reason (``""``: one did not fail)."""
    if len(reasons) >= _HOPELESS and len(set(reasons)) == 1 and reasons[0]:
        raise StageError(
            f"the first {len(reasons)} tiles all failed for the same reason: the run was stopped",
            found=reasons[0],
        )
