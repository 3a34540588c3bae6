"""Views side by side: heights, classes and errors, with captions, a scale and a legend."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from ..base.asprs import class_name
from .pictures import fit_text, font, text_width
from .raster import BACKGROUND, paint, shading
from .views import (
    CLASS_COLORS,
    INK,
    RIGHT,
    WRONG,
    checked_columns,
    class_codes,
    nice_step,
    ramp,
    span,
    verdict,
    window,
)

_GAP = 12

Entry = tuple[str, tuple[int, int, int]]


def legend(codes: Sequence[int], width: int, extra: Sequence[Entry] = ()) -> np.ndarray:
    """A band of color patches with class names, then with `extra` texts: (height, width, 3) uint8, as high as it needs."""
    entries = [(f"{c} {class_name(c)}", tuple(CLASS_COLORS[c].tolist())) for c in codes]
    spots, left, line = [], 16, 0
    for text, color in [*entries, *extra]:
        text = fit_text(text, width - 60)
        need = 48 + text_width(text)
        if left + need > width and left > 16:
            left, line = 16, line + 1
        spots.append((left, 6 + 28 * line, text, color))
        left += need
    band = Image.new("RGB", (width, 28 * (line + 1) + 8), BACKGROUND)
    pen = ImageDraw.Draw(band)
    for left, top, text, color in spots:
        pen.rectangle((left, top, left + 17, top + 17), fill=color, outline=(90, 90, 90))
        pen.text((left + 26, top + 9), text, INK, font(), anchor="lm")
    return np.array(band)


def triptych(
    x: npt.ArrayLike,
    y: npt.ArrayLike,
    z: npt.ArrayLike,
    predicted: npt.ArrayLike,
    truth: npt.ArrayLike | None = None,
    *,
    width: int = 1500,
) -> np.ndarray:
    """Heights, classes and errors side by side, with captions, a scale and a legend.

    Parameters
    ----------
    x, y, z : (n,) float
    predicted : (n,) integer
    truth : (n,) integer, optional
        Reference classes; without them there is no panel of errors.
    width : int
        Pixels across all panels.

    Returns
    -------
    (height, width, 3) uint8
    """
    x, y, z, predicted = checked_columns(x=x, y=y, z=z, predicted=predicted)
    predicted = class_codes(predicted)
    panels = 2 if truth is None else 3
    each = (int(width) - _GAP * (panels + 1)) // panels
    s = window(x, y, z, each)
    light = shading(s)
    images = [
        paint(s, ramp(s.z, *span(s.z), "height"), light),
        paint(s, CLASS_COLORS[s.spread(predicted, 0)], light),
    ]
    texts = ["Heights (shaded)", "Predicted classes"]
    extra: list[Entry] = []
    if truth is not None:
        _, truth = checked_columns(x=x, truth=truth)
        truth = class_codes(truth)
        wrong = predicted != truth
        images.append(paint(s, verdict(s, x, y, z, wrong, np.zeros_like(wrong)), light))
        texts.append(f"Errors: {100 * wrong.sum() / len(x):.1f} % of {len(x):,} points")
        extra = [("right", RIGHT), ("wrong", WRONG)]

    band = legend(np.unique(predicted).tolist(), int(width), extra)
    top = 36
    below = top + images[0].shape[0]
    sheet = Image.new("RGB", (int(width), below + 36 + band.shape[0]), BACKGROUND)
    pen = ImageDraw.Draw(sheet)
    for n, (image, text) in enumerate(zip(images, texts, strict=True)):
        left = _GAP + n * (each + _GAP)
        pen.text((left + 2, top - 14), fit_text(text, each), INK, font(), anchor="lm")
        sheet.paste(Image.fromarray(image), (left, top))
    _scale_bar(pen, _GAP + 2, below + 17, each, s.frame.pixel)
    sheet.paste(Image.fromarray(band), (0, below + 36))
    return np.array(sheet)


def _scale_bar(pen: ImageDraw.ImageDraw, left: int, y: int, most: int, pixel: float) -> None:
    """A bar of a round length, at most about half as long as `most` pixels; `pixel` in meters."""
    length = nice_step(0.2 * most * pixel)
    long = max(2, round(length / pixel))
    pen.rectangle((left, y - 2, left + long - 1, y + 2), fill=INK)
    pen.rectangle((left + long // 2, y - 1, left + long - 2, y + 1), fill=BACKGROUND)
    pen.text((left + long + 8, y), f"{length:g} m", INK, font(), anchor="lm")
