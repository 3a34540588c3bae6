"""Points of LAS and LAZ files as records (LAS 1.4 R15, tables 7 to 18), some of their fields or all.

Not laspy's, whose import takes 0.15 CPU seconds of every start.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .chunks import laz_chunks
from .errors import StageError
from .extrabytes import number_type, plain_dimensions
from .las import POINT_BYTES, LasHeader
from .lascheck import DAMAGED

_OLD = [
    *(("X", "<i4"), ("Y", "<i4"), ("Z", "<i4"), ("intensity", "<u2"), ("bit_fields", "u1")),
    *(("raw_classification", "u1"), ("scan_angle_rank", "i1"), ("user_data", "u1")),
    ("point_source_id", "<u2"),
]
_NEW = [
    *(("X", "<i4"), ("Y", "<i4"), ("Z", "<i4"), ("intensity", "<u2"), ("bit_fields", "u1")),
    *(("classification_flags", "u1"), ("classification", "u1"), ("user_data", "u1"), ("scan_angle", "<i2")),
    *(("point_source_id", "<u2"), ("gps_time", "<f8")),
]
_TIME = [("gps_time", "<f8")]
_COLORS = [("red", "<u2"), ("green", "<u2"), ("blue", "<u2")]
#: Fields by point format, under laspy's names; formats with waveforms are not among them.
_FIELDS: dict[int, list[tuple[str, str]]] = {
    0: _OLD,
    1: [*_OLD, *_TIME],
    2: [*_OLD, *_COLORS],
    3: [*_OLD, *_TIME, *_COLORS],
    6: _NEW,
    7: [*_NEW, *_COLORS],
    8: [*_NEW, *_COLORS, ("nir", "<u2")],
}
#: Points that are read at a time: whole chunks of LAZ, for all cores.
_BLOCK = 200_000


class DamagedError(StageError):
    """Points that cannot be decoded."""


def damaged(where: str, found: str) -> DamagedError:
    """What is said of them, and what to do."""
    what = "the LAS file is damaged: its points cannot be decoded"
    return DamagedError(what, where=where, found=found, cure=DAMAGED)


def record_type(path: str | os.PathLike, header: LasHeader) -> np.dtype | None:
    """The type of a file's records, extra dimensions by their names; None where not all fields are plain numbers."""
    fields = _FIELDS.get(header.point_format)
    extra = plain_dimensions(path)
    if fields is None or extra is None:
        return None
    named = [(name, number_type(kind).newbyteorder("<")) for name, kind in extra]
    if {name for name, _ in named} & {name for name, _ in fields} or len(dict(named)) < len(named):
        return None
    dtype = np.dtype([*fields, *named])
    assert np.dtype(fields).itemsize == POINT_BYTES[header.point_format]
    return dtype if dtype.itemsize == header.point_bytes else None


def blocks(
    path: str | os.PathLike,
    header: LasHeader,
    dtype: np.dtype,
    fields: Collection[str] | None = None,
    count: int | None = None,
) -> Iterator[NDArray]:
    """The first `count` records of a file in their order, in parts; all where none is given.

    Of LAZ 1.4 only `fields` are sure to be read; others may be zeros.

    Raises
    ------
    DamagedError
        If they cannot be decoded.
    StageError
        If they cannot be read for another reason.
    """
    left = header.count if count is None else min(count, header.count)
    try:
        with open(path, "rb") as file:
            file.seek(header.offset)
            source = _unpacker(path, file, header, fields) if header.compressed and left else None
            while left:
                number = min(left, _BLOCK)
                records = np.empty(number, dtype)
                raw = records.view(np.uint8)
                if source is not None:
                    source.decompress_many(raw)
                elif file.readinto(raw.data) < len(raw):
                    raise OSError("the file ends before its points do")
                yield records
                left -= number
    except GeneratorExit:
        raise
    except (KeyboardInterrupt, StageError):
        raise
    except BaseException as error:  # lazrs panics at damaged points, which is no Exception
        if isinstance(error, Exception) or type(error).__name__ == "PanicException":
            if isinstance(error, (MemoryError, OSError)):  # of the machine, not of the file
                raise StageError("the points cannot be read", where=str(path), found=error) from error
            raise damaged(str(path), str(error)) from error
        raise


def _unpacker(path: str | os.PathLike, file: Any, header: LasHeader, fields: Collection[str] | None) -> Any:
    import lazrs

    chunks = laz_chunks(path, header)
    if chunks is None:
        raise StageError("the chunks of the file are too many", where=str(path))
    if fields is None:
        return lazrs.ParLasZipDecompressor(file, chunks.record)
    return lazrs.ParLasZipDecompressor(file, chunks.record, lazrs.DecompressionSelection(_layers(fields)))


def _layers(fields: Collection[str]) -> int:
    """The layers of LAZ 1.4 that hold fields."""
    import lazrs

    layers = {
        "X": lazrs.SELECTIVE_DECOMPRESS_XY_RETURNS_CHANNEL,
        "Y": lazrs.SELECTIVE_DECOMPRESS_XY_RETURNS_CHANNEL,
        "bit_fields": lazrs.SELECTIVE_DECOMPRESS_XY_RETURNS_CHANNEL,
        "Z": lazrs.SELECTIVE_DECOMPRESS_Z,
        "intensity": lazrs.SELECTIVE_DECOMPRESS_INTENSITY,
        "classification": lazrs.SELECTIVE_DECOMPRESS_CLASSIFICATION,
        "classification_flags": lazrs.SELECTIVE_DECOMPRESS_FLAGS,
    }
    chosen = lazrs.SELECTIVE_DECOMPRESS_XY_RETURNS_CHANNEL
    for field in fields:
        chosen |= layers.get(field, lazrs.SELECTIVE_DECOMPRESS_ALL)
    return chosen


class RecordColumns:
    """Fields of all records of a file, each in an array of its own; those not named are read when they are asked for."""

    def __init__(
        self, path: str | os.PathLike, header: LasHeader, dtype: np.dtype, fields: Collection[str]
    ) -> None:
        self._path, self._header, self.dtype = path, header, dtype
        self._held: dict[str, NDArray] = {}
        self._read(fields)

    def _read(self, fields: Collection[str]) -> None:
        new = {name: np.empty(self._header.count, self.dtype[name]) for name in fields}
        start = 0
        for records in blocks(self._path, self._header, self.dtype, fields):
            for name, column in new.items():
                column[start : start + len(records)] = records[name]
            start += len(records)
        self._held |= new

    def __len__(self) -> int:
        return self._header.count

    def __getitem__(self, name: str) -> NDArray:
        if name not in self._held:
            self._read([name])
        return self._held[name]
