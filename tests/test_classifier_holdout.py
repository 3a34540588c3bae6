"""Ground that is held out: whole blocks or surveys, a gap, and shares of every class."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from pdal_stages.base.errors import OptionError
from pdal_stages.classifier.sampling import Folds, split


def block_folds(xy, label, folds, side):
    return Folds.of_blocks(xy, label, np.ones(len(xy), int), folds, side).points(xy)


@settings(max_examples=15, deadline=None)
@given(
    st.integers(0, 10**6),
    st.integers(2, 5),
    st.sampled_from([5.0, 13.0]),
    st.sampled_from([0.0, 1.0, 6.0]),
)
def test_blocks_are_whole_and_the_gap_is_kept(seed, folds, block, gap):
    random = np.random.default_rng(seed)
    xy = random.random((400, 2)) * 60 - 20
    label = random.integers(0, 3, 400)
    fold = block_folds(xy, label, folds, block)
    assert set(fold.tolist()) == set(range(folds))
    cell = np.floor(xy / block).astype(int)
    for entry in np.unique(cell, axis=0):
        assert len(set(fold[(cell == entry).all(axis=1)].tolist())) == 1
    p = random.permutation(400)
    assert np.array_equal(fold[p], block_folds(xy[p], label[p], folds, block))
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
    fold = block_folds(xy, label, 4, 20.0)
    for k in (0, 1):
        share = np.bincount(fold[label == k], minlength=4) / (label == k).sum()
        assert share.min() > 0.15


def test_folds_are_blocks_or_whole_surveys():
    random = np.random.default_rng(0)
    xy = random.random((900, 2)) * (90, 70)
    label, first = random.integers(0, 2, 900), np.ones(900, int)
    folds = Folds.of_ground(xy, label, first, ("x", "y"), 4)
    assert folds.count == 4 and not folds.surveys
    # Ground without samples belongs to some fold as well.
    far = random.random((500, 3)) * 1000 - 500
    assert set(folds.points(far).tolist()) == {0, 1, 2, 3}
    folds = Folds.of_ground(xy, label, first, ("x", "y", "z", "x"), 5)
    assert folds.count == 3 and sorted(folds.surveys.values()) == [0, 1, 2]
    assert (folds.points(far, "y") == folds.surveys["y"]).all()
    small = Folds.of_ground(xy / 20, label, first, ("x",), 5)  # where blocks of 25 m are too few
    assert small.side < 5 and small.count == 5
    with pytest.raises(OptionError, match="too small"):
        Folds.of_ground(np.ones((9, 2)), np.ones(9, int), np.ones(9, int), ("x",), 5)
