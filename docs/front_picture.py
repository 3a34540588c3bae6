"""The picture of the first page: a real tile as it comes and as ``pdal-stages classify`` gives it
back.

python docs/front_picture.py --data FOLDER        # writes docs/pictures/raw-and-classified.png

FOLDER holds montpellier/test_*.laz, two adjoining 50 m tiles of the French national survey that the
shipped model has not seen.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import laspy
import numpy as np

from pdal_stages.cli import main as command
from pdal_stages.reports.pictures import CLASS_COLORS, paint, shading, surface, write_png

TARGET = Path(__file__).resolve().parent / "pictures" / "raw-and-classified.png"
GAP = 24  # pixels between the halves


def picture(folder: Path, width: int = 620) -> np.ndarray:
    """Both halves side by side, (height, width, 3) uint8."""
    names = sorted(str(path) for path in folder.glob("montpellier/test_*.laz"))
    with tempfile.TemporaryDirectory() as out:
        if command(["classify", *names, out]):
            raise SystemExit("classify failed")
        clouds = [laspy.read(path) for path in sorted(Path(out).glob("*.laz"))]
    x, y, z, classes = (
        np.concatenate([np.asarray(getattr(cloud, name)) for cloud in clouds])
        for name in ("x", "y", "z", "classification")
    )
    seen = surface(y, -x, z, width)  # east up, so that the row of tiles lies
    light = shading(seen)
    raw, classified = (
        paint(seen, colors, light)
        for colors in (np.full((*light.shape, 3), 150), CLASS_COLORS[seen.per_pixel(classes, 0)])
    )
    return np.concatenate([raw, np.full((len(raw), GAP, 3), 255, np.uint8), classified], axis=1)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", required=True, type=Path)
    write_png(TARGET, picture(parser.parse_args().data))
