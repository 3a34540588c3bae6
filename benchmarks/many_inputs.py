"""Many small inputs, and overlapping flight strips, against the same points in one piece.

    python benchmarks/many_inputs.py --side 500

A generated town is written as one file, as square files of 20 m, and as 30 long files that overlap. `classify` runs over
each, and the CPU seconds of program and workers are printed (median of --runs).
"""

from __future__ import annotations

import argparse
import json
import resource
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import laspy
import numpy as np

from pdal_stages.synthetic import TownOptions, write_town


def cpu() -> float:
    """CPU seconds of all children that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def classify(*words: object) -> float:
    before = cpu()
    command = [sys.executable, "-m", "pdal_stages.cli", "classify", *map(str, words), "--no-progress"]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        sys.exit(done.stderr)
    return cpu() - before


def part(las: laspy.LasData, chosen: np.ndarray, path: Path) -> None:
    made = laspy.LasData(las.header)
    made.points = las.points[chosen]
    made.write(path)


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--side", type=float, default=500.0, help="Of the town, meters")
    p.add_argument("--density", type=float, default=5.0)
    p.add_argument("--tile", default="auto")
    p.add_argument("--runs", type=int, default=1)
    p.add_argument("--json", type=Path)
    o = p.parse_args()
    found = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_town(TownOptions(size=o.side, density=o.density, seed=11), folder / "town.laz")
        las = laspy.read(folder / "town.laz")
        x, y = np.asarray(las.x) - np.floor(np.min(las.x)), np.asarray(las.y) - np.floor(np.min(las.y))
        (folder / "small").mkdir()
        number = np.floor(x / 20).astype(int) * 1000 + np.floor(y / 20).astype(int)
        for square in np.unique(number):
            part(las, number == square, folder / "small" / f"s{square:06d}.laz")
        (folder / "strips").mkdir()
        strip = np.random.default_rng(0).integers(0, 3, len(x)) + np.floor(y / (o.side / 28)).astype(int)
        for one in np.unique(strip):
            part(las, strip == one, folder / "strips" / f"strip{one:02d}.laz")
        for what, words in (
            ("one file", (folder / "town.laz", folder / "whole.laz")),
            ("small files", (folder / "small", folder / "out_small/", "--tile", o.tile)),
            ("strips", (folder / "strips", folder / "out_strips/", "--tile", o.tile)),
        ):
            files = len(list(words[0].iterdir())) if words[0].is_dir() else 1
            seconds = statistics.median(classify(*words) for _ in range(o.runs))
            found.append({"what": what, "files": files, "points": len(x), "cpu_seconds": seconds})
            ratio = seconds / found[0]["cpu_seconds"]
            print(
                f"{what:12s} {files:6,} files {len(x):10,} points {seconds:8.1f} CPU s  {ratio:.2f}",
                flush=True,
            )
    if o.json:
        o.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
