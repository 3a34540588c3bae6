"""Rounds before the tiles: what a far-reaching stage needs of points is made once, and tiles put it together.

Filtered ground looks half a kilometer around a tile, but what decides on it is a raster: of the lowest points, and of where
the ground's points lie in each cell. So each tile's own points are read first, with the surroundings that the stages before
need (noise is marked before heights are made). The lowest are written into a file, all that may be ground, and what the
stages before changed. Then blocks of the raster are made, each out of the lowest points of its surroundings and the points
inside. At last a tile reads the points that the stages after need, gives them what the stages before changed, and takes the
raster from the blocks.
"""

from __future__ import annotations

import os
from collections.abc import Collection
from dataclasses import dataclass
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ..stages.hag_morphological import HagMorphological, inside_block
from .grid import Box, TileGrid
from .inputs import CloudIndex, InputSource
from .pieces import Piece, cut_all
from .plan import FirstRound, TilePlan
from .store import load_arrays, save_arrays, written
from .tile import Changed, FromBefore, RunContext, run_first


def left_file(tile: str) -> str:
    """The name of the file of what the first round left of a tile."""
    return f"{tile}.first.npz"


def block_file(block: tuple[int, int]) -> str:
    """The name of the file of a block that is made of what is left."""
    return f"{block[0]}_{block[1]}.block.npz"


def stage_of(plan: TilePlan) -> HagMorphological:
    """The stage that the rounds before the tiles are for."""
    assert plan.first is not None
    given = plan.head[plan.first.at]
    options = {name: value for name, value in given.items() if name not in ("type", "tag", "inputs")}
    return HagMorphological(options)


@dataclass(frozen=True)
class FirstRoundTask:
    """A tile of the first round."""

    context: RunContext
    first: FirstRound
    tile: tuple[int, int]
    sources: list[tuple[InputSource, CloudIndex | None]]  #: inputs that may hold points of it or its halo
    target: str  #: file for what is left of its points

    def run(self) -> dict[str, Any]:
        """Write what is left of the tile's own points, and what the stages before the one that wants it changed."""
        context = self.context
        with TemporaryDirectory(prefix="first-", dir=context.scratch, ignore_cleanup_errors=True) as folder:
            halo = self.first.halo_m / context.unit
            cuts = cut_all(context.grid, self.tile, self.sources, halo, folder)
            left, arrays, messages = run_first(context, cuts, self.first) if cuts else ([], {}, [])
        left.append({"around": np.empty((0, 3))})
        for name in {name for one in left for name in one}:
            arrays[name] = np.concatenate([one[name] for one in left if name in one])
        save_arrays(self.target, arrays)
        return {"outputs": written([self.target]), "messages": messages}


@dataclass(frozen=True)
class BlockTask:
    """A block of the raster that is made once of what is left around it."""

    plan: TilePlan
    block: tuple[int, int]
    tiles: list[str]  #: files of what is left of the tiles around, as far as these were done
    target: str

    def run(self) -> dict[str, Any]:
        """Write what tiles need of the block."""
        assert self.plan.first is not None
        blocks = self.plan.first.blocks
        low_x, low_y, high_x, high_y = TileGrid(blocks.side).box(self.block, blocks.reach)
        parts = [np.empty((3, 0))]  # whose rows are taken as they are
        for path in self.tiles:
            x, y, _ = points = load_arrays(path, ["around"])["around"].T
            parts.append(points[:, (x >= low_x) & (x <= high_x) & (y >= low_y) & (y <= high_y)])
        inside = (load_arrays(path, [inside_block(self.block)]) for path in self.tiles)
        mine = (points for found in inside for points in found.values())
        block = stage_of(self.plan).block_of(np.concatenate(parts, axis=1).T, mine, self.block)
        save_arrays(self.target, block)
        return {"outputs": written([self.target])}


def blocks_around(first: FirstRound, box: Box, unit: float, around_m: float) -> list[tuple[int, int]]:
    """The blocks that a box with surroundings touches, in units of the coordinates and in meters."""
    x0, y0, x1, y1 = (side * unit for side in box)
    grid = TileGrid(first.blocks.side)
    return grid.covering((x0 - around_m, y0 - around_m, x1 + around_m, y1 + around_m))


def tiles_around(
    first: FirstRound, grid: TileGrid, unit: float, block: tuple[int, int], known: Collection[tuple[int, int]]
) -> list[tuple[int, int]]:
    """The known tiles whose points may matter for a block."""
    x0, y0, x1, y1 = (side / unit for side in TileGrid(first.blocks.side).box(block, first.blocks.reach))
    (i0, j0), (i1, j1) = grid.index(np.array([x0, y0])).tolist(), grid.index(np.array([x1, y1])).tolist()
    return [(i, j) for j in range(j0, j1 + 1) for i in range(i0, i1 + 1) if (i, j) in known]


def from_before(
    folder: str, context: RunContext, tile: tuple[int, int], read_m: float, cuts: list[Piece]
) -> FromBefore:
    """What the rounds before, which are kept in `folder`, left for a tile that is read with so many meters around it."""
    first = context.plan.first
    assert first is not None
    around = read_m + first.blocks.around + first.blocks.spill
    x0, y0, x1, y1 = (side * context.unit for side in context.grid.box(tile))
    box = (x0 - around, y0 - around, x1 + around, y1 + around)
    paths = [os.path.join(folder, block_file(block)) for block in TileGrid(first.blocks.side).covering(box)]
    stage = stage_of(context.plan)
    needed = stage.needed_of_blocks(box)
    found = (load_arrays(path, needed) for path in paths if os.path.exists(path))  # others have no points
    return FromBefore(stage.made_of_blocks(found), [_changed(context, folder, piece) for piece in cuts])


def _changed(context: RunContext, folder: str, piece: Piece) -> Changed:
    """New values of a piece's points that the stages before the far-reaching one gave: rows and values by dimension."""
    assert context.plan.first is not None
    names = context.plan.first.kept or ()
    parts = []
    for tile in sorted(piece.tiles) if names else ():
        path = os.path.join(folder, left_file(context.grid.name(tile)))
        kept = load_arrays(path, under=f"{piece.source.key}/")
        if "index" in kept:
            rows = np.searchsorted(piece.index, kept["index"])
            rows[rows == len(piece.index)] = 0
            there = piece.index[rows] == kept["index"]
            parts.append((rows[there], *(kept[name][there] for name in names)))
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    return {name: (columns[0], column) for name, column in zip(names, columns[1:], strict=False)}
