"""Too little memory for the libraries themselves, which say so in many ways, or not at all."""

from __future__ import annotations

import errno
import re
from typing import Any

from .errors import StageError

#: Bytes of addresses that PDAL, Numba, LLVM and SciPy take before any point is read: with 740 MB they cannot be loaded,
#: 780 MB do for a few points (two threads, Linux on x86-64). With less, OpenBLAS may ask for memory without end.
LEAST = 770_000_000
#: What is asked for where it is less.
_ADVISED = "Give it 1 GB and what the points need (340 bytes a point): raise `ulimit -v`, or the job's limit"
_SHORT = re.compile(
    r"cannot allocate memory|failed to map segment|out of memory|paging file|insufficient memory",
    re.IGNORECASE,
)
#: Bytes below the limit at which a library that cannot be loaded is taken to have hit it.
_NEAR = 150_000_000


def address_limit() -> int | None:
    """Bytes of addresses this process may have (``ulimit -v``); None where there is no limit."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    soft = resource.getrlimit(resource.RLIMIT_AS)[0]
    return None if soft == resource.RLIM_INFINITY else soft


def check_limit() -> None:
    """Refuse to begin where the libraries alone would not find room.

    Raises
    ------
    StageError
    """
    limit = address_limit()
    if limit is not None and limit < LEAST:
        raise StageError(
            f"too little memory is allowed: PDAL and the libraries need {LEAST / 1e6:,.0f} MB of addresses",
            found=f"a limit of {limit / 1e6:,.0f} MB",
            cure=_ADVISED,
        )


def is_short(error: BaseException | None) -> bool:
    """Whether an error, or what it came from, says that memory ran out, libraries' ways of saying it among them."""
    while error is not None:
        if isinstance(error, MemoryError):
            return True
        if isinstance(error, ImportError | OSError):
            if getattr(error, "errno", None) == errno.ENOMEM or _SHORT.search(str(error)):
                return True
            if (isinstance(error, ImportError) or "load" in str(error)) and _near_limit():
                return True
        error = error.__cause__ or error.__context__
    return False


def shortage(found: Any, where: str | None = None) -> StageError:
    """What is said of libraries that could not be loaded for want of memory."""
    return StageError("memory ran out while libraries were loaded", where=where, found=found, cure=_ADVISED)


def _near_limit() -> bool:
    limit = address_limit()
    if limit is None:
        return False
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            pages = int(file.read().split()[0])
    except (OSError, ValueError):
        return False
    import resource

    return pages * resource.getpagesize() > limit - _NEAR
