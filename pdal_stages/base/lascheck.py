"""LAS and LAZ files held against what their headers say, before PDAL reads one and after it wrote one.

PDAL reads a file that is cut short as if it were whole, giving points made of nothing, and some damaged headers
end the process.
"""

from __future__ import annotations

import math
import os
import struct
from pathlib import Path
from typing import BinaryIO

from . import chunks
from .errors import StageError
from .las import POINT_BYTES, WAVES, LasHeader, read_header, records

#: What to do about a damaged file.
DAMAGED = "Get the file again from its source, or repair it with a tool made for that (e.g. lasinfo -repair)"

#: Steps of the coordinates that points may lie beyond the box: programs round it differently.
_BOX_STEPS = 100


def check_readable(path: str | os.PathLike) -> str | None:
    """Refuse a LAS or LAZ file whose header cannot be right; a warning where it only looks odd.

    Raises
    ------
    StageError
        What is wrong with the file, or why it cannot be opened: PDAL says little then, or crashes. Or that no PDAL reads
        its point format.
    """
    try:
        size = Path(path).stat().st_size
        header = read_header(path)
        table = chunks.table_place(path, size, header) if header is not None and header.compressed else 0
        wrong = None if header is None else _what_is_wrong(header, size, table)
        if header is not None and header.records_after and not wrong:
            wrong = _wrong_records(path, header, size)
        if header is not None and header.compressed and header.count and not wrong:
            wrong = _wrong_chunks(path, header, table)
    except OSError as error:
        raise StageError("the file cannot be read", where=str(path), found=error) from None
    if header is None:
        raise StageError(
            "not a LAS file", where=str(path), found=f"{size:,} bytes without a LAS header", cure=DAMAGED
        )
    if wrong:
        raise StageError(
            f"the LAS file is damaged: {wrong[0]}", where=str(path), found=wrong[1], cure=DAMAGED
        )
    if without := WAVES.get(header.point_format):
        raise StageError(
            "PDAL does not read points with waveforms",
            where=str(path),
            found=f"point format {header.point_format}",
            cure=f"Write the file anew in format {without}, which has all but the waveforms: "
            f"laspy.convert(laspy.read(IN), point_format_id={without}).write(OUT)",
        )
    beyond = _bytes_beyond(header, size)
    if beyond >= header.point_bytes:
        return (
            f"{path}: the file holds {beyond:,} bytes beyond the {header.count:,} points that its header counts; "
            "they are not read"
        )
    if header.count > 1 and not header.boxed:
        return (
            f"{path}: the box in its header is all zeros, as where a program ends while it writes the header; look whether "
            "the points lie where they should"
        )
    return None


def beyond_box(path: str | os.PathLike, lie: tuple[float, float, float, float]) -> str | None:
    """A warning where a file's points lie (min x, min y, max x, max y) beyond the box in its header: None where they do not.

    LAZ has no checksums: a damaged file may decode to points anywhere, without an error.
    """
    header = read_header(path)
    if header is None or not header.count or not header.boxed:
        return None
    room = [_BOX_STEPS * scale for scale in header.scales[:2]] * 2
    over = (header.box[0] - lie[0], header.box[1] - lie[1], lie[2] - header.box[2], lie[3] - header.box[3])
    if all(far <= most for far, most in zip(over, room, strict=True)):
        return None
    say = "x {0:.12g} to {2:.12g}, y {1:.12g} to {3:.12g}"
    return (
        f"{path}: points lie beyond the box in the header, so the file may be damaged (found {say.format(*lie)}; the header "
        f"says {say.format(*header.box)}). {DAMAGED}"
    )


def _bytes_beyond(header: LasHeader, size: int) -> int:
    """Bytes after the points of a file that is not compressed, and before what the header says comes then."""
    ends = [header.after] if header.records_after else []
    ends += [header.waveforms] if header.waveforms else []
    if header.compressed or any(not header.end_of_points <= end <= size for end in ends):
        return 0
    return min([size, *ends]) - header.end_of_points


#: Scales below and offsets above are no lengths, but bytes of a header that was written in part.
_SMALLEST, _LARGEST = 1e-30, 1e15
#: Bytes that a header has at least, by its version.
_HEADER_BYTES = (227, 227, 227, 235, 375, 375)


def _what_is_wrong(header: LasHeader, size: int, table: int) -> tuple[str, str] | None:
    if header.minor > 5:
        return "its version is not known", f"LAS 1.{header.minor}"
    if header.point_format >= len(POINT_BYTES):
        return "its point format is not known", f"point format {header.point_format}"
    least = POINT_BYTES[header.point_format]
    if header.point_bytes < least:
        return (
            "its points are shorter than their format",
            f"{header.point_bytes} bytes, format {header.point_format} has {least}",
        )
    if header.header_bytes < _HEADER_BYTES[header.minor]:
        least = _HEADER_BYTES[header.minor]
        return "its header is too short", f"{header.header_bytes} bytes, LAS 1.{header.minor} has {least}"
    if header.header_bytes > min(header.offset, size):
        return (
            "its points begin inside the header",
            f"header of {header.header_bytes} bytes, points at {header.offset}",
        )
    if header.records * 54 > header.offset - header.header_bytes:
        return (
            "it counts more records than there is room for",
            f"{header.records:,} records before the points",
        )
    if not all(_SMALLEST <= abs(v) < math.inf for v in header.scales) or not all(
        abs(v) <= _LARGEST for v in header.offsets
    ):
        return (
            "its scales or offsets are not valid numbers",
            f"scales {header.scales}, offsets {header.offsets}",
        )
    if header.count and header.offset > size:
        return "it is cut short", f"{size:,} bytes, points begin at {header.offset:,}"
    if header.compressed:
        if header.count and not header.offset + 8 <= table <= size - 8:
            return "it is cut short", f"{size:,} bytes, its table of chunks should be at {table:,}"
    elif header.end_of_points > size:
        held = max(0, size - header.offset) // header.point_bytes
        return "it is cut short", f"{held:,} whole points, its header counts {header.count:,}"
    if header.count and header.minor >= 4 and header.by_return != header.count:
        beyond = _bytes_beyond(header, size)
        if beyond >= header.point_bytes:  # either alone may be the work of a careless program
            return (
                "its header counts fewer points than it holds, and others by return",
                f"{header.count:,} points, {header.by_return:,} by return, {beyond:,} bytes after them",
            )
    if not header.count:
        end = header.after if header.records_after else size
        if header.compressed and header.offset + 8 <= table <= size - 8:
            end = min(end, table - 8)  # which is where an empty file has it
        if end >= header.offset + (8 + 1 if header.compressed else header.point_bytes):
            return (
                "its header counts no points, but holds some, as programs leave it that end before they are done",
                f"{end - header.offset:,} bytes where points are",
            )
    return None


def _wrong_records(path: str | os.PathLike, header: LasHeader, size: int) -> tuple[str, str] | None:
    """What is wrong with the records after the points."""
    begin = header.offset if header.compressed else header.end_of_points
    if not begin <= header.after <= size - 60 * header.records_after:
        return (
            "the records after its points are not where it says",
            f"{header.records_after:,} records at {header.after:,}, a file of {size:,} bytes",
        )
    with open(path, "rb") as file:
        held = [r for r in records(file, header) if r.after and r.data + r.length <= size]
    if len(held) < header.records_after:
        return (
            "the records after its points do not end within the file",
            f"{len(held):,} of {header.records_after:,} do",
        )
    return None


def _wrong_chunks(path: str | os.PathLike, header: LasHeader, table: int) -> tuple[str, str] | None:
    """What is wrong with the chunks of a LAZ file whose table is at `table`."""
    with open(path, "rb") as file:
        coding = chunks.coding_of(file, header)
        if coding is None:
            return "it has no record of how it is compressed", "no 'laszip encoded' among its records"
        of_chunk = chunks.points_of_chunk(coding)
        number, data = chunks.table_at(file, table)
        wrong = chunks.what_is_wrong(
            data,
            table - header.offset - 8,
            points=header.count,
            point_bytes=header.point_bytes,
            chunk_points=of_chunk,
        )
        if not wrong and header.point_format >= 6 and of_chunk is not None:
            wrong = _wrong_last_chunk(file, header, of_chunk, number, data)
        return wrong


def _wrong_last_chunk(
    file: BinaryIO, header: LasHeader, of_chunk: int, number: int, table: bytes
) -> tuple[str, str] | None:
    """What the last chunk of points of formats 6 to 10 says against the header: each begins with a point and its count."""
    if not 0 < number <= chunks.MOST_DECODED:
        return None
    sizes, _ = chunks.decode(table, variable=False)
    file.seek(header.offset + 8 + sum(sizes[:-1]) + header.point_bytes)
    held = file.read(4)
    counted = header.count - of_chunk * (number - 1)
    if len(held) == 4 and struct.unpack("<I", held)[0] != counted:
        found = of_chunk * (number - 1) + struct.unpack("<I", held)[0]
        return "its header counts other points than it holds", f"{header.count:,} counted, {found:,} held"
    return None
