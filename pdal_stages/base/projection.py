"""The records of a LAS file that say its reference system, put back as they were.

PDAL writes them anew: WKT 2 becomes WKT 1, GeoTIFF keys are rewritten, and some are dropped.
"""

from __future__ import annotations

import os
import shutil
import struct
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from .las import LasHeader, read_header, records

#: Whose records, and which: GeoTIFF keys and well-known text (LAS 1.4 R15, section 3), and a copy that PDAL adds.
_GEOTIFF = {(b"LASF_Projection", number) for number in (34735, 34736, 34737)}
_WKT = {(b"LASF_Projection", 2111), (b"LASF_Projection", 2112), (b"liblas", 2112)}
_MOST, _LARGEST = 10_000, 65_535
#: The bit of the global encoding that says which of them counts.
_WKT_BIT = 0x10


class Projection(NamedTuple):
    """What a file says of its reference system: its records, whole, and whether well-known text counts."""

    records: tuple[bytes, ...]
    wkt: bool


def projection_of(path: str | os.PathLike) -> Projection | None:
    """The records of a file as they stand there; None where there are none, or they cannot stand before the points."""
    header = read_header(path)
    if header is None:
        return None
    found = []
    with open(path, "rb") as file:
        for record in islice(records(file, header), _MOST):
            if (record.user, record.number) in _GEOTIFF | _WKT:
                if record.length > _LARGEST:
                    return None
                file.seek(record.place)
                head = file.read(record.data - record.place)
                short = head[:20] + struct.pack("<H", record.length) + head[-32:]
                file.seek(record.data)
                found.append(short + file.read(record.length))
        wkt = _says_wkt(file)
    return Projection(tuple(found), wkt) if found else None


def _says_wkt(file) -> bool:
    file.seek(6)
    return bool(struct.unpack("<H", file.read(2))[0] & _WKT_BIT)


def put_back(path: str | os.PathLike, wanted: Projection) -> bool:
    """Give a file these records in place of its own; False where it has them, or is of the other kind."""
    header = read_header(path)
    own = projection_of(path)
    if header is None or own == wanted:
        return False
    with open(path, "rb") as file:
        if _says_wkt(file) != wanted.wkt:
            return False
        kept: list[bytes] = []
        place: int | None = None
        for record in islice(records(file, header), _MOST):
            if record.after:
                break
            if (record.user, record.number) in _GEOTIFF | _WKT:
                place = len(kept) if place is None else place
                continue
            file.seek(record.place)
            kept.append(file.read(record.data + record.length - record.place))
        kept[place or 0 : place or 0] = wanted.records
        _rewrite(Path(path), header, file, kept)
    return True


def _rewrite(path: Path, header: LasHeader, file, kept: list[bytes]) -> None:
    """The file with other records before its points, which move as they are."""
    file.seek(0)
    head = bytearray(file.read(header.header_bytes))
    offset = header.header_bytes + sum(map(len, kept))
    moved = offset - header.offset
    struct.pack_into("<II", head, 96, offset, len(kept))
    if header.minor >= 4 and header.header_bytes >= 375:
        (waves,) = struct.unpack_from("<Q", head, 227)
        struct.pack_into("<Q", head, 227, waves + moved if waves else 0)
        if header.records_after:
            struct.pack_into("<Q", head, 235, header.after + moved)
    new = path.with_name(path.name + ".records")
    with open(new, "xb") as out:
        out.write(bytes(head) + b"".join(kept))
        file.seek(header.offset)
        if header.compressed and header.count:  # begins with where the table of chunks is
            table = file.read(8)
            (place,) = struct.unpack("<q", table)
            out.write(struct.pack("<q", place + moved) if place > 0 else table)
        shutil.copyfileobj(file, out, 1 << 20)
        out.flush()
        os.fsync(out.fileno())
    os.replace(new, path)
