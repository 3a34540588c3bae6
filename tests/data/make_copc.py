"""How town.copc.laz was made: a corner of the generated town as COPC, which neither PDAL 2.2 nor laspy writes.

The town's own options and the package copclib (2.6.3, from PyPI):

    python tests/data/make_copc.py tests/data/town.copc.laz
"""

import sys
import tempfile
from pathlib import Path

import copclib
import laspy
import numpy as np

from pdal_stages.synthetic import make_town, write_town

DIMENSIONS = ("intensity", "return_number", "number_of_returns", "classification")


def main(target: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder, "town.laz")
        write_town(make_town(30, 3, seed=7, progress=False), source)
        las = laspy.read(source)
    low = las.header.mins
    half = float((las.header.maxs - low).max() / 2)
    config = copclib.CopcConfigWriter(
        6,
        copclib.Vector3(*las.header.scales),
        copclib.Vector3(*las.header.offsets),
        las.header.parse_crs().to_wkt() if las.header.parse_crs() else "",
    )
    config.las_header.min, config.las_header.max = copclib.Vector3(*low), copclib.Vector3(*las.header.maxs)
    info = config.copc_info
    info.center_x, info.center_y, info.center_z = (float(v) for v in low + half)
    info.halfsize, info.spacing = half, half / 16
    writer = copclib.FileWriter(target, config)
    header = writer.copc_config.las_header
    xyz = np.column_stack([las.x, las.y, las.z])
    values = {name: np.asarray(las[name]) for name in DIMENSIONS}

    def points(rows):
        packed = copclib.Points(header)
        for row in rows:
            point = packed.CreatePoint()
            point.x, point.y, point.z = (float(v) for v in xyz[row])
            for name, column in values.items():
                setattr(point, name, int(column[row]))
            packed.AddPoint(point)
        return packed

    order = np.random.default_rng(0).permutation(len(xyz))
    coarse, fine = np.split(order, [len(order) // 4])
    writer.AddNode(copclib.VoxelKey(0, 0, 0, 0), points(coarse))
    octant = (xyz[fine] - low >= half).astype(int)
    for key in np.unique(octant, axis=0):
        writer.AddNode(copclib.VoxelKey(1, *(int(v) for v in key)), points(fine[(octant == key).all(axis=1)]))
    writer.Close()


if __name__ == "__main__":
    main(sys.argv[1])
