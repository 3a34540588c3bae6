"""Where tasks run: in this process, in others of this machine, or on a Dask scheduler."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from typing import Any

from ..pipeline.interrupts import check, gentle
from ..pipeline.processes import Processes
from ..pipeline.work import Task, TaskResult, perform
from .scheduler import OnDask
from .settings import TilingOptions


class Here(AbstractContextManager):
    """Tasks one after the other in this process."""

    def __init__(self, threads: int) -> None:
        self.slots, self.threads = 1, threads

    def __exit__(self, *exc: object) -> None: ...

    def run(self, waiting: deque, task_of: Callable[[Any], Task]) -> Iterator[tuple[Any, TaskResult]]:
        """Yield (item, answer) for every item; see :meth:`pdal_stages.pipeline.processes.Processes.run`."""
        with gentle():
            while waiting:
                item = waiting.popleft()
                answer = perform(task_of(item))
                check()
                yield item, answer


def last_tries(
    pool: Pool,
    waiting: deque,
    task_of: Callable[[Any], Task],
    retries: int,
    spent: Callable[[Any, Mapping[str, float]], None],
) -> Iterator[tuple[Any, TaskResult]]:
    """Items and the answers of their last tries; failed ones wait again behind the others, up to `retries` times.

    `spent` hears of each item what each try took.
    """
    for item, answer in pool.run(waiting, task_of):
        item.tries += 1
        spent(item, answer.cost)
        if answer.reason and answer.again and item.tries <= retries:
            waiting.append(item)
        else:
            yield item, answer


Pool = Here | Processes | OnDask


def open_pool(options: TilingOptions, folder: str) -> Pool:
    """Where the tasks of a run are done, which keeps what it makes in `folder`."""
    if options.scheduler:
        return OnDask(options, folder)
    workers, threads = options.local_workers, options.threads
    return Processes(workers, threads) if workers else Here(threads)
