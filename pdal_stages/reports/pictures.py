"""PNG files and lettering: what Pillow does for the views, and the alphabet of its built-in font."""

from __future__ import annotations

import io
import os
import unicodedata
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageFont

from ..base.errors import StageError
from ..base.files import write_whole

#: Pixels of letters.
_SIZE = 16
#: What the built-in font has beyond ASCII, and spellings of common characters it lacks.
_LETTERS = "°±·"
_SPELLINGS = str.maketrans({"ß": "ss", "æ": "ae", "ø": "o", "×": "x", "–": "-", "—": "-", "µ": "u"})


def png(rgb: npt.NDArray[np.uint8], palette: bool = False) -> bytes:
    """An image as a PNG file; the same image gives the same bytes.

    Parameters
    ----------
    rgb : (height, width, 3) uint8
    palette : bool
        Round the channels until 256 colors are left: a third of the size, for maps inside a page. Class maps
        are few colors in many shades, so steps of 4 to 16 levels do, and a rare class keeps its color.

    Raises
    ------
    StageError
        If it is not such an array.
    """
    rgb = np.asarray(rgb)
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8 or 0 in rgb.shape:
        raise StageError(
            "a picture is a (height, width, 3) array of uint8", found=f"{rgb.shape} of {rgb.dtype}"
        )
    image = Image.fromarray(np.ascontiguousarray(rgb))
    if palette:
        for step in (1, 4, 8, 12, 16, 24, 32, 48, 64):  # 64: at most 5 x 5 x 5 colors
            rounded = np.minimum((rgb.astype(np.uint16) + step // 2) // step * step, 255)
            image = Image.fromarray(rounded.astype(np.uint8))
            if image.getcolors(256):
                break
        image = image.quantize(256, dither=Image.Dither.NONE)
    file = io.BytesIO()
    image.save(file, "PNG")
    return file.getvalue()


def write_png(path: str | os.PathLike[str], rgb: npt.NDArray[np.uint8], palette: bool = False) -> Path:
    """Write an image as a PNG file, whole or not at all; see :func:`png`."""
    return write_whole(path, png(rgb, palette), what="picture")


@lru_cache
def font(size: int = _SIZE) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Pillow's own font: pictures look alike on every machine."""
    return ImageFont.load_default(size)


def plain(text: str) -> str:
    """The text in letters that the font has: accents are dropped, and what is left over becomes '?'."""
    parts = unicodedata.normalize("NFKD", text.translate(_SPELLINGS))
    return "".join(
        letter if letter in _LETTERS or " " <= letter <= "~" else "?"
        for letter in parts
        if not unicodedata.combining(letter)
    )


def text_width(text: str) -> int:
    """Pixels that a line of text is wide."""
    return round(font().getlength(plain(text)))


def fit_text(text: str, width: int) -> str:
    """The text in letters of the font, shortened with '..' where it is wider than `width` pixels."""
    text = plain(text)
    if text_width(text) <= width:
        return text
    while text and text_width(text + "..") > width:
        text = text[:-1]
    return text + ".." if text else ""
