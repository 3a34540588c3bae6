"""A run over a survey: it reads the inputs, runs jobs as workers become free, and keeps records."""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import AbstractContextManager
from functools import partial
from typing import TypeVar

from ..base.errors import StageError, WriteError
from ..base.hashing import fingerprint
from ..base.progress import Progress
from ..base.version import build
from ..pipeline.workers import Task, ThisProcess, WorkerProcesses, Workers, run_tasks
from .inputs import CloudIndex, Survey
from .jobs import InputJob, Job, OutputJob, Store
from .options import TilingOptions
from .sorted_points import sort_points

_Job = TypeVar("_Job", bound=Job)
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
        self, what: str, waiting: deque[_Job], task_of: Callable[[_Job], Task]
    ) -> Iterator[_Job]:
        """Run jobs as workers become free, save their records, and yield each.

        Outputs may be added after every one. StageError where the first ones all fail for the same
        reason.
        """
        for job in waiting:
            self.store.forget(job.name)
        counted = [job for job in waiting if not isinstance(job, OutputJob)]
        done, failures = 0, []
        with Progress(sum(job.points for job in counted), what, enabled=self.show) as progress:
            for job, answer in run_tasks(self.workers, waiting, task_of):
                self.cpu_seconds += answer.cost.cpu_seconds
                self.peak_mb = max(self.peak_mb, answer.cost.peak_mb)
                if answer.reason:
                    job.fail(answer.reason)
                    job.failure = answer.failure
                else:
                    job.state, job.record, job.cost = "done", answer.result, answer.cost
                    with contextlib.suppress(OSError):  # no room: a later run does it again
                        self.store.finish(job.name, job.to_json(), job.digest)
                if not isinstance(job, OutputJob):
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
        waiting: deque[InputJob] = deque()
        for source in survey.readable():
            if source.index and (source.index.copy or source.path not in needed):
                continue
            name = fingerprint(source.path, vars(survey.grid))
            if source.path not in needed and (saved := store.record(name, build())):
                index = CloudIndex.from_json(saved)
                if index.is_of(source.path):
                    source.index = index
                    continue
            assert source.extent is not None
            waiting.append(InputJob(name, source.extent.count, digest=build(), source=source))

        def task_of(job: InputJob) -> Task:
            copy = str(store.scratch / f"{job.name}.points")
            return partial(sort_points, job.source.path, survey.grid, survey.lone_grid, copy)

        for job in self.do("reading the inputs", waiting, task_of):
            if job.failure is WriteError:  # the input is not the cause
                raise StageError(job.reason)
            job.source.blame(job.reason)
            job.source.index = job.record or job.source.index
        survey.place()

    def unkept(self, jobs: Iterable[_Job]) -> deque[_Job]:
        """Return the waiting jobs that no earlier run has finished."""
        waiting = deque(job for job in jobs if job.state == "waiting")
        for job in waiting:
            if known := self.store.finished(job.name, job.digest):
                job.keep(known)
            elif not self.survey.options.overwrite and (paths := self.store.edited(job.name)):
                job.keep(self.store.note(job.name))
                self.edited += paths
        return deque(job for job in waiting if job.state == "waiting")


def stop_if_hopeless(reasons: list[str]) -> None:
    """Stop the run where all tiles failed for the same reason (``""``: one did not fail)."""
    if len(reasons) >= _HOPELESS and len(set(reasons)) == 1 and reasons[0]:
        raise StageError(
            f"the first {len(reasons)} tiles all failed for the same reason: the run was stopped",
            found=reasons[0],
        )
