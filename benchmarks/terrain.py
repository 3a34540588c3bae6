"""Heights above ground: filters.hag_morphological and filters.hag_minima beside PDAL's filters.smrf
with its own heights.

Two kinds of clouds with known ground: the ISPRS filter test samples (hand-made, 0.2 to 1 points/m2)
and labeled tiles of national surveys (training parts and single clouds, never test parts), these
also thinned to 2 and 0.5 points/m2. Nothing is read of the labels but noise (7, 18), which is left
out for all. filters.smrf has its defaults, and its ground gives PDAL's filters.hag_nn and
filters.hag_delaunay their heights; points whose return number is 0 get 1, or it would stop.

Ground points should be at height 0. With hag_nn a point that SMRF calls ground is its own nearest
one, so its height is 0 whatever it is; other heights are measured from a surface, and the roughness
of ground shows.

    python benchmarks/terrain.py --data FOLDER [--json FILE] [--only isprs]
    python benchmarks/terrain.py --corners
    python benchmarks/terrain.py --cost FILE ...

With --corners: clips of 30, 50 and 100 m of generated woods on slopes, turned at random: ground
missed, and where the surface is more than 1 m too high. With --cost: CPU seconds of ground with
heights of whole files, by turns with SMRF and hag_nn, and of reading alone, which is in both; least
of three.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import laspy
import numpy as np
from woods import closed_wood

import pdal_stages as ps
from pdal_stages.pipeline import pdal as pdal_env

SMRF = [
    {"type": "filters.assign", "assignment": ["Classification[:]=0", "ReturnNumber[0:0]=1", "NumberOfReturns[0:0]=1"]},
    {"type": "filters.smrf"},
]  # fmt: skip
OURS = "hag_morphological"
SMRF_NN = "smrf + hag_nn"
METHODS: dict[str, list[dict]] = {
    OURS: [{"type": "filters.hag_morphological", "ground": True}],
    SMRF_NN: [*SMRF, {"type": "filters.hag_nn"}],
    "smrf + hag_delaunay": [*SMRF, {"type": "filters.hag_delaunay"}],
    "hag_minima": [{"type": "filters.hag_minima"}],
    "hag_minima, 10 m cells": [{"type": "filters.hag_minima", "cell": 10}],
}
#: Clouds with labels: files, and codes that say neither ground nor object.
TILES: dict[str, tuple[str, tuple[int, ...]]] = {
    "montpellier": ("montpellier/train_*.laz", (0,)),
    "delft": ("delft/train.laz", (9, 26)),
    "seville": ("seville/plazanueva.laz", (12,)),
    "hamlet": ("rural/lidarhd_57ppm2.laz", ()),
    "farm": ("rural/lidarhd_11ppm2.laz", (208, 214)),
    "power line": ("rural/ahn4_powerline.laz", (9, 26)),
}
DENSITIES = (2.0, 0.5)
NOISE = (7, 18)


def clouds(data: Path, only: str) -> Iterator[tuple[str, np.ndarray, tuple[int, ...]]]:
    """Name, columns x, y, z, label, and the labels that are not scored."""
    if only in ("", "isprs"):
        for path in sorted(data.glob("isprs_filter/*.laz")):
            yield path.stem, load([path]), ()
    if only in ("", "tiles"):
        for name, (pattern, left_out) in TILES.items():
            cloud = load(sorted(data.glob(pattern)))
            yield name, cloud, left_out
            density = len(cloud) / (4 * len(np.unique(np.floor(cloud[:, :2] / 2), axis=0)))
            for wanted in DENSITIES:
                if wanted < 0.9 * density:
                    kept = np.random.default_rng(0).random(len(cloud)) < wanted / density
                    yield f"{name}, {wanted:g} points/m²", cloud[kept], left_out


def load(paths: list[Path]) -> np.ndarray:
    parts = []
    for path in paths:
        las = laspy.read(path)
        parts.append(np.column_stack([las.x, las.y, las.z, np.asarray(las.classification)]))
    cloud = np.concatenate(parts)
    return cloud[~np.isin(cloud[:, 3], NOISE)]


def save(cloud: np.ndarray, path: Path) -> None:
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = [0.001] * 3, np.floor(cloud[:, :3].min(axis=0))
    las = laspy.LasData(header)
    las.x, las.y, las.z = cloud[:, :3].T
    las.user_data = cloud[:, 3].astype(np.uint8)
    las.write(path)


def measure(cloud: np.ndarray, left_out: tuple[int, ...], methods: dict[str, list[dict]]) -> dict:
    """Figures of every method; see :func:`figures`."""
    out = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "cloud.las")
        save(cloud, path)
        for name, stages in methods.items():
            pipeline = ps.Pipeline([str(path), *stages])
            started = time.process_time()
            try:
                pipeline.execute()
            except ps.StageError as error:  # PDAL 2.2's hag_delaunay stops at collinear neighbors
                out[name] = {"error": str(error.found)}
                continue
            array = pipeline.arrays[0]
            called = array["Ground"] == 1 if name == OURS else array["Classification"] == 2
            out[name] = {
                **figures(
                    array["HeightAboveGround"], called if "minima" not in name else None, array["UserData"], left_out
                ),
                "cpu_seconds": round(time.process_time() - started, 2),
            }  # fmt: skip
    return out


def cost(paths: list[str]) -> None:
    """Print the CPU seconds of pipelines over files, least of three by turns, after one to warm."""
    methods = {"reading": [], OURS: METHODS[OURS], SMRF_NN: METHODS[SMRF_NN]}
    print("| cloud | points | " + " | ".join(methods) + " | ours / SMRF's |\n|---|" + "---:|" * 5)
    for path in paths:
        least = dict.fromkeys(methods, np.inf)
        for turn in range(4):
            for name, stages in methods.items():
                pipeline = ps.Pipeline([path, *stages])
                started = time.process_time()
                count = pipeline.execute()
                if turn:
                    least[name] = min(least[name], time.process_time() - started)
        cells = " | ".join(f"{seconds:.2f}" for seconds in least.values())
        ratio = least[OURS] / least[SMRF_NN]
        print(f"| {Path(path).name} | {count:,} | {cells} | {ratio:.2f} |", flush=True)


def figures(
    height: np.ndarray, called: np.ndarray | None, label: np.ndarray, left_out: tuple[int, ...]
) -> dict:
    """Heights of true ground; ground missed (I), objects called ground (II) and all errors; roofs
    at the ground.

    Percent; kappa of ground against objects. The label 1 of production classes is whatever is not
    named, grass and kerbs too, so type II errors of tiles are no errors of the method alone.
    """
    ground = label == 2
    scored = ~np.isin(label, left_out)
    away = np.abs(height[ground])
    out = {
        "points": len(height),
        "mean_absolute": float(away.mean()),
        "median_absolute": float(np.median(away)),
        "p95_absolute": float(np.percentile(away, 95)),
        "bias": float(height[ground].mean()),
    }
    roofs = label == 6
    if roofs.any():
        out["roofs_below_1m"] = 100 * float((height[roofs] < 1).mean())
    if called is not None:
        t, c = ground[scored], called[scored]
        agree, chance = (t == c).mean(), t.mean() * c.mean() + (1 - t.mean()) * (1 - c.mean())
        out |= {
            "type_1": 100 * float((~c[t]).mean()),
            "type_2": 100 * float(c[~t].mean()),
            "total": 100 * float((t != c).mean()),
            "precision": 100 * float(t[c].mean()),
            "kappa": 100 * float((agree - chance) / (1 - chance)),
        }
    return out


def _heights(one: dict) -> str:
    return one.get("error") or f"{one['mean_absolute']:.2f} / {one['p95_absolute']:.2f}"


def _errors(one: dict) -> str:
    return one.get("error") or f"{one['type_1']:.1f} / {one['type_2']:.1f} / {one['total']:.1f}"


def _mean(rows: list[dict]) -> dict:
    rows = [row for row in rows if "error" not in row]
    return (
        {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}
        if rows
        else {"error": "none"}
    )


def _roofs(one: dict) -> str:
    return f"{one['roofs_below_1m']:.1f}" if "roofs_below_1m" in one else "–"


def tables(results: dict) -> str:
    isprs = {name: row for name, row in results.items() if name.startswith("samp")}
    tiles = {name: row for name, row in results.items() if name not in isprs}
    lines = []
    if isprs:
        names = list(next(iter(isprs.values())))
        lines += ["| sample |" + "".join(f" {m} |" for m in names), "|---|" + "---:|" * len(names)]
        every = {**isprs, "mean": {m: _mean([row[m] for row in isprs.values()]) for m in names}}
        lines += [
            f"| {name} |" + "".join(f" {_heights(row[m])} |" for m in names)
            for name, row in every.items()
        ]
        lines += ["", f"| sample | {OURS}: I / II / total | kappa | smrf: I / II / total | kappa |"]
        lines += ["|---|---:|---:|---:|---:|"]
        for name, row in every.items():
            cells = [f" {_errors(row[m])} | {row[m]['kappa']:.1f} |" for m in (OURS, SMRF_NN)]
            lines += [f"| {name} |" + "".join(cells)]
        lines += [""]
    if tiles:
        lines += [
            "| cloud | points | "
            + " | ".join(f"{m}: mean / 95 % | I / II / total | roofs" for m in (OURS, SMRF_NN))
            + " |"
        ]
        lines += ["|---|" + "---:|" * 7]
        for name, row in tiles.items():
            cells = [
                f" {_heights(row[m])} | {_errors(row[m])} | {_roofs(row[m])} |"
                for m in (OURS, SMRF_NN)
            ]
            lines += [f"| {name} | {row[OURS]['points']:,} |" + "".join(cells)]
    return "\n".join(lines)


def corners() -> None:
    """Print how ground is found in clips of woods on slopes, and in the whole."""
    print("| slope | points/m² | missed, % | > 1 m too high, % | at most, m | in the whole, % |")
    print("|---:|---:|---:|---:|---:|---:|")
    for slope in (0.3, 0.46, 0.7, 1.0):
        for density in (0.5, 2.0, 6.0):
            rows = []
            for seed in range(4):
                xyz, ground, _ = closed_wood(slope, density, 0.1, seed, 220)
                whole = ps.filtered_ground(xyz)["HeightAboveGround"]
                rng = np.random.default_rng(seed)
                for side in (30, 50, 100) * 4:
                    angle, away = rng.uniform(0, 1.5), xyz[:, :2] - rng.uniform(70, 150, 2)
                    c, s = np.cos(angle), np.sin(angle)
                    inside = (np.abs(away @ np.array([[c, -s], [s, c]])) < side / 2).all(axis=1)
                    heights, seen = ps.filtered_ground(xyz[inside]), ground[inside]
                    height = heights["HeightAboveGround"][seen]
                    rows.append([
                        100 * (heights["Ground"][seen] == 0).mean(), 100 * (height < -1).mean(), -height.min(),
                        100 * (whole[inside][seen] < -1).mean(),
                    ])  # fmt: skip
            table = np.array(rows)
            missed, high, _, before = table.mean(axis=0)
            shown = f"{missed:.2f} | {high:.2f} | {table[:, 2].max():.1f} | {before:.2f}"
            print(f"| {slope:g} | {density:g} | {shown} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--data", default=os.environ.get("PDAL_STAGES_DATA"), help="folder of the real clouds"
    )
    parser.add_argument("--only", choices=("isprs", "tiles"), default="")
    parser.add_argument("--json", help="write the figures here")
    parser.add_argument("--corners", action="store_true", help="clips of woods on slopes instead")
    parser.add_argument("--cost", nargs="+", metavar="FILE", help="CPU seconds beside SMRF's")
    options = parser.parse_args()
    if options.cost:
        cost(options.cost)
        return
    if options.corners:
        corners()
        return
    if not options.data:
        parser.error("name the folder of the clouds with --data or PDAL_STAGES_DATA")
    results = {}
    for name, cloud, left_out in clouds(Path(options.data), options.only):
        methods = METHODS if name.startswith("samp") else {m: METHODS[m] for m in (OURS, SMRF_NN)}
        results[name] = measure(cloud, left_out, methods)
    print(
        f"PDAL {'.'.join(map(str, pdal_env.version()))}, {platform.machine()}\n\n{tables(results)}"
    )
    if options.json:
        Path(options.json).write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
