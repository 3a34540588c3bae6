"""Thresholds fitted to several clouds: as if they were one."""

import numpy as np
import pytest

from pdal_stages import TrainingCloud, TrainingOptions, train
from pdal_stages.features import FeatureEngine, FeaturePlan
from pdal_stages.features.engine import fit_clouds
from pdal_stages.features.shape_distributions import SAMPLES, smallest_hashes

PLAN = FeaturePlan.parse("c1,s2,k5,kopt(5,20),copt", ("all",))


def rough(n, seed, height, away=0.0):
    """Ground with bushes of a height, on a field of its own."""
    xyz = np.random.default_rng(seed).uniform(0, 1, (n, 3)) * (20, 20, height)
    xyz[: n // 2, 2] = 0.0
    return np.round(xyz, 3) + np.array([away, 0, 0])


CLOUDS = (rough(1500, 0, 0.5), rough(900, 1, 4.0, 1000.0), rough(400, 2, 2.0, 2000.0))


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)])
def test_clouds_far_apart_are_fitted_as_one(order):
    """Neighborhoods never meet, so the clouds joined to one must give the same bits."""
    whole = FeatureEngine(np.concatenate(CLOUDS), PLAN, seed=3).fit()
    bins, threshold = fit_clouds([CLOUDS[k] for k in order], PLAN, seed=3)
    assert threshold == whole.copt_threshold
    assert bins == whole.bins
    alone = [FeatureEngine(cloud, PLAN, seed=3).fit() for cloud in CLOUDS]
    assert threshold not in [engine.copt_threshold for engine in alone]
    assert all(bins != engine.bins for engine in alone)


def test_nothing_is_fitted_that_no_feature_needs():
    assert fit_clouds(CLOUDS, FeaturePlan.parse("c1,kopt", "covariance")) == (None, None)
    bins, threshold = fit_clouds(CLOUDS, FeaturePlan.parse("copt", "covariance"))
    assert bins is None and threshold is not None
    bins, threshold = fit_clouds(CLOUDS, FeaturePlan.parse("c1", "A3"))
    assert bins is not None and threshold is None


def test_samples_are_the_smallest_hashes_whatever_the_order_and_the_copies():
    xyz = CLOUDS[0]
    hashes, rows = smallest_hashes(xyz, 5)
    assert len(rows) == SAMPLES and (np.diff(hashes.astype(float)) >= 0).all()
    doubled = np.concatenate([xyz[::-1], xyz])
    again, where = smallest_hashes(doubled, 5)
    assert np.array_equal(hashes, again)
    assert np.array_equal(doubled[where], xyz[rows])


def test_a_thinned_copy_gives_its_samples_too():
    """The same points in two densities: the order of the clouds still does not matter."""
    thin = CLOUDS[0][::3]
    plan = FeaturePlan.parse("s2", "shapes")
    first, other = fit_clouds([CLOUDS[0], thin], plan), fit_clouds([thin, CLOUDS[0]], plan)
    assert first == other
    assert first[0] != fit_clouds([CLOUDS[0]], plan)[0]


def test_training_stores_what_all_clouds_give():
    clouds = [
        TrainingCloud(xyz, np.where(xyz[:, 2] > 0, 5, 2), name=f"cloud {k}")
        for k, xyz in enumerate(CLOUDS)
    ]
    options = TrainingOptions(
        neighborhoods="copt,s2", feature_set=("covariance", "D2"), dimensions=(), count=50, trees=2, passes=1, voxel=0.0,
        threads=1,
    )  # fmt: skip
    model = train(clouds, options, progress=False)
    features = model.passes[0].features
    expected = fit_clouds([cloud.xyz for cloud in clouds], features.plan)
    assert (features.bins, features.copt_threshold) == expected
