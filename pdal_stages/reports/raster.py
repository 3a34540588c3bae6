"""From points to pixels: the highest point of each pixel, gaps closed from the nearest, relief by shading."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from ..base.errors import StageError
from ..base.jit import njit

BACKGROUND = (246, 246, 243)
#: More pixels than this are refused: a picture, not a map sheet.
MOST_PIXELS = 25_000_000


@dataclass(frozen=True)
class Frame:
    """A map window: lower left corner, units per pixel, and size in pixels."""

    x0: float
    y0: float
    pixel: float
    width: int
    height: int

    @staticmethod
    def around(x: np.ndarray, y: np.ndarray, width: int) -> Frame:
        """The window of all finite points, `width` pixels wide (narrower where it would be more than 2.5 times as tall)."""
        good = np.isfinite(x) & np.isfinite(y)
        if not good.any():
            raise StageError(
                "there is nothing to draw: no point has finite coordinates",
                where="picture",
                found=f"{x.size} points",
                cure="Check that the pipeline before the picture leaves points",
            )
        x0, x1 = float(np.min(x, where=good, initial=np.inf)), float(np.max(x, where=good, initial=-np.inf))
        y0, y1 = float(np.min(y, where=good, initial=np.inf)), float(np.max(y, where=good, initial=-np.inf))
        wide, tall = max(x1 - x0, 1e-3), max(y1 - y0, 1e-3)
        pixel = max(wide / width, tall / (2.5 * width))
        return Frame(x0, y0, pixel, max(2, math.ceil(wide / pixel)), max(2, math.ceil(tall / pixel)))


@njit
def _highest(x, y, z, x0, y0, pixel, top, which, base):
    height, width = top.shape
    for n in range(x.size):
        if not (math.isfinite(x[n]) and math.isfinite(y[n]) and math.isfinite(z[n])):
            continue
        i, j = math.floor((x[n] - x0) / pixel), math.floor((y[n] - y0) / pixel)
        i, j = (width - 1 if i == width else i), (height - 1 if j == height else j)
        if 0 <= i < width and 0 <= j < height:
            row = height - 1 - j
            if z[n] > top[row, i]:
                top[row, i] = z[n]
                which[row, i] = base + n


@dataclass(frozen=True)
class Surface:
    """The highest point of each pixel: ``which`` (row of the point, -1: none) and ``z`` (NaN: none)."""

    frame: Frame
    which: np.ndarray
    z: np.ndarray
    spacing: float  # typical distance of neighboring points in pixels, 1 at least

    def spread(self, values: np.ndarray, missing) -> np.ndarray:
        """Per-point values on the pixels."""
        out = np.full(self.which.shape + values.shape[1:], missing, dtype=values.dtype)
        seen = self.which >= 0
        out[seen] = values[self.which[seen]]
        return out


def surface(x: np.ndarray, y: np.ndarray, z: np.ndarray, frame: Frame) -> Surface:
    """Grid the highest points, (n,) float each; an empty pixel takes the nearest within 1.6 times the points' spacing."""
    if frame.width * frame.height > MOST_PIXELS:
        raise StageError(
            "the picture is too large",
            where="picture",
            found=f"{frame.width} x {frame.height} pixels",
            cure="Give a smaller 'width'",
        )
    top = np.full((frame.height, frame.width), -np.inf)
    which = np.full((frame.height, frame.width), -1, dtype=np.int64)
    for base in range(0, len(x), 4_000_000):  # bounded copies of columns that are not contiguous float64
        part = slice(base, base + 4_000_000)
        xyz = [np.ascontiguousarray(a[part], dtype=np.float64) for a in (x, y, z)]
        _highest(*xyz, frame.x0, frame.y0, frame.pixel, top, which, base)
    seen = which >= 0
    if not seen.any():
        raise StageError(
            "there is nothing to draw: no point has a finite height",
            where="picture",
            found=f"{len(x)} points",
        )
    spacing = 1.0
    if not seen.all():
        away, at = ndimage.distance_transform_edt(~seen, return_indices=True)
        # Spacing inside the cloud: pixels near some point, per pixel that has one.
        share = math.sqrt(seen.size / seen.sum())
        spacing = max(1.0, math.sqrt((away <= share).sum() / seen.sum()))
        fill = ~seen & (away <= 1.6 * spacing)
        which[fill] = which[at[0][fill], at[1][fill]]
        top[fill] = top[at[0][fill], at[1][fill]]
    top[which < 0] = np.nan
    return Surface(frame, which, top, spacing)


def blur(image: np.ndarray, size: float) -> np.ndarray:
    """Gaussian blur; a wide one on an image made smaller first, which shows no difference."""
    factor = int(size / 3)
    if factor < 2:
        return ndimage.gaussian_filter(image, size, mode="nearest", truncate=3.0)
    height, width = image.shape
    padded = np.pad(image, ((0, -height % factor), (0, -width % factor)), mode="edge")
    tall, wide = padded.shape[0] // factor, padded.shape[1] // factor
    small = padded.reshape(tall, factor, wide, factor).mean(axis=(1, 3))
    small = ndimage.gaussian_filter(small, size / factor, mode="nearest", truncate=3.0)
    large = ndimage.zoom(small, factor, order=1, mode="nearest", grid_mode=True)
    return large[:height, :width]


def shading(s: Surface) -> np.ndarray:
    """Light on the surface, about 0.5 (dark) to 1.15: sun from the north-west and open sky.

    The sun gives shape to roofs and slopes; the sky term darkens what lies lower than its surroundings, as
    streets between houses do.
    """
    known = np.isfinite(s.z)
    level = np.nanmedian(s.z)
    above = np.where(known, s.z - level, 0.0).astype(np.float32)
    weight = known.astype(np.float32)
    widest = 0.1 * max(s.z.shape)  # wider shows nothing more

    def height_around(size: float) -> np.ndarray:
        size = min(size, widest)
        soft = [blur(a, size) for a in (above, weight)]
        return soft[0] / np.maximum(soft[1], 1e-6)

    fine = height_around(0.45 * s.spacing)
    gy, gx = np.gradient(fine, s.frame.pixel)
    gy = -gy  # rows run south
    sun = (0.5 * gx - 0.5 * gy + 0.75) / np.sqrt(1 + gx * gx + gy * gy) / 0.75
    meters = 1.0 / s.frame.pixel
    low = 0.0
    for size in (1.5, 6.0):
        around = height_around(max(size * meters, 1.2 * s.spacing))
        low = low + 0.5 * np.clip((fine - around) / (1.2 * size), -1, 1)
    light = 0.62 + 0.34 * np.clip(sun, 0, 1.35) + 0.22 * low
    return np.where(known, np.clip(light, 0.42, 1.18), 1.0)


def paint(s: Surface, colors: np.ndarray, light: np.ndarray | None) -> np.ndarray:
    """Pixels from per-pixel colors and light; empty ones get the background."""
    out = colors.astype(float)
    if light is not None:
        out = np.where(light[..., None] <= 1, out * light[..., None], 255 - (255 - out) / light[..., None])
    out[s.which < 0] = BACKGROUND
    return np.clip(np.round(out), 0, 255).astype(np.uint8)
