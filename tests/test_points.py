"""What a stage sees of PDAL's points, and what it lets go of."""

import numpy as np
import pytest

import pdal_stages as ps
from pdal_stages.base.errors import DimensionError
from pdal_stages.stages.points import Points
from pdal_stages.synthetic import TownOptions, write_town


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
    gone = []
    points.let_go_of = gone.append
    points.keep_only(["Classification", "HeightAboveGround"])
    assert {id(one) for one in gone} == {id(given[name]) for name in ("X", "Y", "Z", "GpsTime")}
    assert set(points.arrays) == {"Classification", "Mine"} and points.count == 1000
    with pytest.raises(DimensionError, match="GpsTime"):
        points.dimension("GpsTime")
    assert np.array_equal(points.take_xyz(), np.column_stack([given[name] for name in "XYZ"]))
    assert points.counted(np.ones(1000, bool)) == 1000


@pytest.mark.pdal
def test_pdal_s_own_points_keep_what_a_stage_let_go_of(tmp_path):
    write_town(TownOptions(size=60, density=20, seed=3), tmp_path / "town.laz")  # more than a few pages
    heights = {"type": "filters.hag_morphological", "ground": True, "openings": [5, 17], "decks": True}
    plain = ps.Pipeline([str(tmp_path / "town.laz")])
    plain.execute()
    made = ps.Pipeline(
        [
            str(tmp_path / "town.laz"),
            heights,
            {"type": "filters.modelclassifier", "model": "standard"},
            {"type": "filters.consistency"},
        ]
    )
    made.execute()
    before, after = plain.arrays[0], made.arrays[0]
    assert len(before) > 50_000 and len(np.unique(after["Classification"])) > 2
    for name in before.dtype.names:
        if name != "Classification":
            assert np.array_equal(before[name], after[name]), name
