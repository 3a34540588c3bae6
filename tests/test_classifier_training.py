"""Training and prediction on small clouds: labels, files, blocks, threads, where, rejection, dimensions."""

import copy

import numpy as np
import pytest

from pdal_stages import Model, TrainingCloud, TrainingOptions, load_model, train
from pdal_stages.base.errors import DimensionError, ModelError, OptionError
from pdal_stages.classifier import model_file, training_percentiles
from pdal_stages.classifier.prediction import Prediction

SMALL = {
    "neighborhoods": "c1,s2,kopt(5,20)",
    "feature_set": "covariance,geometric,D2",
    "count": 150,
    "trees": 12,
    "min_samples_leaf": 1,
    "passes": 1,
    "voxel": 0.0,
}


def scene(seed=0, n=6000, origin=(0.0, 0.0, 0.0)):
    """A field (2), boxes with flat roofs (6) and round bushes (5), seen from above; dimensions of a flight."""
    random = np.random.default_rng(seed)
    xyz = random.random((n, 3)) * (60, 60, 0.1)
    label = np.full(n, 2)
    block = np.floor(xyz[:, :2] / 10).astype(int)
    kind = random.integers(0, 3, (6, 6))[block[:, 0], block[:, 1]]
    inside = (np.abs(xyz[:, :2] % 10 - 5) < 3).all(axis=1)
    roof, bush = (kind == 1) & inside, (kind == 2) & inside
    xyz[roof, 2] += 4
    xyz[bush, 2] += random.random(bush.sum()) * 4
    label[roof], label[bush] = 6, 5
    dimensions = {
        "HeightAboveGround": xyz[:, 2].copy(),
        "Intensity": random.integers(0, 1000, n).astype(np.uint16),
        "ReturnNumber": np.ones(n, np.uint8),
        "NumberOfReturns": random.integers(1, 4, n).astype(np.uint8),
    }
    return xyz + origin, label, dimensions


def learn(clouds, **more):
    return train(clouds, TrainingOptions(**SMALL, **more), progress=False)


@pytest.fixture(scope="module")
def trained() -> Model:
    return learn([TrainingCloud(*scene(), "some/folder/a.laz")])


@pytest.fixture(scope="module")
def other():
    return scene(seed=7, n=4000)


def accuracy(prediction, label):
    return (prediction.classification == label).mean()


def same(a: Prediction, b: Prediction):
    for name in ("classification", "reliability", "margin", "probabilities"):
        first, two = getattr(a, name), getattr(b, name)
        assert (first is None) == (two is None)
        assert first is None or np.array_equal(first, two), name


# ---- what comes out ------------------------------------------------------------------------------------


def test_another_place_is_classified(trained, other):
    xyz, label, dimensions = other
    result = trained.predict(xyz, dimensions, margin=True, probabilities=True)
    assert accuracy(result, label) > 0.9
    assert result.classification.dtype == np.uint8 and result.reliability.dtype == np.float32
    p = np.sort(result.probabilities, axis=1)
    assert np.allclose(p.sum(axis=1), 1, atol=1e-6)
    assert np.array_equal(result.reliability, p[:, -1])
    assert np.allclose(result.margin, p[:, -1] - p[:, -2], atol=1e-6)
    assert np.array_equal(trained.codes[result.probabilities.argmax(axis=1)], result.classification)
    assert result.report.figures["classified"] == len(xyz) and not len(result.unsure)
    assert sum(result.report.figures["classes"].values()) == len(xyz)


# ---- where and rejection -------------------------------------------------------------------------------


def test_where_keeps_the_rest_which_still_are_neighbors(trained, other):
    xyz, label, dimensions = other
    where = xyz[:, 0] > 30
    current = np.where(label == 2, 17, 4)
    whole = trained.predict(xyz, dimensions)
    part = trained.predict(xyz, dimensions, where=where, current=current, probabilities=True)
    assert np.array_equal(part.classification[where], whole.classification[where])
    assert np.array_equal(part.reliability[where], whole.reliability[where])
    assert np.array_equal(part.classification[~where], current[~where])
    assert not part.reliability[~where].any() and not part.probabilities[~where].any()
    assert part.report.figures["classified"] == where.sum()
    assert part.report.figures["outside_where"] == (~where).sum()
    # Without them as neighbors the result near the line is another one.
    alone = trained.predict(xyz[where], {k: v[where] for k, v in dimensions.items()})
    assert not np.array_equal(alone.reliability, whole.reliability[where])
    assert not trained.predict(xyz, dimensions, where=where).classification[~where].any()


def test_reject(trained, other):
    xyz, _, dimensions = other
    whole = trained.predict(xyz, dimensions)
    low = whole.reliability < np.float32(0.7)
    assert 0 < low.sum() < len(xyz)
    for keywords, expected in (
        ({}, 1),
        ({"current": np.full(len(xyz), 9)}, 9),
        ({"current": np.full(len(xyz), 9), "rejected_code": 30}, 30),
    ):
        result = trained.predict(xyz, dimensions, reject_below=0.7, **keywords)
        assert len(result.unsure) == low.sum() == result.report.figures["rejected"]
        assert (result.classification[low] == expected).all()
        assert np.array_equal(result.classification[~low], whole.classification[~low])
        assert np.array_equal(result.reliability, whole.reliability)
        assert result.report.figures["classified"] == (~low).sum()
    for bad in (-0.1, 1.1, float("nan"), True):
        with pytest.raises(OptionError, match="reject_below"):
            trained.predict(xyz, dimensions, reject_below=bad)


# ---- dimensions ----------------------------------------------------------------------------------------


def test_a_missing_dimension_names_itself_and_its_maker(trained, other):
    xyz, label, _ = other
    with pytest.raises(DimensionError, match=r"HeightAboveGround.*filtered_ground"):
        trained.predict(xyz, {})
    with pytest.raises(DimensionError, match=r"HeightAboveGround.*filtered_ground"):
        learn([TrainingCloud(xyz, label, {}, "b.laz")])
    bad = {"HeightAboveGround": np.where(np.arange(len(xyz)) < 5, np.nan, 1.0)}
    with pytest.raises(DimensionError, match="5 points"):
        trained.predict(xyz, bad)
    with pytest.raises(DimensionError, match="one value per point"):
        trained.predict(xyz, {"HeightAboveGround": np.zeros(3)})


# ---- training ------------------------------------------------------------------------------------------


def test_counts_scores_and_importances(trained):
    classes = {entry["code"]: entry for entry in trained.info["classes"]}
    assert [entry["samples"] + entry["duplicates"] for entry in classes.values()] == [150] * 3
    score = trained.info["accuracy"]["cross_validation"]["chosen"]
    assert 0.8 < score["overall_accuracy"] <= 1 and set(score["f1"]) == {"2", "5", "6"}
    importances = trained.importances()
    assert sum(importances.values()) == pytest.approx(1)
    assert {"Linearity_c1", "D2_0_s2", "HeightAboveGround"} <= importances.keys()
    text = str(trained)
    words = ("Ground", "Building", "kopt(5,20)", "HeightAboveGround", "a.laz", "held out")
    assert all(word in text for word in words)


def test_the_file_holds_percentiles_of_the_samples_unless_they_are_many(trained, monkeypatch):
    """Half of a class's samples lie below its median; the values are those of samples; 100 kB at most."""
    ranges = trained.manifest()["passes"][0]["percentiles"]
    assert list(ranges) == list(trained.passes[0].plan.names)
    assert all(list(by_class) == ["2", "5", "6"] for by_class in ranges.values())
    heights = ranges["HeightAboveGround"]
    assert heights["6"][3] == pytest.approx(4.05, abs=0.1) and heights["2"][-1] < 0.11
    assert all(row == sorted(row) for by_class in ranges.values() for row in by_class.values())
    monkeypatch.setattr(training_percentiles, "LIMIT_BYTES", 100)
    few = learn([TrainingCloud(*scene(), "a.laz")], folds=0)
    assert "percentiles" not in few.manifest()["passes"][0]


def test_percentiles_by_class_are_those_of_numpy():
    rng = np.random.default_rng(3)
    values, label = rng.normal(size=(500, 2)).astype(np.float32), rng.integers(0, 2, 500)
    table = training_percentiles.percentiles_by_class(values, label, ["a", "b"], [2, 5, 6])
    assert set(table["a"]) == {"2", "5"}  # class 6 has no samples
    for column, name in enumerate("ab"):
        for place, code in enumerate("25"):
            of_class = values[label == place, column]
            below = [np.mean(of_class <= 1.001 * value) for value in sorted(table[name][code])]
            assert np.allclose(below, np.array(training_percentiles.PERCENTILES) / 100, atol=0.01)


def test_several_clouds_are_sampled_together_but_are_not_neighbors():
    a, b = scene(0), scene(1, origin=(1000.0, 0.0, 0.0))
    clouds = [TrainingCloud(*a, name="a"), TrainingCloud(*b, name="b")]
    options = TrainingOptions(**SMALL)
    model = train(clouds, options, progress=False)
    assert [c["name"] for c in model.info["training"]["clouds"]] == ["a", "b"]
    swapped = train(clouds[::-1], options, progress=False)
    assert swapped.algorithm.features.bins == model.algorithm.features.bins
    assert np.array_equal(swapped.algorithm.forest.threshold, model.algorithm.forest.threshold)


@pytest.mark.parametrize(
    ("labels", "more", "text"),
    [
        (lambda label: label, {"classes": [2, 9]}, r"class 9 .* has no samples .*2: "),
        (np.ones_like, {}, r"at least two classes .*1: 500"),
        (lambda label: label, {"folds": 1}, r"one fold .*0 for no score"),
        (lambda label: label[:-1], {}, "one label per point"),
        (lambda label: np.full_like(label, 7), {}, r"no points to train on.*labels \(7 and 18\)"),
    ],
)
def test_errors_say_what_was_found(labels, more, text):
    xyz, label, dimensions = scene(n=500)
    with pytest.raises(OptionError, match=text):
        learn([TrainingCloud(xyz, labels(label), dimensions)], **more)
    with pytest.raises(OptionError, match="no points to train on"):
        learn([])
    with pytest.raises(OptionError, match="mask"):
        learn([TrainingCloud(xyz, label, dimensions, mask=label)])


def test_binary():
    xyz, label, dimensions = scene()
    model = learn([TrainingCloud(xyz, label, dimensions)], target=6)
    assert model.classes == [(1, "Background"), (6, "Building")]
    assert model.info["classes"][0]["labels"] == [2, 5]
    result = model.predict(xyz, dimensions)
    assert accuracy(result, np.where(label == 6, 6, 1)) > 0.9
    assert "binary, target 6" in str(model)


def test_prior_weight(other):
    """Probabilities times (frequency in the clouds / in the samples) ** weight; the frequent gain, the rare lose."""
    xyz, label, dimensions = scene()
    clouds = [TrainingCloud(xyz, label, dimensions)]
    models = {w: learn(clouds, prior_weight=w) for w in (0, 0.3, 1)}
    xyz, label, dimensions = other
    results = {w: m.predict(xyz, dimensions, probabilities=True) for w, m in models.items()}
    frequency = np.array([e["available"] for e in models[1].info["classes"]]) / 150
    for w in (0.3, 1):
        expected = results[0].probabilities * frequency**w
        expected /= expected.sum(axis=1, keepdims=True)
        assert np.allclose(results[w].probabilities, expected, atol=1e-6)
        ground = [(results[k].classification == 2).sum() for k in (0, w)]
        assert ground[1] > ground[0]
    assert models[0].info["priors"] is None
    with pytest.raises(OptionError, match="prior_weight"):
        TrainingOptions(prior_weight=1.5)


# ---- hostile manifests ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "edit",
    [
        lambda m: m["passes"][0].update(neighborhoods=["c9"]),
        lambda m: m["passes"][0].update(neighborhoods=[]),
        lambda m: m["passes"][0].update(feature_names=m["passes"][0]["feature_names"][::-1]),
        lambda m: m["passes"][0].update(dimensions=[]),
        lambda m: m["passes"][0].update(context=["box1"]),
        lambda m: m["passes"][0].update(importances=[1.0]),
        lambda m: m["priors"].update(factors=[1.0]),
        lambda m: m["classes"].reverse(),
        lambda m: m["passes"][0].update(shape_bins=None),
        lambda m: m["passes"][0]["shape_bins"].pop("c1"),
    ],
)
def test_manifests_that_do_not_fit_themselves(trained, tmp_path, edit, other):
    manifest = copy.deepcopy(trained.manifest())
    edit(manifest)
    with pytest.raises(ModelError):  # some are refused where they are written
        model_file.write(tmp_path / "m", manifest, [trained.algorithm.arrays()])
        load_model(tmp_path / "m")
