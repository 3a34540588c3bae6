"""Point files checked against their headers, before PDAL reads one and after it wrote one.

PDAL reads a truncated file as if it were whole, with made-up points; some damaged headers and
chunk tables crash it or make it hang. Its writers do not notice a full disk. Layout: LAS 1.4 R15.
Octrees of COPC files and EPT sources: :mod:`.octrees`.
"""

from __future__ import annotations

import io
import math
import os
import struct
from pathlib import Path
from typing import BinaryIO

from .errors import StageError
from .files import disk_is_full
from .json_types import StageJson
from .las import (
    POINT_BYTES,
    POINTWISE,
    LasHeader,
    chunk_table,
    end_of_points,
    laszip_record,
    read_header,
    records,
)
from .las_points import Layout

#: What to do about a damaged file.
CURE_OF_DAMAGE = (
    "Get the file again from its source, or repair it with a tool made for that (lasinfo -repair)"
)
#: Steps of the coordinates by which points may lie outside the bounding box: programs round it
#: differently. 10 cm at a step of 1 mm; not tuned.
_BOX_STEPS = 100
#: Smaller scales come from a damaged or partly written header: surveys have 1e-7 (degrees) to 1.
_SMALLEST_SCALE = 1e-30
#: Larger offsets of coordinates come from such a header, too: a double has steps of 12 cm there.
_LARGEST_OFFSET = 1e15
#: The least size of a header in bytes, by minor version.
_HEADER_BYTES = (227, 227, 227, 235, 375, 375)
#: More chunks (ten billion points in chunks of the usual size) are not decoded one by one.
_MOST_CHUNKS = 200_000
#: Most points of a chunk, since lazrs allocates memory for all of them; 50,000 are usual.
_LARGEST_CHUNK = 2**24


def check_readable(path: str | os.PathLike) -> str | None:
    """Refuse a LAS or LAZ file whose header cannot be right; return a warning if it is unusual.

    Raises
    ------
    StageError
        If the file is damaged or cannot be opened, where PDAL says little or crashes.
    """
    where = str(path)
    try:
        size, header = Path(path).stat().st_size, read_header(path)
        if header is None:
            value = f"{size:,} bytes without a LAS header"
            raise StageError("not a LAS file", found=value, cure=CURE_OF_DAMAGE)
        _check_header(header, size)
        with open(path, "rb") as file:
            _check_records(file, header, size)
            (_check_chunks if header.compressed else _check_count)(file, header, size)
        Layout.of_file(path)  # whose extra bytes must fit
    except OSError as error:
        raise StageError("the file cannot be read", where=where, found=error) from None
    except StageError as error:
        raise error.at(where) from None
    warning = _describe_oddity(header, size)
    return warning and f"{path}: {warning}"


def _describe_oddity(header: LasHeader, size: int) -> str | None:
    """Return a warning about a file that can be read but is unusual."""
    beyond = end_of_points(header, size) - header.offset - header.count * header.point_bytes
    if not header.compressed and beyond >= header.point_bytes:
        return (
            f"the file holds {beyond:,} bytes beyond the {header.count:,} points that its header "
            "counts; they are not read"
        )
    if header.count > 1 and not header.boxed:
        return (
            "the bounding box in its header is all zeros, as when a program was stopped while "
            "writing it; check that the points lie where they should"
        )
    return None


def beyond_box(path: str | os.PathLike, extent: tuple[float, float, float, float]) -> str | None:
    """Return a warning where the extent of a file's points exceeds the box in its header.

    LAZ has no checksums: a damaged file may decode to points anywhere, without an error. The
    extent is (min x, min y, max x, max y).
    """
    header = read_header(path)
    if header is None or not header.count or not header.boxed:
        return None
    room = [_BOX_STEPS * scale for scale in header.scales[:2]] * 2
    box = header.box
    excess = (box[0] - extent[0], box[1] - extent[1], extent[2] - box[2], extent[3] - box[3])
    if all(far <= most for far, most in zip(excess, room, strict=True)):
        return None
    say = "x {0:.12g} to {2:.12g}, y {1:.12g} to {3:.12g}"
    return (
        f"{path}: points lie outside the bounding box in the header, so the file may be damaged "
        f"(found {say.format(*extent)}; the header says {say.format(*box)}). {CURE_OF_DAMAGE}"
    )


def check_complete(
    path: str | os.PathLike,
    name: str | os.PathLike,
    writer: StageJson,
    count: int | None = None,
) -> None:
    """Refuse a file that was not written completely.

    LAS and LAZ files are checked against their headers and the number of points; for other
    formats, only whether the disk has room left.

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
        if las:
            check_readable(path)
            header = read_header(path)
            whole = header is not None and count in (None, header.count)
        else:
            whole = not disk_is_full(path)
    except OSError as error:
        raise StageError("the output file cannot be read back", found=f"{name}: {error}") from error
    except StageError:  # the file is damaged
        whole = False
    if not whole:
        raise StageError(
            "the output file could not be written completely",
            found=f"{name}: {size:,} bytes were written",
            cure="Make room on the disk",
        )


def _require(good: bool, what: str, seen: str) -> None:
    """Refuse a file as damaged unless a condition holds."""
    if not good:
        raise StageError(f"the LAS file is damaged: {what}", found=seen, cure=CURE_OF_DAMAGE)


def _check_header(header: LasHeader, size: int) -> None:
    """Refuse a header that cannot be right."""
    h, kind = header, header.point_format
    _require(h.minor <= 5, "its version is not known", f"LAS 1.{h.minor}")
    _require(kind < len(POINT_BYTES), "its point format is not known", f"point format {kind}")
    seen = f"{h.point_bytes} bytes, format {kind} has {POINT_BYTES[kind]}"
    _require(h.extra_bytes >= 0, "its points are shorter than their format", seen)
    least = _HEADER_BYTES[h.minor]
    seen = f"{h.header_bytes} bytes, LAS 1.{h.minor} has {least}"
    _require(h.header_bytes >= least, "its header is too short", seen)
    seen = f"header of {h.header_bytes} bytes, points at {h.offset}"
    _require(h.header_bytes <= min(h.offset, size), "its points begin inside the header", seen)
    fit, seen = (
        h.records * 54 <= h.offset - h.header_bytes,
        f"{h.records:,} records before the points",
    )
    _require(fit, "it counts more records than there is room for", seen)
    finite = all(_SMALLEST_SCALE <= abs(value) < math.inf for value in h.scales)
    finite &= all(abs(value) <= _LARGEST_OFFSET for value in h.offsets)
    seen = f"scales {h.scales}, offsets {h.offsets}"
    _require(finite, "its scales or offsets are not valid numbers", seen)
    seen = f"{size:,} bytes, points begin at {h.offset:,}"
    _require(not h.count or h.offset <= size, "it is cut short", seen)


def _check_records(file: BinaryIO, header: LasHeader, size: int) -> None:
    """Refuse records after the points that are not there."""
    count = header.records_after
    end = header.offset + (0 if header.compressed else header.count * header.point_bytes)
    if not count or end > size:  # of which the number of points tells
        return
    seen = f"{count:,} records at {header.after:,}, a file of {size:,} bytes"
    there = end <= header.after <= size - 60 * count
    _require(there, "the records after its points are not where it says", seen)
    whole = sum(r.after and r.data + r.length <= size for r in records(file, header))
    what = "the records after its points do not end within the file"
    _require(whole == count, what, f"{whole:,} of {count:,} do")


def _check_count(file: BinaryIO, header: LasHeader, size: int) -> None:
    """Refuse a wrong number of uncompressed points."""
    held = max(0, end_of_points(header, size) - header.offset) // header.point_bytes
    seen = f"{held:,} whole points, its header counts {header.count:,}"
    _require(held >= header.count, "it is cut short", seen)
    _require_counted(header, held * header.point_bytes)


def _require_counted(header: LasHeader, size: int) -> None:
    """Refuse a file of `size` bytes of points whose header counts none."""
    what = (
        "its header counts no points, but the file holds some, as when a program was stopped "
        "before it finished"
    )
    _require(header.count > 0 or size <= 0, what, f"{size:,} bytes where points are")


def _check_chunks(file: BinaryIO, header: LasHeader, size: int) -> None:
    """Refuse chunks of a LAZ file that do not agree with their table, which is written last.

    Layout: "LAZ specification 1.4", chunk table.
    """
    coding = laszip_record(file.name)
    if header.count and coding.startswith(POINTWISE):  # only decoding all points would tell
        return
    (_, table), begin = chunk_table(file, header), header.offset + 8
    inside = begin <= table <= size - 8
    if not header.count:  # an empty file may have 8 bytes
        end = table - 8 if inside else end_of_points(header, size)
        return _require_counted(header, end - begin)
    seen = f"{size:,} bytes, its table of chunks should be at {table:,}"
    _require(inside, "it is cut short", seen)
    what = "it has no record of how it is compressed"
    _require(len(coding) >= 16, what, "no 'laszip encoded' among its records")
    _check_table(file, header, table, int.from_bytes(coding[12:16], "little"))


def _check_table(file: BinaryIO, header: LasHeader, table: int, chunk_points: int) -> None:
    """Refuse a table of chunks at `table`, each of `chunk_points`, that is not that of the file."""
    file.seek(table)
    head = file.read(8)
    version, number = struct.unpack("<II", head)
    varies = chunk_points in (0, 2**32 - 1)
    room = table - header.offset - 8
    _require(not version, "its table of chunks is of an unknown version", str(version))
    what, seen = "its chunks are larger than any program makes them", f"{chunk_points:,} points"
    _require(varies or chunk_points <= _LARGEST_CHUNK, what, seen)
    what, seen = (
        "it has more chunks than there is room for",
        f"{number:,} chunks in {room:,} bytes",
    )
    _require(number * header.point_bytes <= room, what, seen)  # a chunk begins with a whole point
    if number > _MOST_CHUNKS:
        return
    sizes, counts = _decode_table(head + file.read(56 + 16 * number), varies)
    _require(
        bool(sizes) or not number, "it is cut short", f"its table of {number:,} chunks does not end"
    )
    seen = f"{sum(sizes):,} bytes in chunks, {room:,} bytes there"
    _require(sum(sizes) == room, "its chunks do not fill the file", seen)
    held = sum(counts) if varies else number * chunk_points
    # Chunks of formats 6 and later begin with a point and their number of points.
    if not varies and header.point_format >= 6 and number:
        file.seek(table - sizes[-1] + header.point_bytes)
        held += int.from_bytes(file.read(4), "little") - chunk_points
    exact = varies or header.point_format >= 6
    good = held == header.count or (held > header.count and not exact)
    what = "its header counts a different number of points than it holds"
    _require(good, what, f"{header.count:,} counted, {held:,} held")


def _decode_table(table: bytes, varies: bool) -> tuple[list[int], list[int]]:
    """Return the bytes of each chunk, and its points if they vary; none of a table cut short."""
    import lazrs

    if any(table[4:8]) and table[8:12] == b"\xff" * 4:  # no encoder writes it, and lazrs panics
        return [], []
    try:
        coding = lazrs.LazVlr.new_for_compression(0, 0, varies)
        entries = lazrs.read_chunk_table_only(io.BytesIO(table), coding)
    except lazrs.LazrsError:
        return [], []
    # The numbers have 32 bits; lazrs takes the upper half of them for negative ones.
    sizes = [size % 2**32 for _, size in entries]
    return sizes, [points % 2**32 for points, _ in entries] if varies else []
