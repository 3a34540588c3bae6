"""Pictures of a cloud from above, by class, height, value or error, and PNG files of them."""

from __future__ import annotations

import base64
import io
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image
from scipy import ndimage

from ..base.asprs import class_color
from ..base.errors import StageError
from ..base.files import write_whole
from .raster import BACKGROUND, Surface, paint, shading, surface

RIGHT, WRONG, IGNORED = (196, 196, 192), (204, 24, 32), (232, 232, 228)
#: The color of each class code, (256, 3) uint8.
CLASS_COLORS = np.array([class_color(code) for code in range(256)], dtype=np.uint8)
#: Color ramps, as a few anchors: heights like a tinted map; values dark to bright with even lightness.
_RAMPS = {
    "height": (
        (38, 84, 106), (62, 128, 112), (132, 170, 104), (208, 200, 130), (206, 152, 98), (172, 102, 84), (233, 204, 186)
    ),
    "value": ((68, 1, 84), (65, 68, 135), (42, 120, 142), (34, 168, 132), (122, 209, 81), (253, 231, 37)),
}  # fmt: skip
_GAP = 12


def png(rgb: npt.NDArray[np.uint8]) -> bytes:
    """A (height, width, 3) uint8 image as a PNG file of at most 256 colors; the same image gives the same bytes.

    Class maps are few colors in many shades, so channels in steps of 4 to 16 levels do, and a rare class keeps its color.
    """
    image = Image.fromarray(np.ascontiguousarray(rgb))
    for step in (1, 4, 8, 12, 16, 24, 32, 48, 64):  # 64: at most 5 x 5 x 5 colors
        rounded = np.minimum((rgb.astype(np.uint16) + step // 2) // step * step, 255)
        image = Image.fromarray(rounded.astype(np.uint8))
        if image.getcolors(256):
            break
    file = io.BytesIO()
    image.quantize(256, dither=Image.Dither.NONE).save(file, "PNG")
    return file.getvalue()


def embedded(rgb: npt.NDArray[np.uint8]) -> dict[str, Any]:
    """An image for a template: its file as text, its size."""
    return {"base64": base64.b64encode(png(rgb)).decode("ascii"), "tall": rgb.shape[0], "wide": rgb.shape[1]}


def write_png(path: str | os.PathLike[str], rgb: npt.NDArray[np.uint8]) -> Path:
    """Write an image as a PNG file of all its colors, whole or not at all."""
    file = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(rgb)).save(file, "PNG")
    return write_whole(path, file.getvalue(), what="picture")


def ramp(values: np.ndarray, limits: tuple[float, float] | None = None, name: str = "value") -> np.ndarray:
    """Colors, (..., 3) uint8, of values between limits, by default the 1st and 99th percentile; NaN becomes mid gray."""
    good, anchors = np.isfinite(values), np.array(_RAMPS[name], dtype=float)
    low, high = limits or (np.percentile(values[good], [1, 99]) if good.any() else (0.0, 1.0))
    if limits is None and high <= low:
        high = low + 1.0
    share = np.where(good, values - low, 0.0) / max(high - low, 1e-12) * (len(anchors) - 1)
    out = np.stack([np.interp(share, np.arange(len(anchors)), anchors[:, c]) for c in range(3)], axis=-1)
    out[~good] = 150
    return np.round(out).astype(np.uint8)


def columns(**arrays: npt.ArrayLike | None) -> list[np.ndarray]:
    """Arrays of one value per point, all as long as the first; their names are for messages.

    ``classes``, ``predicted`` and ``truth`` are codes from 0 to 255, and become (n,) uint8.
    """
    given = {name: np.asarray(a) for name, a in arrays.items() if a is not None}
    size = next(iter(given.values())).shape
    for name, a in given.items():
        if a.ndim != 1 or a.shape != size:
            raise StageError(
                f"'{name}' must be one value per point", where="picture", found=f"shape {a.shape}"
            )
        if name in ("classes", "predicted", "truth"):
            if a.dtype.kind not in "iub" or (a != a.astype(np.uint8)).any():
                raise StageError(
                    "classes must be whole numbers from 0 to 255", where="picture", found=a.dtype
                )
            given[name] = a.astype(np.uint8)
    return list(given.values())


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
    x, y, z, *by = columns(x=x, y=y, z=z, classes=classes, values=values)
    s = surface(x, y, z, width)
    if classes is not None:
        shown = CLASS_COLORS[s.spread(by[0], 0)]
    elif values is not None:
        shown = ramp(s.spread(by[0].astype(np.float64), np.nan), limits)
    else:
        shown = ramp(s.z, limits, "height")
    return paint(s, shown, shading(s))


def verdict(
    s: Surface, x: np.ndarray, y: np.ndarray, z: np.ndarray, wrong: np.ndarray, left_out: np.ndarray
) -> np.ndarray:
    """Colors of the pixels of a surface, (height, width, 3) uint8: right, wrong or left out.

    A wrong point is drawn over right ones of the same pixel, so that no error hides under a roof or a crown.
    """
    kinds = s.spread(np.where(left_out, 2, wrong).astype(np.int64), 0)
    shown = np.array([RIGHT, WRONG, IGNORED], dtype=np.uint8)[kinds]
    good = wrong & np.isfinite(x) & np.isfinite(y) & np.isfinite(z)
    mask = np.zeros(s.which.shape, bool)
    mask[s.cells(x[good], y[good])] = True
    grow = min(int(0.4 * s.spacing), 5)  # about as large as a point's share of the surface
    shown[ndimage.binary_dilation(mask, iterations=grow) if grow else mask] = WRONG
    return shown


def triptych(
    x: npt.ArrayLike,
    y: npt.ArrayLike,
    z: npt.ArrayLike,
    predicted: npt.ArrayLike,
    truth: npt.ArrayLike | None = None,
    *,
    width: int = 1500,
) -> np.ndarray:
    """Heights, classes and errors (wrong points red) side by side.

    Parameters
    ----------
    x, y, z : (n,) float
    predicted : (n,) integer
    truth : (n,) integer, optional
        Reference classes; without them there is no panel of errors.
    width : int
        Pixels across all panels, about.

    Returns
    -------
    (height, width, 3) uint8
    """
    x, y, z, predicted, *true = columns(x=x, y=y, z=z, predicted=predicted, truth=truth)
    panels = 2 + len(true)
    s = surface(x, y, z, (int(width) - _GAP * (panels - 1)) // panels)
    shown = [ramp(s.z, name="height"), CLASS_COLORS[s.spread(predicted, 0)]]
    for known in true:
        wrong = predicted != known
        shown.append(verdict(s, x, y, z, wrong, np.zeros_like(wrong)))
    light, gap = shading(s), np.full((len(s.z), _GAP, 3), BACKGROUND, np.uint8)
    return np.concatenate([part for colors in shown for part in (gap, paint(s, colors, light))][1:], axis=1)


def nice_step(rough: float) -> float:
    """1, 2 or 5 times a power of ten, at least about `rough`."""
    power = 10.0 ** math.floor(math.log10(rough))
    return next(m * power for m in (1, 2, 5, 10) if m * power >= rough * 0.999)
