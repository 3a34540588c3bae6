"""Rounds before the tiles: the raster of a far-reaching stage is computed once, in blocks that tiles share.

Filtered ground depends on points half a kilometer around a tile, but only through a raster of the lowest points and of the
positions of ground points in each cell. So each tile's own points are read first, with the halo of the earlier stages (noise
is marked before heights are computed). The lowest points, possible ground points, and changes by earlier stages are saved.
Then blocks of the raster are computed from the lowest points around them and the points inside. Finally a tile reads the
points that the later stages need, applies the saved changes, and takes the raster from the blocks.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from ..base.grid import places_among
from ..stages.first_round import FarReaching, inside_block
from ..stages.registry import stage_from
from .checkpoint import load_arrays, save_arrays, written
from .plan import RunContext, TilePlan
from .sorted_points import Piece
from .tile_grid import Box, TileGrid

Changed = dict[str, tuple[NDArray[np.int64] | None, NDArray]]


class FromBefore(NamedTuple):
    """Results of the first round for a tile."""

    blocks: Any  #: for the far-reaching stage
    changed: list[
        Changed
    ]  #: for each piece: rows and new values of dimensions, from the stages before it


def left_name(squares: TileGrid, square: tuple[int, int]) -> str:
    """Return the name of the first round's result for a square."""
    return f"{squares.name(square)}.first"


def block_name(block: tuple[int, int]) -> str:
    """The name of a block of the raster."""
    return f"{block[0]}_{block[1]}.block"


def stage_of(plan: TilePlan) -> FarReaching:
    """The stage that the rounds before the tiles are for."""
    assert plan.first is not None
    return cast(FarReaching, stage_from(plan.head[plan.first.at]))


def make_block(
    plan: TilePlan, block: tuple[int, int], tiles: Sequence[str], target: str
) -> dict[str, Any]:
    """Save a block of the raster, computed from the first round's files of the tiles around it; returns a record."""
    assert plan.first is not None
    blocks = plan.first.blocks
    low_x, low_y, high_x, high_y = TileGrid(blocks.side).box(block, blocks.reach)
    parts = [np.empty((4, 0))]  # whose rows are taken as they are
    for path in tiles:
        x, y, *_ = points = load_arrays(path, ["around"])["around"].T
        parts.append(points[:, (x >= low_x) & (x <= high_x) & (y >= low_y) & (y <= high_y)])
    inside = (load_arrays(path, [inside_block(block)]) for path in tiles)
    mine = (points for found in inside for points in found.values())
    save_arrays(target, stage_of(plan).compute_block(np.concatenate(parts, axis=1).T, mine, block))
    return {"outputs": written([target])}


def blocks_around(context: RunContext, box: Box, around_m: float) -> list[tuple[int, int]]:
    """Return the blocks that touch a box, in the unit of the coordinates, grown by some meters."""
    assert context.plan.first is not None
    return TileGrid(context.plan.first.blocks.side).covering(_box_m(context, box, around_m))


def _box_m(context: RunContext, box: Box, around_m: float) -> Box:
    x0, y0, x1, y1 = (side * context.unit for side in box)
    return (x0 - around_m, y0 - around_m, x1 + around_m, y1 + around_m)


def from_before(
    context: RunContext, tile: tuple[int, int], read_m: float, cuts: list[Piece]
) -> FromBefore:
    """The results of the earlier rounds for a tile that is read with so many meters around it."""
    first = context.plan.first
    assert first is not None
    around = read_m + first.blocks.margin + first.blocks.spill
    own = context.grid.box(tile)
    blocks = map(block_name, blocks_around(context, own, around))
    stage = stage_of(context.plan)
    needed = stage.arrays_in(_box_m(context, own, around))
    found = (
        load_arrays(path, needed) for path in _there(context.rasters, blocks)
    )  # others have no points
    squares = context.squares.covering(context.grid.box(tile, read_m / context.unit))
    left = _there(context.rasters, [left_name(context.squares, each) for each in squares])
    changed = _changed(first.kept or (), left, cuts)
    return FromBefore(stage.join_blocks(found), changed)


def _there(folder: str, names: Iterable[str]) -> list[str]:
    paths = (os.path.join(folder, f"{name}.npz") for name in names)
    return [path for path in paths if os.path.exists(path)]


def _changed(names: Sequence[str], left: list[str], cuts: list[Piece]) -> list[Changed]:
    """Return for each piece the new values that earlier stages gave to its points: rows and values by dimension."""
    parts: list[list[tuple]] = [[] for _ in cuts]
    for path in left if names else ():
        kept = load_arrays(path, {piece.source.key for piece in cuts})
        for piece, mine in zip(cuts, parts, strict=True):
            points = kept.get(piece.source.key)
            if points is not None:
                rows, there = places_among(piece.index, points["index"])
                mine.append((rows[there], *(points[f"dim/{name}"][there] for name in names)))
    found: list[Changed] = []
    for mine in parts:
        columns = [np.concatenate(column) for column in zip(*mine, strict=True)]
        found.append({n: (columns[0], c) for n, c in zip(names, columns[1:], strict=False)})
    return found
