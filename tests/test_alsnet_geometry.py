"""Sampling, balls, circular batches: held against slow, obvious references. No PyTorch."""

import numpy as np
import pytest
from alsnet_scenes import TINY, coverage, scene
from hypothesis import given, settings
from hypothesis import strategies as st

from pdal_stages.alsnet.batches import (
    Batches,
    ball_query,
    build_pyramid,
    farthest_point_sampling,
    interpolation_weights,
    join_pyramids,
    random_order,
    spacing_for,
)
from pdal_stages.alsnet.configuration import parse_configuration
from pdal_stages.base.errors import OptionError
from pdal_stages.classifier.training_options import RECIPES
from pdal_stages.features.cell_means import density

# ---- references ------------------------------------------------------------------------------------------


def slow_farthest(p, count, start):
    far, out, now = np.full(len(p), np.inf), [], start
    for _ in range(count):
        out.append(now)
        far = np.minimum(far, ((p - p[now]) ** 2).sum(axis=1))
        far[out] = -1.0
        now = int(np.argmax(far))  # of equals the first
    return np.array(out)


def slow_ball(p, centers, radius, samples):
    out = []
    for c in centers:
        inside = np.flatnonzero(((p - p[c]) ** 2).sum(axis=1) <= radius * radius)[:samples]
        out.append(np.concatenate([inside, np.full(samples - len(inside), inside[0])]))
    return np.array(out)


clouds = st.builds(
    lambda seed, n, kind: (
        np.random.default_rng(seed)
        .integers(0, 4, (n, 3))
        .astype(float)  # ties and coinciding points
        if kind == "lattice"
        else np.random.default_rng(seed).normal(size=(n, 3))
        * (10.0 if kind == "wide" else [50.0, 1e-3, 2.0])
    ),
    st.integers(0, 2**32),
    st.integers(1, 300),
    st.sampled_from(["lattice", "wide", "line"]),
)

# ---- farthest points, balls, nearest ------------------------------------------------------------------------


@given(clouds, st.data())
@settings(max_examples=30, deadline=None)
def test_farthest_points_equal_the_reference(p, data):
    count = data.draw(st.integers(1, len(p)))
    start = data.draw(st.integers(0, len(p) - 1))
    sampled = farthest_point_sampling(p, count, start)
    assert np.array_equal(sampled, slow_farthest(p, count, start))
    assert len(set(sampled.tolist())) == count


@given(clouds, st.floats(0.01, 30.0), st.integers(1, 20), st.integers(0, 2**32))
@settings(max_examples=30, deadline=None)
def test_ball_query_equals_the_reference(p, radius, samples, seed):
    centers = np.random.default_rng(seed).integers(0, len(p), min(len(p), 30))
    assert np.array_equal(
        ball_query(p, centers, radius, samples), slow_ball(p, centers, radius, samples)
    )


@given(clouds, st.integers(1, 10))
@settings(max_examples=25, deadline=None)
def test_three_nearest_weigh_by_inverse_square(p, m):
    coarse = p[:m]
    index, weight = interpolation_weights(p, coarse)
    d2 = ((p[:, None, :] - coarse[None, :, :]) ** 2).sum(axis=2)
    k = min(3, len(coarse))
    np.testing.assert_allclose(
        np.take_along_axis(d2, index[:, :k], axis=1),
        np.sort(d2, axis=1)[:, :k],
        rtol=1e-9,
        atol=1e-12,
    )
    expected = 1.0 / np.maximum(np.sort(d2, axis=1)[:, :k], 1e-10)
    np.testing.assert_allclose(
        weight[:, :k], expected / expected.sum(axis=1, keepdims=True), rtol=1e-4
    )
    assert not weight[:, k:].any()


# ---- batches ------------------------------------------------------------------------------------------------


@given(
    st.integers(0, 2**32),
    st.integers(1, 2500),
    st.integers(16, 300),
    st.sampled_from(["even", "clumps", "places"]),
)
@settings(max_examples=25, deadline=None)
def test_every_point_is_in_a_batch_and_batches_are_the_nearest_points(seed, n, points, kind):
    random = np.random.default_rng(seed)
    xyz = random.random((n, 3)) * [60.0, 40.0, 5.0]
    if kind == "clumps":  # density varies a thousandfold
        xyz[: n // 2, :2] = random.normal([10.0, 10.0], 0.3, (n // 2, 2))
    if kind == "places":
        xyz = np.floor(xyz / 20.0) * 20.0
    batches = Batches(xyz, points, spacing_for(points, n / 2400.0))
    seen = np.zeros(n, int)
    for number, (x, y) in enumerate(batches.centers):
        members = batches.members(number)
        assert len(members) <= batches.sizes[number]
        seen[members] += 1
        d2 = (xyz[:, 0] - x) ** 2 + (xyz[:, 1] - y) ** 2
        expected = np.sort(d2[d2 <= batches.reach**2])[: batches.sizes[number]]
        assert np.array_equal(np.sort(d2[members]), expected)
    assert seen.min() >= 1
    assert np.array_equal(seen, coverage(batches))
    if kind == "even":
        assert (batches.sizes == points).all()


def test_points_are_in_four_batches_on_average():
    xyz = np.random.default_rng(0).random((15_000, 3)) * [100.0, 100.0, 10.0]
    points = 1000
    batches = Batches(xyz, points, spacing_for(points, density(xyz)))
    assert coverage(batches).min() >= 1
    assert 3.7 < coverage(batches).mean() < 4.3
    inside = ((xyz[:, :2] > 20) & (xyz[:, :2] < 80)).all(axis=1)
    assert 3.8 < coverage(batches)[inside].mean() < 4.2


def test_with_a_far_reach_every_batch_is_the_nearest_points():
    """[WM19 3]: the nearest 200,000 points; at the cloud's edge they lie beyond 1.5 spacings."""
    xyz = np.random.default_rng(0).random((8_000, 3)) * [80.0, 60.0, 10.0]
    xyz = xyz[(xyz[:, 0] > 30) | (xyz[:, 1] < 30)]  # an L
    spacing = spacing_for(1000, density(xyz))
    sizes = {
        reach: [len(batches.members(number)) for number in range(len(batches))]
        for reach in (1.5, 4.0)
        for batches in [Batches(xyz, 1000, spacing, reach=reach)]
    }
    assert min(sizes[1.5]) < 1000 and set(sizes[4.0]) == {1000}
    assert RECIPES["winiwarter2019"]["alsnet"]["reach"] == 4


# ---- pyramids -----------------------------------------------------------------------------------------------


def test_scramble_follows_the_coordinates():
    xyz = np.random.default_rng(1).random((500, 3))
    shuffled = np.random.default_rng(2).permutation(500)
    assert np.array_equal(xyz[random_order(xyz)], xyz[shuffled][random_order(xyz[shuffled])])
    assert abs(np.corrcoef(np.arange(500), xyz[random_order(xyz)][:, 0])[0, 1]) < 0.2


# ---- configurations -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "given, text",
    [
        ("smal", "Did you mean 'small'"),
        ({"points": 100}, "'levels' is a required property"),
        ({"points": 100, "levels": [{**TINY.to_dict()["levels"][0], "radius": 0}]}, "'radius'"),
        ({"points": 100, "levels": [{**TINY.to_dict()["levels"][0], "mlp": [0]}]}, "'mlp'"),
    ],
)
def test_bad_configurations(given, text):
    with pytest.raises(OptionError, match=text):
        parse_configuration(given)


def test_stacked_pyramids_do_not_mix():
    parts = [
        build_pyramid(scene(n, 6.0, n)[0], np.full((n, 1), n, np.float32), TINY)
        for n in (100, 256, 30)
    ]
    whole = join_pyramids(parts)
    fine = np.repeat(np.arange(3), [100, 256, 30])
    for k, step in enumerate(whole.steps):
        coarse = np.repeat(np.arange(3), [len(part.steps[k].groups) for part in parts])
        assert (fine[step.groups] == coarse[:, None]).all()
        assert (coarse[step.nearest] == fine[:, None]).all()
        fine = coarse
