"""`writers.ogr` after our stages: PDAL 2.2 takes from memory which dimension is the measure, and crashes."""

from __future__ import annotations

import json

import pytest

from pdal_stages.pipeline import pdal as pdal_env
from pdal_stages.pipeline.run import Pipeline

pytestmark = pytest.mark.pdal
POINTS = 3000
FAUX = {"type": "readers.faux", "count": POINTS, "mode": "ramp", "bounds": "([0,60],[0,60],[0,9])"}


def test_it_gets_a_measure_where_nobody_names_one(monkeypatch):
    monkeypatch.setattr(pdal_env, "version", lambda: (2, 2, 0))
    for writer in ({"type": "writers.ogr", "filename": "a.gml"}, "a.shp"):
        assert (
            pdal_env.for_this_version(pdal_env.with_types([FAUX, writer]))[-1]["measure_dim"] == "Z"
        )
    own = {"type": "writers.ogr", "filename": "a.shp", "measure_dim": "Intensity"}
    assert pdal_env.for_this_version([FAUX, own])[-1] == own
    assert "measure_dim" not in pdal_env.for_this_version(pdal_env.with_types([FAUX, "a.las"]))[-1]
    monkeypatch.setattr(pdal_env, "version", lambda: (2, 9, 0))
    theirs = {"type": "writers.ogr", "filename": "a.shp"}
    assert pdal_env.for_this_version([FAUX, theirs])[-1] == theirs


@pytest.mark.parametrize(("name", "multicount"), [("o.shp", 1), ("o.geojson", 1), ("o.geojson", 7)])
def test_points_reach_the_file(tmp_path, name, multicount):
    out = tmp_path / name
    heights = {"type": "filters.hag_morphological", "ground": True, "openings": [5, 17]}
    # Scripts in between leave the used memory in which PDAL then makes its writer.
    Pipeline(
        [FAUX, heights, {"type": "writers.ogr", "filename": str(out), "multicount": multicount}]
    ).execute()
    if name.endswith(".shp"):
        assert out.stat().st_size == 100 + POINTS * 44  # type PointZ: x, y, z and the measure
        assert {p.suffix for p in tmp_path.iterdir()} >= {".shp", ".shx", ".dbf"}
    else:
        found = json.loads(out.read_text())["features"]
        assert len(found) == -(-POINTS // multicount)
        assert found[0]["geometry"]["type"] == ("Point" if multicount == 1 else "MultiPoint")
