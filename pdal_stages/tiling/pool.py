"""Where tasks run: in this process, or on Dask."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

from ..base.errors import StageError, optional_import
from ..pipeline.interrupts import gentle
from .settings import TilingOptions
from .work import perform

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

    def run(
        self, tasks: Callable[[], tuple[Any, str] | None], busy: Callable[[], bool]
    ) -> Iterator[tuple[Any, Any]]:
        """Yield (key, answer) for every task; see :meth:`OnDask.run`."""
        with gentle() as interrupts:
            while (task := tasks()) is not None:
                key, text = task
                answer = perform(text)
                interrupts.check()
                yield key, answer


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

    def run(
        self, tasks: Callable[[], tuple[Any, str] | None], busy: Callable[[], bool]
    ) -> Iterator[tuple[Any, Any]]:
        """Yield (key, answer) for every task, as they finish.

        Parameters
        ----------
        tasks : callable
            Gives the next (key, JSON) or None when there is none now; asked again after every answer.
        busy : callable
            Whether there is a task.

        Notes
        -----
        As many tasks are out as there are workers. While a killed worker starts anew, two may sit on one; so a task
        whose worker was killed is tried once more with nothing beside it before it is blamed.
        """
        if not busy():
            return
        if self._distributed is None:
            self._start()
        finished = self._distributed.as_completed(loop=self._client.loop)
        keys: dict[str, tuple[Any, str]] = {}
        futures: dict[str, Any] = {}
        suspects: list[tuple[Any, str]] = []
        alone: tuple[Any, str] | None = None
        try:
            while True:
                waiting: list[tuple[Any, str]] = []
                if alone is None:
                    while len(keys) + len(waiting) < self._slots_now() and (task := tasks()) is not None:
                        waiting.append(task)
                    if not keys and not waiting:
                        if not suspects:
                            return
                        alone = suspects.pop(0)
                        waiting.append(alone)
                for task in waiting:
                    future = self._client.submit(perform, task[1], pure=False, retries=0)
                    keys[future.key], futures[future.key] = task, future
                    finished.add(future)
                future = next(finished)
                task = keys.pop(future.key)
                futures.pop(future.key)
                error = future.exception()
                answer = error if error is not None else future.result()
                future.release()
                if alone is None and isinstance(error, self._distributed.KilledWorker):
                    # It may only have waited on a worker that another tile killed: judge it by itself.
                    suspects.append(task)
                    continue
                alone = None
                yield task[0], answer
        finally:
            if futures:
                with contextlib.suppress(Exception):
                    self._client.cancel(list(futures.values()), force=True)

    def _slots_now(self) -> int:
        if self._options.scheduler:  # workers may join and leave
            with contextlib.suppress(Exception):
                self.slots = max(1, len(self._client.nthreads()))
        return self.slots


def open_pool(options: TilingOptions) -> Here | OnDask:
    """Where the tasks of a run are done."""
    return OnDask(options) if options.scheduler or options.local_workers > 0 else Here(options)
