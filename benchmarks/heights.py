"""What heights cost where points are sparse or dense: CPU microseconds a point, one thread, and where they go.

    python benchmarks/heights.py                                  # generated towns of 0.2 to 500 points/m2
    python benchmarks/heights.py --against CHECKOUT --repeats 5   # by turns with the package in another folder
    python benchmarks/heights.py --clouds A.laz B.laz --kernels   # each kernel's share, a point and a cell of 1 m
    python benchmarks/heights.py --block                          # a block of the ground's raster, as tiles make it

Heights above filtered ground with two openings, as the model that comes with the package prepares them. A run is a process
of its own that does the work twice and counts the second time, when kernels are loaded; reading is left out. The block has
1,024 cells a side, decks are looked for; a town of 512 m at 5 points/m2 is repeated in it and all around it.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import laspy
import numpy as np

from pdal_stages.synthetic import TownOptions, write_town

#: What a process does: (3, n) coordinates from a file; seconds, and those of kernels, to standard output.
RUN = """
import json, sys, time
from collections import defaultdict
import numpy as np
from pdal_stages.base import jit
from pdal_stages.terrain import filtered_ground, groundblocks, groundcells
from pdal_stages.terrain.lowpoints import lowest_of_cells

axes, kernels, call = np.load(sys.argv[1]), defaultdict(float), jit.Kernel.__call__

def timed(self, *given):
    began = time.process_time()
    try:
        return call(self, *given)
    finally:
        name = self.__wrapped__.__module__.rpartition(".")[2] + "." + self.__wrapped__.__name__
        kernels[name] += time.process_time() - began

def repeated(points, start, times):
    corners = [[start + 512.0 * i, start + 512.0 * j, 0.0] for j in range(times) for i in range(times)]
    return np.concatenate([points.T + corner for corner in corners])

if sys.argv[2] == "block":
    axes = axes - np.floor(axes.min(axis=1, keepdims=True)) * [[1], [1], [0]]
    axes = axes[:, (axes[:2] < 512).all(axis=0)]
    low = lowest_of_cells(*axes, np.ones(axes.shape[1], bool), 1.0)
    around, inside = np.ascontiguousarray(repeated(axes[:, low], 0.0, 6).T), repeated(axes, 1024.0, 2)
    options = groundcells.FilterOptions(openings=(5, 17), decks=True)
    work = lambda: groundblocks.cells_of_block(*around, (1, 1), options, [inside])
else:
    work = lambda: filtered_ground(*axes, openings=(5, 17), threads=1)
jit.Kernel.__call__ = timed
for _ in range(2):
    kernels.clear()
    began = time.process_time()
    work()
    seconds = time.process_time() - began
print(json.dumps({"seconds": seconds, "kernels": kernels}))
"""


def coordinates(cloud: Path, folder: Path) -> tuple[Path, int, int]:
    """A file of coordinates (3, n), the number of points, and of cells of 1 m round them."""
    las = laspy.read(cloud)
    axes = np.array([las.x, las.y, las.z])
    path = folder / f"{cloud.stem}.npy"
    np.save(path, axes)
    low, high = np.floor(axes[:2].min(axis=1)), np.floor(axes[:2].max(axis=1))
    return path, axes.shape[1], int(np.prod(high - low + 1))


def town(folder: Path, size: float, density: float) -> Path:
    """A generated town, made once."""
    path = folder / f"town-{size:.0f}m-{density:g}.laz"
    if not path.exists():
        write_town(TownOptions(size=size, density=density, seed=2), path)
    return path


def once(package: Path, coordinates: Path, kind: str) -> dict[str, Any]:
    """One process, with the package in a folder."""
    environment = {**os.environ, "PYTHONPATH": str(package)}
    command = [sys.executable, "-c", RUN, str(coordinates.resolve()), kind]  # which looks in its folder first
    ran = subprocess.run(command, env=environment, cwd=package, check=True, stdout=subprocess.PIPE)
    return json.loads(ran.stdout)


def main() -> None:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--densities", type=float, nargs="+", default=[0.2, 0.3, 1, 2, 7, 50, 200, 500])
    p.add_argument("--points", type=float, default=500_000)
    p.add_argument("--clouds", type=Path, nargs="+", help="LAS or LAZ files instead of towns")
    p.add_argument("--block", action="store_true")
    p.add_argument("--against", type=Path, help="A folder that holds another state of the package")
    p.add_argument("--repeats", type=int, default=3)
    p.add_argument("--kernels", action="store_true")
    p.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir(), "pdal-stages-heights"))
    o = p.parse_args()
    o.folder.mkdir(parents=True, exist_ok=True)
    here = Path(__file__).resolve().parents[1]
    packages = {"now": here} if o.against is None else {"before": o.against.resolve(), "now": here}
    if o.block:
        clouds = [town(o.folder, 516.0, 5.0)]
    else:
        clouds = o.clouds or [town(o.folder, (o.points / d) ** 0.5, d) for d in o.densities]
    print("| cloud | points | " + " | ".join(packages) + " |\n|---|---:|" + "---:|" * len(packages))
    for cloud in clouds:
        path, points, cells = coordinates(cloud, o.folder)
        if o.block:
            points, cells = 4 * points, 1024 * 1024
        runs: dict[str, list[dict[str, Any]]] = {name: [] for name in packages}
        for _ in range(o.repeats):
            for name, package in packages.items():
                runs[name].append(once(package, path, "block" if o.block else "heights"))
        seconds = {name: sorted(run["seconds"] for run in found) for name, found in runs.items()}
        scale, unit = (1.0, " s") if o.block else (1e6 / points, "")
        told = [
            " / ".join(f"{s * scale:.2f}" for s in (v[0], statistics.median(v), v[-1]))
            for v in seconds.values()
        ]
        print(
            f"| {cloud.stem} | {points:,} | " + " | ".join(f"{text}{unit}" for text in told) + " |",
            flush=True,
        )
        for name, found in runs.items() if o.kernels else ():
            kernels = {
                k: statistics.median(run["kernels"].get(k, 0.0) for run in found) for k in found[0]["kernels"]
            }
            for kernel, spent in sorted(kernels.items(), key=lambda item: -item[1]):
                print(
                    f"    {name} {kernel:40s}{1e6 * spent / points:8.3f} a point{1e6 * spent / cells:8.3f} a cell"
                )
        path.unlink()


if __name__ == "__main__":
    main()
