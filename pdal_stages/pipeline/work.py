"""Tasks as workers do them: tiles, files."""

from __future__ import annotations

import sys
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

from ..base.errors import (
    DependencyError,
    DimensionError,
    InterruptedStage,
    ModelError,
    OptionError,
    StageError,
)
from ..base.files import NO_ROOM
from ..base.shortage import is_short, shortage

#: One tile at a time in a process: PDAL's threads are ours, and memory is stated for one.
_one = threading.Lock()


class Task(Protocol):
    """Work that is sent to a worker process whole."""

    def run(self) -> Any:
        """Do it."""


@dataclass
class Call:
    """A function of a module's own, and what it is given."""

    function: Callable[..., Any]
    given: tuple

    def run(self) -> Any:
        return self.function(*self.given)


@dataclass
class TaskResult:
    """What became of a task."""

    result: Any = None
    reason: str = ""  #: why it failed; empty where it did not
    again: bool = False  #: whether trying again can help
    #: ``seconds``, ``cpu_seconds``, ``peak_mb`` (the most memory the process has held so far).
    cost: dict[str, float] = field(default_factory=dict)


def perform(task: Task) -> TaskResult:
    """Do a task; what goes wrong is in the answer, except Ctrl-C."""
    with _one:
        started, cpu = time.perf_counter(), time.process_time()
        try:
            answer = TaskResult(task.run())
        except InterruptedStage:
            raise KeyboardInterrupt from None
        except StageError as error:
            wrong = isinstance(error, OptionError | ModelError | DimensionError | DependencyError)
            answer = TaskResult(
                reason=str(error), again=not wrong
            )  # nothing helps where the request itself is wrong
        except MemoryError:
            answer = TaskResult(reason="memory ran out. Take smaller tiles or fewer workers", again=True)
        except (ImportError, OSError) as error:
            if getattr(error, "errno", None) in NO_ROOM:
                answer = TaskResult(
                    reason=f"a temporary file beside the outputs could not be written ({error}). Make room on the disk",
                    again=True,
                )
            elif not is_short(error):
                answer = _unforeseen(error)
            else:
                answer = TaskResult(reason=str(shortage(f"{type(error).__name__}: {error}")), again=True)
        except Exception as error:
            answer = _unforeseen(error)
        answer.cost = {
            "seconds": time.perf_counter() - started,
            "cpu_seconds": time.process_time() - cpu,
            "peak_mb": _peak(),
        }
        return answer


def _unforeseen(error: Exception) -> TaskResult:
    last = traceback.extract_tb(error.__traceback__)[-1]
    return TaskResult(reason=f"{type(error).__name__}: {error} ({last.name}, line {last.lineno})", again=True)


def _peak() -> float:
    """The most memory this process has held, megabytes."""
    try:
        import resource
    except ImportError:
        return 0.0
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most / (2**20 if sys.platform == "darwin" else 2**10)
