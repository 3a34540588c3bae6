"""Tiles of filtered ground: a first round leaves the lowest points of cells; the same bits as in one piece."""

from __future__ import annotations

import json

import laspy
import numpy as np
import pytest
from test_ground_filter import town

import pdal_stages as ps
from pdal_stages import run_tiled
from pdal_stages.terrain import filtered_ground
from pdal_stages.terrain.filter_options import FilterOptions
from pdal_stages.terrain.ground_blocks import (
    BLOCK_SIDE,
    GroundCells,
    cells_of_block,
    reach_of_block,
    reduced_points,
)
from pdal_stages.terrain.smrf import reach_of_cells
from pdal_stages.tiling import plan_run as run

HEIGHTS = {"type": "filters.hag_morphological", "window": 8, "ground": True, "openings": [5, 9]}
MADE = ("HeightAboveGround", "Ground", "HeightAboveOpening_5", "HeightAboveOpening_9")
SIDE, TILE = 460, 160


@pytest.fixture(scope="module")
def survey(tmp_path_factory, write_las):
    """Two files that adjoin, with noise that is ignored by its class and some that is not."""
    folder = tmp_path_factory.mktemp("survey")
    x, y, z, height = town(3, side=SIDE, density=0.3)
    rng = np.random.default_rng(0)
    codes = np.where((height < 0) & (rng.random(len(x)) < 0.5), 7, 1).astype(np.uint8)
    paths = []
    for name, inside in (("west", x < 270), ("east", x >= 270)):
        arrays = {"X": x[inside], "Y": y[inside], "Z": z[inside], "Classification": codes[inside]}
        paths.append(str(write_las(folder / f"{name}.las", arrays)))
    return paths


def in_tiles(paths, stages, folder, **options):
    folder.mkdir(exist_ok=True)
    writer = {
        "type": "writers.las",
        "filename": str(folder / "#.las"),
        "extra_dims": "all",
        "forward": "all",
    }
    return run_tiled([*paths, *stages, writer], TILE, workers=0, progress=False, **options)


def of_files(folder, name):
    return np.concatenate(
        [np.asarray(laspy.read(folder / f"{f}.las")[name]) for f in ("west", "east")]
    )


@pytest.mark.pdal
@pytest.mark.parametrize(
    "before", [[{"type": "filters.detachednoise"}], [{"type": "filters.range", "limits": "Z[60:]"}]]
)
def test_tiles_are_the_same_bits_and_read_few_points(tmp_path, survey, before):
    run = in_tiles(survey, [*before, HEIGHTS], tmp_path / "out")
    assert not run.failures
    whole = np.concatenate(ps.run_pipeline([*survey, *before, HEIGHTS]).arrays)
    for name in MADE:
        assert np.array_equal(of_files(tmp_path / "out", name), whole[name]), name
    read = sum(job.record.read for job in run.tiles)
    ours = sum(job.record.points for job in run.tiles)
    assert read <= 1.01 * ours  # what noise marked is kept
    assert not list((tmp_path / "out" / ".pdal-stages" / "kept").glob("*.np[yz]"))


@pytest.mark.pdal
def test_where_and_units_reach_the_first_round(tmp_path, survey):
    stage = {**HEIGHTS, "where": "X < 400", "horizontal_unit": "foot", "vertical_unit": "foot"}
    assert not in_tiles(survey, [stage], tmp_path / "out").failures
    whole = np.concatenate(ps.run_pipeline([*survey, stage]).arrays)
    for name in MADE:
        assert np.array_equal(of_files(tmp_path / "out", name), whole[name]), name


def failing_in(patch, *jobs):
    """Let some jobs fail, given as round, column and row; return a list of those that are begun."""
    real, begun = run.run_tile, []

    def run_tile(context, number, at, *rest):
        begun.append((number, *at))
        if begun[-1] in jobs:
            raise ps.StageError("no luck")
        return real(context, number, at, *rest)

    patch.setattr(run, "run_tile", run_tile)
    return begun


@pytest.mark.pdal
def test_resume_makes_what_is_missing_alone(tmp_path, survey, monkeypatch):
    """And removes what is left of tiles that have no points any more; a damaged file is made again."""
    folder = tmp_path / "out"
    with monkeypatch.context() as patch:
        begun = failing_in(patch, (1, 1, 1))
        assert len(in_tiles(survey, [HEIGHTS], folder).failures) >= 1
    assert sorted(job for job in begun if job[0] == 0) == sorted(
        (0, i, j) for i in range(3) for j in range(3)
    )
    left = folder / ".pdal-stages" / "kept"
    assert len(list(left.glob("*.round0.npz"))) == 9
    (left / "0_0.round0.npz").unlink()
    np.savez(left / "-160_0.round0.npz", around=np.array([[-1.0, 100.0, -500.0]]))
    with open(left / "320_320.round0.npz", "r+b") as file:
        file.truncate(100)
    begun = failing_in(monkeypatch)
    assert not in_tiles(survey, [HEIGHTS], folder, resume=True).failures
    assert [job for job in begun if job[0] == 0] == [(0, 0, 0), (0, 2, 2)]
    whole = np.concatenate(ps.run_pipeline([*survey, HEIGHTS]).arrays)
    assert np.array_equal(of_files(folder, "HeightAboveGround"), whole["HeightAboveGround"])


@pytest.mark.pdal
def test_what_fails_in_the_first_round_is_said_of_the_tiles_that_need_it(
    tmp_path, survey, monkeypatch
):
    failing_in(monkeypatch, (0, 0, 0))
    small = {**HEIGHTS, "window": 1, "openings": []}
    tiles = in_tiles(survey, [small], tmp_path / "out").tiles
    failed = {job.tile for job in tiles if job.state == "failed"}
    assert (0, 0) in failed and all("no luck" in job.reason for job in tiles if job.tile in failed)
    failing_in(monkeypatch, *((0, *job.tile) for job in tiles))
    assert all(
        "no luck" in job.reason for job in in_tiles(survey, [small], tmp_path / "other").tiles
    )


def blocks_of(points, options, near):
    """The cells of all blocks that points need, each made of the lowest points that it may look at."""
    cell = options.cell
    low, inside = reduced_points(*points, np.ones(points.shape[1], bool), options)
    low = low.T
    side, surroundings = BLOCK_SIDE * cell, (reach_of_block(options) + 1) * cell
    results = []
    for i in range(int(near[0] // side), int(near[2] // side) + 1):
        for j in range(int(near[1] // side), int(near[3] // side) + 1):
            box = (
                i * side - surroundings,
                j * side - surroundings,
                (i + 1) * side + surroundings,
                (j + 1) * side + surroundings,
            )
            seen = (low[0] >= box[0]) & (low[0] <= box[2]) & (low[1] >= box[1]) & (low[1] <= box[3])
            members = inside.get((i, j), np.empty((0, 3)))
            parts = [members[::2], members[1::2]]
            results.append(cells_of_block(low[:, seen].T, (i, j), options, parts))
    return GroundCells(results)


def test_thousands_of_lone_points_are_refused_before_any_of_them_is_worked_on(tmp_path, write_las):
    column, row = np.divmod(np.arange(4100), 64)
    source = write_las(
        tmp_path / "in.las", {"X": column * 5000.0, "Y": row * 5000.0, "Z": row * 0.0}
    )
    job = run_tiled(
        [str(source), HEIGHTS, str(tmp_path / "o_#.las")], 1000, workers=0, progress=False
    )
    assert (
        "thousands of points lie alone, far from any other (found 4,100 of"
        in job.unreadable[str(source)]
    )
    assert not list(tmp_path.glob("o_*"))


@pytest.mark.parametrize(
    ("origin", "cell", "window", "strays"),
    [((770_500.0, 6_277_550.0), 1.0, 30.0, True), ((1000.0, 2000.0), 0.7, 5.0, False)],
)
def test_blocks_put_together_give_the_ground_of_the_whole(origin, cell, window, strays):
    x, y, z, _ = town(4, side=700, density=0.2, origin=origin)
    far = np.maximum(np.abs(x - origin[0] - 100), np.abs(y - origin[1] - 590))
    z[far < 150] = 0.02 * (x[far < 150] - origin[0]) + 100  # bare land, and a hall on it
    z[far < 50] += 12.0
    if strays:  # far from all else, and a hole in the middle
        away = np.random.default_rng(1).uniform(0, 60, (2, 400))
        x, y, z = (
            np.append(x, origin[0] + 4000 + away[0]),
            np.append(y, origin[1] - 3000 + away[1]),
            np.append(z, z[:400]),
        )
        kept = np.hypot(x - origin[0] - 450, y - origin[1] - 450) > 90
        x, y, z = x[kept], y[kept], z[kept]
    options = {"window": window, "openings": (5, 9), "slope_too": True, "cell": cell}
    whole = filtered_ground(x, y, z, **options)
    hall = np.maximum(np.abs(x - origin[0] - 100), np.abs(y - origin[1] - 590)) < 50
    assert whole["Ground"][hall].mean() < 0.1
    options_values = FilterOptions(cell=cell, window=window, openings=(5, 9))
    u, v = x - origin[0], y - origin[1]
    for box in (
        (430, 410, 520, 560),
        (-10, 630, 60, 710),
        *([(4000, -3000, 4050, -2950)] if strays else []),
    ):
        away = np.maximum(np.maximum(box[0] - u, u - box[2]), np.maximum(box[1] - v, v - box[3]))
        near = away <= 3.0
        wide = 3.0 + reach_of_cells(options_values) * cell
        surroundings = [box[0] - wide, box[1] - wide, box[2] + wide, box[3] + wide]
        surroundings = [edge + origin[n % 2] for n, edge in enumerate(surroundings)]
        cells = blocks_of(np.array([x, y, z]), options_values, surroundings)
        subset = filtered_ground(x[near], y[near], z[near], cells=cells, **options)
        core = away[near] < 0
        assert core.any()
        for name, values in subset.items():
            assert np.array_equal(values[core], whole[name][near][core]), (box, name)


@pytest.mark.pdal
def test_a_resumed_run_reports_what_an_uninterrupted_one_does(tmp_path, survey, monkeypatch):
    """Messages and counts of what is kept are in it; what has a damaged record is done again."""
    stages = [{"type": "filters.detachednoise"}, HEIGHTS]
    run = in_tiles(survey, stages, tmp_path / "at_once")
    expected = [run.messages, *(run.summary[name] for name in ("classes", "point_counts"))]
    assert any("meters were assumed" in text for text in run.messages) and all(expected)
    folder = tmp_path / "out"
    with monkeypatch.context() as patch:
        failing_in(patch, (1, 1, 1))
        assert in_tiles(survey, stages, folder).failures
    begun = failing_in(monkeypatch)

    def resume() -> list[tuple[int, ...]]:
        """Resume the run, and return which tiles and squares it did."""
        begun.clear()
        run = in_tiles(survey, stages, folder, resume=True)
        assert [run.messages, *(run.summary[n] for n in ("classes", "point_counts"))] == expected
        return begun.copy()

    assert (1, 1, 1) in resume() and resume() == []
    kept = folder / ".pdal-stages" / "kept"
    for name in ("0_0.round0", "160_160"):
        record = json.loads((kept / f"{name}.json").read_text())
        (kept / f"{name}.json").write_text(json.dumps({**record, "messages": [], "points": 1}))
    assert resume() == [(0, 0, 0), (1, 1, 1)] and resume() == []
