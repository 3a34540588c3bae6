"""Large roofs: how much of each a shipped model calls building, by the roof's width.

    python benchmarks/surveys/halls.py --data DIR [--model standard]

Simulated halls stand alone on flat ground; the real ones are all roofs of at least 30 m width in two survey tiles, by
their own labels (6) in cells of 4 m. Width is that of the largest square that fits in.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from scipy import ndimage

import pdal_stages as ps
from pdal_stages.models import find

TILES = ("rural/ign_0p3ppm2.laz", "bridge/ign_0299_6802.laz")
CELL = 4.0


def simulated(model, width: float, height: float = 8.0, density: float = 4.0) -> float:
    """Share of a hall's points that are called building."""
    rng = np.random.default_rng(0)
    side = width + 120.0
    x, y = rng.uniform(0.0, side, (2, int(density * side * side)))
    on = (np.abs(x - side / 2) < width / 2) & (np.abs(y - side / 2) < width / 2)
    z = np.where(on, height, 0.0) + rng.normal(0.0, 0.03, x.size)
    ones = np.ones(x.size, np.uint8)
    returns = {"ReturnNumber": ones, "NumberOfReturns": ones}
    found = model.predict(np.column_stack([x + 5e5, y + 5e6, z]), returns).classification
    return float((found[on] == 6).mean())


def roofs(path: Path, model) -> list[tuple[float, int, float, float]]:
    """Width in meters, points, shares called building and ground, of each large roof."""
    pipeline = ps.Pipeline([str(path)])
    pipeline.execute()
    points = pipeline.arrays[0]
    xyz = np.column_stack([points["X"], points["Y"], points["Z"]])
    names = ("ReturnNumber", "NumberOfReturns")
    found = model.predict(xyz, {name: points[name] for name in names}).classification
    truth = points["Classification"]
    cells = np.floor((xyz[:, :2] - xyz[:, :2].min(0)) / CELL).astype(int) + 1
    grid = np.zeros(cells.max(0) + 2, bool)
    grid[tuple(cells[truth == 6].T)] = True
    grid = ndimage.binary_closing(grid, np.ones((3, 3)))
    labels, count = ndimage.label(grid)
    widths = ndimage.maximum(ndimage.distance_transform_cdt(grid), labels, np.arange(1, count + 1)) * 2 - 1
    out = []
    of_point = np.where(truth == 6, labels[tuple(cells.T)], 0)
    for number in np.flatnonzero(widths * CELL >= 30.0) + 1:
        codes = found[of_point == number]
        out.append((widths[number - 1] * CELL, codes.size, (codes == 6).mean(), (codes == 2).mean()))
    return sorted(out, reverse=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--model", default="standard")
    given = parser.parse_args()
    model = ps.load_model(find(given.model))
    for width in (30, 60, 100, 150, 200):
        print(f"simulated hall, {width} m: {100 * simulated(model, width):.1f} % building")
    for name in TILES:
        for width, points, building, ground in roofs(given.data / name, model):
            print(
                f"{name}: roof {width:.0f} m wide, {points:,} points: {100 * building:.1f} % building, "
                f"{100 * ground:.1f} % ground"
            )


if __name__ == "__main__":
    main()
