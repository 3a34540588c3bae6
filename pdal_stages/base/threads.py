"""Threads over blocks of work, and how many of them the machine allows.

Kernels are compiled with ``nogil``, so plain Python threads use every core. numba's own parallel
loops are not used: its portable threading layer aborts the process when two Python threads enter
it together, and users do run pipelines in threads.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import TypeVar

from . import checks

_Block = TypeVar("_Block")
_Result = TypeVar("_Result")

#: Files of a control group, of version 2 and of version 1, with its quota of CPU and the period of
#: that quota, both in microseconds.
_QUOTAS = ("cpu.max",), ("cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us")

#: The environment variable with the number of cores of a worker; joblib, and so scikit-learn,
#: respect it as well.
CORES_VARIABLE = "LOKY_MAX_CPU_COUNT"


@cache
def available_threads() -> int:
    """Return the cores this process may use: the least of affinity, quota and CORES_VARIABLE."""
    bounds = [os.cpu_count() or 1, *_quota()]
    if hasattr(os, "sched_getaffinity"):
        bounds.append(len(os.sched_getaffinity(0)))
    with contextlib.suppress(ValueError):
        bounds.append(int(os.environ.get(CORES_VARIABLE, "")))
    return max(1, min(bounds))


def _quota(folder: str = "/sys/fs/cgroup") -> Iterator[int]:
    """Yield the cores that a control group's quota is worth, where there is one."""
    for files in _QUOTAS:
        # no such file; "max" for no bound
        with contextlib.suppress(OSError, ValueError, ArithmeticError):
            quota, period = (
                int(word) for file in files for word in Path(folder, file).read_text().split()
            )
            if quota > 0:
                yield math.ceil(quota / period)


def resolve_threads(threads: int | None) -> int:
    """Return a number of threads: every core for ``None`` or 0, else the positive number itself."""
    if threads is None or (threads == 0 and not isinstance(threads, bool)):
        return available_threads()
    return checks.whole("'threads'", threads, 0)


def map_blocks(
    function: Callable[[_Block], _Result],
    blocks: Sequence[_Block],
    threads: int | None = None,
    ahead: int = 2,
) -> Iterator[_Result]:
    """Yield ``function(block)`` for every block, in order, computed by several `threads`.

    The function should release the GIL. At most ``threads * ahead`` results wait unread, so memory
    stays bounded when the reader is slower than the workers. An exception (Ctrl-C too) stops
    handing out blocks and is raised once the blocks in work are finished.
    """
    count = resolve_threads(threads)
    if count == 1 or len(blocks) <= 1:
        yield from map(function, blocks)
        return
    pool = ThreadPoolExecutor(count, thread_name_prefix="pdal-stages")
    pending: deque[Future[_Result]] = deque()
    try:
        for block in blocks:
            pending.append(pool.submit(function, block))
            if len(pending) == count * ahead:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
