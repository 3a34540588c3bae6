"""Rounds before the tiles: the raster of a far-reaching stage is computed once, in blocks that tiles share.

Filtered ground depends on points half a kilometer around a tile, but only through a raster of the lowest points and of the
positions of ground points in each cell. So each tile's own points are read first, with the halo of the earlier stages (noise
is marked before heights are computed). The lowest points, possible ground points, and changes by earlier stages are saved.
Then blocks of the raster are computed from the lowest points around them and the points inside. Finally a tile reads the
points that the later stages need, applies the saved changes, and takes the raster from the blocks.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import places_among
from ..pipeline.runtime import points_of
from ..stages.hag_morphological import HagMorphological, inside_block
from .grid import Box, TileGrid
from .inputs import IndexedSource
from .outputs import arrays_of
from .pieces import Piece, cut_all
from .plan import OUTSIDE, TilePlan
from .store import load_arrays, save_arrays, written
from .tile import Changed, FromBefore, HeadRun, RunContext, run_head


def left_name(tile: str) -> str:
    """The name of the first round's result for a tile."""
    return f"{tile}.first"


def block_name(block: tuple[int, int]) -> str:
    """The name of a block of the raster."""
    return f"{block[0]}_{block[1]}.block"


def stage_of(plan: TilePlan) -> HagMorphological:
    """The stage that the rounds before the tiles are for."""
    assert plan.first is not None
    given = plan.head[plan.first.at]
    options = {name: value for name, value in given.items() if name not in ("type", "tag", "inputs")}
    return HagMorphological(options)


def run_first_round(
    context: RunContext, tile: tuple[int, int], sources: Sequence[IndexedSource], target: str
) -> dict[str, Any]:
    """Save what the raster needs of a tile's own points, and the changes by earlier stages; returns a record.

    `sources` may have points in the tile or its halo.
    """
    plan, first = context.plan, context.plan.first
    assert first is not None
    stage, left = stage_of(plan), [{"around": np.empty((0, 4))}]

    def leave(module: Any, ins: Mapping[str, NDArray], outs: dict[str, NDArray]) -> None:
        mine = ins[OUTSIDE] < 0
        if mine.any():
            left.append(stage.left_of(points_of(stage, module, {n: ins[n][mine] for n in ins})))

    before = replace(plan, head=plan.head[: first.at], creates=first.kept or [], first=None)
    head = HeadRun([])
    with TemporaryDirectory(prefix="first-", dir=context.scratch, ignore_cleanup_errors=True) as folder:
        cuts = cut_all(context.grid, tile, sources, first.halo_m / context.unit, folder)
        if cuts:
            head = run_head(replace(context, plan=before), tile, cuts, True, last=leave)
    arrays = {
        name: np.concatenate([one[name] for one in left if name in one])
        for name in {name for one in left for name in one}
    }
    if first.kept:
        arrays |= arrays_of(head.results)
    save_arrays(target, arrays)
    return {"outputs": written([target]), "messages": head.messages}


def make_block(plan: TilePlan, block: tuple[int, int], tiles: Sequence[str], target: str) -> dict[str, Any]:
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
    save_arrays(target, stage_of(plan).block_of(np.concatenate(parts, axis=1).T, mine, block))
    return {"outputs": written([target])}


def blocks_around(context: RunContext, tile: tuple[int, int], around_m: float) -> list[tuple[int, int]]:
    """The blocks that a tile touches with so many meters around it."""
    assert context.plan.first is not None
    box = _box_m(context, tile, around_m)
    return TileGrid(context.plan.first.blocks.side).covering(box)


def _box_m(context: RunContext, tile: tuple[int, int], around_m: float) -> Box:
    x0, y0, x1, y1 = (side * context.unit for side in context.grid.box(tile))
    return (x0 - around_m, y0 - around_m, x1 + around_m, y1 + around_m)


def from_before(
    folder: str, context: RunContext, tile: tuple[int, int], read_m: float, cuts: list[Piece]
) -> FromBefore:
    """The results of the earlier rounds in `folder` for a tile that is read with so many meters around it."""
    first = context.plan.first
    assert first is not None
    around = read_m + first.blocks.around + first.blocks.spill
    box = _box_m(context, tile, around)
    blocks = map(block_name, blocks_around(context, tile, around))
    stage = stage_of(context.plan)
    needed = stage.needed_of_blocks(box)
    found = (load_arrays(path, needed) for path in _there(folder, blocks))  # others have no points
    tiles = context.grid.covering(context.grid.box(tile, read_m / context.unit))
    left = _there(folder, [left_name(context.grid.name(each)) for each in tiles])
    changed = [_changed(first.kept or (), left, piece) for piece in cuts]
    return FromBefore(stage.made_of_blocks(found), changed)


def _there(folder: str, names: Iterable[str]) -> list[str]:
    paths = (os.path.join(folder, f"{name}.npz") for name in names)
    return [path for path in paths if os.path.exists(path)]


def _changed(names: Sequence[str], left: list[str], piece: Piece) -> Changed:
    """New values that earlier stages gave to points of a piece: rows and values by dimension."""
    parts = []
    for path in left if names else ():
        kept = load_arrays(path, under=f"{piece.source.key}/")
        if "index" in kept:
            rows, there = places_among(piece.index, kept["index"])
            parts.append((rows[there], *(kept[f"dim/{name}"][there] for name in names)))
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    return {name: (columns[0], column) for name, column in zip(names, columns[1:], strict=False)}
