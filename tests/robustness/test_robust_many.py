"""Several inputs at once: tile indexes and descriptions that lie, outputs that are inputs."""

from __future__ import annotations

import json

import pytest
from robustness_kit import HAG, job

pytestmark = pytest.mark.pdal
TILES = ["--tile", 30, "--workers", 0]


def test_accuracy_without_z(command, tmp_path):
    """Points are compared by X and Y."""
    path = tmp_path / "flat.csv"
    path.write_text("X,Y,Classification\n1,2,2\n3,4,6\n")
    done = command.runs(["accuracy", path, "--reference", path])
    assert "100.00" in done.out + done.err


# ---- what names or describes many files ------------------------------------------------------------------


def _features(*names: object) -> bytes:
    rows = [
        {"type": "Feature", "geometry": None, "properties": {"location": name}} for name in names
    ]
    return json.dumps({"type": "FeatureCollection", "features": rows}).encode()


_SCHEMA = [{"name": n, "type": "signed", "size": 4, "scale": 0.01, "offset": 0} for n in "XYZ"]
_EPT = {"boundsConforming": [0, 0, 0, 60, 60, 9], "points": 100, "schema": _SCHEMA, "bounds": [0, 0, 0, 60, 60, 60], "span": 128,
        "dataType": "laszip", "hierarchyType": "json", "version": "1.0.0", "srs": {}}  # fmt: skip


def _ept(**changed) -> bytes:
    return json.dumps({**_EPT, **changed}).encode()


#: name of the file, its content, what the message must hold
LISTS = {
    "tile index that names no file": ("index.geojson", _features(), ["no column 'location'"]),
    "tile index that names a number": ("index.geojson", _features(5), ["is not a file's name"]),
    "tile index that names what is not there": ("index.geojson", _features("no.las"), ["No such file", "no.las"]),
    "tile index that names itself": ("index.geojson", _features("index.geojson"), ["not a LAS or LAZ file"]),
    "tile index nested 100,000 deep": ("index.geojson", b"[" * 100_000, ["GDAL knows no format"]),
    "tile index that is no database": ("index.gpkg", b"no database", ["GDAL knows no format"]),
    "EPT that is no JSON": ("ept.json", b"no", ["the EPT source is damaged"]),
    "EPT without bounds": ("ept.json", _ept(boundsConforming=[]), ["the EPT source is damaged"]),
    "EPT beyond its octree": ("ept.json", _ept(boundsConforming=[-1e12, -1e12, 0, 1e12, 1e12, 9]), ["its points lie outside its octree"]),
    "EPT whose coordinates PDAL would round": ("ept.json", _ept(dataType="binary"), ["to whole numbers"]),
    "EPT of -5 points": ("ept.json", _ept(points=-5), ["not a valid description"]),
    "EPT without its data": ("ept.json", _ept(), ["the EPT source is damaged"]),
}  # fmt: skip


@pytest.mark.parametrize("case", LISTS)
def test_lists_of_files(command, tmp_path, case):
    name, content, says = LISTS[case]
    (tmp_path / name).write_bytes(content)
    kind, tiles = ("readers.ept", []) if name == "ept.json" else ("readers.tindex", TILES)
    read = {"type": kind, "filename": str(tmp_path / name)}
    command.refused(["pipeline", job(tmp_path, read, HAG, tmp_path / "o_#.las"), *tiles], *says)
