"""What tiles cost: a generated town in one piece, in tiles, in many small files and in strips that overlap.

    python benchmarks/tiling.py --side 500

Prints CPU seconds of the program and its workers, how many times those of one piece they are for as many points, and the
most memory that a process held.
"""

from __future__ import annotations

import argparse
import json
import os
import struct
import subprocess
import sys
import tempfile
from pathlib import Path

import laspy
import numpy as np

from pdal_stages.synthetic import TownOptions, write_town


def classify(*words: object) -> tuple[float, float]:
    """CPU seconds, and megabytes of the largest process."""
    command = [sys.executable, "-m", "pdal_stages.cli", "classify", *map(str, words), "--no-progress"]
    run = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(run.pid, 0)
    if status:
        sys.exit(f"{' '.join(command)} failed")
    return used.ru_utime + used.ru_stime, used.ru_maxrss / 1024


def part(las: laspy.LasData, chosen: np.ndarray, path: Path) -> None:
    made = laspy.LasData(las.header)
    made.points = las.points[chosen]
    made.write(path)


def side_by_side(town: Path, folder: Path, side: float) -> None:
    """Nine files of the same points; 4.laz is in the middle."""
    head = bytearray(town.read_bytes())
    offsets, box = struct.unpack_from("<3d", head, 155), struct.unpack_from("<6d", head, 179)
    for number in range(9):
        x, y = (number % 3 - 1) * side, (number // 3 - 1) * side
        struct.pack_into("<2d", head, 155, offsets[0] + x, offsets[1] + y)
        struct.pack_into("<4d", head, 179, box[0] + x, box[1] + x, box[2] + y, box[3] + y)
        (folder / f"{number}.laz").write_bytes(head)


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--side", type=float, default=500.0, help="Of the town, meters")
    p.add_argument("--density", type=float, default=5.0)
    p.add_argument("--json", type=Path)
    o = p.parse_args()
    found: dict[str, dict] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        town = folder / "town.laz"
        write_town(TownOptions(size=o.side, density=o.density, seed=11), town)
        las = laspy.read(town)
        x, y = np.asarray(las.x) - np.floor(np.min(las.x)), np.asarray(las.y) - np.floor(np.min(las.y))
        for what in ("small", "strips", "nine"):
            (folder / what).mkdir()
        number = np.floor(x / 20).astype(int) * 1000 + np.floor(y / 20).astype(int)
        for square in np.unique(number):
            part(las, number == square, folder / "small" / f"s{square:06d}.laz")
        strip = np.random.default_rng(0).integers(0, 3, len(x)) + np.floor(y / (o.side / 28)).astype(int)
        for one in np.unique(strip):
            part(las, strip == one, folder / "strips" / f"strip{one:02d}.laz")
        side_by_side(town, folder / "nine", o.side)
        for what, words in (
            ("one piece", (town, folder / "whole.laz")),
            ("tiles", (town, folder / "cut.laz", "--tile", o.side / 2)),
            ("small files", (folder / "small", folder / "out_small/")),
            ("strips", (folder / "strips", folder / "out_strips/")),
            ("nine", (folder / "nine", folder / "out/", "--tile", o.side)),
        ):
            seconds, megabytes = classify(*words)
            found[what] = {"points": len(x) * (9 if what == "nine" else 1), "cpu": seconds, "mb": megabytes}
            times = seconds / found[what]["points"] * len(x) / found["one piece"]["cpu"]
            print(f"{what:12s} {found[what]['points']:10,} points {seconds:7.1f} CPU s {times:5.2f} times "
                  f"{megabytes:6,.0f} MB", flush=True)  # fmt: skip
    if o.json:
        o.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
