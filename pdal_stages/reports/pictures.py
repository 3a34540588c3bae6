"""Pictures of a cloud from above, and PNG files of them.

Each pixel shows its highest point; gaps are filled from the nearest one, and relief is shaded.
"""

from __future__ import annotations

import base64
import io
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image
from scipy import ndimage

from ..base.asprs import class_color
from ..base.errors import StageError
from ..base.files import write_whole

RIGHT, WRONG, IGNORED = (196, 196, 192), (204, 24, 32), (232, 232, 228)
#: The color of each class code, (256, 3) uint8.
CLASS_COLORS = np.array([class_color(code) for code in range(256)], dtype=np.uint8)
#: Heights like a tinted map, as a few anchors.
_TINTS = (
    (38, 84, 106), (62, 128, 112), (132, 170, 104), (208, 200, 130), (206, 152, 98), (172, 102, 84), (233, 204, 186)
)  # fmt: skip
_GAP = 12
BACKGROUND = (246, 246, 243)


def png(rgb: npt.NDArray[np.uint8]) -> bytes:
    """A (height, width, 3) uint8 image as a PNG file of at most 256 colors, rare ones among them."""
    file, image = io.BytesIO(), Image.fromarray(np.ascontiguousarray(rgb))
    image.quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(file, "PNG")
    return file.getvalue()


def embedded(rgb: npt.NDArray[np.uint8]) -> dict[str, Any]:
    """An image for a template: its file as text, its size."""
    return {
        "base64": base64.b64encode(png(rgb)).decode("ascii"),
        "tall": rgb.shape[0],
        "wide": rgb.shape[1],
    }


def write_png(path: str | os.PathLike[str], rgb: npt.NDArray[np.uint8]) -> Path:
    """Write an image as a PNG file of all its colors, whole or not at all."""
    file = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(rgb)).save(file, "PNG")
    return write_whole(path, file.getvalue(), what="picture")


@dataclass(frozen=True)
class Surface:
    """The highest point of each pixel of a map that is `pixel` units fine and whose lower left corner is (x0, y0).

    ``which`` is the row of the point (-1: none), ``z`` its height (NaN: none), ``spacing`` the typical distance of
    neighboring points in pixels, 1 at least.
    """

    x0: float
    y0: float
    pixel: float
    which: np.ndarray
    z: np.ndarray
    spacing: float

    def spread(self, values: np.ndarray, missing) -> np.ndarray:
        """Values of points as values of pixels."""
        return np.where(self.which >= 0, values[self.which], np.array(missing, values.dtype))

    def cells(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of finite places on the map."""
        height, width = self.which.shape
        row = height - 1 - np.floor((y - self.y0) / self.pixel).astype(np.int64)
        return row.clip(0), np.floor((x - self.x0) / self.pixel).astype(np.int64).clip(
            None, width - 1
        )


def surface(x: np.ndarray, y: np.ndarray, z: np.ndarray, width: int) -> Surface:
    """The map of points, (n,) float each, `width` pixels wide (narrower where it would be more than 2.5 times as tall).

    An empty pixel takes the nearest point within 1.6 times the points' spacing; points that are not finite are left out.
    """
    if not 16 <= int(width) <= 3000:
        raise StageError("'width' must be from 16 to 3000 pixels", where="picture", found=width)
    good = np.flatnonzero(np.isfinite(x) & np.isfinite(y) & np.isfinite(z))
    if not good.size:
        raise StageError(
            "there is nothing to draw: no point has finite coordinates",
            where="picture",
            found=f"{x.size} points",
            cure="Check that the pipeline before the picture leaves points",
        )
    x, y, z = (np.asarray(a[good], np.float64) for a in (x, y, z))
    x0, y0 = float(x.min()), float(y.min())
    wide, tall = max(float(x.max()) - x0, 1e-3), max(float(y.max()) - y0, 1e-3)
    pixel = max(wide / width, tall / (2.5 * width))
    shape = max(2, math.ceil(tall / pixel)), max(2, math.ceil(wide / pixel))
    made = Surface(x0, y0, pixel, np.full(shape, -1), np.full(shape, np.nan), 1.0)
    order = np.argsort(z, kind="stable")
    cells = made.cells(x[order], y[order])
    made.which[cells], made.z[cells] = (
        good[order],
        z[order],
    )  # of several the last stays: the highest
    seen = made.which >= 0
    if seen.all():
        return made
    away, at = ndimage.distance_transform_edt(~seen, return_indices=True)
    # Spacing inside the cloud: pixels near some point, per pixel that has one.
    share = math.sqrt(seen.size / seen.sum())
    spacing = max(1.0, math.sqrt((away <= share).sum() / seen.sum()))
    near = np.where(away <= 1.6 * spacing, made.which[tuple(at)], -1)
    return Surface(x0, y0, pixel, near, np.where(near >= 0, made.z[tuple(at)], np.nan), spacing)


def shading(s: Surface) -> np.ndarray:
    """Light on the surface, about 0.4 (dark) to 1.2: sun from the north-west, and less sky where surroundings are higher."""
    known = np.isfinite(s.z)
    above, weight = (
        np.where(known, s.z - np.nanmedian(s.z), 0.0).astype(np.float32),
        known.astype(np.float32),
    )

    def smooth(size: float) -> np.ndarray:
        soft, of = (
            ndimage.gaussian_filter(a, size, mode="nearest", truncate=2.0) for a in (above, weight)
        )
        return soft / np.maximum(of, 1e-6)

    fine = smooth(0.45 * s.spacing)
    south, east = np.gradient(fine, s.pixel)
    sun = (0.5 * east + 0.5 * south + 0.75) / np.sqrt(1 + east**2 + south**2) / 0.75
    around = smooth(min(max(4.0 / s.pixel, 1.2 * s.spacing), 0.1 * max(s.z.shape)))
    light = 0.62 + 0.34 * np.clip(sun, 0, 1.35) + 0.22 * np.clip((fine - around) / 4.8, -1, 1)
    return np.where(known, np.clip(light, 0.42, 1.18), 1.0)


def paint(s: Surface, colors: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Pixels from per-pixel colors and light; empty ones get the background."""
    light, out = light[..., None], colors.astype(float)
    out = np.where(light <= 1, out * light, 255 - (255 - out) / light)
    out[s.which < 0] = BACKGROUND
    return np.clip(np.round(out), 0, 255).astype(np.uint8)


def ramp(
    values: np.ndarray, anchors: npt.ArrayLike, limits: tuple[float, float] | None = None
) -> np.ndarray:
    """Colors, (..., 3) uint8, of values between limits, by default the 1st and 99th percentile; NaN becomes mid gray."""
    good, colors = np.isfinite(values), np.asarray(anchors, dtype=float)
    low, high = limits or (np.percentile(values[good], [1, 99]) if good.any() else (0.0, 1.0))
    share = np.where(good, values - low, 0.0) / max(high - low, 1e-12) * (len(colors) - 1)
    out = np.stack(
        [np.interp(share, np.arange(len(colors)), colors[:, c]) for c in range(3)], axis=-1
    )
    out[~good] = 150
    return np.round(out).astype(np.uint8)


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
    x: np.ndarray,
    y: np.ndarray,
    z: np.ndarray,
    predicted: np.ndarray,
    truth: np.ndarray | None = None,
    *,
    width: int = 1500,
) -> np.ndarray:
    """Heights, classes and errors (wrong points red) side by side, (height, width, 3) uint8.

    Without `truth`, the reference classes (n,), there is no panel of errors; `width` is of all panels, about, in pixels.
    """
    panels = 2 if truth is None else 3
    s = surface(x, y, z, (int(width) - _GAP * (panels - 1)) // panels)
    shown = [ramp(s.z, _TINTS), CLASS_COLORS[s.spread(predicted, 0)]]
    if truth is not None:
        wrong = predicted != truth
        shown.append(verdict(s, x, y, z, wrong, np.zeros_like(wrong)))
    light, gap = shading(s), np.full((len(s.z), _GAP, 3), BACKGROUND, np.uint8)
    return np.concatenate(
        [part for colors in shown for part in (gap, paint(s, colors, light))][1:], axis=1
    )


def nice_step(rough: float) -> float:
    """1, 2 or 5 times a power of ten, at least about `rough`."""
    power = 10.0 ** math.floor(math.log10(rough))
    return next(m * power for m in (1, 2, 5, 10) if m * power >= rough * 0.999)
