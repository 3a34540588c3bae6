"""Recipes: the papers' experiments by one word, held to the numbers in the papers' texts."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from pdal_stages import TrainingCloud, TrainingOptions, train
from pdal_stages.base.errors import OptionError
from pdal_stages.classifier.class_map import ClassMap
from pdal_stages.classifier.random_forest import grow_forest
from pdal_stages.classifier.sampling import draw_samples
from pdal_stages.classifier.train_forest import limit_to_percentiles
from pdal_stages.classifier.training_options import (
    RECIPES,
    describe_recipes,
    feature_plan,
    with_recipe,
)
from pdal_stages.features import FeaturePlan
from pdal_stages.features.engine import fit_clouds
from pdal_stages.pipeline.json_source import parse_overrides
from pdal_stages.stages.registry import stage_from, stage_types
from pdal_stages.tiling.train_survey import TrainTask

#: Features of a recipe, by the texts: [B16 3.1, 3.2.1], [W18 3.1, 3.2], [H17 2.2].
FEATURES = {"blomley2016": 312, "weinmann2018": 560, "weinmann2018-binary": 560, "he2017": 6}

HEIGHT = "HeightAboveGround"


def growth(**options):
    """Options of growing trees on all samples."""
    return TrainingOptions(**{"min_samples_leaf": 1, "max_samples": 1.0, **options})


@pytest.mark.parametrize("name", FEATURES)
def test_a_recipe_has_as_many_features_as_the_text_says(name):
    assert len(feature_plan(TrainingOptions(**RECIPES[name])).names) == FEATURES[name]


@pytest.mark.parametrize("name, height", [("blomley2016", "Z"), ("weinmann2018", HEIGHT)])
def test_the_height_stays_where_other_neighborhoods_are_named(name, height):
    """It is a feature by itself, beside those of the neighborhoods [B16 3.2.1, W18 3.2]."""
    options = with_recipe({"recipe": name, "neighborhoods": "c1,c2,c3,c5"})
    del options["recipe"]
    names = feature_plan(TrainingOptions(**options)).names
    assert len(names) == 4 * 62 + 1 and names[-1] == height


def test_the_networks_recipe():
    stage = stage_from(
        {"type": "writers.classifiermodel", "filename": "a.model", "recipe": "winiwarter2019"}
    )
    assert stage.algorithm == "alsnet"
    assert stage.alsnet["histogram_threshold"] == 20  # [WM19 4.1]
    assert stage.alsnet["configuration"] == "alsnet4"
    merged = with_recipe({"recipe": "winiwarter2019", "alsnet": {"epochs": 2}})["alsnet"]
    assert merged == {**stage.alsnet, "epochs": 2}


def test_options_of_the_network_beside_its_recipe_may_be_text(tmp_path):
    """Stock PDAL and the command line give text: the recipe's other options stay."""
    known = {"type": "writers.classifiermodel", "filename": "a.model", "recipe": "winiwarter2019"}
    stage = stage_from({**known, "alsnet": '{"epochs": 2}'})
    assert stage.alsnet == {**RECIPES["winiwarter2019"]["alsnet"], "epochs": 2}
    overrides, _ = parse_overrides(['--writers.classifiermodel.alsnet={"epochs": 2}'])
    writer = {"recipe": "winiwarter2019"}
    task = TrainTask([], str(tmp_path / "a.model"), overrides, writer)
    assert task.stage.alsnet == stage.alsnet
    with pytest.raises(OptionError, match=r"writers.classifiermodel: option 'alsnet' must be a"):
        stage_from({**known, "alsnet": '{"epochs": 2, "epochs": 3}'})


def test_an_object_as_text_is_that_object():
    labels = {"5": [3, 4]}
    for name, stage in stage_types().items():
        for option in stage.all_options():
            if "object" in option.schema()["type"]:
                assert option.decode(json.dumps(labels)) == labels, f"{name}: {option.name}"
                assert option.decode(labels) == labels


@pytest.mark.parametrize("name", [*RECIPES])
def test_what_is_given_beside_a_recipe_replaces_its_value(name):
    known = {"type": "writers.classifiermodel", "filename": "a.model", "recipe": name}
    stage = stage_from({**known, "voxel": 0.5, "count": 77})
    assert (stage.voxel, stage.count) == (0.5, 77)
    for option, value in RECIPES[name].items():
        if option not in ("voxel", "alsnet", "classes"):
            result = stage.options[option]
            assert result == (77 if option == "count" else _plain(value)), option
    assert f"  {name}\n" in describe_recipes()


def _plain(value):
    return list(value) if isinstance(value, tuple) else value


@pytest.mark.parametrize("name", ["weinman2018", "weinmann2018,vaihing", ["vaihing"], 5])
def test_an_unknown_recipe_is_refused(name):
    with pytest.raises(OptionError, match="'recipe' must be"):
        with_recipe({"recipe": name})


def test_labels_of_vaihingen_are_classes_with_its_names():
    """Codes 0, 1 and 7 say nothing in LAS; there they are power lines, low vegetation, shrubs."""
    known = {"type": "writers.classifiermodel", "filename": "a.model"}
    stage = stage_from({**known, "recipe": "weinmann2018-binary,vaihingen", "target": 5})
    assert (stage.count, stage.target) == (100_000, 5)
    classes = ClassMap.parse(stage.training.classes)
    names = dict(zip(classes.labels, classes.names, strict=True))
    assert names[(8,)] == "Tree" and names[(7,)] == "Shrub" and names[(0,)] == "Powerline"
    rng = np.random.default_rng(3)
    xyz, labels = rng.uniform(0, 30, (4000, 3)), rng.integers(0, 9, 4000)
    xyz[:, 2] = labels
    options = replace(
        stage.training, neighborhoods="c2", feature_set="HeightRange", dimensions=("Z",), count=50,
        trees=10, folds=0,
    )  # fmt: skip
    model = train([TrainingCloud(xyz, labels)], options, progress=False)
    assert dict(model.classes) == {1: "Background", 5: "Tree"}
    nine = train([TrainingCloud(xyz, labels)], replace(options, target=None), progress=False)
    assert dict(nine.classes)[4] == "Shrub" and len(nine.classes) == 9
    predicted = nine.predict(xyz, {}).classification
    assert all(
        (predicted[labels == label] == code).mean() > 0.9
        for label, code in ((0, 14), (1, 3), (7, 4))
    )


def test_the_threshold_of_copt_is_given_or_found():
    """[H17 3.3]: 0.03, found on training and test points together, can be set in training."""
    rng = np.random.default_rng(5)
    flat, tree = rng.uniform(0, 20, (3000, 3)) * [1, 1, 0.001], rng.uniform(0, 6, (2000, 3))
    cloud = TrainingCloud(np.vstack([flat, tree + 30]), np.repeat([2, 5], [3000, 2000]))
    few = {"recipe": "he2017", "count": 100, "trees": 5, "folds": 0}

    def trained(**more):
        options = with_recipe({**few, **more})
        del options["recipe"]
        return train([cloud], TrainingOptions(**options)).passes[0].features.copt_threshold

    assert trained(copt_threshold=0.03) == 0.03
    assert 0.05 < trained() < 0.3
    shapes = TrainingOptions(neighborhoods="copt", feature_set="D2", copt_threshold=0.03)
    bins = [fit_clouds([cloud.xyz], feature_plan(shapes), copt_threshold=at) for at in (0, 1)]
    assert [threshold for _, threshold in bins] == [0, 1]
    assert bins[0][0].to_dict() != bins[1][0].to_dict()  # of the neighborhoods that it chooses
    with pytest.raises(OptionError, match="'copt_threshold' is for the neighborhood copt"):
        TrainingOptions(neighborhoods="kopt", copt_threshold=0.03)


def test_random_samples_and_duplicates_beyond_the_largest_class():
    """[W18 4.3]: as many of each class as asked for, those of a class with fewer several times."""
    rng = np.random.default_rng(0)
    xyz = rng.uniform(0, 100, (3000, 3))
    position = np.repeat([0, 1], [2900, 100])
    samples = draw_samples([(xyz, position)], 2, 5000, 0, random_order=True)
    for label, available in ((0, 2900), (1, 100)):
        weight = samples.weight[samples.label == label]
        assert weight.sum() == 5000 and len(weight) == available
        assert weight.max() - weight.min() <= 1
    few = draw_samples([(xyz, position)], 2, 50, 0, random_order=True)
    again = draw_samples([(xyz[::-1], position[::-1])], 2, 50, 0, random_order=True)
    assert {tuple(xyz[row]) for row in few.row} == {tuple(xyz[::-1][row]) for row in again.row}


def test_scaling_is_the_papers_mapping_to_trees():
    """A forest on limited features decides like one on features mapped to [0, 1] and cut off."""
    rng = np.random.default_rng(1)
    plan = FeaturePlan.parse("c1", feature_set="Linearity,HeightRange,D2")
    values = rng.gamma(2.0, 2.0, (400, len(plan.names))).astype(np.float32)
    values[5, 0] = 0.0
    limited = values.copy()
    limit_to_percentiles(limited, plan)
    low, high = np.percentile(values, [1, 99], axis=0)
    low[values.min(axis=0) == 0] = 0
    for column, name in enumerate(plan.names):
        expected = np.clip(values[:, column], low[column], high[column])
        if name.startswith("D2"):
            expected = values[:, column]
        assert np.allclose(limited[:, column], expected)
    label = (values[:, 0] + values[:, 1] > 8).astype(int)
    forest, _ = grow_forest(limited, label, np.ones(400, int), 10, growth())
    assert (
        forest.predict_proba(values).argmax(axis=1) == forest.predict_proba(limited).argmax(axis=1)
    ).all()


def test_depth_votes_and_the_number_of_trees():
    rng = np.random.default_rng(2)
    values = rng.normal(size=(600, 6)).astype(np.float32)
    label = (values[:, 0] + rng.normal(0, 0.7, 600) > 0).astype(int)
    weight = np.ones(600, int)
    forest, _ = grow_forest(values, label, weight, 20, growth(max_depth="sqrt"))
    assert forest.depths.max() == 2  # the root of six features
    voting, _ = grow_forest(values, label, weight, 20, growth(vote="majority", min_samples_leaf=30))
    mean, _ = grow_forest(values, label, weight, 20, growth(min_samples_leaf=30))
    shares = voting.predict_proba(values)
    assert np.allclose(shares * 20, np.rint(shares * 20))  # whole votes of 20 trees
    shares = 20 * mean.predict_proba(values)
    assert not np.allclose(shares, np.rint(shares))
    # The grid takes the number whose forest is right about most samples that its trees have not seen.
    chosen, _ = grow_forest(values, label, weight, (1, 5, 60), growth())
    assert chosen.n_trees == 60
    whole, _ = grow_forest(values, label, weight, 60, growth())
    assert np.array_equal(chosen.threshold, whole.threshold)  # of more trees the first ones
