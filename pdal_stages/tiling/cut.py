"""A tile's points and their surroundings, cut out of each input into a LAS file of their own that PDAL reads."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .ept import fetch
from .grid import TileGrid
from .index import CloudIndex, coordinates, points_near
from .lasfiles import header_of, record_blocks, write_records
from .sources import InputSource


@dataclass
class Piece:
    """Points of one input, in their order, as an uncompressed LAS file."""

    source: InputSource
    path: str
    core: str  #: another file, with the tile's own points alone; empty where none was asked for
    index: NDArray[np.int64]  #: (n,) number of each point in its input file
    #: (n,) how far it lies outside the tile, in the unit of the coordinates; -1 inside
    away: NDArray[np.float64]
    tiles: set[tuple[int, int]]  #: that its points belong to

    @cached_property
    def own(self) -> NDArray[np.int64]:
        """Rows of the tile's own points."""
        return np.flatnonzero(self.away < 0)

    @property
    def reader(self) -> dict[str, Any]:
        """The reader of its input, without a file's name."""
        return {**self.source.reader, "type": "readers.las"}


def cut_all(
    grid: TileGrid,
    tile: tuple[int, int],
    sources: Sequence[tuple[InputSource, CloudIndex | None]],
    halo_units: float,
    folder: str,
    cores: bool,
) -> list[Piece]:
    """A tile's points and their surroundings, out of every input that has any there.

    `halo_units` is in the unit of the coordinates; `cores`: the tile's own points come in files of their own, too.
    """
    box = grid.box(tile, halo_units)
    pieces = []
    for number, (source, index) in enumerate(sources):
        path = source.path
        if source.kind == "ept":
            path = os.path.join(folder, f"fetched{number}.las")
            if not fetch(source, box, path):
                continue
            records = np.concatenate(list(record_blocks(path)))
            numbers = np.arange(len(records))
        elif index is not None:
            numbers, records = points_near(path, index, grid, box)
        else:
            continue
        if not len(records):
            continue
        header = header_of(path)
        x, y = coordinates(records, header)
        away, tiles = outside(x, y, grid, tile)
        target = os.path.join(folder, f"piece{number}.las")
        write_records(target, header, [records])
        core = ""
        if cores:
            core = os.path.join(folder, f"core{number}.las")
            write_records(core, header, [records[away < 0]])
        pieces.append(Piece(source, target, core, numbers, away, tiles))
    return pieces


def outside(
    x: NDArray, y: NDArray, grid: TileGrid, tile: tuple[int, int]
) -> tuple[NDArray[np.float64], set[tuple[int, int]]]:
    """Distance of points from a tile along the farther axis, -1 for its own points; and all tiles they belong to."""
    x0, y0, x1, y1 = grid.box(tile)
    away = np.maximum(np.maximum(x0 - x, x - x1), np.maximum(y0 - y, y - y1))
    column, row = grid.index(x), grid.index(y)
    mine = (column == tile[0]) & (row == tile[1])
    left, bottom = int(column.min()), int(row.min())
    across = int(column.max()) - left + 1
    there = np.flatnonzero(np.bincount((row - bottom) * across + (column - left)))  # few: all lie in one box
    tiles = {(left + int(n) % across, bottom + int(n) // across) for n in there}
    return np.where(mine, -1.0, np.maximum(away, 0.0)), tiles
