"""What inputs add to a probability: sums to 1e-6 for all kinds of forests, and against a slow walk."""

import numpy as np
import pytest
from test_classifier_forest import data
from test_classifier_passes import FEW
from test_classifier_training import scene
from test_refinement import on_top

from pdal_stages import TrainingCloud, TrainingOptions, train
from pdal_stages.classifier.interface import ModelObserver
from pdal_stages.classifier.random_forest import grow_forest


def slow(forest, row):
    """Walk each tree; a node's share is that of the counts of all leaves below it."""
    start, added = np.zeros(forest.n_classes), np.zeros((forest.n_features, forest.n_classes))
    first = leaf = 0
    for size in forest.tree_sizes:
        feature, threshold = (a[first : first + size] for a in (forest.feature, forest.threshold))
        splits, leaves = np.cumsum(feature >= 0) - 1, leaf + np.cumsum(feature < 0) - 1

        def share(node, feature=feature, splits=splits, leaves=leaves):
            def count(node):
                if feature[node] < 0:
                    return forest.leaf_counts[leaves[node]].astype(float)
                return count(2 * splits[node] + 1) + count(2 * splits[node] + 2)

            return count(node) / count(node).sum()

        node, start = 0, start + share(0)
        while feature[node] >= 0:
            left = row[feature[node]] <= threshold[node]
            child = 2 * splits[node] + (1 if left else 2)
            added[feature[node]] += share(child) - share(node)
            node = child
        first, leaf = first + size, leaves[-1] + 1
    return start / forest.n_trees, added / forest.n_trees


@pytest.mark.parametrize("vote", ["mean", "majority"])
def test_contributions_equal_a_slow_walk(vote):
    values, label = data()
    growth = TrainingOptions(vote=vote, min_samples_leaf=1)
    forest, _ = grow_forest(values, label, np.ones(len(label), np.int64), 5, growth)
    rows = data(7, seed=5)[0]
    start, added = forest.contributions(rows)
    for row, of_row in zip(rows, added, strict=True):
        slow_start, slow_added = slow(forest, row)
        assert np.allclose(start, slow_start, atol=1e-12)
        assert np.allclose(of_row, slow_added, atol=1e-12)


@pytest.fixture(scope="module")
def observed():
    """Return a function that gives, for each pass of a model, it and what it read of some points."""
    xyz, _, dimensions = scene(seed=7, n=4000)

    def read(model):
        where, seen = np.zeros(len(xyz), bool), {}
        where[[5, 77, 1234, 3001]] = True

        class Observer(ModelObserver):
            def see_inputs(self, inputs):
                if len(inputs.rows):
                    seen.setdefault(inputs.number, []).append(inputs)

            def see_classes(self, step, codes, least=None):
                assert len(codes) == len(xyz)

        model.predict(xyz, dimensions, where, observer=Observer())
        parts = [[*zip(*seen[number], strict=True)][1:] for number in range(len(model.passes))]
        return [
            (single, *map(np.concatenate, part))
            for single, part in zip(model.passes, parts, strict=True)
        ]

    return read


def models():
    cloud = TrainingCloud(*scene(), "a.laz")
    yield train([cloud], TrainingOptions(**FEW, passes=2, prior_weight=0.5), progress=False)
    yield train([cloud], TrainingOptions(**FEW, passes=2, vote="majority"), progress=False)
    base = train([cloud], TrainingOptions(**{**FEW, "voxel": 0.25}, passes=2), progress=False)
    yield on_top(base)
    yield on_top(base, keep=[5, 6])


def test_sums_are_the_probabilities_of_each_pass(observed):
    """Of forests, refined forests (all passes) and majority votes, whatever the priors."""
    for model in models():
        for single, rows, _, values, probabilities in observed(model):
            start, added = single.contributions(values)
            assert sorted(rows) == [5, 77, 1234, 3001] and added.shape == (
                *values.shape,
                probabilities.shape[1],
            )
            assert np.abs(start + added.sum(axis=1) - probabilities).max() < 1e-6


def test_what_passes_read_is_observed_of_the_points_to_classify_alone(observed):
    model = train(
        [TrainingCloud(*scene(), "a.laz")], TrainingOptions(**FEW, passes=2), progress=False
    )
    first, second = observed(model)
    assert sorted(first[1]) == sorted(second[1]) == [5, 77, 1234, 3001]
