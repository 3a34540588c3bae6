"""LAS and LAZ files checked against their headers, before PDAL reads one and after it wrote one.

PDAL reads a truncated file as if it were whole, with made-up points; some damaged headers and chunk tables crash it or
make it hang. Its writers do not notice a full disk.
"""

from __future__ import annotations

import io
import math
import os
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

from .errors import StageError
from .extra_bytes import description, fields_of
from .files import disk_is_full
from .las import (
    POINT_BYTES,
    POINTWISE,
    WAVES,
    LasHeader,
    laszip_record,
    read_header,
    records,
)

#: What to do about a damaged file.
DAMAGED = "Get the file again from its source, or repair it with a tool made for that (e.g. lasinfo -repair)"
#: Steps of the coordinates by which points may lie outside the bounding box: programs round it differently.
_BOX_STEPS = 100
#: Smaller scales and larger offsets come from a header that was only partly written.
_SMALLEST, _LARGEST = 1e-30, 1e15
#: The least size of a header in bytes, by minor version.
_HEADER_BYTES = (227, 227, 227, 235, 375, 375)
#: More chunks than this (ten billion points in chunks of the usual size) are not decoded one by one.
_MOST_CHUNKS = 200_000
#: Most points of a chunk, since lazrs allocates memory for all of them; 50,000 are usual.
_LARGEST_CHUNK = 2**24

#: Points that are decoded at a time.
_DECODED = 50_000

#: What is wrong, and what was found.
Wrong = tuple[str, str]


def check_readable(path: str | os.PathLike) -> str | None:
    """Refuse a LAS or LAZ file whose header cannot be right; return a warning where it is only unusual.

    Raises
    ------
    StageError
        If the file is damaged or cannot be opened, where PDAL says little or crashes; or if no PDAL reads its point
        format.
    """
    where = str(path)
    try:
        size, header = Path(path).stat().st_size, read_header(path)
        if header is None:
            found = f"{size:,} bytes without a LAS header"
            raise StageError("not a LAS file", where=where, found=found, cure=DAMAGED)
        with open(path, "rb") as file:
            wrong = _wrong_header(header, size) or _wrong_records(file, header, size)
            wrong = wrong or (_wrong_chunks if header.compressed else _wrong_count)(
                file, header, size
            )
        fields = [] if wrong else fields_of(header, description(path))[0]
    except OSError as error:
        raise StageError("the file cannot be read", where=where, found=error) from None
    except StageError as error:
        raise error.at(where) from None
    if wrong:
        raise StageError(
            f"the LAS file is damaged: {wrong[0]}", where=where, found=wrong[1], cure=DAMAGED
        )
    if without := WAVES.get(header.point_format):
        raise StageError(
            "PDAL does not read points with waveforms",
            where=where,
            found=f"point format {header.point_format}",
            cure=f"Convert the file to format {without}, which has everything but the waveforms: "
            f"laspy.convert(laspy.read(IN), point_format_id={without}).write(OUT)",
        )
    beyond = _end_of_points(header, size) - header.offset - header.count * header.point_bytes
    if not header.compressed and beyond >= header.point_bytes:
        return (
            f"{path}: the file holds {beyond:,} bytes beyond the {header.count:,} points that its header counts; "
            "they are not read"
        )
    if header.count > 1 and not header.boxed:
        return (
            f"{path}: the bounding box in its header is all zeros, as when a program was stopped while writing it; check "
            "that the points lie where they should"
        )
    if clashing := [f"{one.title} as {one.name}" for one in fields if one.clashes]:
        return (
            f"{path}: extra bytes named like other dimensions are read and written under other names: "
            + ", ".join(clashing)
        )
    return None


def beyond_box(path: str | os.PathLike, lie: tuple[float, float, float, float]) -> str | None:
    """A warning where the extent `lie` of a file's points exceeds the bounding box in its header; None where it does not.

    LAZ has no checksums: a damaged file may decode to points anywhere, without an error.
    """
    header = read_header(path)
    if header is None or not header.count or not header.boxed:
        return None
    room = [_BOX_STEPS * scale for scale in header.scales[:2]] * 2
    over = (
        header.box[0] - lie[0],
        header.box[1] - lie[1],
        lie[2] - header.box[2],
        lie[3] - header.box[3],
    )
    if all(far <= most for far, most in zip(over, room, strict=True)):
        return None
    say = "x {0:.12g} to {2:.12g}, y {1:.12g} to {3:.12g}"
    return (
        f"{path}: points lie outside the bounding box in the header, so the file may be damaged (found {say.format(*lie)}; "
        f"the header says {say.format(*header.box)}). {DAMAGED}"
    )


def check_complete(
    path: str | os.PathLike,
    name: str | os.PathLike,
    writer: Mapping[str, Any],
    count: int | None = None,
) -> None:
    """Refuse a file that was not written completely.

    LAS and LAZ files are checked against their headers and the number of points; for other formats, only whether
    disk and limits left room.

    Parameters
    ----------
    path : path
        The file as it was written.
    name : path
        Its final name, for the message.
    writer : mapping
        The stage that wrote it.
    count : int, optional
        The number of points it must hold, where known.

    Raises
    ------
    StageError
        If it is incomplete.
    """
    path = Path(path)
    las = writer["type"] in ("writers.las", "writers.copc")
    try:
        size = path.stat().st_size
        with open(path, "rb+") as file:
            os.fsync(file.fileno())  # some file systems report a full disk only here
        whole = _is_whole(path, count) if las else not disk_is_full(path) and size < _largest_file()
    except OSError as error:
        raise StageError("the output file cannot be read back", found=f"{name}: {error}") from error
    if not whole:
        raise StageError(
            "the output file could not be written completely",
            found=f"{name}: {size:,} bytes were written",
            cure="Make room on the disk (or raise the limit on file sizes)",
        )


def _is_whole(path: Path, count: int | None) -> bool:
    try:
        check_readable(path)
    except StageError:
        return False
    header = read_header(path)
    return header is not None and count in (None, header.count)


def _largest_file() -> float:
    """The limit on the size of this process's files, in bytes."""
    try:
        import resource
    except ImportError:  # Windows
        return math.inf
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
    return math.inf if limit == resource.RLIM_INFINITY else limit


def _end_of_points(header: LasHeader, size: int) -> int:
    """The end of the point data: the offset of what follows, or the size of the file."""
    after = [header.after] * bool(header.records_after) + [header.waveforms] * bool(
        header.waveforms
    )
    return min([size, *(place for place in after if place >= header.offset)])


def _wrong_header(header: LasHeader, size: int) -> Wrong | None:
    """What is wrong with the header itself."""
    least = POINT_BYTES[header.point_format] if header.point_format < len(POINT_BYTES) else 0
    if header.minor > 5:
        return "its version is not known", f"LAS 1.{header.minor}"
    if not least:
        return "its point format is not known", f"point format {header.point_format}"
    if header.point_bytes < least:
        found = f"{header.point_bytes} bytes, format {header.point_format} has {least}"
        return "its points are shorter than their format", found
    if header.header_bytes < _HEADER_BYTES[header.minor]:
        found = (
            f"{header.header_bytes} bytes, LAS 1.{header.minor} has {_HEADER_BYTES[header.minor]}"
        )
        return "its header is too short", found
    if header.header_bytes > min(header.offset, size):
        found = f"header of {header.header_bytes} bytes, points at {header.offset}"
        return "its points begin inside the header", found
    if header.records * 54 > header.offset - header.header_bytes:
        return (
            "it counts more records than there is room for",
            f"{header.records:,} records before the points",
        )
    scaled = all(_SMALLEST <= abs(value) < math.inf for value in header.scales)
    if not scaled or not all(abs(value) <= _LARGEST for value in header.offsets):
        found = f"scales {header.scales}, offsets {header.offsets}"
        return "its scales or offsets are not valid numbers", found
    if header.count and header.offset > size:
        return "it is cut short", f"{size:,} bytes, points begin at {header.offset:,}"
    return None


def _wrong_records(file: BinaryIO, header: LasHeader, size: int) -> Wrong | None:
    """What is wrong with the records after the points."""
    points = 0 if header.compressed else header.count * header.point_bytes
    if not header.records_after or header.offset + points > size:
        return None
    if not header.offset + points <= header.after <= size - 60 * header.records_after:
        found = f"{header.records_after:,} records at {header.after:,}, a file of {size:,} bytes"
        return "the records after its points are not where it says", found
    held = sum(r.after and r.data + r.length <= size for r in records(file, header))
    if held < header.records_after:
        found = f"{held:,} of {header.records_after:,} do"
        return "the records after its points do not end within the file", found
    return None


def _wrong_count(file: BinaryIO, header: LasHeader, size: int) -> Wrong | None:
    """What is wrong with the number of uncompressed points."""
    held = max(0, _end_of_points(header, size) - header.offset) // header.point_bytes
    if held < header.count:
        return "it is cut short", f"{held:,} whole points, its header counts {header.count:,}"
    return _none_counted(held * header.point_bytes) if held and not header.count else None


def _none_counted(size: int) -> Wrong:
    what = "its header counts no points, but the file holds some, as when a program was stopped before it finished"
    return what, f"{size:,} bytes where points are"


def _wrong_chunks(file: BinaryIO, header: LasHeader, size: int) -> Wrong | None:
    """What is wrong with the chunks of a LAZ file and their table, which is written last.

    Layout: "LAZ specification 1.4", chunk table.
    """
    coding = laszip_record(file, header)
    if header.count and coding.startswith(POINTWISE):
        return _wrong_stream(file, header, coding)
    file.seek(header.offset)
    place = file.read(8)
    if place == b"\xff" * 8:  # a stream that could not be rewound has it at its end
        file.seek(size - 8)
        place = file.read(8)
    table, begin = int.from_bytes(place, "little", signed=True), header.offset + 8
    inside = len(place) == 8 and begin <= table <= size - 8
    if not header.count:
        end = (
            table - 8 if inside else _end_of_points(header, size)
        )  # an empty file may have 8 bytes
        return _none_counted(end - begin) if end > begin else None
    if not inside:
        return "it is cut short", f"{size:,} bytes, its table of chunks should be at {table:,}"
    if len(coding) < 16:
        return "it has no record of how it is compressed", "no 'laszip encoded' among its records"
    (of_chunk,) = struct.unpack_from("<I", coding, 12)
    file.seek(table)
    head = file.read(8)
    version, number = struct.unpack("<II", head)
    if version:
        return "its table of chunks is of an unknown version", str(version)
    varies = of_chunk in (0, 2**32 - 1)
    if not varies and of_chunk > _LARGEST_CHUNK:
        return "its chunks are larger than any program makes them", f"{of_chunk:,} points"
    room = table - begin
    if number * header.point_bytes > room:  # a chunk begins with a whole point
        return "it has more chunks than there is room for", f"{number:,} chunks in {room:,} bytes"
    if number > _MOST_CHUNKS:
        return None
    try:
        sizes, counts = _decoded(head + file.read(56 + 16 * number), varies)
    except EOFError:
        return "it is cut short", f"its table of {number:,} chunks does not end"
    if sum(sizes) != room:
        return (
            "its chunks do not fill the file",
            f"{sum(sizes):,} bytes in chunks, {room:,} bytes there",
        )
    held = sum(counts) if varies else number * of_chunk
    if (
        not varies and header.point_format >= 6 and number
    ):  # whose chunks begin with a point and their count
        file.seek(table - sizes[-1] + header.point_bytes)
        held += int.from_bytes(file.read(4), "little") - of_chunk
    exact = varies or header.point_format >= 6
    if held < header.count or (exact and held > header.count):
        return (
            "its header counts a different number of points than it holds",
            f"{header.count:,} counted, {held:,} held",
        )
    return None


def _wrong_stream(file: BinaryIO, header: LasHeader, coding: bytes) -> Wrong | None:
    """Return what is wrong with points that are compressed one by one: without a table, only decoding them tells."""
    import lazrs

    file.seek(header.offset)
    left, buffer = header.count, bytearray(_DECODED * header.point_bytes)
    try:
        stream = lazrs.LasZipDecompressor(file, coding)
        while left:
            number = min(left, _DECODED)
            stream.decompress_many(memoryview(buffer)[: number * header.point_bytes])
            left -= number
    except (lazrs.LazrsError, OSError) as error:
        return "it is cut short, or its points cannot be decoded", str(error)
    return None


def _decoded(table: bytes, varies: bool) -> tuple[list[int], list[int]]:
    """The bytes of each chunk, and its points where they vary; EOFError where the table is truncated."""
    import lazrs

    if (
        any(table[4:8]) and table[8:12] == b"\xff" * 4
    ):  # which no encoder writes, and where lazrs panics
        raise EOFError
    try:
        coding = lazrs.LazVlr.new_for_compression(0, 0, varies)
        entries = lazrs.read_chunk_table_only(io.BytesIO(table), coding)
    except lazrs.LazrsError:
        raise EOFError from None
    # The numbers have 32 bits; lazrs takes the upper half of them for negative ones.
    return [size % 2**32 for _, size in entries], [
        points % 2**32 for points, _ in entries
    ] if varies else []
