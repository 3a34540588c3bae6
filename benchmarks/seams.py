"""Whether a survey in files is classified as the whole would be: real clouds cut where houses
stand.

    python benchmarks/seams.py --data FOLDER

Each cloud is classified as one file and, cut at two lines through buildings, as four: in tiles,
and each alone.
Prints how many points differ in class, height or reliability.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import laspy
import numpy as np

DIMENSIONS = ("classification", "HeightAboveGround", "Reliability")


def busiest(values: np.ndarray, weights: np.ndarray, low: float, high: float) -> float:
    """The line, of those at whole meters, on both sides of which the most points of buildings
    lie."""
    edges = np.arange(np.ceil(low), np.floor(high) + 1)
    counts = np.histogram(values[weights], edges)[0]
    return float(edges[np.argmax(counts[:-1] + counts[1:]) + 1])


def cut(path: Path, folder: Path) -> tuple[Path, list[Path]]:
    """The cloud as one file, and as four that meet where buildings are."""
    las = laspy.read(path)
    x, y = np.asarray(las.x), np.asarray(las.y)
    building = np.asarray(las.classification) == 6
    thirds = [(v.min() + np.ptp(v) / 4, v.max() - np.ptp(v) / 4) for v in (x, y)]
    at = [busiest(v, building, *third) for v, third in zip((x, y), thirds, strict=True)]
    parts = []
    for number in range(4):
        inside = ((x >= at[0]) == bool(number & 1)) & ((y >= at[1]) == bool(number & 2))
        part = laspy.LasData(las.header)
        part.points = las.points[inside]
        parts.append(folder / f"part{number}.laz")
        part.write(parts[-1])
    close = (np.abs(x - at[0]) < 10) | (np.abs(y - at[1]) < 10)
    print(
        f"{path.name}: {len(x):,} points, {np.count_nonzero(close & building):,} of buildings "
        "within 10 m of a cut"
    )
    return path, parts


def classify(*words: object) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "pdal_stages.cli", "classify", *map(str, words), "--no-progress"],
        capture_output=True,
        text=True,
    )
    if done.returncode:
        sys.exit(done.stderr)


def ordered(paths: list[Path]) -> dict[str, np.ndarray]:
    """Values of all points, in an order that depends on the points alone."""
    read = [laspy.read(path) for path in paths]
    xyz = np.concatenate(
        [np.column_stack([r.X, r.Y, r.Z, np.asarray(r.gps_time).view(np.int64)]) for r in read]
    )
    order = np.lexsort(xyz.T)
    return {
        "xyz": xyz[order],
        **{name: np.concatenate([np.asarray(r[name]) for r in read])[order] for name in DIMENSIONS},
    }


def main() -> None:
    p = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument(
        "--data", type=Path, required=True, help="The folder with delft/ and montpellier/"
    )
    p.add_argument("--tile", type=float, default=40.0)
    o = p.parse_args()
    for path in [
        o.data / "delft" / "train.laz",
        *sorted((o.data / "montpellier").glob("train_*_627755.laz")),
    ]:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            whole, parts = cut(path, folder)
            classify(whole, folder / "whole.laz")
            classify(*parts, folder / "tiles/", "--tile", o.tile)
            (folder / "alone").mkdir()
            for part in parts:
                classify(part, folder / "alone" / part.name)
            first = ordered([folder / "whole.laz"])
            for way in ("tiles", "alone"):
                other = ordered([folder / way / part.name for part in parts])
                assert np.array_equal(first["xyz"], other["xyz"])
                differ = {n: np.count_nonzero(first[n] != other[n]) for n in DIMENSIONS}
                print(f"  {way}:", ", ".join(f"{n} {count:,}" for n, count in differ.items()))


if __name__ == "__main__":
    main()
