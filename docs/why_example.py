"""The worked example of docs/why.md: a tree beside a house, found, explained, corrected.

python docs/why_example.py --data FOLDER     # prints what the page shows, writes its picture

FOLDER holds rural/lidarhd_57ppm2.laz, one of the surveys that the shipped model was trained on. The
ten labels are points that the survey's own labels call vegetation and the model a building.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import laspy
import numpy as np
import pyogrio
import rasterio
import shapely

from pdal_stages.cli import main as command
from pdal_stages.reports.pictures import CLASS_COLORS, write_png

STEPS = ("minimum_grid", "openings", "round_3", "surface")
LEVELS = (656.0, 668.0)  # elevations that are drawn dark and bright
STEPS_TARGET = Path(__file__).resolve().parent / "pictures" / "why-steps.png"
TARGET = Path(__file__).resolve().parent / "pictures" / "why-hamlet.png"
#: Middle of the section that is drawn, and half its length and width, in meters.
SECTION = (931136.3, 6449661.8, 12.0, 2.0)
LABELS = 10
#: West, south, east, north of a piece of roof that is confirmed, so that there are two classes.
ROOF = (931133.0, 6449666.0, 931136.0, 6449669.0)
SCALE = 34  # pixels per meter


def run(*words: object) -> None:
    """Run a command of pdal-stages, and show it."""
    print(
        "\n$ pdal-stages", *(Path(word).name if isinstance(word, Path) else word for word in words)
    )
    if command([str(word) for word in words]):
        raise SystemExit("it failed")


def section(path: Path) -> np.ndarray:
    """Return a section (height, width, 3) through the points of a file, by class."""
    cloud = laspy.read(path)
    x, y, z = (np.array(axis) for axis in (cloud.x, cloud.y, cloud.z))
    east, north, length, width = SECTION
    near = (np.abs(x - east) < length) & (np.abs(y - north) < width)
    i = ((x[near] - east + length) * SCALE).astype(int)
    j = ((z[near].max() + 1 - z[near]) * SCALE).astype(int)
    image = np.full((int(14.5 * SCALE), int(2 * length * SCALE), 3), 255, np.uint8)
    colors = CLASS_COLORS[np.array(cloud.classification)[near]]
    for down in range(3):
        for right in range(3):
            inside = (j + down < len(image)) & (i + right < image.shape[1])
            image[j[inside] + down, i[inside] + right] = colors[inside]
    return image


def steps(folder: Path) -> np.ndarray:
    """Return rasters of the ground filter (height, width, 3) side by side, high cells bright."""
    rasters = []
    for name in STEPS:
        (path,) = (folder / name).glob("*.tif")
        with rasterio.open(path) as file:
            values = file.read(1).astype(float)
            values[values == file.nodata] = np.nan
        gray = np.clip((values - LEVELS[0]) / np.ptp(LEVELS), 0, 1) * 215 + 40
        empty = np.isnan(values)
        rgb = np.where(empty[..., None], (255, 255, 255), np.nan_to_num(gray)[..., None])
        enlarged = np.kron(rgb.astype(np.uint8), np.ones((7, 7, 1), np.uint8))
        rasters += [enlarged, np.full((len(enlarged), 14, 3), 255, np.uint8)]
    return np.concatenate(rasters[:-1], axis=1)


def main() -> None:
    """Run the example."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--data", required=True, type=Path)
    raw = options.parse_args().data / "rural" / "lidarhd_57ppm2.laz"
    truth = np.array(laspy.read(raw).classification)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        first, second = folder / "hamlet.laz", folder / "second.laz"
        kept = folder / "steps"
        run("classify", raw, first, f"--filters.hag_morphological.keep_rasters={kept}")
        write_png(STEPS_TARGET, steps(kept))
        run("review", first, folder / "review.gpkg", "--json", folder / "review.json")
        cloud = laspy.read(first)
        x, y = (np.array(axis) for axis in (cloud.x, cloud.y))
        codes = np.array(cloud.classification)
        in_tree = np.hypot(x - SECTION[0], y - SECTION[1]) < 4.0
        wrong = np.flatnonzero(in_tree & (codes == 6) & (truth == 5))
        worst = json.loads((folder / "review.json").read_text())["worst"]
        patches = [row["at"] for row in worst]
        east, north = next(at for at in patches if np.hypot(*np.subtract(at, SECTION[:2])) < 4.0)
        nearest = wrong[np.argmin(np.hypot(x[wrong] - east, y[wrong] - north))]
        place = [f"{np.array(axis)[nearest]:.2f}" for axis in (cloud.x, cloud.y, cloud.z)]
        run("explain", first, *place)
        labeled = np.random.default_rng(1).choice(wrong, LABELS, replace=False)
        codes[labeled] = 5
        cloud.classification = codes
        cloud.write(folder / "corrected.laz")
        roof, shape = folder / "roof.gpkg", [shapely.to_wkb(shapely.box(*ROOF))]
        kind = {"geometry_type": "Polygon", "crs": "EPSG:2154"}
        pyogrio.raw.write(roof, np.array(shape), [], [], **kind)
        edited, checked = folder / "corrected.laz", folder / "checked.laz"
        run("corrections", first, edited, "--area", roof, "--around", 0, "--out", checked)
        run("train", "--base", "standard", folder / "checked.laz", "--model", folder / "mine.model")
        run(
            "classify",
            folder / "checked.laz",
            second,
            "--model",
            folder / "mine.model",
            "--where",
            "Checked == 0",
        )
        run("explain", second, *place, "--model", folder / "mine.model")
        after = np.array(laspy.read(second).classification)
        judged = np.isin(truth, (2, 5, 6))
        print(
            f"\nof {len(wrong)} points of the tree that were called building {np.count_nonzero(after[wrong] == 6)} still are"
        )
        for name, given in (
            ("before", np.array(laspy.read(first).classification)),
            ("after", after),
        ):
            print(
                f"{name}: {100 * np.mean(given[judged] == truth[judged]):.2f} % right of ground, vegetation, building"
            )
        pictures = [section(first), section(second)]
        gap = np.full((len(pictures[0]), 20, 3), 255, np.uint8)
        write_png(TARGET, np.concatenate([pictures[0], gap, pictures[1]], axis=1))


if __name__ == "__main__":
    main()
