"""Stages of ours that follow each other directly run in one filter of PDAL."""

from __future__ import annotations

import numpy as np
import pytest

import pdal_stages as ps
from pdal_stages.base.errors import StageError
from pdal_stages.pipeline import run
from pdal_stages.pipeline.lowering import lower
from pdal_stages.pipeline.read import read_pipeline
from pdal_stages.pipeline.together import joined, together
from pdal_stages.stages import registry
from pdal_stages.synthetic import TownOptions, write_town

pytestmark = pytest.mark.pdal

NOISE = {"type": "filters.detachednoise"}
HEIGHTS = {"type": "filters.hag_morphological", "ground": True, "openings": [5, 17], "decks": True}
CLASSES = {"type": "filters.modelclassifier", "model": "standard"}
RULES = {"type": "filters.consistency"}
BRIDGES = {"type": "filters.bridges"}


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    path = tmp_path_factory.mktemp("together") / "town.laz"
    write_town(TownOptions(size=60, density=6, seed=3), path)
    return str(path)


def groups(stages, town="town.laz"):
    """Types of the stages in each filter that holds ours; PDAL's own stages by their type."""
    filters = joined(lower(read_pipeline([{"type": "readers.las", "filename": town}, *stages])).stages)
    return [
        [one["stage"].partition(".")[2] for one in together(f["pdalargs"])] if "pdalargs" in f else f["type"]
        for f in filters[1:]
    ]


def test_neighbors_join_and_what_lets_go_of_arrays_comes_last():
    assert groups([NOISE, HEIGHTS, CLASSES, BRIDGES, RULES]) == [
        ["detachednoise", "hag_morphological", "modelclassifier"],
        ["bridges", "consistency"],
    ]


def test_pdals_stages_and_wiring_keep_filters_apart():
    range_ = {"type": "filters.range", "limits": "Z[:1000]"}
    assert groups([NOISE, range_, HEIGHTS]) == [["detachednoise"], "filters.range", ["hag_morphological"]]
    tagged = [{**NOISE, "tag": "a"}, {**HEIGHTS, "inputs": ["a"]}]
    assert groups(tagged) == [["detachednoise"], ["hag_morphological"]]
    wanted_later = [
        {**NOISE, "tag": "a"},
        {**HEIGHTS, "tag": "b"},
        {"type": "filters.merge", "inputs": ["a", "b"]},
    ]
    assert groups(wanted_later)[:2] == [["detachednoise"], ["hag_morphological"]]


def test_dimensions_of_two_types_keep_filters_apart():
    stages = lower(read_pipeline(["town.laz", NOISE, HEIGHTS])).stages
    stages[1]["add_dimension"] = ["Ground=double"]
    assert len(joined(stages)) == len(stages)
    stages[1]["add_dimension"] = ["Ground=uint8_t"]
    assert len(joined(stages)) == len(stages) - 1


@pytest.mark.parametrize("compact", [False, True])
def test_results_are_those_of_filters_apart(town, monkeypatch, compact):
    stages = [town, NOISE, HEIGHTS, {**CLASSES, "compact": compact, "where": "Z < 30"}, BRIDGES, RULES]

    def results():
        pipeline = ps.Pipeline(stages)
        pipeline.execute()
        return pipeline.arrays[0], [report.to_dict() for _, each in pipeline.reports for report in each]

    together_, reports = results()
    monkeypatch.setattr(run, "joined", list)
    apart, reports_apart = results()
    assert together_.dtype == apart.dtype
    for name in apart.dtype.names:
        np.testing.assert_array_equal(together_[name], apart[name], err_msg=name)
    assert together_["Ground"].any() and together_["HeightAboveOpening_5"].any()
    assert reports == reports_apart


def test_metadata_names_each_stage(town):
    pipeline = ps.Pipeline([town, NOISE, HEIGHTS])
    pipeline.execute()
    assert {NOISE["type"], HEIGHTS["type"]} <= set(pipeline.metadata["metadata"])
    assert "filters.python" not in pipeline.metadata["metadata"]


def test_an_error_names_the_stage_that_failed(town, monkeypatch):
    def fail(self, points):
        raise StageError("no such luck")

    monkeypatch.setattr(registry.stages()["filters.hag_morphological"], "run", fail)
    with pytest.raises(StageError, match="no such luck") as caught:
        ps.Pipeline([town, NOISE, {**HEIGHTS, "tag": "mine"}, RULES]).execute()
    assert caught.value.where == "filters.hag_morphological (tag 'mine')"
