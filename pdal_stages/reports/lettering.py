"""Captions: proportional letters from a small table of glyphs."""

from __future__ import annotations

import base64
import struct
import zlib
from functools import lru_cache

import numpy as np

from .glyphs import DATA, LETTERS

SMALL, LARGE = 15, 22


@lru_cache(maxsize=1)
def _fonts() -> dict[int, dict[str, np.ndarray]]:
    """Ink of every letter by size: (height, width) float in 0..1."""
    raw = zlib.decompress(base64.b85decode(DATA))
    fonts, at = {}, 0
    while at < len(raw):
        size, height, width = struct.unpack_from("<HHH", raw, at)
        at += 6
        widths = np.frombuffer(raw, np.uint8, len(LETTERS), at)
        at += len(LETTERS)
        half = (width + 1) // 2
        packed = np.frombuffer(raw, np.uint8, height * half, at).reshape(height, half)
        at += height * half
        ink = np.empty((height, 2 * half))
        ink[:, ::2], ink[:, 1::2] = packed >> 4, packed & 15
        edges = np.concatenate([[0], np.cumsum(widths.astype(int))])
        fonts[size] = {
            letter: ink[:, a:b] / 15.0 for letter, a, b in zip(LETTERS, edges[:-1], edges[1:], strict=True)
        }
    return fonts


def text_mask(text: str, size: int = SMALL) -> np.ndarray:
    """Ink of one line, (height, width) float in 0..1; a letter that is not in the table becomes '?'."""
    font = _fonts()[LARGE if size > (SMALL + LARGE) // 2 else SMALL]
    if not text:
        return np.zeros((font["?"].shape[0], 0))
    return np.hstack([font.get(letter, font["?"]) for letter in text])


def text_size(text: str, size: int = SMALL) -> tuple[int, int]:
    """Width and height of one line in pixels."""
    height, width = text_mask(text, size).shape
    return width, height


def draw_text(
    rgb: np.ndarray,
    left: int,
    top: int,
    text: str,
    size: int = SMALL,
    color: tuple[int, int, int] = (30, 34, 40),
) -> int:
    """Draw one line onto an image, cut at its edges; returns the line's width.

    Parameters
    ----------
    rgb : (height, width, 3) uint8
        Changed in place.
    left, top : int
    text : str
    size : int
        15 or 22 pixels, whichever is nearer.
    color : (r, g, b)
    """
    ink = text_mask(text, size)
    height, width = ink.shape
    y0, x0 = max(top, 0), max(left, 0)
    y1, x1 = min(top + height, rgb.shape[0]), min(left + width, rgb.shape[1])
    if y1 > y0 and x1 > x0:
        share = ink[y0 - top : y1 - top, x0 - left : x1 - left, None]
        part = rgb[y0:y1, x0:x1]
        part[...] = np.round(part * (1 - share) + np.array(color) * share).astype(np.uint8)
    return width


def fit_text(text: str, width: int, size: int = SMALL) -> str:
    """The text, shortened with '..' where it is wider than `width` pixels."""
    if text_size(text, size)[0] <= width:
        return text
    while text and text_size(text + "..", size)[0] > width:
        text = text[:-1]
    return text + ".." if text else ""
