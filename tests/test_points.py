"""What a stage sees of PDAL's points, and what it lets go of."""

import numpy as np
import pytest

from pdal_stages.base.errors import DimensionError
from pdal_stages.stages.points import Points


def arrays(n=1000):
    random = np.random.default_rng(0)
    made = {name: random.uniform(0, 50, n) for name in ("X", "Y", "Z", "GpsTime")}
    return made | {"Classification": np.full(n, 2, np.uint8), "Mine": np.full(n, -1.0)}


def test_coordinates_in_meters_are_no_copies():
    given = arrays()
    points = Points(given)
    assert all(axis is given[name] for axis, name in zip(points.axes, "XYZ", strict=True))
    assert np.array_equal(points.xyz, np.column_stack([given[name] for name in "XYZ"]))


def test_what_is_not_kept_is_let_go_of_and_coordinates_stay():
    given = arrays()
    points = Points(dict(given), own=given["Mine"])
    points.keep_only(["Classification", "HeightAboveGround"])
    assert set(points.arrays) == {"Classification"} and points.count == 1000
    with pytest.raises(DimensionError, match="GpsTime"):
        points.dimension("GpsTime")
    assert np.array_equal(points.take_xyz(), np.column_stack([given[name] for name in "XYZ"]))
    assert points.counted(np.ones(1000, bool)) == 1000
