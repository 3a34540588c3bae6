"""Bridge decks: how many of their points are found, and how many others are taken for them.

python benchmarks/bridges.py --data FOLDER

Decks of scenes (tests/bridge_scenes.py; 8 points/m2, none on water) and of the labeled clouds.
Cars, lamps and what was never labeled count neither way. `false` is the share of all points that
are wrongly taken; seconds are of one process.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import laspy
import numpy as np

from pdal_stages.structures.decks import find_decks
from pdal_stages.terrain.heights import filtered_ground

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from bridge_scenes import SCENES, scan

CLOUDS = (
    "bridge/pont.laz", "bridge/ign_0299_6802.laz", "delft/train.laz", "forest/neon_osbs.laz", "isprs_filter/samp11.laz",
    "isprs_filter/samp12.laz", "isprs_filter/samp21.laz", "isprs_filter/samp31.laz",
    "isprs_filter/samp41.laz", "isprs_filter/samp51.laz",
    "isprs_filter/samp54.laz", "isprs_filter/samp61.laz", "montpellier/train_77050_627755.laz",
    "montpellier/train_77050_627760.laz", "montpellier/train_77055_627755.laz", "montpellier/train_77055_627760.laz",
    "rural/ahn3_achterhoek.laz", "rural/ahn4_powerline.laz", "rural/ign_0p3ppm2.laz", "rural/lidarhd_11ppm2.laz",
    "rural/lidarhd_57ppm2.laz", "rural/lidarhd_bank.laz", "seville/plazanueva.laz",
)  # fmt: skip
#: Codes that are not real: noise, what was added by computer.
DROPPED = (7, 18, 64, 65, 66, 67)


def row(
    name: str, what: str, found: np.ndarray, true: np.ndarray, either: np.ndarray, seconds: float
) -> None:
    """Print a row of the table; points that may be `either` are not judged."""
    known = ~either | true
    right, wrong = int((found & true).sum()), int((found & ~true & known).sum())
    score = 2 * right / max(2 * right + wrong + int((true & ~found).sum()), 1)
    words = f"{100 * score:.1f}" if true.any() else "–"
    print(
        f"| {name} | {what} | {int(true.sum()):,} | {words} | {100 * wrong / len(found):.3f} | "
        f"{seconds:.1f} |",
        flush=True,
    )


def decks(
    name: str, xyz: np.ndarray, use: np.ndarray, true: np.ndarray, either: np.ndarray
) -> None:
    ground = filtered_ground(xyz, mask=use)["Ground"] > 0
    begin = time.process_time()
    decks = find_decks(*(np.ascontiguousarray(axis) for axis in xyz.T), use, ground)
    row(name, "deck", decks, true, either, time.process_time() - begin)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder of the labeled clouds")
    folder = parser.parse_args().data
    print("| cloud | what | points | F1 % | false % | CPU s |")
    print("|---|---|---:|---:|---:|---:|")
    for name, make in SCENES.items():
        xyz, codes = scan(make(), 8.0)
        decks(name, xyz, np.ones(len(xyz), bool), codes == 17, codes == 1)
    for name in CLOUDS:
        las = laspy.read(folder / name)
        codes = np.asarray(las.classification)
        use = ~np.isin(codes, DROPPED)
        bridge = codes == (26 if name.startswith("delft") else 17)
        if "powerline" in name:
            use &= codes != 26
        decks(name, las.xyz, use, bridge, codes == 1)


if __name__ == "__main__":
    main()
