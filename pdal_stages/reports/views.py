"""Views of a cloud: from above by class, height, value or error, and in section."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw
from scipy import ndimage

from ..base.asprs import class_color
from ..base.errors import StageError
from .pictures import font
from .raster import BACKGROUND, Frame, Surface, paint, shading, surface

INK, FAINT, GRIDLINE = (34, 38, 44), (110, 114, 120), (226, 226, 222)
RIGHT, WRONG, IGNORED = (196, 196, 192), (204, 24, 32), (232, 232, 228)

# Color ramps, as a few anchors: heights like a tinted map; values dark to bright with even lightness.
_RAMPS = {
    "height": (
        (38, 84, 106),
        (62, 128, 112),
        (132, 170, 104),
        (208, 200, 130),
        (206, 152, 98),
        (172, 102, 84),
        (233, 204, 186),
    ),
    "value": ((68, 1, 84), (65, 68, 135), (42, 120, 142), (34, 168, 132), (122, 209, 81), (253, 231, 37)),
}


def ramp(values: np.ndarray, low: float, high: float, name: str = "value") -> np.ndarray:
    """Colors, (..., 3) uint8, of values between `low` and `high`; NaN becomes mid gray."""
    if name not in _RAMPS:
        raise StageError(
            "unknown color ramp", where="picture", found=name, cure=f"Use one of {', '.join(_RAMPS)}"
        )
    anchors = np.array(_RAMPS[name], dtype=float)
    share = (np.asarray(values, dtype=float) - low) / max(high - low, 1e-12) * (len(anchors) - 1)
    good = np.isfinite(share)
    share = np.clip(np.where(good, share, 0.0), 0, len(anchors) - 1)
    out = np.stack([np.interp(share, np.arange(len(anchors)), anchors[:, c]) for c in range(3)], axis=-1)
    out[~good] = 150
    return np.round(out).astype(np.uint8)


#: The color of each class code, (256, 3) uint8.
CLASS_COLORS = np.array([class_color(code) for code in range(256)], dtype=np.uint8)
#: Discs of 5 and 21 pixels that a point of a section is drawn as.
_SMALL_DOT = ndimage.generate_binary_structure(2, 1)
_DOT = np.hypot(*np.mgrid[-2:3, -2:3]) <= 2.3


def checked_columns(**arrays: npt.ArrayLike) -> list[np.ndarray]:
    """Arrays of one value per point, all as long as the first and not empty; their names are for messages."""
    out = [np.asarray(a) for a in arrays.values()]
    size = out[0].shape
    for a, name in zip(out, arrays, strict=True):
        if a.ndim != 1 or a.shape != size:
            found = f"shape {a.shape}, '{next(iter(arrays))}' has {size}"
            raise StageError(f"'{name}' must be one value per point", where="picture", found=found)
    if not size[0]:
        raise StageError(
            "there is nothing to draw: the cloud is empty",
            where="picture",
            found="0 points",
            cure="Check that the pipeline before the picture leaves points",
        )
    return out


def class_codes(classes: np.ndarray) -> np.ndarray:
    """Codes from 0 to 255 as (n,) uint8, or an error."""
    if classes.dtype.kind not in "iub" or (classes.size and (classes.min() < 0 or classes.max() > 255)):
        raise StageError(
            "classes must be whole numbers from 0 to 255",
            where="picture",
            found=f"{classes.dtype} {classes.min()}..{classes.max()}",
        )
    return classes.astype(np.uint8)


def window(x: np.ndarray, y: np.ndarray, z: np.ndarray, width: int) -> Surface:
    """The surface of all points, `width` pixels wide."""
    if not 16 <= int(width) <= 20_000:
        raise StageError("'width' must be from 16 to 20000 pixels", where="picture", found=width)
    return surface(x, y, z, Frame.around(x, y, int(width)))


def top_view(
    x: npt.ArrayLike,
    y: npt.ArrayLike,
    z: npt.ArrayLike,
    classes: npt.ArrayLike | None = None,
    *,
    values: npt.ArrayLike | None = None,
    width: int = 900,
    limits: tuple[float, float] | None = None,
) -> np.ndarray:
    """The cloud from above, colored by ASPRS class, by a value or by height; the highest point of a pixel wins.

    Parameters
    ----------
    x, y, z : (n,) float
        Coordinates; points that are not finite are left out.
    classes : (n,) integer, optional
    values : (n,) float, optional
        Instead of classes: a feature, ``Reliability``, intensity. Without either, heights are shown.
    width : int
        Pixels across; the height follows from the extent.
    limits : (low, high), optional
        Values at the ends of the ramp; by default the 1st and 99th percentile.

    Returns
    -------
    (height, width, 3) uint8

    Raises
    ------
    StageError
        If the cloud is empty, or arrays do not fit together.
    """
    if classes is not None and values is not None:
        raise StageError("give 'classes' or 'values', not both", where="picture")
    given = {"x": x, "y": y, "z": z, "classes": classes, "values": values}
    x, y, z, *by = checked_columns(**{name: array for name, array in given.items() if array is not None})
    s = window(x, y, z, width)
    if classes is not None:
        shown = CLASS_COLORS[s.spread(class_codes(by[0]), 0)]
    elif values is not None:
        numbers = by[0].astype(np.float64)
        shown = ramp(s.spread(numbers, np.nan), *(limits or span(numbers)), "value")
    else:
        shown = ramp(s.z, *(limits or span(s.z)), "height")
    return paint(s, shown, shading(s))


def span(values: np.ndarray) -> tuple[float, float]:
    """The 1st and 99th percentile of the finite values: what a ramp shows."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return 0.0, 1.0
    low, high = np.percentile(finite, [1, 99])
    return float(low), float(high if high > low else low + 1.0)


def error_view(
    x: npt.ArrayLike,
    y: npt.ArrayLike,
    z: npt.ArrayLike,
    wrong: npt.ArrayLike,
    left_out: npt.ArrayLike,
    *,
    width: int = 900,
) -> np.ndarray:
    """The cloud from above: gray where points are right, red where they are `wrong`, pale where they are `left_out`.

    A wrong point is drawn over right ones of the same pixel, so that no error hides under a roof or a crown. Arrays are as
    for :func:`top_view`.
    """
    x, y, z, wrong, left_out = checked_columns(x=x, y=y, z=z, wrong=wrong, left_out=left_out)
    s = window(x, y, z, width)
    return paint(s, verdict(s, x, y, z, wrong, left_out), shading(s))


def verdict(
    s: Surface, x: np.ndarray, y: np.ndarray, z: np.ndarray, wrong: np.ndarray, left_out: np.ndarray
) -> np.ndarray:
    """Colors of the pixels of a surface, (height, width, 3) uint8: right, wrong or left out."""
    kinds = s.spread(np.where(left_out, 2, wrong).astype(np.int64), 0)
    shown = np.array([RIGHT, WRONG, IGNORED], dtype=np.uint8)[kinds]
    if wrong.any():
        f = s.frame
        good = wrong & np.isfinite(x) & np.isfinite(y) & np.isfinite(z)
        i = np.minimum(((x[good] - f.x0) / f.pixel).astype(np.int64), f.width - 1)
        j = np.minimum(((y[good] - f.y0) / f.pixel).astype(np.int64), f.height - 1)
        mask = np.zeros((f.height, f.width), dtype=bool)
        mask[f.height - 1 - j, i] = True
        grow = min(int(0.4 * s.spacing), 5)  # about as large as a point's share of the surface
        shown[ndimage.binary_dilation(mask, iterations=grow) if grow else mask] = WRONG
    return shown


def section_view(
    x: npt.ArrayLike,
    y: npt.ArrayLike,
    z: npt.ArrayLike,
    classes: npt.ArrayLike | None = None,
    *,
    start: tuple[float, float] | None = None,
    end: tuple[float, float] | None = None,
    thickness: float = 3.0,
    width: int = 1400,
) -> np.ndarray:
    """A vertical slice through the cloud, with a scale.

    Parameters
    ----------
    x, y, z : (n,) float
    classes : (n,) integer, optional
        Colors; heights where not given.
    start, end : (x, y), optional
        Ends of the section line; west to east through the middle where not given.
    thickness : float
        Depth of the slice in the cloud's unit, half on each side of the line.
    width : int
        Pixels across.
    """
    x, y, z = checked_columns(x=x, y=y, z=z)
    frame = Frame.around(x, y, 1000)
    middle = frame.y0 + 0.5 * frame.pixel * frame.height
    start = (frame.x0, middle) if start is None else start
    end = (frame.x0 + frame.pixel * frame.width, middle) if end is None else end
    run = (end[0] - start[0], end[1] - start[1])
    length = math.hypot(*run)
    if not (length > 0 and thickness > 0):
        raise StageError(
            "a section needs two different ends and a thickness above 0",
            where="section_view",
            found=(start, end, thickness),
        )
    s = ((x - start[0]) * run[0] + (y - start[1]) * run[1]) / length
    off = ((y - start[1]) * run[0] - (x - start[0]) * run[1]) / length
    keep = np.flatnonzero((s >= 0) & (s <= length) & (np.abs(off) <= thickness / 2) & np.isfinite(z))
    if not keep.size:
        raise StageError(
            "the section holds no points",
            where="section_view",
            found=f"{start} to {end}",
            cure="Move it into the cloud, or give a larger 'thickness'",
        )
    keep = keep[np.argsort(off[keep], kind="stable")[::-1]]  # far ones first
    low, high = float(z[keep].min()), float(z[keep].max())
    left, bottom, above = 64, 46, 16
    scale = (width - left - 16) / length
    tall = max(24, math.ceil((high - low) * scale) + 8)
    if tall > 4 * width:
        raise StageError(
            "the section is much higher than wide",
            where="section_view",
            found=f"{length:g} long, {high - low:g} high",
            cure="Give a longer line, or remove points far from the rest",
        )
    base = above + tall - 4
    canvas = Image.new("RGB", (width, tall + bottom + above), BACKGROUND)
    pen = ImageDraw.Draw(canvas)
    step = nice_step(length / 8)
    for n in range(int(length / step) + 1):
        at = left + round(n * step * scale)
        pen.line((at, above, at, above + tall), GRIDLINE)
        pen.text((at, above + tall + 8), f"{n * step:g}", FAINT, font(), anchor="ma")
    step = nice_step(max((high - low) / 5, 1e-6))
    for n in range(math.ceil(low / step), math.floor(high / step) + 1):
        at = base - round((n * step - low) * scale)
        pen.line((left, at, width - 16, at), GRIDLINE)
        pen.text((left - 8, at), f"{n * step:g}", FAINT, font(), anchor="rm")
    if classes is not None:
        color = CLASS_COLORS[class_codes(np.asarray(classes))[keep]]
    else:
        color = ramp(z[keep], low, high, "height")
    # The nearest point of each pixel, then the nearest of each disc around a pixel.
    nearest = np.full((canvas.height, canvas.width), -1)
    column = left + np.round(s[keep] * scale).astype(np.int64)
    row = base - np.round((z[keep] - low) * scale).astype(np.int64)
    nearest[row, column] = np.arange(keep.size)
    spacing = math.sqrt(length * (high - low + 1) / keep.size) * scale
    nearest = ndimage.maximum_filter(nearest, footprint=_SMALL_DOT if spacing < 5 else _DOT)
    out = np.array(canvas)
    out[nearest >= 0] = color[nearest[nearest >= 0]]
    return out


def nice_step(rough: float) -> float:
    """1, 2 or 5 times a power of ten, at least about `rough`."""
    power = 10.0 ** math.floor(math.log10(rough))
    return next(m * power for m in (1, 2, 5, 10) if m * power >= rough * 0.999)
