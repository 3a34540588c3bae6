"""A tile: its points with a halo go through the head of the pipeline, and the results of its own
points are saved.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.asprs import LEGACY_LIMIT
from ..base.errors import NoTerrainError, PipelineError
from ..pipeline.las_output import REPLACED, check_writers
from ..pipeline.run import Pipeline
from ..pipeline.runtime import Callbacks, ExpandedStage, Function, points_of
from ..pipeline.spatial_reference import NO_REFERENCE
from ..stages.base import WHOLE_CLOUD, first_round_of
from ..stages.points import NO_POINT_MATCHES, NO_POLYGON_NEAR, class_counts
from ..stages.registry import stage_types
from .checkpoint import save_arrays, written
from .first_round import ChangedValues, FirstRoundResults, load_first_round, stage_of
from .inputs import IndexedSource
from .plan import INPUT, OUTSIDE, ROW, RunContext
from .sorted_points import Piece, cut_all
from .tile_grid import inside
from .write_outputs import (
    NewValues,
    PieceResults,
    arrays_of,
    flags_in_classes,
    read_with,
    write_tile,
)

#: How many times a tile is read again with a wider halo.
_MOST_WIDENINGS = 3
_MARKS = (ROW, INPUT, OUTSIDE)


class HeadResult(NamedTuple):
    """What the head of a pipeline did with a tile."""

    results: list[PieceResults]
    halo_needed_m: float = 0.0
    messages: Sequence[str] = ()  #: warnings and notes
    left_alone: Mapping[str, int] = {}  #: of the tile's own points, see :mod:`.jobs`


@dataclass
class _HeadRun:
    """One run of the head on a tile and what was read around it."""

    context: RunContext
    tile: tuple[int, int]
    pieces: list[Piece]
    complete: bool  #: all points of the inputs were read, so none lies farther away
    earlier: FirstRoundResults | None = None
    callbacks: Callbacks = field(default_factory=Callbacks)
    needs_m: list[float] = field(default_factory=lambda: [0.0])  #: halos that stages need
    #: Dimensions of the tile's own points alone, to save memory; one for each view.
    views: list[dict[str, NDArray]] = field(default_factory=list)
    expanded: dict[int, ExpandedStage] = field(default_factory=dict)  #: by place in the pipeline
    #: Place in the pipeline -> how far outside results of a stage are used, and how far around its
    #: own input matters.
    distances_m: dict[int, tuple[float, float]] = field(default_factory=dict)

    def run(self, last: Function | None = None) -> HeadResult:
        """Run the head; `last` gets its result."""
        plan = self.context.plan
        pipeline = Pipeline(self._stages(last), whole=False)
        self.expanded = {stage.number: stage for stage in pipeline.expanded.ours}
        check_writers([*pipeline.expanded.stages, *plan.tail], pipeline.expanded.ours)
        for number, stage in self.expanded.items():
            stage.update_context(outside=OUTSIDE, used_m=self.distances_m[number][0])
        if self.earlier is not None:  # of the first one alone
            needs_rounds = (
                s for s in self.expanded.values() if first_round_of(s.stage) is not None
            )
            next(needs_rounds).update_context(blocks=self.earlier.blocks)
        pipeline.execute(arrays=False)
        if not self.complete:
            for number, stage in self.expanded.items():
                reaches = [report.reach for report in stage.reports if report.beyond_halo]
                self.needs_m += [sum(self.distances_m[number]) + reach for reach in reaches]
        messages = _messages(pipeline, self.context.scratch)
        results = _collect(self.views, self.pieces)
        return HeadResult(results, max(self.needs_m), messages, pipeline.left_alone)

    def _stages(self, last: Function | None) -> list[dict[str, Any]]:
        """Return the pipeline: readers, the head, and functions that take its result."""
        plan, first = self.context.plan, self.context.plan.first
        begin, changed = 0, [ChangedValues()] * len(self.pieces)
        if self.earlier is not None and first is not None and first.kept is not None:
            begin, changed = first.at, self.earlier.changed
        marked = [
            _marked(number, piece, self.context.unit, changed[number])
            for number, piece in enumerate(self.pieces)
        ]
        flags = [flags_in_classes(piece.path) for piece in self.pieces]
        readers = [{**piece.reader, "filename": piece.path} for piece in self.pieces]
        mixed = flags if len(set(flags)) > 1 else []
        stages, last_read = read_with(self.callbacks, readers, marked, mixed)
        apart = len(self.pieces) > 1 and begin < len(plan.head) and not _merges(plan.head[begin])
        if apart:  # PDAL's own filters see one file at a time, until a stage merges them
            stages.append({"type": "filters.groupby", "dimension": INPUT, "inputs": [last_read]})
            last_read = stages[-1]["tag"] = "apart"
        head_begins = len(stages)
        for number, step in enumerate(plan.head[begin:], begin):
            if apart and _merges(step):
                stages.append({"type": "filters.merge"})
                apart = False
            place = len(stages)
            self.distances_m[place] = plan.used_m[number], plan.upstream_m[number]
            stages.append(_with_threads(step, self.context.threads))
            kind = stage_types().get(step["type"])
            if kind is not None and kind.open_ended and not self.complete:
                stages.append(self.callbacks.filter(partial(self._measure_reach, place)))
        functions = [self._take] if last is None else [self._take, last]
        stages += [self.callbacks.filter(function) for function in functions]
        stages[head_begins]["inputs"] = [last_read]
        return stages

    def _measure_reach(
        self, place: int, module: Any, ins: Mapping[str, NDArray], outs: dict[str, NDArray]
    ) -> None:
        """Ask an open-ended stage which halo it needs."""
        expanded = self.expanded[place]
        points = points_of(expanded.stage, expanded.context, module, ins)
        box = [side * points.units.horizontal for side in self.context.grid.box(self.tile)]
        self.needs_m.append(expanded.stage.reach_of(points, expanded.context, box))

    def _take(self, module: Any, ins: Mapping[str, NDArray], outs: dict[str, NDArray]) -> None:
        """Take the results of the tile's own points."""
        creates = self.context.plan.creates
        wanted = ins if creates is None else creates
        names = [name for name in wanted if name in ins and name not in _MARKS]
        rows = np.flatnonzero(ins[OUTSIDE] < 0)
        self.views.append({name: ins[name][rows] for name in (ROW, INPUT, *names)})


def _merges(stage: Mapping[str, Any]) -> bool:
    """Return whether a stage sees the points of all files together."""
    return stage["type"] in ("filters.merge", *stage_types())


def _messages(pipeline: Pipeline, scratch: str) -> list[str]:
    """Messages of a tile, worded the same for every tile, as a run repeats them once; none about
    files in `scratch`.
    """
    lines = [f"PDAL says: {line}" for line in pipeline.log_lines]
    for text in pipeline.messages:
        about_piece = text.startswith((scratch, REPLACED)) or NO_REFERENCE in text
        if about_piece:  # the input has its own message
            continue
        known = next((words for words in (NO_POLYGON_NEAR, NO_POINT_MATCHES) if words in text), "")
        lines.append(text[text.index(known) :])  # without its stage
    return lines


def _marked(number: int, piece: Piece, unit: float, changed: ChangedValues) -> NewValues:
    """Return new values that number a piece's points, with those of the first round."""
    count = len(piece.index)
    marks = {
        ROW: np.arange(count, dtype=np.uint32),
        INPUT: np.full(count, number, np.uint32),
        OUTSIDE: np.where(piece.away < 0, -1.0, piece.away * unit),
    }
    every = {name: (None, values) for name, values in marks.items()}
    return NewValues(np.ones(count, bool), every | changed)


def _with_threads(step: dict[str, Any], threads: int) -> dict[str, Any]:
    """Return a stage that uses no more threads than its worker has."""
    if step["type"] not in stage_types():
        return dict(step)
    wanted = int(step.get("threads") or 0)
    return {**step, "threads": min(wanted, threads) if wanted else threads}


def _collect(views: list[dict[str, NDArray]], pieces: list[Piece]) -> list[PieceResults]:
    """Return results of the tile's own points, in the order of their pieces."""
    names = [name for view in views[:1] for name in view if name not in _MARKS]
    results = []
    for number, piece in enumerate(pieces):
        parts = [(view, np.flatnonzero(view[INPUT] == number)) for view in views]
        rows = np.concatenate([np.empty(0, np.int64), *(view[ROW][at] for view, at in parts)])
        order = np.argsort(rows, kind="stable")
        rows = rows[order]
        if (np.diff(rows) == 0).any():
            raise PipelineError(
                "a stage creates new points, which belong to no input file",
                cure="Run the pipeline without --tile",
            )
        values = {
            name: np.concatenate([view[name][at] for view, at in parts])[order] for name in names
        }
        # Old PDAL reads flags as bits of the class.
        if flags_in_classes(piece.path) and "Classification" in values:
            values["Classification"] = values["Classification"] & np.uint8(LEGACY_LIMIT)
        results.append(PieceResults(piece, rows, values))
    return results


# ---- tasks of workers ------------------------------------------------------------------------------


def run_first_round(
    context: RunContext, square: tuple[int, int], sources: Sequence[IndexedSource], target: str
) -> dict[str, Any]:
    """Save what blocks need of a square's own points, and changes by earlier stages.

    Parameters
    ----------
    context : RunContext
    square : (int, int)
        Column and row in the grid of squares.
    sources : sequence of IndexedSource
        Inputs that may have points in the square or its halo.
    target : str
        The file to write.

    Returns
    -------
    dict
        The record of the job.
    """
    first = context.plan.first
    assert first is not None
    stage, left = stage_of(context.plan), [{"around": np.empty((0, 4))}]

    def leave(module: Any, ins: Mapping[str, NDArray], outs: dict[str, NDArray]) -> None:
        inside = ins[OUTSIDE] < 0
        if inside.any():
            arrays = {name: values[inside] for name, values in ins.items()}
            left.append(stage.reduce_points(points_of(stage, WHOLE_CLOUD, module, arrays)))

    # Class codes that do not fit the writers may still be changed by the stages after these: no
    # tail.
    head = context.plan.head[: first.at]
    before = replace(context.plan, head=head, tail=[], creates=first.kept or [], first=None)
    context = replace(context, plan=before, grid=context.squares)
    result = HeadResult([])
    folder = TemporaryDirectory(prefix="first-", dir=context.scratch, ignore_cleanup_errors=True)
    with folder as name:
        pieces = cut_all(context.grid, square, sources, first.halo_m / context.unit, name)
        if pieces:
            result = _HeadRun(context, square, pieces, complete=True).run(leave)
    arrays = {
        name: np.concatenate([part[name] for part in left if name in part])
        for name in {name for part in left for name in part}
    }
    if first.kept:
        arrays |= arrays_of(result.results)
    save_arrays(target, arrays)
    return {"outputs": written([target]), "messages": result.messages}


def run_tile(
    context: RunContext,
    tile: tuple[int, int],
    sources: Sequence[IndexedSource],
    complete_m: float,
    result: str,
    outputs: list[str] | None,
) -> dict[str, Any]:
    """Run the head on a tile; save the results or write the outputs.

    Parameters
    ----------
    context : RunContext
    tile : (int, int)
        Column and row.
    sources : sequence of IndexedSource
        All inputs within `complete_m` meters around the tile.
    complete_m : float
    result : str
        The file for the results, where tiles are not outputs.
    outputs : list of str, optional
        The files of the writers, where tiles are outputs.

    Returns
    -------
    dict
        The record of the job.
    """
    folder = TemporaryDirectory(prefix="tile-", dir=context.scratch, ignore_cleanup_errors=True)
    with folder as name:
        results, record = _run_with_halo(context, tile, sources, complete_m, name)
        if outputs is not None:
            output = write_tile(results, context.plan, outputs, context.scratch)
            messages = [*record["messages"], *output.get("messages", [])]
            return record | output | {"messages": messages}
        save_arrays(result, arrays_of(results))
    return record | {"outputs": written([result])}


def _run_with_halo(
    context: RunContext,
    tile: tuple[int, int],
    sources: Sequence[IndexedSource],
    complete_m: float,
    folder: str,
) -> tuple[list[PieceResults], dict[str, Any]]:
    """Run the head with a sufficient halo; return results and a record.

    It has the ``points`` of the tile, those ``read`` with its halo, the ``halo_m`` used, and
    whether that was too ``short``.
    """
    grid, least_m = context.grid, context.plan.halo_m
    side_m, halo_m, short = grid.size * context.unit, least_m, False
    head: HeadResult | None = None
    for attempt in range(_MOST_WIDENINGS + 1):
        pieces = cut_all(grid, tile, sources, halo_m / context.unit, folder)
        read = sum(len(piece.index) for piece in pieces)
        points = sum(len(piece.own_rows) for piece in pieces)
        if not points or not context.plan.head:
            head = HeadResult([PieceResults(piece, piece.own_rows, {}) for piece in pieces])
            break
        complete = inside(context.bounds, grid.box(tile, halo_m / context.unit))
        earlier = load_first_round(context, tile, halo_m, pieces) if context.rasters else None
        try:
            head = _HeadRun(context, tile, pieces, complete, earlier).run()
            needed_m = head.halo_needed_m
        except NoTerrainError:
            if complete:
                raise
            head, needed_m = None, side_m + 2 * least_m  # look farther away
        if complete or needed_m <= halo_m:
            break
        short = True
        if math.isinf(needed_m):  # there are too few points
            needed_m = halo_m + 2 * side_m
        estimate = read * ((side_m + 2 * needed_m) / (side_m + 2 * halo_m)) ** 2
        if attempt == _MOST_WIDENINGS or estimate > context.most_points or needed_m > complete_m:
            break
        halo_m, short = needed_m + 1e-6, False
    if head is None:
        raise NoTerrainError(
            "no terrain: no point near the tile can be part of it", found=f"within {halo_m:.0f} m"
        )
    classes = [np.zeros(0, np.uint8)]
    classes += [r.values["Classification"] for r in head.results if "Classification" in r.values]
    return head.results, {
        "points": points,
        "read": read,
        "halo_m": halo_m,
        "short": short,
        "widened": halo_m > least_m,
        "dropped": points - sum(len(result.rows) for result in head.results),
        "classes": class_counts(np.concatenate(classes)),
        "messages": head.messages,
        "left_alone": head.left_alone,
    }
