"""Spatial cross-validation: whole blocks, a gap, and scores that do not flatter."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from pdal_stages.base.errors import OptionError
from pdal_stages.classifier.crossval import block_folds, score, split
from pdal_stages.classifier.trees import Ranked, TreeOptions


@settings(max_examples=30, deadline=None)
@given(
    st.integers(0, 10**6), st.integers(2, 5), st.sampled_from([5.0, 13.0]), st.sampled_from([0.0, 1.0, 6.0])
)
def test_blocks_are_whole_and_the_gap_is_kept(seed, folds, block, gap):
    random = np.random.default_rng(seed)
    xy = random.random((400, 2)) * 60 - 20
    label = random.integers(0, 3, 400)
    fold = block_folds(xy, label, np.ones(400, int), folds, block)
    assert set(fold.tolist()) == set(range(folds))
    cell = np.floor(xy / block).astype(int)
    for one in np.unique(cell, axis=0):
        assert len(set(fold[(cell == one).all(axis=1)].tolist())) == 1
    for number in range(folds):
        train, held = split(xy, fold, number, gap)
        assert (fold[held] == number).all() and not train[held].any()
        if train.any():
            near = cdist(xy[train], xy[held]).min(axis=1)
            assert (near > gap).all() if gap else True
        dropped = np.flatnonzero(~train & (fold != number))
        if len(dropped):  # nothing is dropped without need
            assert (cdist(xy[dropped], xy[held]).min(axis=1) <= gap).all()


def test_every_fold_gets_its_share_of_every_class():
    random = np.random.default_rng(0)
    xy = random.random((5000, 2)) * 200
    label = (xy[:, 0] > 150).astype(int)
    fold = block_folds(xy, label, np.ones(5000, int), 4, 20.0)
    for k in (0, 1):
        share = np.bincount(fold[label == k], minlength=4) / (label == k).sum()
        assert share.min() > 0.15


def test_order_of_samples_does_not_matter():
    random = np.random.default_rng(0)
    xy = random.random((500, 2)) * 100
    label = random.integers(0, 2, 500)
    p = random.permutation(500)
    one = np.ones(500, int)
    assert np.array_equal(block_folds(xy, label, one, 3, 20.0)[p], block_folds(xy[p], label[p], one, 3, 20.0))


def test_too_few_blocks_is_an_error():
    with pytest.raises(OptionError, match="fewer than the 3 folds"):
        block_folds(np.random.default_rng(0).random((50, 2)), np.zeros(50, int), np.ones(50, int), 3, 10.0)


def test_a_memorised_place_scores_no_better_than_chance():
    """Features that name the place are useless elsewhere; a spatial score must say so."""
    random = np.random.default_rng(0)
    xy = random.random((1500, 2)) * 100
    cell = np.floor(xy / 5).astype(int)
    label = random.integers(0, 2, (20, 20))[cell[:, 0], cell[:, 1]]
    values = Ranked.of(xy.astype(np.float32))
    weight = np.ones(1500, np.int64)
    fold = block_folds(xy, label, weight, 4, 25.0)
    row = score(values, label, weight, xy, (2, 6), TreeOptions(1), 20, fold, gap=5.0, seed=0, progress=False)
    assert row["overall_accuracy"] < 0.62 and len(row["mean_f1_by_fold"]) == 4


def test_a_class_only_in_one_block_is_an_error():
    xy = np.random.default_rng(0).random((300, 2)) * 100
    label = (np.hypot(*(xy - 10).T) < 5).astype(int)
    weight = np.ones(300, np.int64)
    fold = block_folds(xy, label, weight, 3, 25.0)
    values = Ranked.of(xy.astype(np.float32))
    with pytest.raises(OptionError, match="no samples left"):
        score(values, label, weight, xy, (2, 6), TreeOptions(), 3, fold, gap=0.0, seed=0, progress=False)
