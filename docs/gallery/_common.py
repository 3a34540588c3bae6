"""The town every gallery script uses, and where pictures go."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from pdal_stages.reports.pictures import CLASS_COLORS, paint, ramp, shading, surface, write_png
from pdal_stages.synthetic import Town, make_town

#: Tests set a smaller town and another folder.
SIZE = float(os.environ.get("GALLERY_SIZE", "120"))
OUTPUT = Path(os.environ.get("GALLERY_OUTPUT", Path(__file__).parent / "pictures"))


def town(seed: int = 1) -> Town:
    return make_town(size=SIZE, density=7.0, seed=seed, progress=False)


def halves(points: Town) -> tuple[np.ndarray, np.ndarray]:
    """Masks of the western and the eastern half."""
    west = points.x < np.median(points.x)
    return west, ~west


def save(name: str, rgb: np.ndarray) -> None:
    OUTPUT.mkdir(parents=True, exist_ok=True)
    write_png(OUTPUT / f"{name}.png", rgb)
    print(OUTPUT / f"{name}.png")


#: Values dark to bright with even lightness.
VALUES = (68, 1, 84), (65, 68, 135), (42, 120, 142), (34, 168, 132), (122, 209, 81), (253, 231, 37)


def top_view(x, y, z, classes=None, *, values=None, width: int = 900, limits=None) -> np.ndarray:
    """The cloud from above, colored by class or by a value between limits."""
    s = surface(x, y, z, width)
    if classes is not None:
        return paint(s, CLASS_COLORS[s.per_pixel(classes, 0)], shading(s))
    return paint(
        s, ramp(s.per_pixel(np.asarray(values, float), np.nan), VALUES, limits), shading(s)
    )
