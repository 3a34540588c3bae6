"""Speed and memory of tiled runs as the cloud grows.

    python benchmarks/tiling.py --points 1e6 5e6 --tile 250 --workers 2

Writes generated towns of 5 points a square meter (kept in --folder and used again), trains a model on another
town, classifies each in tiles, and prints points per second and the most memory each process held. A
number of points with an `x` (4x5e6) is a mosaic of shifted copies of one town, which is quicker to make.
CPU seconds are those of the workers' tasks, so they hold on a busy machine too; wall seconds do not.
"""

from __future__ import annotations

import argparse
import json
import math
import platform
import resource
import sys
from pathlib import Path

import laspy
import numpy as np

import pdal_stages as ps
from pdal_stages.base.threads import available_threads
from pdal_stages.synthetic import TownOptions, write_town
from pdal_stages.terrain.minima import hag_minima
from pdal_stages.tiling import run_tiled

#: Points the survey of Vorarlberg holds [WM19], and the workers of an imagined cluster.
SURVEY, CLUSTER = 10**10, 64


def town(folder: Path, words: str, density: float) -> Path:
    """A file with a town, or a square mosaic of one."""
    path = folder / f"town_{words}_{density:g}.laz"
    if path.exists():
        return path
    copies, _, points = words.rpartition("x")
    if not copies:
        size = math.sqrt(float(points) / density)
        write_town(TownOptions(size=size, density=density, seed=11), path)
        return path
    one = laspy.read(town(folder, points, density))
    side, step = math.isqrt(int(copies)), math.ceil(float(np.ptp(one.x)))
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = one.header.scales, one.header.offsets
    header.vlrs, header.global_encoding.wkt = one.header.vlrs, True
    with laspy.open(path, mode="w", header=header) as out:
        for i in range(side):
            for j in range(side):
                record = one.points.copy()
                record["X"] += round(i * step / header.scales[0])
                record["Y"] += round(j * step / header.scales[1])
                out.write_points(record)
    return path


def model(folder: Path, neighborhoods: str, features: str, trees: int) -> Path:
    """A model trained on another town."""
    path = folder / f"{neighborhoods.replace(',', '_')}_{features.replace(',', '_')}_{trees}.model"
    if not path.exists():
        made = ps.make_town(150.0, 5.0, seed=3)
        options = ps.TrainingOptions(
            neighborhoods=neighborhoods,
            feature_set=features.split(","),
            dimensions=("HeightAboveGround",),
            classes={"2": 2, "3,4,5": 5, "6": 6},
            count=1000,
            trees=trees,
        )
        cloud = ps.TrainingCloud(
            made.xyz, made.classification, {"HeightAboveGround": hag_minima(*made.xyz.T)}
        )
        ps.train([cloud], options, progress=False).save(path)
    return path


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--points", nargs="+", default=["1e6", "5e6"])
    p.add_argument("--density", type=float, default=5.0)
    p.add_argument("--tile", type=float, default=250.0)
    p.add_argument("--workers", type=int, default=2)
    p.add_argument("--per", default="tile")
    p.add_argument("--neighborhoods", default="c1,c2,c3,s2")
    p.add_argument("--features", default="covariance,geometric")
    p.add_argument("--trees", type=int, default=30)
    p.add_argument("--folder", type=Path, default=Path("tiling-benchmark"))
    p.add_argument("--json", type=Path)
    o = p.parse_args()
    o.folder.mkdir(exist_ok=True)
    trained = model(o.folder, o.neighborhoods, o.features, o.trees)
    print(
        f"{platform.platform()}, {available_threads()} cores, Python {platform.python_version()}, tiles of {o.tile:g} m"
    )
    print(f"{o.neighborhoods}, {o.features}, {o.trees} trees; output per {o.per}, {o.workers} workers")
    print(
        f"{'points':>12} {'tiles':>6} {'wall s':>8} {'cpu s':>8} {'points/cpu s':>13} {'worker MB':>10} {'parent MB':>10}"
    )
    found = []
    for words in o.points:
        source = town(o.folder, words, o.density)
        out = o.folder / f"out_{words}_{o.per}"
        out.mkdir(exist_ok=True)
        stages = [
            str(source),
            {"type": "filters.hag_minima"},
            {"type": "filters.modelclassifier", "model": str(trained)},
            {"type": "writers.las", "filename": str(out / "c_#.laz"), "forward": "all", "extra_dims": "all"},
        ]
        run = run_tiled(stages, o.tile, workers=o.workers, per=o.per)
        if run.failures:
            sys.exit(f"{run.failures[0]}")
        s = run.summary
        parent = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        rate = s["points"] / s["cpu_seconds"]
        found.append({"given": words, **s, "points_per_cpu_second": rate, "parent_mb": parent})
        print(
            f"{s['points']:12,} {len(run.tiles):6} {s['seconds']:8.0f} {s['cpu_seconds']:8.0f} {rate:13,.0f} "
            f"{s['peak_mb_of_a_worker']:10,.0f} {parent:10,.0f}",
            flush=True,
        )
    rate = found[-1]["points_per_cpu_second"]
    hours = SURVEY / rate / CLUSTER / 3600
    print(f"{SURVEY:,} points on {CLUSTER} workers of one core each: {hours:.1f} hours, if reading keeps up")
    if o.json:
        o.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
