"""PNG without an imaging library: zlib and two kinds of chunk are all it takes (ISO/IEC 15948)."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import numpy as np

from ..base.errors import StageError


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def write_png(path: str | os.PathLike | None, rgb: np.ndarray) -> bytes:
    """Encode an image, and write it where a path is given (beside, then renamed).

    Parameters
    ----------
    path : path or None
    rgb : (height, width, 3) uint8

    Returns
    -------
    bytes
        The file's content; the same image gives the same bytes.
    """
    rgb = np.ascontiguousarray(rgb)
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8 or 0 in rgb.shape:
        raise StageError(
            "a picture is a (height, width, 3) array of uint8",
            where="write_png",
            found=(rgb.shape, str(rgb.dtype)),
        )
    height, width = rgb.shape[:2]
    # Filter 'up' (2) on every line but the first: neighbours above are alike in maps.
    lines = np.empty((height, 1 + 3 * width), dtype=np.uint8)
    flat = rgb.reshape(height, -1)
    lines[0, 0], lines[0, 1:] = 0, flat[0]
    lines[1:, 0] = 2
    np.subtract(flat[1:], flat[:-1], out=lines[1:, 1:])
    data = (
        b"\x89PNG\r\n\x1a\n"
        + _chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
        + _chunk(b"IDAT", zlib.compress(lines.tobytes(), 9))
        + _chunk(b"IEND", b"")
    )
    if path is not None:
        target = Path(path)
        beside = target.with_name(f".{target.name}.part")
        try:
            beside.write_bytes(data)
            os.replace(beside, target)
        except OSError as error:
            beside.unlink(missing_ok=True)
            raise StageError(
                "the picture cannot be written",
                where=str(path),
                found=error.strerror,
                cure="Give a file in a folder that exists and may be written",
            ) from error
    return data
