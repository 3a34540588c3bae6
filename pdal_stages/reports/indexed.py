"""PNG with a palette: a third of the size of a true-colour one, for maps held inside a page."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import numpy.typing as npt

from ..base.errors import StageError


def indexed_png(rgb: npt.NDArray[np.uint8]) -> bytes:
    """Encode an image with at most 256 colours, rounding them as little as it takes.

    Class maps are a few colours in many shades, so rounding each channel to steps of 4 to 16 levels,
    which the eye does not see in them, leaves few enough.

    Parameters
    ----------
    rgb : (height, width, 3) uint8

    Returns
    -------
    bytes
        The file's content; the same image gives the same bytes.
    """
    image = np.asarray(rgb)
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or not image.size:
        raise StageError("an image must be height x width x 3 bytes", found=f"{image.shape} {image.dtype}")
    height, width, _ = image.shape
    for step in (1, 4, 8, 12, 16, 24, 32, 48, 64):  # 64: at most 5 x 5 x 5 colours
        rounded = np.minimum((image.astype(np.uint32) + step // 2) // step * step, 255)
        packed = rounded[..., 0] << 16 | rounded[..., 1] << 8 | rounded[..., 2]
        palette, index = np.unique(packed, return_inverse=True)
        if len(palette) <= 256:
            break
    colors = np.stack([palette >> 16, palette >> 8 & 255, palette & 255], axis=1).astype(np.uint8)
    rows = np.zeros((height, width + 1), np.uint8)  # a leading 0: no filter, best for palettes
    rows[:, 1:] = index.reshape(height, width)
    header = struct.pack(">IIBBBBB", width, height, 8, 3, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"PLTE", colors.tobytes()), (b"IDAT", zlib.compress(rows.tobytes(), 9)))
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(k, d) for k, d in chunks) + _chunk(b"IEND", b"")


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
