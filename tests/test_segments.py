"""Segments of a class: known shapes, and the same bits in any order of points and in tiles."""

import numpy as np
import pytest

from pdal_stages.base.errors import ModelError
from pdal_stages.classifier.context_features import Context, rows_needed
from pdal_stages.classifier.segments import COLUMNS, RULES, describe_segments

GROUND, TREE, HOUSE = range(3)


def scene(seed=0, side=120.0, origin=(631_008.0, 6_270_016.0)):
    """Houses of 10 x 12 m, 6 m high, on a slope, specks of house votes among trees."""
    random = np.random.default_rng(seed)
    xy = random.uniform(0, side, (int(4 * side**2), 2))
    terrain = 0.05 * xy[:, 0]
    is_house = (xy[:, 0] % 40 < 10) & (xy[:, 1] % 40 < 12)
    is_tree = ~is_house & (xy[:, 0] % 40 > 20) & (xy[:, 1] % 40 > 20)
    vote = np.where(is_house, HOUSE, np.where(is_tree, TREE, GROUND))
    vote[is_tree & (random.random(len(xy)) < 0.1)] = HOUSE
    height = np.where(is_house, 6.0, np.where(is_tree, random.uniform(1, 9, len(xy)), 0.0))
    shares = np.full((len(xy), 3), 6553, np.uint16)
    shares[np.arange(len(xy)), vote] = 52429
    return np.column_stack([xy + origin, terrain + height]), shares, height


def columns_of(xyz, shares, height, rows=slice(None)):
    rows = np.arange(len(xyz))[rows]
    return describe_segments(xyz, shares, height, HOUSE, GROUND).columns(rows)


def test_a_house_is_described():
    xyz, shares, height = scene(origin=(0.0, 0.0))
    x, y = xyz[:, 0], xyz[:, 1]
    house = (x > 40) & (x < 50) & (y > 40) & (y < 52)
    roof = dict(zip(COLUMNS, columns_of(xyz, shares, height, house).T, strict=True))
    assert (roof["SegmentArea"] == 120.0).all()
    assert (roof["SegmentFill"] == 1.0).all()
    assert roof["SegmentRimDrop"] == pytest.approx(6.0, abs=0.2)
    assert (roof["SegmentRimDropShare"] == 1.0).all()
    assert roof["SegmentHeight"] == pytest.approx(6.0, abs=1e-3)
    assert roof["SegmentProbability"] == pytest.approx(0.8, abs=1e-3)
    assert (roof["DistanceToSegment_32"] == 0.0).all()
    beside = (x > 52) & (x < 54) & (y > 44) & (y < 48)
    street = dict(zip(COLUMNS, columns_of(xyz, shares, height, beside).T, strict=True))
    assert (street["SegmentArea"] == -1.0).all()
    assert (street["DistanceToSegment_32"] == 4.0).all()
    assert (street["HeightAboveSegment"] == -2 * RULES.max_offset).all()
    lawn = (x > 67) & (x < 69) & (y > 67) & (y < 69)
    far = dict(zip(COLUMNS, columns_of(xyz, shares, height, lawn).T, strict=True))
    assert (far["DistanceToSegment_128"] == RULES.distance).all()


def test_order_and_stray_points_play_no_part():
    xyz, shares, height = scene()
    expected = columns_of(xyz, shares, height)
    order = np.random.default_rng(1).permutation(len(xyz))
    assert np.array_equal(columns_of(xyz[order], shares[order], height[order]), expected[order])
    strays = np.array([[1e11, -1e11, 5.0], [-1e11, 1e11, 5.0]])
    ends = ((xyz, strays), (shares, shares[:2]), (height, height[:2]))
    assert np.array_equal(columns_of(*map(np.concatenate, ends))[:-2], expected)


@pytest.mark.parametrize("seed", range(4))
def test_a_tile_with_its_halo_has_the_same_bits(seed):
    xyz, shares, height = scene(seed)
    context = Context(("segments6",))
    random = np.random.default_rng(seed)
    low = xyz[:, :2].min(axis=0) + random.uniform(0, 80, 2)
    rows = np.flatnonzero(((xyz[:, :2] >= low) & (xyz[:, :2] < low + 20)).all(axis=1))
    expected = columns_of(xyz, shares, height)[rows]
    near = rows_needed(xyz, rows, context)
    away = np.maximum(low - xyz[:, :2], xyz[:, :2] - low - 20).max(axis=1)
    for part in (near, np.flatnonzero(away <= context.reach)):
        assert len(part) < len(xyz)
        tile = columns_of(xyz[part], shares[part], height[part])
        assert np.array_equal(tile[np.searchsorted(part, rows)], expected)


def test_what_segments_need_is_checked():
    context = Context(("own", "segments6", "box1"))
    context.check_codes((2, 5, 6), ("HeightAboveGround",))
    for codes, dimensions in (((2, 5), ("HeightAboveGround",)), ((2, 6), ("Intensity",))):
        with pytest.raises(ModelError, match="segments6"):
            context.check_codes(codes, dimensions)


def test_columns_lie_where_their_names_say():
    xyz, shares, height = scene(side=40.0)
    context = Context(("own", "segments6", "box1"))
    cells = context.cell_means(xyz, shares, None, (2, 5, 6), height)
    columns = cells.columns(np.arange(len(xyz)))
    names = context.names((2, 5, 6))
    assert columns.shape == (len(xyz), len(names))
    assert np.array_equal(
        columns[:, names.index("SegmentArea_segments6")], columns_of(xyz, shares, height)[:, 0]
    )
    assert np.allclose(
        context.own_probabilities(columns, 3), shares / shares.sum(axis=1, keepdims=True)
    )
