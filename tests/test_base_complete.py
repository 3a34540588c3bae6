"""A file that was cut anywhere is not taken for whole, in any format that PDAL writes; a whole one is."""

from __future__ import annotations

import json
import subprocess

import numpy as np
import pytest

from pdal_stages.base.complete import _JUDGES, check_complete
from pdal_stages.base.errors import StageError

COUNT = 300
FAUX = {"type": "readers.faux", "count": COUNT, "mode": "uniform", "bounds": "([0,100],[0,100],[0,9])"}
CASES = {
    "a.las": {"type": "writers.las"},
    "b.laz": {"type": "writers.las", "compression": "laszip"},
    "c.las": {"type": "writers.las", "minor_version": 4, "dataformat_id": 6, "extra_dims": "all"},
    "d.txt": {"type": "writers.text"},
    "e.csv": {"type": "writers.text", "write_header": False, "order": "X,Y", "keep_unspecified": False},
    "f.json": {"type": "writers.text", "format": "geojson"},
    "g.ply": {"type": "writers.ply"},
    "h.ply": {"type": "writers.ply", "storage_mode": "little endian"},
    "i.ply": {"type": "writers.ply", "storage_mode": "big endian", "faces": True},
    "j.ply": {"type": "writers.ply", "faces": True},
    "k.bpf": {"type": "writers.bpf"},
    "l.bpf": {"type": "writers.bpf", "compression": True},
    "m.pcd": {"type": "writers.pcd"},
    "n.pcd": {"type": "writers.pcd", "compression": "binary"},
    "o.sbet": {"type": "writers.sbet"},
    "p.glb": {"type": "writers.gltf"},
    "q.geojson": {"type": "writers.ogr", "measure_dim": "Z"},
    "r.shp": {"type": "writers.ogr", "measure_dim": "Z"},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory, pdal_program):
    path = tmp_path_factory.mktemp("formats")
    for name, writer in CASES.items():
        stages = [
            FAUX,
            *([{"type": "filters.delaunay"}] if name[0] in "ijp" else []),
            {**writer, "filename": name},
        ]
        (path / "job.json").write_text(json.dumps(stages))
        done = subprocess.run(
            [pdal_program, "pipeline", "job.json"], cwd=path, capture_output=True, text=True
        )
        (path / f"{name}.error").write_text(done.stderr if done.returncode else "")
    return path


@pytest.mark.pdal
@pytest.mark.parametrize("name", CASES)
def test_cut_files_are_refused(folder, tmp_path, name):
    if error := (folder / f"{name}.error").read_text():
        assert "Couldn't create" in error, error
        pytest.skip(f"{CASES[name]['type']} was left out of this build")
    content = (folder / name).read_bytes()
    path = tmp_path / name
    count = None if name == "p.glb" else COUNT
    writer = {**CASES[name], "filename": name}
    bare = {"filename": name}  # where PDAL chose the writer
    path.write_bytes(content)
    assert check_complete(path, name, writer, count) and check_complete(path, name, writer)
    if name not in ("e.csv", "f.json"):  # whose options tell
        assert check_complete(path, name, bare, count)
    rng = np.random.default_rng(1)
    lengths = {
        0,
        1,
        len(content) - 1,
        len(content) - 2,
        len(content) // 2,
        *rng.integers(0, len(content), 60).tolist(),
    }
    for length in sorted(lengths):
        path.write_bytes(content[:length])
        with pytest.raises(StageError, match="could not be written completely"):
            check_complete(path, name, writer, count)
    if count is not None and name != "f.json":
        path.write_bytes(content)
        with pytest.raises(StageError, match="could not be written completely"):
            check_complete(path, name, writer, count + 1)


@pytest.mark.pdal
def test_a_file_of_zeros_is_refused(folder, tmp_path):
    for name, writer in CASES.items():
        if (folder / f"{name}.error").read_text():
            continue
        path = tmp_path / name
        path.write_bytes(bytes((folder / name).stat().st_size))
        if name == "o.sbet":  # no header, and any number is one
            continue
        with pytest.raises(StageError):
            check_complete(path, name, {**writer, "filename": name}, COUNT)


def test_every_judged_writer_is_tested():
    assert {writer["type"] for writer in CASES.values()} >= set(_JUDGES) - {"writers.copc"}


def test_other_formats_are_held_against_disk_and_limits(tmp_path, monkeypatch):
    path = tmp_path / "x.tif"
    path.write_bytes(b"x" * 100)
    writer = {"type": "writers.gdal", "filename": "x.tif"}
    assert not check_complete(path, path, writer)
    monkeypatch.setattr("pdal_stages.base.complete._largest", lambda: 100)
    with pytest.raises(StageError, match="Make room"):
        check_complete(path, path, writer)
    monkeypatch.undo()
    monkeypatch.setattr("pdal_stages.base.complete.disk_is_full", lambda path: True)
    with pytest.raises(StageError, match="Make room"):
        check_complete(path, path, writer)
