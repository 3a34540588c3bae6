"""Outputs: read the points of a file or tile again, put the results in, run the tail, rename."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .inparts import HeadersDifferError, write_in_parts
from .results import PieceResults, of_own_points, read_range
from .sources import InputSource
from .tail import run_tail

#: A larger file is written in parts of so many points.
MOST_AT_ONCE = 4_000_000


@dataclass(frozen=True)
class FileTask:
    """An input file's output, to be put together from tiles."""

    source: InputSource
    count: int  #: points of the input
    results: list[str]  #: files of tiles
    tail: list[dict[str, Any]]  #: stages to run, with the writers
    outputs: list[str]  #: what each of the writers writes
    scratch: str  #: folder for temporary files

    def run(self) -> dict[str, Any]:
        """Write the outputs; see :func:`~pdal_stages.tiling.tail.run_tail`."""

        def new_values(start: int, end: int):
            return read_range(self.results, self.source, self.count, start, end)

        writers = [stage for stage in self.tail if stage["type"].startswith("writers.")]
        kinds = {(writer["type"], Path(writer["filename"]).suffix.lower()) for writer in writers}
        if self.count > MOST_AT_ONCE and kinds <= {("writers.las", ".las"), ("writers.las", ".laz")}:
            try:
                return write_in_parts(
                    self.source, self.count, MOST_AT_ONCE, new_values, self.tail, self.outputs, self.scratch
                )
            except HeadersDifferError:  # such as automatic offsets: written at once
                pass
        reader = {**self.source.reader, "filename": self.source.path}
        return run_tail([reader], [new_values(0, self.count)], self.tail, self.outputs)


def write_tile(results: list[PieceResults], tail: list[dict[str, Any]], outputs: list[str]) -> dict[str, Any]:
    """Write one tile's own points, from the files that were cut for it."""
    mine = [result for result in results if result.piece.own.size]
    if not mine:
        return {"outputs": []}
    readers = [{**r.source.reader, "type": "readers.las", "filename": r.piece.core} for r in mine]
    return run_tail(readers, [of_own_points(result) for result in mine], tail, outputs)
