"""Tasks in this process or in workers on this machine, of which one can die alone."""

from __future__ import annotations

import gc
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, TypeVar

from ..base import checks
from ..base.errors import InterruptedStage, StageError
from ..base.files import NO_ROOM
from ..base.processes import ProcessEnded, PythonProcess
from ..base.progress import Progress
from ..base.threads import CORES_VARIABLE, available_threads
from .interrupts import check_interrupt, deferred_interrupts

#: The reason where a worker died.
KILLED = str(ProcessEnded())
#: One task at a time in a process: PDAL's threads are ours, and memory is stated for one.
_one_task = threading.Lock()


#: What a worker calls; its result is :attr:`TaskResult.result`.
Task = Callable[[], object]
_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


@dataclass(frozen=True)
class Cost:
    """Time and memory that a task took."""

    seconds: float = 0.0
    cpu_seconds: float = 0.0
    peak_mb: float = 0.0  #: the most memory that the process has held so far


@dataclass
class TaskResult:
    """The result of a task."""

    result: Any = None
    reason: str = ""  #: why it failed; empty where it did not
    failure: type[Exception] | None = None  #: the error
    cost: Cost = Cost()


def perform_task(task: Task) -> TaskResult:
    """Call a task; errors are part of the result, except Ctrl-C."""
    with _one_task:
        started, cpu = time.perf_counter(), time.process_time()
        out = TaskResult()
        try:
            out.result = task()
        except InterruptedStage:
            raise KeyboardInterrupt from None
        except Exception as error:
            out.reason, out.failure = _reason(error), type(error)
        out.cost = Cost(time.perf_counter() - started, time.process_time() - cpu, _peak())
        return out


class Workers(Protocol):
    """Performs tasks: this process, others on this machine, or those of a cluster."""

    slots: int  #: tasks at the same time
    threads: int  #: threads of each task

    def submit(self, task: Task) -> Future:
        """Send a task to a free worker; return what stands for its result."""

    def wait(self, futures: Iterable[Future]) -> set[Future]:
        """Wait for at least one; return those that are done."""


def _reason(error: Exception) -> str:
    if isinstance(error, StageError):
        return str(error)
    if isinstance(error, MemoryError):
        return "memory ran out. Take smaller tiles or fewer workers"
    if getattr(error, "errno", None) in NO_ROOM:
        return f"a temporary file could not be written ({error}). Make room on the disk"
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {error} ({last.name}, line {last.lineno})"


def _peak() -> float:
    """Return the most memory that this process has held, in megabytes."""
    try:
        import resource
    except ImportError:  # Windows
        return 0.0
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most / (2**20 if sys.platform == "darwin" else 2**10)


class ThisProcess(AbstractContextManager):
    """Tasks one after the other in this process."""

    slots = 1

    def __init__(self, threads: int) -> None:
        self.threads = threads

    def __exit__(self, *exc: object) -> None:
        """Leave the process as it is."""

    def submit(self, task: Task) -> Future:
        """Do a task at once."""
        future: Future = Future()
        with deferred_interrupts():
            future.set_result(perform_task(task))
            check_interrupt()
        # A command seldom collects: 4 MB and the points of each tile stayed. These are young; what
        # is older (generation 2) takes 0.15 s to search.
        gc.collect(1)
        return future

    def wait(self, futures: Iterable[Future]) -> set[Future]:
        """Return all of them."""
        return set(futures)


class WorkerProcesses(AbstractContextManager):
    """Tasks in processes of their own, one at a time in each; they end with this process."""

    def __init__(self, slots: int, threads: int) -> None:
        self.slots, self.threads = slots, threads
        limits = [*(f"{name}_NUM_THREADS" for name in ("OMP", "OPENBLAS", "MKL")), CORES_VARIABLE]
        self._environment = dict.fromkeys(limits, str(threads)) | {"PDAL_STAGES_PROGRESS": "0"}
        self._idle: list[PythonProcess] = []
        self._busy: dict[Future, PythonProcess] = {}
        self._waiting = ThreadPoolExecutor(slots)  # one thread waits for each process

    def __exit__(self, *exc: object) -> None:
        """End the processes."""
        for process in [*self._idle, *self._busy.values()]:
            process.kill()
        self._waiting.shutdown(cancel_futures=True)

    def submit(self, task: Task) -> Future:
        """Send a task to a free worker."""
        try:
            process = self._idle.pop() if self._idle else PythonProcess(self._environment)
        except OSError as error:
            what = "worker processes cannot be started"
            raise StageError(what, found=error, cure="Do without them: --workers 0") from None
        future = self._waiting.submit(process.call, perform_task, task)
        self._busy[future] = process
        return future

    def wait(self, futures: Iterable[Future]) -> set[Future]:
        """Wait for at least one; return those that are done."""
        done = wait(list(futures), return_when=FIRST_COMPLETED).done
        for future in done:
            process = self._busy.pop(future)
            if future.exception() is None:
                self._idle.append(process)
            else:
                process.kill()
        return done


def run_tasks(
    workers: Workers, waiting: deque[_Item], task_of: Callable[[_Item], Task]
) -> Iterator[tuple[_Item, TaskResult]]:
    """Yield (item, result) for every waiting item, as they finish.

    Items may be added after every result. `task_of` is called for an item's task just before it is
    sent.
    """
    running: dict[Future, _Item] = {}
    while waiting or running:
        while waiting and len(running) < workers.slots:
            item = waiting.popleft()
            running[workers.submit(task_of(item))] = item
        for future in workers.wait(running):
            yield running.pop(future), _result_of(future)


def _result_of(future: Future) -> TaskResult:
    """Return the result of a task that is done, or why there is none."""
    error = future.exception()
    if error is None:
        return future.result()
    if isinstance(error, ProcessEnded) or type(error).__name__ == "KilledWorker":  # of Dask
        return TaskResult(reason=KILLED)
    return TaskResult(reason=f"{type(error).__name__}: {error}")


def each_file(
    function: Callable[..., _Result], work: Sequence[tuple], workers: int = 1
) -> Iterator[_Result]:
    """Yield the result for each item of work, the function's arguments, as they finish.

    The function must be importable by other processes. They share the cores. A single worker is
    this process. At the end a StageError names the first files that failed.
    """
    count = min(checks.whole("--workers", workers, 1, 1024), len(work))
    threads = max(1, available_threads() // count)
    failed = []
    with (
        Progress(len(work), "reading", "files") as line,
        WorkerProcesses(count, threads) if count > 1 else ThisProcess(threads) as pool,
    ):
        for _, task in run_tasks(pool, deque(work), lambda item: partial(function, *item)):
            line.update()
            if task.reason:
                failed.append(task.reason)
            else:
                yield task.result
    if failed and len(work) == 1:
        raise StageError(failed[0])
    if failed:
        raise StageError(
            f"{len(failed)} of {len(work)} inputs cannot be read", found="; ".join(failed[:3])
        )
