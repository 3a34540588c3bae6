"""Run a round on a tile: its points with a halo go through stages, and its results are saved.

Filtered ground depends on points some 400 m around a tile, but only through a raster of the
lowest points and of the positions of ground points in each cell. So squares of some tiles are read
first, with the halo of the earlier stages (noise is marked before heights are computed). The lowest
points, possible ground points, and changes by earlier stages are saved. Then blocks of the raster
are computed from the lowest points around them and the points inside. Finally a tile reads the
points that the later stages need, applies the saved changes, and takes the raster from the blocks.

What a stage saves and computes is its own affair: see :class:`..stages.base.FarReaching`.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from ..base.asprs import LEGACY_LIMIT
from ..base.errors import NoTerrainError, PipelineError
from ..base.grid import places_among
from ..base.las_copy import LasCopy
from ..base.las_points import RecordColumns, SomeRows
from ..pipeline.copies import selection
from ..pipeline.pdal_facts import check_outputs
from ..pipeline.run import Pipeline
from ..pipeline.runtime import Callbacks, ExpandedStage, points_of
from ..pipeline.spatial_reference import NO_REFERENCE
from ..stages.base import WHOLE_CLOUD, FarReaching, inside_block
from ..stages.points import NO_POINT_MATCHES, NO_POLYGON_NEAR, SELECTED, class_counts
from ..stages.registry import stage_types
from .inputs import InputSource
from .jobs import SavedArrays, load_arrays, save_arrays, written
from .options import Box, TileGrid, inside
from .plan import INPUT, OUTSIDE, ROW, RunContext
from .sorted_points import Piece, cut_all
from .write_outputs import PieceResults, arrays_of, write_tile

#: How many times a tile is read again with a wider halo (not tuned); one that needs more is
#: reported as ``short``.
_MOST_WIDENINGS = 3
_MARKS = (ROW, INPUT, OUTSIDE)


# ---- results of earlier rounds -------------------------------------------------------------------

#: Dimension -> rows of a piece and their new values.
ChangedValues = dict[str, tuple[NDArray[np.int64], NDArray]]

#: Stages of the run that this process works for, by its temporary folder.
_ready: dict[str, list[ExpandedStage | None]] = {}


def ready_stages(context: RunContext) -> list[ExpandedStage | None]:
    """Return our stages of the head, made once in a process; None in the places of PDAL's."""
    if context.scratch not in _ready:
        _ready.clear()
        head = [with_threads(step, context.threads) for step in context.plan.head]
        expanded = Pipeline(head).expanded.ours if head else []
        ours = {stage.number: stage for stage in expanded}
        _ready[context.scratch] = [ours.get(number) for number in range(len(head))]
    return _ready[context.scratch]


def with_threads(step: dict[str, Any], threads: int) -> dict[str, Any]:
    """Return a stage that uses no more threads than its worker has."""
    if step["type"] not in stage_types():
        return dict(step)
    wanted = int(step.get("threads") or 0)
    return {**step, "threads": min(wanted, threads) if wanted else threads}


def far_reaching(context: RunContext) -> FarReaching:
    """Return the stage that blocks are computed for."""
    at = next(part.end for part in context.plan.rounds if part.blocks)
    stage = ready_stages(context)[at]
    assert stage is not None
    return cast(FarReaching, stage.stage)


def square_name(context: RunContext, number: int, square: tuple[int, int]) -> str:
    """Return the name of the result of a round for a square."""
    return f"{context.squares.name(square)}.round{number}"


def block_name(block: tuple[int, int]) -> str:
    """Return the name of a block of the raster."""
    return f"{block[0]}_{block[1]}.block"


def make_block(
    context: RunContext, block: tuple[int, int], squares: Sequence[str], target: str
) -> dict[str, Any]:
    """Save a block of the raster, computed from the files of squares around it; return a record."""
    blocks = context.plan.blocks
    assert blocks is not None
    low_x, low_y, high_x, high_y = TileGrid(blocks.side).box(block, blocks.reach)
    parts = [np.empty((0, 3))]
    for path in squares:
        points = load_arrays(path, ["around"])["around"]
        x, y = points[:, 0], points[:, 1]
        parts.append(points[(x >= low_x) & (x <= high_x) & (y >= low_y) & (y <= high_y)])
    files = (load_arrays(path, [inside_block(block)]) for path in squares)
    inside = (points for arrays in files for points in arrays.values())
    save_arrays(target, far_reaching(context).compute_block(np.concatenate(parts), inside, block))
    return {"outputs": written([target])}


def blocks_near(context: RunContext, box: Box, distance_m: float) -> list[tuple[int, int]]:
    """Return the blocks that touch a box, in the unit of the coordinates, grown by some meters."""
    assert context.plan.blocks is not None
    x0, y0, x1, y1 = (side * context.unit for side in box)
    grown = (x0 - distance_m, y0 - distance_m, x1 + distance_m, y1 + distance_m)
    return TileGrid(context.plan.blocks.side).covering(grown)


def load_blocks(context: RunContext, box: Box, read_m: float) -> list[SavedArrays]:
    """Return the blocks for a tile (its box) that is read with some meters around it."""
    assert context.plan.blocks is not None
    distance_m = read_m + context.plan.blocks.margin + context.plan.blocks.spill
    names = map(block_name, blocks_near(context, box, distance_m))
    return [SavedArrays(path) for path in _existing(context.kept, names)]


def load_changes(
    context: RunContext, number: int, box: Box, pieces: list[Piece]
) -> list[ChangedValues]:
    """Return the new values that a round gave to the points of each piece in a box."""
    squares = (square_name(context, number, each) for each in context.squares.covering(box))
    rows_of: list[list[NDArray]] = [[] for _ in pieces]
    values_of: list[dict[str, list[NDArray]]] = [{} for _ in pieces]
    for path in _existing(context.kept, squares):
        saved = load_arrays(path, {piece.source.key for piece in pieces})
        for piece, all_rows, columns in zip(pieces, rows_of, values_of, strict=True):
            points = saved.get(piece.source.key)
            if points is not None:
                rows, present = places_among(piece.index, points["index"])
                all_rows.append(rows[present])
                for name in list(points.dtype.names or ())[1:]:
                    columns.setdefault(name.removeprefix("dim/"), []).append(points[name][present])
    return [
        {name: (np.concatenate(rows), np.concatenate(c)) for name, c in columns.items()}
        for rows, columns in zip(rows_of, values_of, strict=True)
    ]


def _existing(folder: str, names: Iterable[str]) -> list[str]:
    """Return the paths of the files that exist; others would have no points."""
    paths = (os.path.join(folder, f"{name}.npz") for name in names)
    return [path for path in paths if os.path.exists(path)]


# ---- one run -------------------------------------------------------------------------------------


class HeadResult(NamedTuple):
    """Results of a round for a tile."""

    results: list[PieceResults]
    halo_needed_m: float = 0.0
    messages: Sequence[str] = ()  #: warnings and notes
    point_counts: Mapping[str, int] = {}  #: counts of its own points, by ``type.name``
    reduced: Sequence[dict[str, NDArray]] = ()  #: what blocks need of its own points


@dataclass
class _HeadRun:
    """One run of a round on a tile and what was read around it."""

    context: RunContext
    number: int  #: of the round
    tile: tuple[int, int]
    pieces: list[Piece]
    halo_m: float  #: within which they were read
    complete: bool  #: all points of the inputs were read, so none lies farther away
    folder: str  #: for files of this run
    callbacks: Callbacks = field(default_factory=Callbacks)
    needs_m: list[float] = field(default_factory=lambda: [0.0])  #: halos that stages need
    #: Dimensions of the tile's own points alone, to save memory; one for each view.
    views: list[dict[str, NDArray]] = field(default_factory=list)
    reduced: list[dict[str, NDArray]] = field(default_factory=list)  #: one for each view
    #: Place in the pipeline of our stages -> step of the head.
    steps: dict[int, int] = field(default_factory=dict)
    expanded: dict[int, ExpandedStage] = field(default_factory=dict)  #: by place in the pipeline

    def run(self) -> HeadResult:
        """Run the steps of the round."""
        plan = self.context.plan
        part = plan.rounds[self.number]
        marks = self._marks()
        pipeline = self._pipeline(marks)
        if plan.read_here:
            parts = [(piece.layout, piece.records) for piece in self.pieces]
            known = _concatenate_by_name(marks)
            seen = pipeline.run_here(RecordColumns(parts), self.context.wkt, known, self._after)
            self._take({"spatialreference": {"wkt": self.context.wkt}}, seen, {})
        else:
            pipeline.execute(arrays=False)
        if not self.complete:
            for number, stage in self.expanded.items():
                step = self.steps[number] - part.begin
                distance_m = part.used_m[step] + part.upstream_m[step]
                self.needs_m += [distance_m + r.reach for r in stage.reports if r.beyond_halo]
        messages = _messages(pipeline, self.context.scratch)
        if plan.where and len(marks) and not any(mark[SELECTED].any() for mark in marks):
            messages.append(f"{NO_POINT_MATCHES} {plan.where}")
        return HeadResult(
            _collect(self.views, self.pieces),
            max(self.needs_m),
            messages,
            pipeline.point_counts,
            self.reduced,
        )

    def _marks(self) -> list[dict[str, NDArray]]:
        """Return dimensions that number a piece's points, with what an earlier round changed."""
        plan, context = self.context.plan, self.context
        changed = [ChangedValues()] * len(self.pieces)
        if self.number and plan.rounds[self.number - 1].kept:
            box = self._box(self.halo_m / context.unit)
            changed = load_changes(context, self.number - 1, box, self.pieces)
        return [
            _marked(number, piece, context, changed[number])
            for number, piece in enumerate(self.pieces)
        ]

    def _pipeline(self, marks: Sequence[Mapping[str, NDArray]]) -> Pipeline:
        """Return the pipeline of the round, its stages with their contexts."""
        plan, ready = self.context.plan, ready_stages(self.context)
        part = plan.rounds[self.number]
        stages = self._stages_here() if plan.read_here else self._stages(marks)
        ours = [stage for stage in ready[part.begin : part.end] if stage is not None]
        pipeline = Pipeline(stages, ready=ours)
        self.expanded = {stage.number: stage for stage in pipeline.expanded.ours}
        if part.end == len(plan.head) and not plan.copied:  # codes of earlier rounds may change
            check_outputs([*pipeline.expanded.stages, *plan.tail], pipeline.expanded.ours)
        for number, stage in self.expanded.items():
            used_m = part.used_m[self.steps[number] - part.begin]
            stage.update_context(outside=OUTSIDE, used_m=used_m)
        earlier = plan.rounds[self.number - 1] if self.number else None
        if earlier is not None and earlier.blocks is not None:
            far = next(n for n, step in self.steps.items() if step == earlier.end)
            blocks = load_blocks(self.context, self._box(), self.halo_m)
            self.expanded[far].update_context(blocks=blocks)
        return pipeline

    @property
    def _is_last(self) -> bool:
        return self.number + 1 == len(self.context.plan.rounds)

    def _box(self, halo_units: float = 0.0) -> Box:
        return self.context.grid_of(self.number).box(self.tile, halo_units)

    def _stages_here(self) -> list[dict[str, Any]]:
        """Return the pipeline of a round that runs without PDAL: a reader and the steps."""
        part = self.context.plan.rounds[self.number]
        stages: list[dict[str, Any]] = [{**self.pieces[0].reader, "filename": "piece.las"}]
        for number in range(part.begin, part.end):
            self.steps[len(stages)] = number
            stages.append(with_threads(self.context.plan.head[number], self.context.threads))
        return stages

    def _stages(self, marks: Sequence[Mapping[str, NDArray]]) -> list[dict[str, Any]]:
        """Return the pipeline of a round with PDAL's filters.

        It reads pieces that are written for it, with their marks as extra bytes, runs the steps,
        and calls functions that take their results.
        """
        plan, context = self.context.plan, self.context
        stages = []
        for number, (piece, mark) in enumerate(zip(self.pieces, marks, strict=True)):
            path = os.path.join(self.folder, f"piece{number}.las")
            added = {n: v.dtype for n, v in mark.items() if n not in piece.layout.names}
            copy = LasCopy(piece.source.path, piece.layout, False, added)
            with copy.writing_to(Path(path)):
                copy.write(piece.records, mark)
            reader = {**piece.reader, "filename": path, "tag": f"in{number}"}
            stages.append({**reader, "use_eb_vlr": True})
        tags = [stage["tag"] for stage in stages]
        part = plan.rounds[self.number]
        # PDAL's own filters see one file at a time, until a stage merges them.
        apart = len(self.pieces) > 1
        head_begins = len(stages)
        for number, step in enumerate(plan.head[part.begin : part.end], part.begin):
            if apart and _merges(step):
                stages.append({"type": "filters.merge"})
                apart = False
            place = len(stages)
            stages.append(with_threads(step, context.threads))
            kind = stage_types().get(step["type"])
            if kind is not None:
                self.steps[place] = number
                if kind.open_ended and not self.complete:
                    stages.append(self.callbacks.filter(partial(self._measure_reach, place)))
        stages.append(self.callbacks.filter(self._take))
        stages[head_begins]["inputs"] = tags
        return stages

    def _after(self, expanded: ExpandedStage, seen: Mapping[str, NDArray]) -> None:
        """Ask an open-ended stage that has run which halo it needs."""
        if expanded.stage.open_ended and not self.complete:
            module = {"spatialreference": {"wkt": self.context.wkt}}
            self._measure_reach(expanded.number, module, seen, {})

    def _measure_reach(
        self, place: int, module: Any, ins: Mapping[str, NDArray], outs: dict[str, NDArray]
    ) -> None:
        """Ask an open-ended stage which halo it needs."""
        expanded = self.expanded[place]
        points = points_of(expanded.stage, expanded.context, module, ins)
        box = [side * points.units.horizontal for side in self._box()]
        self.needs_m.append(expanded.stage.reach_of(points, expanded.context, box))

    def _take(self, module: Any, ins: Mapping[str, NDArray], outs: dict[str, NDArray]) -> None:
        """Take the results of the tile's own points, and reduce these for blocks."""
        part = self.context.plan.rounds[self.number]
        wanted = self.context.plan.creates if self._is_last else part.kept
        names = [name for name in (ins if wanted is None else wanted) if name in ins]
        rows = np.flatnonzero(ins[OUTSIDE] < 0)
        marks = [ROW, INPUT, *(name for name in names if name not in _MARKS)]
        self.views.append({name: ins[name][rows] for name in marks})
        if part.blocks is not None and len(rows):
            stage = far_reaching(self.context)
            points = points_of(stage, WHOLE_CLOUD, module, SomeRows(ins, rows))
            self.reduced.append(stage.reduce_points(points))


def _concatenate_by_name(parts: Sequence[Mapping[str, NDArray]]) -> dict[str, NDArray]:
    """Return the arrays of all views together, by name."""
    return {
        name: np.concatenate([part[name] for part in parts if name in part])
        for name in {name for part in parts for name in part}
    }


def _merges(stage: Mapping[str, Any]) -> bool:
    """Return whether a stage sees the points of all files together."""
    return stage["type"] in ("filters.merge", *stage_types())


def _messages(pipeline: Pipeline, scratch: str) -> list[str]:
    """Return messages of a tile, the same words for every tile; none about files in `scratch`."""
    lines = [f"PDAL says: {line}" for line in pipeline.log_lines]
    for text in pipeline.messages:
        about_piece = text.startswith(scratch) or NO_REFERENCE in text
        if about_piece:  # the input has its own message
            continue
        known = next((words for words in (NO_POLYGON_NEAR, NO_POINT_MATCHES) if words in text), "")
        lines.append(text[text.index(known) :])  # without its stage
    return lines


def _marked(
    number: int, piece: Piece, context: RunContext, changed: ChangedValues
) -> dict[str, NDArray]:
    """Return dimensions that mark a piece's points, with those that an earlier round changed."""
    count, layout = len(piece.index), piece.layout
    columns = RecordColumns([(layout, piece.records)])
    marks: dict[str, NDArray] = {
        ROW: np.arange(count, dtype=np.uint32),
        INPUT: np.full(count, number, np.uint32),
        OUTSIDE: np.where(piece.away < 0, -1.0, piece.away * context.unit),
        **selection(context.plan.where, columns),
    }
    for name, (rows, values) in changed.items():
        kind = values.dtype
        out = columns[name].astype(kind) if name in columns else np.zeros(count, kind)
        out[rows] = values
        marks[name] = out
    return marks


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
        if piece.layout.is_old and "Classification" in values:  # old PDAL reads flags as bits of it
            values["Classification"] = values["Classification"] & np.uint8(LEGACY_LIMIT)
        results.append(PieceResults(piece, rows, values))
    return results


# ---- the task of a worker ------------------------------------------------------------------------


def run_tile(
    context: RunContext,
    number: int,
    tile: tuple[int, int],
    sources: Sequence[InputSource],
    complete_m: float,
    target: str,
    outputs: list[str] | None = None,
) -> dict[str, Any]:
    """Run a round on a tile, or on a larger square; save the results or write the outputs.

    Parameters
    ----------
    context : RunContext
    number : int
        Number of the round.
    tile : (int, int)
        Column and row in the grid of the round.
    sources : sequence of InputSource
        All inputs within `complete_m` meters around the tile.
    complete_m : float
    target : str
        The file for the results, where tiles are not outputs.
    outputs : list of str, optional
        The files of the writers, where tiles are outputs.

    Returns
    -------
    dict
        The record of the job.
    """
    with TemporaryDirectory(dir=context.scratch, ignore_cleanup_errors=True) as folder:
        head, record = _run_with_halo(context, number, tile, sources, complete_m, folder)
        if outputs is not None:
            output = write_tile(head.results, context.plan, outputs, context.scratch)
            messages = [*record["messages"], *output.get("messages", [])]
            return record | output | {"messages": messages}
        part, arrays = context.plan.rounds[number], arrays_of(head.results)
        if number + 1 < len(context.plan.rounds):
            arrays = arrays if part.kept else {}
        if part.blocks is not None:
            arrays |= _concatenate_by_name([{"around": np.empty((0, 3))}, *head.reduced])
        save_arrays(target, arrays)
        return record | {"outputs": written([target])}


def _run_with_halo(
    context: RunContext,
    number: int,
    tile: tuple[int, int],
    sources: Sequence[InputSource],
    complete_m: float,
    folder: str,
) -> tuple[HeadResult, dict[str, Any]]:
    """Run a round with a sufficient halo; return results and a record.

    It has the ``points`` of the tile, those ``read`` with its halo, the ``halo_m`` used, and
    whether that was too ``short``.
    """
    grid, part = context.grid_of(number), context.plan.rounds[number]
    side_m, halo_m, short = grid.size * context.unit, part.halo_m, False
    head: HeadResult | None = None
    for attempt in range(_MOST_WIDENINGS + 1):
        pieces = cut_all(grid, tile, sources, halo_m / context.unit)
        read = sum(len(piece.index) for piece in pieces)
        points = sum(len(piece.own_rows) for piece in pieces)
        if not points or (not context.plan.head and part.blocks is None):
            head = HeadResult([PieceResults(piece, piece.own_rows, {}) for piece in pieces])
            break
        complete = inside(context.bounds, grid.box(tile, halo_m / context.unit))
        try:
            head = _HeadRun(context, number, tile, pieces, halo_m, complete, folder).run()
            needed_m = head.halo_needed_m
        except NoTerrainError:
            if complete:
                raise
            head, needed_m = None, side_m + 2 * part.halo_m  # look farther away
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
    return head, {
        "points": points,
        "read": read,
        "halo_m": halo_m,
        "short": short,
        "widened": halo_m > part.halo_m,
        "dropped": points - sum(len(result.rows) for result in head.results),
        "classes": class_counts(np.concatenate(classes)),
        "messages": head.messages,
        "point_counts": head.point_counts,
    }
