"""Whether the chunks of a LAZ file just written are what its writer compressed.

PDAL 2.9 goes on after a write that failed, so that a disk which is full for a moment leaves a hole of zeros, or bytes
are lost and what follows moves up, while the header and the table of chunks are right. Three things show it:

* a chunk of the formats from 6 on says how long its layers are, and they fill it exactly;
* one of the formats before is one stream, whose decoder needs each of its bytes and none beyond, and whose points lie
  in the header's box;
* a chunk that ends in zeros, as a hole does, comes out the same when its points are compressed anew.
"""

from __future__ import annotations

import io
import os
import struct

import numpy as np

from .chunks import laz_chunks
from .las import POINT_BYTES, LasHeader

#: Layers of a chunk, without those of extra bytes ("LAZ specification 1.4", point data of formats 6 to 8).
_LAYERS = {6: 9, 7: 10, 8: 11}
_STREAMED = (0, 1, 2, 3)
#: Zeros at the end of a chunk beyond which it is compressed anew; encoders end it with up to five.
_ZEROS = 16
#: Bytes that a decoder may read ahead.
_AHEAD = 4


def chunks_are_whole(path: str | os.PathLike, header: LasHeader) -> bool:
    """Whether each chunk of a LAZ file holds its points, as far as that can be seen.

    Parameters
    ----------
    path : path
        A file that `check_readable` takes. Formats with wave packets are taken for whole.
    header : LasHeader
    """
    found = laz_chunks(path, header)
    if found is None or header.point_format not in (*_LAYERS, *_STREAMED):
        return True
    with open(path, "rb") as file:
        file.seek(found.begin)
        for size, points in zip(found.sizes, found.points, strict=True):
            chunk = file.read(size)
            if len(chunk) < size:
                return False
            if points and not _holds(chunk, points, found.record, header):
                return False
    return True


def _holds(chunk: bytes, points: int, record: bytes, header: LasHeader) -> bool:
    suspect = not any(chunk[-_ZEROS:])
    if header.point_format in _LAYERS and not _layers_fill(chunk, points, header):
        return False
    if header.point_format in _LAYERS and not suspect:
        return True
    decoded, taken = _decode(chunk, points, record, header.point_bytes)
    if decoded is None:
        return False
    if header.point_format in _STREAMED and not (
        abs(taken - len(chunk)) <= _AHEAD and _in_box(decoded, header)
    ):
        return False
    return not suspect or _encode(decoded, record)[: len(chunk)] == chunk


def _layers_fill(chunk: bytes, points: int, header: LasHeader) -> bool:
    layers = _LAYERS[header.point_format] + header.point_bytes - POINT_BYTES[header.point_format]
    begin = header.point_bytes + 4 * (1 + layers)
    if len(chunk) < begin:
        return False
    count, *sizes = struct.unpack_from(f"<{1 + layers}I", chunk, header.point_bytes)
    return count == points and begin + sum(sizes) == len(chunk)


class _Sips(io.BytesIO):
    """Bytes that are given one at a time towards their end, so that what a reader took is what it needed."""

    slow = 0

    def readinto(self, buffer) -> int:
        left = len(self.getbuffer()) - self.tell()
        return super().readinto(memoryview(buffer)[: max(1, left - self.slow)])


def _decode(chunk: bytes, points: int, record: bytes, width: int) -> tuple[np.ndarray | None, int]:
    """Points of a chunk as rows of bytes (None where it has not so many), and how many bytes their decoder took."""
    import lazrs

    room = bytes(64)  # where a decoder finds more than the chunk has
    begin = struct.pack("<q", 8 + len(chunk) + len(room))
    source = _Sips(begin + chunk + room + bytes(8))
    source.slow = len(room) + 8 + 64
    out = np.empty(points * width, np.uint8)
    try:
        lazrs.LasZipDecompressor(source, record).decompress_many(out)
    except BaseException as error:
        if isinstance(error, Exception) or type(error).__name__ == "PanicException":  # of Rust
            return None, 0
        raise
    return out.reshape(points, width), source.tell() - 8


def _encode(decoded: np.ndarray, record: bytes) -> bytes:
    import lazrs

    return bytes(lazrs.compress_points(lazrs.LazVlr(record), decoded.reshape(-1), False)[8:])


def _in_box(decoded: np.ndarray, header: LasHeader) -> bool:
    for axis in (0, 1):
        stored = np.ascontiguousarray(decoded[:, 4 * axis : 4 * axis + 4]).view("<i4")
        scale, offset = header.scales[axis], header.offsets[axis]
        low, high = sorted(int(value) * scale + offset for value in (stored.min(), stored.max()))
        least, most = header.box[axis], header.box[axis + 2]
        spare = abs(scale) + 1e-9 * max(abs(least), abs(most))
        if low < least - spare or high > most + spare:
            return False
    return True
