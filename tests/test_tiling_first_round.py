"""Tiles of filtered ground: a first round leaves the lowest points of cells; the same bits as in one piece."""

from __future__ import annotations

import laspy
import numpy as np
import pytest
from test_terrain_morphological import town

import pdal_stages as ps
from pdal_stages.stages.hag_morphological import HagMorphological
from pdal_stages.terrain import filtered_ground, groundblocks
from pdal_stages.terrain.decks import level_points
from pdal_stages.terrain.groundblocks import by_block, cells_of_block, reach_of_block
from pdal_stages.terrain.groundcells import BLOCK_SIDE, FilterOptions, GroundCells
from pdal_stages.terrain.lowpoints import lowest_of_cells
from pdal_stages.terrain.morphological import reach_of_cells
from pdal_stages.tiling import run_tiled
from pdal_stages.tiling.firstround import BlockTask

HEIGHTS = {"type": "filters.hag_morphological", "window": 8, "ground": True, "openings": [5, 9]}
MADE = ("HeightAboveGround", "Ground", "HeightAboveOpening_5", "HeightAboveOpening_9")
SIDE, TILE = 640, 200


@pytest.mark.parametrize("cell", [1.0, 0.7, 3.0])
def test_the_lowest_points_of_cells(cell):
    rng = np.random.default_rng(int(10 * cell))
    x, y, z = np.round(rng.uniform(-40, 40, (3, 3000)), 1)
    x[:5] += 1e7  # strays
    z[7] = -1e7
    use = rng.random(3000) < 0.9
    found = lowest_of_cells(x, y, z, use, cell)
    best: dict[tuple[int, int], tuple] = {}
    for n in np.flatnonzero(use & (np.abs(z) < 1e6)):
        key = (int(np.floor(x[n] / cell)), int(np.floor(y[n] / cell)))
        best[key] = min(best.get(key, (np.inf,)), (z[n], x[n], y[n]))
    assert {(z[n], x[n], y[n]) for n in found} == set(best.values())
    assert len(found) == len(best)
    assert lowest_of_cells(x, y, z, np.zeros(3000, bool), cell).size == 0


def test_a_stage_is_given_what_it_left(write_las):
    stage = HagMorphological({"openings": "5"})
    assert stage.near_halo_m() == 0.0 < stage.halo_m() and stage.from_blocks is None


@pytest.fixture(scope="module")
def survey(tmp_path_factory, write_las):
    """Two files that adjoin, with noise that is ignored by its class and some that is not."""
    folder = tmp_path_factory.mktemp("survey")
    x, y, z, height = town(3, side=SIDE, density=0.3)
    rng = np.random.default_rng(0)
    codes = np.where((height < 0) & (rng.random(len(x)) < 0.5), 7, 1).astype(np.uint8)
    paths = []
    for name, mine in (("west", x < 270), ("east", x >= 270)):
        arrays = {"X": x[mine], "Y": y[mine], "Z": z[mine], "Classification": codes[mine]}
        paths.append(str(write_las(folder / f"{name}.las", arrays)))
    return paths


def in_tiles(paths, stages, folder, **options):
    folder.mkdir(exist_ok=True)
    writer = {"type": "writers.las", "filename": str(folder / "#.las"), "extra_dims": "all", "forward": "all"}
    return run_tiled([*paths, *stages, writer], TILE, workers=0, progress=False, **options)


def of_files(folder, name):
    return np.concatenate([np.asarray(laspy.read(folder / f"{f}.las")[name]) for f in ("west", "east")])


@pytest.mark.pdal
@pytest.mark.parametrize(
    "before", [[], [{"type": "filters.detachednoise"}], [{"type": "filters.range", "limits": "Z[60:]"}]]
)
def test_tiles_are_the_same_bits_and_read_few_points(tmp_path, survey, before):
    run = in_tiles(survey, [*before, HEIGHTS], tmp_path / "out")
    assert not run.failures
    whole = np.concatenate(ps.run_pipeline([*survey, *before, HEIGHTS]).arrays)
    for name in MADE:
        assert np.array_equal(of_files(tmp_path / "out", name), whole[name]), name
    read = sum(job.record["read"] for job in run.tiles)
    own = sum(job.record["points"] for job in run.tiles)
    assert read <= 1.01 * own  # what noise marked is kept
    steps = run.summary["cpu_seconds_by_step"]
    assert set(steps) == {"index", "first_rounds", "tiles", "outputs"} and min(steps.values()) > 0
    assert run.summary["cpu_seconds"] == pytest.approx(sum(steps.values()))
    assert not list((tmp_path / "out" / ".pdal-stages" / "tiles").glob("*.np[yz]"))


@pytest.mark.pdal
def test_where_and_units_reach_the_first_round(tmp_path, survey):
    stage = {**HEIGHTS, "where": "X < 400", "horizontal_unit": "foot", "vertical_unit": "foot"}
    assert not in_tiles(survey, [stage], tmp_path / "out").failures
    whole = np.concatenate(ps.run_pipeline([*survey, stage]).arrays)
    for name in MADE:
        assert np.array_equal(of_files(tmp_path / "out", name), whole[name]), name


@pytest.mark.pdal
def test_resume_makes_what_is_missing_alone(tmp_path, survey, monkeypatch):
    from pdal_stages.tiling import tile_task
    from pdal_stages.tiling.firstround import FirstRoundTask

    made, real, refused = [], FirstRoundTask.run, tile_task.run_head

    def noted(self):
        made.append(self.tile)
        return real(self)

    def failing(context, tile, *rest):
        if tile == (1, 1):
            raise ps.StageError("no luck")
        return refused(context, tile, *rest)

    monkeypatch.setattr(FirstRoundTask, "run", noted)
    monkeypatch.setattr(tile_task, "run_head", failing)
    folder = tmp_path / "out"
    assert len(in_tiles(survey, [HEIGHTS], folder).failures) >= 1
    assert len(made) == len(set(made)) == 16
    left = folder / ".pdal-stages" / "tiles"
    assert len(list(left.glob("*.first.npz"))) == 16
    monkeypatch.setattr(tile_task, "run_head", refused)
    (left / "0_0.first.npz").unlink()
    made.clear()
    assert not in_tiles(survey, [HEIGHTS], folder, resume=True).failures
    assert made == [(0, 0)]
    whole = np.concatenate(ps.run_pipeline([*survey, HEIGHTS]).arrays)
    assert np.array_equal(of_files(folder, "HeightAboveGround"), whole["HeightAboveGround"])


def note_of(path):
    """What a run notes of a file that it keeps: of tiles under their name, of the rounds before under the file's."""
    before = path.name.endswith((".first.npz", ".cells.npz"))
    return path.with_name(f"{path.name}.json") if before else path.with_suffix(".json")


@pytest.mark.pdal
@pytest.mark.parametrize("kind", ["first round", "tiles"])
def test_killed_between_a_file_and_its_note(tmp_path, survey, monkeypatch, kind):
    """A file that a run with other options made is not taken for that of the run before, whatever was noted of that."""
    from pdal_stages.tiling import tiledrun
    from pdal_stages.tiling.file_task import FileTask
    from pdal_stages.tiling.store import Store

    def stages(least):
        return [{"type": "filters.range", "limits": f"X[{least}:]"}, HEIGHTS]

    def stop(*_):
        raise KeyboardInterrupt

    folder = tmp_path / "out"
    place, attribute = (tiledrun, "run_all") if kind == "first round" else (FileTask, "run")
    with monkeypatch.context() as patch:
        patch.setattr(place, attribute, stop)
        with pytest.raises(KeyboardInterrupt):
            in_tiles(survey, stages(2), folder)
    kept = folder / ".pdal-stages" / "tiles"
    made = {path: path.read_bytes() for path in kept.glob("*.np?")}
    assert len(made) >= 16 and all(note_of(path).exists() for path in made)
    with monkeypatch.context() as patch:
        patch.setattr(Store, "finish", stop)
        if kind == "tiles":  # of which the first is made, as the first round is left out of the other run
            patch.setattr(tiledrun, "run_first_round", lambda *_: None)
        with pytest.raises(KeyboardInterrupt):
            in_tiles(survey, stages(10), folder, resume=True)
    changed = [path for path in made if path.read_bytes() != made[path]]
    assert changed and not any(note_of(path).exists() for path in changed)
    assert not in_tiles(survey, stages(2), folder, resume=True).failures
    whole = np.concatenate(ps.run_pipeline([*survey, *stages(2)]).arrays)
    for name in MADE:
        assert np.array_equal(of_files(folder, name), whole[name]), name


@pytest.mark.pdal
def test_what_is_left_of_an_input_that_is_gone_is_removed(tmp_path, survey, monkeypatch):
    from pdal_stages.tiling import tile_task

    real = tile_task.run_head

    def failing(context, tile, *rest):
        if tile == (1, 1):
            raise ps.StageError("no luck")
        return real(context, tile, *rest)

    monkeypatch.setattr(tile_task, "run_head", failing)
    folder = tmp_path / "out"
    assert in_tiles(survey, [HEIGHTS], folder).failures
    left = folder / ".pdal-stages" / "tiles"
    names = {path.name for path in left.glob("*.first.npz")}
    np.savez(
        left / "-200_0.first.npz", around=np.array([[-1.0, 100.0, -500.0]])
    )  # of a tile without points now
    assert in_tiles(survey, [HEIGHTS], folder, resume=True).failures
    assert {path.name for path in left.glob("*.first.npz")} == names


@pytest.mark.pdal
def test_a_damaged_file_of_the_first_round_is_made_again(tmp_path, survey, monkeypatch):
    from pdal_stages.tiling.firstround import FirstRoundTask

    real = FirstRoundTask.run

    def damaged(self):
        answer = real(self)
        if self.tile == (2, 2):
            with open(self.target, "r+b") as file:
                file.truncate(100)
        return answer

    monkeypatch.setattr(FirstRoundTask, "run", damaged)
    run = in_tiles(survey, [HEIGHTS], tmp_path / "out")
    assert any("first round left" in job.reason for job in run.tiles)
    monkeypatch.setattr(FirstRoundTask, "run", real)
    assert not in_tiles(survey, [HEIGHTS], tmp_path / "out", resume=True).failures


@pytest.mark.pdal
def test_what_fails_in_the_first_round_is_said_of_the_tiles_that_need_it(tmp_path, survey, monkeypatch):
    from pdal_stages.tiling.firstround import FirstRoundTask

    real = FirstRoundTask.run

    def failing(self):
        if self.tile == (0, 0):
            raise ps.StageError("no luck")
        return real(self)

    monkeypatch.setattr(FirstRoundTask, "run", failing)
    small = {**HEIGHTS, "window": 1, "openings": []}
    run = in_tiles(survey, [small], tmp_path / "out")
    failed = {job.tile for job in run.tiles if job.state == "failed"}
    assert (0, 0) in failed and all("no luck" in job.reason for job in run.tiles if job.tile in failed)
    monkeypatch.setattr(FirstRoundTask, "run", lambda self: (_ for _ in ()).throw(ps.StageError("no luck")))
    with pytest.raises(ps.StageError, match="all tiles failed for one reason"):
        in_tiles(survey, [small], tmp_path / "other")


def blocks_of(points, options, near, cells=BLOCK_SIDE):
    """The cells of all blocks that points need, each made of the lowest points that it may look at."""
    cell = options.cell
    low = points[:, lowest_of_cells(*points, np.ones(points.shape[1], bool), cell)]
    side, around = cells * cell, (reach_of_block(options) + 1) * cell
    inside = by_block(*points, np.ones(points.shape[1], bool), cell, cells)
    found = []
    for i in range(int(near[0] // side), int(near[2] // side) + 1):
        for j in range(int(near[1] // side), int(near[3] // side) + 1):
            box = i * side - around, j * side - around, (i + 1) * side + around, (j + 1) * side + around
            seen = (low[0] >= box[0]) & (low[0] <= box[2]) & (low[1] >= box[1]) & (low[1] <= box[3])
            mine = inside.get((i, j), np.empty((0, 3)))
            found.append(cells_of_block(*low[:, seen], (i, j), options, [mine[::2], mine[1::2]], cells))
    return GroundCells.joined(found, len(options.openings))


@pytest.mark.parametrize(
    ("origin", "cell", "window", "strays", "side"),
    [
        ((0.0, 0.0), 1.0, 8.0, False, BLOCK_SIDE),
        ((770_500.0, 6_277_550.0), 1.0, 30.0, True, BLOCK_SIDE),
        ((1000.0, 2000.0), 0.5, 5.0, False, BLOCK_SIDE),
        ((770_500.0, 6_277_550.0), 1.0, 30.0, True, 2 * BLOCK_SIDE),
        ((0.0, 0.0), 1.0, 8.0, False, 300),
    ],
)
def test_blocks_put_together_give_the_ground_of_the_whole(origin, cell, window, strays, side):
    x, y, z, _ = town(4, side=900, density=0.5, origin=origin)
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
    made = FilterOptions(cell=cell, window=window, openings=(5, 9))
    u, v = x - origin[0], y - origin[1]
    for box in ((430, 410, 520, 560), (-10, 830, 60, 910), *([(4000, -3000, 4050, -2950)] if strays else [])):
        away = np.maximum(np.maximum(box[0] - u, u - box[2]), np.maximum(box[1] - v, v - box[3]))
        near = away <= 3.0
        wide = 3.0 + reach_of_cells(cell)
        around = [box[0] - wide, box[1] - wide, box[2] + wide, box[3] + wide]
        around = [edge + origin[n % 2] for n, edge in enumerate(around)]
        blocks = blocks_of(np.array([x, y, z]), made, around, side)
        cells = blocks.within(*(int(edge // cell) for edge in around))
        some = filtered_ground(x[near], y[near], z[near], cells=cells, **options)
        core = away[near] < 0
        assert core.any()
        for name, values in some.items():
            assert np.array_equal(values[core], whole[name][near][core]), (box, name)


@pytest.mark.pdal
def test_larger_blocks_give_the_same(tmp_path, survey, monkeypatch):
    stages = [{"type": "filters.detachednoise"}, HEIGHTS]
    sides, usual = [], BlockTask.run

    def run(task):
        sides.append((task.plan.first.blocks.side, task.block))
        return usual(task)

    monkeypatch.setattr(BlockTask, "run", run)
    for name, factor in (("usual", 1), ("larger", 2), ("smaller", 0.25)):
        monkeypatch.setattr(
            "pdal_stages.tiling.survey.widened",
            lambda blocks, *_, by=factor: blocks._replace(side=by * blocks.side),
        )
        assert not in_tiles(survey, stages, tmp_path / name).failures
    found = {side: {block for of, block in sides if of == side} for side, _ in sides}
    assert set(found) == {1024.0, 2048.0, 256.0} and len(found[256.0]) >= 9
    for name in ("larger", "smaller"):
        for file in ("west.las", "east.las"):
            assert (tmp_path / name / file).read_bytes() == (tmp_path / "usual" / file).read_bytes()


@pytest.mark.parametrize("cell", [1.0, 0.7])
def test_points_by_block_are_by_the_cells_of_blocks(cell):
    rng = np.random.default_rng(3)
    xyz = np.round(rng.uniform(-3000, 3000, (500, 3)), 1)
    xyz[0] = 1e7, -1e7, 5.0
    xyz[1, 2] = -1e7  # no terrain
    use = np.arange(500) != 7
    found = by_block(*xyz.T, use, cell)
    assert sum(map(len, found.values())) == 498
    for block, points in found.items():
        cells = np.floor(points[:, :2] / cell)
        assert (cells // BLOCK_SIDE == block).all()
    assert set(by_block(*xyz[:1].T, use[:1], cell)) == {
        tuple((np.floor(xyz[0, :2] / cell) // BLOCK_SIDE).astype(int))
    }
    assert by_block(*np.empty((3, 0)), use[:0], cell) == {}


@pytest.mark.parametrize("side", [1024, 4096])
def test_decks_of_a_block_are_looked_for_in_one_piece(side, monkeypatch):
    """In squares each would be looked at with as much around as the whole, four times the work."""
    found = []

    def levels(x, y, z, use, largest):
        found.append((np.ptp(x) + 1, np.ptp(y) + 1, largest))
        return np.empty((0, 5)), np.empty(0, np.int64)

    monkeypatch.setattr(groundblocks, "levels_near_decks", levels)
    options = FilterOptions(decks=True)
    away = reach_of_block(options) + 40
    axes = np.meshgrid(*[np.arange(-away, side + away, 8) + 0.5] * 2)
    cells_of_block(*(axis.ravel() for axis in axes), np.zeros(axes[0].size), (0, 0), options, side=side)
    ((across, along, largest),) = found
    assert side < across * along <= largest


def test_a_block_without_points_has_no_cells():
    none = cells_of_block(*np.empty((3, 0)), (3, -4), FilterOptions(openings=(5,)))
    assert none.column.size == 0 and none.opened.shape == (1, 0)


@pytest.mark.parametrize("name", ["viaduct", "river"])
def test_decks_of_blocks_are_those_of_the_whole(name):
    from bridge_scenes import SCENES, scan

    xyz, _ = scan(SCENES[name](), 3.0)
    middle = np.array([xyz[:, 0].mean() - 1024.0, xyz[:, 1].mean() - 2048.0, 0.0])  # where four blocks meet
    x, y, z = (xyz - middle).T
    use = np.random.default_rng(0).random(len(x)) < 0.95
    options = {"decks": True, "openings": (5,)}
    whole = filtered_ground(x, y, z, mask=use, **options)
    assert np.count_nonzero(whole["Deck"]) > 500
    left = np.union1d(lowest_of_cells(x, y, z, use, 1.0), level_points(x, y, z, use))
    made = FilterOptions(openings=(5,), decks=True)
    inside = by_block(x, y, z, use, 1.0)
    parts = [
        cells_of_block(x[left], y[left], z[left], (i, j), made, [inside[i, j]])
        for i in (0, 1)
        for j in (1, 2)
    ]
    assert all(len(part.decks) for part in parts)
    some = filtered_ground(x, y, z, mask=use, cells=GroundCells.joined(parts, 1), **options)
    for key, values in some.items():
        assert np.array_equal(values, whole[key]), key


@pytest.mark.parametrize("count", [0, 1, 3000])
def test_cells_in_parts_are_the_cells(count):
    """Those of any box, out of the parts that it needs alone; levels of decks once."""
    random = np.random.default_rng(count)
    number = random.permutation(200 * 150)[:count]
    column, row = number % 200 - 90, number // 200 + 70_000
    ground, held = random.random((2, count)) < 0.6
    cells = GroundCells(
        column, row, *random.random((2, count)).astype(np.float32), ground, random.random((ground.sum(), 3)),
        random.random((2, count)).astype(np.float32), held, random.random((held.sum(), 3)), random.random((4, 5)),
    )  # fmt: skip
    kept = cells.in_parts(32)
    for box in [
        (-90, 70_000, 109, 70_149),
        (-33, 70_031, 0, 70_064),
        (7, 70_100, 7, 70_100),
        (500, 0, 600, 9),
    ]:
        needed = GroundCells.names_within(32, *box)
        parts = [
            one.within(*box) for one in GroundCells.of_parts({n: v for n, v in kept.items() if n in needed})
        ]
        found, expected = GroundCells.joined(parts, 2), cells.within(*box)
        for one in (order := [np.lexsort((g.column, g.row)) for g in (found, expected)]):
            assert len(one) == len(order[0])
        for name in ("column", "row", "lowest", "floor", "ground", "opened", "held"):
            assert np.array_equal(
                getattr(found, name)[..., order[0]], getattr(expected, name)[..., order[1]]
            ), name
        for name, mask in (("place", "ground"), ("means", "held")):
            given = [np.column_stack([g.column, g.row])[getattr(g, mask)].tolist() for g in (found, expected)]
            values = [
                sorted(zip(g, getattr(c, name).tolist(), strict=True))
                for g, c in zip(given, (found, expected), strict=True)
            ]
            assert values[0] == values[1], name
        assert len(found.decks) == (4 if parts else 0)
