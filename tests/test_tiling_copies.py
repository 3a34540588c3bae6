"""Copies of inputs by place: a cut out of one is the cut out of the file, and a run does without."""

from __future__ import annotations

import laspy
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tiling_clouds import same_points

from pdal_stages.base.errors import StageError
from pdal_stages.tiling import byplace, extract, run_tiled, tile_task
from pdal_stages.tiling.byplace import CopyByPlace, points_in
from pdal_stages.tiling.cloudindex import index_las
from pdal_stages.tiling.extract import Member, cut
from pdal_stages.tiling.grid import TileGrid
from pdal_stages.tiling.sources import InputSource
from pdal_stages.tiling.store import Store
from pdal_stages.tiling.survey import Survey

GRID = TileGrid(25.0)


@pytest.fixture(scope="module")
def cloud(tmp_path_factory, random_cloud, write_las):
    """120,000 points in no order, a few of them far away."""
    folder = tmp_path_factory.mktemp("copies")
    xyz = random_cloud(120_000, seed=1, extent=(100, 100, 5))
    xyz[::40_000, :2] += 30_000
    arrays = dict(zip("XYZ", xyz.T, strict=True)) | {"Intensity": np.arange(len(xyz)) % 65536}
    return write_las(folder / "cloud.laz", arrays)


def piece_of(path, copy, folder, tile=(1, 2), around=3.0):
    index = index_las(str(path), GRID, str(copy) if copy else "")
    made = cut(
        [Member(InputSource(str(path), {}, "las"), str(path), index)],
        GRID,
        tile,
        around,
        str(folder / "piece.las"),
    )
    return made.index, made.away, made.tiles, (folder / "piece.las").read_bytes()


def same(a, b) -> bool:
    return all(
        np.array_equal(x, y) if isinstance(x, np.ndarray) else x == y for x, y in zip(a, b, strict=True)
    )


@pytest.mark.parametrize("part", [1_000_000, 30_000])
@pytest.mark.parametrize(("tile", "around"), [((1, 2), 3.0), ((0, 0), 40.0), ((1201, 1200), 5.0)])
def test_a_cut_out_of_a_copy_is_the_same(tmp_path, cloud, monkeypatch, part, tile, around):
    monkeypatch.setattr(byplace, "_PART", part)
    try:
        expected = piece_of(cloud, None, tmp_path, tile, around)
    except AttributeError:  # no point there
        pytest.skip("no stray fell there")
    monkeypatch.setattr(extract, "read_block", None)  # so that the file itself cannot be read
    assert same(piece_of(cloud, tmp_path / "copy", tmp_path, tile, around), expected)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.floats(-1e6, 1e6), st.floats(-50, 50)), max_size=60), st.integers(1, 30))
def test_every_point_near_is_found_once(tmp_path_factory, places, part):
    """In any order, with points in one place, and in cells of any number of points."""
    path = str(tmp_path_factory.mktemp("copy") / "a.points")
    xy = np.array(places, np.float64).reshape(-1, 2)
    records = np.arange(len(xy), dtype="<u4").view((np.void, 4))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(byplace, "_PART", part)
        patch.setattr(byplace, "_CELL", 3)
        with CopyByPlace(path) as copying:
            for start in range(0, len(xy), 7):
                end = min(start + 7, len(xy))
                copying.add(records[start:end], xy[start:end, 0], xy[start:end, 1])
    box = (-100.0, -10.0, 5_000.0, 20.0)
    found = list(points_in(path, len(xy), box))
    numbers = np.concatenate([np.empty(0, np.int64), *(n for n, _ in found)])
    assert (np.diff(numbers) > 0).all()
    for rows, there in found:
        assert np.array_equal(there.view("<u4"), rows)
    inside = (xy[:, 0] >= box[0]) & (xy[:, 0] <= box[2]) & (xy[:, 1] >= box[1]) & (xy[:, 1] <= box[3])
    assert set(np.flatnonzero(inside)) <= set(numbers.tolist())


@pytest.mark.parametrize("harm", ["gone", "torn", "of another file", "empty"])
def test_a_copy_that_is_not_whole_is_not_read(tmp_path, cloud, harm):
    expected = piece_of(cloud, None, tmp_path)
    copy = tmp_path / "copy"
    index = index_las(str(cloud), GRID, str(copy))
    whole = copy.read_bytes()
    if harm == "gone":
        copy.unlink()
    elif harm == "of another file":
        las = laspy.read(cloud)
        las.points = las.points[:60_000]
        las.write(tmp_path / "other.laz")
        index_las(str(tmp_path / "other.laz"), GRID, str(copy))
    else:
        copy.write_bytes(whole[:-5] if harm == "torn" else b"")
    member = Member(InputSource(str(cloud), {}, "las"), str(cloud), index)
    made = cut([member], GRID, (1, 2), 3.0, str(tmp_path / "again.las"))
    assert same((made.index, made.away, made.tiles, (tmp_path / "again.las").read_bytes()), expected)


@pytest.mark.parametrize("part", [1_000_000, 30_000])
def test_an_input_is_unpacked_out_of_its_copy(tmp_path, cloud, monkeypatch, part):
    monkeypatch.setattr(byplace, "_PART", part)
    copy, plain = tmp_path / "copy", tmp_path / "plain.las"
    count = index_las(str(cloud), GRID, str(copy)).count
    assert extract.unpacked(str(cloud), str(copy), count, str(plain))
    packed, made = laspy.read(cloud), laspy.read(plain)
    assert made.points.array.tobytes() == packed.points.array.tobytes() and len(made) == count
    assert (
        not made.header.are_points_compressed
        and made.header.offsets.tolist() == packed.header.offsets.tolist()
    )
    assert not extract.unpacked(str(cloud), str(copy), count, str(tmp_path / "nowhere" / "plain.las"))
    copy.write_bytes(copy.read_bytes()[:-5])
    assert not extract.unpacked(str(cloud), str(copy), count, str(plain))
    assert not extract.unpacked(str(cloud), "", count, str(plain))
    assert not extract.unpacked(str(plain), str(copy), count, str(tmp_path / "again.las"))


def test_no_room_for_a_copy(tmp_path, cloud, monkeypatch):
    def full(self):
        raise OSError(28, "No space left on device")

    expected = index_las(str(cloud), GRID)
    monkeypatch.setattr(CopyByPlace, "_write", full)
    found = index_las(str(cloud), GRID, str(tmp_path / "copy"))
    assert found.tiles == expected.tiles and not list(tmp_path.iterdir())


def test_a_copy_that_cannot_get_its_name(tmp_path, cloud):
    (tmp_path / "copy").mkdir()
    assert index_las(str(cloud), GRID, str(tmp_path / "copy")).count == 120_000
    assert [p.name for p in tmp_path.iterdir()] == ["copy"]


def test_a_damaged_input_leaves_no_copy(tmp_path, cloud):
    (tmp_path / "torn.laz").write_bytes(cloud.read_bytes()[:-200_000])
    with pytest.raises(StageError):
        index_las(str(tmp_path / "torn.laz"), GRID, str(tmp_path / "copy"))
    assert [p.name for p in tmp_path.iterdir()] == ["torn.laz"]


@pytest.fixture(scope="module")
def survey(tmp_path_factory, random_cloud, write_las):
    xyz = random_cloud(12_000, seed=2, extent=(90, 60, 5))
    return write_las(tmp_path_factory.mktemp("survey") / "town.laz", dict(zip("XYZ", xyz.T, strict=True)))


def run(survey, out, **options):
    out.mkdir(exist_ok=True)
    stages = [
        str(survey),
        {"type": "filters.hag_minima", "cell": 5},
        {"type": "writers.las", "filename": str(out / "c_#.laz"), "forward": "all", "extra_dims": "all"},
    ]
    return run_tiled(stages, 30.0, workers=0, per="file", **options)


def test_a_run_with_copies_without_and_stopped_between(tmp_path, survey, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(Store, "room_for", lambda self, size: False)
        patch.setattr(byplace, "points_in", None)
        assert run(survey, tmp_path / "without").failures == []
    used = []
    points = extract.points_in
    monkeypatch.setattr(extract, "points_in", lambda *given: used.append(given[0]) or points(*given))

    out = tmp_path / "with"
    index = out / ".pdal-stages" / "index"
    with monkeypatch.context() as patch:
        patch.setattr(tile_task, "run_head", lambda *given: 1 / 0)
        assert len(run(survey, out).failures) == 7  # six tiles, and the output
    assert used and [p.suffix for p in index.iterdir() if p.suffix != ".json"] == [".points"]
    used.clear()
    again = run(survey, out, resume=True)
    assert again.failures == [] and used
    same_points(out / "c_town.laz", tmp_path / "without" / "c_town.laz")
    assert not list(index.glob("*.points*"))


def test_copies_are_made_where_tiles_read_more_than_their_own(tmp_path, survey, monkeypatch):
    """Not for a cluster, nor of small files, nor for a single tile."""
    made = []
    monkeypatch.setattr(
        Survey,
        "_worth",
        lambda self, paths, f=Survey._worth: made.append(f(self, paths)) or made[-1],
    )
    run(survey, tmp_path / "one")
    monkeypatch.setattr("pdal_stages.tiling.survey.SMALL", 10**9)
    run(survey, tmp_path / "small")
    assert made == [[str(survey)], []]
