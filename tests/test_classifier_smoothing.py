"""Smoothed probabilities beside a plain double loop; order, threads, copies, `where`, tiles."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_classifier_training import SMALL, scene

from pdal_stages.base.errors import OptionError
from pdal_stages.classifier import TrainingCloud, TrainingOptions, train
from pdal_stages.classifier.smoothing import WHOLE, count_shares, smooth


def plain(xyz, shares, radius):
    """Half the own, half the mean over the sphere, point by point."""
    out = np.empty(shares.shape)
    for i, q in enumerate(xyz):
        inside = ((xyz - q) ** 2).sum(axis=1) <= radius * radius
        out[i] = 0.5 * shares[i] / shares[i].sum() + 0.5 * shares[inside].sum(axis=0) / shares[inside].sum()
    return out


def random_shares(rng, n, classes=3):
    return count_shares(rng.dirichlet(np.ones(classes), n))


@settings(max_examples=40, deadline=None)
@given(
    st.integers(1, 150), st.sampled_from([0.1, 0.35, 1.0, 1.5, 3.7]), st.integers(0, 2**32 - 1), st.booleans()
)
def test_equals_the_double_loop(n, radius, seed, gridded):
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-3, 3, (n, 3)) + np.array([500_000, 5_400_000, 300])
    if gridded:  # distances of exactly the radius, copies
        xyz = np.round(xyz * 2) / 2
    shares = random_shares(rng, n)
    got = smooth(xyz, shares, radius, threads=2)
    # Rows of shares sum to 65535 but for rounding, which the mean over members weighs a little differently.
    np.testing.assert_allclose(got, plain(xyz, shares, radius), atol=3 / WHOLE)
    np.testing.assert_allclose(got.sum(axis=1), 1, atol=1e-6)
    order = rng.permutation(n)
    assert np.array_equal(smooth(xyz[order], shares[order], radius, threads=1), got[order])


def test_many_rows_and_pieces():
    """Several pieces of work, far strays, the same bits with any number of threads."""
    rng = np.random.default_rng(0)
    xyz = rng.uniform(0, 300, (250_000, 3)) * [1, 1, 0.02]
    xyz[0] += 1e8
    shares = random_shares(rng, len(xyz))
    one, two = (smooth(xyz, shares, 1.0, threads) for threads in (1, 2))
    assert np.array_equal(one, two)
    some = np.r_[0, rng.integers(0, len(xyz), 50)]
    from scipy.spatial import cKDTree

    for i, members in zip(some, cKDTree(xyz).query_ball_point(xyz[some], 1.0), strict=True):
        mean = shares[members].sum(axis=0) / shares[members].sum()
        np.testing.assert_allclose(one[i], 0.5 * shares[i] / shares[i].sum() + 0.5 * mean, atol=3 / WHOLE)


def test_a_heap_of_copies_takes_no_time():
    xyz = np.zeros((300_000, 3))
    shares = random_shares(np.random.default_rng(1), len(xyz))
    got = smooth(xyz, shares, 2.0)
    mean = shares.sum(axis=0, dtype=float) / shares.sum(dtype=float)
    np.testing.assert_allclose(
        got, 0.5 * shares / shares.sum(axis=1, keepdims=True) + 0.5 * mean, atol=3 / WHOLE
    )


def test_no_points_and_wrong_radii():
    assert smooth(np.zeros((0, 3)), np.zeros((0, 4), np.uint16), 1.0).shape == (0, 4)
    xyz, label, dimensions = scene(n=1500)
    model = train([TrainingCloud(xyz, label, dimensions, "a")], TrainingOptions(**SMALL), progress=False)
    for radius in (-1, 11, float("nan"), True, "1"):
        with pytest.raises(OptionError, match="smooth"):
            model.predict(xyz, dimensions, smooth=radius)


def test_prediction():
    """Classes, reliability and margin follow from the smoothed probabilities; outside `where` nothing counts."""
    xyz, label, dimensions = scene(n=3000)
    model = train([TrainingCloud(xyz, label, dimensions, "a")], TrainingOptions(**SMALL), progress=False)
    where = np.arange(len(xyz)) % 3 > 0
    for mask in (None, where):
        raw = model.predict(xyz, dimensions, mask, probabilities=True, margin=True)
        calm = model.predict(xyz, dimensions, mask, probabilities=True, margin=True, smooth=1.0)
        rows = np.flatnonzero(where) if mask is not None else np.arange(len(xyz))
        expected = plain(xyz[rows], count_shares(raw.probabilities[rows]), 1.0)
        np.testing.assert_allclose(calm.probabilities[rows], expected, atol=3 / WHOLE)
        p = calm.probabilities[rows]
        assert np.array_equal(calm.classification[rows], model.codes[p.argmax(axis=1)])
        assert np.array_equal(calm.reliability[rows], p.max(axis=1))
        top = np.sort(p, axis=1)
        np.testing.assert_allclose(calm.margin[rows], top[:, -1] - top[:, -2], atol=1e-6)
        if mask is not None:
            assert not calm.probabilities[~where].any() and not calm.classification[~where].any()
        assert calm.report.figures["smooth"] == 1.0 and "smooth" not in raw.report.figures
