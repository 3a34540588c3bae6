"""Where tasks run: in this process, or on Dask."""

from __future__ import annotations

import contextlib
import pickle
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

from ..base.errors import StageError, optional_import
from ..pipeline.interrupts import gentle
from .settings import TilingOptions
from .work import Answer, Task, perform

#: Seconds to wait for the first worker.
_WAIT = 120
_PURPOSE = "working in several processes (--workers)"


class Here:
    """Tasks one after the other in this process."""

    slots = 1
    threads: int
    address = "this process"

    def __init__(self, options: TilingOptions) -> None:
        self.threads = options.threads

    def __enter__(self) -> Here:
        return self

    def __exit__(self, *exc: object) -> None: ...

    def run(self, waiting: deque, task_of: Callable[[Any], Task]) -> Iterator[tuple[Any, Answer]]:
        """Yield (item, answer) for every item; see :meth:`OnDask.run`."""
        with gentle() as interrupts:
            while waiting:
                item = waiting.popleft()
                answer = perform(task_of(item))
                interrupts.check()
                yield item, answer


class OnDask:
    """Tasks on Dask: processes on this machine, or a scheduler that runs already."""

    def __init__(self, options: TilingOptions) -> None:
        self._options = options
        self._stack = contextlib.ExitStack()
        self._distributed: Any = None
        self.threads = options.threads
        self.slots = options.local_workers
        self.address = options.scheduler

    def __enter__(self) -> OnDask:
        optional_import("distributed", "dask", _PURPOSE)  # said now, not after reading all inputs
        if self._options.scheduler:
            self._start()
        return self

    def _start(self) -> None:
        """Find or start the workers: processes of this machine only when there is work."""
        distributed = optional_import("distributed", "dask", _PURPOSE)
        import dask

        o = self._options
        try:
            if o.scheduler:
                self._client = self._stack.enter_context(
                    distributed.Client(o.scheduler, timeout=10, set_as_default=False)
                )
                with contextlib.suppress(TimeoutError, AttributeError):
                    self._client.wait_for_workers(1, timeout=_WAIT)
                threads = self._client.nthreads()
                if not threads:
                    raise StageError(
                        "the scheduler has no workers",
                        found=o.scheduler,
                        cure="Start dask worker on some hosts",
                    )
                self.slots = len(threads)
                # One tile at a time in a process; what Dask calls its threads are the cores it may use.
                self.threads = max(1, min(threads.values()))
            else:
                settings = {
                    "distributed.worker.multiprocessing-method": "spawn",
                    "distributed.scheduler.allowed-failures": o.retries,
                    "distributed.scheduler.worker-ttl": None,  # PDAL may hold the interpreter for minutes
                    "distributed.worker.daemon": True,
                    "distributed.admin.tick.limit": "10 minutes",
                    "distributed.nanny.pre-spawn-environ.OMP_NUM_THREADS": str(self.threads),
                    "distributed.nanny.pre-spawn-environ.OPENBLAS_NUM_THREADS": str(self.threads),
                    "distributed.nanny.pre-spawn-environ.MKL_NUM_THREADS": str(self.threads),
                    "distributed.nanny.pre-spawn-environ.PDAL_STAGES_PROGRESS": "0",
                }
                self._stack.enter_context(dask.config.set(settings))
                cluster = self._stack.enter_context(
                    distributed.LocalCluster(
                        n_workers=self.slots,
                        threads_per_worker=1,
                        processes=True,
                        memory_limit=0,  # a tile's memory is stated; pausing in mid-tile helps nobody
                        dashboard_address="127.0.0.1:0",
                        silence_logs=40,
                    )
                )
                self._client = self._stack.enter_context(distributed.Client(cluster, set_as_default=False))
                self.address = cluster.scheduler_address
        except OSError as error:
            self._stack.close()
            raise StageError(
                "the Dask scheduler cannot be reached", found=f"{o.scheduler}: {error}"
            ) from None
        except BaseException:
            self._stack.close()
            raise
        self._distributed = distributed

    def __exit__(self, *exc: object) -> None:
        self._stack.close()

    def run(self, waiting: deque, task_of: Callable[[Any], Task]) -> Iterator[tuple[Any, Answer]]:
        """Yield (item, answer) for every item, as they finish.

        Parameters
        ----------
        waiting : deque
            Items to do, from the left; more may be put in after every answer.
        task_of : callable
            Gives an item's task, just before it is sent.

        Notes
        -----
        As many tasks are out as there are workers. While a killed worker starts anew, two may sit on one; so a task
        whose worker was killed is tried once more with nothing beside it before it is blamed.
        """
        if not waiting:
            return
        if self._distributed is None:
            self._start()
        finished = self._distributed.as_completed(loop=self._client.loop)
        out: dict[str, tuple[Any, Any]] = {}  # item and future, by the future's key
        suspects: deque[Any] = deque()
        alone = False
        try:
            while True:
                sent: list[Any] = []
                if not alone:
                    while waiting and len(out) + len(sent) < self._slots_now():
                        sent.append(waiting.popleft())
                    if not out and not sent:
                        if not suspects:
                            return
                        alone = True
                        sent.append(suspects.popleft())
                for item in sent:
                    # As bytes: Dask would look for its own keys in all that a task holds.
                    task = pickle.dumps(task_of(item))
                    future = self._client.submit(_perform_pickled, task, pure=False, retries=0)
                    out[future.key] = item, future
                    finished.add(future)
                future = next(finished)
                item, _ = out.pop(future.key)
                error = future.exception()
                killed = isinstance(error, self._distributed.KilledWorker)
                answer = future.result() if error is None else _failed(error, killed)
                future.release()
                if killed and not alone:
                    # It may only have waited on a worker that another tile killed: judge it by itself.
                    suspects.append(item)
                    continue
                alone = False
                yield item, answer
        finally:
            if out:
                with contextlib.suppress(Exception):
                    self._client.cancel([future for _, future in out.values()], force=True)

    def _slots_now(self) -> int:
        if self._options.scheduler:  # workers may join and leave
            with contextlib.suppress(Exception):
                self.slots = max(1, len(self._client.nthreads()))
        return self.slots


def last_tries(
    pool: Here | OnDask, waiting: deque, task_of: Callable[[Any], Task], retries: int
) -> Iterator[tuple[Any, Answer]]:
    """Items and the answers of their last tries; failed ones wait again behind the others, up to `retries` times."""
    for item, answer in pool.run(waiting, task_of):
        item.tries += 1
        if answer.reason and answer.again and item.tries <= retries:
            waiting.append(item)
        else:
            yield item, answer


def _perform_pickled(task: bytes) -> Answer:
    return perform(pickle.loads(task))


def _failed(error: BaseException, killed: bool) -> Answer:
    """The answer of a task that gave none."""
    if killed:
        reason = "it killed its worker each time it was tried: too little memory, or a crash in a library"
        return Answer(reason=reason)
    return Answer(reason=f"{type(error).__name__}: {error}", again=True)


Pool = Here | OnDask


def open_pool(options: TilingOptions) -> Pool:
    """Where the tasks of a run are done."""
    return OnDask(options) if options.scheduler or options.local_workers > 0 else Here(options)
