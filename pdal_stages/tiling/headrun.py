"""The head of a pipeline on a tile and its halo: points numbered, stages run, the tile's own results taken out."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.asprs import LEGACY_LIMIT
from ..base.errors import PipelineError, StageError
from ..base.las import holds_flags
from ..pipeline.callbacks import Callbacks
from ..pipeline.las_output import check_writers
from ..pipeline.references import NO_REFERENCE
from ..pipeline.run import Pipeline
from ..pipeline.runtime import points_of
from ..stages import registry
from ..stages.base import Left, Stage
from ..stages.points import HOLDS_NOWHERE
from ..stages.polygons import THE_PLACES, TOUCH_NONE
from .cut import Piece
from .grid import Box, TileGrid
from .outcome import left_alone
from .results import PieceResults
from .tileplan import INPUT, OUTSIDE, ROW, FirstRound, TilePlan

#: Points are left out before a stage that needs less than this share of the halo.
_NARROW = 0.5
#: Points whose neighbors are looked at in one go where they lie far apart.
_AT_ONCE = 100_000
_MARK_TYPES = {ROW: "uint32_t", INPUT: "uint32_t", OUTSIDE: "double"}


@dataclass(frozen=True)
class RunContext:
    """What all tiles of a run have in common."""

    plan: TilePlan
    grid: TileGrid
    unit: float  #: meters per unit of the coordinates
    bounds: Box  #: of all inputs
    threads: int
    most_points: int  #: a tile is not read with a wider halo that holds more
    scratch: str  #: folder for temporary files


@dataclass
class HeadRun:
    """What a run of the head gave."""

    results: list[PieceResults]
    need: float  #: the halo that it took, meters
    messages: list[str] = field(default_factory=list)  #: warnings and notes
    left_alone: dict[str, int] = field(default_factory=dict)  #: of the tile's own points, see :mod:`.outcome`
    narrowing: bool = True  #: whether stages after one that reaches far may be given fewer points


class FromBefore(NamedTuple):
    """What the rounds before the tiles made for a tile."""

    from_blocks: Callable[[], Any]  #: for the far-reaching stage
    #: Of each piece, new values that the stages before it gave: rows and values by dimension.
    changed: list[dict[str, tuple[NDArray[np.int64], NDArray]]]


def run_head(
    context: RunContext,
    tile: tuple[int, int],
    cuts: list[Piece],
    everything: bool,
    before: FromBefore | None = None,
    narrowing: bool = True,
) -> HeadRun:
    """Run the head once.

    `everything`: all inputs were read, so nothing can lie farther away. `before`: what is taken from the rounds before.
    With `narrowing`, stages after one that reaches far get the points alone
    that they can reach themselves. Where that turns out to be too few (the k nearest neighbors of sparse points), it is
    done again without.
    """
    plan = context.plan
    if not plan.head:
        return HeadRun([PieceResults(piece, piece.own, {}) for piece in cuts], 0.0)
    marks = _marks(cuts, context)
    begin = 0
    if before is not None and plan.first is not None and plan.first.kept is not None:
        begin = plan.first.at
        for mark, changed in zip(marks, before.changed, strict=True):
            mark.changed = changed
    reaches: dict[int, _Reach] = {}
    narrowed = False
    from_afar = None
    found = _Found(plan.creates)
    with Callbacks() as callbacks:
        stages = _marked(callbacks, cuts, marks)
        for number, (given, later) in enumerate(zip(plan.head, plan.later, strict=True)):
            if number < begin:
                continue
            stage = _with_threads(given, context.threads)
            stages.append(stage if number > begin else {**stage, **_after(marks)})
            if before is not None and plan.first is not None and number == plan.first.at:
                from_afar = len(stages) - 1
            kind = registry.stages().get(stage["type"])
            if kind is not None and kind.open_ended and not everything:
                reach = reaches[len(stages) - 1] = _Reach(context.grid.box(tile), later)
                stages.append(callbacks.filter(reach))
            if narrowing and kind is not None and 0 < later < plan.halo_m * _NARROW:
                narrowed = True
                stages.append({"type": "filters.range", "limits": f"{OUTSIDE}[:{later!r}]"})
        stages.append(callbacks.filter(found))
        pipeline = Pipeline(stages, whole=False)
        ours_there = [(ours.stage, ours.place, ours.index) for ours in pipeline.lowered.ours]
        check_writers([*pipeline.lowered.stages, *plan.tail], ours_there)
        for ours in pipeline.lowered.ours:
            ours.stage.own_points = OUTSIDE
            if ours.number == from_afar:
                assert before is not None
                ours.stage.from_blocks = before.from_blocks()
            if ours.number in reaches:
                reaches[ours.number].stage = ours.stage
        found.with_places = any(ours.stage.most_neighbors() for ours in pipeline.lowered.ours)
        pipeline.execute(arrays=False)
    results = _collect(found.views, cuts, plan.creates, marks)
    need = max((reach.need for reach in reaches.values()), default=0.0)
    far = any(report.beyond_halo for _, reports in pipeline.reports for report in reports)
    if far and narrowed:
        return run_head(context, tile, cuts, everything, before, narrowing=False)
    if far and not everything:
        most = max(ours.stage.most_neighbors() for ours in pipeline.lowered.ours)
        second = max(ours.stage.second_neighbors() for ours in pipeline.lowered.ours)
        need = max(need, _far_neighbors(found.places, most, second, context, tile))
    messages = _messages(pipeline, context.scratch)
    alone = left_alone(each[-1].figures for _, each in pipeline.reports if each)
    return HeadRun(results, need, messages, alone, narrowing)


class FirstResults(NamedTuple):
    """What the first round leaves of a tile's own points."""

    left: list[Left]  #: what the far-reaching stage needs of them
    #: New values that the stages before it gave: by inputs' keys, the points' numbers and values by dimension.
    changed: dict[str, tuple[NDArray[np.int64], dict[str, NDArray]]]
    messages: list[str]


#: The warning of `Points` in a tile: of the user's `where` with what was added for the tile, or of that alone.
_NOWHERE = re.compile(rf"{HOLDS_NOWHERE} [\d,]+ points: (?:\((.*)\) && \()?{OUTSIDE} <", re.DOTALL)


def _messages(pipeline: Pipeline, scratch: str) -> list[str]:
    """What is said of a tile, in the same words of every tile, as a run says it once; nothing of files in `scratch`."""
    lines = [f"PDAL says: {line}" for line in pipeline.log_lines]
    for text in pipeline.messages:
        if text.startswith(scratch):  # of a piece, as is said of the input
            continue
        nowhere = _NOWHERE.search(text)
        if TOUCH_NONE in text:  # the places differ from tile to tile
            lines.append(text[text.index(TOUCH_NONE) :].partition(THE_PLACES)[0])
        elif nowhere is None and NO_REFERENCE not in text:  # which the run says of its inputs
            lines.append(text)
        elif nowhere is not None and nowhere[1] is not None:
            lines.append(f"{HOLDS_NOWHERE} points: {nowhere[1]}")
        # Otherwise the tile has no point of its own: nothing that the user asked for.
    return lines


def run_first(context: RunContext, cuts: list[Piece], first: FirstRound) -> FirstResults:
    """Run the stages before the one that looks far, on a tile and the surroundings that they need."""
    marks = _marks(cuts, context, first.kept or () if first.at else ())
    with Callbacks() as callbacks:
        stages = _marked(callbacks, cuts, marks)
        head = [_with_threads(given, context.threads) for given in context.plan.head[: first.at + 1]]
        head[0] |= _after(marks)
        wanting = Pipeline([*stages, *head], whole=False).lowered.ours[-1].stage
        wanting.block_side = first.blocks.side
        left = _Left(wanting, marks)
        run = callbacks.filter(left, **(_after(marks) if first.at == 0 else {}))
        pipeline = Pipeline([*stages, *head[:-1], run], whole=False)
        pipeline.execute(arrays=False)
    messages = _messages(pipeline, context.scratch)
    return FirstResults(left.found, _changes(left.values, marks), messages)


def _changes(
    found: list[tuple[int, NDArray[np.int64], dict[str, NDArray]]], marks: list[_Mark]
) -> dict[str, tuple[NDArray[np.int64], dict[str, NDArray]]]:
    """Of the values that pieces' rows have, those that differ from what was read, input by input."""
    out: dict[str, tuple[NDArray[np.int64], dict[str, NDArray]]] = {}
    for number, mark in enumerate(marks):
        mine = [(rows, values) for piece, rows, values in found if piece == number]
        if not mine or not mark.keep:
            continue
        rows = np.concatenate([each for each, _ in mine])
        order = np.argsort(rows, kind="stable")
        rows = rows[order]
        values = {name: np.concatenate([v[name] for _, v in mine])[order] for name in mark.keep}
        mark.put_flags_back(rows, values)
        at = np.searchsorted(mark.piece.own, rows)
        new = np.zeros(len(rows), bool)
        for name, column in values.items():
            new |= column != mark.original[name][at]
        if new.any():
            chosen = {name: column[new] for name, column in values.items()}
            out[mark.piece.source.key] = (mark.piece.index[rows[new]], chosen)
    return out


def _marks(cuts: list[Piece], context: RunContext, keep: Collection[str] = ()) -> list[_Mark]:
    marks = [_Mark(number, piece, context, keep) for number, piece in enumerate(cuts)]
    old = [mark.old_format for mark in marks]
    for mark in marks:
        mark.mixed = any(old) and not all(old)
    return marks


def _marked(callbacks: Callbacks, cuts: list[Piece], marks: list[_Mark]) -> list[dict[str, Any]]:
    """Readers of the pieces, whose points are numbered."""
    stages: list[dict[str, Any]] = []
    for number, piece in enumerate(cuts):
        reader = {**piece.reader, "filename": piece.path, "tag": f"in{number}"}
        marked = callbacks.filter(marks[number], _MARK_TYPES, inputs=[f"in{number}"], tag=f"mark{number}")
        stages += [reader, marked]
    return stages


def _after(marks: list[_Mark]) -> dict[str, Any]:
    return {"inputs": [f"mark{number}" for number in range(len(marks))]}


def _with_threads(given: dict[str, Any], threads: int) -> dict[str, Any]:
    if given["type"] not in registry.stages():
        return dict(given)
    asked = int(given.get("threads") or 0)
    return {**given, "threads": min(asked, threads) if asked else threads}


class _Some(Mapping[str, NDArray]):
    """Some points' dimensions, each as it is asked for."""

    def __init__(self, arrays: Mapping[str, NDArray], mask: NDArray[np.bool_]) -> None:
        self._arrays, self._mask = arrays, mask
        self._found: dict[str, NDArray] = {}

    def __getitem__(self, name: str) -> NDArray:
        if name not in self._found:
            self._found[name] = self._arrays[name][self._mask]
        return self._found[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._arrays)

    def __len__(self) -> int:
        return len(self._arrays)


class _Left:
    """Keeps what a stage would need of a tile's own points if they were far away, and what the stages before changed."""

    def __init__(self, stage: Stage, marks: list[_Mark]) -> None:
        self.stage, self.marks = stage, marks
        self.found: list[Left] = []  # one for each view
        self.values: list[
            tuple[int, NDArray[np.int64], dict[str, NDArray]]
        ] = []  # a piece's rows and their values

    def __call__(self, module: Any, ins: Mapping[str, NDArray], outs: dict[str, NDArray]) -> None:
        mine = ins[OUTSIDE] < 0
        if mine.any():
            points = points_of(self.stage, module, _Some(ins, mine))
            self.found.append(self.stage.left_of(points))
        for number, mark in enumerate(self.marks):
            if mark.keep:
                at = np.flatnonzero(mine & (ins[INPUT] == number))
                values = {name: np.array(ins[name][at]) for name in mark.keep}
                self.values.append((number, ins[ROW][at].astype(np.int64), values))


class _Mark:
    """Numbers a reader's points, and keeps what they were where changes are to be found later.

    Old PDAL reads the flags of LAS 1.0 to 1.3 as bits of the class. Beside a file of LAS 1.4, whose flags it reads apart,
    stages could not tell: the bits then go where those are, and back into the results.
    """

    def __init__(self, number: int, piece: Piece, context: RunContext, keep: Collection[str] = ()) -> None:
        self.number, self.piece, self.keep = number, piece, list(keep)
        self.keep_all = context.plan.creates is None
        self.changed: dict[str, tuple[NDArray[np.int64], NDArray]] = {}  # given by the rounds before
        self.away = piece.away
        if context.unit != 1.0:
            self.away = np.where(piece.away < 0, -1.0, piece.away * context.unit)
        self.old_format = holds_flags(piece.path)
        self.mixed = False  # whether there are others beside it
        self.holds_flags = False  # whether class codes of the results hold flags
        self.original: dict[str, NDArray] = {}  # dimensions of the tile's own points
        self._flags: NDArray[np.uint8] | None = None

    def __call__(self, module: Any, ins: Mapping[str, NDArray], outs: dict[str, NDArray]) -> None:
        count = len(ins["X"])
        if count != len(self.away):
            raise StageError(f"the reader gave {count:,} points of {len(self.away):,}")
        outs[ROW] = np.arange(count, dtype=np.uint32)
        outs[INPUT] = np.full(count, self.number, np.uint32)
        outs[OUTSIDE] = self.away
        if self.keep_all:
            self.original = {name: v[self.piece.own] for name, v in ins.items() if name not in _MARK_TYPES}
        else:
            self.original = {name: ins[name][self.piece.own] for name in self.keep}
        given: dict[str, NDArray] = {}
        for name, (rows, values) in self.changed.items():
            given[name] = outs[name] = np.array(ins[name])
            given[name][rows] = values
        self.holds_flags = self.old_format and not {"Synthetic", "Withheld"} & set(ins)
        if self.holds_flags and self.mixed:
            codes = given.get("Classification", ins["Classification"])
            self._flags = codes[self.piece.own] & ~np.uint8(LEGACY_LIMIT)
            outs["Classification"] = codes & np.uint8(LEGACY_LIMIT)
            if "ClassFlags" in ins:
                outs["ClassFlags"] = codes >> np.uint8(LEGACY_LIMIT.bit_length())
                if self.keep_all:
                    self.original["ClassFlags"] = outs["ClassFlags"][self.piece.own]

    def put_flags_back(self, rows: NDArray[np.int64], values: dict[str, NDArray]) -> None:
        """Give new class codes of some rows the flags that were taken off."""
        if self._flags is not None and "Classification" in values:
            values["Classification"] |= self._flags[np.searchsorted(self.piece.own, rows)]


class _Reach:
    """Finds how far an open-ended stage reached for what is used of its results: up to `later` meters outside the tile."""

    def __init__(self, box: Box, later: float) -> None:
        self.box, self.later, self.need = box, later, 0.0
        self.stage: Stage | None = None

    def __call__(self, module: Any, ins: Mapping[str, NDArray], outs: dict[str, NDArray]) -> None:
        assert self.stage is not None
        points = points_of(self.stage, module, ins)
        wanted = ins[OUTSIDE] <= self.later if self.later > 0 else ins[OUTSIDE] < 0
        box = [side * points.units.horizontal for side in self.box]
        self.need = max(self.need, self.stage.reach_of(points, wanted, box))


class _Found:
    """Takes what the stages gave the tile's own points, view by view: far less than all arrays of all points.

    `with_places`: where all points are, too: X, Y, Z and how far outside the tile.
    """

    def __init__(self, creates: list[str] | None) -> None:
        self.creates, self.with_places = creates, False
        self.views: list[dict[str, NDArray]] = []
        self.places: list[NDArray[np.float64]] = []

    def __call__(self, module: Any, ins: Mapping[str, NDArray], outs: dict[str, NDArray]) -> None:
        if self.creates is None:
            names = [name for name in ins if name not in _MARK_TYPES]
        else:
            names = [name for name in self.creates if name in ins]
        mine = np.flatnonzero(ins[OUTSIDE] < 0)
        self.views.append({name: ins[name][mine] for name in (ROW, INPUT, *names)})
        if self.with_places:
            self.places.append(np.column_stack([ins[name] for name in ("X", "Y", "Z", OUTSIDE)]))


def _collect(
    views: list[dict[str, NDArray]],
    cuts: list[Piece],
    creates: list[str] | None,
    marks: list[_Mark],
) -> list[PieceResults]:
    """Results of the tile's own points, sorted as their pieces are."""
    names = [name for view in views[:1] for name in view if name not in _MARK_TYPES]
    results = []
    for number, piece in enumerate(cuts):
        mine = [(view, np.flatnonzero(view[INPUT] == number)) for view in views]
        rows = np.concatenate([np.empty(0, np.int64), *(view[ROW][at] for view, at in mine)])
        order = np.argsort(rows, kind="stable")
        rows = rows[order]
        if (np.diff(rows) == 0).any():
            raise PipelineError(
                "a stage makes new points, which have no place in the input files",
                cure="Run the pipeline without --tile",
            )
        values = {name: np.concatenate([view[name][at] for view, at in mine])[order] for name in names}
        marks[number].put_flags_back(rows, values)
        results.append(PieceResults(piece, rows, values, marks[number].holds_flags))
    if creates is None:
        for name in names:
            if not any(
                _changed(result, name, mark.original) for result, mark in zip(results, marks, strict=True)
            ):
                for result in results:
                    del result.values[name]
    return results


def _changed(result: PieceResults, name: str, original: Mapping[str, NDArray]) -> bool:
    """Whether a dimension is new, or differs from what was read."""
    if not result.rows.size:
        return False
    before = np.searchsorted(result.piece.own, result.rows)
    return name not in original or not np.array_equal(original[name][before], result.values[name])


def _far_neighbors(
    places: list[NDArray[np.float64]], most: int, second: int, context: RunContext, tile: tuple[int, int]
) -> float:
    """Meters around the tile within which the `most` nearest neighbors of all its points lie, and the `second` of these."""
    from scipy.spatial import cKDTree

    x0, y0, x1, y1 = (side * context.unit for side in context.grid.box(tile))
    every = np.concatenate(places)
    xyz = every[:, :3] * context.unit
    mine = xyz[every[:, 3] < 0]
    if len(xyz) <= most:
        return 2 * (x1 - x0)
    inward = np.min([mine[:, 0] - x0, x1 - mine[:, 0], mine[:, 1] - y0, y1 - mine[:, 1]], axis=0)
    tree = cKDTree(xyz)
    if not second:
        far = tree.query(mine, k=[most + 1], workers=context.threads)[0][:, 0]
        return float(max(0.0, (far - inward).max()))
    beyond = tree.query(xyz, k=[second + 1], workers=context.threads)[0][:, 0]
    need = 0.0
    for start in range(0, len(mine), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        away, at = tree.query(mine[part], k=most + 1, workers=context.threads)
        need = max(need, float(((away + beyond[at]).max(axis=1) - inward[part]).max()))
    return need
