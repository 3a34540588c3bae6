"""Outputs: read the points of a file or tile again, put the results in, run the tail, rename."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..base import las
from ..base.asprs import LEGACY_LIMIT
from ..pipeline.filenames import LAS_WRITERS
from ..pipeline.las_output import extra_dims_option
from . import sizing
from .grid import Box
from .inparts import HeadersDifferError, write_in_parts
from .rasters import on_one_grid
from .results import NewValues, PieceResults, of_own_points, read_range
from .sources import InputSource
from .tail import run_tail
from .tileplan import TilePlan


@dataclass(frozen=True)
class FileTask:
    """An input file's output, to be put together from tiles."""

    source: InputSource
    count: int  #: points of the input
    results: list[str]  #: files of tiles
    tail: list[dict[str, Any]]  #: stages to run, with the writers
    beside: dict[str, str] | None  #: see TilePlan
    outputs: list[str]  #: what each of the writers writes
    scratch: str  #: folder for temporary files
    makes: Mapping[str, str] = field(default_factory=dict)  #: see TilePlan

    def run(self) -> dict[str, Any]:
        """Write the outputs; see :func:`~pdal_stages.tiling.tail.run_tail`. The record counts classes, too."""
        classes = np.zeros(256, np.int64)
        holds_flags = las.holds_flags(self.source.path)

        def new_values(start: int, end: int) -> NewValues:
            values = read_range(self.results, self.source, self.count, start, end)
            if not self.count:  # no tile tells which dimensions its points would have got
                nothing = {name: np.empty(0, las.number_type(kind)) for name, kind in self.makes.items()}
                values = NewValues(values.kept, {name: (None, column) for name, column in nothing.items()})
            if start == 0:  # begun, or begun anew
                classes[:] = 0
            if "Classification" in values.values:
                codes = np.asarray(values.values["Classification"][1], np.uint8)
                codes = codes & np.uint8(LEGACY_LIMIT if holds_flags else 255)
                np.add(classes, np.bincount(codes, minlength=256), out=classes)
            return values

        record = self._write(new_values)
        return record | {"classes": {str(code): int(classes[code]) for code in np.flatnonzero(classes)}}

    def _write(self, new_values: Callable[[int, int], NewValues]) -> dict[str, Any]:
        tail = with_beside(self.tail, self.beside, [self.source.path])
        writers = [stage["type"] for stage in self.tail if stage["type"].startswith("writers.")]
        kinds = {(kind, Path(path).suffix.lower()) for kind, path in zip(writers, self.outputs, strict=True)}
        if self.count > sizing.MOST_AT_ONCE and kinds <= {("writers.las", ".las"), ("writers.las", ".laz")}:
            try:
                return write_in_parts(
                    self.source,
                    self.count,
                    sizing.MOST_AT_ONCE,
                    new_values,
                    tail,
                    self.outputs,
                    self.scratch,
                )
            except HeadersDifferError:  # such as automatic offsets: written at once
                pass
        reader = {**self.source.reader, "filename": self.source.path}
        header = las.read_header(self.source.path)
        if header is not None and header.count:
            tail = on_one_grid(tail, header.box, half_open=False)
        return run_tail([reader], [new_values(0, self.count)], tail, self.outputs, self.scratch)


def write_tile(
    results: list[PieceResults], plan: TilePlan, outputs: list[str], box: Box, scratch: str
) -> dict[str, Any]:
    """Write one tile's own points, from the files that were cut for it.

    `box`: where it lies; `scratch`: the run's folder for temporary files.
    """
    mine = [result for result in results if result.piece.own.size]
    tail = with_beside(plan.tail, plan.beside, [result.piece.source.path for result in mine])
    if not mine:
        return {"outputs": []}
    if plan.takes is not None:
        return plan.takes(mine, outputs, scratch)
    readers = [{**result.piece.reader, "filename": result.piece.core} for result in mine]
    tail = on_one_grid(tail, box, half_open=True)
    return run_tail(readers, [of_own_points(result) for result in mine], tail, outputs, scratch)


def with_beside(
    tail: list[dict[str, Any]], beside: dict[str, str] | None, paths: list[str]
) -> list[dict[str, Any]]:
    """The tail with LAS writers told which extra dimensions to write: the inputs' own, and those beside them."""
    if beside is None:
        return tail
    listed = extra_dims_option(paths, beside)
    return [
        {"extra_dims": listed, **stage} if listed and stage["type"] in LAS_WRITERS else stage
        for stage in tail
    ]
