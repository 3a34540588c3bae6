"""LAS and LAZ headers, looked at before PDAL reads the file and after it wrote one.

PDAL reads a file that is cut short as if it were whole, giving points made of nothing, and some damaged headers
end the process. What a header says is therefore held against the size of the file first.

Not laspy's reader, which was tried: its import takes 0.15 CPU seconds of every start (NumPy apart), a header of 43 real
files 240 microseconds on average against 10 here, and it reads all records before the size is held against them.
"""

from __future__ import annotations

import hashlib
import math
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import accumulate, islice
from pathlib import Path
from typing import BinaryIO, NamedTuple

from . import chunks, copc
from .errors import StageError

#: Bytes of a point of each format, without extra bytes (LAS 1.4 R15, tables 7 to 18).
POINT_BYTES = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)
#: Point formats with waveforms, and what has all else that they have.
WAVES = {4: 1, 5: 3, 9: 6, 10: 8}
#: What to do about a damaged file.
DAMAGED = "Get the file again from its source, or repair it with a tool made for that (e.g. lasinfo -repair)"
#: Steps of the coordinates that points may lie beyond the box: programs round it differently.
_BOX_STEPS = 100


@dataclass(frozen=True)
class LasHeader:
    """What a header says of the size of its file."""

    minor: int
    point_format: int
    point_bytes: int
    compressed: bool
    header_bytes: int
    offset: int  #: where points (or LAZ chunks) begin
    records: int  #: variable-length records before the points
    records_after: int
    after: int  #: where the records after the points begin
    count: int
    by_return: int  #: the sum of its counts of points by their return number
    waveforms: int  #: where waveforms inside the file begin, 0 where there are none
    boxed: bool  #: whether its box is more than zeros
    scales: tuple[float, ...]
    offsets: tuple[float, ...]
    texts: dict[str, bytes]  #: the texts of the header
    box: tuple[float, float, float, float]  #: (min x, min y, max x, max y)

    @property
    def end_of_points(self) -> int:
        """Bytes a file that is not compressed must have."""
        return self.offset + self.count * self.point_bytes


def read_header(path: str | os.PathLike) -> LasHeader | None:
    """The header of a LAS or LAZ file; None where the file is too short for one, or is something else."""
    with open(path, "rb") as file:
        head = file.read(375)
    if len(head) < 227 or head[:4] != b"LASF":
        return None
    size, offset, records, kind, length, count = struct.unpack_from("<HIIBHI", head, 94)
    minor, after, place, waveforms = head[25], 0, 0, 0
    by_return = sum(struct.unpack_from("<5I", head, 111))
    if minor >= 3 and size >= 235 and len(head) >= 235:
        (waveforms,) = struct.unpack_from("<Q", head, 227)
    if minor >= 4 and size >= 375 and len(head) >= 255:
        place, after, count = struct.unpack_from("<QIQ", head, 235)
        by_return = sum(struct.unpack("<15Q", head[255:].ljust(120, b"\0")))
    numbers = struct.unpack_from("<6d", head, 131)
    x1, x0, y1, y0 = struct.unpack_from("<4d", head, 179)
    texts = {
        "system identifier": head[26:58].split(b"\0")[0],
        "generating software": head[58:90].split(b"\0")[0],
    }
    return LasHeader(
        minor, kind & 0x3F, length, bool(kind & 0xC0), size, offset, records, after, place, count, by_return,
        waveforms, any(struct.unpack_from("<6d", head, 179)), numbers[:3], numbers[3:], texts, (x0, y0, x1, y1),
    )  # fmt: skip


def holds_flags(path: str | os.PathLike) -> bool:
    """Whether a file is of LAS 1.0 to 1.3, whose flags (synthetic, key-point, withheld) share a byte with the class."""
    header = read_header(path)
    return header is not None and header.point_format <= 5


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
        table = _chunk_table(path, size, header) if header is not None and header.compressed else 0
        wrong = None if header is None else _what_is_wrong(header, size, table)
        if header is not None and header.records_after and not wrong:
            wrong = _wrong_records(path, header, size)
        if header is not None and header.compressed and header.count and not wrong:
            wrong = _wrong_chunks(path, header, table, size)
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


def supersede_copc(path: str | os.PathLike) -> None:
    """Mark COPC records that do not describe this file, which PDAL forwards from a COPC input with the others.

    Readers of COPC would look for an octree where there is none. The records get the id with which LAS 1.4 (R15,
    section 2.5, "Superseded") negates a record in place.
    """
    header = read_header(path) if Path(path).suffix.lower() in (".las", ".laz") else None
    if header is None:
        return
    with open(path, "r+b") as file:
        copc = [r for r in records(file, header) if r.user == b"copc"]
        root = None
        for record in copc:
            if record.number == 1 and record.length >= 48:
                file.seek(record.data + 40)
                (root,) = struct.unpack("<Q", file.read(8))
        if any(r.after and root is not None and 0 <= root - r.data < r.length for r in copc):
            return
        for record in copc:
            file.seek(record.place + 2)
            file.write(_SUPERSEDED)


#: User and record id of a record that no longer counts.
_SUPERSEDED = b"LASF_Spec".ljust(16, b"\0") + struct.pack("<H", 7)


class Record(NamedTuple):
    """A variable-length record: where its head is, whose it is, where its data are; `after` the points or before."""

    place: int
    user: bytes
    number: int
    title: bytes
    data: int
    length: int
    after: bool


def records(file: BinaryIO, header: LasHeader) -> Iterator[Record]:
    """The records of a file, as far as they are all there."""
    place = header.header_bytes
    for index in range(header.records + header.records_after):
        after = index >= header.records
        if index == header.records:
            place = header.after
        size = 60 if after else 54
        if place >= 2**62:
            return
        file.seek(place)
        head = file.read(size)
        if len(head) < size:
            return
        (number,) = struct.unpack_from("<H", head, 18)
        (length,) = struct.unpack_from("<Q" if after else "<H", head, 20)
        user, title = head[2:18].split(b"\0")[0], head[size - 32 :].split(b"\0")[0]
        yield Record(place, user, number, title, place + size, length, after)
        place += size + length


#: Records that are looked through, and bytes of one that is read.
_MOST_RECORDS, _LARGEST_RECORD = 10_000, 1 << 20


def records_of(path: str | os.PathLike, user: bytes) -> Iterator[tuple[Record, bytes]]:
    """The records of a user (``LASF_Spec``) in a file, with their data; none where it is no LAS file."""
    header = read_header(path)
    if header is None:
        return
    with open(path, "rb") as file:
        for record in islice(records(file, header), _MOST_RECORDS):
            if record.user == user and record.length <= _LARGEST_RECORD:
                file.seek(record.data)
                yield record, file.read(record.length)


def _chunk_table(path: str | os.PathLike, size: int, header: LasHeader) -> int:
    """Where a LAZ file's table of chunks is, which is written last; -1 where that is not in the file."""
    with open(path, "rb") as file:
        file.seek(header.offset)
        place = file.read(8)
        if len(place) == 8 and place == b"\xff" * 8:  # a stream that could not be rewound has it at its end
            file.seek(size - 8)
            place = file.read(8)
    return struct.unpack("<q", place)[0] if len(place) == 8 else -1


def _wrong_chunks(
    path: str | os.PathLike, header: LasHeader, table: int, size: int
) -> tuple[str, str] | None:
    """What is wrong with the chunks of a LAZ file whose table is at `table`."""
    with open(path, "rb") as file:
        coding = _coding(file, header)
        if coding is None:
            return "it has no record of how it is compressed", "no 'laszip encoded' among its records"
        of_chunk = _points_of_chunk(coding)
        number, data = _table(file, table)
        wrong = chunks.what_is_wrong(
            data,
            table - header.offset - 8,
            points=header.count,
            point_bytes=header.point_bytes,
            chunk_points=of_chunk,
        )
        if not wrong and header.point_format >= 6 and of_chunk is not None:
            wrong = _wrong_last_chunk(file, header, of_chunk, number, data)
        if wrong or not Path(path).name.lower().endswith(".copc.laz"):
            return wrong
        listed = of_chunk is None and number <= chunks.MOST_DECODED
        return _wrong_octree(file, header, size, data if listed else b"")


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


def _coding(file: BinaryIO, header: LasHeader) -> bytes | None:
    """The record of how a LAZ file is compressed, None where it lacks one."""
    for record in records(file, header):
        if (record.user, record.number) == (b"laszip encoded", 22204):
            file.seek(record.data)
            data = file.read(min(record.length, _LARGEST_RECORD))
            return data if len(data) >= 16 else None
    return None


def _points_of_chunk(coding: bytes) -> int | None:
    """Points of every chunk but the last; None where the table tells for each."""
    (points,) = struct.unpack_from("<I", coding, 12)
    return None if points in (0, 2**32 - 1) else points


def _table(file: BinaryIO, place: int) -> tuple[int, bytes]:
    """Number of chunks, and the file from their table on: as much as the table of so many can take."""
    file.seek(place)
    begin = file.read(8)
    number = struct.unpack("<4xI", begin)[0] if len(begin) == 8 else 0
    # A number takes less than eight bytes, and a chunk has two at most.
    return number, begin + file.read(56 + 16 * min(chunks.MOST_DECODED, number))


class LazChunks(NamedTuple):
    """The chunks of a LAZ file: the record of their coding, where the first begins, bytes and points of each."""

    record: bytes
    begin: int
    sizes: list[int]
    points: list[int]


def laz_chunks(path: str | os.PathLike, header: LasHeader) -> LazChunks | None:
    """The chunks of a LAZ file that `check_readable` takes; None where they are too many to be listed."""
    table = _chunk_table(path, os.stat(path).st_size, header)
    with open(path, "rb") as file:
        coding = _coding(file, header)
        number, data = _table(file, table)
    if coding is None or number > chunks.MOST_DECODED:
        return None
    of_chunk = _points_of_chunk(coding)
    sizes, points = chunks.decode(data, variable=of_chunk is None)
    if of_chunk is not None:
        points = [max(0, min(of_chunk, header.count - done * of_chunk)) for done in range(number)]
    return LazChunks(coding, header.offset + 8, sizes, points)


def _wrong_octree(file: BinaryIO, header: LasHeader, size: int, table: bytes) -> tuple[str, str] | None:
    """What is wrong with the octree of a file that calls itself COPC; `table`: of its chunks, where each has its count."""
    first = next(records(file, header), None)
    if first is None or first.user != b"copc" or first.number != 1:
        return "it is called .copc.laz, but its first record does not describe an octree", str(
            first and first.user
        )
    known = None
    if table:
        sizes, counts = chunks.decode(table, variable=True)
        places = accumulate(sizes, initial=header.offset + 8)
        known = [place for place in zip(places, sizes, counts, strict=False) if place[2]]
    return copc.what_is_wrong(file, first.data, size, header.count, known)


def odd_text(path: str | os.PathLike) -> tuple[str, bytes] | None:
    """A text of the header or of a record's head that is not UTF-8: (what, bytes)."""
    try:
        header = read_header(path)
        if header is None:
            return None
        texts = list(header.texts.items())
        with open(path, "rb") as file:
            for record in islice(records(file, header), min(header.records, 1000)):
                texts += [("description of a record", record.title), ("user of a record", record.user)]
    except (OSError, ValueError):
        return None
    for what, text in texts:
        try:
            text.decode()
        except UnicodeDecodeError:
            return what, text
    return None


def projection(path: str | os.PathLike) -> str:
    """A digest of the records that hold a file's spatial reference; empty where it has none.

    Raises
    ------
    OSError
        If the file cannot be read.
    """
    held = records_of(path, b"LASF_Projection")
    found = [struct.pack("<HQ", record.number, record.length) + data for record, data in held]
    return hashlib.sha256(b"".join(found)).hexdigest()[:16] if found else ""
