"""From points to pixels: the highest point of each pixel, gaps closed from the nearest, relief by shading."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from ..base.errors import StageError

BACKGROUND = (246, 246, 243)


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
        """Per-point values on the pixels."""
        return np.where(self.which >= 0, values[self.which], np.array(missing, values.dtype))

    def cells(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of finite places on the map."""
        height, width = self.which.shape
        row = height - 1 - np.floor((y - self.y0) / self.pixel).astype(np.int64)
        return row.clip(0), np.floor((x - self.x0) / self.pixel).astype(np.int64).clip(None, width - 1)


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
    made.which[cells], made.z[cells] = good[order], z[order]  # of several the last stays: the highest
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
    above, weight = np.where(known, s.z - np.nanmedian(s.z), 0.0).astype(np.float32), known.astype(np.float32)

    def smooth(size: float) -> np.ndarray:
        soft, of = (ndimage.gaussian_filter(a, size, mode="nearest", truncate=2.0) for a in (above, weight))
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
