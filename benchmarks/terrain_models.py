"""The terrain of ``pdal-stages surfaces`` beside PDAL's own triangulation, at ground held out.

Every tenth ground point is held out; each program makes a raster of 1 m from the rest, which is
interpolated (bilinear) at the held-out points:

    python benchmarks/terrain_models.py CLOUD...

PDAL: filters.range, filters.delaunay, filters.faceraster, writers.raster. CPU seconds are of whole
commands, the least of three; ours also makes surface and canopy, and writes overviews.
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("clouds", nargs="+")
    print(
        f"{'cloud':20s}{'points':>10s}{'CPU s':>8s}{'PDAL':>8s}{'RMSE m':>9s}{'PDAL':>8s}{'compared':>10s}"
    )
    for name in parser.parse_args().clouds:
        cloud = laspy.read(name)
        ground = np.flatnonzero(np.isin(np.asarray(cloud.classification), TERRAIN))
        xyz = np.column_stack([cloud.x, cloud.y, cloud.z])[ground[::10]]
        with tempfile.TemporaryDirectory() as folder:
            rest, theirs = Path(folder) / "rest.laz", Path(folder) / "pdal.tif"
            cloud.points = cloud.points[np.delete(np.arange(len(cloud.points)), ground[::10])]
            cloud.write(rest)
            limits = ",".join(f"Classification[{code}:{code}]" for code in TERRAIN)
            job = Path(folder) / "job.json"
            stages = [
                str(rest),
                {"type": "filters.range", "limits": limits},
                {"type": "filters.delaunay"},
                {"type": "filters.faceraster", "resolution": 1},
                {"type": "writers.raster", "filename": str(theirs), "gdaldriver": "GTiff"},
            ]
            job.write_text(json.dumps(stages))
            ours = sys.executable, "-m", "pdal_stages.cli", "surfaces", str(rest), folder
            times = cpu_seconds(*ours), cpu_seconds("pdal", "pipeline", str(job))
            found = np.column_stack(
                [errors(p, xyz) for p in (Path(folder) / "terrain.tif", theirs)]
            )
        found = found[np.isfinite(found).all(axis=1)]
        rms = np.sqrt((found**2).mean(axis=0))
        print(
            f"{Path(name).stem:20s}{len(cloud.points):>10,}{times[0]:>8.1f}{times[1]:>8.1f}"
            f"{rms[0]:>9.3f}{rms[1]:>8.3f}{len(found):>10,}",
            flush=True,
        )


if __name__ == "__main__":
    main()
