"""Model files that ask for more than heights before them: code, files, other points, other models."""

from __future__ import annotations

import laspy
import numpy as np
import pytest
from robustness_kit import job
from test_robust_models import repack

import pdal_stages as ps
from pdal_stages.base.errors import ModelError

pytestmark = pytest.mark.pdal

HAG = {"type": "filters.hag_minima"}
#: What the model file asks for -> the stage it names; VICTIM stands for a file that must stay as it is, NEW for none.
HOSTILE = {
    "runs Python from its text": {"type": "filters.python", "function": "f", "module": "m",
                                  "source": "import pathlib\npathlib.Path('NEW').touch()\ndef f(a, b): return True"},
    "runs a script": {"type": "filters.python", "function": "f", "module": "m", "script": "VICTIM"},
    "empties a file by the log of filters.stats": {"type": "filters.stats", "log": "VICTIM"},
    "empties a file by the log of filters.smrf": {"type": "filters.smrf", "log": "VICTIM"},
    "empties a file by the log of filters.hag_minima": {**HAG, "log": "VICTIM"},
    "writes into a folder by filters.smrf": {"type": "filters.smrf", "dir": "FOLDER"},
    "writes a table by filters.accuracy": {"type": "filters.accuracy", "json": "NEW"},
    "writes bins by filters.multiscalefeatures": {"type": "filters.multiscalefeatures", "bins": "NEW"},
    "reads a file of options": {**HAG, "option_file": "VICTIM"},
    "reads a file of options for PDAL": {"type": "filters.smrf", "option_file": "VICTIM"},
    "opens a raster": {"type": "filters.hag_dem", "raster": "VICTIM"},
    "drops points by filters.head": {"type": "filters.head", "count": 1},
    "drops points by filters.range": {"type": "filters.range", "limits": "Z[0:0]"},
    "moves points": {"type": "filters.transformation", "matrix": "1 0 0 9 0 1 0 9 0 0 1 9 0 0 0 1"},
    "loads another model": {"type": "filters.modelclassifier", "model": "VICTIM"},
    "trains another model": {"type": "writers.classifiermodel", "filename": "NEW"},
    "reads another cloud": {"type": "readers.las", "filename": "VICTIM"},
    "is another name for a filter": {"type": "filters.hag_minima ", "log": "VICTIM"},
    "asks for cells of a nanometer": {**HAG, "cell": 1e-9},
    "nests a pipeline": {**HAG, "inputs": [{"type": "readers.las", "filename": "VICTIM"}]},
}  # fmt: skip


@pytest.mark.parametrize("what", HOSTILE)
@pytest.mark.parametrize("last", [False, True], ids=["alone", "after an honest one"])
def test_a_preparation_that_does_more_than_heights(cell, tmp_path, cloud, model, what, last):
    victim, folder = tmp_path / "victim.txt", tmp_path / "folder"
    victim.write_text("--cell=1\n")
    folder.mkdir()
    words = {"VICTIM": str(victim), "NEW": str(tmp_path / "new"), "FOLDER": str(folder)}

    def filled(value):
        for word, path in words.items():
            value = value.replace(word, path) if isinstance(value, str) else value
        return value

    stage = {key: filled(value) for key, value in HOSTILE[what].items()}
    asked = [HAG, stage] if last else [stage]
    target = repack(model, tmp_path / "evil.model", lambda head, _: head.update(preparation=asked))
    it = cell("Models", f"model whose preparation {what}")
    message = it.refused(["classify", cloud, tmp_path / "out.las", "--model", target], "evil.model")
    assert "Put before" not in message
    again = job(
        tmp_path, str(cloud), HAG, {"type": "filters.modelclassifier", "model": str(target)}, "out.las"
    )
    for command in (["pipeline", again], ["validate", again], ["expand", again], ["model", target]):
        done = it.command(*command)
        assert done.code == 1 and "Put before" not in done.err
    with pytest.raises(ModelError):
        ps.load_model(target)
    assert victim.read_text() == "--cell=1\n" and not any(folder.iterdir())
    assert not (tmp_path / "new").exists()


def test_a_hostile_preparation_with_workers(cell, tmp_path, cloud, model):
    stage = {"type": "filters.python", "module": "m", "function": "f",
             "source": f"open({str(tmp_path / 'new')!r}, 'w')\ndef f(a, b): return True"}  # fmt: skip
    target = repack(model, tmp_path / "evil.model", lambda head, _: head.update(preparation=[stage]))
    (tmp_path / "out").mkdir()
    two = tmp_path / "two.las"
    two.write_bytes(cloud.read_bytes())
    cell("Models", "model whose preparation runs Python, with workers").refused(
        ["classify", cloud, two, tmp_path / "out", "--model", target, "--workers", "2"], "filters.python"
    )
    assert not (tmp_path / "new").exists()


def test_training_on_heights_that_a_model_cannot_carry(cell, tmp_path, cloud):
    """The model is written without its preparation, and everybody says what belongs before it."""
    target = tmp_path / "m.model"
    write = {"type": "writers.classifiermodel", "filename": str(target), "neighborhoods": "c1", "trees": 3, "passes": 1, "label": "Reference",
             "feature_set": "covariance", "count": 50, "dimensions": "HeightAboveGround", "folds": 0}  # fmt: skip
    made = [{"type": "filters.pmf"}, {"type": "filters.hag_nn"}]
    keep = {"type": "filters.ferry", "dimensions": "Classification=>Reference"}
    path = job(tmp_path, str(cloud), keep, *made, write)
    it = cell("Models", "training on heights of stages that a model cannot carry")
    done = it.runs(
        ["pipeline", path], "trained; the file says which stages belong before it, and does not hold them"
    )
    assert "'filters.pmf'" in done.err and "Write a pipeline with the same stages" in done.err
    found = ps.load_model(target)
    assert found.info["preparation"] == [] and found.info["by_hand"] == ["filters.pmf", "filters.hag_nn"]
    it = cell("Models", "classify with a model whose heights were made by stages it cannot carry")
    it.refused(
        ["classify", cloud, tmp_path / "out.las", "--model", target],
        "filters.pmf, filters.hag_nn",
        "Write a pipeline",
    )
    apply = {"type": "filters.modelclassifier", "model": str(target)}
    it.refused(["pipeline", job(tmp_path, str(cloud), apply, "out.las")], "filters.pmf, filters.hag_nn")
    done = it.command("pipeline", job(tmp_path, str(cloud), *made, apply, str(tmp_path / "out.las")))
    assert done.code == 0, done.err


def test_heights_of_pdal_are_carried(cell, tmp_path, cloud):
    """filters.smrf and filters.hag_nn with options go into the file and are run by classify."""
    target = tmp_path / "m.model"
    made = [
        {"type": "filters.smrf", "cell": "2", "ignore": "Classification[7:7]", "tag": "ground"},
        {"type": "filters.hag_nn", "count": 2},
    ]
    ps.run_pipeline([str(cloud), {"type": "filters.ferry", "dimensions": "Classification=>Reference"}, *made,
                     {"type": "writers.classifiermodel", "filename": str(target), "neighborhoods": "c1", "trees": 3,
                      "label": "Reference", "passes": 1, "feature_set": "covariance", "count": 50, "folds": 0,
                      "dimensions": "HeightAboveGround"}])  # fmt: skip
    assert ps.load_model(target).info["preparation"] == [
        {"type": "filters.smrf", "cell": 2, "ignore": ["Classification[7:7]"]},
        {"type": "filters.hag_nn", "count": 2},
    ]
    cell("Models", "classify with a model of heights from filters.smrf and filters.hag_nn").runs(
        ["classify", cloud, tmp_path / "out.las", "--model", target], "classes, with the heights of training"
    )
    assert np.unique(laspy.read(tmp_path / "out.las").classification).size == 2


def test_the_units_of_training_points_stay_there(tmp_path, cloud):
    """A unit that was given in training says of those points, not of the ones to classify."""
    ps.run_pipeline([str(cloud), {**HAG, "vertical_unit": "foot"},
                     {"type": "writers.classifiermodel", "filename": str(tmp_path / "u.model"), "neighborhoods": "c1",
                      "feature_set": "covariance", "count": 50, "trees": 3, "passes": 1, "folds": 0,
                      "dimensions": "HeightAboveGround", "vertical_unit": "foot"}])  # fmt: skip
    assert ps.load_model(tmp_path / "u.model").info["preparation"] == [HAG]
