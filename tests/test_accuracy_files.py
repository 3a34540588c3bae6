"""`accuracy` of several files: a table by file, a map by place, vegetation as one class."""

from __future__ import annotations

import json
from contextlib import nullcontext

import numpy as np
import pytest
from test_training_scores import scene

from pdal_stages.base.errors import StageError
from pdal_stages.cli import main
from pdal_stages.pipeline.accuracy_files import _refuse_other_points, paired
from pdal_stages.stages.points import Points


@pytest.mark.pdal
def test_each_file_has_its_line_and_its_map(tmp_path, write_las, capfd):
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
    assert text.count("<h2>Maps") == 3 and "Maps: far.laz" in text


@pytest.mark.parametrize(("moved", "refused"), [(0.005, False), (0.02, True)])
def test_references_of_other_points_are_refused(moved, refused):
    x, zero = np.arange(3.0), np.zeros(3)
    one, other = (Points({"X": x + d, "Y": zero, "Z": zero}) for d in (0.0, moved))
    with pytest.raises(StageError, match="lie apart") if refused else nullcontext():
        _refuse_other_points(one, other, "a.las", "b.las")


@pytest.mark.parametrize(
    ("code", "moved", "refused"),
    [(4326, 1e-6, True), (4326, 5e-8, False), (2992, 0.02, False), (2992, 0.05, True)],
)
def test_the_same_place_is_a_centimeter_in_any_unit(code, moved, refused):
    """0.000001 degrees are 11 cm; 2992 is in feet."""
    wkt = pytest.importorskip("pyproj").CRS.from_epsg(code).to_wkt("WKT1_GDAL")
    x, zero = np.arange(3.0), np.zeros(3)
    one, other = (Points({"X": x + d, "Y": zero, "Z": zero}, wkt=wkt) for d in (0.0, moved))
    with pytest.raises(StageError, match="lie apart") if refused else nullcontext():
        _refuse_other_points(one, other, "a.las", "b.las")


@pytest.mark.pdal
def test_points_of_files_in_degrees_that_lie_apart_are_refused(tmp_path, run, write_las):
    x, y = 5.0 + np.arange(100) * 1e-5, 52.0 + np.zeros(100)
    arrays = {"Z": 0 * x, "Classification": np.full(100, 2, np.uint8), "Y": y}
    names = [
        str(write_las(tmp_path / name, {"X": x + d, **arrays}, scale=1e-7, point_format=6))
        for name, d in (("a.las", 0.0), ("b.las", 0.005))
    ]
    code, _, err = run("accuracy", names[0], "--reference", names[1])
    assert code == 1 and "100 points of" in err and "lie apart" in err
    assert run("accuracy", names[0], "--reference", names[0])[0] == 0


def test_files_are_paired_by_name():
    files, true = ["out/c_t1.laz", "out/c_t11.laz"], ["truth/t11.laz", "truth/t1.laz"]
    assert sorted(paired(files, true)) == sorted(zip(files, true[::-1], strict=True))
    with pytest.raises(StageError, match="no reference with its name"):
        paired(files, ["truth/t11.laz", "truth/t2.laz"])
