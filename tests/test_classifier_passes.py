"""Models of several passes: what they gain, and that nothing but the cloud decides what comes out."""

import json

import numpy as np
import pytest
from test_classifier_training import SMALL, scene

from pdal_stages import TrainingCloud, TrainingOptions, load_model, train
from pdal_stages.base.errors import ModelError, OptionError
from pdal_stages.classifier import auto_context, model_file
from pdal_stages.features import FeatureEngine

FEW = {
    **{key: value for key, value in SMALL.items() if key != "passes"},
    "feature_set": "covariance",
    "neighborhoods": "s1",
    "trees": 8,
    "context": ["own", "box1", "column4"],
}


def learned(number=2, **more):
    xyz, label, dimensions = scene()
    options = TrainingOptions(**{**FEW, **more}, passes=number)
    return train([TrainingCloud(xyz, label, dimensions, "a.laz")], options, progress=False)


@pytest.fixture(scope="module")
def two():
    return learned()


@pytest.fixture(scope="module")
def three():
    return learned(3, context=["own", "columnvotes2"])


@pytest.fixture(scope="module")
def other():
    return scene(seed=7, n=5000)


@pytest.fixture(autouse=True)
def small_bands(monkeypatch):
    """Scenes of a few thousand points have several bands."""
    monkeypatch.setattr(auto_context, "BAND", 500)


def same(a, b, rows=slice(None), other=slice(None)):
    for name in ("classification", "reliability", "margin", "probabilities"):
        first, two = getattr(a, name), getattr(b, name)
        assert np.array_equal(first[rows], two[other]), name


def everything(model, xyz, dimensions, where=None, **more):
    return model.predict(xyz, dimensions, where, probabilities=True, margin=True, **more)


def test_a_second_pass_sees_more_than_the_first(two, other):
    xyz, label, dimensions = other
    single = (learned(1).predict(xyz, dimensions).classification == label).mean()
    assert 1 - (two.predict(xyz, dimensions).classification == label).mean() < 0.5 * (1 - single)
    inner = max(two.passes[0].plan.halo_m + 8.0, two.passes[1].plan.halo_m)
    assert two.halo_m == inner + two.voxel
    assert two.required_dimensions == ("HeightAboveGround",)


def test_equals_passes_by_hand(two, other):
    """Features, first forest, context by loops, second forest."""
    from test_classifier_context import reference

    from pdal_stages.classifier.context_features import count_shares

    xyz, _, dimensions = other
    first, second = two.passes
    engine = FeatureEngine(xyz, first.plan, bins=first.features.bins)
    values = engine.table(dimensions={"HeightAboveGround": dimensions["HeightAboveGround"]}).values
    shares = count_shares(first.forest.predict_proba(values))
    rows = np.arange(0, len(xyz), 7)
    columns = reference(xyz, shares, rows, second.context)
    p = second.forest.predict_proba(np.hstack([values[rows], columns]))
    p = p * two.factors
    p /= p.sum(axis=1, keepdims=True)
    ours = everything(two, xyz, dimensions).probabilities[rows]
    assert np.array_equal(ours, p.astype(np.float32))


def test_blocks_threads_memory_and_order_change_nothing(two, other):
    model, (xyz, _, dimensions) = two, other
    whole = everything(model, xyz, dimensions, threads=1, memory_mb=2000)
    same(whole, everything(model, xyz, dimensions, threads=3, memory_mb=32))
    p = np.random.default_rng(0).permutation(len(xyz))
    shuffled = everything(model, xyz[p], {k: v[p] for k, v in dimensions.items()}, threads=2)
    same(whole, shuffled, p)


def test_where_and_tiles_change_nothing(three, other):
    model = three
    xyz, _, dimensions = other
    whole = everything(model, xyz, dimensions)
    inner = (np.abs(xyz[:, :2] - 30) < 8).all(axis=1)
    part = everything(model, xyz, dimensions, inner, current=np.full(len(xyz), 9))
    same(whole, part, inner, inner)
    assert (part.classification[~inner] == 9).all() and not part.reliability[~inner].any()
    near = (np.abs(xyz[:, :2] - 30) < 8 + model.halo_m).all(axis=1)
    assert not near.all()
    tile = everything(model, xyz[near], {k: v[near] for k, v in dimensions.items()}, inner[near])
    same(whole, tile, inner, inner[near])
    none = everything(model, xyz, dimensions, np.zeros(len(xyz), bool))
    assert none.report.figures["classified"] == 0 and not none.classification.any()


def test_empty_and_lone(two):
    empty = two.predict(np.zeros((0, 3)), {"HeightAboveGround": np.zeros(0)})
    assert len(empty.classification) == 0
    lone = two.predict(np.array([[1e6, 2e6, 3.0]]), {"HeightAboveGround": np.zeros(1)})
    assert lone.report.figures["classified"] == 1


def test_the_file_holds_all_passes(three, other, tmp_path):
    xyz, _, dimensions = other
    three.save(tmp_path / "m")
    again = load_model(tmp_path / "m")
    again.save(tmp_path / "n")
    assert (tmp_path / "m").read_bytes() == (tmp_path / "n").read_bytes()
    same(everything(three, xyz, dimensions), everything(again, xyz, dimensions))
    assert again.halo_m == three.halo_m and str(again) == str(three)
    assert "pass 3" in str(again) and "columnvotes2" in str(again)


def test_training_depends_on_nothing_but_the_points(two, tmp_path):
    xyz, label, dimensions = scene()
    p = np.random.default_rng(1).permutation(len(xyz))
    cloud = TrainingCloud(xyz[p], label[p], {k: v[p] for k, v in dimensions.items()}, "a.laz")
    options = TrainingOptions(**FEW, passes=2, threads=3, memory_mb=40)
    again = train([cloud], options, progress=False)
    two.save(tmp_path / "m")
    again.save(tmp_path / "n")
    assert (tmp_path / "m").read_bytes() == (tmp_path / "n").read_bytes()


@pytest.mark.parametrize(
    "edit",
    [
        lambda m: m["passes"].reverse(),
        lambda m: m["passes"][1].update(context=[]),
        lambda m: m["passes"][1].update(context=["own", "box1", "column2"]),
        lambda m: m["passes"][1].update(context=["own", "sphere1"]),
        lambda m: m["passes"][0].update(context=["own"]),
        lambda m: m["passes"].pop(),
        lambda m: m["passes"][1].update(algorithm="alsnet"),
    ],
)
def test_hostile_passes_are_refused(two, tmp_path, edit):
    manifest = json.loads(json.dumps(two.manifest()))
    edit(manifest)
    with pytest.raises(ModelError):
        model_file.write(tmp_path / "m", manifest, [entry.arrays() for entry in two.passes])
        load_model(tmp_path / "m")


def test_options():
    for bad in ({"passes": 4}, {"passes": 0}, {"passes": 2, "context": []}, {"context": "box3"}):
        with pytest.raises(OptionError):
            TrainingOptions(**bad)
