"""Buildings, trees and wires as objects: outlines along walls, crowns with their tops; to be
checked in yellow."""

import numpy as np
import shapely
from _common import save, town
from PIL import Image, ImageDraw

import pdal_stages as ps

#: Fill and edge of each layer, in the order they are drawn.
INKS = {
    "crowns": ("#badba0", "#549448"),
    "buildings": ("#e28a78", "#8c281e"),
    "spans": ("#966e00", "#966e00"),
    "trees": ("#185c28", "#185c28"),
}
TO_CHECK = ("#facd5a", "#aa6e00")

points = town(seed=4)
cells = ps.Cells.from_points(*points.xyz.T, points.classification, 0.5)
objects = ps.find_objects(cells, ps.ObjectSettings(), progress=False)
layers = ps.object_layers(objects)
west, south, east, north = shapely.total_bounds(
    np.concatenate([layer.shapes for layer in layers.values()])
)
scale = 900 / (east - west)
image = Image.new("RGB", (900, round(scale * (north - south))), "white")
draw = ImageDraw.Draw(image)
for name, inks in INKS.items():
    layer = layers[name]
    verdicts = layer.columns["verdict"]
    print(f"{len(layer.shapes)} {name}, {np.count_nonzero(verdicts == 'check')} to be checked")
    for shape, verdict in zip(layer.shapes, verdicts, strict=True):
        fill, edge = TO_CHECK if verdict == "check" else inks
        for part in shapely.get_parts(shape):
            ring = part.exterior if part.geom_type == "Polygon" else part
            places = (shapely.get_coordinates(ring) - (west, north)) * (scale, -scale)
            flat = places.ravel().tolist()
            if part.geom_type == "Point":
                draw.ellipse([*(v - 2 for v in flat), *(v + 2 for v in flat)], fill)
            elif part.geom_type == "Polygon":
                draw.polygon(flat, fill, edge, width=2)
            else:
                draw.line(flat, edge, width=2)
save("7_objects", np.asarray(image))
