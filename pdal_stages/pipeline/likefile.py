"""A LAS file like one that PDAL wrote, of other points.

What a file says before its points is taken as PDAL wrote it, but for what is counted of points. These come as records: the
format's own bytes as they are, extra dimensions in the order that PDAL gave them, and what stages made of them. Whoever
uses this holds a file that PDAL wrote against the one that is written here of the same points, byte for byte.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.chunks import laz_chunks
from ..base.errors import StageError
from ..base.extrabytes import number_type, plain_dimensions
from ..base.las import POINT_BYTES, LasHeader, read_header
from .las_output import UNCOMPRESSED


class Extra(NamedTuple):
    """An extra dimension."""

    at: int  #: its place in a record
    dtype: np.dtype


_PLACE = np.dtype("<i4")
#: What is counted of a record's first bytes, in all formats (LAS 1.4 R15, tables 7 to 18).
_COUNTED = {
    "X": Extra(0, _PLACE),
    "Y": Extra(4, _PLACE),
    "Z": Extra(8, _PLACE),
    "bits": Extra(14, np.dtype("u1")),
}


class Some(NamedTuple):
    """Points, as a file holds them, with what is new of them."""

    records: NDArray[np.uint8]  #: (n, bytes)
    #: New values of dimensions, and whose rows they are; None for all.
    values: Mapping[str, tuple[NDArray[np.int64] | None, NDArray]]
    kept: NDArray[np.bool_] | None = None  #: (n,) which of the points come out; None for all


def extra_of(path: str | os.PathLike, header: LasHeader) -> dict[str, Extra] | None:
    """Extra dimensions by name, in their order; None where one is scaled, or no number, or bytes are left over."""
    found: dict[str, Extra] = {}
    at = POINT_BYTES[header.point_format]
    named = plain_dimensions(path)
    for name, kind in named or ():
        dtype = number_type(kind).newbyteorder("<")
        found[name] = Extra(at, dtype)
        at += dtype.itemsize
    return found if named is not None and len(found) == len(named) and at == header.point_bytes else None


@dataclass(frozen=True)
class LikeFile:
    """How files are written that are like one."""

    head: bytes  #: all before the points; counts and box, where PDAL writes them, are those of other points
    header: LasHeader  #: of the file, before anybody compressed its points
    at_end: bool  #: whether it says that records would begin where it ends, though its points are compressed
    coding: bytes  #: the record of how points are compressed; empty where they are not
    own: int  #: bytes of a point of the format, without extra ones
    extra: dict[str, Extra]  #: extra dimensions

    @classmethod
    def of(cls, path: str) -> LikeFile | None:
        """Like the file at `path`, compressed where :mod:`.packing` is to do that; None where that cannot be told of it."""
        header = read_header(path)
        if header is None or header.records_after or header.waveforms:
            return None
        extra = extra_of(path, header)
        if extra is None:
            return None
        with open(path, "rb") as file:
            head = file.read(header.offset)
        coding = b""
        if path.endswith(UNCOMPRESSED):
            return None
        if header.compressed:
            chunks = laz_chunks(path, header)
            if chunks is None:
                return None
            coding = chunks.record
        at_end = header.compressed and head[235:243] == struct.pack("<Q", os.stat(path).st_size)
        return cls(head, header, at_end, coding, POINT_BYTES[header.point_format], extra)

    @property
    def holds(self) -> set[str]:
        """Dimensions of which there may be new values."""
        return {"Classification", *self.extra}

    def write(self, file: BinaryIO, points: Iterable[Some], given: Mapping[str, Extra]) -> int:
        """Write an empty file that can be read back, and give the number of its points.

        `given`: extra dimensions that the records have and that come out of them, where there is nothing new.

        Raises
        ------
        StageError
            If points cannot be compressed.
        OSError
            If the file cannot be written.
        """
        totals = _Totals(self.header)
        file.write(self.head)
        blocks = (totals.counted(self._put(some, given)) for some in points)
        if self.coding:
            import lazrs

            try:
                packer = lazrs.ParLasZipCompressor(file, lazrs.LazVlr(self.coding))
                for block in blocks:
                    packer.compress_many(block.view(np.uint8))
                packer.done()
            except (ValueError, RuntimeError, lazrs.LazrsError) as error:
                raise StageError(
                    "the output file could not be compressed", found=f"{getattr(file, 'name', '')}: {error}"
                ) from error
        else:
            for block in blocks:
                file.write(block.view(np.uint8).data)
        end = file.seek(0, os.SEEK_END)
        file.seek(0)
        file.write(totals.put(self.head, self._records_begin(totals.count, end)))
        return totals.count

    def _records_begin(self, count: int, end: int) -> int:
        """Where records would begin after so many points, in a file of so many bytes."""
        (said,) = struct.unpack_from("<Q", self.head, 235) if self.header.minor >= 4 else (0,)
        if not said or self.at_end:
            return end if said else 0
        return said + (count - self.header.count) * self.header.point_bytes

    def _put(self, some: Some, given: Mapping[str, Extra]) -> NDArray:
        """Records as they come out."""
        own = {"": Extra(0, np.dtype(("V", self.own)))}
        out = np.zeros(len(some.records), _fields(own | self.extra, self.header.point_bytes))
        came = _fields(
            own | {name: given[name] for name in self.extra if name in given}, some.records.shape[1]
        )
        records = np.ascontiguousarray(some.records).view(came)[:, 0]
        for name in came.names or ():
            out[name] = records[name]
        for name, (rows, column) in some.values.items():
            if name == "Classification":
                place = 16 if self.header.point_format >= 6 else 15
                target = out.view(np.uint8).reshape(len(out), -1)[:, place]
            else:
                target = out[_field(name)]
            target[slice(None) if rows is None else rows] = column
        return out if some.kept is None or some.kept.all() else out[some.kept]


def _field(name: str) -> str:
    return f"of {name}"  # NumPy gives a field without a name one that a dimension may have


def _fields(extra: Mapping[str, Extra], width: int) -> np.dtype:
    """The type of records of so many bytes, as far as it matters."""
    places, types = zip(*extra.values(), strict=True)
    names = list(map(_field, extra))
    return np.dtype({"names": names, "formats": types, "offsets": places, "itemsize": width})


class _Totals:
    """What a header says of all points: their number, by return too, and their box."""

    def __init__(self, header: LasHeader) -> None:
        self._header = header
        self.count = 0
        self._returns = np.zeros(16, np.int64)
        self._least = np.full(3, 2**31, np.int64)
        self._most = np.full(3, -(2**31), np.int64)

    def counted(self, records: NDArray) -> NDArray:
        """The same records, which are counted."""
        points = records.view(_fields(_COUNTED, records.dtype.itemsize))
        self.count += len(points)
        mask = 15 if self._header.point_format >= 6 else 7
        self._returns += np.bincount(points[_field("bits")] & mask, minlength=16)
        for axis, name in enumerate("XYZ"):
            if len(points):
                self._least[axis] = min(self._least[axis], points[_field(name)].min())
                self._most[axis] = max(self._most[axis], points[_field(name)].max())
        return records

    def put(self, head: bytes, begin: int) -> bytes:
        """The head of a file with what was counted, and where records would `begin` (LAS 1.4 R15, table 3)."""
        out = bytearray(head)
        returns = self._returns[1:].tolist()
        if any(head[107:131]):  # counts of older versions, which not every PDAL writes into files of LAS 1.4
            struct.pack_into("<6I", out, 107, self.count, *returns[:5])
        box: list[float] = []
        for axis in range(3):
            scale, offset = self._header.scales[axis], self._header.offsets[axis]
            box += [float(ends[axis]) * scale + offset for ends in (self._most, self._least)]
        struct.pack_into("<6d", out, 179, *box)
        if self._header.minor >= 4:
            struct.pack_into("<Q", out, 235, begin)
            struct.pack_into("<16Q", out, 247, self.count, *returns)
        return bytes(out)
