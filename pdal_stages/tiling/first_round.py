"""Rounds before the tiles: the raster of a far-reaching stage is computed once, in blocks.

Filtered ground depends on points half a kilometer around a tile, but only through a raster of the
lowest points and of the positions of ground points in each cell. So squares of some tiles are read
first, with the halo of the earlier stages (noise is marked before heights are computed). The lowest
points, possible ground points, and changes by earlier stages are saved. Then blocks of the raster
are computed from the lowest points around them and the points inside. Finally a tile reads the
points that the later stages need, applies the saved changes, and takes the raster from the blocks.

What a stage saves and computes is its own affair: see :class:`..stages.base.FarReaching`.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from ..base.grid import places_among
from ..stages.base import FarReaching, inside_block
from ..stages.registry import stage_from
from .checkpoint import load_arrays, save_arrays, written
from .plan import RunContext, TilePlan
from .sorted_points import Piece
from .tile_grid import Box, TileGrid

#: Dimension -> rows of a piece and their new values.
ChangedValues = dict[str, tuple[NDArray[np.int64] | None, NDArray]]


class FirstRoundResults(NamedTuple):
    """Results of the first round for a tile."""

    blocks: Any  #: for the far-reaching stage
    changed: list[ChangedValues]  #: of each piece, from the stages before it


def square_name(squares: TileGrid, square: tuple[int, int]) -> str:
    """Return the name of the first round's result for a square."""
    return f"{squares.name(square)}.first"


def block_name(block: tuple[int, int]) -> str:
    """Return the name of a block of the raster."""
    return f"{block[0]}_{block[1]}.block"


def stage_of(plan: TilePlan) -> FarReaching:
    """Return the stage that the rounds before the tiles are for."""
    assert plan.first is not None
    return cast(FarReaching, stage_from(plan.head[plan.first.at]))


def make_block(
    plan: TilePlan, block: tuple[int, int], squares: Sequence[str], target: str
) -> dict[str, Any]:
    """Save a block of the raster, computed from the files of the squares around it; return a
    record.
    """
    assert plan.first is not None
    blocks = plan.first.blocks
    low_x, low_y, high_x, high_y = TileGrid(blocks.side).box(block, blocks.reach)
    parts = []
    for path in squares:
        points = load_arrays(path, ["around"])["around"]
        x, y = points[:, 0], points[:, 1]
        parts.append(points[(x >= low_x) & (x <= high_x) & (y >= low_y) & (y <= high_y)])
    files = (load_arrays(path, [inside_block(block)]) for path in squares)
    inside = (points for arrays in files for points in arrays.values())
    around = np.concatenate(parts) if parts else np.empty((0, 4))
    save_arrays(target, stage_of(plan).compute_block(around, inside, block))
    return {"outputs": written([target])}


def blocks_around(context: RunContext, box: Box, around_m: float) -> list[tuple[int, int]]:
    """Return the blocks that touch a box, in the unit of the coordinates, grown by some meters."""
    assert context.plan.first is not None
    return TileGrid(context.plan.first.blocks.side).covering(_box_m(context, box, around_m))


def _box_m(context: RunContext, box: Box, around_m: float) -> Box:
    x0, y0, x1, y1 = (side * context.unit for side in box)
    return (x0 - around_m, y0 - around_m, x1 + around_m, y1 + around_m)


def load_first_round(
    context: RunContext, tile: tuple[int, int], read_m: float, pieces: list[Piece]
) -> FirstRoundResults:
    """Load the results for a tile that is read with some meters around it."""
    first = context.plan.first
    assert first is not None
    around_m = read_m + first.blocks.margin + first.blocks.spill
    box = context.grid.box(tile)
    stage = stage_of(context.plan)
    needed = stage.arrays_in(_box_m(context, box, around_m))
    names = map(block_name, blocks_around(context, box, around_m))
    blocks = (load_arrays(path, needed) for path in _existing(context.rasters, names))
    squares = context.squares.covering(context.grid.box(tile, read_m / context.unit))
    files = _existing(context.rasters, (square_name(context.squares, each) for each in squares))
    changed = _changed_values(first.kept or (), files, pieces)
    return FirstRoundResults(stage.join_blocks(blocks), changed)


def _existing(folder: str, names: Iterable[str]) -> list[str]:
    """Return the paths of the files that exist; others would have no points."""
    paths = (os.path.join(folder, f"{name}.npz") for name in names)
    return [path for path in paths if os.path.exists(path)]


def _changed_values(
    names: Sequence[str], squares: list[str], pieces: list[Piece]
) -> list[ChangedValues]:
    """Return for each piece the new values that earlier stages gave to its points."""
    parts: list[list[tuple]] = [[] for _ in pieces]
    for path in squares if names else ():
        saved = load_arrays(path, {piece.source.key for piece in pieces})
        for piece, columns in zip(pieces, parts, strict=True):
            points = saved.get(piece.source.key)
            if points is not None:
                rows, present = places_among(piece.index, points["index"])
                values = (points[f"dim/{name}"][present] for name in names)
                columns.append((rows[present], *values))
    changed: list[ChangedValues] = []
    for parts_of_piece in parts:
        joined = [np.concatenate(column) for column in zip(*parts_of_piece, strict=True)]
        changed.append({n: (joined[0], c) for n, c in zip(names, joined[1:], strict=False)})
    return changed
