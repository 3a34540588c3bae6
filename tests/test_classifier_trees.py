"""Grown trees are scikit-learn's, node by node and bit by bit."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.tree import DecisionTreeClassifier

from pdal_stages.base.errors import OptionError
from pdal_stages.classifier.trees import Ranked, TreeOptions, grow_tree


def assert_is_sklearns(values, label, weight, tried, seed, **options):
    reference = DecisionTreeClassifier(max_features=tried, random_state=seed, **options)
    reference.fit(values, label, sample_weight=weight.astype(np.float64))
    ranked = Ranked.of(values, threads=1)
    tree = grow_tree(ranked, label, weight, tried, seed, **options)
    theirs = reference.tree_
    split = theirs.children_left >= 0
    assert np.array_equal(tree.left, theirs.children_left)
    assert np.array_equal(tree.right, theirs.children_right)
    assert np.array_equal(tree.feature[split], theirs.feature[split])
    assert np.array_equal(tree.threshold[split], theirs.threshold[split])
    assert np.array_equal(tree.impurity, theirs.impurity)
    assert np.array_equal(tree.counts.sum(axis=1), theirs.weighted_n_node_samples)
    assert np.array_equal(tree.importances(values.shape[1]), reference.feature_importances_)
    # rows that it was not grown on too: their values lie between those of the samples
    rows = np.arange(len(values))
    assert np.array_equal(tree.shares(ranked, rows), reference.predict_proba(values))
    return tree


@settings(max_examples=80, deadline=None)
@given(
    st.integers(0, 10**6),
    st.integers(1, 300),
    st.integers(1, 12),
    st.integers(1, 6),
    st.sampled_from(["normal", "few values", "nearly equal", "constant columns", "signed zeros", "huge"]),
    st.sampled_from([1, 1_000, 100_000]),
    st.integers(1, 4),
)
def test_a_tree_is_scikit_learns(seed, rows, features, classes, kind, most, leaf):
    random = np.random.default_rng(seed)
    values = random.normal(size=(rows, features)).astype(np.float32)
    if kind == "few values":
        values = np.round(values)
    elif kind == "nearly equal":  # than 1e-7, values further apart are not told apart
        values *= np.float32(1e-7)
    elif kind == "constant columns":
        values[:, random.random(features) < 0.7] = 3.0
    elif kind == "signed zeros":
        values = np.where(values > 0.5, values, np.where(values > 0, np.float32(0.0), np.float32(-0.0)))
    elif kind == "huge":
        values *= np.float32(1e30)
    label = np.unique(random.integers(0, classes, rows), return_inverse=True)[1]
    weight = random.integers(0, 4, rows) * random.integers(1, most, rows, endpoint=True)
    weight[random.integers(rows)] += 1
    tried = int(random.integers(1, features, endpoint=True))
    assert_is_sklearns(values, label, weight, tried, seed, min_samples_leaf=leaf)


@pytest.mark.parametrize("tried", [1, 12])
def test_large_nodes_are_sorted_digit_by_digit(tried):
    random = np.random.default_rng(tried)
    values = random.normal(size=(30_000, 12)).astype(np.float32)  # places of more than two digits
    values[:, ::3] = np.round(values[:, ::3], 1)
    label = (values[:, 0] + values[:, 4] > random.normal(size=len(values))).astype(np.int64)
    label[values[:, 7] > 1.5] = 2
    weight = random.integers(0, 3, len(values))
    tree = assert_is_sklearns(values, label, weight, tried, 5, min_samples_leaf=30)
    assert len(tree.left) > 100


def test_ranks_of_two_matrices_side_by_side():
    random = np.random.default_rng(3)
    a, b = (random.normal(size=(50, n)).astype(np.float32) for n in (3, 2))
    both, whole = (
        Ranked.of(a).beside(Ranked.of(b)),
        Ranked.of(np.concatenate([a, b], axis=1), threads=2),
    )
    for name in ("place", "different", "start"):
        assert np.array_equal(getattr(both, name), getattr(whole, name))
    low, high = whole.limits(3)
    assert low == b.min(axis=0).tolist() and high == b.max(axis=0).tolist()


def test_counts_whose_squares_have_no_room_are_refused():
    ranked = Ranked.of(np.zeros((3, 1), np.float32))
    with pytest.raises(OptionError, match="too often"):
        grow_tree(ranked, np.array([0, 1, 1]), np.array([1, 1, 2**31]), 1, 0)


@pytest.mark.parametrize("features", [1, 7, 64, 569])
@pytest.mark.parametrize("asked", ["sqrt", "log2", 1, 5, 700, 0.01, 0.1, 1.0, np.float32(0.3)])
def test_features_tried_are_as_many_as_scikit_learn_tries(asked, features):
    x = np.random.default_rng(0).normal(size=(4, features)).astype(np.float32)
    tree = DecisionTreeClassifier(max_features=asked if isinstance(asked, str | int) else float(asked))
    theirs = min(tree.fit(x, [0, 1, 0, 1]).max_features_, features)
    assert TreeOptions(max_features=asked).tried(features) == theirs
