"""The same work for many files, one after the other or several at a time; one that fails does not stop the others."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Any

from ..base import checks
from ..base.errors import StageError
from ..base.threads import available_threads


def each_file(
    function: Callable[..., Any], work: Sequence[tuple], workers: int = 1
) -> Iterator[tuple[tuple, Any]]:
    """Each item of work with what the function gave for it, or the error, in order.

    Parameters
    ----------
    function : callable
        Of a module's own, so that other processes find it.
    work : sequence of tuple
        Arguments.
    workers : int
        Processes; they share the cores.
    """
    workers = min(checks.whole("--workers", workers, 1, 1024), len(work))
    if workers == 1:
        for item in work:
            yield item, _outcome(function, item)
        return
    threads = max(1, available_threads() // workers)
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, _share, (threads,)) as pool:
        waiting = [pool.submit(_outcome, function, item) for item in work]
        for item, answer in zip(work, waiting, strict=True):
            yield item, answer.result()


def _share(threads: int) -> None:
    os.environ["LOKY_MAX_CPU_COUNT"] = str(threads)  # which available_threads heeds


def _outcome(function: Callable[..., Any], item: tuple) -> Any:
    try:
        return function(*item)
    except StageError as error:
        return error
