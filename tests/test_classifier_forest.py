"""The forest in arrays gives scikit-learn's own answers, and refuses arrays that are no forest."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.ensemble import RandomForestClassifier

from pdal_stages import TrainingOptions
from pdal_stages.base.errors import ModelError
from pdal_stages.classifier.random_forest import MAX_DEPTH, Forest, grow_forest


def data(n=600, features=17, classes=4, seed=0):
    random = np.random.default_rng(seed)
    y = random.integers(0, classes, n)
    x = random.normal(size=(n, features)) + random.normal(size=(classes, features))[y]
    return np.ascontiguousarray(x, dtype=np.float32), y


def oracle(forest, values):
    """A slow, obvious walk over the documented layout."""
    out = np.zeros((len(values), forest.n_classes))
    start = leaf = 0
    for size in forest.tree_sizes:
        feature = forest.feature[start : start + size]
        splits = np.cumsum(feature >= 0) - 1
        leaves = leaf + np.cumsum(feature < 0) - 1
        for r, row in enumerate(values):
            i = 0
            while feature[i] >= 0:
                left = row[feature[i]] <= forest.threshold[start + i]
                i = 2 * splits[i] + (1 if left else 2)
            counts = forest.leaf_counts[leaves[i]].astype(float)
            out[r] += counts / counts.sum()
        start += size
        leaf = leaves[-1] + 1
    return out / len(forest.tree_sizes)


def test_equals_sklearn_bit_for_bit():
    x, y = data()
    reference = RandomForestClassifier(9, random_state=1, min_samples_leaf=2).fit(x, y)
    forest = Forest.from_sklearn(reference.estimators_, x.shape[1])
    assert forest.predict_proba(np.zeros((0, 17), np.float32)).shape == (0, 4)
    rows = data(2050, seed=5)[0]  # more than walk a tree together
    ours = forest.predict_proba(rows)
    assert np.array_equal(ours, reference.set_params(n_jobs=1).predict_proba(rows))


@settings(max_examples=12, deadline=None)
@given(
    st.integers(0, 10**6),
    st.integers(1, 9),
    st.integers(1, 300),
    st.sampled_from([None, 1, 3]),
    st.integers(1, 20),
)
def test_equals_sklearn_on_any_forest(seed, trees, rows, depth, leaf):
    # Values from a coarse grid: many land exactly on thresholds' neighbors, many leaves tie.
    random = np.random.default_rng(seed)
    x = (random.integers(-5, 6, (rows, 3)) / 3).astype(np.float32)
    y = random.integers(0, 3, rows)
    reference = RandomForestClassifier(
        trees, max_depth=depth, min_samples_leaf=leaf, random_state=seed % 1000, n_jobs=1
    )
    reference.fit(x, y)
    forest = Forest.from_sklearn(reference.estimators_, 3)
    query = np.concatenate([x, (random.integers(-10, 11, (50, 3)) / 6).astype(np.float32)])
    assert np.array_equal(forest.predict_proba(query), reference.predict_proba(query))
    assert np.allclose(forest.predict_proba(query), oracle(forest, query), atol=1e-12)


# ---- arrays that are no forest ---------------------------------------------------------------------------


def small():
    x, y = data(200, 5, 3)
    forest = Forest.from_sklearn(
        RandomForestClassifier(3, random_state=0, max_depth=4).fit(x, y).estimators_, 5
    )
    return {name: array.copy() for name, array in forest.arrays().items()}


def broken(change):
    arrays = small()
    change(arrays)
    with pytest.raises(ModelError) as caught:
        Forest.from_arrays(arrays, 5, 3)
    return str(caught.value)


def test_hostile_arrays():
    split = int(np.flatnonzero(small()["feature"] >= 0)[1])
    leaf = int(np.flatnonzero(small()["feature"] < 0)[1])

    def put(name, at, value):
        return lambda a: a[name].__setitem__(at, value)

    assert "does not exist" in broken(put("feature", split, 5))
    assert "does not exist" in broken(put("feature", split, -2))
    assert "finite" in broken(put("threshold", split, np.nan))
    assert "finite" in broken(put("threshold", split, np.inf))
    assert "tree" in broken(put("feature", leaf, 0))  # a split more: its children are missing
    assert "tree" in broken(put("feature", split, -1))  # a split less: nodes nobody reaches
    assert "no samples" in broken(put("leaf_counts", 0, 0))
    assert "sizes" in broken(put("tree_sizes", 0, 0))
    assert "sizes" in broken(put("tree_sizes", 0, -3))
    assert "leaf" in broken(lambda a: a.update(leaf_counts=a["leaf_counts"][:-1]))
    assert "classes" in broken(lambda a: a.update(leaf_counts=a["leaf_counts"][:, :2].copy()))
    assert "fit" in broken(lambda a: a.update(threshold=a["threshold"][:-1]))
    assert "fit" in broken(lambda a: a.update(tree_sizes=a["tree_sizes"][:0]))
    moved = broken(lambda a: a["tree_sizes"].__iadd__(np.array([1, -1, 0], np.int32)))
    assert "tree" in moved or "leaf" in moved


def made(sizes, feature, leaves):
    """A forest of five features without thresholds."""
    counts, threshold = np.ones((leaves, 2), np.uint32), np.zeros(len(feature), np.float32)
    return Forest(np.array(sizes, np.int32), feature, threshold, counts, 5)


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.integers(-3, 6), min_size=1, max_size=40),
    st.lists(st.integers(-2, 30), min_size=1, max_size=5),
)
def test_any_arrays_are_a_forest_or_an_error(feature, sizes):
    feature = np.array(feature, np.int16)
    leaves = int((feature < 0).sum())
    try:
        forest = made(sizes, feature, leaves)
    except ModelError:
        return
    query = np.random.default_rng(0).normal(size=(20, 5)).astype(np.float32)
    assert np.allclose(forest.predict_proba(query), oracle(forest, query))


def test_a_tree_deeper_than_any_real_one_is_refused():
    n = MAX_DEPTH + 2
    feature = np.zeros(2 * n + 1, np.int16)
    feature[1::2] = -1
    feature[-1] = -1
    with pytest.raises(ModelError, match="deeper"):
        made([len(feature)], feature, int((feature < 0).sum()))


def growth(**options):
    """Options of growing trees on all samples."""
    return TrainingOptions(**{"min_samples_leaf": 1, "max_samples": 1.0, **options})


# ---- growing ---------------------------------------------------------------------------------------------


def test_growing_does_not_depend_on_threads_and_counts_weights():
    x, y = data(300)
    weight = np.ones(300, np.int64)
    weight[:50], weight[290:] = 3, 0
    setting = {"seed": 4, "min_samples_leaf": 2, "max_samples": 0.5}
    first, other = (
        grow_forest(x, y, weight, 7, growth(threads=threads, **setting)) for threads in (1, 3)
    )
    for name, array in first[0].arrays().items():
        assert np.array_equal(array, other[0].arrays()[name])
    assert np.array_equal(first[1], other[1]) and first[1].sum() == pytest.approx(1)
    assert first[0].leaf_counts.sum() == 7 * round(0.5 * weight.sum())
    assert (first[0].predict_proba(x).argmax(axis=1) == y).mean() > 0.8
