"""Worker processes on this machine, reached through pipes alone: nothing listens that another user could talk to."""

from __future__ import annotations

import contextlib
import os
import pickle
import queue
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..base import checks
from ..base.errors import StageError
from ..base.plain import print_messages
from ..base.runlog import LoggedStream
from ..base.shortage import check_limit
from ..base.threads import CORES, available_threads
from . import lifesigns
from .work import Call, Task, TaskResult, perform

_STUCK = "its worker showed no sign of life for {:.0f} s each time it was tried"
_KILLED = "it killed its worker each time it was tried: too little memory, or a crash in a library"


class Processes(contextlib.AbstractContextManager):
    """Tasks in processes of their own, one at a time in each, started as they are needed.

    A worker looks for modules where this Python is installed, never in the current folder. When this process ends,
    however it does, its workers see their pipe end and end too.
    """

    def __init__(self, slots: int, threads: int) -> None:
        self.slots, self.threads = slots, threads
        check_limit()
        self._workers: list[_Worker] = []
        self._next_look = 0.0
        self._answers: queue.SimpleQueue[tuple[_Worker, TaskResult | None]] = queue.SimpleQueue()

    def __exit__(self, *exc: object) -> None:
        for worker in self._workers:
            worker.stop()
        self._workers.clear()

    def run(self, waiting: deque, task_of: Callable[[Any], Task]) -> Iterator[tuple[Any, TaskResult]]:
        """Yield (item, answer) for every item, as they finish.

        They are taken from the left; more may be put in after every answer. `task_of` is asked for an item's task just
        before that is sent.
        """
        busy: dict[_Worker, Any] = {}
        while waiting or busy:
            while waiting and len(busy) < self.slots:
                item = waiting.popleft()
                worker = next((w for w in self._workers if w not in busy), None)
                if worker is None:
                    worker = _Worker(self.threads, self._answers)
                    self._workers.append(worker)
                busy[worker] = item
                worker.give(task_of(item))
            worker, answer = self._next_answer(busy)
            if answer is None:
                self._workers.remove(worker)
                failure = None if worker.began else worker.why_not()
                worker.stop()
                if failure is not None:
                    raise failure
                if worker not in busy:
                    continue
                reason = _STUCK.format(lifesigns.END_AFTER) if worker.stuck else _KILLED
                answer = TaskResult(reason=reason, again=True)
            yield busy.pop(worker), answer

    def _next_answer(self, busy: Mapping[_Worker, Any]) -> tuple[_Worker, TaskResult | None]:
        """What a worker says next; meanwhile those that are silent are told of, and ended in the end."""
        while True:
            try:
                return self._answers.get(timeout=max(0.0, self._next_look - time.monotonic()))
            except queue.Empty:
                for worker in busy:
                    worker.look()
                self._next_look = time.monotonic() + lifesigns.LOOK


class _Worker:
    """A process, and a thread here that waits for its answers."""

    def __init__(self, threads: int, answers: queue.SimpleQueue) -> None:
        self.began = False  #: whether it got so far as to take tasks
        self.stuck = False  #: whether it was ended for showing no sign of life
        self._said: Any = None
        self._answers = answers
        self.process = subprocess.Popen(
            _command(),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE if isinstance(sys.stderr, LoggedStream) else None,
            env=_environment(threads),
            start_new_session=True,  # Ctrl-C is for this process, which ends the others
        )
        self._signs = lifesigns.LifeSigns(self.process.pid)
        threading.Thread(target=self._listen, daemon=True).start()
        self._hearer = threading.Thread(target=self._hear, args=(sys.stderr,), daemon=True)
        self._hearer.start()

    def give(self, task: Task) -> None:
        """Send a task; where the process has ended, :meth:`_listen` tells."""
        assert self.process.stdin is not None
        self._signs.begin()
        with contextlib.suppress(OSError):
            pickle.dump(task, self.process.stdin)
            self.process.stdin.flush()

    def _listen(self) -> None:
        """Hand on answers, and None at the end."""
        assert self.process.stdout is not None
        with contextlib.suppress(EOFError, OSError, ValueError, pickle.UnpicklingError):
            self._said = pickle.load(self.process.stdout)
            self.began = self._said == READY
            while self.began:
                answer = pickle.load(self.process.stdout)
                self._signs.beat()
                if answer != BEATING:
                    self._answers.put((self, answer))
        self._answers.put((self, None))

    def why_not(self) -> StageError:
        """Why it could not be started."""
        if isinstance(self._said, StageError):
            return self._said
        status = self.process.wait()
        found = (
            f"it did not begin within {lifesigns.START_WITHIN:.0f} s"
            if self.stuck
            else f"it ended with status {status}"
        )
        return StageError(
            "a worker process could not be started",
            found=found,
            cure="What it said stands above. --workers 0 works in this process",
        )

    def look(self) -> None:
        """See whether it still lives; tell if it does not seem to, and end it after a while."""
        signs = self._signs
        signs.look()
        quiet = signs.silent if self.began else signs.waited
        limit = lifesigns.END_AFTER if self.began else lifesigns.START_WITHIN
        if lifesigns.TELL_AFTER <= quiet < lifesigns.TELL_AFTER + lifesigns.LOOK:
            what = "shows no sign of life" if self.began else "has not begun to work"
            print_messages(
                f"worker process {self.process.pid} {what} since {quiet:.0f} s; it is replaced after {limit:.0f} s"
            )
        if quiet >= limit and not self.stuck:
            self.stuck = True
            print_messages(
                f"worker process {self.process.pid} was ended: nothing came of it for {quiet:.0f} s"
            )
            self.process.kill()

    def _hear(self, stream: Any) -> None:
        """Say what the process says, where a log hears it."""
        for line in self.process.stderr or ():
            stream.write(line.decode("utf-8", "backslashreplace"))

    def stop(self) -> None:
        """End the process, whatever it does."""
        self.process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):  # one that waits for a disk that is gone
            self.process.wait(10.0)
        self._hearer.join(1.0)
        for pipe in (self.process.stdin, self.process.stdout, self.process.stderr):
            with contextlib.suppress(OSError):
                if pipe is not None:
                    pipe.close()


#: What a worker says when it can take tasks, and every few seconds.
READY, BEATING = "ready", "alive"


def _command() -> list[str]:
    """A Python that finds modules where they are installed, and this package where it is here."""
    root = str(Path(__file__).resolve().parents[2])
    paths = [path for path in sys.path[1:] if path] if sys.version_info < (3, 11) else []
    program = (
        f"import sys; sys.path += {paths!r}; sys.path.insert(0, {root!r}); import pdal_stages; "
        f"sys.path.remove({root!r}); from pdal_stages.pipeline.worker import serve; serve()"
    )
    safe = "-P" if sys.version_info >= (3, 11) else "-I"
    return [sys.executable, safe, "-X", f"utf8={sys.flags.utf8_mode}", "-c", program]


def _environment(threads: int) -> dict[str, str]:
    out = {**os.environ, "PDAL_STAGES_PROGRESS": "0"}
    out |= {f"{name}_NUM_THREADS": str(threads) for name in ("OMP", "OPENBLAS", "MKL")}
    out[CORES] = str(threads)
    if "PYTHONPATH" in out:  # where an empty entry means the current folder
        out["PYTHONPATH"] = os.pathsep.join(filter(None, out["PYTHONPATH"].split(os.pathsep)))
    return out


def each_file(
    function: Callable[..., Any], work: Sequence[tuple], workers: int = 1, *, apart: bool = False
) -> Iterator[tuple[tuple, TaskResult]]:
    """Each item of work, the function's arguments, with what became of it, as they finish; failures do not stop the rest.

    The function is a module's own, so that other processes find it. They share the cores.
    A single worker is this process, unless the work is to be `apart`.
    """
    workers = min(checks.whole("--workers", workers, 1, 1024), len(work))
    if workers == 1 and not apart:
        for item in work:
            yield item, perform(Call(function, item))
        return
    with Processes(workers, max(1, available_threads() // workers)) as pool:
        yield from pool.run(deque(work), lambda item: Call(function, item))
