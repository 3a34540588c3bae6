"""Memory of the machine: sizes as users write them, and what is free."""

from __future__ import annotations

import os
import re
from pathlib import Path

from .errors import OptionError

#: Free memory in bytes that is assumed where the system does not report it: a small computer's.
_ASSUMED_FREE = 4 * 10**9
#: The least amount of memory that is accepted, in bytes: a smaller one lacks its unit.
_LEAST_SIZE = 1e6
#: Limit and use of a control group, of version 2 and of version 1.
_GROUP_FILES = (
    ("memory.max", "memory.current"),
    ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes"),
)
#: A control group whose limit is larger has no limit: version 1 reports nearly 2**63 then.
_NO_LIMIT = 2**60


def parse_size(text: str) -> int:
    """Return the bytes of ``4GB``, ``500 MB``, ``4GiB`` or a plain number of a million or more.

    Raises
    ------
    OptionError
        For anything else.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([KMGT]?)(i?)B?\s*", text, re.IGNORECASE)
    size = 0.0
    if match is not None:
        power = " KMGT".index(match[2].upper() or " ")
        size = float(match[1]) * (1024 if match[3] else 1000) ** power
    if size < _LEAST_SIZE:
        what = "an amount of memory is a number and a unit"
        raise OptionError(what, found=text, cure="For example 4GB")
    return int(size)


def free_memory() -> int:
    """Return the bytes available without swapping, within the limit of a container."""
    return min(filter(None, (_available(), _left_in_container())), default=_ASSUMED_FREE)


def _available() -> int:
    """Return the free bytes of the machine; half of all where free ones are not reported; or 0."""
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except (OSError, ValueError):
        pass
    try:  # other systems than Linux
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
    except (OSError, ValueError, AttributeError):
        return 0


def _left_in_container() -> int:
    """Return the free bytes of the control group, of either version; 0 without a limit."""
    folder = Path("/sys/fs/cgroup")
    for limit, used in _GROUP_FILES:
        try:
            most = int((folder / limit).read_text())
            if most < _NO_LIMIT:
                return max(1, most - int((folder / used).read_text()))
        except (OSError, ValueError):
            continue
    return 0
