"""Results of files that are read one by one, in which points that come twice count once."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from ..base.distinct import Box, DistinctPoints, overlaps_of, take_first
from ..base.las import header_there
from .workers import each_file


class DistinctFiles:
    """Files whose points are counted once: those of earlier files, and of a file the first.

    Each is read once, and once more if it has points of a file before it.
    """

    def __init__(self, files: Sequence[str]) -> None:
        self.files = list(files)
        self.repeated: dict[str, int] = {}  #: points that are left out, by file; once read

    def results(
        self, function: Callable[..., Any], work: Sequence[tuple], workers: int
    ) -> Iterator[Any]:
        """Yield `function(*item, distinct)` for the item of work of each file, in any order.

        The function leaves out what :meth:`DistinctPoints.first` does not return; see
        :func:`.workers.each_file`.
        """
        headers = [header_there(path) for path in self.files]
        overlaps = overlaps_of([header.box if header else None for header in headers])
        tasks = [(function, item, n, overlaps[n], None) for n, item in enumerate(work)]
        waiting: dict[int, tuple[Any, Any]] = {}
        for number, result, keys in self._read(tasks, workers):
            if overlaps[number]:
                waiting[number] = result, keys
            else:
                yield result
        numbers = sorted(waiting)
        taken = dict(zip(numbers, take_first([waiting[n][1] for n in numbers]), strict=True))
        yield from (waiting[number][0] for number in numbers if not len(taken[number]))
        again = [(*tasks[n][:4], taken[n]) for n in numbers if len(taken[n])]
        waiting.clear()
        if again:
            yield from (result for _, result, _ in self._read(again, workers))

    def _read(self, tasks: Sequence[tuple], workers: int) -> Iterator[tuple[int, Any, Any]]:
        for number, result, keys, repeated in each_file(_read_file, tasks, workers):
            self.repeated[self.files[number]] = repeated
            yield number, result, keys

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


def _read_file(
    function: Callable[..., Any], item: tuple, number: int, overlaps: Sequence[Box], taken: Any
) -> tuple[int, Any, Any, int]:
    """Return a file's number, its result, the keys that others may have, and points left out."""
    distinct = DistinctPoints(taken, overlaps)
    result = function(*item, distinct)
    return number, result, distinct.shared, distinct.repeated
