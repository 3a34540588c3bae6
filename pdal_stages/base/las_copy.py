"""Copies of LAS and LAZ files: each byte is that of the input, but for what :data:`CHANGES` lists.

What stands before and behind the points is copied as bytes, and so are their records. Nothing is
decoded and encoded again but the compression.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from .asprs import LEGACY_LIMIT
from .errors import DimensionError, OptionError, StageError
from .las import PROJECTION, Record, end_of_points, records
from .las_points import (
    MOST_ENTRIES,
    Layout,
    bytes_of,
    describe,
    entries_of,
    size_of_entry,
)

#: All that a copy changes. docs/robustness.md shows this list, and a test compares files by it.
CHANGES = (
    "the class of points that were classified; the flags in the same byte (formats 0 to 5) stay",
    "our dimensions: appended to the record as extra bytes; where the input holds one of exactly "
    "that name, its values",
    "their descriptions in the record of extra bytes, in one record if there were several, and of "
    "bytes before them that nobody had described",
    "the compression: another suffix; its record; records of COPC are left out",
    "the reference system, where --readers.las.override_srs or default_srs names one",
    "what follows in the header: length of a record, number of records, offsets",
)
_DESCRIPTIONS = (b"LASF_Spec", 4)
_COMPRESSION = (b"laszip encoded", 22204)
#: Bit of the header's global encoding that says that the reference system is well-known text.
_WKT_BIT = 16


def _kind(record: Record) -> tuple[bytes, int]:
    return record.user, record.number


def _is_copied(record: Record, replaces_projection: bool) -> bool:
    return record.user != b"copc" and not (replaces_projection and record.user == PROJECTION)


class LasCopy:
    """A copy of a file: what it will hold is settled first, then it is written.

    Parameters
    ----------
    source : str
        The file that is copied.
    layout : Layout
        Of that file.
    compressed : bool
        Whether the copy is LAZ.
    added : mapping of str to dtype
        Dimensions that are written beside classes, in this order.
    projection : sequence of (int, bytes), optional
        Records of the reference system, by number, in place of those of the file.

    Raises
    ------
    StageError
        If a dimension or its description does not fit.
    """

    def __init__(
        self,
        source: str,
        layout: Layout,
        compressed: bool,
        added: Mapping[str, np.dtype],
        projection: Sequence[tuple[int, bytes]] | None = None,
    ) -> None:
        self.layout, self.source = layout, source
        self.replaced = {
            name: layout.extra_by_name[name] for name in added if name in layout.extra_by_name
        }
        refuse_narrow(source, layout, added)
        self.added = {n: np.dtype(kind) for n, kind in added.items() if n not in self.replaced}
        self.at: dict[str, int] = {}  #: byte of a record at which each begins
        self.point_bytes = layout.header.point_bytes
        for name, kind in self.added.items():
            self.at[name] = self.point_bytes
            self.point_bytes += kind.itemsize
        self.compressed = compressed
        self.projection = projection
        self.count = 0
        header = layout.header
        with open(source, "rb") as file:
            self._head = file.read(header.offset)
            listed = list(islice(records(file, header), header.records + header.records_after))
        self._before = [r for r in listed if not r.after and r.data + r.length <= header.offset]
        self._behind = [record for record in listed if record.after]
        described = (r for r in (*self._before, *self._behind) if _kind(r) == _DESCRIPTIONS)
        #: The record that gets all descriptions; None where one must be made.
        self._holder = next(described, None)
        self._entries = self._described() if self.added else []
        self._coding: Any = None
        self._file: Any = None
        self._encoder: Any = None

    # ---- what stands around the points -----------------------------------------------------------

    @contextlib.contextmanager
    def writing_to(self, target: Path) -> Iterator[LasCopy]:
        """Write what stands before the points; on leaving, unless by an exception, what follows.

        Inside, :meth:`write` all records in their order.
        """
        with open(target, "w+b") as self._file:
            self._file.write(self._assembled_head())
            self._encoder = self._make_encoder() if self.compressed else None
            yield self
            self._finish()

    def _described(self) -> list[bytes]:
        """Return descriptions of all extra bytes of the copy."""
        entries = entries_of(self.layout.described)
        room = self.layout.header.point_bytes - _plain_bytes(self.layout)
        missing = room - sum(map(size_of_entry, entries))
        most = MOST_ENTRIES - len(entries) - len(self.added)
        # Bytes that nobody describes: one by one, or three by three where they are many.
        while missing > 0:
            triple = missing >= 3 and missing > most
            entries.append(describe(f"undescribed{missing}", 21 if triple else 1))
            missing, most = missing - (3 if triple else 1), most - 1
        entries += [describe(name, kind) for name, kind in self.added.items()]
        if len(entries) > MOST_ENTRIES:
            raise DimensionError(
                f"a LAS file describes at most {MOST_ENTRIES} extra dimensions",
                where=self.source,
                found=f"{len(entries):,} with those that are to be written",
                cure="Write fewer with --dimensions",
            )
        return entries

    def _changed(self, record: Record, bytes_: bytes) -> bytes | None:
        """Return a record of the copy, with its head; None where it has none."""
        if not _is_copied(record, self.projection is not None):
            return None
        kind = _kind(record)
        if kind == _COMPRESSION:
            return _with_data(record, bytes_, self._compression()) if self.compressed else None
        if kind == _DESCRIPTIONS and self._entries:
            if record != self._holder:
                return None
            return _with_data(record, bytes_, b"".join(self._entries))
        return bytes_

    def _compression(self) -> bytes:
        """Return the data of the record on compression."""
        import lazrs

        header = self.layout.header
        room = self.point_bytes - _plain_bytes(self.layout)
        self._coding = lazrs.LazVlr.new_for_compression(header.point_format, room)
        return self._coding.record_data()

    def _assembled_head(self) -> bytes:
        """Return what stands before the points in the copy."""
        header, old, fits = self.layout.header, self._head, self._before
        end = max((r.data + r.length for r in fits), default=header.header_bytes)
        kept = [self._changed(r, old[r.place : r.data + r.length]) for r in fits]
        parts = [part for part in kept if part is not None]
        if self._entries and self._holder is None:
            parts.append(_record(*_DESCRIPTIONS, b"Extra Bytes Record", b"".join(self._entries)))
        for number, data in self.projection or ():
            parts.append(_record(PROJECTION, number, b"", data))
        if self.compressed and self._coding is None:
            parts.append(_record(*_COMPRESSION, b"https://laszip.org", self._compression()))
        if large := next((part for part in parts if len(part) > 54 + 65_535), None):
            raise StageError("a record of the copy is too long", found=f"{len(large):,} bytes")
        head = bytearray(old[: header.header_bytes] + b"".join(parts) + old[end:])
        struct.pack_into("<I", head, 96, len(head))
        struct.pack_into("<I", head, 100, header.records + len(parts) - len(fits))
        head[104] = header.point_format | (0x80 if self.compressed else 0)
        struct.pack_into("<H", head, 105, self.point_bytes)
        if self.projection:
            text = any(number == 2112 for number, _ in self.projection)
            head[6] = head[6] & ~_WKT_BIT | (_WKT_BIT if text else 0)
        return bytes(head)

    def _make_encoder(self) -> Any:
        import lazrs

        return lazrs.ParLasZipCompressor(self._file, self._coding)

    # ---- points ----------------------------------------------------------------------------------

    def write(self, part: NDArray, values: Mapping[str, NDArray]) -> None:
        """Write records (n,) of the input with new values (n,) of Classification and others."""
        part = part.copy()
        if "Classification" in values:
            self._check_codes(values["Classification"])
        for name, column in values.items():
            if name in self.layout.names and name not in self.replaced:
                self.layout.put(part, name, column)
        old = bytes_of(part)
        new = np.zeros((len(part), self.point_bytes), np.uint8)
        new[:, : old.shape[1]] = old
        for name, column in values.items():
            if name in self.replaced:
                field = self.replaced[name]
                at = old.shape[1] - self.layout.dtype["extra"].itemsize + field.at
                new[:, at : at + field.type.itemsize] = _as_bytes(
                    held_in(column, field.type, name, self.source), field.type
                )
            elif name in self.added:
                kind = self.added[name]
                new[:, self.at[name] : self.at[name] + kind.itemsize] = _as_bytes(column, kind)
        if self._encoder is None:
            self._file.write(new)
        elif len(new):
            with _compressing():
                self._encoder.compress_many(new.reshape(-1))
        self.count += len(new)

    def _check_codes(self, codes: NDArray) -> None:
        """Refuse classes that have no room beside the flags of formats 0 to 5."""
        largest = codes.max(initial=0)
        if self.layout.is_old and largest > LEGACY_LIMIT:
            raise OptionError(
                f"class codes above {LEGACY_LIMIT} do not fit the file, which is of LAS 1.0-1.3",
                where=self.source,
                found=f"code {largest}",
                cure="Convert it to LAS 1.4 first (minor_version 4, dataformat_id 6)",
            )

    # ---- the end ---------------------------------------------------------------------------------

    def _finish(self) -> None:
        header, file = self.layout.header, self._file
        if self._encoder is not None:
            with _compressing():
                self._encoder.done()
            self._encoder = None  # which holds the file
        file.seek(0, 2)
        if self.count != header.count:
            file.seek(107)
            file.write(struct.pack("<I", self.count if self.layout.is_old else 0))
            if header.minor >= 4:
                file.seek(247)
                file.write(struct.pack("<Q", self.count))
            file.seek(0, 2)
        with open(self.source, "rb") as source:
            places = self._copy_tail(source)
        if header.waveforms:
            file.seek(227)
            file.write(struct.pack("<Q", places.get(header.waveforms, 0)))
        if header.records_after:
            kept = [r for r in self._behind if places.get(r.place)]
            file.seek(235)
            gone = len(self._behind) - len(kept)
            first = places[kept[0].place] if kept else 0
            file.write(struct.pack("<QI", first, header.records_after - gone))
        file.flush()

    def _copy_tail(self, source: BinaryIO) -> dict[int, int]:
        """Copy what stands behind the points; return places in the copy by those in the input."""
        header, out = self.layout.header, self._file
        size = source.seek(0, 2)
        at = end_of_points(header, size)
        if not header.compressed:
            at = min(at, header.offset + header.count * header.point_bytes)
        places: dict[int, int] = {}
        for record in self._behind:
            end = record.data + record.length
            if record.place < at or end > size:
                break
            self._copy_bytes(source, at, record.place, places)
            head = _bytes(source, record.place, record.data)
            changes = _kind(record) == _DESCRIPTIONS and bool(self._entries)
            data = _data(source, record) if changes else b""
            new = self._changed(record, head + data)
            if new is not None:
                places[record.place] = out.tell()
                out.write(new)
                if not changes:
                    self._copy_bytes(source, record.data, end, places)
            at = end
        self._copy_bytes(source, at, size, places)
        return places

    def _copy_bytes(self, source: BinaryIO, start: int, end: int, places: dict[int, int]) -> None:
        """Copy bytes of the input, and note where waveforms come to stand."""
        shift = self._file.tell() - start
        if start <= (waveforms := self.layout.header.waveforms) < end:
            places[waveforms] = waveforms + shift
        source.seek(start)
        left = end - start
        while left > 0 and (data := source.read(min(left, 1 << 22))):
            self._file.write(data)
            left -= len(data)


@contextlib.contextmanager
def _compressing() -> Iterator[None]:
    """Report the encoder's errors, which write to the file, as those of the output."""
    import lazrs

    try:
        yield
    except lazrs.LazrsError as error:
        what, cure = "the output file could not be written", "Make room on the disk"
        raise StageError(what, found=str(error), cure=cure) from None


def refuse_narrow(source: str, layout: Layout, added: Mapping[str, np.dtype]) -> None:
    """Refuse dimensions of the input whose type cannot hold the values that they would get."""
    for name, kind in added.items():
        field = layout.extra_by_name.get(name)
        if field is None:
            continue
        fits = field.type.kind == np.dtype(kind).kind == "f" or np.can_cast(kind, field.type)
        if field.is_scaled or not fits:
            raise _narrow(source, name, f"{field.type.name}{', scaled' * field.is_scaled}")


def held_in(values: NDArray, kind: np.dtype, name: str, source: str) -> NDArray:
    """Return values (n,) in a type that holds them exactly; refused by name where it does not."""
    out = values.astype(kind)
    if not np.array_equal(out.astype(values.dtype), values, equal_nan=True):
        raise _narrow(source, name, kind.name)
    return out


def _narrow(source: str, name: str, kind: str) -> DimensionError:
    return DimensionError(
        f"the input has a dimension '{name}' whose type does not hold the values it would get",
        where=source,
        found=kind,
        cure=f"Leave '{name}' out of --dimensions, or rename it in the input",
    )


def _as_bytes(values: NDArray, kind: np.dtype) -> NDArray[np.uint8]:
    """Return values (n,) as the bytes (n, size) of a little-endian type."""
    plain = np.ascontiguousarray(values, kind.newbyteorder("<"))
    return plain.view(np.uint8).reshape(len(plain), kind.itemsize)


def _plain_bytes(layout: Layout) -> int:
    extra = layout.dtype["extra"].itemsize if "extra" in (layout.dtype.names or ()) else 0
    return layout.header.point_bytes - extra


def _record(user: bytes, number: int, title: bytes, data: bytes) -> bytes:
    """Return a record before the points."""
    return struct.pack("<H16sHH32s", 0, user, number, len(data) & 0xFFFF, title) + data


def _with_data(record: Record, bytes_: bytes, data: bytes) -> bytes:
    """Return a record with other data."""
    size = record.data - record.place
    length = struct.pack("<Q", len(data))[: 8 if record.after else 2]
    return bytes_[:20] + length + bytes_[20 + len(length) : size] + data


def _data(source: BinaryIO, record: Record) -> bytes:
    """Return the data of a record."""
    return _bytes(source, record.data, record.data + record.length)


def _bytes(source: BinaryIO, start: int, end: int) -> bytes:
    source.seek(start)
    return source.read(end - start)
