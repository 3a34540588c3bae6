"""A gradient booster of scikit-learn, registered from outside, is trained, stored and applied like the forest."""

from __future__ import annotations

import laspy
import numpy as np
import pytest
from sklearn.ensemble import GradientBoostingClassifier

import pdal_stages as ps
from pdal_stages.base.errors import ModelError, OptionError
from pdal_stages.classifier.feature_kind import FeatureKind
from pdal_stages.classifier.interface import KINDS, ArrayRule
from pdal_stages.cli import main


class Booster:
    """Boosted trees as arrays: a row of `nodes` has left, right, feature (-1: a leaf), threshold and value."""

    rules = {
        "nodes": ArrayRule(("<f8",), 2),
        "roots": ArrayRule(("<i4",), 2),
        "start": ArrayRule(("<f8",), 1),
    }

    def __init__(self, nodes, roots, start):
        self.nodes, self.roots, self.start = nodes, roots, start

    @classmethod
    def fit(cls, values, label, weight, trees, options, progress=None):
        if not isinstance(trees, int):
            raise OptionError("boosting takes one number of trees", found=str(trees))
        learned = GradientBoostingClassifier(n_estimators=trees, random_state=options.seed)
        learned.fit(values, label, sample_weight=weight)
        nodes, roots = [], np.zeros(learned.estimators_.shape, np.int32)
        for place, tree in np.ndenumerate(learned.estimators_):
            t, roots[place] = tree.tree_, sum(map(len, nodes))
            leaf = t.children_left < 0
            children = [
                np.where(leaf, 0, each + roots[place])
                for each in (t.children_left, t.children_right)
            ]
            value = learned.learning_rate * t.value[:, 0, 0]
            nodes.append(
                np.column_stack([*children, np.where(leaf, -1, t.feature), t.threshold, value])
            )
        start = np.log(np.clip(learned.init_.class_prior_, 1e-15, 1))
        return cls(np.concatenate(nodes), roots, start), learned.feature_importances_

    @classmethod
    def from_arrays(cls, arrays, n_features, n_classes):
        nodes, roots, start = (arrays[name] for name in cls.rules)
        if nodes.shape[1] != 5 or roots.shape[1:] != start.shape or len(start) != n_classes:
            raise ModelError("the booster's arrays do not fit", found=str(roots.shape))
        inside = (
            (nodes[:, :2] >= 0).all()
            and (nodes[:, :2] < len(nodes)).all()
            and (nodes[:, 2] < n_features).all()
        )
        if not inside or roots.min() < 0 or roots.max() >= len(nodes):
            raise ModelError("a node of the booster leads nowhere")
        return cls(nodes, roots, start)

    def arrays(self):
        return {"nodes": self.nodes, "roots": self.roots, "start": self.start}

    def parameters(self):
        return {"trees": self.roots.size, "nodes": len(self.nodes)}

    def predict_proba(self, values):
        raw, rows = np.tile(self.start, (len(values), 1)), np.arange(len(values))
        for (_, column), root in np.ndenumerate(self.roots):
            at = np.full(len(values), root)
            for _ in range(3):  # trees of depth 3
                left, right, feature, threshold = self.nodes[at, :4].T
                to = np.where(values[rows, feature.astype(int)] <= threshold, left, right).astype(
                    int
                )
                at = np.where(feature < 0, at, to)
            raw[:, column] += self.nodes[at, 4]
        p = np.exp(raw - raw.max(axis=1, keepdims=True))
        return p / p.sum(axis=1, keepdims=True)


@pytest.fixture(autouse=True)
def boosting(monkeypatch):
    monkeypatch.setitem(KINDS, "boosting", FeatureKind("boosting", lambda: Booster))


@pytest.fixture()
def scene():
    """Ground, a roof and a bush."""
    rng = np.random.default_rng(4)
    ground = np.column_stack([rng.uniform(0, 40, (3000, 2)), rng.normal(0, 0.03, 3000)])
    roof = np.column_stack([rng.uniform(10, 22, (1200, 2)), rng.normal(6, 0.03, 1200)])
    bush = rng.normal([30, 30, 2], [3, 3, 0.8], (1200, 3))
    return np.vstack([ground, roof, bush]), np.repeat([2, 6, 5], [3000, 1200, 1200]).astype(
        np.uint8
    )


def options(**more):
    return ps.TrainingOptions(
        neighborhoods="s2", algorithm="boosting", trees=8, count=300, folds=0, **more
    )


def test_as_scikit_learn_computes_it(scene):
    values = np.random.default_rng(0).normal(size=(300, 4)).astype(np.float32)
    label = (values[:, 0] > 0).astype(int) + (values[:, 1] > 0.5)
    booster, _ = Booster.fit(values, label, np.ones(300, int), 8, options())
    theirs = GradientBoostingClassifier(n_estimators=8, random_state=0).fit(values, label)
    assert np.allclose(booster.predict_proba(values), theirs.predict_proba(values))


def test_it_trains_is_stored_and_classifies_in_tiles(scene, tmp_path, write_las):
    xyz, codes = scene
    model = ps.train(xyz, codes, options(), progress=False)
    assert [each.name for each in model.passes] == ["boosting"] * 2 and model.importances()
    model.save(tmp_path / "b.model")
    loaded = ps.load_model(tmp_path / "b.model")
    whole = loaded.predict(xyz)
    assert np.array_equal(whole.classification, model.predict(xyz).classification)
    assert (whole.classification == codes).mean() > 0.9 and "boosting" in str(loaded)
    cloud = write_las(tmp_path / "in.las", dict(zip("XYZ", xyz.T, strict=True)), point_format=6)
    words = ["classify", str(cloud), "--model", str(tmp_path / "b.model"), "--no-noise"]
    assert main([*words, str(tmp_path / "whole.las")]) == 0
    assert main([*words, str(tmp_path / "tiles.las"), "--tile", "15", "--workers", "0"]) == 0
    one, tiles = (laspy.read(tmp_path / f"{name}.las") for name in ("whole", "tiles"))
    assert np.array_equal(one.classification, tiles.classification)
    assert np.array_equal(one["Reliability"], tiles["Reliability"])


def test_it_refuses_what_it_cannot(scene, tmp_path):
    xyz, codes = scene
    with pytest.raises(OptionError, match="one number of trees"):
        ps.train(xyz, codes, options(trees_grid=(2, 4)), progress=False)
    model = ps.train(xyz, codes, options(passes=1), progress=False)
    with pytest.raises(OptionError, match="on a 'base'"):
        options(base=model)
    with pytest.raises(OptionError, match="only a network gives a variance"):
        model.predict(xyz, variance=True)
    model.save(tmp_path / "b.model")
    del KINDS["boosting"]
    with pytest.raises(ModelError, match="an algorithm this release does not know"):
        ps.load_model(tmp_path / "b.model")
    with pytest.raises(OptionError, match="'algorithm'"):
        options()


def test_arrays_that_are_no_booster_are_refused():
    arrays = {"nodes": np.zeros((1, 5)), "roots": np.array([[9]], np.int32), "start": np.zeros(1)}
    with pytest.raises(ModelError, match="leads nowhere"):
        Booster.from_arrays(arrays, 3, 1)
