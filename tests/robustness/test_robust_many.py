"""Several inputs at once: references that differ, tile indexes and descriptions that lie, odd names."""

from __future__ import annotations

import json
import os
import struct
import sys
from pathlib import Path

import pytest
from conftest import scene
from robustness_kit import job

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from test_references import DEGREES, FEET, METERS, OTHER

pytestmark = pytest.mark.pdal
HAG = {"type": "filters.hag_minima"}

PAIRS = [
    ("meters beside feet", METERS, FEET, ["different units of length"]),
    ("meters beside degrees", METERS, DEGREES, ["degrees", "b.las"]),
    ("two zones of one projection", METERS, OTHER, ["different reference systems"]),
    ("feet beside no reference", FEET, None, ["different units of length", "no reference says otherwise"]),
]


@pytest.mark.parametrize("tiles", [False, True], ids=["whole", "tiles"])
@pytest.mark.parametrize(("case", "one", "two", "says"), PAIRS, ids=[row[0] for row in PAIRS])
def test_references(cell, tmp_path, write_las, case, one, two, says, tiles):
    for name, wkt, shift in (("a", one, 0), ("b", two, 30)):
        points = scene()
        write_las(tmp_path / f"{name}.las", {**points, "X": points["X"] + shift}, point_format=6, wkt=wkt)
    path = job(tmp_path, {"type": "readers.las", "filename": str(tmp_path / "?.las")}, HAG,
               {"type": "writers.las", "filename": str(tmp_path / "out" / ("#.las" if tiles else "o.las"))})  # fmt: skip
    (tmp_path / "out").mkdir()
    it = cell("Clouds", f"{'in tiles: ' if tiles else ''}{case}")
    it.refused(["pipeline", path, *(["--tile", 30, "--workers", 0] if tiles else [])], *says)


def test_accuracy_without_z(cell, tmp_path):
    path = tmp_path / "flat.csv"
    path.write_text("X,Y,Classification\n1,2,2\n3,4,6\n")
    it = cell("Clouds", "accuracy of a cloud without Z")
    done = it.runs(["accuracy", path, "--reference", path], "points are compared by X and Y")
    assert "100.00" in done.out + done.err


def test_bins_of_another_kind(cell, tmp_path, cloud):
    (tmp_path / "bins.json").write_text('{"older": 1}')
    path = job(tmp_path, str(cloud), {"type": "filters.multiscalefeatures", "neighborhoods": "c1", "feature_set": "D1",
               "bins": str(tmp_path / "bins.json")}, {"type": "writers.las", "filename": str(tmp_path / "o.las")})  # fmt: skip
    cell("Options", "bins that name another JSON file").refused(
        ["pipeline", path], "is not a file of thresholds", "without bins"
    )


# ---- what names or describes many files ------------------------------------------------------------------


def _dbf(rows: int, *names: bytes) -> bytes:
    field = b"location".ljust(11, b"\0") + b"C" + bytes(4) + b"\x14" + bytes(15)
    head = struct.pack("<B3xIHH20x", 3, rows, 65, 21)
    return head + field + b"\r" + b"".join(b" " + name.ljust(20) for name in names)


def _features(*names: object) -> bytes:
    return json.dumps({"features": [{"properties": {"location": name}} for name in names]}).encode()


INDEXES = [
    ("tile index of four billion rows", ".dbf", _dbf(2**32 - 1, b"a.las"), ["4,294,967,295 rows"]),
    ("tile index cut in its columns", ".dbf", _dbf(1)[:40], ["cannot be read"]),
    ("tile index that names no file", ".geojson", _features(), ["names no file"]),
    ("tile index that names a number", ".geojson", _features(5), ["5 is not a file's name"]),
    ("tile index that names a NUL", ".geojson", _features("a\0.las"), ["is not a file's name"]),
    (
        "tile index that names files that are not there",
        ".geojson",
        _features("no.las", "nor.las"),
        ["No such file", "no.las"],
    ),
    ("tile index that names itself", ".geojson", _features("index.geojson"), ["not a LAS or LAZ file"]),
    ("tile index nested 100,000 deep", ".geojson", b"[" * 100_000, ["cannot be read"]),
    ("tile index that is no database", ".gpkg", b"SQLite format 3\0" + b"\xff" * 2000, ["cannot be read"]),
]


@pytest.mark.parametrize(("case", "suffix", "content", "says"), INDEXES, ids=[row[0] for row in INDEXES])
def test_tile_indexes(cell, tmp_path, case, suffix, content, says):
    (tmp_path / f"index{suffix}").write_bytes(content)
    name = tmp_path / f"index{'.shp' if suffix == '.dbf' else suffix}"
    path = job(tmp_path, {"type": "readers.tindex", "filename": str(name)}, HAG,
               {"type": "writers.las", "filename": str(tmp_path / "o_#.las")})  # fmt: skip
    cell("Clouds", case).refused(["pipeline", path, "--tile", 30, "--workers", 0], *says)


_SCHEMA = [{"name": n, "type": "signed", "size": 4, "scale": 0.01, "offset": 0} for n in "XYZ"]
_EPT = {"boundsConforming": [0, 0, 0, 60, 60, 9], "points": 100, "schema": _SCHEMA, "bounds": [0, 0, 0, 60, 60, 60], "span": 128,
        "dataType": "binary", "hierarchyType": "json", "version": "1.0.0", "srs": {}}  # fmt: skip
EPTS = [
    ("EPT description that is no JSON", b"no", ["cannot be read"]),
    ("EPT description without bounds", {**_EPT, "boundsConforming": []}, ["cannot be read"]),
    ("EPT description of 1e300 m", {**_EPT, "boundsConforming": [-1e300, -1e300, 0, 1e300, 1e300, 9]}, ["can be read"]),
    ("EPT description of -5 points", {**_EPT, "points": -5}, ["a description of nothing"]),
    ("EPT description without its data", _EPT, ["PDAL"]),
    ("EPT description with a scale of text", {**_EPT, "schema": [{**_SCHEMA[0], "scale": "x"}, *_SCHEMA[1:]]}, ["PDAL"]),
]  # fmt: skip


@pytest.mark.parametrize(("case", "content", "says"), EPTS, ids=[row[0] for row in EPTS])
def test_ept(cell, tmp_path, case, content, says):
    (tmp_path / "ept.json").write_bytes(
        content if isinstance(content, bytes) else json.dumps(content).encode()
    )
    path = job(tmp_path, {"type": "readers.ept", "filename": str(tmp_path / "ept.json")}, HAG,
               {"type": "writers.las", "filename": str(tmp_path / "o_#.las")})  # fmt: skip
    cell("Clouds", case).refused(["pipeline", path, "--tile", 30, "--workers", 0], *says)


def test_latin_1_beside_others(cell, tmp_path, cloud):
    try:
        (tmp_path / os.fsdecode(b"gr\xfcn.las")).write_bytes(cloud.read_bytes())
    except OSError:
        pytest.skip("this file system has UTF-8 names only")
    path = job(tmp_path, {"type": "readers.las", "filename": str(tmp_path / "*.las")}, HAG,
               {"type": "writers.las", "filename": str(tmp_path / "o_#.laz")})  # fmt: skip
    it = cell("Environment", "in tiles: file name in Latin-1")
    it.refused(
        ["pipeline", path, "--tile", 30, "--workers", 0],
        "the name of the file is not UTF-8",
        "Rename the file",
    )


# ---- many files, one output each ------------------------------------------------------------------------------


def test_an_output_that_is_another_input(cell, tmp_path, cloud, model):
    for name in ("a.las", "c_a.las"):
        (tmp_path / name).write_bytes(cloud.read_bytes())
    it = cell("Outputs", "classify of many files, one onto another")
    words = ["classify", tmp_path / "a.las", tmp_path / "c_a.las", tmp_path / "c_#.las", "--model", model]
    it.refused(words, "the output file is one of the inputs", "c_a.las")
    assert (tmp_path / "c_a.las").read_bytes() == cloud.read_bytes()


def test_modules_that_lie_about(cell, tmp_path, cloud, model):
    """Workers import nothing from the current folder."""
    for name in ("signal", "struct", "numpy", "laspy", "pickle"):
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'taken')!r}, 'a').write('{name} ')\n")
    for name in ("a.las", "b.las"):
        (tmp_path / name).write_bytes(cloud.read_bytes())
    start = f"import sys; sys.path[0] = {str(Path(__file__).parents[2])!r}; from pdal_stages.cli import main; sys.exit(main())"
    it = cell("Environment", "classify of many files with workers, in a folder with a signal.py")
    words = ["classify", "a.las", "b.las", "c_#.las", "--workers", 2, "--model", model]
    environment = {"PYTHONPATH": None}
    done = it.process(*words, command=[sys.executable, "-c", start], env=environment)
    it.runs(done, "is not taken for Python's own")
    assert (tmp_path / "c_a.las").exists() and not (tmp_path / "taken").exists()
