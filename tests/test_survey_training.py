"""`train` with surveys: each file by itself, whatever its reference system, and what is said where there is no score."""

from __future__ import annotations

import numpy as np
import pytest
from test_training_scores import QUICK_WORDS, scene

import pdal_stages as ps
from pdal_stages.base.errors import OptionError
from pdal_stages.cli import main
from pdal_stages.tiling import train_survey
from pdal_stages.tiling.train_survey import surveys_of


def test_surveys_are_files_or_groups_of_them():
    files = ["a/1.laz", "a/2.laz", "b/1.laz", "c.laz"]
    assert surveys_of(files) == {
        "1": ["a/1.laz"],
        "2": ["a/2.laz"],
        "b/1.laz": ["b/1.laz"],
        "c": ["c.laz"],
    }
    assert surveys_of(files, ["north=a/*"]) == {
        "north": files[:2],
        "1": ["b/1.laz"],
        "c": ["c.laz"],
    }
    assert surveys_of(files, ["n=a/*,b/*", "s=c.laz"]) == {"n": files[:3], "s": files[3:]}
    for wrong in (["a/*"], ["n=x/*"], ["n=a/*", "s=a/1.laz"], ["=a/*"]):
        with pytest.raises(OptionError):
            surveys_of(files, wrong)


@pytest.mark.pdal
def test_surveys_of_two_reference_systems_are_left_out_in_turn(tmp_path, write_las, capsys):
    pyproj = pytest.importorskip("pyproj")
    # The same coordinates in different systems: as one cloud they would lie in one another.
    for number, epsg in enumerate((2154, 28992, 25830)):
        write_las(
            tmp_path / f"t{number}.laz",
            scene(number),
            point_format=6,
            wkt=pyproj.CRS(epsg).to_wkt("WKT1_GDAL"),
        )
    words = [
        "train",
        *(str(tmp_path / f"t{k}.laz") for k in range(3)),
        "--model",
        str(tmp_path / "m.model"),
    ]
    telling = ["--feature-set", "HeightAboveLowest", "--neighborhoods", "s12"]
    assert main([*words, *QUICK_WORDS, *telling, "--surveys"]) == 0
    out = capsys.readouterr().out
    assert "surveys held out" in out.splitlines()[0]
    info = ps.load_model(tmp_path / "m.model").info
    score = info["accuracy"]["cross_validation"]
    assert (score["by"], score["folds"]) == ("surveys", 3)
    assert score["chosen"]["overall_accuracy"] > 0.9
    assert [entry["name"] for entry in info["training"]["clouds"]] == ["t0", "t1", "t2"]

    wide = ["--filters.hag_morphological.window=20", "--writers.classifiermodel.dimensions=Ground"]
    assert main([*words, *QUICK_WORDS, *telling, *wide, "--surveys"]) == 0
    capsys.readouterr()
    (heights,) = ps.load_model(tmp_path / "m.model").info["preparation"]  # as they were made
    assert heights["window"] == 20

    grouped = [*words, *QUICK_WORDS, "--surveys", f"one={tmp_path}/t0.laz,{tmp_path}/t1.laz"]
    assert main(grouped) == 1  # of one survey must be of one reference system
    assert "reference systems" in capsys.readouterr().err


@pytest.mark.pdal
def test_it_is_said_that_there_is_no_score_and_what_to_label_next(tmp_path, write_las, capsys):
    points = scene(1)
    building = points["Classification"] == 6
    corner = (points["X"] > 20) | (points["Y"] > 20)
    points["Classification"][building & corner] = 1
    write_las(tmp_path / "a.laz", points, point_format=1)
    assert (
        main(["train", str(tmp_path / "a.laz"), "--model", str(tmp_path / "m.model"), *QUICK_WORDS])
        == 0
    )
    output = capsys.readouterr()
    assert "there is no score on ground held out" in output.err and "class 6" in output.err
    assert "Label in more places" in output.err and "not scored" in output.out
    info = ps.load_model(tmp_path / "m.model").info
    assert info["accuracy"]["cross_validation"] is None and "sureness" not in info
    labels = '{"2": "Ground", "1,6": "6 Roofs"}'  # JSON, as docs/train.md has it
    assert main(["train", str(tmp_path / "a.laz"), "--model", str(tmp_path / "m.model"), *QUICK_WORDS,
                 "--writers.classifiermodel.folds=0", "--classes", labels]) == 0  # fmt: skip
    output = capsys.readouterr()
    assert "no score" not in output.err and "6 Roofs" in output.out


@pytest.mark.pdal
def test_corrections_are_trained_on(tmp_path, write_las, capsys):
    """Samples are drawn from what a person checked, and a place to draw from must hold some."""
    points = scene(1)
    points["Checked"] = (points["X"] < points["X"].mean()).astype(np.uint8)
    cloud = str(write_las(tmp_path / "a.laz", points, point_format=6))
    words = ["train", cloud, "--model", str(tmp_path / "m.model"), *QUICK_WORDS]
    assert main(words) == 0
    assert "were checked by a person" in "".join(capsys.readouterr())
    (tmp_path / "m.model").unlink()
    assert main([*words, "--writers.classifiermodel.where=Checked == 0"]) == 1
    assert "no checked point lies inside 'where'" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["a.laz"]


@pytest.mark.pdal
def test_more_points_than_fit_into_memory_are_refused(tmp_path, write_las, capsys, monkeypatch):
    for name in "ab":
        write_las(tmp_path / f"{name}.laz", scene(1), point_format=6)
    monkeypatch.setattr(train_survey, "free_memory", lambda: 1.5 * 400 * len(scene(1)["X"]))
    words = ["train", str(tmp_path), "--model", str(tmp_path / "m.model"), *QUICK_WORDS]
    assert main(words) == 1 and "do not fit into memory" in capsys.readouterr().err
    assert main([*words, "--surveys"]) == 0  # one is read after the other
