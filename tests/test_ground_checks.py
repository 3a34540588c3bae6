"""PDAL's heights where no point is ground: an error, where PDAL 2.2 ends the process; and else nothing but PDAL's."""

from __future__ import annotations

import subprocess

import laspy
import numpy as np
import pytest

import pdal_stages as ps
from pdal_stages.base.errors import StageError
from pdal_stages.pipeline import pdal as pdal_env

pytestmark = pytest.mark.pdal
TYPES = ("filters.hag_nn", "filters.hag_delaunay")


def write(path, codes):
    las = laspy.LasData(laspy.LasHeader(version="1.4", point_format=6))
    las.header.scales = np.full(3, 0.001)
    las.x, las.y, las.z = np.random.default_rng(0).uniform(0, 30, (3, len(codes)))
    las.classification = np.asarray(codes, np.uint8)
    las.write(path)
    return str(path)


def stages(source, kind, target, **more):
    return [{"type": "readers.las", "filename": source, "tag": "in"}, {"type": kind, "tag": "h", **more},
            {"type": "writers.las", "filename": str(target), "extra_dims": "all", "minor_version": 4}]  # fmt: skip


@pytest.mark.parametrize("kind", TYPES)
@pytest.mark.parametrize("more", [{}, {"inputs": ["in"]}], ids=["", "inputs"])
def test_no_ground_is_an_error(tmp_path, kind, more):
    if pdal_env.version() >= (2, 9, 0):
        pytest.skip("PDAL 2.9 and newer go on without ground")
    source = write(tmp_path / "a.las", [1] * 90 + [5] * 10)
    job = ps.Pipeline(stages(source, kind, tmp_path / "o.las", **more))
    with pytest.raises(StageError, match="no ground was found") as caught:
        job.execute()
    for words in (f"{kind} (tag 'h')", "100 points of class 1, 5", "filters.smrf"):
        assert words in str(caught.value)
    assert not (tmp_path / "o.las").exists()
    tiles = stages(str(tmp_path / "a.las"), kind, tmp_path / "o_#.las")
    run = ps.run_tiled(tiles, 20, workers=0, buffer=5.0, progress=False)
    assert len(run.failures) >= 4 and "no ground was found" in run.failures[0][1]


@pytest.mark.parametrize("kind", TYPES)
@pytest.mark.parametrize("codes", [[2] * 50 + [1] * 50, [2] * 100])
def test_heights_are_those_of_pdal(tmp_path, kind, codes, pdal_program):
    source = write(tmp_path / "a.las", codes)
    job = ps.Pipeline(stages(source, kind, tmp_path / "ours.las"))
    job.execute()
    words = ["--writers.las.extra_dims=all", "--writers.las.minor_version=4"]
    files = ["translate", source, tmp_path / "stock.las", kind.partition(".")[2]]
    subprocess.run([pdal_program, *files, *words], check=True, capture_output=True)
    ours, stock = (laspy.read(tmp_path / f"{name}.las") for name in ("ours", "stock"))
    np.testing.assert_array_equal(ours["HeightAboveGround"], stock["HeightAboveGround"])
    assert "filters.python" not in job.metadata["metadata"]


def test_no_points_are_no_error(tmp_path):
    cut = {"type": "filters.range", "limits": "Z[-9:-8]"}
    source = write(tmp_path / "a.las", [1] * 100)
    first, *rest = stages(source, "filters.hag_nn", tmp_path / "o.las")
    assert ps.Pipeline([first, cut, *rest]).execute() == 0
