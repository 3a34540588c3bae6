"""The same work for many files, one after the other or several at a time; one that fails does not stop the others."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from ..base import checks
from ..base.threads import available_threads
from .processes import Processes
from .work import Answer, perform


@dataclass
class _Call:
    """A function and what it is given."""

    function: Callable[..., Any]
    given: tuple

    def run(self) -> Any:
        return self.function(*self.given)


def each_file(
    function: Callable[..., Any], work: Sequence[tuple], workers: int = 1
) -> Iterator[tuple[tuple, Answer]]:
    """Each item of work with what became of it, as they finish.

    Parameters
    ----------
    function : callable
        Of a module's own, so that other processes find it.
    work : sequence of tuple
        Arguments.
    workers : int
        Processes; they share the cores.
    """
    workers = min(checks.whole("--workers", workers, 1, 1024), len(work))
    if workers == 1:
        for item in work:
            yield item, perform(_Call(function, item))
        return
    with Processes(workers, max(1, available_threads() // workers)) as pool:
        yield from pool.run(deque(work), lambda item: _Call(function, item))
