"""Extra bytes of LAS points: descriptions (LAS 1.4 R15, table 24) and names that PDAL can take.

PDAL refuses names with spaces or signs, lets a name like ``Z`` overwrite the coordinates, and
leaves out bytes of type 0 and bytes that no record describes.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Iterable
from dataclasses import dataclass

from .errors import StageError
from .las import POINT_BYTES, LasHeader, read_header, records_of

#: Bytes of one description.
ENTRY = 192
#: Most descriptions that one record holds.
MOST_ENTRIES = 65_535 // ENTRY
#: PDAL's names of the types of extra bytes, by number, 1 to 10; 11 to 20 are pairs, 21 to 30
#: triples of these.
_INTEGERS = ("uint8", "int8", "uint16", "int16", "uint32", "int32", "uint64", "int64")
_TYPES = (*_INTEGERS, "float", "double")
_BYTES = (1, 1, 2, 2, 4, 4, 8, 8, 4, 8)
#: Dimensions that PDAL or laspy read from every point format, in lower case without underscores,
#: and PDAL's other names of them; ``where`` is no name of a dimension.
_OF_ALL_FORMATS = frozenset(
    (
        *("x", "y", "z", "intensity", "returnnumber", "numberofreturns", "scandirectionflag"),
        *("edgeofflightline", "classification", "class", "cls", "scananglerank", "scanangle"),
        *("userdata", "pointsourceid", "scanchannel", "scannerchannel", "classflags", "where"),
        *("synthetic", "keypoint", "withheld", "overlap", "classificationflags", "bitfields"),
        "rawclassification",
    )
)
_TIME = frozenset(["gpstime"])
_COLORS = frozenset(["red", "green", "blue", "diffusered", "diffusegreen", "diffuseblue"])
_INFRARED = frozenset(["infrared", "nearinfrared", "nir"])
_COLORED = (2, 3, 5, 7, 8, 10)
#: What is put before a name that another dimension has.
_PREFIX = "Extra_"
#: Name of bytes without a description.
_UNDESCRIBED = "Undescribed"


@dataclass(frozen=True)
class ExtraField:
    """Extra bytes as one dimension."""

    title: str  #: the name in the file; empty for bytes without one
    name: str  #: the name of the dimension
    kind: str  #: PDAL's type
    clashes: bool  #: whether the name in the file is that of another dimension


def _taken(point_format: int) -> set[str]:
    """Return the names of the dimensions of a point format, as :func:`_plain` gives them."""
    names = set(_OF_ALL_FORMATS)
    names |= _TIME if point_format not in (0, 2) else set()
    names |= _COLORS if point_format in _COLORED else set()
    return names | (_INFRARED if point_format in (8, 10) else set())


def _plain(name: str) -> str:
    """Return a name in lower case without underscores and spaces.

    PDAL ignores case, and laspy writes ``gps_time``.
    """
    return re.sub(r"[_ ]", "", name.lower())


def _title(entry: bytes) -> str:
    """Return the name in a description, which may be in UTF-8 or Latin-1."""
    text = entry[4:36].split(b"\0")[0]
    try:
        return text.decode()
    except UnicodeDecodeError:
        return text.decode("latin-1")


def _elements(name: str, count: int) -> list[str]:
    """Return PDAL's names of the elements of an array; the name itself for a single value."""
    return [name] if count == 1 else [f"{name}{n}" for n in range(count)]


def _valid_name(title: str, count: int, taken: set[str]) -> tuple[str, bool]:
    """Return a name for a title that PDAL accepts and that is not `taken`; and if the title was.

    The name is added to `taken`.
    """
    name = re.sub(r"[^A-Za-z0-9_]", "_", title)
    name = name if re.match("[A-Za-z]", name) else f"{_PREFIX}{name}"
    clashes = not taken.isdisjoint(map(_plain, _elements(name, count)))
    stem = (f"{_PREFIX}{name}" if clashes else name)[:31]  # of 32 bytes, with the end of the text
    name, number = stem, 1
    while not taken.isdisjoint(map(_plain, _elements(name, count))):
        number += 1
        name = f"{stem[:26]}_{number}"
    taken.update(map(_plain, _elements(name, count)))
    return name, clashes or number > 1


def _described(header: LasHeader, data: bytes) -> list[tuple[str, bytes]]:
    """Return the title and the description of all extra bytes, those without one byte by byte.

    StageError where the descriptions do not fit the points.
    """
    room = header.point_bytes - POINT_BYTES[header.point_format]
    one_byte, entries, size = struct.pack("<HBB188x", 0, 1, 0), [], 0
    for entry in (data[at : at + ENTRY] for at in range(0, len(data) - ENTRY + 1, ENTRY)):
        kind, title = entry[2], _title(entry)
        if kind > 30:
            raise StageError(
                "the LAS file is damaged: its extra bytes are of no known type", found=kind
            )
        if kind:
            entries.append((title, entry))
            size += ((kind - 1) // 10 + 1) * _BYTES[(kind - 1) % 10]
        else:  # of which the options are the number
            entries += [(f"{title or _UNDESCRIBED}_{n}", one_byte) for n in range(entry[3])]
            size += entry[3]
    if size > room:
        raise StageError(
            "the LAS file is damaged: its points are shorter than the descriptions of their "
            "extra bytes",
            found=f"{size:,} bytes described, {room:,} there",
        )
    entries += [(f"{_UNDESCRIBED}_{n}", one_byte) for n in range(room - size)]
    if len(entries) > MOST_ENTRIES:
        raise StageError(
            "its points have more extra bytes than a record of LAS can describe",
            found=f"{room:,} bytes",
            cure="Write the file without them: pdal translate IN OUT",
        )
    return entries


def fields_of(header: LasHeader, data: bytes) -> tuple[list[ExtraField], bytes]:
    """Return the dimensions of a file's extra bytes, and descriptions of them that PDAL can take.

    `data` is the record of the file, empty where there is none. StageError where it does not fit
    the points.
    """
    taken, fields, entries = _taken(header.point_format), [], []
    for title, entry in _described(header, data):
        count, number = (entry[2] - 1) // 10 + 1, (entry[2] - 1) % 10
        name, clashes = _valid_name(title, count, taken)
        kind = "double" if entry[3] & 0x18 else _TYPES[number]  # with a scale or an offset
        for old, new in zip(_elements(title, count), _elements(name, count), strict=True):
            fields.append(ExtraField(old, new, kind, clashes))
        entries.append(entry if title == name and entry[4] else _renamed(entry, name))
    return fields, b"".join(entries)


def _renamed(entry: bytes, name: str) -> bytes:
    """Return a description with another name."""
    return entry[:4] + name.encode().ljust(32, b"\0") + entry[36:]


def overwritten(point_format: int, data: bytes) -> list[str]:
    """Return the titles in a record that are dimensions of the format: PDAL overwrites these."""
    entries = (data[at : at + ENTRY] for at in range(0, len(data) - ENTRY + 1, ENTRY))
    titles = [_title(entry) for entry in entries]
    return [title for title in titles if _plain(title) in _taken(point_format)]


def description(path: str | os.PathLike) -> bytes:
    """Return the first record that describes a file's extra bytes, empty without any.

    PDAL ignores later ones.
    """
    return next((data for r, data in records_of(path, b"LASF_Spec") if r.number == 4), b"")


def extra_fields(path: str | os.PathLike) -> list[ExtraField]:
    """Return the extra bytes of a LAS file as dimensions; empty where the file cannot be read."""
    try:
        header = read_header(path)
        if header is None or header.point_format >= len(POINT_BYTES):
            return []
        return fields_of(header, description(path))[0]
    except (OSError, ValueError, StageError):  # which check_readable reports
        return []


def extra_dimensions(path: str | os.PathLike) -> dict[str, str]:
    """Return the extra dimensions of a LAS file: name -> PDAL's type, ``double`` if scaled."""
    return {field.name: field.kind for field in extra_fields(path)}


def restore_titles(path: str | os.PathLike, sources: Iterable[str | os.PathLike]) -> None:
    """Give extra dimensions of an output, in place, the names back that they have in the sources.

    Names that are those of other dimensions stay changed.
    """
    fields = [field for source in sources for field in extra_fields(source)]
    titles = {
        field.name.encode(): field.title.encode()
        for field in fields
        if not field.clashes and field.title != field.name and len(field.title.encode()) <= 32
    }
    described = [r for r, _ in records_of(path, b"LASF_Spec") if r.number == 4] if titles else []
    with open(path, "r+b") as file:
        for record in described:
            for start in range(record.data, record.data + record.length - ENTRY + 1, ENTRY):
                file.seek(start + 4)
                if title := titles.get(file.read(32).split(b"\0")[0]):
                    file.seek(start + 4)
                    file.write(title.ljust(32, b"\0"))
