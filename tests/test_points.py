"""What a stage sees of PDAL's points, and what it lets go of."""

import numpy as np
import pytest

from pdal_stages.base.errors import DimensionError
from pdal_stages.stages.bridges import Bridges
from pdal_stages.stages.points import Points
from pdal_stages.stages.where_expression import Expression


def arrays(n=1000):
    random = np.random.default_rng(0)
    columns = {name: np.round(random.uniform(0, 50, n), 3) for name in ("X", "Y", "Z", "GpsTime")}
    return columns | {"Classification": np.full(n, 2, np.uint8), "Mine": np.full(n, -1.0)}


def test_coordinates_in_meters():
    columns = arrays()
    points = Points(columns)
    assert all(
        np.array_equal(axis, columns[name]) for axis, name in zip(points.axes, "XYZ", strict=True)
    )
    assert np.array_equal(points.xyz, np.column_stack([columns[name] for name in "XYZ"]))


def test_what_is_not_kept_is_let_go_of_and_coordinates_stay():
    columns = arrays()
    points = Points(dict(columns), meters_outside=columns["Mine"])
    points.keep_only(["Classification", "HeightAboveGround"])
    assert set(points.arrays) == {"Classification"} and points.count == 1000
    with pytest.raises(DimensionError, match="GpsTime"):
        points.dimension("GpsTime")
    assert np.array_equal(points.take_xyz(), np.column_stack([columns[name] for name in "XYZ"]))
    points.tally(Bridges.decks, np.ones(1000, bool))
    assert points.report.figures["decks"] == points.report.counts[Bridges.decks] == 1000


@pytest.mark.parametrize("scale", [0.01, 0.001, 0.00025])
def test_scale_and_offset_of_a_file_do_not_change_coordinates(scale):
    """LAS readers compute coordinates that differ in the last bit, and fall into other cells."""
    steps = np.arange(683_200_000, 683_210_000)  # of a centimeter
    plain = steps * 0.01 + 0.0
    offset = 6_831_989.0
    other = np.rint((plain - offset) / scale) * scale + offset
    assert (plain != other).any()
    first, two = (Points(dict.fromkeys("XYZ", values)).axes for values in (plain, other))
    assert all(np.array_equal(a, b) for a, b in zip(first, two, strict=True))
    assert np.abs(first[0] - plain).max() < 1e-8


def test_a_height_in_feet_is_told_by_its_dimension_not_by_its_prefix():
    """Heights above ground have the unit of Z; features are lengths in meters."""
    values = {"HeightAboveGround": np.full(1000, 10.0), "HeightAboveOpening_5": np.full(1000, 10.0)}
    meters = {"HeightAboveLowest_s2": np.full(1000, 10.0), "HeightAboveSea": np.full(1000, 10.0)}
    points = Points({**arrays(), **values, **meters}, unit_names=("foot", "foot"))
    assert all((points.dimension(name) == 3.048).all() for name in values)
    assert all((points.dimension(name) == 10.0).all() for name in meters)


def test_a_condition_names_flags_that_old_pdal_keeps_in_other_dimensions():
    """As in tiles and `classify`, which read the flags themselves."""
    axes = {axis: np.arange(4.0) for axis in "XYZ"}
    bits = np.array([0, 1, 4, 12], np.uint8)  # none, synthetic, withheld, withheld and overlap
    wanted = {
        "withheld == 1": [False, False, True, True],
        "Synthetic == 0": [True, False, True, True],
    }
    for condition, mask in wanted.items():
        where = Expression(condition)
        assert Points({**axes, "ClassFlags": bits}, where=where).mask.tolist() == mask
        old = {**axes, "Classification": 2 + ((bits & 7) << 5).astype(np.uint8)}
        assert Points(old, where=where, legacy_flags=True).mask.tolist() == mask
    overlap = Expression("Overlap == 1")
    assert Points({**axes, "ClassFlags": bits}, where=overlap).mask.tolist() == [False] * 3 + [True]
    with pytest.raises(DimensionError, match="names the dimension 'Overlap'"):
        Points(old, where=overlap, legacy_flags=True)
