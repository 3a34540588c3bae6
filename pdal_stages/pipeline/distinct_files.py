"""Results of files that are read one by one, in which points that come twice count once."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..base.distinct import Box, DistinctPoints, overlaps_of, take_first
from ..base.las import header_there
from .workers import each_file

_Result = TypeVar("_Result")


@dataclass(frozen=True)
class _FileTask(Generic[_Result]):
    """Read a file."""

    function: Callable[..., _Result]  #: gets `work`, and which points are distinct
    work: tuple
    number: int  #: of the file
    overlaps: Sequence[Box]  #: where other files may have the same points
    taken: NDArray[np.uint64] | None = None  #: keys of points that came before


@dataclass(frozen=True)
class _FileResult(Generic[_Result]):
    """Result of reading a file."""

    number: int  #: of the file
    result: _Result
    shared: NDArray[np.uint64]  #: keys of points that other files may have
    repeated: int  #: points that are left out


class DistinctFiles:
    """Files whose points are counted once: those of earlier files, and of a file the first.

    Each is read once, and once more if it has points of a file before it.
    """

    def __init__(self, files: Sequence[str]) -> None:
        self.files = list(files)
        self.repeated: dict[str, int] = {}  #: points that are left out, by file; once read

    def results(
        self, function: Callable[..., _Result], work: Sequence[tuple], workers: int
    ) -> Iterator[_Result]:
        """Yield `function(*item, distinct)` for the item of work of each file, in any order.

        The function leaves out what :meth:`DistinctPoints.first` does not return; see
        :func:`.workers.each_file`.
        """
        headers = [header_there(path) for path in self.files]
        overlaps = overlaps_of([header.box if header else None for header in headers])
        tasks = [_FileTask(function, item, n, overlaps[n]) for n, item in enumerate(work)]
        waiting: dict[int, _FileResult[_Result]] = {}
        for each in self._read(tasks, workers):
            if overlaps[each.number]:
                waiting[each.number] = each
            else:
                yield each.result
        numbers = sorted(waiting)
        taken = dict(zip(numbers, take_first([waiting[n].shared for n in numbers]), strict=True))
        yield from (waiting[number].result for number in numbers if not len(taken[number]))
        again = [replace(tasks[n], taken=taken[n]) for n in numbers if len(taken[n])]
        waiting.clear()
        if again:
            yield from (each.result for each in self._read(again, workers))

    def _read(
        self, tasks: Sequence[_FileTask[_Result]], workers: int
    ) -> Iterator[_FileResult[_Result]]:
        for each in each_file(_read_file, [(task,) for task in tasks], workers):
            self.repeated[self.files[each.number]] = each.repeated
            yield each

    @property
    def messages(self) -> list[str]:
        """Return how many points came twice, and where."""
        files = {path: count for path, count in self.repeated.items() if count}
        if not files:
            return []
        first = max(files, key=lambda path: files[path])
        more = f" and {len(files) - 1:,} more files" if len(files) > 1 else ""
        return [
            f"{sum(files.values()):,} points come twice, at the same place and time, and are "
            f"counted once (in {first}{more})"
        ]


def _read_file(task: _FileTask[_Result]) -> _FileResult[_Result]:
    """Read a file."""
    distinct = DistinctPoints(task.taken, task.overlaps)
    result = task.function(*task.work, distinct)
    return _FileResult(task.number, result, distinct.shared, distinct.repeated)
