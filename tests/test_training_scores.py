"""What training says of a model: an honest score first, from files and folders, by command and by pipeline."""

from __future__ import annotations

import json

import numpy as np
import pytest

import pdal_stages as ps
from pdal_stages.cli import main

QUICK = {"feature_set": "Linearity,HeightRange", "trees": 8, "passes": 1, "dimensions": ""}


def scene(seed, x0=0.0, n=900):
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, 60, (2, n)).round(2)
    block = (x % 20 > 10) & (y % 20 > 10)
    z = (np.where(block, 5.0, 0.0) + rng.normal(0, 0.02, n)).round(2)
    return {"X": x + x0, "Y": y, "Z": z, "Classification": np.where(block, 6, 2).astype("u1")}


@pytest.mark.pdal
def test_train_takes_folders_and_says_an_honest_score_first(tmp_path, write_las, capsys):
    (tmp_path / "in").mkdir()
    for number in range(2):
        write_las(tmp_path / "in" / f"t{number}.laz", scene(number, 60.0 * number), point_format=1)
    words = [
        "train",
        tmp_path / "in",
        "--model",
        tmp_path / "m.model",
        "--count",
        200,
        "--neighborhoods",
        "k8",
    ]
    words += ["--trees", 8, "--feature-set", "Linearity,HeightRange", "--no-progress"]
    more = [f"--writers.classifiermodel.{k}={v}" for k, v in QUICK.items() if k in ("passes", "dimensions")]
    assert main([*map(str, words), *more]) == 0
    out = capsys.readouterr().out
    assert out.startswith("blocks held out") and "out of bag" in out.splitlines()[1]
    assert "t0.laz, t1.laz" in out
    found = ps.load_model(tmp_path / "m.model").info["accuracy"]["cross_validation"]
    assert found["by"] == "blocks" and found["chosen"]["trees"] == 2


@pytest.mark.pdal
def test_training_by_pipeline_prints_its_score(tmp_path, write_las, capsys):
    write_las(tmp_path / "a.laz", scene(1), point_format=1)
    writer = {"type": "writers.classifiermodel", "filename": str(tmp_path / "m.model"), "neighborhoods": "k8"}
    stages = [str(tmp_path / "a.laz"), {**writer, "count": 100, **QUICK}]
    (tmp_path / "job.json").write_text(json.dumps(stages))
    assert main(["pipeline", str(tmp_path / "job.json")]) == 0
    assert "blocks held out" in capsys.readouterr().err


def test_surveys_are_held_out_where_there_are_several(tmp_path):
    clouds = []
    for number in range(3):
        arrays = scene(number, 1000.0 * number)
        xyz = np.column_stack([arrays[k] for k in "XYZ"])
        clouds.append(ps.TrainingCloud(xyz, arrays["Classification"], name=f"s{number}"))
    options = ps.TrainingOptions("k8", **{**QUICK, "dimensions": ()}, count=200)
    model = ps.train(clouds, options, progress=False)
    found = model.info["accuracy"]["cross_validation"]
    assert (found["by"], found["folds"]) == ("surveys", 3) and str(model).startswith("surveys held out")
    without = ps.train(
        clouds, ps.TrainingOptions("k8", **{**QUICK, "dimensions": ()}, count=200, folds=0), progress=False
    )
    assert without.info["accuracy"]["cross_validation"] is None
    for one, other in zip(model.passes, without.passes, strict=True):  # the score chooses nothing
        assert all(np.array_equal(a, other.arrays()[key]) for key, a in one.arrays().items())
    model.save(tmp_path / "m.model")
    assert ps.load_model(tmp_path / "m.model").info["accuracy"]["cross_validation"]["by"] == "surveys"


def test_too_little_ground_for_a_score_is_no_error():
    rng = np.random.default_rng(0)
    xyz = rng.uniform(0, 8, (300, 3))
    options = ps.TrainingOptions("k8", **{**QUICK, "dimensions": ()}, count=50)
    model = ps.train([ps.TrainingCloud(xyz, np.where(xyz[:, 2] > 4, 6, 2))], options, progress=False)
    assert model.info["accuracy"]["cross_validation"] is None and str(model).startswith("out of bag")
