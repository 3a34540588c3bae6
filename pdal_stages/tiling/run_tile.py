"""Run a round on a tile, step by step: read, join, run, then save or write (:func:`run_tile`).

- **read** the points of a tile and its halo, of each input a piece;
- **join** them with what earlier rounds saved (:mod:`.earlier_rounds`);
- **run** the stages of the round on them;
- look whether the halo sufficed: else read again, farther;
- **save** the results of the tile's own points, or **write** the outputs.

Filtered ground depends on points some 400 m around a tile, but only through a raster of the
lowest points and of the positions of ground points in each cell. So squares of some tiles are read
first, with the halo of the earlier stages (noise is marked before heights are computed). The lowest
points, possible ground points, and changes by earlier stages are saved. Then blocks of the raster
are computed from the lowest points around them and the points inside. Finally a tile reads the
points that the later stages need, applies the saved changes, and takes the raster from the blocks.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.asprs import LEGACY_LIMIT
from ..base.columns import SomeRows
from ..base.distinct import count_shared
from ..base.errors import NoTerrainError, PipelineError
from ..base.json_types import JsonObject, StageJson
from ..base.las_copy import LasCopy
from ..base.las_points import LasColumns
from ..base.messages import Message, Topic
from ..pipeline.copies import selection
from ..pipeline.pdal_facts import check_class_codes
from ..pipeline.run import Pipeline
from ..pipeline.runtime import Callbacks, ExpandedStage, points_of
from ..stages.base import WHOLE_CLOUD
from ..stages.points import RESERVED, SELECTED, class_counts, warning_of_no_match
from ..stages.registry import stage_types
from .earlier_rounds import (
    ChangedValues,
    far_reaching,
    load_blocks,
    load_changes,
    ready_stages,
    with_threads,
)
from .inputs import InputSource
from .jobs import save_arrays
from .options import Box, inside
from .plan import INPUT, OUTSIDE, ROW, RunContext
from .records import SharedPoints, TileRecord, WrittenFile, describe_written
from .sorted_points import Piece, cut_all
from .write_outputs import PieceResults, arrays_of, write_tile

#: How many times a tile is read again with a wider halo (not tuned); the last time with all points.
_MOST_WIDENINGS = 4
#: Dimensions that say where a point of a tile comes from.
_ORIGIN = (ROW, INPUT, OUTSIDE)


class RoundResult(NamedTuple):
    """Results of a round for a tile."""

    results: list[PieceResults]
    halo_needed_m: float = 0.0
    messages: Sequence[Message] = ()
    point_counts: Mapping[str, int] = {}  #: counts of its own points, by ``type.name``
    reduced: Sequence[dict[str, NDArray]] = ()  #: what blocks need of its own points


@dataclass
class _RoundRun:
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
    expanded: dict[int, ExpandedStage] = field(default_factory=dict)  #: by place in the pipeline

    def run(self) -> RoundResult:
        """Run the steps of the round."""
        plan = self.context.plan
        part = plan.rounds[self.number]
        origins = self._origins()
        pipeline, numbers = self._pipeline(origins)
        if plan.read_here:
            parts = [(piece.layout, piece.records) for piece in self.pieces]
            known = _concatenate_by_name(origins)
            seen = pipeline.run_here(LasColumns(parts), self.context.wkt, known, self._after)
            self._take({"spatialreference": {"wkt": self.context.wkt}}, seen, {})
        else:
            pipeline.execute(arrays=False)
        if not self.complete:
            for number, stage in self.expanded.items():
                far = part.stages[numbers[number] - part.begin]
                distance_m = far.used_m + far.before_m
                self.needs_m += [distance_m + r.reach for r in stage.reports if r.beyond_halo]
        messages = _messages(pipeline)
        if plan.where and len(origins) and not any(each[SELECTED].any() for each in origins):
            messages.append(warning_of_no_match(plan.where))
        return RoundResult(
            _collect(self.views, self.pieces),
            max(self.needs_m),
            messages,
            pipeline.point_counts,
            self.reduced,
        )

    def _origins(self) -> list[dict[str, NDArray]]:
        """Return dimensions that number a piece's points, with what an earlier round changed."""
        plan, context = self.context.plan, self.context
        changed = [ChangedValues()] * len(self.pieces)
        if self.number and plan.rounds[self.number - 1].saved:
            box = self._box(self.halo_m / context.unit)
            changed = load_changes(context, self.number - 1, box, self.pieces)
        return [
            _with_origin(number, piece, context, changed[number])
            for number, piece in enumerate(self.pieces)
        ]

    def _pipeline(
        self, origins: Sequence[Mapping[str, NDArray]]
    ) -> tuple[Pipeline, dict[int, int]]:
        """Return the pipeline of the round, its stages with their contexts.

        By the place there of each of our stages its number in :attr:`.plan.TilePlan.in_tiles`
        is returned, too.
        """
        plan, ready = self.context.plan, ready_stages(self.context)
        part = plan.rounds[self.number]
        stages, numbers = self._stages_here() if plan.read_here else self._stages(origins)
        ours = [stage for stage in ready[part.begin : part.end] if stage is not None]
        pipeline = Pipeline(stages, ready=ours)
        self.expanded = {stage.number: stage for stage in pipeline.expanded.ours}
        if part.end == len(plan.in_tiles) and not plan.copied:  # codes of earlier rounds may change
            check_class_codes([*pipeline.expanded.stages, *plan.per_output], pipeline.expanded.ours)
        for number, stage in self.expanded.items():
            used_m = part.stages[numbers[number] - part.begin].used_m
            stage.update_context(outside=OUTSIDE, used_m=used_m)
        earlier = plan.rounds[self.number - 1] if self.number else None
        if earlier is not None and earlier.blocks is not None:
            far = next(place for place, number in numbers.items() if number == earlier.end)
            blocks = load_blocks(self.context, self._box(), self.halo_m)
            self.expanded[far].update_context(blocks=blocks)
        return pipeline, numbers

    @property
    def _is_last(self) -> bool:
        return self.number + 1 == len(self.context.plan.rounds)

    def _box(self, halo_units: float = 0.0) -> Box:
        return self.context.grid_of(self.number).box(self.tile, halo_units)

    def _stages_here(self) -> tuple[list[StageJson], dict[int, int]]:
        """Return the pipeline of a round that runs without PDAL, and the numbers of our stages."""
        part = self.context.plan.rounds[self.number]
        stages: list[StageJson] = [{**self.pieces[0].source.reader, "filename": "piece.las"}]
        numbers: dict[int, int] = {}
        for number in range(part.begin, part.end):
            numbers[len(stages)] = number
            stages.append(with_threads(self.context.plan.in_tiles[number], self.context.threads))
        return stages, numbers

    def _stages(
        self, origins: Sequence[Mapping[str, NDArray]]
    ) -> tuple[list[StageJson], dict[int, int]]:
        """Return the pipeline of a round with PDAL's filters, and the numbers of our stages.

        It reads pieces that are written for it, with their origin as extra bytes, runs the stages,
        and calls functions that take their results.
        """
        plan, context = self.context.plan, self.context
        stages = []
        for number, (piece, origin) in enumerate(zip(self.pieces, origins, strict=True)):
            path = os.path.join(self.folder, f"piece{number}.las")
            added = {n: v.dtype for n, v in origin.items() if n not in piece.layout.fields}
            copy = LasCopy(piece.source.path, piece.layout, False, added)
            with copy.writing_to(Path(path)):
                copy.write(piece.records, origin)
            stages.append({**piece.source.reader_of_copy, "filename": path, "tag": f"in{number}"})
        tags = [stage["tag"] for stage in stages]
        part = plan.rounds[self.number]
        # PDAL's own filters see one file at a time, until a stage merges them.
        apart = len(self.pieces) > 1
        first, numbers = len(stages), {}
        for number, stage in enumerate(plan.in_tiles[part.begin : part.end], part.begin):
            if apart and _merges(stage):
                stages.append({"type": "filters.merge"})
                apart = False
            place = len(stages)
            stages.append(with_threads(stage, context.threads))
            kind = stage_types().get(stage["type"])
            if kind is not None:
                numbers[place] = number
                if kind.open_ended and not self.complete:
                    stages.append(self.callbacks.filter(partial(self._measure_reach, place)))
        stages.append(self.callbacks.filter(self._take))
        stages[first]["inputs"] = tags
        return stages, numbers

    def _after(self, expanded: ExpandedStage, seen: Mapping[str, NDArray]) -> None:
        """Ask an open-ended stage that has run which halo it needs."""
        if expanded.stage.open_ended and not self.complete:
            module = {"spatialreference": {"wkt": self.context.wkt}}
            self._measure_reach(expanded.number, module, seen, {})

    def _measure_reach(
        self, place: int, module: JsonObject, ins: Mapping[str, NDArray], outs: dict[str, NDArray]
    ) -> None:
        """Ask an open-ended stage which halo it needs."""
        expanded = self.expanded[place]
        points = points_of(expanded.stage, expanded.context, module, ins)
        box = [side * points.units.horizontal for side in self._box()]
        self.needs_m.append(expanded.stage.reach_of(points, expanded.context, box))

    def _take(
        self, module: JsonObject, ins: Mapping[str, NDArray], outs: dict[str, NDArray]
    ) -> None:
        """Take the results of the tile's own points, and reduce these for blocks."""
        part = self.context.plan.rounds[self.number]
        wanted = self.context.plan.creates if self._is_last else part.saved
        if wanted is None:
            wanted = [name for name in ins if not name.startswith(RESERVED)]
        rows = np.flatnonzero(ins[OUTSIDE] < 0)
        names = [ROW, INPUT, *(name for name in wanted if name in ins)]
        self.views.append({name: ins[name][rows] for name in names})
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


def _merges(stage: StageJson) -> bool:
    """Return whether a stage sees the points of all files together."""
    return stage["type"] in ("filters.merge", *stage_types())


def _messages(pipeline: Pipeline) -> list[Message]:
    """Return messages of a tile; those on the files cut for it are left to the survey's inputs."""
    messages = pipeline.log_messages
    for message in pipeline.messages:
        if message.topic is Topic.NOTHING_MATCHES:
            messages.append(replace(message, place=""))
        elif message.topic not in (Topic.INPUT, Topic.NO_REFERENCE):
            messages.append(message)
    return messages


def _with_origin(
    number: int, piece: Piece, context: RunContext, changed: ChangedValues
) -> dict[str, NDArray]:
    """Return where a piece's points come from, and the dimensions that an earlier round changed."""
    count, layout = len(piece.index), piece.layout
    columns = LasColumns([(layout, piece.records)])
    origins: dict[str, NDArray] = {
        ROW: np.arange(count, dtype=np.uint32),
        INPUT: np.full(count, number, np.uint32),
        OUTSIDE: np.where(piece.away < 0, -1.0, piece.away * context.unit),
        **selection(context.plan.where, columns),
    }
    for name, (rows, values) in changed.items():
        kind = values.dtype
        out = columns[name].astype(kind) if name in columns else np.zeros(count, kind)
        out[rows] = values
        origins[name] = out
    return origins


def _collect(views: list[dict[str, NDArray]], pieces: list[Piece]) -> list[PieceResults]:
    """Return results of the tile's own points, in the order of their pieces."""
    names = [name for view in views[:1] for name in view if name not in _ORIGIN]
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


@dataclass
class _TileHalo:
    """The halo of a tile: how far around it points are read, and whether that suffices."""

    context: RunContext
    number: int  #: of the round
    tile: tuple[int, int]
    complete_m: float  #: within which all inputs are known
    used_m: float
    short: bool = False  #: more is needed, and too much to read, or in inputs too far away
    attempts: int = 0

    @property
    def complete(self) -> bool:
        """Return whether all points of the inputs are read, so that none lies farther away."""
        grid = self.context.grid_of(self.number)
        return inside(self.context.bounds, grid.box(self.tile, self.used_m / self.context.unit))

    @property
    def side_m(self) -> float:
        """Return the side of the tile in meters."""
        return self.context.grid_of(self.number).size * self.context.unit

    @property
    def everything_m(self) -> float:
        """Return the halo in meters with which all points are read."""
        tile, bounds = self.context.grid_of(self.number).box(self.tile), self.context.bounds
        low = max(tile[axis] - bounds[axis] for axis in (0, 1))
        high = max(bounds[axis] - tile[axis] for axis in (2, 3))
        return max(low, high) * self.context.unit

    def widen(self, needed_m: float, read: int) -> bool:
        """Widen it to what stages need, `read` points so far; False where it stays as it is."""
        if self.complete or needed_m <= self.used_m:
            return False
        if math.isinf(needed_m):  # there are too few points
            needed_m = self.used_m + 2 * self.side_m
        if self.attempts + 1 == _MOST_WIDENINGS:
            needed_m = max(needed_m, self.everything_m)
        wider = (self.side_m + 2 * needed_m) / (self.side_m + 2 * self.used_m)
        too_many = read * wider**2 > self.context.most_points
        self.short = too_many or needed_m > self.complete_m
        if not self.short:
            self.used_m, self.attempts = needed_m + 1e-6, self.attempts + 1
        return not self.short


# ---- the task of a worker ------------------------------------------------------------------------


def run_tile(
    context: RunContext,
    number: int,
    tile: tuple[int, int],
    sources: Sequence[InputSource],
    complete_m: float,
    target: str,
    outputs: list[str] | None = None,
) -> TileRecord:
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
    """
    halo = _TileHalo(context, number, tile, complete_m, context.plan.rounds[number].halo_m)
    with TemporaryDirectory(dir=context.scratch, ignore_cleanup_errors=True) as folder:
        while True:
            pieces = _read(halo, sources)
            result = _join_and_run(halo, pieces, folder)
            needed_m = _wider(halo) if result is None else result.halo_needed_m
            if not halo.widen(needed_m, sum(len(piece.index) for piece in pieces)):
                break
        if result is None:
            what = "no terrain: no point near the tile can be part of it"
            raise NoTerrainError(
                what,
                found=f"within {halo.used_m:.0f} m",
                cure="Take larger tiles, or run without --tile; given ground must lie near each",
            )
        record = _describe(halo, pieces, result)
        if outputs is None:
            return replace(record, outputs=_save(halo, result, target))
        output = write_tile(result.results, context.plan, outputs, context.scratch)
        classes = record.classes if output.classes is None else output.classes
        return replace(record, outputs=output.outputs, written=output.written, classes=classes)


def _read(halo: _TileHalo, sources: Sequence[InputSource]) -> list[Piece]:
    """Return the points of a tile and its halo, from each input that has any there."""
    context = halo.context
    grid = context.grid_of(halo.number)
    return cut_all(grid, halo.tile, sources, halo.used_m / context.unit)


def _join_and_run(halo: _TileHalo, pieces: list[Piece], folder: str) -> RoundResult | None:
    """Join pieces with results of earlier rounds, run the stages; None where no ground is near."""
    plan, part = halo.context.plan, halo.context.plan.rounds[halo.number]
    has_points = any(len(piece.own_rows) for piece in pieces)
    if not has_points or (not plan.in_tiles and part.blocks is None):
        return RoundResult([PieceResults(piece, piece.own_rows, {}) for piece in pieces])
    complete = halo.complete
    try:
        return _RoundRun(
            halo.context, halo.number, halo.tile, pieces, halo.used_m, complete, folder
        ).run()
    except NoTerrainError:
        if complete:
            raise
        return None


def _wider(halo: _TileHalo) -> float:
    """Return the halo in meters in which ground is looked for after none was near."""
    return halo.side_m + 2 * halo.context.plan.rounds[halo.number].halo_m


def _describe(halo: _TileHalo, pieces: list[Piece], result: RoundResult) -> TileRecord:
    """Return the record of a tile."""
    points = sum(len(piece.own_rows) for piece in pieces)
    classes = [np.zeros(0, np.uint8)]
    classes += [r.values["Classification"] for r in result.results if "Classification" in r.values]
    return TileRecord(
        points,
        sum(len(piece.index) for piece in pieces),
        halo.used_m,
        halo.short,
        halo.used_m > halo.context.plan.rounds[halo.number].halo_m,
        points - sum(len(each.rows) for each in result.results),
        class_counts(np.concatenate(classes)),
        result.messages,
        result.point_counts,
        _shared(pieces) if halo.number + 1 == len(halo.context.plan.rounds) else [],
    )


def _shared(pieces: Sequence[Piece]) -> list[SharedPoints]:
    """Return the pairs of inputs that hold the same points in a tile, and how many."""
    parts = [(piece, piece.records[piece.own_rows]) for piece in pieces if len(piece.own_rows)]
    columns = [LasColumns([(piece.layout, records)]) for piece, records in parts]
    paths = [piece.source.path for piece, _ in parts]
    pairs = count_shared(columns).items()
    return [SharedPoints(paths[a], paths[b], count) for (a, b), count in pairs]


def _save(halo: _TileHalo, result: RoundResult, target: str) -> list[WrittenFile]:
    """Save what the next round, or an output, needs; return the file."""
    plan = halo.context.plan
    part, arrays = plan.rounds[halo.number], arrays_of(result.results)
    if halo.number + 1 < len(plan.rounds) and not part.saved:
        arrays = {}
    if part.blocks is not None:
        arrays |= _concatenate_by_name([{"around": np.empty((0, 3))}, *result.reduced])
    save_arrays(target, arrays)
    return describe_written([target])
