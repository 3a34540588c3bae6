"""A call in a Python process of its own, from programs whose libraries the callee's would clash with."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from .errors import StageError


def apart(function: Callable[..., Any], *arguments: Any) -> Any:
    """``function(*arguments)`` in another process of this Python; function and arguments are such that can be pickled.

    Raises
    ------
    StageError
        What the function raises of this kind; other errors of it, and where no process comes about, as one.
    """
    root = str(Path(__file__).resolve().parents[2])
    program = (
        f"import sys; sys.path[:0] = [{root!r}]; sys.path += {[path for path in sys.path if path]!r}; "
        "from pdal_stages.base.apart import answer; answer()"
    )
    # Nothing is imported from the folder one happens to be in.
    safe = "-P" if sys.version_info >= (3, 11) else "-I"
    try:
        done = subprocess.run(
            [interpreter(), safe, "-c", program],
            input=pickle.dumps((function, arguments)),
            stdout=subprocess.PIPE,
            check=False,
        )
        good, result = pickle.loads(done.stdout)
    except (OSError, EOFError, pickle.UnpicklingError) as error:
        raise StageError(
            "a process for vector files could not be started or did not answer",
            found=str(error) or repr(error),
        ) from None
    if good:
        return result
    raise result


def interpreter() -> str:
    """The Python that this is, where a program has it within."""
    if os.path.basename(sys.executable or "").startswith("python"):
        return sys.executable
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    names = ("python.exe",) if os.name == "nt" else (f"bin/{version}", "bin/python3")
    for prefix in (sys.prefix, sys.base_prefix):
        for name in names:
            path = os.path.join(prefix, name)
            if os.access(path, os.X_OK):
                return path
    raise StageError(
        "the Python that this program has within has no program of its own",
        found=sys.prefix,
        cure="Run the pipeline by pdal-stages pipeline",
    )


def answer() -> None:
    """The other process: read a call from standard input, write what came of it to standard output."""
    with os.fdopen(os.dup(1), "wb") as out:
        os.dup2(2, 1)  # what libraries print is no answer
        said: tuple[bool, Any]
        try:
            function, arguments = pickle.load(sys.stdin.buffer)
            said = True, function(*arguments)
        except StageError as error:
            said = False, error
        except Exception as error:
            said = False, StageError(f"{type(error).__name__}: {error}")
        pickle.dump(said, out)
