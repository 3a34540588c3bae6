"""What all stages have in common: they cannot be changed after they are made."""

from __future__ import annotations

import copy
import pickle

import pytest

from pdal_stages.stages.registry import stage_type, stage_types

NEEDED = {
    "filters.modelclassifier": {"model": "standard"},
    "writers.classifiermodel": {"filename": "new.model"},
    "writers.objects": {"filename": "new.gpkg"},
}


@pytest.mark.parametrize("name", [name for name in stage_types() if name != "filters.polygons"])
def test_stages_are_immutable(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    stage = stage_type(name)(NEEDED.get(name, stage_type(name).example))
    before = stage.options.copy()
    for attribute in ("upstream", "place", "options", "threads", "_condition", "anything"):
        with pytest.raises(AttributeError):
            setattr(stage, attribute, 1)
    placed = stage.after([{"type": "filters.smrf"}])
    assert placed.upstream and not stage.upstream and placed.options == before == stage.options
    for other in (copy.copy(placed), pickle.loads(pickle.dumps(placed))):
        assert other.upstream == placed.upstream
        with pytest.raises(AttributeError):
            other.upstream = ()
