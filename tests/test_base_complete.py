"""A LAS file that was cut anywhere is not taken for whole; a whole one is."""

from __future__ import annotations

import json
import subprocess

import numpy as np
import pytest

from pdal_stages.base.errors import StageError
from pdal_stages.base.las_check import check_complete

COUNT = 300
BOUNDS = "([0,100],[0,100],[0,9])"
FAUX = {"type": "readers.faux", "count": COUNT, "mode": "uniform", "bounds": BOUNDS}
CASES = {
    "a.las": {},
    "b.laz": {"compression": "laszip"},
    "c.las": {"minor_version": 4, "dataformat_id": 6, "extra_dims": "all"},
}


@pytest.mark.pdal
@pytest.mark.parametrize("name", CASES)
def test_cut_files_are_refused(tmp_path, pdal_program, name):
    path, writer = tmp_path / name, {"type": "writers.las", "filename": name, **CASES[name]}
    (tmp_path / "job.json").write_text(json.dumps([FAUX, writer]))
    subprocess.run([pdal_program, "pipeline", "job.json"], cwd=tmp_path, check=True)
    content = path.read_bytes()
    check_complete(path, name, writer, COUNT)
    with pytest.raises(StageError, match="could not be written completely"):
        check_complete(path, name, writer, COUNT + 1)
    size = len(content)
    lengths = np.random.default_rng(1).integers(0, size, 40).tolist()
    for length in (0, 1, size // 2, size - 2, size - 1, *lengths):
        path.write_bytes(content[:length])
        with pytest.raises(StageError, match="could not be written completely"):
            check_complete(path, name, writer, COUNT)
