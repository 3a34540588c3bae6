"""A run of which nothing is left to be done says so without reading its inputs."""

from __future__ import annotations

import os

import numpy as np
import pytest

from pdal_stages.tiling import run_tiled, tiledrun

pytestmark = pytest.mark.pdal


@pytest.fixture
def again(tmp_path, write_las, monkeypatch):
    """Runs over two files, briefly, and whether it looked into them."""
    rng = np.random.default_rng(1)
    for name, west in (("a", 0), ("b", 30)):
        x, y, z = rng.uniform(0, 30, (3, 500))
        write_las(tmp_path / f"{name}.las", {"X": x + west, "Y": y, "Z": z})
    (tmp_path / "out").mkdir()
    looked = []
    real = tiledrun.Survey
    monkeypatch.setattr(tiledrun, "Survey", lambda *given: looked.append(1) or real(*given))

    def run(tile=20.0, cell=5.0, **options):
        looked.clear()
        stages = [
            str(tmp_path / "*.las"),
            {"type": "filters.hag_minima", "cell": cell},
            {"type": "writers.las", "filename": str(tmp_path / "out" / "c_#.las"), "extra_dims": "all"},
        ]
        options = {"resume": True, "brief": True, "progress": False, **options}
        done = run_tiled(stages, tile, workers=0, **options)
        assert not done.failures
        return done, bool(looked)

    run(resume=False)
    return run


def test_nothing_is_left_to_be_done(again):
    run, looked = again()
    assert not looked and run.tiles == [] and run.summary["states"] == {"done": 0, "kept": 6, "failed": 0}
    assert "nothing is to be done: all of 2 outputs" in run.messages[0]
    run, looked = again(brief=False)
    assert looked and len(run.tiles) == 6
    assert not again()[1]


def test_what_was_touched_is_looked_into(again, tmp_path):
    status = os.stat(tmp_path / "a.las")
    text = (tmp_path / "a.las").read_bytes()
    (tmp_path / "a.las").write_bytes(text)
    os.utime(tmp_path / "a.las", ns=(status.st_atime_ns, status.st_mtime_ns))
    run, looked = again()  # the same content and time of change, but touched
    assert looked and run.summary["states"] == {"done": 0, "kept": 6, "failed": 0}
    assert not again()[1]


@pytest.mark.parametrize("how", ["output", "option", "input", "new"])
def test_what_changed_is_done(again, tmp_path, how, write_las):
    if how == "output":
        (tmp_path / "out" / "c_a.las").unlink()
    if how == "input":
        write_las(tmp_path / "a.las", {"X": np.ones(9), "Y": np.ones(9), "Z": np.arange(9.0)})
    if how == "new":
        write_las(tmp_path / "c.las", {"X": np.full(9, 55.0), "Y": np.ones(9), "Z": np.arange(9.0)})
    run, looked = again(cell=4.0 if how == "option" else 5.0)
    assert looked and any(out.state == "done" for out in run.outputs)
    assert not again(cell=4.0 if how == "option" else 5.0)[1]


def test_another_run_between_is_not_forgotten(again):
    again(cell=4.0)
    run, looked = again()
    assert looked and {out.state for out in run.outputs} == {"done"}


def test_another_side_is_not_the_same_run(again):
    assert again(tile=15.0)[1]
    assert not again(tile=15.0)[1]


def test_a_first_run_says_that_it_compiles(again, monkeypatch, capsys):
    """Workers do not: they show no progress of their own."""
    for count, asked, said in ((0, None, True), (0, False, False), (1, None, False)):
        monkeypatch.setattr(tiledrun, "kept_kernels", lambda count=count: count)
        again(resume=False, progress=asked)
        assert ("compiling for this processor first" in capsys.readouterr().err) == said
