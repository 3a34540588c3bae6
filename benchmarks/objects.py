"""Buildings of Delft's train part, by its own classes, against the official outlines.

python benchmarks/objects.py FOLDER [--picture FILE]
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import laspy
import numpy as np
import shapely
from object_accuracy import compare_buildings

from pdal_stages import Cells, find_objects
from pdal_stages.objects.cells import Kind
from pdal_stages.objects.outlines import raw_outlines, straight_outlines


def delft(folder):
    """Cells of Delft's train part, and its official outlines."""
    las = laspy.read(folder / "delft" / "train.laz")
    cells = Cells.from_points(las.x, las.y, las.z, np.asarray(las.classification), 0.5)
    listed = json.loads((folder / "delft" / "buildings_train.geojson").read_text())["features"]
    true = [shapely.from_geojson(json.dumps(feature["geometry"])) for feature in listed]
    return cells, list(shapely.make_valid(true))


def draw(path, colored, around, size=(170, 140), pixels=5, finer=3):
    """Outlines by color, in the middle of what they are `around`: `size` in meters, `pixels` a
    meter."""
    from PIL import Image, ImageDraw

    west, south, east, north = shapely.total_bounds(around)
    corner = np.array([(west + east - size[0]) / 2, (south + north + size[1]) / 2])
    image = Image.new("RGB", tuple(side * pixels * finer for side in size), "white")
    pen = ImageDraw.Draw(image)
    for color, shapes in colored.items():
        for part in shapely.get_parts(shapes):
            for ring in (part.exterior, *part.interiors):
                at = (shapely.get_coordinates(ring) - corner) * (pixels * finer, -pixels * finer)
                pen.line([tuple(xy) for xy in at], color, 2 * finer, joint="curve")
    image.reduce(finer).quantize(64).save(path)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="folder of the real clouds")
    parser.add_argument("--picture", metavar="FILE", help="of the outlines over the official ones")
    options = parser.parse_args()
    cells, true = delft(options.folder)
    found = find_objects(cells, progress=False)
    raw = raw_outlines(found.tables[Kind.BUILDING], 0.5)
    for name, shapes in (("cells", raw), ("straight", straight_outlines(raw))):
        shapes = [shapely.transform(shape, lambda xy: xy / 2) for shape in shapes]
        got = compare_buildings(shapes, true)
        area, edge = got["area"], got["boundary"]
        print(
            f"{name}: F1 {100 * got['objects']['f1']:.1f} %, "
            f"{100 * got['covered']:.1f} % of {len(true)} outlines covered by 80 % or more, "
            f"{100 * area['completeness']:.1f} % of their area, boundary "
            f"{edge['median']:.2f} m, 95 %: {edge['p95']:.2f} m"
        )
    if options.picture:
        draw(options.picture, {(58, 116, 214): true, (190, 30, 36): shapes}, true)


if __name__ == "__main__":
    main()
