"""Clouds, models and comparisons that the tests of tiling share."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np

import pdal_stages as ps
from pdal_stages.terrain.minima import hag_minima

#: Heights of coarse cells of 5 m, so that surroundings stay small beside small tiles.
CELL = 5


def town(size: float = 90.0, density: float = 2.5, seed: int = 5):
    """A small town with a hole, and points exactly on the edges of 30 m tiles."""
    points = ps.make_town(size, density, seed=seed)
    xyz = points.xyz.copy()
    x, y = xyz[:, 0] - 500_000.0, xyz[:, 1] - 5_400_000.0
    for value, axis in ((10.0, 0), (40.0, 0), (70.0, 0), (30.0, 1), (60.0, 1)):
        near = np.abs((x, y)[axis] - value) < 0.1
        xyz[near, axis] = value + (500_000.0, 5_400_000.0)[axis]
    hole = (x > 39.0) & (x < 71.0) & (y > 59.0)  # a whole tile and a little more
    return points, xyz, ~hole


def model(
    path: Path, neighborhoods: str = "c1,s2,kopt", feature_set: str = "covariance,geometric,D1_3_c1"
) -> Path:
    """A small model, trained on another town."""
    points = ps.make_town(60.0, 2.5, seed=9)
    options = ps.TrainingOptions(
        neighborhoods=neighborhoods,
        feature_set=feature_set.split(","),
        dimensions=("HeightAboveGround",),
        classes={"2": 2, "3,4,5": 5, "6": 6},
        count=150,
        trees=6,
    )
    heights = hag_minima(*points.xyz.T, cell=CELL)
    cloud = ps.TrainingCloud(points.xyz, points.classification, {"HeightAboveGround": heights})
    ps.train([cloud], options, progress=False).save(path)
    return path


def stages(inputs, output, model_file, **writer):
    """The pipeline of the tests."""
    return [
        *map(str, inputs),
        {"type": "filters.hag_minima", "cell": CELL},
        {"type": "filters.modelclassifier", "model": str(model_file)},
        {
            "type": "writers.las",
            "filename": str(output),
            "forward": "all",
            "extra_dims": "all",
            **writer,
        },
    ]


def same_points(a: Path, b: Path) -> None:
    """Two files hold the same points in the same order, byte for byte, under the same header."""
    first, two = laspy.read(a), laspy.read(b)
    assert first.points.array.dtype == two.points.array.dtype
    for name in first.points.array.dtype.names:
        different = np.count_nonzero(first.points.array[name] != two.points.array[name])
        assert different == 0, f"{name} differs in {different} of {len(first)} points"
    for name in (
        "scales",
        "offsets",
        "version",
        "creation_date",
        "system_identifier",
        "global_encoding",
    ):
        left, right = getattr(first.header, name), getattr(two.header, name)
        if name == "global_encoding":
            left, right = left.value, right.value
        assert np.all(left == right), name
    assert first.header.point_format.id == two.header.point_format.id
    texts = [
        [v.record_data_bytes() for v in las.header.vlrs if v.record_id == 2112]
        for las in (first, two)
    ]
    assert texts[0] == texts[1]


def hidden(folder: Path) -> list[str]:
    """Files left half-written under a folder."""
    return [p.name for p in folder.rglob("*") if p.name.startswith(".") and "partial" in p.name]
