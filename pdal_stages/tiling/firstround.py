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
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..stages import registry
from ..stages.base import Stage
from .cut import Piece, cut_all
from .grid import Box, TileGrid
from .headrun import FirstResults, RunContext, run_first
from .index import CloudIndex
from .kept import load_arrays, save_arrays
from .sources import InputSource
from .store import block_file, left_file
from .tileplan import FirstRound, TilePlan


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
            cuts = cut_all(
                context.grid, self.tile, self.sources, self.first.halo_m / context.unit, folder, False
            )
            found = run_first(context, cuts, self.first) if cuts else FirstResults([], {}, [])
        arrays = {"around": np.concatenate([np.empty((0, 3)), *(one.around for one in found.left)])}
        for block in {block for one in found.left for block in one.inside}:
            parts = [one.inside[block] for one in found.left if block in one.inside]
            arrays[_inside(block)] = np.concatenate(parts)
        for key, (index, values) in found.changed.items():
            arrays[f"{key}/index"] = index
            arrays |= {f"{key}/{name}": column for name, column in values.items()}
        save_arrays(self.target, arrays, context.scratch)
        return {"result_bytes": os.path.getsize(self.target), "messages": found.messages}


@dataclass(frozen=True)
class BlockTask:
    """A block of the raster that is made once of what is left around it."""

    plan: TilePlan
    block: tuple[int, int]
    tiles: list[str]  #: files of what is left of the tiles around, as far as these were done
    target: str
    scratch: str  #: the run's folder for temporary files

    def run(self) -> dict[str, Any]:
        """Write what tiles need of the block."""
        assert self.plan.first is not None
        first, stage = self.plan.first, stage_of(self.plan)
        box = block_grid(first).box(self.block, first.blocks.reach)
        parts = [_within(box, load_arrays(path, ["around"])["around"]).T for path in self.tiles]
        around = np.concatenate([np.empty((3, 0)), *parts], axis=1)  # whose rows are taken as they are
        del parts
        inside = _inside(self.block)
        points = (load_arrays(path, [inside]).get(inside) for path in self.tiles)
        block = stage.block_of(
            around.T,
            (some for some in points if some is not None),
            self.block,
        )
        save_arrays(self.target, block, self.scratch)
        return {"result_bytes": os.path.getsize(self.target)}


def _within(box: Box, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Those of points (n, 3) that lie in a box."""
    x, y, _ = points.T
    return points[(x >= box[0]) & (x <= box[2]) & (y >= box[1]) & (y <= box[3])]


def _inside(block: tuple[int, int]) -> str:
    """The name of the array of points of a block."""
    return f"inside/{block[0]}/{block[1]}"


def stage_of(plan: TilePlan) -> Stage:
    """The stage that the rounds before the tiles are for."""
    assert plan.first is not None
    given = plan.head[plan.first.at]
    options = {name: value for name, value in given.items() if name not in ("type", "tag", "inputs")}
    stage = registry.get(given["type"])(options)
    stage.block_side = plan.first.blocks.side
    return stage


def block_grid(first: FirstRound) -> TileGrid:
    """The grid of blocks, in meters."""
    return TileGrid(first.blocks.side)


def blocks_around(first: FirstRound, box: Box, unit: float, around_m: float) -> list[tuple[int, int]]:
    """The blocks that a box with surroundings touches, in units of the coordinates and in meters."""
    x0, y0, x1, y1 = (side * unit for side in box)
    return block_grid(first).covering((x0 - around_m, y0 - around_m, x1 + around_m, y1 + around_m))


@dataclass(frozen=True)
class Before:
    """What the rounds before left for a tile."""

    folder: str
    context: RunContext
    first: FirstRound

    def from_blocks(self, tile: tuple[int, int], read_m: float) -> Any:
        """What the far-reaching stage needs around a tile that is read with so many meters of surroundings."""
        first, context = self.first, self.context
        around = read_m + first.blocks.around + first.blocks.spill
        x0, y0, x1, y1 = (side * context.unit for side in context.grid.box(tile))
        box = (x0 - around, y0 - around, x1 + around, y1 + around)
        paths = [os.path.join(self.folder, block_file(block)) for block in block_grid(first).covering(box)]
        stage = stage_of(context.plan)
        needed = stage.needed_of_blocks(box)
        found = (load_arrays(path, needed) for path in paths if os.path.exists(path))  # others have no points
        return stage.made_of_blocks(found, box)

    def changed(self, piece: Piece) -> dict[str, tuple[NDArray[np.int64], NDArray]]:
        """New values of a piece's points that the stages before the far-reaching one gave: rows and values by dimension."""
        found: dict[str, list[tuple[NDArray[np.int64], NDArray]]] = {
            name: [] for name in self.first.kept or ()
        }
        for tile in sorted(piece.tiles):
            path = os.path.join(self.folder, left_file(self.context.grid.name(tile)))
            key = piece.source.key
            kept = load_arrays(path, [f"{key}/{name}" for name in ("index", *found)])
            index = kept.get(f"{key}/index")
            if index is None:
                continue
            rows = np.searchsorted(piece.index, index)
            rows[rows == len(piece.index)] = 0
            there = piece.index[rows] == index
            for name, parts in found.items():
                parts.append((rows[there], kept[f"{key}/{name}"][there]))
        return {
            name: tuple(np.concatenate(part) for part in zip(*parts, strict=True))  # type: ignore[misc]
            for name, parts in found.items()
            if parts
        }


def blocks_of(
    first: FirstRound, grid: TileGrid, unit: float, tiles: Collection[tuple[int, int]]
) -> set[tuple[int, int]]:
    """All blocks that hold anything."""
    spill = first.blocks.spill
    return {block for tile in tiles for block in blocks_around(first, grid.box(tile), unit, spill)}


def tiles_around(
    first: FirstRound, grid: TileGrid, unit: float, block: tuple[int, int], known: Collection[tuple[int, int]]
) -> Iterator[tuple[int, int]]:
    """The known tiles whose points may matter for a block."""
    x0, y0, x1, y1 = (side / unit for side in block_grid(first).box(block, first.blocks.reach))
    low, high = np.array([x0, y0]), np.array([x1, y1])
    (i0, j0), (i1, j1) = grid.index(low).tolist(), grid.index(high).tolist()
    if (i1 - i0 + 1) * (j1 - j0 + 1) > len(known):
        yield from (t for t in known if i0 <= t[0] <= i1 and j0 <= t[1] <= j1)
        return
    for j in range(j0, j1 + 1):
        for i in range(i0, i1 + 1):
            if (i, j) in known:
                yield i, j
