"""What a run says and where: warnings once, a log, verdicts as JSON, names of outputs, errors of others."""

from __future__ import annotations

import inspect
import json

import laspy
import numpy as np
import pytest

import pdal_stages as ps

pytestmark = pytest.mark.pdal


@pytest.fixture()
def cloud(tmp_path, write_las):
    rng = np.random.default_rng(1)
    x, y = rng.uniform(0, 30, (2, 500))
    arrays = {
        "X": x,
        "Y": y,
        "Z": rng.normal(0, 0.02, 500),
        "Amplitude": rng.random(500).astype("f4"),
    }
    return write_las(tmp_path / "cloud.las", arrays, point_format=1)


@pytest.mark.parametrize("tiles", [(), ("--tile", 20, "--workers", 0, "--buffer", 5)])
def test_warnings_of_pdal_are_shown_once(cloud, tmp_path, run_job, tiles):
    """filters.hag_nn warns of ground points that are not there."""
    smrf = {"type": "filters.smrf", "cell": 20}
    stages = [
        cloud,
        smrf,
        {"type": "filters.hag_minima"},
        {"type": "filters.hag_minima", "tag": "b"},
    ]
    code, _, err = run_job([*stages, tmp_path / "o.las"], *tiles)
    assert code == 0, err
    assert err.count("small number of cells") == 1 and "pypipeline" not in err
    assert err.count("no spatial reference") == 1


def test_metadata_names_the_final_outputs(cloud, tmp_path, run_job):
    out, meta = tmp_path / "o.las", tmp_path / "m.json"
    assert run_job([cloud, {"type": "filters.hag_minima"}, out], "--metadata", meta)[0] == 0
    assert json.loads(meta.read_text())["metadata"]["writers.las"]["filename"] == [str(out)]


def test_extra_dimensions_of_old_files_are_read(cloud, tmp_path, run_job):
    """PDAL leaves those of LAS 1.0-1.3 out unless `use_eb_vlr` is set."""
    stages = [cloud, {"type": "filters.hag_minima"}]
    writer = {"type": "writers.las", "filename": str(tmp_path / "o.las"), "extra_dims": "all"}
    assert run_job([*stages, writer])[0] == 0
    assert np.array_equal(
        laspy.read(tmp_path / "o.las")["Amplitude"], laspy.read(cloud)["Amplitude"]
    )


@pytest.mark.parametrize(
    ("stage", "says"),
    [
        ({"type": "filters.accuracy"}, "'Reference' is missing"),
        (
            {"type": "filters.modelclassifier", "model": "standard"},
            "'HeightAboveGround' is missing",
        ),
        ({"type": "filters.hag_minima", "cell": -1}, "must be a number"),
        ({"type": "filters.hag_nonsense"}, "no stage|Couldn't create"),
        ("degrees", "degrees"),
    ],
)
def test_what_cannot_run_is_not_valid(cloud, tmp_path, run_job, stage, says):
    stages = [cloud, stage, tmp_path / "o.las"]
    if stage == "degrees":
        turned = {"type": "filters.reprojection", "in_srs": "EPSG:32632", "out_srs": "EPSG:4326"}
        stages[1:2] = [turned, {"type": "filters.hag_minima"}]
    for command, words in (("pipeline", ["--validate"]), ("validate", [])):
        code, out, err = run_job(stages, *words, command=command)
        verdict = json.loads(out)
        assert code == 1 and verdict["valid"] is False and verdict["error_detail"].strip() in err
        assert any(word in err for word in says.split("|")) and not (tmp_path / "o.las").exists()


def test_dimensions_that_a_file_or_a_stage_brings_are_valid(tmp_path, run_job, write_las):
    xyz = dict(zip("XYZ", np.random.default_rng(0).uniform(0, 9, (3, 50)), strict=True))
    inside = write_las(
        tmp_path / "mine.las", {**xyz, "Reference": np.full(50, 2, "u1")}, point_format=6
    )
    plain = write_las(tmp_path / "plain.las", xyz, point_format=6)
    ferry = {"type": "filters.ferry", "dimensions": "Classification=>Reference"}
    for stages in ([inside], [plain, ferry]):
        assert run_job([*stages, {"type": "filters.accuracy"}], command="validate")[0] == 0
    assert run_job([plain, {"type": "filters.accuracy"}], command="validate")[0] == 1


def test_errors_of_others_are_told_as_such(cloud, tmp_path, run_job):
    script = "def f(ins, outs):\n    raise ValueError('my own problem')\n"
    theirs = {"type": "filters.python", "module": "x", "function": "f", "source": script}
    code, _, err = run_job([cloud, theirs, {"type": "filters.hag_minima"}, tmp_path / "o.las"])
    assert code == 1 and "ValueError: my own problem" in err and "line 2" in err
    assert "Traceback" not in err and "internal error" not in err


# ---- objects that behave like python-pdal's ----------------------------------------------------------------


def test_objects_like_those_of_python_pdal(cloud, pdal_module):
    reader = pdal_module.Reader.las(str(cloud)).pipeline()
    reader.execute()
    alone = ps.Filter.hag_minima(tag="h").pipeline(reader.arrays[0])
    assert alone.execute() == 500 and "HeightAboveGround" in alone.arrays[0].dtype.names
    stage = ps.Filter.hag_minima(cell=10, tag="h")
    assert (stage.type, stage.tag, stage.options["cell"]) == ("filters.hag_minima", "h", 10)


def test_signatures_and_completion():
    first, *others = inspect.signature(ps.Filter.modelclassifier).parameters.values()
    assert first.name == "model" and {"margin", "ignore", "tag"} <= {p.name for p in others}
    assert inspect.signature(ps.Filter.hag_minima).parameters["cell"].default == 20.0
    assert ps.Filter.modelclassifier("standard").options == {
        "type": "filters.modelclassifier",
        "model": "standard",
    }
    assert "Side of the coarse cells" in ps.Filter.hag_minima.__doc__
    assert "hag_minima" in dir(ps.Filter) and not hasattr(ps.Filter, "nonsense")
    with pytest.raises(TypeError):
        ps.Filter.hag_minima(20)
