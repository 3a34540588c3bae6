"""Cut points out of LAS and LAZ files, byte for byte, with the file's own header."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base import las
from ..base.errors import StageError
from .byplace import points_in
from .cloudindex import SMALL, CloudIndex, counted
from .ept import fetch
from .grid import Box, TileGrid, touching
from .lasfiles import (
    BLOCK,
    Located,
    all_points,
    finish,
    likeness,
    open_las,
    plain_header,
    read_block,
    read_small,
    scaled,
)
from .sources import InputSource

#: Points of a piece that its file holds while the others are held in memory.
SAMPLE = 64


@dataclass(frozen=True)
class Member:
    """An input of which a part is cut out."""

    source: InputSource
    path: str  #: the file that holds its points: its own, or what was fetched of it
    index: CloudIndex


@dataclass
class Piece:
    """Points of one file, or of several that are alike, in their order, as an uncompressed LAS file."""

    path: str
    core: str  #: another file, with the tile's own points alone; empty where none was asked for
    index: NDArray[np.int64]  #: (n,) number of each point in its input file
    #: (n,) how far it lies outside the tile, in the unit of the coordinates; -1 inside
    away: NDArray[np.float64]
    spans: list[tuple[InputSource, int, int]]  #: whose points are the rows from one number to another
    tiles: set[tuple[int, int]]  #: that its points belong to
    #: Its points as the file has them, where `path` holds a few of them alone, until :meth:`write`.
    records: NDArray | None = None
    like: bytes = b""  #: what is the same in files that are read alike, see :func:`likeness`

    def write(self) -> None:
        """Write all points into the file at `path`."""
        if self.records is None:
            return
        head, tail = plain_header(self.path)
        with open(self.path, "wb") as out:
            out.write(head)
            out.write(self.records.tobytes())
            finish(out, head, tail, len(self.records))
        self.records = None

    @cached_property
    def own(self) -> NDArray[np.int64]:
        """Rows of the tile's own points."""
        return np.flatnonzero(self.away < 0)

    @property
    def reader(self) -> dict[str, Any]:
        """The reader of its inputs, without a file's name."""
        return {**self.spans[0][0].reader, "type": "readers.las"}


def cut_all(
    grid: TileGrid,
    tile: tuple[int, int],
    sources: Sequence[tuple[InputSource, CloudIndex | None]],
    halo_units: float,
    folder: str,
    cores: bool,
    hold: bool = False,
) -> list[Piece]:
    """A tile's points and their surroundings, out of every input; inputs that are alike are read as one.

    `halo_units` is in the unit of the coordinates; `cores`: the tile's own points come in files of their own, too.
    `hold`: see :func:`cut`.
    """
    box = grid.box(tile, halo_units)
    alike: dict[tuple[bytes, str], list[Member]] = {}
    for number, (source, index) in enumerate(sources):
        path = source.path
        if source.kind == "ept":
            path = os.path.join(folder, f"fetched{number}.las")
            index = fetch(source, grid, tile, halo_units, path)
        if index is None or not touching(index.boxes, box):
            continue
        reader = json.dumps(source.reader, sort_keys=True)
        alike.setdefault((likeness(path), reader), []).append(Member(source, path, index))
    pieces = []
    for number, ((like, _), members) in enumerate(alike.items()):
        core = os.path.join(folder, f"core{number}.las") if cores else ""
        target = os.path.join(folder, f"piece{number}.las")
        piece = cut(members, grid, tile, halo_units, target, core, hold)
        if piece is not None:
            piece.like = like
            pieces.append(piece)
    return pieces


def cut(
    members: Sequence[Member],
    grid: TileGrid,
    tile: tuple[int, int],
    halo_units: float,
    target: str,
    core: str = "",
    hold: bool = False,
) -> Piece | None:
    """Cut a tile and its halo out of files that are alike (:func:`likeness`); None where they have no point there.

    `halo_units` is in the unit of the coordinates. A LAS file `target` is written, and a second one, `core`, for the tile's
    own points alone, where it is given. With `hold` points stay in memory, and the file has :data:`SAMPLE` of them at most.
    """
    box = grid.box(tile, halo_units)
    rows_cut: list[NDArray[np.int64]] = []
    aways: list[NDArray[np.float64]] = []
    spans: list[tuple[InputSource, int, int]] = []
    tiles: set[tuple[int, int]] = set()
    held: list[NDArray] = []
    cores = found = 0
    head, tail = plain_header(members[0].path)
    (width,) = struct.unpack_from("<H", head, 105)
    try:
        with open(target, "wb") as out, open(core or os.devnull, "wb") as core_out:
            out.write(head)
            core_out.write(head)
            for member in members:
                first = found
                for numbers, points in _blocks(member, box):
                    x, y = points.x, points.y
                    rows = np.flatnonzero((x >= box[0]) & (x <= box[2]) & (y >= box[1]) & (y <= box[3]))
                    if not rows.size:
                        continue
                    away, others = outside(x[rows], y[rows], grid, tile)
                    tiles |= others
                    raw = points.array if len(rows) == len(x) else np.take(points.array, rows)
                    if raw.dtype.itemsize != width:
                        raise StageError(
                            "the points have another length than the header says", where=member.path
                        )
                    if hold:
                        held.append(raw)
                    else:
                        out.write(raw.tobytes())
                    if core:
                        mine = away < 0
                        core_out.write(raw[mine].tobytes())
                        cores += int(np.count_nonzero(mine))
                    rows_cut.append(numbers[rows])
                    aways.append(away)
                    found += len(rows)
                if found > first:
                    spans.append((member.source, first, found))
            records = np.concatenate(held) if held else None
            held.clear()
            if records is not None:
                out.write(sampled(records).tobytes())
            finish(out, bytearray(head), tail, found if records is None else min(found, SAMPLE))
            if core:
                finish(core_out, bytearray(head), tail, cores)
    except OSError as error:
        raise StageError("a tile could not be cut out", where=members[0].path, found=error) from error
    if not rows_cut:
        os.unlink(target)
        if core:
            os.unlink(core)
        return None
    return Piece(target, core, np.concatenate(rows_cut), np.concatenate(aways), spans, tiles, records)


def sampled(records: NDArray) -> NDArray:
    """:data:`SAMPLE` of the records at most, spread over all."""
    return records[np.linspace(0, len(records) - 1, min(len(records), SAMPLE)).astype(np.int64)]


def unpacked(path: str, copy: str, count: int, target: str) -> bool:
    """Write a LAZ file's points uncompressed, out of its copy by place; whether there is a whole one, and it is worth it.

    Everything else in the file is the same. PDAL takes four times as long to read points that are compressed.
    """
    header = las.read_header(path)
    if header is None or not header.compressed or not copy:
        return False
    everywhere = (-np.inf, -np.inf, np.inf, np.inf)
    found = 0
    try:
        points = points_in(copy, count, everywhere)
        if points is None:
            return False
        head, tail = plain_header(path)
        with open(target, "wb") as out:
            out.write(head)
            for numbers, records in points:  # parts follow each other as in the file
                if records.dtype.itemsize != header.point_bytes or numbers[0] != found:
                    return False
                out.write(records.tobytes())
                found += len(records)
            finish(out, head, tail, found)
    except (OSError, ValueError):
        return False
    return found == count


def records_of(path: str, copy: str, count: int) -> NDArray[np.uint8] | None:
    """All points of a file, (n, bytes) as it holds them, out of memory or its copy where it is there.

    None where it does not hold `count` of them.
    """
    header = las.read_header(path)
    if header is None or header.count != count or not count:
        return None
    status = os.stat(path)
    parts: list[NDArray] | None = None
    if count <= SMALL:
        parts = [_small(path, count, status.st_mtime_ns, status.st_size).array]
    elif copy and (copied := points_in(copy, count, (-np.inf, -np.inf, np.inf, np.inf))) is not None:
        parts = [records for _, records in copied]
    if parts is None:
        parts = [points.array for points in all_points(path)]
    if sum(map(len, parts)) != count:
        return None
    return np.concatenate([np.ascontiguousarray(part)[:, None].view(np.uint8) for part in parts])


def _blocks(member: Member, box: Box) -> Iterator[tuple[NDArray[np.int64], Located]]:
    """Numbers, ascending, and points of a file, in parts: all that may lie in a box."""
    blocks = touching(member.index.boxes, box)
    if not blocks:
        return
    if member.index.count <= SMALL:
        status = os.stat(member.path)
        points = _small(member.path, member.index.count, status.st_mtime_ns, status.st_size)
        yield np.arange(len(points.x)), points
        return
    copied = points_in(member.index.copy, member.index.count, box) if member.index.copy else None
    if copied is not None:
        yield from _scaled(member.path, copied)
        return
    with open_las(member.path) as reader:
        for block in blocks:
            start = block * BLOCK
            points = read_block(reader, member.path, start, member.index.count)
            numbers = np.arange(start, start + len(points))
            yield numbers, Located(points.array, np.asarray(points.x), np.asarray(points.y))


def _scaled(
    path: str, copied: Iterator[tuple[NDArray[np.int64], NDArray]]
) -> Iterator[tuple[NDArray[np.int64], Located]]:
    """Records of a file's copy, with coordinates as they are read from the file itself."""
    for numbers, records in copied:
        yield numbers, scaled(path, records)


@lru_cache(maxsize=2048)
def _small(path: str, count: int, changed: int, size: int) -> Located:
    """All points of a small file, which tiles side by side read again and again."""
    points = read_small(path, count)
    if points is not None:
        return points
    with open_las(path) as reader:  # which says what is wrong
        read = read_block(reader, path, 0, count)
        return Located(read.array, np.array(read.x), np.array(read.y))


def outside(
    x: NDArray, y: NDArray, grid: TileGrid, tile: tuple[int, int]
) -> tuple[NDArray[np.float64], set[tuple[int, int]]]:
    """Distance of points from a tile along the farther axis, -1 for its own points; and all tiles they belong to."""
    only = grid.only(x, y)
    if only == tile:
        return np.full(len(x), -1.0), {tile}
    x0, y0, x1, y1 = grid.box(tile)
    away = np.maximum(np.maximum(x0 - x, x - x1), np.maximum(y0 - y, y - y1))
    if only is not None:
        return np.maximum(away, 0.0), {only}
    column, row = grid.index(x), grid.index(y)
    mine = (column == tile[0]) & (row == tile[1])
    tiles = {(int(i), int(j)) for i, j, _ in counted(column, row)}
    return np.where(mine, -1.0, np.maximum(away, 0.0)), tiles
