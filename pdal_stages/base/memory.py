"""Memory of the machine: sizes as users write them, what is free, and giving pages back."""

from __future__ import annotations

import ctypes
import mmap
import os
import re
import sys
from pathlib import Path

import numpy as np

from .errors import OptionError

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
