"""Without what is only looked for, or waited for: for a process that runs nobody's code but ours."""

from __future__ import annotations

import atexit
import gc
import importlib
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_lean = False
#: What packages import to see whether it is there, and we never use through them: half a second of pyogrio's start,
#: a tenth of laspy's.
_OPTIONAL = {
    "pyogrio": ("geopandas", "pandas", "pyarrow", "pyproj"),
    "laspy": ("requests", "pyproj"),
}


def be_lean() -> None:
    """From now on leave out what is not needed. In a notebook, or with stages of the user's, somebody may need it.

    Call it before NumPy is imported: the threads of its linear algebra, of which we do next to none, spin while they wait.
    """
    global _lean
    _lean = True
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    atexit.register(
        gc.freeze
    )  # Python looks at all objects once more before the process ends, and the memory with it


def imported(name: str) -> Any:
    """A package, by ``import``; in a process that is lean without what it would only look for."""
    if name in sys.modules or not _lean:
        return importlib.import_module(name)
    with _absent(*_OPTIONAL.get(name, ())):
        return importlib.import_module(name)


@contextmanager
def _absent(*names: str) -> Iterator[None]:
    """Make packages that are not imported yet seem not to be there."""
    hidden = [name for name in names if name not in sys.modules]
    sys.modules.update(dict.fromkeys(hidden))  # type: ignore[arg-type]
    try:
        yield
    finally:
        for name in hidden:
            if sys.modules.get(name, name) is None:
                del sys.modules[name]
