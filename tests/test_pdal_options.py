"""Options as PDAL's own stages have them: ranges of classes, file names as objects."""

from __future__ import annotations

import json

import numpy as np
import pytest

import pdal_stages as ps
from pdal_stages.base.errors import OptionError
from pdal_stages.stages.hag_minima import HagMinima

HAG = "filters.hag_minima"


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
