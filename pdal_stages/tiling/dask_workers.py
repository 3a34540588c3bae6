"""Run tasks on a running Dask scheduler, with workers on this or other hosts."""

from __future__ import annotations

import contextlib
import os
import pickle
import socket
import time
from collections.abc import Iterable
from concurrent.futures import FIRST_COMPLETED, Future, wait

from ..base.errors import StageError, optional_import
from ..base.version import build
from ..pipeline import pdal as pdal_env
from ..pipeline.workers import Task, TaskResult, perform_task

#: Seconds to wait for the scheduler.
_CONNECT = 10.0
#: Seconds to wait for a worker at the start, or after all have gone.
_WAIT = 120.0
#: Seconds between checks that scheduler and workers are still there.
_ASK = 10.0
_RESUME = "Once it is back, continue with --resume"


class Cluster(contextlib.AbstractContextManager):
    """Tasks on the workers of a scheduler, one at a time on each; they may join and leave."""

    def __init__(self, address: str, folder: str) -> None:
        self.address, self.folder, self.slots = address, folder, 1

    def __enter__(self) -> Cluster:
        """Connect, and wait for the first worker."""
        dask = optional_import("distributed", "dask", "a Dask scheduler (--scheduler)")
        try:
            self._client = dask.Client(self.address, timeout=_CONNECT, set_as_default=False)
        except (OSError, ValueError) as error:  # ValueError: an address of another kind
            raise StageError(
                "the Dask scheduler cannot be reached",
                found=f"{self.address}: {error}",
                cure="Is dask scheduler running there, and is that the address it printed?",
            ) from None
        with contextlib.suppress(TimeoutError):
            self._client.wait_for_workers(1, timeout=_WAIT)
        threads = self._client.nthreads()
        if not threads:
            self._client.close()
            raise StageError(
                "the scheduler has no workers",
                found=self.address,
                cure="Start dask worker on some hosts",
            )
        # One tile at a time in a process; what Dask calls its threads are the cores it may use.
        self.slots, self.threads = len(threads), max(1, min(threads.values()))
        self._executor = self._client.get_executor(pure=False)
        return self

    def __exit__(self, *exc: object) -> None:
        """Cancel what waits, and disconnect."""
        with contextlib.suppress(Exception):
            self._executor.shutdown(wait=False)
        self._client.close()

    def submit(self, task: Task) -> Future:
        """Send a task, as bytes so that Dask does not search it for its own keys."""
        host, work = socket.gethostname(), pickle.dumps(task)
        try:
            return self._executor.submit(perform_for, _versions(), self.folder, host, work)
        except (OSError, RuntimeError):
            raise _lost() from None

    def wait(self, futures: Iterable[Future]) -> set[Future]:
        """Wait for the first futures that are done; StageError if workers or cluster fail."""
        last_seen = time.monotonic()
        while True:
            done = wait(list(futures), timeout=_ASK, return_when=FIRST_COMPLETED).done
            if self._client.status != "running" or any(future.cancelled() for future in done):
                raise _lost()
            for future in done:
                if future.exception() is None and isinstance(reason := future.result(), str):
                    raise StageError(reason)
            if done:
                return done
            with contextlib.suppress(OSError, TimeoutError):
                self.slots = len(self._client.nthreads())
            if self.slots:
                last_seen = time.monotonic()
            elif time.monotonic() - last_seen > _WAIT:
                raise StageError("all workers of the Dask scheduler are gone", cure=_RESUME)


def _lost() -> StageError:
    return StageError("the Dask scheduler cannot be reached any more", cure=_RESUME)


def _versions() -> tuple[str, str]:
    """Return the versions of this package and of PDAL in this process."""
    return build(), pdal_env.dotted_version()


def perform_for(wanted: tuple[str, str], folder: str, host: str, task: bytes) -> TaskResult | str:
    """Do a task on a worker for the program on `host`, or return why the worker is unsuitable."""
    here, versions = socket.gethostname(), _versions()
    if versions != wanted:
        return (
            "a worker of the scheduler runs other versions than this program (found pdal-stages "
            f"{versions[0]} and PDAL {versions[1]} on {here}, here {wanted[0]} and {wanted[1]}). "
            "Install the same on all hosts"
        )
    if not os.path.isdir(folder):  # network file systems may show a new one late
        time.sleep(5)
    if not os.path.isdir(folder):
        return (
            f"a worker of the scheduler does not see the output folder (found no {folder} on "
            f"{here}). Inputs, model and outputs must have the same paths on all hosts"
        )
    answer = perform_task(pickle.loads(task))
    if answer.reason and here != host:
        answer.reason = f"on {here}: {answer.reason}"
    return answer
