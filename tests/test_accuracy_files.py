"""`accuracy` of several files: a table by file, a map by place, vegetation as one class, a model scored by one option."""

from __future__ import annotations

import json
from contextlib import nullcontext

import numpy as np
import pytest
from test_training_scores import QUICK_WORDS, scene

from pdal_stages.base.errors import StageError
from pdal_stages.cli import main
from pdal_stages.pipeline.accuracy_files import _refuse_other_points, paired
from pdal_stages.reports.accuracy_page import Place, places
from pdal_stages.stages.points import Points


def place(name, x, n=50):
    xyz = np.random.default_rng(0).random((n, 3)) * 10 + [x, 0, 0]
    return Place(name, xyz, np.full(n, 2), np.full(n, 2))


def test_files_near_one_another_share_a_map():
    files = [place("a", 0), place("b", 600_000), place("c", 900), place("d", 1800)]
    matches = places(files)
    assert [match.name for match in matches] == ["a, c, d", "b"]
    assert [len(match.xyz) for match in matches] == [150, 50]
    # Of another reference system, they lie elsewhere.
    assert [match.name for match in places(files, ["x", "x", "y", "y"])] == ["a", "b", "c, d"]


@pytest.mark.pdal
def test_each_file_has_its_line_and_each_place_its_map(tmp_path, write_las, capfd):
    for name, x0, wrong in (("a", 0.0, 0.1), ("b", 60.0, 0.4), ("far", 300_000.0, 0.0)):
        points = scene(1, x0)
        points["Reference"] = points["Classification"].copy()
        wrongly = np.random.default_rng(2).random(len(points["X"])) < wrong
        points["Classification"] = np.where(wrongly, 6, points["Reference"]).astype("u1")
        write_las(tmp_path / f"{name}.laz", points, point_format=6)
    page, figures = tmp_path / "a.html", tmp_path / "a.json"
    words = [str(tmp_path / f"{n}.laz") for n in ("a", "b", "far")] + [
        "--html",
        str(page),
        "--json",
        str(figures),
    ]
    assert main(["accuracy", *words]) == 0
    lines = capfd.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[2:5]] == ["b.laz", "a.laz", "far.laz"]
    report = json.loads(figures.read_text())
    by_name = {entry["name"]: entry for entry in report["files"]}
    assert by_name["far.laz"]["overall_accuracy"] == 1.0 > by_name["a.laz"]["overall_accuracy"]
    assert report["points"] == sum(entry["points"] for entry in report["files"])
    right = sum(entry["points"] * entry["overall_accuracy"] for entry in report["files"])
    assert np.isclose(report["overall_accuracy"], right / report["points"])
    text = page.read_text()
    assert text.count("<h2>Maps") == 2 and "Maps: far.laz" in text


_DEGREES = (
    'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],'
    'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]]'
)
_FEET = 'LOCAL_CS["grid",UNIT["foot",0.3048]]'


@pytest.mark.parametrize(
    ("wkt", "moved", "refused"),
    [
        ("", 0.005, False),
        ("", 0.02, True),
        (_FEET, 0.02, False),  # 6 mm
        (_FEET, 0.04, True),
        (_DEGREES, 0.005, True),  # 500 m
        (_DEGREES, 5e-8, False),
    ],
)
def test_references_of_other_points_are_refused_in_meters(wkt, moved, refused):
    x, zero = np.arange(3.0), np.zeros(3)
    one, other = (Points({"X": x + d, "Y": zero, "Z": zero}, wkt) for d in (0.0, moved))
    with pytest.raises(StageError, match="lie apart") if refused else nullcontext():
        _refuse_other_points(one, other, "a.las", "b.las")


@pytest.mark.pdal
def test_a_model_is_scored_by_one_option(tmp_path, write_las, capsys):
    for number in range(2):
        write_las(tmp_path / f"t{number}.laz", scene(number, 100.0 * number), point_format=6)
    model = str(tmp_path / "m.model")
    telling = ["--feature-set", "HeightAboveLowest", "--neighborhoods", "s12"]
    assert main(["train", str(tmp_path / "t0.laz"), "--model", model, *QUICK_WORDS, *telling]) == 0
    capsys.readouterr()
    words = ["accuracy", str(tmp_path / "t1.laz"), "--model", model]
    assert main([*words, "--json", str(tmp_path / "a.json")]) == 0
    report = json.loads((tmp_path / "a.json").read_text())
    assert report["points"] > 800 and report["overall_accuracy"] > 0.9
    assert [entry["code"] for entry in report["classes"]] == [2, 6]
    assert main([*words, "--reference", str(tmp_path / "t0.laz")]) == 1
    assert "exclude each other" in capsys.readouterr().err


def test_files_of_one_name_are_compared_by_their_folders():
    names = ["out/2023/c_t1.laz", "out/2024/c_t1.laz", "out/2024/t2.laz"]
    true = ["truth/2024/t1.laz", "truth/2023/t1.laz", "truth/2024/t2.laz"]
    assert sorted(paired(names, true)) == sorted(
        zip(names, [true[1], true[0], true[2]], strict=True)
    )
    with pytest.raises(StageError, match="no reference with its name") as caught:
        paired(names, [*true[:2], "truth/2023/t2.laz"])
    assert "2023/t2" in str(caught.value)
