"""Pipelines with several ends, of which PDAL would run the first, and pipelines without a reader."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pdal_stages.base.errors import DimensionError, PipelineError
from pdal_stages.cli import main
from pdal_stages.pipeline.expansion import check_dimensions
from pdal_stages.pipeline.run import Pipeline
from pdal_stages.stages import preprocessing

FAUX = {"type": "readers.faux", "count": 300, "mode": "ramp", "bounds": "([0,60],[0,60],[0,9])"}
HAG = {"type": "filters.hag_minima"}


def writer(name, *inputs, **more):
    return {
        "type": "writers.las",
        "filename": name,
        **({"inputs": list(inputs)} if inputs else {}),
        **more,
    }


def filter_(*inputs, **more):
    return {
        "type": "filters.range",
        "limits": "X[0:]",
        **({"inputs": list(inputs)} if inputs else {}),
        **more,
    }


#: Stages, and how many files PDAL writes where there is one end.
WHOLE = {
    "a line": ([FAUX, filter_(), writer("1.las"), writer("2.las")], 2),
    "several readers": ([FAUX, FAUX, filter_(), writer("1.las")], 1),
}
SEVERAL_ENDS = {
    "two writers of one": (
        [FAUX, filter_(tag="f"), writer("1.las", "f"), writer("2.las", "f")],
        "writers.las 2.las",
    ),
    "a reader nobody asks": (
        [{**FAUX, "tag": "A"}, {**FAUX, "count": 7}, writer("1.las", "A")],
        "readers.faux",
    ),
}


@pytest.mark.pdal
@pytest.mark.parametrize("name", WHOLE)
def test_pipelines_with_one_end(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    stages, files = WHOLE[name]
    assert Pipeline(stages).execute()
    assert len(list(tmp_path.glob("*.las"))) == files


@pytest.mark.parametrize("name", SEVERAL_ENDS)
def test_pipelines_with_several_ends_are_refused(name):
    stages, end = SEVERAL_ENDS[name]
    with pytest.raises(PipelineError, match=rf"several ends.*{end} \(stage"):
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


@pytest.mark.pdal
@pytest.mark.parametrize("ground", preprocessing.GROUND_OF_PDAL)
def test_ground_of_pdal_is_no_height(ground):
    """Points that have none still get one, and a model that reads heights is refused at once."""
    city = str(Path(__file__).parent / "data" / "city.laz")
    hag = Pipeline([city, {"type": ground}, HAG]).expanded
    assert not hag.ours[0].context.created_before and not hag.ours[0].stage.upstream
    model = {"type": "filters.modelclassifier", "model": "standard"}
    expanded = Pipeline([city, {"type": ground}, model]).expanded
    with pytest.raises(DimensionError, match="no stage before creates it"):
        check_dimensions(expanded)
    after = Pipeline([city, {"type": ground}, {"type": "filters.hag_nn"}, model]).expanded
    assert [stage["type"] for stage in after.ours[0].stage.upstream] == [ground, "filters.hag_nn"]
