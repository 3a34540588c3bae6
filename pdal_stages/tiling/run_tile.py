"""A tile: its points with a halo go through the head of the pipeline, and the results of its own points are saved."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.asprs import LEGACY_LIMIT
from ..base.errors import NoTerrainError, PipelineError
from ..pipeline.las_output import REPLACED, check_writers
from ..pipeline.run import Pipeline
from ..pipeline.runtime import Callbacks, Function, points_of
from ..pipeline.spatial_reference import NO_REFERENCE
from ..stages.context import WHOLE_CLOUD
from ..stages.first_round import FarReaching
from ..stages.points import NO_POINT_MATCHES, NO_POLYGON_NEAR, class_counts
from ..stages.registry import stage_types
from .checkpoint import save_arrays, written
from .first_round import Changed, FromBefore, from_before, stage_of
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
_WIDENINGS = 3
_MARKS = (ROW, INPUT, OUTSIDE)


class HeadRun(NamedTuple):
    """The result of running the head."""

    results: list[PieceResults]
    need: float = 0.0  #: the halo that was needed, meters
    messages: Sequence[str] = ()  #: warnings and notes
    left_alone: Mapping[str, int] = {}  #: of the tile's own points, see :mod:`.jobs`


def run_head(
    context: RunContext,
    tile: tuple[int, int],
    cuts: list[Piece],
    everything: bool,
    before: FromBefore | None = None,
    last: Function | None = None,
) -> HeadRun:
    """Run the head once. `everything`: all points are read, so none lies farther away; `last` gets its result."""
    plan, first = context.plan, context.plan.first
    if not plan.head and last is None:
        return HeadRun([PieceResults(piece, piece.own, {}) for piece in cuts])
    begin, changed = 0, [Changed()] * len(cuts)
    if before is not None and first is not None and first.kept is not None:
        begin, changed = first.at, before.changed
    new = [_marked(n, piece, context.unit, changed[n]) for n, piece in enumerate(cuts)]
    flags = [flags_in_classes(piece.path) for piece in cuts]
    needs = [0.0]
    views: list[dict[str, NDArray]] = []  # of the tile's own points only, to save memory

    def reach(
        number: int, module: Any, ins: Mapping[str, NDArray], outs: dict[str, NDArray]
    ) -> None:
        one = ours[number]
        points = points_of(one.stage, one.context, module, ins)
        box = [side * points.units.horizontal for side in context.grid.box(tile)]
        needs.append(one.stage.reach_of(points, one.context, box))

    def take(module: Any, ins: Mapping[str, NDArray], outs: dict[str, NDArray]) -> None:
        wanted = ins if plan.creates is None else plan.creates
        names = [name for name in wanted if name in ins and name not in _MARKS]
        mine = np.flatnonzero(ins[OUTSIDE] < 0)
        views.append({name: ins[name][mine] for name in (ROW, INPUT, *names)})

    callbacks = Callbacks()
    readers = [{**piece.reader, "filename": piece.path} for piece in cuts]
    stages, last_read = read_with(callbacks, readers, new, flags if len(set(flags)) > 1 else [])
    apart = bool(len(cuts) > 1 and begin < len(plan.head)) and not _merges(plan.head[begin])
    if apart:  # PDAL's own filters see one file at a time, until a stage merges them
        stages.append({"type": "filters.groupby", "dimension": INPUT, "inputs": [last_read]})
        last_read = stages[-1]["tag"] = "apart"
    begins, used = len(stages), {}
    for given, used_m in zip(plan.head[begin:], plan.later[begin:], strict=False):
        if apart and _merges(given):
            stages.append({"type": "filters.merge"})
            apart = False
        used[len(stages)] = used_m
        stages.append(_with_threads(given, context.threads))
        kind = stage_types().get(given["type"])
        if kind is not None and kind.open_ended and not everything:
            stages.append(callbacks.filter(partial(reach, len(stages) - 1)))
    stages += [callbacks.filter(function) for function in (take, last) if function is not None]
    stages[begins]["inputs"] = [last_read]
    pipeline = Pipeline(stages, whole=False)
    ours = {one.number: one for one in pipeline.expanded.ours}
    check_writers([*pipeline.expanded.stages, *plan.tail], pipeline.expanded.ours)
    for one in ours.values():
        one.update_context(outside=OUTSIDE, used_m=used[one.number])
    if before is not None:  # of the first one alone
        far = next(
            one
            for one in ours.values()
            if isinstance(one.stage, FarReaching) and one.stage.blocks() is not None
        )
        far.update_context(blocks=before.blocks)
    pipeline.execute(arrays=False)
    reports = [
        report for _, reports in pipeline.reports for report in reports if report.beyond_halo
    ]
    if reports and not everything:
        needs += [plan.halo_m + report.reach for report in reports]
    return HeadRun(
        _collect(views, cuts), max(needs), _messages(pipeline, context.scratch), pipeline.left_alone
    )


def _merges(stage: Mapping[str, Any]) -> bool:
    """Return whether a stage sees the points of all files together."""
    return stage["type"] in ("filters.merge", *stage_types())


def _messages(pipeline: Pipeline, scratch: str) -> list[str]:
    """Messages of a tile, worded the same for every tile, as a run repeats them once; none about files in `scratch`."""
    lines = [f"PDAL says: {line}" for line in pipeline.log_lines]
    for text in pipeline.messages:
        about_piece = text.startswith((scratch, REPLACED)) or NO_REFERENCE in text
        if about_piece:  # the input has its own message
            continue
        known = next((words for words in (NO_POLYGON_NEAR, NO_POINT_MATCHES) if words in text), "")
        lines.append(text[text.index(known) :])  # without its stage
    return lines


def _marked(number: int, piece: Piece, unit: float, changed: Changed) -> NewValues:
    """New values that number a piece's points, and those of the first round."""
    count = len(piece.index)
    marks = {
        ROW: np.arange(count, dtype=np.uint32),
        INPUT: np.full(count, number, np.uint32),
        OUTSIDE: np.where(piece.away < 0, -1.0, piece.away * unit),
    }
    return NewValues(
        np.ones(count, bool), {name: (None, values) for name, values in marks.items()} | changed
    )


def _with_threads(given: dict[str, Any], threads: int) -> dict[str, Any]:
    if given["type"] not in stage_types():
        return dict(given)
    asked = int(given.get("threads") or 0)
    return {**given, "threads": min(asked, threads) if asked else threads}


def _collect(views: list[dict[str, NDArray]], cuts: list[Piece]) -> list[PieceResults]:
    """Results of the tile's own points, in the order of their pieces."""
    names = [name for view in views[:1] for name in view if name not in _MARKS]
    results = []
    for number, piece in enumerate(cuts):
        mine = [(view, np.flatnonzero(view[INPUT] == number)) for view in views]
        rows = np.concatenate([np.empty(0, np.int64), *(view[ROW][at] for view, at in mine)])
        order = np.argsort(rows, kind="stable")
        rows = rows[order]
        if (np.diff(rows) == 0).any():
            raise PipelineError(
                "a stage creates new points, which belong to no input file",
                cure="Run the pipeline without --tile",
            )
        values = {
            name: np.concatenate([view[name][at] for view, at in mine])[order] for name in names
        }
        if (
            flags_in_classes(piece.path) and "Classification" in values
        ):  # which old PDAL reads as bits of it
            values["Classification"] = values["Classification"] & np.uint8(LEGACY_LIMIT)
        results.append(PieceResults(piece, rows, values))
    return results


# ---- a tile ---------------------------------------------------------------------------------------------------


def run_first_round(
    context: RunContext, square: tuple[int, int], sources: Sequence[IndexedSource], target: str
) -> dict[str, Any]:
    """Save what the raster needs of a square's own points, and the changes by earlier stages; returns a record.

    `sources` may have points in the square or its halo.
    """
    plan, first = context.plan, context.plan.first
    assert first is not None
    stage, left = stage_of(plan), [{"around": np.empty((0, 4))}]

    def leave(module: Any, ins: Mapping[str, NDArray], outs: dict[str, NDArray]) -> None:
        mine = ins[OUTSIDE] < 0
        if mine.any():
            own = {name: ins[name][mine] for name in ins}
            left.append(stage.reduce_points(points_of(stage, WHOLE_CLOUD, module, own)))

    # Class codes that do not fit the writers may still be changed by the stages after these: no tail.
    before = replace(
        plan, head=plan.head[: first.at], tail=[], creates=first.kept or [], first=None
    )
    context = replace(context, plan=before, grid=context.squares)
    head = HeadRun([])
    with TemporaryDirectory(
        prefix="first-", dir=context.scratch, ignore_cleanup_errors=True
    ) as folder:
        cuts = cut_all(context.grid, square, sources, first.halo_m / context.unit, folder)
        if cuts:
            head = run_head(context, square, cuts, True, last=leave)
    arrays = {
        name: np.concatenate([one[name] for one in left if name in one])
        for name in {name for one in left for name in one}
    }
    if first.kept:
        arrays |= arrays_of(head.results)
    save_arrays(target, arrays)
    return {"outputs": written([target]), "messages": head.messages}


def run_tile(
    context: RunContext,
    tile: tuple[int, int],
    sources: Sequence[IndexedSource],
    complete: float,
    result: str,
    outputs: list[str] | None,
) -> dict[str, Any]:
    """Run the head on a tile; save the results in the file `result`, or write the `outputs`; returns a record.

    `sources` may have points in the tile or its halo; they are all inputs within `complete` meters around it.
    """
    with TemporaryDirectory(
        prefix="tile-", dir=context.scratch, ignore_cleanup_errors=True
    ) as folder:
        results, record = _settled(context, tile, sources, complete, folder)
        if outputs is not None:
            wrote = write_tile(results, context.plan, outputs, context.scratch)
            return record | wrote | {"messages": [*record["messages"], *wrote.get("messages", [])]}
        save_arrays(result, arrays_of(results))
    return record | {"outputs": written([result])}


def _settled(
    context: RunContext,
    tile: tuple[int, int],
    sources: Sequence[IndexedSource],
    complete: float,
    folder: str,
) -> tuple[list[PieceResults], dict[str, Any]]:
    """Run the head with a sufficient halo; returns results and a record.

    It has the ``points`` of the tile, those ``read`` with its halo, the ``halo_m`` used, and whether that did not
    suffice (``short``).
    """
    grid, least_m = context.grid, context.plan.halo_m
    side, halo_m, short = grid.size * context.unit, least_m, False
    head: HeadRun | None = None
    for attempt in range(_WIDENINGS + 1):
        cuts = cut_all(grid, tile, sources, halo_m / context.unit, folder)
        read = sum(len(piece.index) for piece in cuts)
        own = sum(len(piece.own) for piece in cuts)
        if not own:
            head = HeadRun([PieceResults(piece, np.empty(0, np.int64), {}) for piece in cuts])
            break
        everything = inside(context.bounds, grid.box(tile, halo_m / context.unit))
        given = from_before(context, tile, halo_m, cuts) if context.rasters else None
        try:
            head = run_head(context, tile, cuts, everything, given)
            need = head.need
        except NoTerrainError:
            if everything:
                raise
            head, need = None, side + 2 * least_m  # look farther away
        if everything or need <= halo_m:
            break
        short = True
        if math.isinf(need):  # there are too few points
            need = halo_m + 2 * side
        estimate = read * ((side + 2 * need) / (side + 2 * halo_m)) ** 2
        if attempt == _WIDENINGS or estimate > context.most_points or need > complete:
            break
        halo_m, short = need + 1e-6, False
    if head is None:
        raise NoTerrainError(
            "no terrain: no point near the tile can be part of it", found=f"within {halo_m:.0f} m"
        )
    classes = (
        one.values["Classification"] for one in head.results if "Classification" in one.values
    )
    return head.results, {
        "points": own,
        "read": read,
        "halo_m": halo_m,
        "short": short,
        "widened": halo_m > least_m,
        "dropped": own - sum(len(result.rows) for result in head.results),
        "classes": class_counts(np.concatenate([np.zeros(0, np.uint8), *classes])),
        "messages": head.messages,
        "left_alone": head.left_alone,
    }
