"""Buildings, trees, wires and decks as objects: outlines along walls, crowns with their tops; to be checked in yellow."""

import numpy as np
from _common import save, town

import pdal_stages as ps
from pdal_stages.reports.objectmap import object_map

points = town(seed=4)
cells = ps.Cells.of(*points.xyz.T, points.classification, 0.5)
objects = ps.find_objects(cells, ps.ObjectSettings(), progress=False)
layers = ps.object_layers(objects)
for name, layer in layers.items():
    checked = int(np.count_nonzero(layer.columns["verdict"] == "check"))
    print(f"{len(layer.shapes)} {name}, {checked} to be checked")
save("7_objects", object_map(layers))
