"""A call in a Python process of its own, from programs whose libraries would clash with the callee's."""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from .errors import StageError


def in_own_process(function: Callable[..., Any], *arguments: Any) -> Any:
    """``function(*arguments)`` in another process of this Python; function and arguments are such that can be pickled.

    Raises
    ------
    StageError
        What the function raises of this kind; other errors of it, and where no process comes about, as one.
    """
    context = multiprocessing.get_context("spawn")
    context.set_executable(interpreter())
    try:
        with ProcessPoolExecutor(1, mp_context=context) as pool:
            return pool.submit(function, *arguments).result()
    except StageError:
        raise
    except BrokenProcessPool as error:
        raise StageError("a process for vector files did not answer", found=str(error)) from None
    except Exception as error:
        raise StageError(f"{type(error).__name__}: {error}") from None


def interpreter() -> str:
    """The program of the Python that this is, also inside a program that embeds it."""
    if os.path.basename(sys.executable or "").startswith("python"):
        return sys.executable
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    names = ("python.exe",) if os.name == "nt" else (f"bin/{version}", "bin/python3")
    for path in (os.path.join(prefix, name) for prefix in (sys.prefix, sys.base_prefix) for name in names):
        if os.access(path, os.X_OK):
            return path
    raise StageError(
        "no Python program belongs to the Python inside this program",
        found=sys.prefix,
        cure="Run the pipeline by pdal-stages pipeline",
    )
