"""What training says of a model: an honest score first, from files and folders, by command and by pipeline."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from block_scene import QUICK_TRAINING

import pdal_stages as ps
from pdal_stages.cli import main

QUICK = {"feature_set": "Linearity,HeightRange", "trees": 8, "passes": 1, "dimensions": ""}
QUICK_WORDS = [*QUICK_TRAINING, "--writers.classifiermodel.dimensions="]


def scene(seed, x0=0.0, n=900):
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, 60, (2, n)).round(2)
    block = (x % 20 > 10) & (y % 20 > 10)
    z = (np.where(block, 5.0, 0.0) + rng.normal(0, 0.02, n)).round(2)
    return {"X": x + x0, "Y": y, "Z": z, "Classification": np.where(block, 6, 2).astype("u1")}


def words(tmp_path, *files):
    return ["train", *map(str, files), "--model", str(tmp_path / "m.model"), *QUICK_WORDS]


@pytest.mark.pdal
def test_train_takes_folders_and_says_an_honest_score_first(tmp_path, write_las, capsys):
    (tmp_path / "in").mkdir()
    for number in range(2):
        write_las(tmp_path / "in" / f"t{number}.laz", scene(number, 60.0 * number), point_format=1)
    code = main(words(tmp_path, tmp_path / "in"))
    out, err = capsys.readouterr()
    assert code == 0, err
    assert out.startswith("blocks held out")
    assert "blocks held out" not in err  # once is enough
    assert "t0.laz, t1.laz" in out
    score = ps.load_model(tmp_path / "m.model").info["accuracy"]["cross_validation"]
    assert (score["by"], score["folds"]) == ("blocks", 5) and score["chosen"]["trees"] == 2


def test_surveys_are_held_out_where_there_are_several():
    clouds = []
    for number in range(3):
        arrays = scene(number, 1000.0 * number)
        xyz = np.column_stack([arrays[k] for k in "XYZ"])
        clouds.append(ps.TrainingCloud(xyz, arrays["Classification"], name=f"s{number}"))
    options = ps.TrainingOptions("k8", **{**QUICK, "dimensions": ()}, count=200)
    model = ps.train(clouds, options, progress=False)
    score = model.info["accuracy"]["cross_validation"]
    assert (score["by"], score["folds"]) == ("surveys", 3)
    assert str(model).startswith("surveys held out")
    without = ps.train(clouds, replace(options, folds=0), progress=False)
    assert without.info["accuracy"]["cross_validation"] is None
    for first, other in zip(model.passes, without.passes, strict=True):  # the score chooses nothing
        assert all(np.array_equal(a, other.arrays()[key]) for key, a in first.arrays().items())


def test_too_little_ground_for_a_score_is_no_error():
    rng = np.random.default_rng(0)
    xyz = rng.uniform(0, 8, (300, 3))
    options = ps.TrainingOptions("k8", **{**QUICK, "dimensions": ()}, count=50)
    cloud = ps.TrainingCloud(xyz, np.where(xyz[:, 2] > 4, 6, 2))
    model = ps.train([cloud], options, progress=False)
    assert model.info["accuracy"]["cross_validation"] is None
    assert str(model).startswith("not scored")
