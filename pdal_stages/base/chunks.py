"""The chunks of a LAZ file, and the table of them at its end: found, decoded and held against the file.

PDAL from 2.7 on waits forever for a point that no chunk of the table holds, and ends the process where the
table leads it astray. Layout: "LAZ specification 1.4", chunk table.
"""

from __future__ import annotations

import io
import os
import struct
from typing import BinaryIO, NamedTuple

from .las import LARGEST_RECORD, LasHeader, records

#: More chunks than this (ten billion points in chunks of the usual size) are not decoded one by one.
MOST_DECODED = 200_000
#: Points of a chunk; 50,000 are usual.
_LARGEST = 2**24
#: Numbers of the table have 32 bits; lazrs takes the upper half of them for negative ones.
_TOP = 2**32


def what_is_wrong(
    table: bytes, room: int, *, points: int, point_bytes: int, chunk_points: int | None
) -> tuple[str, str] | None:
    """Why a chunk table cannot be right: (what, found); None where it can.

    Parameters
    ----------
    table : bytes
        The file from the table on.
    room : int
        Bytes between the place of the first chunk and the table.
    points, point_bytes : int
        As the file's header has them.
    chunk_points : int or None
        Points of every chunk but the last; None where the table tells for each.
    """
    if len(table) < 8:
        return "it is cut short", f"{len(table)} bytes of its table of chunks"
    version, count = struct.unpack_from("<II", table)
    if version:
        return "its table of chunks is of an unknown version", str(version)
    if chunk_points is not None and chunk_points > _LARGEST:  # for which lazrs takes memory at once
        return "its chunks are larger than any program makes them", f"{chunk_points:,} points"
    if count * point_bytes > room:  # a chunk begins with a whole point
        return "it has more chunks than there is room for", f"{count:,} chunks in {room:,} bytes"
    if count > MOST_DECODED:
        return None
    try:
        sizes, counts = decode(table, variable=chunk_points is None)
    except EOFError:
        return "it is cut short", f"its table of {count:,} chunks does not end"
    if sum(sizes) != room:
        return "its chunks do not fill the file", f"{sum(sizes):,} bytes in chunks, {room:,} bytes there"
    held = count * chunk_points if chunk_points is not None else sum(counts)
    if held < points:
        return "it has fewer points than its header counts", f"at most {held:,} of {points:,}"
    if chunk_points is None and held > points:
        return "its chunks hold more points than its header counts", f"{held:,}, not {points:,}"
    return None


def decode(table: bytes, *, variable: bool) -> tuple[list[int], list[int]]:
    """Bytes of each chunk, and its points where they vary.

    Raises
    ------
    EOFError
        If the data end before the table does.
    """
    import lazrs

    if any(table[4:8]) and table[8:12] == b"\xff" * 4:  # which no encoder writes, and where lazrs panics
        raise EOFError
    try:
        coding = lazrs.LazVlr.new_for_compression(0, 0, variable)
        entries = lazrs.read_chunk_table_only(io.BytesIO(table), coding)
    except lazrs.LazrsError:
        raise EOFError from None
    counts = [points % _TOP for points, _ in entries] if variable else []
    return [size % _TOP for _, size in entries], counts


def table_place(path: str | os.PathLike, size: int, header: LasHeader) -> int:
    """Where a LAZ file's table of chunks is, which is written last; -1 where that is not in the file."""
    with open(path, "rb") as file:
        file.seek(header.offset)
        place = file.read(8)
        if len(place) == 8 and place == b"\xff" * 8:  # a stream that could not be rewound has it at its end
            file.seek(size - 8)
            place = file.read(8)
    return struct.unpack("<q", place)[0] if len(place) == 8 else -1


def coding_of(file: BinaryIO, header: LasHeader) -> bytes | None:
    """The record of how a LAZ file is compressed, None where it lacks one."""
    for record in records(file, header):
        if (record.user, record.number) == (b"laszip encoded", 22204):
            file.seek(record.data)
            data = file.read(min(record.length, LARGEST_RECORD))
            return data if len(data) >= 16 else None
    return None


def points_of_chunk(coding: bytes) -> int | None:
    """Points of every chunk but the last; None where the table tells for each."""
    (points,) = struct.unpack_from("<I", coding, 12)
    return None if points in (0, 2**32 - 1) else points


def table_at(file: BinaryIO, place: int) -> tuple[int, bytes]:
    """Number of chunks, and the file from their table on: as much as the table of so many can take."""
    file.seek(place)
    begin = file.read(8)
    number = struct.unpack("<4xI", begin)[0] if len(begin) == 8 else 0
    # A number takes less than eight bytes, and a chunk has two at most.
    return number, begin + file.read(56 + 16 * min(MOST_DECODED, number))


class LazChunks(NamedTuple):
    """The chunks of a LAZ file: the record of their coding, where the first begins, bytes and points of each."""

    record: bytes
    begin: int
    sizes: list[int]
    points: list[int]


def laz_chunks(path: str | os.PathLike, header: LasHeader) -> LazChunks | None:
    """The chunks of a LAZ file that `check_readable` takes; None where they are too many to be listed."""
    table = table_place(path, os.stat(path).st_size, header)
    with open(path, "rb") as file:
        coding = coding_of(file, header)
        number, data = table_at(file, table)
    if coding is None or number > MOST_DECODED:
        return None
    of_chunk = points_of_chunk(coding)
    sizes, points = decode(data, variable=of_chunk is None)
    if of_chunk is not None:
        points = [max(0, min(of_chunk, header.count - done * of_chunk)) for done in range(number)]
    return LazChunks(coding, header.offset + 8, sizes, points)
