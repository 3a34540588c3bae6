"""Points of LAS and LAZ files as dimensions, under the names that PDAL gives them.

Records are read as bytes, with lazrs where they are compressed. Which bits of a record are which
dimension is told by tables (LAS 1.4 R15, tables 7 to 18 and 24). No name is a pattern, and bytes
that nobody describes stay what they are.
"""

from __future__ import annotations

import functools
import operator
import os
import struct
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .columns import LazyColumns
from .errors import DimensionError, StageError
from .las import POINT_BYTES, POINTWISE, LasHeader, laszip_record, read_header, records_of

#: Dimensions that have a scale and an offset in the header.
AXES = ("X", "Y", "Z")
#: Points read at a time: 30 to 70 MB as LAS stores them.
PART = 1_000_000
#: Bytes of a description of extra bytes.
ENTRY = 192
#: Most descriptions that one record holds.
MOST_ENTRIES = 65_535 // ENTRY
#: Types of extra bytes 1 to 10; 11 to 20 are pairs, 21 to 30 triples of these.
TYPES = tuple(map(np.dtype, ("u1", "i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f4", "<f8")))

#: Degrees of a step of the scan angle in formats 6 to 10.
_ANGLE_STEP = 0.006
#: Dimensions of points: name, what lazrs must decode of LAZ 1.4 for it beside X, Y and the returns,
#: and in formats 0 to 5 and in formats 6 to 10: byte, type, lowest bit, number of bits (0: all).
_ALWAYS: tuple[
    tuple[str, str, tuple[int, str, int, int] | None, tuple[int, str, int, int]], ...
] = (
    ("X", "", (0, "<i4", 0, 0), (0, "<i4", 0, 0)),
    ("Y", "", (4, "<i4", 0, 0), (4, "<i4", 0, 0)),
    ("Z", "Z", (8, "<i4", 0, 0), (8, "<i4", 0, 0)),
    ("Intensity", "INTENSITY", (12, "<u2", 0, 0), (12, "<u2", 0, 0)),
    ("ScanAngleRank", "SCAN_ANGLE", (16, "i1", 0, 0), (18, "<i2", 0, 0)),
    ("UserData", "USER_DATA", (17, "u1", 0, 0), (17, "u1", 0, 0)),
    ("PointSourceId", "POINT_SOURCE_ID", (18, "<u2", 0, 0), (20, "<u2", 0, 0)),
    ("ReturnNumber", "", (14, "u1", 0, 3), (14, "u1", 0, 4)),
    ("NumberOfReturns", "", (14, "u1", 3, 3), (14, "u1", 4, 4)),
    ("ClassFlags", "FLAGS", None, (15, "u1", 0, 4)),
    ("Synthetic", "FLAGS", (15, "u1", 5, 1), (15, "u1", 0, 1)),
    ("KeyPoint", "FLAGS", (15, "u1", 6, 1), (15, "u1", 1, 1)),
    ("Withheld", "FLAGS", (15, "u1", 7, 1), (15, "u1", 2, 1)),
    ("Overlap", "FLAGS", None, (15, "u1", 3, 1)),
    ("ScanChannel", "FLAGS", None, (15, "u1", 4, 2)),
    ("ScanDirectionFlag", "FLAGS", (14, "u1", 6, 1), (15, "u1", 6, 1)),
    ("EdgeOfFlightLine", "FLAGS", (14, "u1", 7, 1), (15, "u1", 7, 1)),
    ("Classification", "CLASSIFICATION", (15, "u1", 0, 5), (16, "u1", 0, 8)),
)
#: Those of some formats: name, what lazrs must decode, type, and the byte by point format.
_OF_FORMATS = (
    ("GpsTime", "GPS_TIME", "<f8", {1: 20, 3: 20, 4: 20, 5: 20, **dict.fromkeys(range(6, 11), 22)}),
    ("Red", "RGB", "<u2", {2: 20, 3: 28, 5: 28, 7: 30, 8: 30, 10: 30}),
    ("Green", "RGB", "<u2", {2: 22, 3: 30, 5: 30, 7: 32, 8: 32, 10: 32}),
    ("Blue", "RGB", "<u2", {2: 24, 3: 32, 5: 32, 7: 34, 8: 34, 10: 34}),
    ("Infrared", "NIR", "<u2", {8: 36, 10: 36}),
)


class Field(NamedTuple):
    """A dimension in a record: bytes, or bits of a byte, and what their number stands for."""

    name: str  #: an element of an array of extra bytes has its number behind it
    at: int  #: byte of the record at which it begins
    type: np.dtype  #: of the bytes
    layer: str  #: what lazrs must decode of LAZ 1.4; empty for what it always does
    scale: float | None = None  #: None where the number is the value
    shift: float = 0.0
    low: int = 0  #: the lowest bit
    bits: int = 0  #: number of bits; 0 for whole bytes

    @property
    def kind(self) -> np.dtype:
        """Return the type of the values."""
        if self.scale is None:
            return self.type.newbyteorder("=")
        return np.dtype(np.float32 if self.name == "ScanAngleRank" else float)

    def numbers(self, records: NDArray) -> NDArray:
        """Return the numbers (n,) that records (n,) hold, as a view of their bytes."""
        return records.getfield(self.type, self.at)

    def scaled(self, numbers: NDArray) -> NDArray:
        """Return the values (n,) of numbers (n,)."""
        if self.scale is None:
            return numbers.astype(self.kind)
        return (numbers * self.scale + self.shift).astype(self.kind, copy=False)

    def read(self, records: NDArray) -> NDArray:
        """Return the values (n,) that records (n,) hold."""
        numbers = self.numbers(records)
        if self.bits:
            return numbers >> np.uint8(self.low) & np.uint8((1 << self.bits) - 1)
        return self.scaled(numbers)

    def write(self, records: NDArray, values: NDArray) -> None:
        """Set the values (n,) of records (n,); one that does not fit is cut off."""
        numbers = self.numbers(records)
        if self.scale is not None:
            values = np.rint((values - self.shift) / self.scale)
        if self.bits:
            mask = np.uint8(((1 << self.bits) - 1) << self.low)
            values = np.asarray(values).astype(np.uint8) << np.uint8(self.low) & mask
            values = numbers & ~mask | values
        numbers[...] = values


def decode_text(field: bytes) -> str:
    """Return a text of a record, in UTF-8 or, as older programs write it, in Latin-1."""
    text = field.split(b"\0")[0]
    try:
        return text.decode()
    except UnicodeDecodeError:
        return text.decode("latin-1")


def size_of_entry(entry: bytes) -> int:
    """Return how many bytes of a point a description is about; StageError for no known type."""
    kind = entry[2]
    if kind > 30:
        what = "the LAS file is damaged: its extra bytes are of no known type"
        raise StageError(what, found=kind)
    # Of bytes without a type the options are the number.
    return ((kind - 1) // 10 + 1) * TYPES[(kind - 1) % 10].itemsize if kind else entry[3]


def entries_of(data: bytes) -> list[bytes]:
    """Return the descriptions in a record of extra bytes."""
    return [data[at : at + ENTRY] for at in range(0, len(data) - ENTRY + 1, ENTRY)]


def extra_fields(header: LasHeader, data: bytes) -> list[Field]:
    """Return the dimensions that descriptions of extra bytes name.

    Raises
    ------
    StageError
        Where they do not fit the points.
    """
    fields, at = [], header.point_bytes - header.extra_bytes
    for entry in entries_of(data):
        options, name = entry[3], decode_text(entry[4:36])
        kind, size = TYPES[(entry[2] - 1) % 10], size_of_entry(entry)
        count = size // kind.itemsize if entry[2] else 0
        numbers = struct.unpack_from("<6d", entry, 112)  # three scales, three offsets
        for n in range(count):
            scale, shift = (
                numbers[n] if options & 8 else 1.0,
                numbers[3 + n] if options & 16 else 0.0,
            )
            title, begin = name if count == 1 else f"{name}{n}", at + n * kind.itemsize
            scaling = () if (scale, shift) == (1.0, 0.0) else (scale, shift)
            fields.append(Field(title, begin, kind, "ALL_EXTRA_BYTES", *scaling))
        at += size
    if at > header.point_bytes:
        room = header.extra_bytes
        raise StageError(
            "the LAS file is damaged: its points are shorter than the descriptions of their "
            "extra bytes",
            found=f"{at - header.point_bytes + room:,} bytes described, {room:,} there",
        )
    return fields


def description(path: str | os.PathLike) -> bytes:
    """Return the descriptions of a file's extra bytes, of all its records; empty without any."""
    return b"".join(
        b"".join(entries_of(data)) for r, data in records_of(path, b"LASF_Spec") if r.number == 4
    )


def describe(name: str, kind: np.dtype | int, options: int = 0) -> bytes:
    """Return a description of extra bytes; `kind` is a type, or its number in LAS."""
    encoded = name.encode()
    if len(encoded) > 32:
        raise DimensionError("the name of a dimension is too long for LAS", found=name)
    number = kind if isinstance(kind, int) else TYPES.index(kind.newbyteorder("<")) + 1
    return struct.pack("<HBB32s156x", 0, number, options, encoded)


@dataclass(frozen=True)
class Layout:
    """The layout of a file's records: where each dimension of its points stands."""

    header: LasHeader
    extra: tuple[Field, ...] = ()
    described: bytes = b""  #: the descriptions that `extra` comes from

    @classmethod
    def of_file(cls, path: str | os.PathLike, described: bytes | None = None) -> Layout:
        """Return the layout of a file; StageError where it has none.

        `described` are descriptions of extra bytes (:func:`describe`) in place of the file's.
        """
        header = read_header(path)
        if header is None:
            raise StageError("the input is not a LAS or LAZ file", where=str(path))
        if header.point_format >= len(POINT_BYTES):
            seen = f"point format {header.point_format}"
            raise StageError("its point format is not known", where=str(path), found=seen)
        data = description(path) if described is None else described
        return cls(header, tuple(extra_fields(header, data)), data)

    @property
    def dtype(self) -> np.dtype:
        """Return the type of a record, whose bytes :attr:`fields` tells."""
        return np.dtype((np.void, self.header.point_bytes))

    @property
    def is_old(self) -> bool:
        """Return whether flags share a byte with the class, as in point formats 0 to 5."""
        return self.header.point_format <= 5

    @cached_property
    def fields(self) -> dict[str, Field]:
        """Return all dimensions by name; extra bytes named like one of the format are none."""
        header = self.header
        axes = zip(header.scales, header.offsets, strict=True)
        scales: dict[str, tuple[float, float]] = dict(zip(AXES, axes, strict=True))
        scales["ScanAngleRank"] = 1.0 if self.is_old else _ANGLE_STEP, 0.0
        places = [(name, layer, old if self.is_old else new) for name, layer, old, new in _ALWAYS]
        for name, layer, kind, by_format in _OF_FORMATS:
            at = by_format.get(header.point_format)
            places.append((name, layer, (at, kind, 0, 0) if at else None))
        fields: dict[str, Field] = {}
        for name, layer, place in places:
            if place is not None:
                at, kind, low, bits = place
                scale, shift = scales.get(name, (None, 0.0))
                fields[name] = Field(name, at, np.dtype(kind), layer, scale, shift, low, bits)
        return fields | {each.name: each for each in self.extra if each.name not in {"", *fields}}

    @cached_property
    def extra_by_name(self) -> dict[str, Field]:
        """Return extra dimensions by name, but those that are named like one of the format."""
        held = {each.name: each for each in self.extra}
        return {name: each for name, each in self.fields.items() if held.get(name) is each}


def layout_there(path: str | os.PathLike) -> Layout | None:
    """Return the layout of a LAS file; None where it cannot be read, which reading reports."""
    try:
        return Layout.of_file(path)
    except (OSError, ValueError, IndexError, StageError):
        return None


def bytes_of(records: NDArray) -> NDArray[np.uint8]:
    """Return the bytes (n, bytes) of records (n,), as a view."""
    return records.view(np.uint8).reshape(len(records), records.dtype.itemsize)


# ---- reading -------------------------------------------------------------------------------------


def read_records(
    path: str | os.PathLike,
    layout: Layout,
    start: int = 0,
    end: int | None = None,
    most: int = PART,
    only: Sequence[str] | None = None,
) -> Iterator[NDArray]:
    """Yield the records of a LAS or LAZ file from one number to another.

    Parameters
    ----------
    path : path
    layout : Layout
        Of the file.
    start, end : int
        Numbers of the first point and of the one after the last; by default all are read.
    most : int
        Records of each part.
    only : sequence of str, optional
        Dimensions that are needed: LAZ 1.4 compresses them separately, so skipping the others
        saves time. Those are zero then.

    Raises
    ------
    StageError
        If the file is cut short or cannot be decoded.
    """
    at, what = start, "the input cannot be read"
    end = layout.header.count if end is None else end
    try:
        with open(path, "rb") as file:
            what = "the input is damaged"
            for part in _parts(file, layout, start, end, most, only):
                at += len(part)
                yield part
    except (GeneratorExit, KeyboardInterrupt, MemoryError):
        raise
    except BaseException as error:  # the decompressor's panics are no Exceptions
        reason: object = f"{type(error).__name__} at point {at:,}: {error}"
        reason = error if isinstance(error, OSError) else reason
        raise StageError(what, where=str(path), found=reason) from None
    if at < end:
        seen = f"{at:,} of {end:,} points"
        raise StageError("the input is cut short", where=str(path), found=seen)


def _parts(
    file: BinaryIO, layout: Layout, start: int, end: int, most: int, only: Sequence[str] | None
) -> Iterator[NDArray]:
    """Yield the records of an open file."""
    header, dtype = layout.header, layout.dtype
    if not header.compressed:
        file.seek(header.offset + start * dtype.itemsize)
        while start < end and len(part := np.fromfile(file, dtype, min(most, end - start))):
            start += len(part)
            yield part
        return
    import lazrs

    coding = laszip_record(file.name)
    layers = {layout.fields[name].layer for name in only or () if name in layout.fields}
    layers = {"ALL"} if only is None else {"XY_RETURNS_CHANNEL", *layers} - {""}
    bits = [getattr(lazrs, f"SELECTIVE_DECOMPRESS_{layer}") for layer in layers]
    selection = lazrs.DecompressionSelection(functools.reduce(operator.or_, bits))
    if lazrs.LazVlr(coding).item_size() != dtype.itemsize:
        raise ValueError(f"points of {lazrs.LazVlr(coding).item_size()} bytes in compressed form")
    alone = coding.startswith(POINTWISE)  # points compressed one by one
    kind = lazrs.LasZipDecompressor if alone else lazrs.ParLasZipDecompressor
    file.seek(header.offset)
    decoder = kind(file, coding, selection)
    if start:
        decoder.seek(start)
    while start < end:
        part = np.empty(min(most, end - start), dtype)
        decoder.decompress_many(part.view(np.uint8))
        start += len(part)
        yield part


#: Dimensions that are read together, since most stages want them.
USUAL = ("X", "Y", "Z", "Classification", "ReturnNumber", "NumberOfReturns", "Withheld", "Overlap")


@dataclass(eq=False)
class LasColumns(LazyColumns):
    """The dimensions of files or records, one after the other, by name; 0 where a part has none.

    Each is read when it is asked for and then kept. Coordinates of a single part are kept as its
    whole numbers, in half the memory.
    """

    parts: Sequence[tuple[Layout, str | NDArray]]  #: files by their paths, or records (n,)
    _read: dict[str, NDArray] = field(default_factory=dict)

    @cached_property
    def names(self) -> Collection[str]:  # type: ignore[override]
        """Return the names of the dimensions, in the order of the parts."""
        return dict.fromkeys(name for layout, _ in self.parts for name in layout.fields).keys()

    def __getitem__(self, name: str) -> NDArray:
        """Return a dimension (n,)."""
        if name not in self._read:
            if name not in self:
                raise KeyError(name)
            usual = name in USUAL and not self._read.keys() & {*USUAL}
            self.load([each for each in (USUAL if usual else (name,)) if each in self])
        values = self._read[name]
        return self.parts[0][0].fields[name].scaled(values) if self._is_whole(name) else values

    def _is_whole(self, name: str) -> bool:
        return name in AXES and len(self.parts) == 1

    def load(self, names: Sequence[str]) -> None:
        """Read dimensions, all in one pass."""
        counts = [len(s) if isinstance(s, np.ndarray) else at.header.count for at, s in self.parts]
        new: dict[str, NDArray] = {}
        for name in names:
            fields = [layout.fields[name] for layout, _ in self.parts if name in layout.fields]
            kinds = [each.type if self._is_whole(name) else each.kind for each in fields]
            new[name] = np.zeros(sum(counts), np.result_type(*kinds))
        at = 0
        for layout, source in self.parts:
            there = [name for name in names if name in layout.fields]
            if isinstance(source, str):
                parts = read_records(source, layout, only=there)
            else:
                parts = iter([source])
            for records in parts:
                rows = slice(at, at + len(records))
                at = rows.stop
                for name in there:
                    read = Field.numbers if self._is_whole(name) else Field.read
                    new[name][rows] = read(layout.fields[name], records)
        self._read |= new


def columns_of_files(paths: Sequence[str]) -> LasColumns:
    """Return the dimensions of all points of files, whose records are kept in memory."""
    parts: list[tuple[Layout, str | NDArray]] = []
    for path in paths:
        layout = Layout.of_file(path)
        records = [np.empty(0, layout.dtype), *read_records(path, layout)]
        parts.append((layout, np.concatenate(records)))
    return LasColumns(parts)
