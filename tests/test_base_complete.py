"""A LAS file that was cut anywhere is not taken for whole; a whole one is."""

from __future__ import annotations

import json
import subprocess

import numpy as np
import pytest

from pdal_stages.base.errors import StageError
from pdal_stages.base.lascheck import check_complete

COUNT = 300
FAUX = {"type": "readers.faux", "count": COUNT, "mode": "uniform", "bounds": "([0,100],[0,100],[0,9])"}
CASES = {
    "a.las": {"type": "writers.las"},
    "b.laz": {"type": "writers.las", "compression": "laszip"},
    "c.las": {"type": "writers.las", "minor_version": 4, "dataformat_id": 6, "extra_dims": "all"},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory, pdal_program):
    path = tmp_path_factory.mktemp("formats")
    for name, writer in CASES.items():
        stages = [
            FAUX,
            {**writer, "filename": name},
        ]
        (path / "job.json").write_text(json.dumps(stages))
        subprocess.run([pdal_program, "pipeline", "job.json"], cwd=path, check=True)
    return path


@pytest.mark.pdal
@pytest.mark.parametrize("name", CASES)
def test_cut_files_are_refused(folder, tmp_path, name):
    content = (folder / name).read_bytes()
    path = tmp_path / name
    count = COUNT
    writer = {**CASES[name], "filename": name}
    bare = {"filename": name}  # where PDAL chose the writer
    path.write_bytes(content)
    assert check_complete(path, name, writer, count) and check_complete(path, name, writer)
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
    path.write_bytes(content)
    with pytest.raises(StageError, match="could not be written completely"):
        check_complete(path, name, writer, count + 1)


def test_other_formats_are_held_against_disk_and_limits(tmp_path, monkeypatch):
    path = tmp_path / "x.tif"
    path.write_bytes(b"x" * 100)
    writer = {"type": "writers.gdal", "filename": "x.tif"}
    assert not check_complete(path, path, writer)
    monkeypatch.setattr("pdal_stages.base.lascheck._largest_file", lambda: 100)
    with pytest.raises(StageError, match="Make room"):
        check_complete(path, path, writer)
    monkeypatch.undo()
    monkeypatch.setattr("pdal_stages.base.lascheck.disk_is_full", lambda path: True)
    with pytest.raises(StageError, match="Make room"):
        check_complete(path, path, writer)
