"""Headers and records of LAS and LAZ files (LAS 1.4 R15).

Their points: :mod:`.las_points`. Copies with other classes: :mod:`.las_copy`. Not laspy's reader:
its import takes 0.15 CPU seconds of every start, and it reads all records before their sizes are
checked.
"""

from __future__ import annotations

import hashlib
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from .errors import StageError

#: Bytes of a point of each format, without extra bytes (LAS 1.4 R15, tables 7 to 18). A format that
#: is not here is refused; PDAL and laspy must read it as well.
POINT_BYTES = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)
#: Point formats with waveforms.
WAVES = (4, 5, 9, 10)


@dataclass(frozen=True)
class LasHeader:
    """The fields of a header that the layout of the file follows from."""

    source_id: int  #: of the file; LAS 1.0 has none
    says_wkt: bool  #: whether its spatial reference is well-known text
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
    waveforms: int  #: where waveforms inside the file begin, 0 where there are none
    boxed: bool  #: whether its bounding box is not all zeros
    scales: tuple[float, ...]
    offsets: tuple[float, ...]
    box: tuple[float, float, float, float]  #: (min x, min y, max x, max y)

    @property
    def extra_bytes(self) -> int:
        """Return the bytes of a point beyond those of its format, which must be known."""
        return self.point_bytes - POINT_BYTES[self.point_format]


def named_las(path: str | os.PathLike) -> bool:
    """Return whether a file is named like a LAS, LAZ or COPC file."""
    return os.fspath(path).lower().endswith((".las", ".laz"))


def named_copc(path: str | os.PathLike) -> bool:
    """Return whether a file is named like a COPC file."""
    return os.fspath(path).lower().endswith(".copc.laz")


def refuse_pipe(path: str | os.PathLike) -> None:
    """Refuse a pipe as an input: it may block, and can be read only once."""
    if Path(path).is_fifo():
        raise StageError("the input is a pipe", where=str(path), cure="Save it to a file first")


def read_header(path: str | os.PathLike) -> LasHeader | None:
    """Return the header of a LAS or LAZ file; None for a short file or another format."""
    refuse_pipe(path)
    with open(path, "rb") as file:
        head = file.read(375)
    if len(head) < 227 or head[:4] != b"LASF":
        return None
    size, offset, records, kind, length, count = struct.unpack_from("<HIIBHI", head, 94)
    minor, after, place, waveforms = head[25], 0, 0, 0
    if minor >= 3 and size >= 235 and len(head) >= 235:
        (waveforms,) = struct.unpack_from("<Q", head, 227)
    if minor >= 4 and size >= 375 and len(head) >= 255:
        place, after, count = struct.unpack_from("<QIQ", head, 235)
    numbers = struct.unpack_from("<12d", head, 131)
    x1, x0, y1, y0 = numbers[6:10]
    source, flags = struct.unpack_from("<HH", head, 4)
    return LasHeader(
        source if minor else 0, bool(flags & 16), minor,
        kind & 0x3F, length, bool(kind & 0xC0), size, offset, records, after, place, count,
        waveforms, any(numbers[6:]), numbers[:3], numbers[3:6], (x0, y0, x1, y1),
    )  # fmt: skip


def header_there(path: str | os.PathLike) -> LasHeader | None:
    """Return the header of a LAS or LAZ file; None for other files and unreadable ones.

    A file that cannot be read is reported when its points are read.
    """
    try:
        return read_header(path)
    except (OSError, ValueError):
        return None


def end_of_points(header: LasHeader, size: int) -> int:
    """Return the end of the point data: the offset of what follows, or the size of the file."""
    places = [header.after] * bool(header.records_after) + [header.waveforms]
    return min([size, *(place for place in places if place >= header.offset)])


class Record(NamedTuple):
    """A variable-length record."""

    place: int  #: offset of its head in the file
    user: bytes  #: user id, e.g. ``LASF_Spec``
    number: int  #: record id
    title: bytes
    data: int  #: offset of its data in the file
    length: int  #: bytes of its data
    after: bool  #: whether it stands behind the points

    @property
    def kind(self) -> tuple[bytes, int]:
        """Return what it holds: its user id and record id."""
        return self.user, self.number


def records(file: BinaryIO, header: LasHeader) -> Iterator[Record]:
    """Yield the records of a file, up to the first that is cut short."""
    place = header.header_bytes
    for index in range(header.records + header.records_after):
        after = index >= header.records
        if index == header.records:
            place = header.after
        size = 60 if after else 54
        if place >= 2**62:  # a damaged length; files cannot be searched from 2**63 on
            return
        file.seek(place)
        head = file.read(size)
        if len(head) < size:
            return
        (number,) = struct.unpack_from("<H", head, 18)
        (length,) = struct.unpack_from("<Q" if after else "<H", head, 20)
        user, title = _text(head[2:18]), _text(head[size - 32 :])
        yield Record(place, user, number, title, place + size, length, after)
        place += size + length


def _text(field: bytes) -> bytes:
    return field.split(b"\0")[0]


#: Most records of a file that are searched: files have some ten, damaged headers count up to 2**32.
_MOST_RECORDS = 10_000
#: Largest record that is read, in bytes: references and descriptions of extra bytes take some kB.
LARGEST_RECORD = 1 << 20


def records_of(path: str | os.PathLike, user: bytes) -> Iterator[tuple[Record, bytes]]:
    """Yield the records of a user id (``LASF_Spec``) in a LAS file with their data."""
    header = read_header(path)
    if header is None:
        return
    with open(path, "rb") as file:
        for record in islice(records(file, header), _MOST_RECORDS):
            if record.user == user and record.length <= LARGEST_RECORD:
                file.seek(record.data)
                yield record, file.read(record.length)


def laszip_record(path: str | os.PathLike) -> bytes:
    """Return the record of how a LAZ file is compressed; empty where it has none."""
    coding = (
        data for record, data in records_of(path, b"laszip encoded") if record.number == 22204
    )
    return next(coding, b"")


def chunk_table(file: BinaryIO, header: LasHeader) -> tuple[int, int]:
    """Return where a LAZ file says where its table of chunks is, and what it says."""
    at = file.seek(header.offset)
    table = int.from_bytes(file.read(8), "little", signed=True)
    if table == -1:  # a stream that could not be rewound has it at its end
        at = file.seek(-8, os.SEEK_END)
        table = int.from_bytes(file.read(8), "little", signed=True)
    return at, table


#: How the record begins where points are compressed one by one, without chunks and a table of them
#: (LASzip 1).
POINTWISE = b"\1\0"


def supersede_copc(path: str | os.PathLike) -> None:
    """Mark COPC records that do not describe this file: PDAL forwards them from a COPC input.

    Readers of COPC would look for an octree where there is none. The records get the id with which
    LAS 1.4 (R15, section 2.5, "Superseded") negates a record in place.
    """
    if not named_las(path):
        return
    copc = list(records_of(path, b"copc"))
    about = [data for record, data in copc if record.number == 1 and len(data) >= 48]
    root = struct.unpack_from("<Q", about[-1], 40)[0] if about else 0
    if any(r.after and 0 <= root - r.data < r.length for r, _ in copc):
        return
    with open(path, "r+b") as file:
        for record, _ in copc:
            file.seek(record.place + 2)
            file.write(b"LASF_Spec".ljust(16, b"\0") + struct.pack("<H", 7))


#: User id of the records of the reference system.
PROJECTION = b"LASF_Projection"


def projection_digest(path: str | os.PathLike) -> str:
    """Return a digest of the records that hold a file's spatial reference; empty without any.

    Raises
    ------
    OSError
        If the file cannot be read.
    """
    held, header = records_of(path, PROJECTION), read_header(path)
    parts = [struct.pack("<HQ", record.number, record.length) + data for record, data in held]
    flag = bytes([header is not None and header.says_wkt])
    return hashlib.sha256(flag + b"".join(parts)).hexdigest()[:16] if parts else ""


#: PDAL's names of types that are not NumPy's.
_FLOATS = {"double": "float64", "float": "float32"}


def number_type(kind: str) -> np.dtype:
    """Return the NumPy type of a PDAL type: ``double``, ``float``, ``uint8`` or ``uint8_t``."""
    return np.dtype(_FLOATS.get(kind, kind.removesuffix("_t")))


def pdal_type(kind: np.dtype) -> str:
    """Return PDAL's name of a NumPy type."""
    return next((name for name, plain in _FLOATS.items() if plain == kind.name), kind.name)
