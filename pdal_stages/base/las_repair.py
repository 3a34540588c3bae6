"""LAS files made readable for PDAL and laspy on the way in, with the points as they are.

Extra bytes are described (LAS 1.4 R15, table 24) and named so that both take them: PDAL refuses
names with spaces or signs, lets a name like ``Z`` overwrite the coordinates, and leaves out bytes
of type 0 and bytes that no record describes. Texts lose their accents, since filters.python insists
on UTF-8 and laspy on ASCII.
"""

from __future__ import annotations

import io
import os
import re
import struct
import unicodedata
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import islice
from typing import BinaryIO

from .errors import StageError
from .las import (
    POINT_BYTES,
    POINTWISE,
    LasHeader,
    Record,
    chunk_table,
    laszip_record,
    number_type,
    read_header,
    records,
    records_of,
)

#: A file whose points begin later, in bytes, is read as it is: what lies before them is held in
#: memory, and the records of usual files take a few kB.
LARGEST_HEAD = 1 << 26
#: Texts of a header: offset and length in bytes.
_HEADER_TEXTS = ((26, 32), (58, 32))
#: Texts in the head of a record before the points.
_RECORD_TEXTS = ((2, 16), (22, 32))
#: Texts in the head of a record after the points.
_LATE_RECORD_TEXTS = ((2, 16), (28, 32))
#: Records that hold a spatial reference as text: well-known text, and the texts of GeoTIFF keys.
_REFERENCES = (2111, 2112, 34737)


class Corrected(io.RawIOBase):
    """A file with another beginning, and bytes replaced farther behind."""

    def __init__(self, path: str, head: bytes, shift: int, patches: dict[int, bytes]) -> None:
        self._file: BinaryIO = open(path, "rb")  # noqa: SIM115  closed with this object
        self._head, self._shift, self._patches, self._at = head, shift, patches, 0
        self._size = os.fstat(self._file.fileno()).st_size + shift

    def readable(self) -> bool:
        """Return True."""
        return True

    def seekable(self) -> bool:
        """Return True."""
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move to a position of the changed file; return it."""
        self._at = offset + (0, self._at, self._size)[whence]
        return self._at

    def tell(self) -> int:
        """Return the position."""
        return self._at

    def close(self) -> None:
        """Close the file underneath, too."""
        self._file.close()
        super().close()

    def readinto(self, buffer) -> int:
        """Read from the new beginning, or from the file with its patches; return the bytes read."""
        data = bytearray(self._head[self._at : self._at + len(buffer)])
        if not data:
            begin = self._at - self._shift  # in the file
            self._file.seek(begin)
            data = bytearray(self._file.read(len(buffer)))
            for place, patch in self._patches.items():
                for at in range(max(place, begin), min(place + len(patch), begin + len(data))):
                    data[at - begin] = patch[at - place]
        buffer[: len(data)] = data
        self._at += len(data)
        return len(data)


def corrected(path: str | os.PathLike, extra: bool = True) -> BinaryIO | None:
    """Open a LAS file as PDAL can read it; None where it can read the file itself.

    Parameters
    ----------
    path : path
        The file, which :func:`.las_check.check_readable` found to be whole.
    extra : bool
        Whether extra bytes are corrected: PDAL reads those of LAS 1.0 to 1.3 only where it is
        asked to.

    Raises
    ------
    StageError
        If the extra bytes of a COPC file would need more room.
    """
    path = os.fspath(path)
    header = read_header(path)
    if header is None or header.offset > LARGEST_HEAD or header.point_format >= len(POINT_BYTES):
        return None
    with open(path, "rb") as file:
        old = file.read(header.offset)
        listed = list(islice(records(file, header), header.records + header.records_after))
    before = [r for r in listed if not r.after and r.data + r.length <= header.offset]
    head, patches = _with_texts(path, old, before, [record for record in listed if record.after])
    struct.pack_into("<I", head, 100, len(before))  # PDAL reads points as records where it is wrong
    described_after = any(
        r.after and (r.user, r.number) == (b"LASF_Spec", 4) for r in listed
    )  # which PDAL reads, too
    if extra and not described_after:
        _describe_extra_bytes(head, header, before)
    shift = len(head) - len(old)
    if shift:
        if any(record.user == b"copc" for record in before):
            what = "the extra bytes of the COPC file are not all described"
            raise StageError(what, where=path, cure="Renamed to .laz and converted, it can be read")
        _move(head, header, shift)
        patches |= _moved_table(path, header, shift)
    if bytes(head) == old and not patches:
        return None
    return io.BufferedReader(Corrected(path, bytes(head), shift, patches), 1 << 20)


def _with_texts(
    path: str, old: bytes, before: list[Record], after: list[Record]
) -> tuple[bytearray, dict[int, bytes]]:
    """Return what stands before the points with plain texts; and plain texts behind, by place."""
    head, patches = bytearray(old), {}
    places = [*_HEADER_TEXTS, *((r.place + at, n) for r in before for at, n in _RECORD_TEXTS)]
    references = (r for r in before if r.user == b"LASF_Projection" and r.number in _REFERENCES)
    places += [(record.data, record.length) for record in references]
    for at, length in places:
        head[at : at + length] = _in_ascii(bytes(head[at : at + length]))
    with open(path, "rb") as file:
        for at, length in ((r.place + at, n) for r in after for at, n in _LATE_RECORD_TEXTS):
            file.seek(at)
            text = file.read(length)
            if (changed := _in_ascii(text)) != text:
                patches[at] = changed
    return head, patches


def _in_ascii(field: bytes) -> bytes:
    """Return a text without accents, of the same length, since GeoTIFF keys name places in it."""
    text = field.split(b"\0")[0]
    if field.isascii() or text.isascii():
        return field
    try:
        decoded = text.decode()
    except UnicodeDecodeError:
        decoded = text.decode("latin-1")  # as older programs write it
    plain = "".join(unicodedata.normalize("NFKD", character)[0] for character in decoded)
    return plain.encode("ascii", "replace").ljust(len(field), b"\0")


def _describe_extra_bytes(head: bytearray, header: LasHeader, before: list[Record]) -> None:
    """Describe and name all extra bytes so that PDAL takes them, in the head of the file."""
    descriptions = [r for r in before if (r.user, r.number) == (b"LASF_Spec", 4)]
    for record in descriptions[:1]:
        end = record.data + record.length
        _, described = fields_of(header, bytes(head[record.data : end]))
        head[record.data : end] = described
        struct.pack_into("<H", head, record.place + 20, len(described))
    if not descriptions and header.point_bytes > POINT_BYTES[header.point_format]:
        _, described = fields_of(header, b"")
        end = max((r.data + r.length for r in before), default=header.header_bytes)
        about = struct.pack("<H16sHH32s", 0, b"LASF_Spec", 4, len(described), b"Extra bytes")
        head[end:end] = about + described
        struct.pack_into("<I", head, 100, len(before) + 1)


def _move(head: bytearray, header: LasHeader, shift: int) -> None:
    """Correct the places in the header of what follows it."""
    struct.pack_into("<I", head, 96, header.offset + shift)
    if header.waveforms:
        struct.pack_into("<Q", head, 227, header.waveforms + shift)
    if header.records_after:
        struct.pack_into("<Q", head, 235, header.after + shift)


def _moved_table(path: str, header: LasHeader, shift: int) -> dict[int, bytes]:
    """Return the new place of the table of chunks, by where it stands; empty without a table."""
    with open(path, "rb") as file:
        if not header.compressed or laszip_record(file, header).startswith(POINTWISE):
            return {}
        at, table = chunk_table(file, header)
    return {at: struct.pack("<q", table + shift)}


#: Bytes of one description.
ENTRY = 192
#: Most descriptions that one record holds.
MOST_ENTRIES = 65_535 // ENTRY
#: PDAL's names of the types of extra bytes, by number, 1 to 10; 11 to 20 are pairs, 21 to 30
#: triples of these.
_INTEGERS = ("uint8", "int8", "uint16", "int16", "uint32", "int32", "uint64", "int64")
_TYPES = (*_INTEGERS, "float", "double")
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
            size += ((kind - 1) // 10 + 1) * number_type(_TYPES[(kind - 1) % 10]).itemsize
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
