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

import numpy as np
import numpy.typing as npt
from PIL import Image
from scipy import ndimage

from ..base.asprs import class_color
from ..base.errors import StageError
from ..base.files import write_whole
from ..base.json_types import JsonObject

#: Colors (red, green, blue) of points with the right class, the wrong one, and not compared.
RIGHT = (196, 196, 192)
WRONG = (204, 24, 32)
IGNORED = (232, 232, 228)
#: Color of pixels without points.
BACKGROUND = (246, 246, 243)
#: Color of each class code, (256, 3) uint8.
CLASS_COLORS = np.array([class_color(code) for code in range(256)], dtype=np.uint8)
#: Colors of heights, from low to high, between which others are interpolated.
HEIGHT_COLORS = (
    (38, 84, 106), (62, 128, 112), (132, 170, 104), (208, 200, 130), (206, 152, 98),
    (172, 102, 84), (233, 204, 186),
)  # fmt: skip
#: Color of pixels whose value is not known: a gray, each of red, green and blue.
UNKNOWN = 150
#: Pixels between the panels of a picture.
PANEL_GAP = 12


@dataclass(frozen=True)
class PictureRules:
    """Sizes of pictures, and light on relief. Values without a reason are not tuned."""

    min_width: int = 16  #: pixels
    max_width: int = 3000  #: pixels; at most 22 million in all
    max_tallness: float = 2.5  #: height of a picture / its width
    min_extent: float = 1e-3  #: of a cloud, in the unit of x and y, so that pixels have a size
    gap_reach: float = 1.6  #: farthest point that an empty pixel takes, in spacings of points
    sun: tuple[float, float] = (0.5, 0.75)  #: direction: west and north alike, and up
    relief_blur: float = 0.45  #: standard deviation, in spacings of points
    surroundings: float = 4.0  #: standard deviation that makes them, in the unit of x and y
    min_surroundings: float = 1.2  #: the same at least, in spacings of points
    max_surroundings: float = 0.1  #: the same at most, as a share of the picture's longer side
    depth: float = 4.8  #: below or above the surroundings that changes light most, in z's unit
    blur_cut: float = 2.0  #: standard deviations at which a blur is cut off
    base_light: float = 0.62
    sunlight: float = 0.34  #: added on level ground
    max_sun: float = 1.35  #: on a slope towards the sun; level ground is 1
    skylight: float = 0.22  #: added on high places, taken off in low ones
    min_light: float = 0.42
    max_light: float = 1.18
    error_size: float = 0.4  #: half the side of a wrong point, in spacings of points
    max_error_size: int = 5  #: half the side of a wrong point, pixels


RULES = PictureRules()


def png(rgb: npt.NDArray[np.uint8]) -> bytes:
    """Return a (height, width, 3) uint8 image as a PNG file of at most 256 colors."""
    file, image = io.BytesIO(), Image.fromarray(np.ascontiguousarray(rgb))
    image.quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(file, "PNG")
    return file.getvalue()


def embed(rgb: npt.NDArray[np.uint8]) -> JsonObject:
    """Return an image for a template: its file as text, and its size in pixels."""
    return {
        "base64": base64.b64encode(png(rgb)).decode("ascii"),
        "tall": rgb.shape[0],
        "wide": rgb.shape[1],
    }


def write_png(path: str | os.PathLike[str], rgb: npt.NDArray[np.uint8]) -> Path:
    """Write :func:`png` of an image as a file, whole or not at all."""
    return write_whole(path, png(rgb), what="picture")


@dataclass(frozen=True)
class Surface:
    """The highest point of each pixel of a map."""

    x0: float  #: lower left corner
    y0: float
    pixel: float  #: side of a pixel, in the unit of x and y
    which: np.ndarray  #: (height, width) int64 index of the point, -1 for none
    z: np.ndarray  #: (height, width) its height, NaN for none
    spacing: float  #: typical distance of neighboring points in pixels, at least 1

    def per_pixel(self, values: np.ndarray, missing) -> np.ndarray:
        """Return values of points as values of pixels."""
        return np.where(self.which >= 0, values[self.which], np.array(missing, values.dtype))

    def cells(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return rows and columns of pixels of places, whose coordinates are finite."""
        height, width = self.which.shape
        row = height - 1 - np.floor((y - self.y0) / self.pixel).astype(np.int64)
        return row.clip(0), np.floor((x - self.x0) / self.pixel).astype(np.int64).clip(
            None, width - 1
        )


def surface(x: np.ndarray, y: np.ndarray, z: np.ndarray, width: int) -> Surface:
    """Return the map of points, (n,) float each.

    It is `width` pixels wide, or narrower where it would be taller than `RULES.max_tallness` times
    that. An empty pixel takes the nearest point within `RULES.gap_reach`. Points that are not
    finite are left out.
    """
    low, high = RULES.min_width, RULES.max_width
    if not low <= int(width) <= high:
        what = f"'width' must be from {low} to {high} pixels"
        raise StageError(what, where="picture", found=width)
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
    wide, tall = (max(float(v.max() - v.min()), RULES.min_extent) for v in (x, y))
    pixel = max(wide / width, tall / (RULES.max_tallness * width))
    shape = max(2, math.ceil(tall / pixel)), max(2, math.ceil(wide / pixel))
    full = Surface(x0, y0, pixel, np.full(shape, -1), np.full(shape, np.nan), 1.0)
    order = np.argsort(z, kind="stable")
    cells = full.cells(x[order], y[order])
    # Of several points of a pixel the last one stays: the highest.
    full.which[cells], full.z[cells] = good[order], z[order]
    seen = full.which >= 0
    if seen.all():
        return full
    distance, at = ndimage.distance_transform_edt(~seen, return_indices=True)
    # Spacing inside the cloud: pixels near a point, per pixel that has one.
    expected = math.sqrt(seen.size / seen.sum())
    spacing = max(1.0, math.sqrt((distance <= expected).sum() / seen.sum()))
    near = np.where(distance <= RULES.gap_reach * spacing, full.which[tuple(at)], -1)
    return Surface(x0, y0, pixel, near, np.where(near >= 0, full.z[tuple(at)], np.nan), spacing)


def shading(s: Surface) -> np.ndarray:
    """Return the light on each pixel, `RULES.min_light` (dark) to `RULES.max_light`.

    The sun is in the north-west, and there is less sky where the surroundings are higher.
    """
    known = np.isfinite(s.z)
    above = np.where(known, s.z - np.nanmedian(s.z), 0.0).astype(np.float32)

    def smooth(size: float) -> np.ndarray:
        total, weight = (
            ndimage.gaussian_filter(values, size, mode="nearest", truncate=RULES.blur_cut)
            for values in (above, known.astype(np.float32))
        )
        return total / np.maximum(weight, 1e-6)

    fine = smooth(RULES.relief_blur * s.spacing)
    south, east = np.gradient(fine, s.pixel)
    flat, up = RULES.sun
    sun = (flat * east + flat * south + up) / np.sqrt(1 + east**2 + south**2) / up
    width = max(RULES.surroundings / s.pixel, RULES.min_surroundings * s.spacing)
    surroundings = smooth(min(width, RULES.max_surroundings * max(s.z.shape)))
    light = RULES.base_light + RULES.sunlight * np.clip(sun, 0, RULES.max_sun)
    light += RULES.skylight * np.clip((fine - surroundings) / RULES.depth, -1, 1)
    return np.where(known, np.clip(light, RULES.min_light, RULES.max_light), 1.0)


def paint(s: Surface, colors: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Return an image from colors and light of pixels; empty ones get the background."""
    light, out = light[..., None], colors.astype(float)
    out = np.where(light <= 1, out * light, 255 - (255 - out) / light)
    out[s.which < 0] = BACKGROUND
    return np.clip(np.round(out), 0, 255).astype(np.uint8)


def ramp(
    values: np.ndarray, anchors: npt.ArrayLike, limits: tuple[float, float] | None = None
) -> np.ndarray:
    """Return colors (..., 3) uint8 of values between limits; NaN becomes gray.

    Limits are the 1st and 99th percentile by default.
    """
    good, colors = np.isfinite(values), np.asarray(anchors, dtype=float)
    low, high = limits or (np.percentile(values[good], [1, 99]) if good.any() else (0.0, 1.0))
    share = np.where(good, values - low, 0.0) / max(high - low, 1e-12) * (len(colors) - 1)
    out = np.stack(
        [np.interp(share, np.arange(len(colors)), colors[:, c]) for c in range(3)], axis=-1
    )
    out[~good] = UNKNOWN
    return np.round(out).astype(np.uint8)


def error_colors(
    s: Surface, x: np.ndarray, y: np.ndarray, z: np.ndarray, wrong: np.ndarray, left_out: np.ndarray
) -> np.ndarray:
    """Return colors of the pixels of a surface, (height, width, 3) uint8.

    A wrong point is drawn over right ones of its pixel, so that no error hides under a roof.
    """
    kinds = s.per_pixel(np.where(left_out, 2, wrong).astype(np.int64), 0)
    shown = np.array([RIGHT, WRONG, IGNORED], dtype=np.uint8)[kinds]
    good = wrong & np.isfinite(x) & np.isfinite(y) & np.isfinite(z)
    mask = np.zeros(s.which.shape, bool)
    mask[s.cells(x[good], y[good])] = True
    grow = min(int(RULES.error_size * s.spacing), RULES.max_error_size)  # about as large as a point
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
    """Return an image of heights, classes and errors side by side, (height, width, 3) uint8.

    Without `truth`, the reference classes (n,), there is no panel of errors. `width` is that of all
    panels together, about, in pixels.
    """
    panels = 2 if truth is None else 3
    s = surface(x, y, z, (int(width) - PANEL_GAP * (panels - 1)) // panels)
    shown = [ramp(s.z, HEIGHT_COLORS), CLASS_COLORS[s.per_pixel(predicted, 0)]]
    if truth is not None:
        wrong = predicted != truth
        shown.append(error_colors(s, x, y, z, wrong, np.zeros_like(wrong)))
    light, gap = shading(s), np.full((len(s.z), PANEL_GAP, 3), BACKGROUND, np.uint8)
    return np.concatenate(
        [part for colors in shown for part in (gap, paint(s, colors, light))][1:], axis=1
    )


def nice_step(rough: float) -> float:
    """Return 1, 2 or 5 times a power of ten, at least about `rough`."""
    power = 10.0 ** math.floor(math.log10(rough))
    return next(m * power for m in (1, 2, 5, 10) if m * power >= rough * 0.999)
