"""What other programs left beside an output does not come back into the one that replaces it."""

from __future__ import annotations

import mmap
import sqlite3
import subprocess
import sys
from contextlib import closing

import laspy
import numpy as np
import pytest

import pdal_stages as ps
from pdal_stages import cli
from pdal_stages.base.companions import companions_of
from pdal_stages.base.files import write_whole
from pdal_stages.synthetic import write_town

pyogrio = pytest.importorskip("pyogrio")
pytest.importorskip("shapely")

#: Open a GeoPackage as QGIS does, change it, and either die or stay.
_PROGRAM = """
import os, sqlite3, sys, time
path, mode, end = sys.argv[1:]
base = sqlite3.connect(path, isolation_level=None)
base.execute(f"PRAGMA journal_mode={mode}")
base.execute("PRAGMA cache_size=1")
base.execute("BEGIN")
base.execute("CREATE TABLE left_behind(text)")
base.executemany("INSERT INTO left_behind VALUES (?)", [("x" * 2000,)] * 2000)
if mode == "WAL":
    base.execute("COMMIT")
print("ready", flush=True)
if end == "dies":
    os._exit(1)
time.sleep(600)
"""


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    path = tmp_path_factory.mktemp("town") / "town.laz"
    write_town(ps.make_town(60.0, 8.0, seed=4, progress=False), path)
    las = laspy.read(path)
    las.add_extra_dim(laspy.ExtraBytesParams("Reliability", "f4"))
    las.Reliability = np.full(len(las), 0.7)
    las.write(path)
    return path


def start(path, mode, end):
    """Return a program that holds a changed GeoPackage, or that has died with it."""
    words = [sys.executable, "-c", _PROGRAM, str(path), mode, end]
    program = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    assert program.stdout.readline() == "ready\n"
    if end == "dies":
        program.wait()
        program.stdout.close()
    return program


def layers(path):
    with closing(sqlite3.connect(path)) as base:
        assert base.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    return {str(name) for name, _ in pyogrio.list_layers(path)}


@pytest.mark.parametrize("mode", ["WAL", "DELETE"])
@pytest.mark.parametrize("command", ["objects", "review"])
def test_the_journal_of_a_program_that_died_is_gone(town, tmp_path, command, mode):
    out = tmp_path / "out.gpkg"
    assert cli.main([command, str(town), str(out)]) == 0
    before = layers(out)
    start(out, mode, "dies")
    assert {path.name for path in companions_of(out)} & {"out.gpkg-wal", "out.gpkg-journal"}
    assert cli.main([command, str(town), str(out)]) == 0
    assert layers(out) == before
    assert [path.name for path in tmp_path.iterdir()] == ["out.gpkg"]


def test_a_geopackage_that_is_open_elsewhere_is_refused(town, tmp_path, capsys):
    out = tmp_path / "out.gpkg"
    assert cli.main(["objects", str(town), str(out)]) == 0
    program = start(out, "WAL", "stays")
    try:
        capsys.readouterr()
        assert cli.main(["objects", str(town), str(out)]) == 1
        assert "is open in another program" in capsys.readouterr().err
    finally:
        program.kill()
        program.communicate()
    with closing(sqlite3.connect(out)) as base:
        assert base.execute("SELECT count(*) FROM left_behind").fetchone() == (2000,)


def test_an_idle_reader_keeps_the_old_file_and_cannot_write_into_the_new_one(town, tmp_path):
    """A reader without a log holds no lock: the file that it has open stays, without a name."""
    out = tmp_path / "out.gpkg"
    assert cli.main(["objects", str(town), str(out)]) == 0
    with closing(sqlite3.connect(out)) as reader:
        reader.execute("CREATE TABLE left_behind(text)")
        reader.commit()
        assert cli.main(["objects", str(town), str(out)]) == 0
        assert reader.execute("SELECT count(*) FROM left_behind").fetchone() == (0,)
        with pytest.raises(sqlite3.OperationalError, match="readonly"):
            reader.execute("INSERT INTO left_behind VALUES ('x')")
    assert "left_behind" not in layers(out)
    assert [path.name for path in tmp_path.iterdir()] == ["out.gpkg"]


@pytest.mark.parametrize("name", ["o.tif", "o.shp", "o.laz"])
def test_whoever_reads_a_file_keeps_what_he_has_open(tmp_path, name):
    path = tmp_path / name
    write_whole(path, b"old values")
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as mapped:
        write_whole(path, b"new ones")
        assert file.read() == mapped[:] == b"old values"
    assert path.read_bytes() == b"new ones"


def test_indexes_of_a_shapefile_are_gone(town, tmp_path):
    for ending in (".qix", ".sbn", ".SBX", ".dbf"):
        (tmp_path / f"o_buildings{ending}").write_bytes(b"old")
    (tmp_path / "o_buildings_more.qix").write_bytes(b"another file's")
    assert cli.main(["objects", str(town), str(tmp_path / "o.shp")]) == 0
    left = {path.name for path in tmp_path.glob("o_buildings*")}
    assert left == {f"o_buildings.{e}" for e in ("shp", "shx", "dbf", "prj", "cpg", "qml")} | {
        "o_buildings_more.qix"
    }
    assert (tmp_path / "o_buildings.dbf").read_bytes() != b"old"


@pytest.mark.pdal
def test_statistics_and_overviews_of_a_raster_are_gone(town, tmp_path):
    for ending in (".tif.ovr", ".tif.aux.xml", ".tfw"):
        (tmp_path / f"o{ending}").write_bytes(b"old")
    writer = {"type": "writers.gdal", "filename": str(tmp_path / "o.tif"), "resolution": 2}
    ps.run_pipeline([str(town), writer])
    assert [path.name for path in tmp_path.iterdir()] == ["o.tif"]


def test_links_keep_nothing_beside_them_or_beside_the_file(tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "o.laz").write_bytes(b"old")
    for name in ("o.lax", "data/o.lax"):
        (tmp_path / name).write_bytes(b"old")
    (tmp_path / "o.laz").symlink_to(tmp_path / "data" / "o.laz")
    write_whole(tmp_path / "o.laz", b"new")
    assert sorted(path.name for path in tmp_path.rglob("*.l*")) == ["o.laz", "o.laz"]
