"""What would fail in every tile is found before the first, in a dry run too, and names the user's own stage."""

from __future__ import annotations

import json

import numpy as np
import pytest

import pdal_stages as ps
from pdal_stages import run_tiled
from pdal_stages.tiling import plan_run as run

pytestmark = pytest.mark.pdal

WRITER = {"type": "writers.las", "filename": "out_#.las"}
HEIGHTS = {"type": "filters.hag_minima", "cell": 5}


@pytest.mark.parametrize("dry_run", [True, False])
@pytest.mark.parametrize(
    ("stages", "line", "words"),
    [
        (
            [{"type": "filters.modelclassifier", "model": "standard"}, WRITER],
            "",
            "HeightAboveGround' is missing",
        ),
        ([HEIGHTS, {**WRITER, "forwrd": "all"}], "line 5", "forwrd"),
        (
            [HEIGHTS, {"type": "filters.assign", "assignment": "Nonsense[:]=3"}, WRITER],
            "line 5",
            "Nonsense",
        ),
        ([HEIGHTS, {"type": "filters.nosuch"}, WRITER], "line 5", "filters.nosuch"),
        ([HEIGHTS, {**WRITER, "minor_version": 9}], "line 5", "minor_version"),
    ],
)
def test_it_is_found_before_the_first_tile(
    tmp_path, monkeypatch, write_las, stages, line, words, dry_run
):
    x, y, z = np.random.default_rng(0).uniform(0, 30, (3, 300))
    for name in "ab":
        write_las(tmp_path / f"{name}.las", {"X": x, "Y": y, "Z": z})
    monkeypatch.chdir(tmp_path)
    text = "[\n" + ",\n".join(json.dumps(stage) for stage in ["a.las", "b.las", *stages]) + "\n]"
    (tmp_path / "job.json").write_text(text)
    monkeypatch.setattr(run, "run_tile", lambda *_: pytest.fail("a tile was begun"))
    with pytest.raises(ps.StageError, match=words) as raised:
        run_tiled(tmp_path / "job.json", 20, workers=0, buffer=0, dry_run=dry_run, progress=False)
    assert line in str(raised.value)


@pytest.mark.parametrize("door", ["validate", "tiles"])
def test_outputs_stay_as_they_are(tmp_path, write_las, door):
    """PDAL's text writer empties its file as soon as it is prepared."""
    x, y, z = np.random.default_rng(0).uniform(0, 30, (3, 300))
    cloud = write_las(tmp_path / "a.las", {"X": x, "Y": y, "Z": z})
    older = tmp_path / "o_0.txt"
    older.write_text("older")
    stages = [str(cloud), HEIGHTS, str(older if door == "validate" else tmp_path / "o_#.txt")]
    if door == "validate":
        ps.Pipeline(stages).validate()
    else:
        run_tiled(stages, 20, workers=0, buffer=0, progress=False, dry_run=True)
    assert older.read_text() == "older" and not list(tmp_path.glob(".*/*.txt"))
