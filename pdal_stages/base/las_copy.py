"""Copies of LAS and LAZ files: each byte is that of the input, but for what :data:`CHANGES` lists.

What stands before and behind the points is copied as bytes, and so are their records. Nothing is
decoded and encoded again but the compression.
"""

from __future__ import annotations

import contextlib
import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .asprs import LEGACY_LIMIT
from .errors import DimensionError, OptionError, StageError
from .las import PROJECTION, Record, end_of_points, records
from .las_points import (
    MOST_ENTRIES,
    Field,
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
        refuse_narrow(source, layout, added)
        self.layout, self.source = layout, source
        self.replaced = [name for name in added if name in layout.extra_by_name]
        self.fields, self.added = layout.fields.copy(), []
        header = layout.header
        self.point_bytes = header.point_bytes
        for name in (name for name in added if name not in self.replaced):
            kind = np.dtype(added[name]).newbyteorder("<")
            self.fields[name] = Field(name, self.point_bytes, kind, "")
            self.added.append(name)
            self.point_bytes += kind.itemsize
        self.compressed = compressed
        self.projection = projection
        self.count = 0
        with open(source, "rb") as file:
            self._head = file.read(header.offset)
            listed = list(islice(records(file, header), header.records + header.records_after))
        self._before = [r for r in listed if not r.after and r.data + r.length <= header.offset]
        self._behind = [record for record in listed if record.after]
        described = (r for r in (*self._before, *self._behind) if r.kind == _DESCRIPTIONS)
        #: The record that gets all descriptions; None where one must be made.
        self._holder = next(described, None)
        self._descriptions = b"".join(self._described()) if self.added else b""
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
            if self.compressed:
                import lazrs

                self._encoder = lazrs.ParLasZipCompressor(self._file, self._coding)
            yield self
            self._finish()

    @cached_property
    def _coding(self) -> Any:
        import lazrs

        header = self.layout.header
        room = self.point_bytes - header.point_bytes + header.extra_bytes
        return lazrs.LazVlr.new_for_compression(header.point_format, room)

    def _described(self) -> list[bytes]:
        """Return descriptions of all extra bytes of the copy."""
        entries = entries_of(self.layout.described)
        missing = self.layout.header.extra_bytes - sum(map(size_of_entry, entries))
        most = MOST_ENTRIES - len(entries) - len(self.added)
        # Bytes that nobody describes: one by one, or three by three where they are many.
        while missing > 0:
            triple = missing >= 3 and missing > most
            entries.append(describe(f"undescribed{missing}", 21 if triple else 1))
            missing, most = missing - (3 if triple else 1), most - 1
        entries += [describe(name, self.fields[name].type) for name in self.added]
        if len(entries) > MOST_ENTRIES:
            raise DimensionError(
                f"a LAS file describes at most {MOST_ENTRIES} extra dimensions",
                where=self.source,
                found=f"{len(entries):,} with those that are to be written",
                cure="Write fewer with --dimensions",
            )
        return entries

    def _drops(self, record: Record) -> bool:
        """Return whether the copy has none of a record."""
        if record.kind == _DESCRIPTIONS:
            return bool(self._descriptions) and record != self._holder
        if record.kind == _COMPRESSION:
            return not self.compressed
        return record.user == b"copc" or (self.projection is not None and record.user == PROJECTION)

    def _edits(self, listed: Sequence[Record]) -> Iterator[tuple[int, int, bytes]]:
        """Yield from where to where the input's bytes of records are others in the copy, and which.

        They are in the order of the file.
        """
        for record in listed:
            if self._drops(record):
                yield record.place, record.data + record.length, b""
            elif data := self._changed(record):
                length = struct.pack("<Q", len(data))[: 8 if record.after else 2]
                yield record.place + 20, record.place + 20 + len(length), length
                yield record.data, record.data + record.length, data

    def _changed(self, record: Record) -> bytes:
        """Return the data of a record that changes; empty for others."""
        if record.kind == _COMPRESSION:
            return self._coding.record_data()
        return self._descriptions if record.kind == _DESCRIPTIONS else b""

    def _assembled_head(self) -> bytes:
        """Return what stands before the points in the copy."""
        header, head = self.layout.header, bytearray(self._head)
        parts = [_record(PROJECTION, number, b"", data) for number, data in self.projection or ()]
        if self._descriptions and self._holder is None:
            parts.insert(0, _record(*_DESCRIPTIONS, b"Extra Bytes Record", self._descriptions))
        if self.compressed and all(record.kind != _COMPRESSION for record in self._before):
            data = self._coding.record_data()
            parts.append(_record(*_COMPRESSION, b"https://laszip.org", data))
        end = max((r.data + r.length for r in self._before), default=header.header_bytes)
        head[end:end] = b"".join(parts)
        for start, stop, data in reversed([*self._edits(self._before)]):
            head[start:stop] = data
        count = header.records + len(parts) - sum(map(self._drops, self._before))
        struct.pack_into("<II", head, 96, len(head), count)
        head[104] = header.point_format | (0x80 if self.compressed else 0)
        struct.pack_into("<H", head, 105, self.point_bytes)
        if self.projection:
            text = any(number == 2112 for number, _ in self.projection)
            head[6] = head[6] & ~_WKT_BIT | (_WKT_BIT if text else 0)
        return bytes(head)

    # ---- points ----------------------------------------------------------------------------------

    def write(self, part: NDArray, values: Mapping[str, NDArray]) -> None:
        """Write records (n,) of the input with new values (n,) of Classification and others."""
        new = np.zeros(len(part), np.dtype((np.void, self.point_bytes)))
        raw = bytes_of(new)
        raw[:, : part.itemsize] = bytes_of(part)
        for name in [name for name in values if name in self.fields]:
            field, column = self.fields[name], values[name]
            if name == "Classification":
                self._check_codes(column)
            if name in self.replaced:
                column = held_in(column, field.type, name, self.source)
            field.write(new, column)
        if self._encoder is None:
            self._file.write(raw)
        elif len(raw):
            with _compressing():
                self._encoder.compress_many(raw.reshape(-1))
        self.count += len(raw)

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
        file.seek(0, os.SEEK_END)
        shifts = self._write_tail()
        if self.count != header.count:
            self._patch(107, "<I", self.count if self.layout.is_old else 0)
            if header.minor >= 4:
                self._patch(247, "<Q", self.count)
        if header.waveforms:
            self._patch(227, "<Q", _moved(header.waveforms, shifts))
        if header.records_after:
            kept = [record.place for record in self._behind if not self._drops(record)]
            self._patch(235, "<QI", _moved(kept[0], shifts) if kept else 0, len(kept))
        file.flush()

    def _patch(self, place: int, kinds: str, *values: int) -> None:
        """Write numbers into the header of the copy."""
        self._file.seek(place)
        self._file.write(struct.pack(kinds, *values))

    def _write_tail(self) -> list[tuple[int, int]]:
        """Copy what stands behind the points.

        Return places in the input, and by how much the bytes from there on have moved in the copy.
        """
        header, out = self.layout.header, self._file
        with open(self.source, "rb") as source:
            size = source.seek(0, os.SEEK_END)
            at = end_of_points(header, size)
            if not header.compressed:
                at = min(at, header.offset + header.count * header.point_bytes)
            shifts = []
            for start, end, data in (*self._edits(self._behind), (size, size, b"")):
                shifts.append((at, out.tell() - at))
                source.seek(at)
                while at < start and (part := source.read(min(start - at, 1 << 22))):
                    out.write(part)
                    at += len(part)
                out.write(data)
                at = end
        return shifts


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
        if field.scale is not None or not fits:
            raise _narrow(
                source, name, f"{field.type.name}{', scaled' * (field.scale is not None)}"
            )


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


def _record(user: bytes, number: int, title: bytes, data: bytes) -> bytes:
    """Return a record before the points."""
    if len(data) > 65_535:
        raise StageError("a record of the copy is too long", found=f"{len(data):,} bytes")
    return struct.pack("<H16sHH32s", 0, user, number, len(data), title) + data


def _moved(place: int, shifts: Sequence[tuple[int, int]]) -> int:
    """Return where a byte of the input stands in the copy; 0 where it was not copied."""
    moved = [place + shift for start, shift in shifts if start <= place]
    return moved[-1] if moved else 0
