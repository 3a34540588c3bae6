"""One tile: cut it out with its surroundings, run the head, keep the tile's own results."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.errors import NoTerrainError, PipelineError, StageError
from ..base.files import write_whole
from ..base.las import read_header
from ..pipeline.callbacks import Callbacks
from ..pipeline.run import Pipeline
from ..pipeline.runtime import points_of
from ..stages import registry
from ..stages.base import Stage
from .assemble import write_tile
from .cloudindex import CloudIndex
from .ept import fetch
from .extract import Piece, cut
from .grid import Box, Grid, inside
from .results import PieceResults, class_counts, save
from .sources import Source
from .tileplan import MARGIN, ROW, SOURCE

#: How often a tile is read again with wider surroundings.
_WIDENINGS = 3
_MARK_TYPES = {ROW: "uint32_t", SOURCE: "uint32_t", MARGIN: "double"}


@dataclass(frozen=True)
class Recipe:
    """What all tiles of a run have in common.

    Attributes
    ----------
    grid : Grid
    unit : float
        Metres per unit of the coordinates.
    bounds : Box
        Of all inputs.
    head, later, tail, halo, creates
        As in :class:`~pdal_stages.tiling.tileplan.TilePlan`.
    threads : int
    most_points : int
        A tile is not read with wider surroundings that hold more.
    scratch : str
        Folder for temporary files.
    """

    grid: Grid
    unit: float
    bounds: Box
    head: list[dict[str, Any]]
    later: list[float]
    tail: list[dict[str, Any]]
    halo: float
    creates: list[str] | None
    threads: int
    most_points: int
    scratch: str


@dataclass(frozen=True)
class TileTask:
    """A tile to be worked on.

    Attributes
    ----------
    recipe : Recipe
    tile : (int, int)
    sources : list of (Source, CloudIndex or None)
        Inputs that may hold points of it or its surroundings; EPT sources have no index.
    mark : str
        Fingerprint of all that decides the result.
    result, done : str
        Files for the results and the report, where outputs are put together from tiles.
    outputs : list of str
        Otherwise: what each of the writers writes.
    """

    recipe: Recipe
    tile: tuple[int, int]
    sources: list[tuple[Source, CloudIndex | None]]
    mark: str
    result: str = ""
    done: str = ""
    outputs: list[str] | None = None

    def run(self) -> dict[str, Any]:
        """Run the head; write its results, or the outputs.

        Returns
        -------
        dict
            ``points`` of the tile, ``read`` with surroundings, ``classes``, ``buffer`` used, ``short`` (True where
            the surroundings did not suffice), ``widened``, ``dropped``.
        """
        with TemporaryDirectory(
            prefix="tile-", dir=self.recipe.scratch, ignore_cleanup_errors=True
        ) as folder:
            results, report = _settle(self, folder)
            if self.outputs is not None:
                return report | write_tile(results, self.recipe.tail, self.outputs)
            save(self.result, results)
        write_whole(self.done, json.dumps({**report, "fingerprint": self.mark}).encode())
        return report


@dataclass
class _Head:
    """What a run of the head gave; `need`: the metres of surroundings that it took."""

    results: list[PieceResults]
    legacy: bool
    need: float


def _settle(task: TileTask, folder: str) -> tuple[list[PieceResults], dict[str, Any]]:
    """Run the head with surroundings that suffice; results, and the report."""
    recipe, tile = task.recipe, task.tile
    side, buffer, short = recipe.grid.size * recipe.unit, recipe.halo, False
    head: _Head | None = None
    for attempt in range(_WIDENINGS + 1):
        cuts = _cut_all(task, buffer / recipe.unit, folder)
        read = sum(len(piece.index) for _, piece in cuts)
        own = sum(len(piece.own) for _, piece in cuts)
        if not own:
            break
        everything = inside(recipe.bounds, recipe.grid.box(tile, buffer / recipe.unit))
        try:
            head = _run_head(task, cuts, everything)
            need = head.need
        except NoTerrainError:
            if everything:
                raise
            head, need = None, side + 2 * recipe.halo  # look farther away
        if everything or need <= buffer:
            break
        short = True
        estimate = read * ((side + 2 * need) / (side + 2 * buffer)) ** 2
        if attempt == _WIDENINGS or estimate > recipe.most_points:
            if head is None:
                raise NoTerrainError(
                    "no terrain: no point near the tile may form one", found=f"within {buffer:.0f} m"
                )
            break
        buffer, short = need + 1e-6, False
    if head is None:
        empty = np.empty(0, np.int64)
        head = _Head([PieceResults(source, piece, empty, {}) for source, piece in cuts], False, 0.0)
    report = {
        "points": own,
        "read": read,
        "buffer": buffer,
        "short": short,
        "widened": buffer > recipe.halo,
        "dropped": own - sum(len(result.rows) for result in head.results),
        "classes": class_counts(head.results, head.legacy),
    }
    return head.results, report


def _cut_all(task: TileTask, margin: float, folder: str) -> list[tuple[Source, Piece]]:
    """The tile's points and their surroundings, out of every input."""
    grid, cuts = task.recipe.grid, []
    for number, (source, index) in enumerate(task.sources):
        path = source.path
        if source.kind == "ept":
            path = os.path.join(folder, f"fetched{number}.las")
            index = fetch(source, grid, task.tile, margin, path)
        if index is None:
            continue
        target = os.path.join(folder, f"piece{number}.las")
        core = "" if task.outputs is None else os.path.join(folder, f"core{number}.las")
        piece = cut(path, index, grid, task.tile, margin, target, core)
        if piece is not None:
            cuts.append((source, piece))
    return cuts


def _run_head(task: TileTask, cuts: list[tuple[Source, Piece]], everything: bool) -> _Head:
    """Run the head once; `everything`: all inputs were read, so nothing can lie farther away."""
    recipe = task.recipe
    if not recipe.head:
        return _Head([PieceResults(source, piece, piece.own, {}) for source, piece in cuts], False, 0.0)
    originals: dict[int, Mapping[str, NDArray]] | None = {} if recipe.creates is None else None
    reaches: dict[int, _Reach] = {}
    with Callbacks() as callbacks:
        stages: list[dict[str, Any]] = []
        for number, (source, piece) in enumerate(cuts):
            reader = {**source.reader, "type": "readers.las", "filename": piece.path, "tag": f"in{number}"}
            mark = _marking(number, piece, recipe.unit, originals)
            marked = callbacks.filter(mark, _MARK_TYPES, inputs=[f"in{number}"], tag=f"mark{number}")
            stages += [reader, marked]
        inputs = {"inputs": [f"mark{number}" for number in range(len(cuts))]}
        for given, later in zip(recipe.head, recipe.later, strict=True):
            stage = {**given, **inputs}
            inputs = {}
            kind = registry.stages().get(stage["type"])
            if kind is not None:
                asked = int(stage.get("threads") or 0)
                stage["threads"] = min(asked, recipe.threads) if asked else recipe.threads
            stages.append(stage)
            if kind is not None and kind.open_ended and not everything:
                reach = reaches[len(stages) - 1] = _Reach(recipe.grid.box(task.tile), later)
                stages.append(callbacks.filter(reach))
        pipeline = Pipeline(stages)
        for ours in pipeline.lowered.ours:
            if ours.number in reaches:
                reaches[ours.number].stage = ours.stage
        pipeline.execute(arrays=True)
    results, legacy = _collect(pipeline.arrays, cuts, recipe.creates, originals)
    need = max((reach.need for reach in reaches.values()), default=0.0)
    if not everything and any(_looked_far(r) for _, reports in pipeline.reports for r in reports):
        most = max(ours.stage.most_neighbors() for ours in pipeline.lowered.ours)
        need = max(need, _far_neighbors(pipeline.arrays, most, task))
    return _Head(results, legacy, need)


def _marking(number: int, piece: Piece, unit: float, originals: dict[int, Mapping[str, NDArray]] | None):
    """A function that numbers a reader's points, and keeps what they were where changes are to be found later."""
    margin = np.where(piece.margin < 0, -1.0, piece.margin * unit)

    def mark(module: Any, ins: Mapping[str, NDArray], outs: dict[str, NDArray]) -> None:
        count = len(ins["X"])
        if count != len(margin):
            raise StageError(f"the reader gave {count:,} points of {len(margin):,}")
        outs[ROW] = np.arange(count, dtype=np.uint32)
        outs[SOURCE] = np.full(count, number, np.uint32)
        outs[MARGIN] = margin
        if originals is not None:
            originals[number] = {name: v[piece.own] for name, v in ins.items() if name not in _MARK_TYPES}

    return mark


class _Reach:
    """Finds how far an open-ended stage reached for what is used of its results: up to `later` metres outside the tile."""

    def __init__(self, box: Box, later: float) -> None:
        self.box, self.later, self.need = box, later, 0.0
        self.stage: Stage | None = None

    def __call__(self, module: Any, ins: Mapping[str, NDArray], outs: dict[str, NDArray]) -> None:
        assert self.stage is not None
        points = points_of(self.stage, module, ins)
        wanted = ins[MARGIN] <= self.later if self.later > 0 else ins[MARGIN] < 0
        if points.mask is not None:
            wanted &= points.mask
        box = [side * points.units.horizontal for side in self.box]
        self.need = max(self.need, self.stage.reach_of(points, wanted, box))


def _collect(
    arrays: list[NDArray],
    cuts: list[tuple[Source, Piece]],
    creates: list[str] | None,
    originals: dict[int, Mapping[str, NDArray]] | None,
) -> tuple[list[PieceResults], bool]:
    """Results of the tile's own points, sorted as their pieces are; whether class codes hold flag bits."""
    names = [n for a in arrays[:1] for n in a.dtype.names or ()]
    headers = [read_header(piece.path) for _, piece in cuts]
    legacy = not {"Synthetic", "Withheld", "ClassFlags"} & set(names) and all(
        header is not None and header.point_format <= 5 for header in headers
    )
    if creates is None:
        names = [n for n in names if n not in _MARK_TYPES]
    else:
        names = [n for n in creates if n in names]
    results = []
    for number, (source, piece) in enumerate(cuts):
        mine = [(a, np.flatnonzero((a[MARGIN] < 0) & (a[SOURCE] == number))) for a in arrays]
        rows = np.concatenate([a[ROW][at].astype(np.int64) for a, at in mine] or [np.empty(0, np.int64)])
        order = np.argsort(rows, kind="stable")
        rows = rows[order]
        if (np.diff(rows) == 0).any():
            raise PipelineError(
                "a stage makes new points, which have no place in the input files",
                cure="Run the pipeline without --tile",
            )
        values = {name: np.concatenate([a[name][at] for a, at in mine])[order] for name in names}
        results.append(PieceResults(source, piece, rows, values))
    if originals is not None:
        for name in names:
            if not any(_changed(result, name, originals[n]) for n, result in enumerate(results)):
                for result in results:
                    del result.values[name]
    return results, legacy


def _changed(result: PieceResults, name: str, original: Mapping[str, NDArray]) -> bool:
    """Whether a dimension is new, or differs from what was read."""
    if not result.rows.size:
        return False
    before = np.searchsorted(result.piece.own, result.rows)
    return name not in original or not np.array_equal(original[name][before], result.values[name])


def _looked_far(report: dict[str, Any]) -> bool:
    return any((report.get("beyond_halo") or {}).values())


def _far_neighbors(arrays: list[NDArray], most: int, task: TileTask) -> float:
    """Metres around the tile within which the `most` nearest neighbors of all its points lie."""
    from scipy.spatial import cKDTree

    recipe = task.recipe
    x0, y0, x1, y1 = (side * recipe.unit for side in recipe.grid.box(task.tile))
    array = np.concatenate([a[["X", "Y", "Z", MARGIN]] for a in arrays])
    xyz = np.column_stack([array[c] for c in "XYZ"]) * recipe.unit
    mine = xyz[array[MARGIN] < 0]
    if len(xyz) <= most:
        return 2 * (x1 - x0)
    inward = np.min([mine[:, 0] - x0, x1 - mine[:, 0], mine[:, 1] - y0, y1 - mine[:, 1]], axis=0)
    far = cKDTree(xyz).query(mine, k=[most + 1], workers=recipe.threads)[0][:, 0]
    return float(max(0.0, (far - inward).max()))
