"""Tasks on a Dask scheduler that runs already, with workers on this or other hosts."""

from __future__ import annotations

import contextlib
import os
import pickle
import socket
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from typing import Any

from ..base.errors import StageError, optional_import
from ..base.plain import print_messages
from ..base.version import build
from ..pipeline import pdal as pdal_env
from ..pipeline.work import Task, TaskResult, perform
from .settings import TilingOptions

#: Seconds to wait for a worker: at the beginning, and when all are gone.
_WAIT = 120.0
#: Seconds after which it is asked whether scheduler and workers are still there.
_ASK = 10.0


class OnDask:
    """Tasks on the workers of a scheduler; they may join and leave."""

    def __init__(self, options: TilingOptions, folder: str) -> None:
        self.address, self.folder = options.scheduler, folder
        self.threads, self.slots = options.threads, 1
        self._stack = contextlib.ExitStack()
        self._unfit: dict[str, str] = {}  # why workers that joined later get no tasks, by their address
        self._asked: set[str] = set()
        self._told: set[str] = set()
        self._chosen: list[str] = []

    def __enter__(self) -> OnDask:
        self._dask: Any = optional_import("distributed", "dask", "a Dask scheduler (--scheduler)")
        with contextlib.ExitStack() as stack:
            try:
                self._client = stack.enter_context(
                    self._dask.Client(self.address, timeout=10, set_as_default=False)
                )
                with contextlib.suppress(TimeoutError, AttributeError):
                    self._client.wait_for_workers(1, timeout=_WAIT)
                threads = self._client.nthreads()
            except (OSError, ValueError) as error:  # ValueError: an address of another kind
                raise StageError(
                    "the Dask scheduler cannot be reached",
                    found=f"{self.address}: {error}",
                    cure="Is dask scheduler running there, and is that the address it printed?",
                ) from None
            if not threads:
                raise StageError(
                    "the scheduler has no workers", found=self.address, cure="Start dask worker on some hosts"
                )
            self._check_workers()
            self._stack = stack.pop_all()
        self.slots = len(threads)
        # One tile at a time in a process; what Dask calls its threads are the cores it may use.
        self.threads = max(1, min(threads.values()))
        return self

    def __exit__(self, *exc: object) -> None:
        self._stack.close()

    def _check_workers(self) -> None:
        """Refuse workers whose results would not be those of this program, or would not get here."""
        try:
            found = self._client.run(at_hand, self.folder)
        except Exception as error:
            raise StageError(
                _MUTE,
                found=f"{type(error).__name__}: {error}",
                cure=_SAME,
            ) from None
        for worker, (theirs, host, sees) in found.items():
            if theirs != versions():
                raise StageError(_OTHER, found=_difference(worker, theirs, versions()), cure=_SAME)
            if not sees:
                raise StageError(_APART, found=f"no {self.folder} on {host}", cure=_SHARE)
        self._asked = set(found)

    def _fit(self) -> list[str]:
        """Addresses of the workers there are that may have tasks; those that joined since are asked first."""
        there = list(self._client.nthreads())
        new = [worker for worker in there if worker not in self._asked]
        if new:
            found = self._client.run(at_hand, self.folder, workers=new, on_error="return")
            self._asked.update(found)
            for worker, answer in found.items():
                if isinstance(answer, OSError):  # gone again, or not yet there
                    self._asked.discard(worker)
                elif isinstance(answer, BaseException):
                    self._leave_out(worker, _MUTE, f"{worker}: {answer}", _SAME)
                elif answer[0] != versions():
                    self._leave_out(worker, _OTHER, _difference(worker, answer[0], versions()), _SAME)
                elif not answer[2]:
                    self._leave_out(worker, _APART, f"no {self.folder} on {answer[1]}", _SHARE)
        return [worker for worker in there if worker not in self._unfit]

    def _leave_out(self, worker: str, what: str, found: str, cure: str) -> None:
        """Give a worker that joined no tasks; of several that are unfit for one reason the first is told."""
        self._unfit[worker] = f"{what} (found {found}). {cure}"
        if what not in self._told:
            self._told.add(what)
            print_messages(f"it joined and gets no tiles: {self._unfit[worker]}")

    def run(self, waiting: deque, task_of: Callable[[Any], Task]) -> Iterator[tuple[Any, TaskResult]]:
        """Yield (item, answer) for every item; see :meth:`pdal_stages.pipeline.processes.Processes.run`.

        Notes
        -----
        As many tasks are out as there are workers. While a killed worker restarts, two tasks may share a worker; so a task
        whose worker was killed is tried once more with nothing beside it before it is blamed.
        """
        out: dict[Any, Any] = {}  # items by their future
        stranded: dict[int, int] = {}  # how often an item waited for workers that are gone
        suspects: deque[Any] = deque()
        try:
            while waiting or out or suspects:
                alone = not waiting and not out
                source, room = (suspects, 1) if alone else (waiting, self._slots_now() - len(out))
                sent = deque(source.popleft() for _ in range(min(room, len(source))))
                try:
                    while sent:
                        future = self._submit(task_of(sent[0]))
                        out[future] = sent.popleft()
                    done = self._wait(list(out))
                except _LostError as lost:
                    waiting.extendleft([*out.values(), *sent, *suspects])
                    out.clear()
                    suspects.clear()
                    while waiting:  # more may come while these are looked at
                        yield waiting.popleft(), TaskResult(reason=str(lost))
                    return
                for future in done:
                    item = out.pop(future)
                    if not future.done():
                        future.cancel(force=True)
                        stranded[id(item)] = stranded.get(id(item), 0) + 1
                        if stranded[id(item)] < _TRIES:
                            waiting.appendleft(item)
                        else:
                            yield item, TaskResult(reason=_KILLED)
                        continue
                    error = future.exception()
                    killed = isinstance(error, self._dask.KilledWorker)
                    answer = future.result() if error is None else _failed(error, killed)
                    future.release()
                    if error is None and self._refused(answer):
                        waiting.appendleft(item)  # from now on for workers that are fit
                        continue
                    if killed and not alone:
                        # It may only have waited on a worker that another tile killed: judge it by itself.
                        suspects.append(item)
                    else:
                        yield item, answer
        finally:
            with contextlib.suppress(Exception):
                self._client.cancel(list(out), force=True)

    def _submit(self, task: Task) -> Any:
        # As bytes: Dask would look for its own keys in all that a task holds.
        content = pickle.dumps(task)
        try:
            words = versions(), self.folder, socket.gethostname(), content
            # Only where others are there: Dask itself moves a task whose worker is gone, but not past these.
            only = {"workers": self._chosen} if self._unfit and self._chosen else {}
            future = self._client.submit(perform_for, *words, pure=False, retries=0, **only)
            future.chosen = frozenset(self._chosen if only else ())
            return future
        except (OSError, RuntimeError):
            raise _LostError(_LOST) from None

    def _refused(self, answer: TaskResult) -> bool:
        """Whether a worker refused a task that another one may do."""
        if not answer.reason.startswith((_OTHER, _APART)):
            return False
        self._slots_now()
        return bool(self._unfit and self._chosen)

    def _wait(self, futures: list[Any]) -> list[Any]:
        """Futures that are done, or that wait for workers that are gone while others are there."""
        gone: float | None = None
        while True:
            try:
                with self._client.as_current():
                    return list(self._dask.wait(futures, timeout=_ASK, return_when="FIRST_COMPLETED").done)
            except (TimeoutError, self._dask.TimeoutError):
                pass
            except (OSError, RuntimeError, CancelledError):
                raise _LostError(_LOST) from None
            if self._client.status != "running":
                raise _LostError(_LOST)
            now = time.monotonic()
            gone = None if self._slots_now(0) else gone or now
            lost = [f for f in futures if f.chosen and f.chosen.isdisjoint(self._chosen) and not f.done()]
            if gone is None and lost:
                return lost
            if gone is not None and now - gone > _WAIT:
                raise _LostError("all workers of the Dask scheduler are gone")

    def _slots_now(self, least: int = 1) -> int:
        with contextlib.suppress(Exception):
            self._chosen = self._fit()
            self.slots = len(self._chosen)
        return max(least, self.slots)


class _LostError(Exception):
    """Nothing more will come from the scheduler."""


#: How often a task may wait for workers that went away before it is blamed.
_TRIES = 4
_KILLED = "it killed its worker each time it was tried: too little memory, or a crash in a library"
_LOST = "the Dask scheduler cannot be reached any more"
_OTHER = "a worker of the scheduler has other versions than this program"
_SAME = "Install the same versions of pdal-stages and PDAL on all hosts"
_MUTE = "a worker of the scheduler cannot say which pdal-stages it has"
_APART = "a worker of the scheduler does not see the output folder"
_SHARE = "Inputs, model and outputs must be there under the same paths on all hosts"


def versions() -> tuple[str, str]:
    """Of this package and of PDAL, where it is called."""
    return build(), pdal_env.dotted_version()


def at_hand(folder: str) -> tuple[tuple[str, str], str, bool]:
    """Of a worker: its versions, its host, and whether it sees a folder."""
    return versions(), socket.gethostname(), _sees(folder)


def _sees(folder: str) -> bool:
    for _ in range(5):  # network file systems may show a new folder late
        if os.path.isdir(folder):
            return True
        time.sleep(1)
    return False


def perform_for(wanted: tuple[str, str], folder: str, host: str, task: bytes) -> TaskResult:
    """Do a task on a worker, if it has the versions of the program that sent it, from `host`, and sees its folder."""
    here = socket.gethostname()
    if versions() != wanted:
        return TaskResult(reason=f"{_OTHER} ({_difference(here, versions(), wanted)}). {_SAME}", again=True)
    if not _sees(folder):
        return TaskResult(reason=f"{_APART} (found no {folder} on {here}). {_SHARE}", again=True)
    answer = perform(pickle.loads(task))
    if answer.reason and here != host:
        answer.reason = f"on {here}: {answer.reason}"
    return answer


def _difference(worker: str, theirs: tuple[str, str], ours: tuple[str, str]) -> str:
    return f"{worker} has pdal-stages {theirs[0]} and PDAL {theirs[1]}, this program {ours[0]} and {ours[1]}"


def _failed(error: BaseException, killed: bool) -> TaskResult:
    """The answer of a task that gave none."""
    if killed:
        return TaskResult(reason=_KILLED)
    return TaskResult(reason=f"{type(error).__name__}: {error}", again=True)
