"""Options as PDAL's own stages have them: option files, where_merge, ranges of classes, file names as objects."""

from __future__ import annotations

import json

import numpy as np
import pytest

import pdal_stages as ps
from pdal_stages.base.errors import OptionError, PipelineError
from pdal_stages.pipeline import pdal as pdal_env
from pdal_stages.stages.hag_minima import HagMinima

HAG = "filters.hag_minima"


def options_of(stage, **more):
    (ours,) = ps.Pipeline(["in.las", {"type": HAG, **stage}], **more).lowered.ours
    return ours.stage.options


# ---- option files ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        '{"cell": 30, "resolution": 2}',
        "--cell=30 --resolution=2",
        "--cell 30\n--resolution '2'\n",
        "\ufeff  --cell=30 --resolution=2",
    ],
)
def test_option_file(tmp_path, text):
    file = tmp_path / "words.txt"
    file.write_text(text, encoding="utf-8")
    found = options_of({"option_file": str(file)})
    assert (found["cell"], found["resolution"]) == (30, 2)
    assert options_of({"option_file": str(file), "cell": 40})["cell"] == 40  # the pipeline goes first
    from pdal_stages.pipeline.overrides import parse_overrides

    said, _ = parse_overrides([f"--{HAG}.cell=50"])
    assert options_of({"option_file": str(file)}, overrides=said)["cell"] == 50


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (None, "cannot be read"),
        ("cell=3", "cannot be read"),
        ("", "cannot be read"),
        ('{"cell": ', "cannot be read"),
        ("--cell", "has no value"),
        ("--cell=3 resolution=2", "does not begin with --name"),
        ('{"cel": 3}', r"no option 'cel'.*Did you mean 'cell'"),
        ('{"tag": "t"}', "not how stages are joined"),
        ("--cell='3", "cannot be read"),
    ],
)
def test_wrong_option_files(tmp_path, text, says):
    file = tmp_path / "words.txt"
    if text is not None:
        file.write_text(text)
    with pytest.raises(OptionError, match=rf"filters\.hag_minima.*{says}"):
        options_of({"option_file": str(file)})


@pytest.mark.pdal
def test_option_files_are_read_as_pdal_reads_them(tmp_path, pdal_module):
    """PDAL itself takes the same files for its own stages."""
    for text in ('{"length": 3}', "--length=3", "--length 3"):
        (tmp_path / "o").write_text(text)
        split = {"type": "filters.splitter", "option_file": str(tmp_path / "o"), "origin_x": 0, "origin_y": 0}
        faux = {"type": "readers.faux", "count": 4, "mode": "ramp", "bounds": "([0,6],[0,0],[0,0])"}
        pipeline = pdal_module.Pipeline(json.dumps([faux, split]))
        pipeline.execute()
        assert len(pipeline.arrays) > 1


# ---- where_merge -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", ["auto", "true", True, "TRUE"])
def test_where_merge_that_can_be(value):
    assert options_of({"where": "Z > 3", "where_merge": value})["where"] == "Z > 3"


@pytest.mark.parametrize(
    ("stage", "says"),
    [
        ({"where": "Z > 3", "where_merge": "false"}, "cannot be false here.*neighbors"),
        ({"where": "Z > 3", "where_merge": False}, "cannot be false here"),
        ({"where": "Z > 3", "where_merge": "maybe"}, "must be one of"),
    ],
)
def test_where_merge_that_cannot(stage, says):
    with pytest.raises(OptionError, match=rf"filters\.hag_minima.*{says}"):
        options_of(stage)


@pytest.mark.pdal
@pytest.mark.parametrize("merge", ["auto", "true"])
def test_where_as_pdal_merges(tmp_path, write_las, merge):
    """One view comes out, in order, as PDAL's own filters with where_merge give it where they can."""
    x = np.arange(50.0)
    cloud = write_las(tmp_path / "in.las", {"X": x, "Y": x % 7, "Z": x % 5})
    run = ps.run_pipeline([str(cloud), {"type": HAG, "where": "Z > 1", "where_merge": merge}])
    (array,) = run.arrays
    assert np.array_equal(array["X"], x) and (array["HeightAboveGround"][array["Z"] <= 1] < 0).all()


# ---- ranges of classes -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "codes"),
    [
        ([7, 18], [7, 18]),
        ("7, 18", [7, 18]),
        (7, [7]),
        ("Classification[7:7]", [7]),
        ("Classification[7:7], Classification[18:18]", [7, 18]),
        (["classification [ 3 : 5 ]", 9], [3, 4, 5, 9]),
        ("Classification(2:5),7", [3, 4, 7]),
        ("Classification[2:5),Classification(2:5]", [2, 3, 4, 5]),
        ("Classification[253:]", [253, 254, 255]),
        ("Classification[:1]", [0, 1]),
        ("Classification![1:255]", [0]),
        ("", []),
    ],
)
def test_ranges(given, codes):
    assert list(HagMinima({"ignore": given}).ignore.codes) == codes


@pytest.mark.parametrize(
    "given", ["Z[1;2]", "Classification[7]", [256], "Classification[a:b]", [7.5], "7;18"]
)
def test_what_is_not_a_range(given):
    with pytest.raises(OptionError, match="class codes of 0 to 255"):
        HagMinima({"ignore": given})


@pytest.mark.pdal
def test_ranges_mean_what_they_mean_in_pdal(pdal_module):
    points = np.zeros(256, [("X", "f8"), ("Y", "f8"), ("Z", "f8"), ("Classification", "u1")])
    points["Classification"] = np.arange(256)
    for text in (
        "Classification[7:7]",
        "Classification(2:5)",
        "Classification[2:5)",
        "Classification(200:]",
        "Classification![3:250]",
    ):
        limits = json.dumps([{"type": "filters.range", "limits": text}])
        pipeline = pdal_module.Pipeline(limits, arrays=[points])
        pipeline.execute()
        assert sorted(pipeline.arrays[0]["Classification"].tolist()) == list(
            HagMinima({"ignore": text}).ignore.codes
        ), text


# ---- file names --------------------------------------------------------------------------------------------


@pytest.mark.pdal
def test_file_names_as_objects(tmp_path, write_las):
    """PDAL 2.9 writes file names as objects, and python-pdal 3.5 makes them; ours take them with any PDAL."""
    x = np.arange(50.0)
    cloud = write_las(tmp_path / "in.las", {"X": x, "Y": x % 7, "Z": x % 5})
    out = tmp_path / "out.las"
    stages = [
        {"type": "readers.las", "filename": {"path": str(cloud)}},
        {"type": HAG},
        {"type": "writers.las", "filename": {"path": str(out)}},
    ]
    assert ps.run_pipeline(stages).metadata["metadata"]["readers.las"]["count"] == 50
    assert out.exists() and not list(tmp_path.glob(".*"))
    (tmp_path / "job.json").write_text(json.dumps(stages))
    assert ps.run_pipeline(tmp_path / "job.json").arrays
    if pdal_env.version() < (2, 9, 0):
        stages[0]["filename"]["headers"] = {"a": "b"}
        with pytest.raises(PipelineError):
            ps.run_pipeline(stages)
