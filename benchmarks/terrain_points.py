"""What it costs to triangulate the lowest ground point of each half cell instead of all.

Every tenth ground point is held out; the others, and the lowest of them, are triangulated, and the
heights at the held-out points compared (SciPy, independent of our triangulation):

    python benchmarks/terrain_points.py CLOUD... [--resolution 1]

The last columns are CPU seconds of a triangulation of all other ground points (one of each square
millimeter), by ours (startinpy, made unique) and by SciPy's.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import laspy
import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import Delaunay

from pdal_stages.base.asprs import TERRAIN
from pdal_stages.surfaces.cells import STEPS, SurfaceOptions, lowest, steps
from pdal_stages.surfaces.triangulation import triangulate


def errors(xyz: np.ndarray, held_out: np.ndarray) -> np.ndarray:
    """Return interpolated minus true heights of the points inside both triangulations."""
    inside = LinearNDInterpolator(xyz[:, :2] - xyz[0, :2], xyz[:, 2])
    return inside(held_out[:, :2] - xyz[0, :2]) - held_out[:, 2]


def cpu_seconds(function, xy: np.ndarray) -> float:
    """Return the CPU seconds of a function of points."""
    before = time.process_time()
    function(xy)
    return time.process_time() - before


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("clouds", nargs="+")
    parser.add_argument("--resolution", type=float, default=1.0)
    options = parser.parse_args()
    kept_by = SurfaceOptions(resolution=options.resolution)
    print(
        f"{'cloud':22s}{'ground':>9s}{'kept':>9s}{'RMSE all':>10s}{'kept':>8s}{'more':>8s}{'mean':>8s}{'kept':>8s}{'ours s':>8s}{'SciPy s':>9s}"
    )
    for name in options.clouds:
        cloud = laspy.read(name)
        xyz = np.column_stack([steps(cloud[axis]) for axis in "xyz"])
        ground = xyz[np.isin(np.asarray(cloud.classification), TERRAIN)]
        held_out, rest = ground[::10], np.delete(ground, np.s_[::10], axis=0)
        few = lowest(rest, kept_by.ground_step(1.0))
        both = np.column_stack(
            [errors(points.astype(float), held_out.astype(float)) for points in (rest, few)]
        )
        both = both[np.isfinite(both).all(axis=1)] / STEPS
        every = lowest(rest, 1.0)[:, :2]
        times = (
            cpu_seconds(triangulate, every),
            cpu_seconds(Delaunay, (every - every[0]).astype(float)),
        )
        rms, mean = np.sqrt((both**2).mean(axis=0)), both.mean(axis=0)
        print(
            f"{Path(name).stem:22s}{len(ground):>9,}{len(few):>9,}{rms[0]:>10.3f}{rms[1]:>8.3f}"
            f"{rms[1] - rms[0]:>+8.3f}{mean[0]:>+8.3f}{mean[1]:>+8.3f}{times[0]:>8.2f}{times[1]:>9.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
