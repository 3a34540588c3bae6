"""Resources of the machine: threads over blocks of work, and memory.

Kernels are compiled with ``nogil``, so plain Python threads use every core. numba's own parallel loops are not used: its
portable threading layer aborts the process when two Python threads enter it together, and users do run pipelines in threads.
"""

from __future__ import annotations

import contextlib
import ctypes
import math
import mmap
import os
import re
import sys
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from . import checks
from .errors import OptionError

#: Where a cgroup of version 2, and one of version 1, says how many microseconds of CPU it may use in how many.
_QUOTAS = ("cpu.max",), ("cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us")

#: The environment variable with the number of cores of a worker, which joblib and so scikit-learn respect as well.
CORES = "LOKY_MAX_CPU_COUNT"


@cache
def available_threads() -> int:
    """Cores this process may use: its CPU affinity, bounded by a cgroup quota and by :data:`CORES`."""
    bounds = [os.cpu_count() or 1, *_quota()]
    if hasattr(os, "sched_getaffinity"):
        bounds.append(len(os.sched_getaffinity(0)))
    with contextlib.suppress(ValueError):
        bounds.append(int(os.environ.get(CORES, "")))
    return max(1, min(bounds))


def _quota(folder: str = "/sys/fs/cgroup") -> Iterator[int]:
    """The cores that a cgroup's quota is worth, where there is one."""
    for files in _QUOTAS:
        with contextlib.suppress(
            OSError, ValueError, ArithmeticError
        ):  # no such file; "max": no bound
            quota, period = (
                int(word) for file in files for word in Path(folder, file).read_text().split()
            )
            if quota > 0:
                yield math.ceil(quota / period)


def resolve_threads(threads: int | None) -> int:
    """``None`` or 0: every core on offer; a positive number: that many."""
    if threads is None or (threads == 0 and not isinstance(threads, bool)):
        return available_threads()
    return checks.whole("'threads'", threads, 0)


def map_blocks(
    function: Callable[[Any], Any],
    blocks: Sequence[Any],
    threads: int | None = None,
    ahead: int = 2,
) -> Iterator[Any]:
    """Yield ``function(block)`` for every block, in order, computed by several `threads`; it should release the GIL.

    At most ``threads * ahead`` results wait unread, so memory stays bounded when the reader is slower than the workers. An
    exception (Ctrl-C too) stops handing out blocks and is raised once the blocks in work are finished.
    """
    count = resolve_threads(threads)
    if count == 1 or len(blocks) <= 1:
        yield from map(function, blocks)
        return
    pool = ThreadPoolExecutor(count, thread_name_prefix="pdal-stages")
    pending: deque[Future] = deque()
    try:
        for block in blocks:
            pending.append(pool.submit(function, block))
            if len(pending) == count * ahead:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


#: Assumed free memory where the system does not say.
_UNKNOWN = 4 * 10**9
#: The least amount of memory that is accepted, in bytes.
_FEWEST = 1e6


def parse_size(text: str) -> int:
    """Bytes of ``4GB``, ``500 MB``, ``4GiB`` or a plain number, which is large.

    Raises
    ------
    OptionError
        For anything else.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([KMGT]?)(i?)B?\s*", text, re.IGNORECASE)
    size = 0.0
    if match is not None:
        size = float(match[1]) * (1024 if match[3] else 1000) ** " KMGT".index(
            match[2].upper() or " "
        )
    if size < _FEWEST:
        raise OptionError(
            "an amount of memory is a number and a unit", found=text, cure="For example 4GB"
        )
    return int(size)


def free_memory() -> int:
    """Bytes available without swapping, within the limit of a container."""
    found = [_available(), _left_in_container()]
    known = [size for size in found if size]
    return min(known) if known else _UNKNOWN


def give_back(array: np.ndarray) -> None:
    """Return the memory of an array to the system; its values are lost, and its owner still has to free it.

    For arrays that someone else holds longer than they are needed. Whole pages, on Linux; nothing happens elsewhere.
    """
    if sys.platform != "linux" or not array.flags.c_contiguous:
        return
    begin = array.ctypes.data
    first = -(-begin // mmap.PAGESIZE) * mmap.PAGESIZE
    last = (begin + array.nbytes) // mmap.PAGESIZE * mmap.PAGESIZE
    if last > first:
        libc = ctypes.CDLL(None)
        libc.madvise(
            ctypes.c_void_p(first), ctypes.c_size_t(last - first), ctypes.c_int(mmap.MADV_DONTNEED)
        )


def _available() -> int:
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except (OSError, ValueError):
        pass
    try:  # other systems than Linux: half of what there is
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
    except (OSError, ValueError, AttributeError):
        return 0


def _left_in_container() -> int:
    """Of control groups, of either version; 0 where there is no limit."""
    folder = Path("/sys/fs/cgroup")
    for limit, used in (
        (folder / "memory.max", folder / "memory.current"),
        (folder / "memory/memory.limit_in_bytes", folder / "memory/memory.usage_in_bytes"),
    ):
        try:
            most = int(limit.read_text())
            if most < 2**60:
                return max(1, most - int(used.read_text()))
        except (OSError, ValueError):
            continue
    return 0
