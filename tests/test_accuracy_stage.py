"""``filters.accuracy`` and ``pdal-stages accuracy``: what is scored, which files belong together, what is told."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

import pdal_stages as ps
from pdal_stages import TrainingCloud, TrainingOptions, train
from pdal_stages.base.errors import StageError
from pdal_stages.cli import main
from pdal_stages.pipeline.accuracy_files import paired
from pdal_stages.pipeline.inputs_outputs import input_files

pytestmark = pytest.mark.pdal
WKT = 'PROJCS["RGF93 / Lambert-93",GEOGCS["RGF93",DATUM["x",SPHEROID["GRS 1980",6378137,298.257222101]],'
WKT += 'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]],PROJECTION["Lambert_Conformal_Conic_2SP"],'
WKT += 'UNIT["metre",1],AUTHORITY["EPSG","2154"]]'


def scene(n=900, seed=1):
    """Ground, a house, bushes and trees (3 and 5), and some points never classified."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, 30, (2, n))
    house, bush, tree = (x > 18) & (y > 18), (x < 10) & (y > 18), (x < 10) & (y < 10)
    z = np.select([house, bush, tree], [6.0, rng.uniform(0, 2, n), rng.uniform(3, 12, n)], 0.0)
    z += rng.normal(0, 0.02, n)
    codes = np.select([house, bush, tree], [6, 3, 5], 2).astype(np.uint8)
    codes[: n // 10] = 1
    return {"X": x, "Y": y, "Z": z, "Classification": codes}


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    """A model of three classes, one of them made of two labels, and a binary one."""
    folder = tmp_path_factory.mktemp("models")
    arrays = scene()
    cloud = TrainingCloud(np.column_stack([arrays[a] for a in "XYZ"]), arrays["Classification"], {})
    common = {
        "neighborhoods": "c1,c3",
        "dimensions": (),
        "feature_set": "covariance,geometric",
        "count": 100,
        "trees": 10,
    }
    for name, options in (
        ("classes", {"classes": {"2": 2, "3,5": "5 Anything green", "6": 6}}),
        ("binary", {"target": 6}),
        ("translated", {"classes": {"2": 5, "3,5": 4, "6": 2}}),
    ):
        train([cloud], TrainingOptions(**common, **options), progress=False).save(
            folder / f"{name}.model"
        )
    return folder


def judged(source, model, tmp_path, **options):
    """Return what a pipeline that classifies and compares finds, and its page."""
    ps.run_pipeline(
        [
            str(source),
            {"type": "filters.ferry", "dimensions": "Classification=>Reference"},
            {"type": "filters.modelclassifier", "model": str(model)},
            {
                "type": "filters.accuracy",
                "json": str(tmp_path / "a.json"),
                "html": str(tmp_path / "a.html"),
                **options,
            },
        ]
    )
    return json.loads((tmp_path / "a.json").read_text()), (tmp_path / "a.html").read_text()


def test_the_trained_classes_are_scored(models, tmp_path, write_las, capfd):
    source = write_las(tmp_path / "town.laz", scene(seed=2), point_format=6, wkt=WKT)
    figures, page = judged(source, models / "classes.model", tmp_path)
    assert [(c["code"], c["name"]) for c in figures["classes"]] == [
        (2, "Ground"),
        (5, "Anything green"),
        (6, "Building"),
    ]
    assert figures["merged"] == {"3": 5} and figures["left_out"] == {
        "points": 90,
        "by_class": {"1": 90},
    }
    assert figures["overall_accuracy"] > 0.5
    assert "Anything green" in capfd.readouterr().out
    for words in ("town.laz", "RGF93 / Lambert-93 (EPSG:2154)", "classes.model", "Importances"):
        assert words in page


def test_the_background_of_a_binary_model_is_scored(models, tmp_path, write_las):
    source = write_las(tmp_path / "town.laz", scene(seed=2))
    figures, _ = judged(source, models / "binary.model", tmp_path, print=False)
    background, building = figures["classes"]
    codes = scene(seed=2)["Classification"]
    assert (background["code"], background["name"], building["code"]) == (1, "Background", 6)
    assert background["support"] == np.isin(codes, [2, 3, 5]).sum()
    assert figures["left_out"]["by_class"] == {"1": 90}
    matrix = np.array(figures["confusion"]["counts"])
    assert building["precision"] == matrix[1, 1] / matrix[:, 1].sum()


def test_a_reference_in_the_codes_of_a_model_that_translates_labels(models, tmp_path, write_las):
    arrays = scene(seed=2)
    arrays["Classification"] = np.array([0, 1, 5, 4, 4, 4, 2], np.uint8)[arrays["Classification"]]
    source = write_las(tmp_path / "town.laz", arrays)
    figures, _ = judged(source, models / "translated.model", tmp_path, print=False)
    assert [c["code"] for c in figures["classes"]] == [2, 4, 5] and figures["merged"] == {}
    assert figures["left_out"]["by_class"] == {"1": 90} and figures["overall_accuracy"] > 0.5


def test_the_user_overrules_the_model(models, tmp_path, write_las):
    source = write_las(tmp_path / "town.laz", scene(seed=2))
    figures, _ = judged(source, models / "classes.model", tmp_path, classes=[2, 6], print=False)
    assert [c["code"] for c in figures["classes"]] == [2, 6] and figures["merged"] == {}
    figures, _ = judged(source, models / "classes.model", tmp_path, merge={"2": [6]}, print=False)
    assert [c["code"] for c in figures["classes"]] == [2, 5] and figures["merged"] == {"6": 2}


def test_files_are_compared_in_pairs_of_their_name(tmp_path, write_las, capfd):
    """The table is output, so that it can be kept: ``pdal-stages accuracy ... > table.txt``."""
    for folder in ("true", "found"):
        (tmp_path / folder).mkdir()
    for seed, name in enumerate(("b", "a_2", "a")):
        arrays = scene(seed=seed)
        write_las(tmp_path / "true" / f"{name}.laz", arrays)
        arrays["Classification"] = np.where(
            np.arange(900) < 180, 5, arrays["Classification"]
        ).astype(np.uint8)
        write_las(tmp_path / "found" / f"c_{name}.laz", arrays)
    found, more = tmp_path / "found", ["--html", tmp_path / "a.html"]
    for sources in ([found], [found / "c_*.laz"], sorted(found.iterdir())):
        words = ["accuracy", *sources, "--reference", tmp_path / "true", *more]
        assert main([str(w) for w in words]) == 0
        out, _ = capfd.readouterr()
        assert re.search(r"Points compared +2,430\b", out)
    page = (tmp_path / "a.html").read_text()
    assert "c_a_2.laz" in page and "none given" in page


def test_files_without_a_partner_are_refused(tmp_path):
    assert paired(["x.laz"], ["y.laz"]) == [("x.laz", "y.laz")]
    assert paired(["o/c_a.laz", "o/c_ab.laz"], ["ab.laz", "a.laz"]) == [
        ("o/c_a.laz", "a.laz"),
        ("o/c_ab.laz", "ab.laz"),
    ]
    with pytest.raises(StageError, match=r"no reference with its name.*c\.laz"):
        paired(["a.laz", "c.laz"], ["a.laz", "b.laz"])
    with pytest.raises(StageError, match="the same reference"):
        paired(["c_a.laz", "d_a.laz"], ["a.laz"])
    with pytest.raises(StageError, match="no LAS or LAZ"):
        input_files([str(tmp_path)])
