"""Cut points out of LAS and LAZ files, byte for byte, with the file's own header."""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base import las
from ..base.errors import StageError
from .cloudindex import BLOCK, CloudIndex, open_las, read_block
from .grid import TileGrid, touching

_COMPRESSOR = b"laszip encoded"


@dataclass
class Piece:
    """Points of one file, in that file's order, as an uncompressed LAS file."""

    path: str
    core: str  #: another file, with the tile's own points alone; empty where none was asked for
    index: NDArray[np.int64]  #: (n,) number of each point in the input file
    #: (n,) how far it lies outside the tile, in the unit of the coordinates; -1 inside
    away: NDArray[np.float64]

    @cached_property
    def own(self) -> NDArray[np.int64]:
        """Rows of the tile's own points."""
        return np.flatnonzero(self.away < 0)


def plain_header(path: str) -> tuple[bytearray, bytes]:
    """All before the points of a file as an uncompressed one has them, and its extended records.

    Counts are left as they are; :func:`finish` sets them.
    """
    header = las.read_header(path)
    assert header is not None
    with open(path, "rb") as file:
        head = bytearray(file.read(header.offset))
        coding = [r for r in las.records(file, header) if r.user == _COMPRESSOR and not r.after]
        file.seek(header.after)
        tail = file.read() if header.records_after else b""
    for record in reversed(coding):
        del head[record.place : record.data + record.length]
    head[104] &= 0x3F
    struct.pack_into("<II", head, 96, len(head), header.records - len(coding))
    return head, tail


def finish(file: Any, head: bytearray, tail: bytes, count: int) -> None:
    """Write extended records after `count` points, and the header with the right counts."""
    version = head[25]
    (width,) = struct.unpack_from("<H", head, 105)
    (start,) = struct.unpack_from("<I", head, 96)
    if version >= 4:
        struct.pack_into("<I", head, 107, count if head[104] < 6 and count < 2**32 else 0)
        struct.pack_into("<Q", head, 247, count)
        if tail:
            struct.pack_into("<Q", head, 235, start + count * width)
    else:
        struct.pack_into("<I", head, 107, count)
    file.write(tail)
    file.seek(0)
    file.write(head)


def cut(
    path: str,
    index: CloudIndex,
    grid: TileGrid,
    tile: tuple[int, int],
    halo: float,
    target: str,
    core: str = "",
) -> Piece | None:
    """Cut a tile and its surroundings out of a LAS or LAZ file; None where the file has no point there.

    `halo` is in the unit of the coordinates. A LAS file `target` is written, and a second one, `core`, for the tile's
    own points alone, where it is given.
    """
    box = grid.box(tile, halo)
    blocks = touching(index.boxes, box)
    if not blocks:
        return None
    rows_cut: list[NDArray[np.int64]] = []
    aways: list[NDArray[np.float64]] = []
    cores = 0
    head, tail = plain_header(path)
    try:
        with open_las(path) as reader, open(target, "wb") as out, open(core or os.devnull, "wb") as core_out:
            out.write(head)
            core_out.write(head)
            for block in blocks:
                start = block * BLOCK
                points = read_block(reader, path, start, index.count)
                x, y = np.asarray(points.x), np.asarray(points.y)
                rows = np.flatnonzero((x >= box[0]) & (x <= box[2]) & (y >= box[1]) & (y <= box[3]))
                if not rows.size:
                    continue
                away = outside(x[rows], y[rows], grid, tile)
                raw = points.array[rows]
                if raw.dtype.itemsize != struct.unpack_from("<H", head, 105)[0]:
                    raise StageError("the points have another length than the header says", where=path)
                out.write(raw.tobytes())
                if core:
                    mine = away < 0
                    core_out.write(raw[mine].tobytes())
                    cores += int(np.count_nonzero(mine))
                rows_cut.append(rows + start)
                aways.append(away)
            found = sum(map(len, rows_cut))
            finish(out, bytearray(head), tail, found)
            if core:
                finish(core_out, bytearray(head), tail, cores)
    except OSError as error:
        raise StageError("a tile could not be cut out", where=path, found=error) from error
    if not rows_cut:
        os.unlink(target)
        if core:
            os.unlink(core)
        return None
    return Piece(target, core, np.concatenate(rows_cut), np.concatenate(aways))


def outside(x: NDArray, y: NDArray, grid: TileGrid, tile: tuple[int, int]) -> NDArray[np.float64]:
    """Distance of points from a tile along the farther axis; -1 for its own points."""
    x0, y0, x1, y1 = grid.box(tile)
    away = np.maximum(np.maximum(x0 - x, x - x1), np.maximum(y0 - y, y - y1))
    mine = (grid.index(x) == tile[0]) & (grid.index(y) == tile[1])
    return np.where(mine, -1.0, np.maximum(away, 0.0))
