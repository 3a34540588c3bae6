"""Rasters that PDAL writes of tiles: one grid, empty ones where nothing is left, LAS files beside them."""

from __future__ import annotations

import numpy as np
import pytest

import pdal_stages as ps
from pdal_stages.tiling import run_tiled
from pdal_stages.tiling.writeroptions import on_one_grid

WRITER = {"type": "writers.gdal", "filename": "r_#.tif", "resolution": 0.2}


@pytest.mark.parametrize("side", [0.2, 0.3, 1.0, 2.5])
@pytest.mark.parametrize("tile", [(3, -2), (1541098, 12555100)])
def test_rasters_of_tiles_adjoin(side, tile):
    writer = {**WRITER, "resolution": side}
    size = 15.0

    def placed(i, j):
        (made,) = on_one_grid([writer], (i * size, j * size, (i + 1) * size, (j + 1) * size), half_open=True)
        return [round(made[name] / side) for name in ("origin_x", "origin_y")], made["width"], made["height"]

    (left, bottom), width, height = placed(*tile)
    (right, _), _, _ = placed(tile[0] + 1, tile[1])
    (_, top), _, _ = placed(tile[0], tile[1] + 1)
    assert (right - left, top - bottom) == (width, height) == (round(size / side),) * 2


def test_points_on_the_edge_of_a_file_have_a_cell():
    (made,) = on_one_grid([WRITER], (0.1, 0.0, 2.0, 1.99), half_open=False)
    assert (made["origin_x"], made["width"], made["height"]) == (0.0, 11, 10)


def test_what_is_placed_or_moved_stays():
    placed = {**WRITER, "origin_x": 1}
    moving = [{"type": "filters.reprojection", "out_srs": "EPSG:4326"}, WRITER]
    assert on_one_grid([placed], (0, 0, 1, 1), half_open=True) == [placed]
    assert on_one_grid(moving, (0, 0, 1, 1), half_open=True) == moving


@pytest.mark.pdal
@pytest.mark.parametrize("per", ["tile", "file"])
def test_rasters_beside_las_files(tmp_path, write_las, per):
    rng = np.random.default_rng(2)
    x, y = rng.uniform(0.3, 39.7, (2, 4000))
    codes = np.where(x < 20, 2, 5).astype(np.uint8)  # no ground in the east
    arrays = {"X": x, "Y": y, "Z": x / 10, "Classification": codes}
    source = str(write_las(tmp_path / "a.las", arrays, minor_version=2))
    stages = [
        source,
        {"type": "filters.hag_minima", "cell": 5},
        {"type": "writers.las", "filename": str(tmp_path / "c_#.las"), "extra_dims": "all", "forward": "all"},
        {"type": "filters.range", "limits": "Classification[2:2]"},
        {
            "type": "writers.gdal",
            "filename": str(tmp_path / "r_#.tif"),
            "resolution": 1,
            "output_type": "max",
        },
    ]
    stages = [*stages[:2], stages[3], stages[2], stages[4]]
    run = run_tiled(stages, 20, workers=0, per=per, progress=False)
    assert not run.failures
    assert any("cells at its edge" in line for line in run.messages)
    found = sorted(tmp_path.glob("r_*.tif"))
    assert len(found) == (4 if per == "tile" else 1)
    for path in found:
        (cells,) = ps.run_pipeline([{"type": "readers.gdal", "filename": str(path), "header": "Z"}]).arrays
        wide = 20 if per == "tile" else 40
        assert len(cells) == wide * wide
        assert np.array_equal(np.unique(cells["X"] % 1), [0.5]) and np.array_equal(
            np.unique(cells["Y"] % 1), [0.5]
        )
        there = cells["Z"] != -9999
        assert not there[cells["X"] > 21].any()
        assert there[cells["X"] < 19].all()
