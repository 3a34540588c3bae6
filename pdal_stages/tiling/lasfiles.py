"""LAS files read record by record: what stands before their points, and points in blocks.

laspy takes two milliseconds to open a file, most of them for copies of descriptions that are the same in the next one.
Small files are therefore read here, as far as nothing is wrong with them.
"""

from __future__ import annotations

import hashlib
import os
import struct
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base import las
from ..base.errors import StageError
from ..base.lean import imported

_COMPRESSOR = b"laszip encoded"
#: Bytes of the header that decide how points are read: encoding, version, sizes, point format, scales and offsets.
_COMPARED = ((6, 8), (24, 26), (94, 107), (131, 179))
#: Points of a block: LAZ is compressed in pieces of so many.
BLOCK = 50_000
#: How the points of files that are alike are laid out and scaled.
_layouts: OrderedDict[bytes, _Layout] = OrderedDict()
_MOST_LAYOUTS = 256


class Located(NamedTuple):
    """Points as a file holds them, and their coordinates."""

    array: NDArray
    x: NDArray[np.float64]
    y: NDArray[np.float64]


class _Layout(NamedTuple):
    dtype: np.dtype
    scales: tuple[float, ...]
    offsets: tuple[float, ...]


def open_las(path: str, only: Sequence[str] = ()):
    """The file, for reading; StageError with the reason where it cannot be.

    `only`: the dimensions that are needed beside X, Y and the returns, by laspy's names of its selections (``Z``,
    ``CLASSIFICATION``, ...): LAZ 1.4 holds them apart, so the others take no time. They hold nothing then.
    """
    laspy = imported("laspy")
    more = {}
    if only:
        wanted = laspy.DecompressionSelection.base()
        for name in only:
            wanted |= laspy.DecompressionSelection[name]
        more["decompression_selection"] = wanted
    try:
        return laspy.open(path, **more)
    except Exception as error:  # laspy and the decompressor raise many types
        found = error if isinstance(error, OSError) else f"{type(error).__name__}: {error}"
        raise StageError("the input cannot be read", where=path, found=found) from None


def read_block(reader: Any, path: str, start: int, end: int):
    """Points from number `start` to `end`, a block at most; StageError where the file is cut short or damaged."""
    count = min(BLOCK, end - start)
    try:
        if reader.points_read != start:  # seeking to where one is costs, and forgets what is wanted
            reader.seek(start)
        points = reader.read_points(count)
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt | MemoryError):
            raise
        raise StageError(
            "the input is damaged", where=path, found=f"{type(error).__name__} at point {start:,}: {error}"
        ) from None
    if len(points) != count:
        raise StageError(
            "the input is cut short", where=path, found=f"it ends before point {start + count:,}"
        )
    return points


def all_points(path: str) -> Iterator[Located]:
    """All points of a file, a block at a time.

    Raises
    ------
    StageError
        If any of it cannot be read.
    """
    header = las.read_header(path)
    small = None if header is None else read_small(path, header.count)
    if small is not None:
        yield small
        return
    with open_las(path) as reader:
        total = int(reader.header.point_count)
        for start in range(0, total, BLOCK):
            points = read_block(reader, path, start, total)
            yield Located(points.array, np.asarray(points.x), np.asarray(points.y))


def _layout(path: str) -> _Layout:
    like = likeness(path)
    if like not in _layouts:
        with open_las(path) as reader:
            header = reader.header
        dtype = header.point_format.dtype()
        _layouts[like] = _Layout(dtype, tuple(map(float, header.scales)), tuple(map(float, header.offsets)))
        if len(_layouts) > _MOST_LAYOUTS:
            _layouts.popitem(last=False)
    return _layouts[like]


def scaled(path: str, records: NDArray) -> Located:
    """Records of a file, with coordinates as laspy reads them from it."""
    layout = _layout(path)
    array = records.view(layout.dtype)
    x, y = (array[name] * layout.scales[k] + layout.offsets[k] for k, name in enumerate("XY"))
    return Located(array, x, y)


def read_small(path: str, count: int) -> Located | None:
    """All points of a file with so many; None where they are too many, or it cannot be read: laspy says why."""
    if not 0 < count <= BLOCK:
        return None
    try:
        header = las.read_header(path)
        if header is None or header.count != count:
            return None
        with open(path, "rb") as file:
            coding = [r for r in las.records(file, header) if r.user == _COMPRESSOR and not r.after]
            if len(coding) != header.compressed:
                return None
            out = np.empty((count, header.point_bytes), np.uint8)
            if coding:
                file.seek(coding[0].data)
                data = file.read(coding[0].length)
                file.seek(header.offset)
                _decompress(file, data, out)
            else:
                file.seek(header.offset)
                if file.readinto(out.data) != out.nbytes:  # type: ignore[arg-type]
                    return None
        return scaled(path, out.reshape(-1))
    except (OSError, ValueError, struct.error, StageError):
        return None


def _decompress(file: Any, coding: bytes, out: NDArray[np.uint8]) -> None:
    """Points as they are uncompressed; ValueError where they cannot be."""
    import lazrs

    try:
        lazrs.LasZipDecompressor(file, coding).decompress_many(out.reshape(-1))
    except BaseException as error:  # of the library's own, beside those of Python
        if isinstance(error, KeyboardInterrupt | MemoryError):
            raise
        raise ValueError(str(error)) from None


def likeness(path: str) -> bytes:
    """What is the same in files whose points may go through one reader: everything before them but counts and extents.

    Name and date of the file's maker and its identifiers are not looked at.
    """
    status = os.stat(path)
    return _likeness(path, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=1 << 16)
def _likeness(path: str, changed: int, size: int) -> bytes:
    head, tail = plain_header(path)
    digest = hashlib.sha256(tail)
    for start, end in _COMPARED:
        digest.update(head[start:end])
    (length,) = struct.unpack_from("<H", head, 94)
    digest.update(head[length:])
    return digest.digest()


def plain_header(path: str) -> tuple[bytearray, bytes]:
    """All before the points of a file as an uncompressed one has them, and its extended records.

    Counts are left as they are; :func:`finish` sets them.
    """
    header = las.read_header(path)
    assert header is not None
    with open(path, "rb") as file:
        head = bytearray(file.read(header.offset))
        coding = [r for r in las.records(file, header) if r.user == _COMPRESSOR and not r.after]
        file.seek(header.after)
        tail = file.read() if header.records_after else b""
    for record in reversed(coding):
        del head[record.place : record.data + record.length]
    head[104] &= 0x3F
    struct.pack_into("<II", head, 96, len(head), header.records - len(coding))
    return head, tail


def finish(file: Any, head: bytearray, tail: bytes, count: int) -> None:
    """Write extended records after `count` points, and the header with the right counts."""
    version = head[25]
    (width,) = struct.unpack_from("<H", head, 105)
    (start,) = struct.unpack_from("<I", head, 96)
    if version >= 4:
        struct.pack_into("<I", head, 107, count if head[104] < 6 and count < 2**32 else 0)
        struct.pack_into("<Q", head, 247, count)
        if tail:
            struct.pack_into("<Q", head, 235, start + count * width)
    else:
        struct.pack_into("<I", head, 107, count)
    file.write(tail)
    file.seek(0)
    file.write(head)
