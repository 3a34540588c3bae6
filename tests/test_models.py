"""Models that come with the package, and what a model says of the stages before it."""

from __future__ import annotations

import json
import shutil

import laspy
import numpy as np
import pytest

from pdal_stages import Filter, run_tiled
from pdal_stages.base.errors import DimensionError, OptionError, StageError
from pdal_stages.classifier.model import load_model
from pdal_stages.classifier.model_file import STANDARD, shipped
from pdal_stages.cli import main
from pdal_stages.pipeline.run import Pipeline
from pdal_stages.stages.preprocessing import made_of_coordinates


def test_every_shipped_model_loads_says_its_preparation_and_is_small(tmp_path):
    assert STANDARD in shipped()
    for path in shipped().values():
        model = load_model(path)
        # Held against the schema, as those beside the code are not.
        load_model(shutil.copy(path, tmp_path))
        assert path.stat().st_size < 5e6
        output = {name for stage in model.info["preparation"] for name in _creates(stage)}
        assert set(model.required_dimensions) <= output
        assert not {"Intensity", "Red", "Green", "Blue"} & set(model.required_dimensions)


def _creates(stage):
    from pdal_stages.stages.registry import stage_type

    return stage_type(stage["type"])({k: v for k, v in stage.items() if k != "type"}).creates()


def test_heights_are_made_as_in_training_beside_return_numbers():
    rng = np.random.default_rng(0)
    xyz = rng.uniform(0, 40, (3000, 3)) * [1, 1, 0.01]
    returns = {
        name: rng.integers(1, 3, 3000).astype(np.uint8)
        for name in ("ReturnNumber", "NumberOfReturns")
    }
    model = load_model(shipped()[STANDARD])
    predicted = model.predict(xyz, returns).classification
    output = made_of_coordinates(model.info["preparation"], xyz)
    assert np.array_equal(predicted, model.predict(xyz, {**output, **returns}).classification)
    assert not np.array_equal(
        model.predict(xyz).reliability, model.predict(xyz, returns).reliability
    )
    with pytest.raises(DimensionError, match=r"missing.*leave all heights out"):
        model.predict(xyz, {"HeightAboveGround": xyz[:, 2], **returns})


@pytest.mark.pdal
def test_a_raw_tile_is_classified_without_a_model_named(ready_town, tmp_path, capsys):
    out = tmp_path / "classified.laz"
    assert main(["classify", str(ready_town), str(out)]) == 0
    assert "points written" in capsys.readouterr().out
    points, truth = (Pipeline([str(path)]) for path in (out, ready_town))
    points.execute()
    truth.execute()
    result, known = points.arrays[0], truth.arrays[0]
    groups = {2: 2, 3: 0, 4: 5, 5: 5, 6: 6}
    wanted = np.array([groups.get(code, 0) for code in range(256)])[known["Classification"]]
    inputs = result["Classification"]
    assert set(np.unique(inputs).tolist()) <= {2, 5, 6, 14, 18}
    # It has never seen a generated town.
    assert np.mean(inputs[wanted > 0] == wanted[wanted > 0]) > 0.8


@pytest.mark.pdal
def test_a_pipeline_with_other_heights_is_told(ready_town):
    same = [str(ready_town), *load_model(shipped()[STANDARD]).info["preparation"]]
    classify = {"type": "filters.modelclassifier", "model": STANDARD}
    assert Pipeline([*same, classify]).expanded.warnings == []
    other = [
        str(ready_town),
        {"type": "filters.hag_morphological", "ground": True, "openings": [5, 17], "window": 20},
    ]
    (warning,) = Pipeline([*other, classify]).expanded.warnings
    assert "trained on other heights" in warning.text and '"window": 20' in warning.text


@pytest.mark.pdal
def test_missing_heights_come_with_the_stage_to_paste(ready_town):
    pipeline = Pipeline([str(ready_town), {"type": "filters.modelclassifier", "model": STANDARD}])
    with pytest.raises(StageError) as caught:
        pipeline.execute()
    assert '{"type": "filters.hag_morphological", "ground": true, "openings": [5, 17]}' in str(
        caught.value
    )


@pytest.mark.pdal
def test_training_keeps_the_stages_before_it(ready_town, tmp_path):
    path = tmp_path / "own.model"
    writer = {"type": "writers.classifiermodel", "filename": str(path), "classes": "2,5,6"}
    few = {"neighborhoods": "k10", "feature_set": "covariance", "count": 50, "trees": 3}
    few |= {"passes": 1, "dimensions": "HeightAboveGround"}
    heights = {"type": "filters.hag_minima", "cell": 10, "tag": "h"}
    Pipeline([str(ready_town), heights, {**writer, **few}]).execute()
    assert load_model(path).info["preparation"] == [{"type": "filters.hag_minima", "cell": 10}]
    expanded = json.loads(Pipeline([str(ready_town), heights, {**writer, **few}]).json)
    arguments = expanded["pipeline"][-1]["pdalargs"]
    assert arguments["preparation"] == [{"type": "filters.hag_minima", "cell": 10}]


@pytest.mark.pdal
def test_vegetation_by_height(ready_town):
    """``vegetation_heights``: low below the first, medium below the second, nothing else touched."""
    plain = classified(ready_town)
    split = classified(ready_town, vegetation_heights="0.5,2", reject_below=0.8)
    height, sure = plain["HeightAboveGround"], plain["Reliability"] >= np.float32(0.8)
    expected = np.where(sure, plain["Classification"], 0)  # rejected ones keep the class they had
    called = expected == 5
    assert called.sum() > 100
    expected[called & (height < 2.0)] = 4
    expected[called & (height < 0.5)] = 3
    assert np.array_equal(split["Classification"][sure], expected[sure])
    assert not np.isin(
        split["Classification"][~sure & (plain["Classification"] == 5)], (3, 4)
    ).all()


def classified(town, **options):
    preparation = load_model(shipped()[STANDARD]).info["preparation"]
    job = Pipeline(
        [str(town), *preparation, {"type": "filters.modelclassifier", "model": STANDARD, **options}]
    )
    job.execute()
    return job.arrays[0]


@pytest.mark.parametrize("wrong", [[2.0], [2.0, 0.5], ["a", "b"], [0.0, 1.0]])
def test_vegetation_heights_that_mean_nothing(wrong):
    with pytest.raises(OptionError, match="vegetation_heights"):
        Filter.modelclassifier(model=STANDARD, vegetation_heights=wrong)


@pytest.mark.pdal
def test_a_shipped_model_by_name_in_tiles(ready_town, tmp_path, monkeypatch):
    """In processes of their own as well, and whatever the current folder holds."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / STANDARD).write_text("mine")
    preparation = load_model(STANDARD).info["preparation"]

    classifier = {"type": "filters.modelclassifier", "model": STANDARD}

    def job(target):
        return [str(ready_town), *preparation, classifier, target]

    Pipeline(job("whole.laz")).execute(arrays=False)
    run = run_tiled(job("tiles.laz"), 40, workers=2, progress=False)
    assert not run.failures
    whole, tiles = laspy.read("whole.laz"), laspy.read("tiles.laz")
    assert np.array_equal(whole.classification, tiles.classification)
