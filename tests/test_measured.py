"""What runs note of their pace, and what a dry run makes of it."""

from __future__ import annotations

import json
import os

import numpy as np
import pytest

from pdal_stages.cli import main
from pdal_stages.tiling import measured
from pdal_stages.tiling.outcome import TiledRun, TileJob

HEAD = [{"type": "filters.modelclassifier", "model": "/somewhere/a.model"}]


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path / "cache"))
    monkeypatch.setattr(measured.sys, "platform", "linux")
    return tmp_path / "cache" / "pdal-stages" / "measured.json"


def run_of(*tiles, **steps):
    """Tiles of so many points, read points and CPU seconds."""
    jobs = [
        TileJob(
            (n, 0), f"{n}_0", own, [], state="done", record={"points": own, "read": read, "cpu_seconds": cpu}
        )
        for n, (own, read, cpu) in enumerate(tiles)
    ]
    return TiledRun(jobs, [], {}, [], [], {"cpu_seconds_by_step": steps})


def test_the_middle_tile_tells_the_pace():
    tiles = [
        (100_000, 200_000, 99.0),
        (100_000, 200_000, 1.16),
        (100_000, 200_000, 1.16),
    ]  # the first compiled
    pace = measured.pace_of(run_of(*tiles, index=1.0, outputs=2.0, tiles=101.32))
    assert pace.tile_seconds == pytest.approx(1e-5) and pace.other_seconds == pytest.approx(1e-5)
    assert pace.core_seconds(1e6, 1e6) == pytest.approx(11.6 + 10.0)
    assert measured.pace_of(run_of((100_000, 200_000, 1.0), tiles=1.0)) is None  # too few points


def test_a_pace_is_kept_for_its_stages(cache):
    assert measured.pace_before(HEAD) is measured.ASSUMED
    measured.remember(run_of((300_000, 400_000, 3.0), tiles=3.0), HEAD)
    known = measured.pace_before([{**HEAD[0], "where": "X < 3"}])
    assert known.points == 300_000 and known.tile_seconds == pytest.approx(3.0 / 316_000)
    assert measured.pace_before([{"type": "filters.hag_minima"}]) is measured.ASSUMED
    for number in range(60):
        measured.remember(run_of((300_000, 400_000, 3.0), tiles=3.0), [{"type": f"filters.t{number}"}])
    assert len(json.loads(cache.read_text())) == 50 and measured.pace_before(HEAD) is measured.ASSUMED


@pytest.mark.parametrize("content", ["", "[]", "{", '{"a": 1}', "null", "[" * 100_000])
def test_a_damaged_note_is_none(cache, content):
    cache.parent.mkdir(parents=True)
    cache.write_text(content)
    assert measured.pace_before(HEAD) is measured.ASSUMED
    measured.remember(run_of((300_000, 400_000, 3.0), tiles=3.0), HEAD)
    assert measured.pace_before(HEAD).points == 300_000
    known = json.loads(cache.read_text())
    for key in known:
        known[key] = {"tile_seconds": -1, "other_seconds": 0, "points": 3, "day": "2026-11-23"}
    cache.write_text(json.dumps(known))
    assert measured.pace_before(HEAD) is measured.ASSUMED


def test_no_place_for_notes_is_no_harm(cache):
    cache.parent.parent.write_text("a file")
    measured.remember(run_of((300_000, 400_000, 3.0), tiles=3.0), HEAD)
    assert measured.pace_before(HEAD) is measured.ASSUMED


def test_no_home_is_no_harm(monkeypatch):
    def homeless(path):
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(measured.Path, "expanduser", homeless)
    measured.remember(run_of((300_000, 400_000, 3.0), tiles=3.0), HEAD)
    assert measured.pace_before(HEAD) is measured.ASSUMED


@pytest.mark.pdal
def test_a_dry_run_tells_the_pace_of_the_run_before_and_the_disk(tmp_path, write_las, capsys, monkeypatch):
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, 100, (2, 30_000))
    (tmp_path / "in").mkdir()
    arrays = {"X": x, "Y": y, "Z": np.zeros(30_000), "Classification": np.ones(30_000, "u1")}
    write_las(tmp_path / "in" / "a.las", arrays)
    stages = [
        str(tmp_path / "in" / "a.las"),
        {"type": "filters.hag_minima", "cell": 5},
        {"type": "writers.las", "filename": str(tmp_path / "#_out.las"), "extra_dims": "all"},
    ]
    (tmp_path / "job.json").write_text(json.dumps(stages))
    words = ["pipeline", str(tmp_path / "job.json"), "--tile", "50", "--workers", "0", "--no-progress"]
    dry = [*words, "--dry-run", "--report", str(tmp_path / "dry.json")]
    assert main(dry) == 0 and "no run was measured here yet" in capsys.readouterr().out
    told = json.loads((tmp_path / "dry.json").read_text())
    copies = 30_000 * (20 + 8)  # of points of format 3 or another
    assert told["measured"] is None and told["disk_gb_of_copies"] * 1e9 >= copies
    assert told["disk_gb"] * 1e9 == pytest.approx(told["disk_gb_of_copies"] * 1e9 + 30_000 * 20)
    monkeypatch.setattr(measured, "_ENOUGH", 20_000)
    monkeypatch.setattr(measured, "_ENOUGH_OF_TILE", 1_000)
    assert main(words) == 0 and capsys.readouterr()
    assert main(dry) == 0 and "as in a run of 30,000 points here on" in capsys.readouterr().out
    after = json.loads((tmp_path / "dry.json").read_text())
    assert after["measured"]["points"] == 30_000 and after["core_hours"] != told["core_hours"]
    assert os.listdir(tmp_path / "cache" / "pdal-stages") == ["measured.json"]
