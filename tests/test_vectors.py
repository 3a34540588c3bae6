"""`writers.ogr` after our stages: PDAL 2.2 takes from memory which dimension is the measure, and crashes."""

from __future__ import annotations

import json

import pytest

from pdal_stages.pipeline.run import Pipeline

pytestmark = pytest.mark.pdal
POINTS = 3000
FAUX = {"type": "readers.faux", "count": POINTS, "mode": "ramp", "bounds": "([0,60],[0,60],[0,9])"}


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
        features = json.loads(out.read_text())["features"]
        assert len(features) == -(-POINTS // multicount)
        assert features[0]["geometry"]["type"] == ("Point" if multicount == 1 else "MultiPoint")
