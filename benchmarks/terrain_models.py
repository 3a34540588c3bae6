"""The terrain of ``pdal-stages surfaces`` beside those of PDAL and lasR, at ground held out.

Every tenth ground point is held out; each program makes a raster of 1 m from the rest, which is
interpolated (bilinear) at the held-out points:

    python benchmarks/terrain_models.py CLOUD... [--lasr PYTHON]

PDAL: filters.range, filters.delaunay, filters.faceraster, writers.raster. lasR: triangulate,
rasterize_triangulation, by a Python that has pylasr. CPU seconds are of whole commands, the least
of three; ours also makes surface and canopy, and writes overviews.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import laspy
import numpy as np
import rasterio
from scipy.ndimage import map_coordinates

from pdal_stages.base.asprs import TERRAIN

#: Makes a terrain of the first argument's cloud: the second argument.
_LASR = f"""
import sys, pylasr
ground = pylasr.triangulate(filter=["Classification %in% {" ".join(map(str, TERRAIN))}"])
raster = pylasr.rasterize_triangulation(ground, res=1.0, ofile=sys.argv[2])
assert (ground + raster).execute([sys.argv[1]])["success"]
"""


def cpu_seconds(*command: str, repeats: int = 3) -> float:
    """Return the least CPU seconds of a program that must succeed."""
    times = []
    for _ in range(repeats):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        times.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return min(times)


def errors(path: Path, xyz: np.ndarray) -> np.ndarray:
    """Return the raster's heights at points minus theirs, NaN where a cell around is unknown."""
    with rasterio.open(path) as file:
        heights = file.read(1, masked=True).astype(float).filled(np.nan)
        column, row = ~file.transform * (xyz[:, 0], xyz[:, 1])
    places = np.array([row - 0.5, column - 0.5])
    return map_coordinates(heights, places, order=1, cval=np.nan) - xyz[:, 2]


def make_terrains(cloud: Path, lasr: str) -> dict[str, tuple[float, Path]]:
    """Make a terrain of a cloud by each program; return the CPU seconds and the file of each."""
    folder = cloud.parent
    limits = ",".join(f"Classification[{code}:{code}]" for code in TERRAIN)
    job, theirs = folder / "job.json", folder / "pdal.tif"
    stages = [
        str(cloud),
        {"type": "filters.range", "limits": limits},
        {"type": "filters.delaunay"},
        {"type": "filters.faceraster", "resolution": 1},
        {"type": "writers.raster", "filename": str(theirs), "gdaldriver": "GTiff"},
    ]
    job.write_text(json.dumps(stages))
    ours = sys.executable, "-m", "pdal_stages.cli", "surfaces", str(cloud), str(folder)
    out = {
        "ours": (cpu_seconds(*ours), folder / "terrain.tif"),
        "PDAL": (cpu_seconds("pdal", "pipeline", str(job)), theirs),
    }
    if lasr:
        third = folder / "lasr.tif"
        out["lasR"] = cpu_seconds(lasr, "-c", _LASR, str(cloud), str(third)), third
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("clouds", nargs="+")
    parser.add_argument("--lasr", default="", help="a Python program that has pylasr")
    options = parser.parse_args()
    programs = ["ours", "PDAL"] + ["lasR"] * bool(options.lasr)
    columns = [f"{each} {unit}" for unit in ("s", "m") for each in programs]
    print(f"{'cloud':20s}{'points':>10s}{'compared':>10s}", *(f"{each:>8s}" for each in columns))
    for name in options.clouds:
        cloud = laspy.read(name)
        ground = np.flatnonzero(np.isin(np.asarray(cloud.classification), TERRAIN))
        xyz = np.column_stack([cloud.x, cloud.y, cloud.z])[ground[::10]]
        cloud.points = cloud.points[np.delete(np.arange(len(cloud.points)), ground[::10])]
        with tempfile.TemporaryDirectory() as folder:
            rest = Path(folder) / "rest.laz"
            cloud.write(rest)
            made = make_terrains(rest, options.lasr)
            found = np.column_stack([errors(path, xyz) for _, path in made.values()])
        found = found[np.isfinite(found).all(axis=1)]
        values = (
            *(f"{seconds:8.1f}" for seconds, _ in made.values()),
            *(f"{rms:8.3f}" for rms in np.sqrt((found**2).mean(axis=0))),
        )
        print(
            f"{Path(name).stem:20s}{len(cloud.points):>10,}{len(found):>10,}", *values, flush=True
        )


if __name__ == "__main__":
    main()
