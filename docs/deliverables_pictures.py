"""The pictures of docs/deliverables.md, of Montpellier's six tiles with the classes they come with.

python docs/deliverables_pictures.py --data FOLDER        # writes docs/pictures/surfaces-*.png
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
import rasterio

from pdal_stages.cli import main as command
from pdal_stages.reports.pictures import (
    HEIGHT_COLORS,
    PANEL_GAP,
    Surface,
    paint,
    ramp,
    shading,
    write_png,
)

PICTURES = Path(__file__).resolve().parent / "pictures"
#: Colors of heights above the terrain, from 0.
CANOPY_COLORS = ((245, 242, 232), (186, 219, 110), (34, 122, 52), (16, 60, 70))
CELL = 0.5


def panel(path: Path) -> np.ndarray:
    """Return a raster as shaded colors, (height, width, 3) uint8."""
    with rasterio.open(path) as file:
        z = file.read(1, masked=True).astype(float).filled(np.nan)
    known = np.isfinite(z)
    map_ = Surface(0.0, 0.0, CELL, np.where(known, 0, -1), z, 1.0)
    canopy = path.stem == "canopy"
    colors = ramp(z, CANOPY_COLORS, (0.0, 25.0)) if canopy else ramp(z, HEIGHT_COLORS)
    light = np.ones_like(z) if canopy else shading(map_)
    return paint(map_, colors, light)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", required=True, type=Path)
    names = str(parser.parse_args().data / "montpellier" / "*.laz")
    with tempfile.TemporaryDirectory() as out:
        if command(["surfaces", names, out, f"--resolution={CELL}"]):
            raise SystemExit("surfaces failed")
        panels = [panel(Path(out) / f"{name}.tif") for name in ("terrain", "surface", "canopy")]
    gap = np.full((len(panels[0]), PANEL_GAP, 3), 255, np.uint8)
    whole = np.concatenate([part for each in panels for part in (gap, each)][1:], axis=1)
    write_png(PICTURES / "surfaces-montpellier.png", whole)


if __name__ == "__main__":
    main()
