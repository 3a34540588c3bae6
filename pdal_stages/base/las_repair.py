"""LAS files made readable for PDAL and laspy on the way in, with the points as they are.

Extra bytes are described and named so that both take them, and texts lose their accents, since
filters.python insists on UTF-8 and laspy on ASCII.
"""

from __future__ import annotations

import io
import os
import struct
import unicodedata
from collections.abc import Iterable
from itertools import islice
from typing import BinaryIO

from .errors import StageError
from .extra_bytes import fields_of
from .las import (
    POINT_BYTES,
    POINTWISE,
    LasHeader,
    Record,
    laszip_record,
    read_header,
    records,
)

#: A file whose points begin later is read as it is; its records are no usual ones.
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


def restore_texts(path: str | os.PathLike, sources: Iterable[str | os.PathLike]) -> None:
    """Give the header of an output its texts with accents back, in place, from the sources."""
    for source in sources:
        with open(source, "rb") as file, open(path, "r+b") as output:
            for at, length in _HEADER_TEXTS:
                file.seek(at)
                output.seek(at)
                text, now = file.read(length), output.read(length)
                if text != now and _in_ascii(text).split(b"\0")[0] == now.split(b"\0")[0]:
                    output.seek(at)
                    output.write(text)


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
        at = header.offset
        file.seek(at)
        (place,) = struct.unpack("<q", file.read(8))
        if place == -1:  # a stream that could not be rewound has it at its end
            at = file.seek(-8, os.SEEK_END)
            (place,) = struct.unpack("<q", file.read(8))
    return {at: struct.pack("<q", place + shift)}
