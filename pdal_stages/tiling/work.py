"""The tasks of a tiled run, as workers do them: JSON in, JSON out."""

from __future__ import annotations

import json
import threading
import time
import traceback
from collections.abc import Callable
from typing import Any

from ..base.errors import (
    DependencyError,
    DimensionError,
    InterruptedStage,
    ModelError,
    OptionError,
    PipelineError,
    StageError,
)

#: One tile at a time in a process: PDAL's threads are ours, and memory is stated for one.
_one = threading.Lock()


def perform(task: str) -> str:
    """Do a task in a worker process.

    Parameters
    ----------
    task : str
        JSON: ``kind`` (``index``, ``tile`` or ``file``) and what that kind needs.

    Returns
    -------
    str
        JSON: the result, or ``error`` with ``reason`` and whether trying again can help (``again``).
    """
    given = json.loads(task)
    with _one:
        started, cpu = time.perf_counter(), time.process_time()
        try:
            result = _kinds()[given["kind"]](given)
        except InterruptedStage:  # what a stage makes of Ctrl-C within PDAL
            raise KeyboardInterrupt from None
        except StageError as error:
            result = {"error": {"reason": str(error), "again": _again(error)}}
        except MemoryError:
            result = {
                "error": {"reason": "memory ran out. Take smaller tiles or fewer workers", "again": True}
            }
        except Exception as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            reason = f"{type(error).__name__}: {error} ({last.name}, line {last.lineno})"
            result = {"error": {"reason": reason, "again": True}}
        result["seconds"] = time.perf_counter() - started
        result["cpu_seconds"] = time.process_time() - cpu
        result["peak_mb"] = _peak()
        return json.dumps(result)


def _kinds() -> dict[str, Callable[[dict[str, Any]], dict[str, Any]]]:
    from .assemble import write_file
    from .tilework import run_tile

    return {"index": _index, "tile": run_tile, "file": write_file}


def _index(given: dict[str, Any]) -> dict[str, Any]:
    from .cloudindex import index_las

    return index_las(given["path"], given["size"])


def _again(error: StageError) -> bool:
    """Whether an error may be gone when the task is tried again: not where the request itself is wrong."""
    if isinstance(error, PipelineError):
        return True  # PDAL's words: a full disk, a lost network folder, or anything else
    return not isinstance(error, OptionError | ModelError | DimensionError | DependencyError)


def _peak() -> float:
    """The most memory this process has held, megabytes."""
    try:
        import resource
    except ImportError:
        return 0.0
    import sys

    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most / (2**20 if sys.platform == "darwin" else 2**10)
