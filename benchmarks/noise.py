"""Noise: how much of what is put into labeled clouds is found, and how many good points are marked.

python benchmarks/noise.py --data FOLDER
python benchmarks/noise.py --data FOLDER --classify
python benchmarks/noise.py --data FOLDER --terrain

Noise as the field knows it is put into each cloud: points and clusters of 2 to 30 within a meter, half of them 1 to 30 m
below the ground (the lowest of what is labeled ground, and of all points, near by), half 3 to 300 m above the highest point
near by. `good` are labeled points other than noise; speed is in points per CPU second of one thread. With --classify, some
clouds are classified with the shipped model as they are, with 0.1 % of noise that nobody looks for, and with it marked. With
--terrain, the ground filter works on clouds with noise, alone and with what is found left out: how much labeled ground
it no longer calls so, and how many good points have another height, by more than 0.3 m.
"""

from __future__ import annotations

import argparse
import io
import time
from contextlib import redirect_stdout
from pathlib import Path
from tempfile import TemporaryDirectory

import laspy
import numpy as np
from scipy.spatial import cKDTree

from pdal_stages import detached_noise, filtered_ground
from pdal_stages.cli import main as command

CLOUDS = (
    "montpellier/train_77050_627755.laz", "montpellier/train_77055_627755.laz", "delft/train.laz", "seville/plazanueva.laz",
    "rural/lidarhd_57ppm2.laz", "rural/lidarhd_11ppm2.laz", "rural/lidarhd_bank.laz", "rural/ahn3_achterhoek.laz",
    "rural/ahn4_powerline.laz", "forest/neon_osbs.laz", "rural/ign_0p3ppm2.laz", "bridge/ign_0299_6802.laz",
)  # fmt: skip
#: What the ground filter is tried on.
UNDER = (
    "montpellier/train_77055_627755.laz", "seville/plazanueva.laz", "rural/lidarhd_57ppm2.laz", "rural/lidarhd_11ppm2.laz",
    "rural/lidarhd_bank.laz", "forest/neon_osbs.laz", "rural/ign_0p3ppm2.laz", "delft/train.laz",
)  # fmt: skip
#: What is classified: a dense town, a bank, a town with noise of its own, a hamlet, a farm, an old town with canals.
CLASSIFIED = (
    "montpellier/train_77055_627755.laz", "rural/lidarhd_bank.laz", "seville/plazanueva.laz",
    "rural/lidarhd_57ppm2.laz", "rural/lidarhd_11ppm2.laz", "delft/train.laz",
)  # fmt: skip
#: Labels of points that are what they are called.
GOOD = (2, 3, 4, 5, 6, 9, 12, 14, 15, 17)
SHARES = (0.0001, 0.001, 0.01)


def injected(xyz: np.ndarray, codes: np.ndarray, share: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Noise of that share of a cloud's points: coordinates, and 7 or 18."""
    rng = np.random.default_rng(seed)
    ground = xyz[codes == 2]
    nearest, around = cKDTree(ground[:, :2]), cKDTree(xyz[:, :2])
    parts, kinds = [], []
    while sum(map(len, parts)) < max(share * len(xyz), 1):
        size = 1 if rng.random() < 0.5 else rng.integers(2, 31)
        at = xyz[rng.integers(len(xyz)), :2] + rng.uniform(-1, 1, 2)
        near = xyz[around.query_ball_point(at, 2.0), 2]
        part = rng.normal(0, 0.4, (size, 3)) * (size > 1)
        if low := rng.random() < 0.5:
            level = ground[nearest.query(at, 3)[1], 2].min()
            top = min([level, *near]) - rng.uniform(1, 30)
            part += [*at, top - part[:, 2].max()]
        else:
            part += [*at, near.max(initial=xyz[:, 2].min()) + rng.uniform(3, 300) - part[:, 2].min()]
        parts.append(part)
        kinds += [7 if low else 18] * size
    return np.round(np.vstack(parts), 3), np.array(kinds)


def classified(folder: Path) -> None:
    """Print overall accuracy (2, 5, 6) of clouds without noise, with noise, and with noise that is marked.

    Noise is 0.1 % of low and high points; or, where a cloud has points labeled 7 itself, those.
    """
    print("| cloud | points of noise | clean | with noise, not marked | marked |")
    print("|---|---:|---:|---:|---:|")
    for name in CLASSIFIED:
        las = laspy.read(folder / name)
        xyz, codes = np.column_stack([las.x, las.y, las.z]), np.asarray(las.classification)
        returns = np.column_stack([las.return_number, las.number_of_returns])
        own = codes == 7
        if own.sum() > 20:
            noise, given = xyz[own], returns[own]
        else:
            noise, _ = injected(xyz[~own], codes[~own], 0.001, 0)
            given = np.ones((len(noise), 2), int)
        xyz, codes, returns = xyz[~own], codes[~own], returns[~own]
        truth = np.where(np.isin(codes, (4, 5)), 5, codes)
        scored = np.isin(truth, (2, 5, 6))
        shown = []
        with TemporaryDirectory() as scratch:
            source, target = str(Path(scratch) / "in.laz"), str(Path(scratch) / "out.laz")
            for some, word in ((0, "--no-noise"), (None, "--no-noise"), (None, "--noise")):
                more, also = noise[:some], given[:some]
                header = laspy.LasHeader(point_format=6, version="1.4")
                header.scales, header.offsets = [0.001] * 3, np.floor(xyz.min(axis=0))
                made = laspy.LasData(header)
                made.x, made.y, made.z = np.vstack([xyz, more]).T
                made.return_number, made.number_of_returns = np.vstack([returns, also]).T
                made.write(source)
                with redirect_stdout(io.StringIO()):
                    if command(["classify", source, target, word, "--no-progress"]):
                        raise SystemExit(f"{name} could not be classified")
                found = np.asarray(laspy.read(target).classification)[: len(xyz)]
                shown.append(f"{100 * (found == truth)[scored].mean():.2f}")
        print(f"| {name} | {len(noise)} | {' | '.join(shown)} |", flush=True)


def terrain(folder: Path) -> None:
    """Print what noise does to filtered ground, alone and after the noise that is found was left out."""
    print("| cloud | noise | echoes below, left | ground lost | heights moved |")
    print("|---|---:|---:|---:|---:|")
    for name in UNDER:
        las = laspy.read(folder / name)
        xyz, codes = np.column_stack([las.x, las.y, las.z]), np.asarray(las.classification)
        good = np.isin(codes, GOOD)
        xyz, codes = xyz[good], codes[good]
        clean, labeled = filtered_ground(*xyz.T), codes == 2
        for share in SHARES[1:]:
            noise, kinds = injected(xyz, codes, share, 0)
            both = np.vstack([xyz, noise])
            shown: list[list[str]] = [[], [], []]
            for use in (np.ones(len(both), bool), detached_noise(both) == 0):
                found = {
                    name: values[: len(xyz)] for name, values in filtered_ground(*both.T, mask=use).items()
                }
                lost = (clean["Ground"] > found["Ground"])[labeled].mean()
                moved = (abs(found["HeightAboveGround"] - clean["HeightAboveGround"]) > 0.3).mean()
                left = np.count_nonzero(use[len(xyz) :] & (kinds == 7))
                for column, text in zip(
                    shown, (f"{left}", f"{100 * lost:.2f}", f"{100 * moved:.2f}"), strict=True
                ):
                    column.append(text)
            cells = " | ".join(" / ".join(column) for column in shown)
            print(f"| {name} | {100 * share:g} % | {cells} |", flush=True)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--classify", action="store_true")
    parser.add_argument("--terrain", action="store_true")
    options = parser.parse_args()
    folder = options.data
    if options.classify:
        classified(folder)
        return
    if options.terrain:
        terrain(folder)
        return
    detached_noise(np.random.default_rng(0).uniform(0, 30, (500, 3)))
    print("| cloud | million points/s | good points marked | found of 0.01 % | 0.1 % | 1 % (low / high) |")
    print("|---|---:|---:|---:|---:|---:|")
    for name in CLOUDS:
        las = laspy.read(folder / name)
        xyz, codes = np.column_stack([las.x, las.y, las.z]), np.asarray(las.classification)
        start = time.process_time()
        marked = detached_noise(xyz)
        spent = time.process_time() - start
        good = np.isin(codes, GOOD)
        found = []
        for share in SHARES:
            tally = np.zeros((2, 2))
            for seed in range(5 if share < 0.001 else 1):
                noise, kinds = injected(xyz, codes, share, seed)
                told = detached_noise(np.vstack([xyz, noise]))[len(xyz) :]
                for row, kind in enumerate((7, 18)):
                    tally[row] += [(told[kinds == kind] == kind).sum(), (kinds == kind).sum()]
            found.append(" / ".join(f"{100 * hits / max(n, 1):.0f}" for hits, n in tally))
        rate, false = len(xyz) / spent / 1e6, 100 * (marked[good] > 0).mean()
        print(f"| {name} | {rate:.1f} | {false:.4f} % | {' | '.join(found)} |", flush=True)


if __name__ == "__main__":
    main()
