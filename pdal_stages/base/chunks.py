"""The table of chunks at the end of a LAZ file, decoded and held against the file.

PDAL from 2.7 on waits forever for a point that no chunk of the table holds, and ends the process where the
table leads it astray. Layout: "LAZ specification 1.4", chunk table.
"""

from __future__ import annotations

import io
import struct

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
