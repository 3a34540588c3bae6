"""Pipelines with several ends, of which PDAL runs the first, and pipelines without a reader."""

from __future__ import annotations

import json
import subprocess

import pytest

from pdal_stages.base.errors import PipelineError
from pdal_stages.cli import main
from pdal_stages.pipeline.lowering import run_by_pdal
from pdal_stages.pipeline.run import Pipeline

FAUX = {"type": "readers.faux", "count": 300, "mode": "ramp", "bounds": "([0,60],[0,60],[0,9])"}
HAG = {"type": "filters.hag_minima"}


def writer(name, *inputs, **more):
    return {"type": "writers.las", "filename": name, **({"inputs": list(inputs)} if inputs else {}), **more}


def filter_(*inputs, **more):
    return {
        "type": "filters.range",
        "limits": "X[0:]",
        **({"inputs": list(inputs)} if inputs else {}),
        **more,
    }


#: Stages, and the numbers of those that PDAL runs.
CASES = {
    "a line": ([FAUX, filter_(), writer("1.las"), writer("2.las")], [0, 1, 2, 3]),
    "two writers of one": ([FAUX, filter_(tag="f"), writer("1.las", "f"), writer("2.las", "f")], [0, 1, 2]),
    "joined again": (
        [
            FAUX,
            filter_(tag="f"),
            writer("1.las", "f", tag="a"),
            writer("2.las", "f", tag="b"),
            filter_("a", "b"),
        ],
        [0, 1, 2, 3, 4],
    ),
    "PDAL's own tags.json": (
        [{**FAUX, "tag": "A"}, {**FAUX, "tag": "B"}, writer("1.las", "A", "B"), writer("2.las", "A")],
        [0, 1, 2],
    ),
    "a reader nobody asks": ([{**FAUX, "tag": "A"}, {**FAUX, "count": 7}, writer("1.las", "A")], [1]),
    "several readers": ([FAUX, FAUX, filter_(), writer("1.las")], [0, 1, 2, 3]),
    "inputs again": ([{**FAUX, "tag": "A"}, {**FAUX, "tag": "B"}, filter_("A"), writer("1.las")], [1]),
}


@pytest.mark.parametrize("name", CASES)
def test_what_pdal_runs(name):
    stages, run = CASES[name]
    assert run_by_pdal(stages) == run


@pytest.mark.pdal
@pytest.mark.parametrize("name", CASES)
def test_pdal_itself_writes_these(name, tmp_path, pdal_program):
    stages, run = CASES[name]
    (tmp_path / "job.json").write_text(json.dumps(stages))
    done = subprocess.run(
        [pdal_program, "pipeline", "job.json"], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    expected = {stages[n]["filename"] for n in run if "filename" in stages[n]}
    assert {path.name for path in tmp_path.glob("*.las")} == expected


@pytest.mark.pdal
def test_other_ends_are_said_and_left_out(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    heights = {**HAG, "tag": "h"}
    (tmp_path / "job.json").write_text(
        json.dumps([FAUX, heights, writer("1.las", "h"), writer("2.las", "h")])
    )
    assert main(["validate", "job.json"]) == 0 and "several ends" in capsys.readouterr().err
    assert main(["pipeline", "job.json"]) == 0
    err = capsys.readouterr().err
    assert (
        "several ends" in err
        and "writers.las 2.las" in err
        and "line 1" in err
        and err.count("several ends") == 1
    )
    assert [path.name for path in tmp_path.glob("*.las")] == ["1.las"]
    assert Pipeline([FAUX, heights, writer("1.las", "h"), writer("2.las", "h"), filter_()]).execute() == 300


@pytest.mark.pdal
def test_a_pipeline_whose_writers_would_not_run(tmp_path):
    stages, _ = CASES["a reader nobody asks"]
    with pytest.raises(PipelineError, match=r"several ends.*not run: .*writers.las 1.las"):
        Pipeline(stages)


@pytest.mark.pdal
@pytest.mark.parametrize("stages", [[filter_()], [HAG], [HAG, FAUX, writer("1.las")]])
def test_a_pipeline_without_a_reader_at_its_start(tmp_path, capsys, monkeypatch, stages):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "job.json").write_text(json.dumps(stages))
    for words in (["pipeline"], ["validate"], ["pipeline", "--tile", "50"]):
        assert main([words[0], "job.json", *words[1:]]) == 1
        assert "reader" in capsys.readouterr().err
    assert not list(tmp_path.glob("*.las"))
