"""Results of earlier rounds that a tile joins: saved values of points, and blocks of a raster.

What a stage saves and computes is its own affair: see :class:`..stages.base.FarReaching`.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from typing import cast

import numpy as np
from numpy.typing import NDArray

from ..base.grid import places_among
from ..base.json_types import JsonObject, StageJson
from ..pipeline.run import Pipeline
from ..pipeline.runtime import ExpandedStage
from ..stages.base import FarReaching, inside_block
from ..stages.registry import stage_types
from .jobs import SavedArrays, load_arrays, save_arrays
from .options import Box, TileGrid
from .plan import RunContext
from .records import FilesRecord, describe_written
from .sorted_points import Piece

#: Dimension -> rows of a piece and their new values.
ChangedValues = dict[str, tuple[NDArray[np.int64], NDArray]]


#: Stages of the run that this process works for, by its temporary folder.
_ready: dict[str, list[ExpandedStage | None]] = {}


def ready_stages(context: RunContext) -> list[ExpandedStage | None]:
    """Return our stages in tiles, made once in a process; None in the places of PDAL's."""
    if context.scratch not in _ready:
        _ready.clear()
        stages = [with_threads(step, context.threads) for step in context.plan.in_tiles]
        expanded = Pipeline(stages).expanded.ours if stages else []
        ours = {stage.number: stage for stage in expanded}
        _ready[context.scratch] = [ours.get(number) for number in range(len(stages))]
    return _ready[context.scratch]


def with_threads(step: StageJson, threads: int) -> JsonObject:
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
) -> FilesRecord:
    """Save a block of the raster, computed from the files of squares around it."""
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
    return FilesRecord(describe_written([target]))


def blocks_near(context: RunContext, box: Box, distance_m: float) -> list[tuple[int, int]]:
    """Return the blocks that touch a box, in the unit of the coordinates, grown by some meters."""
    assert context.plan.blocks is not None
    x0, y0, x1, y1 = (side * context.unit for side in box)
    grown = (x0 - distance_m, y0 - distance_m, x1 + distance_m, y1 + distance_m)
    return TileGrid(context.plan.blocks.side).covering(grown)


def load_blocks(context: RunContext, box: Box, read_m: float) -> list[SavedArrays]:
    """Return the blocks for a tile (its box) that is read with some meters around it."""
    assert context.plan.blocks is not None
    distance_m = read_m + context.plan.blocks.margin + context.plan.blocks.overhang
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
