"""Tiled runs give what untiled runs give, to the last bit."""

from __future__ import annotations

import laspy
import numpy as np
import pytest
import tiling_clouds as clouds
from hypothesis import given, settings
from hypothesis import strategies as st

import pdal_stages as ps
from pdal_stages.base.errors import OptionError, PipelineError, StageError
from pdal_stages.pipeline import pdal as pdal_env
from pdal_stages.synthetic.town import WKT
from pdal_stages.terrain.minima import terrain_reach
from pdal_stages.tiling.classify import ClassifyTask
from pdal_stages.tiling.tiled_run import TilingOptions, run_tiled

pytestmark = pytest.mark.pdal


@pytest.fixture(scope="session")
def model_file(tmp_path_factory, pdal_module):
    return clouds.model(tmp_path_factory.mktemp("tiling") / "small.model")


@pytest.fixture(scope="session")
def town_file(tmp_path_factory, write_las):
    """A town with a hole and points on edges, with an extra dimension."""
    points, xyz, keep = clouds.town()
    arrays = {
        "X": xyz[keep, 0],
        "Y": xyz[keep, 1],
        "Z": xyz[keep, 2],
        "Intensity": points.intensity[keep],
        "Classification": points.classification[keep],
        "GpsTime": points.gps_time[keep],
        "TrueHeight": points.height_above_ground[keep],
    }
    path = tmp_path_factory.mktemp("tiling") / "town.laz"
    return write_las(
        path, arrays, point_format=6, wkt=WKT, scale=0.001, offset=(499_000.0, 5_399_000.0, 0.0)
    )


@pytest.fixture(scope="session")
def whole(tmp_path_factory, town_file, model_file):
    """The untiled result."""
    path = tmp_path_factory.mktemp("tiling") / "whole.laz"
    ps.Pipeline(clouds.stages([town_file], path, model_file)).execute(arrays=False)
    return path


# ---- reading parts of files ------------------------------------------------------------------------------


def test_pdals_filters_see_one_file_at_a_time(tmp_path, random_cloud, write_las):
    """As in a pipeline without tiles, until a stage of ours merges the files."""
    xyz = random_cloud(4_000, seed=2, extent=(40, 40, 3))
    for name, inside in (("a", xyz[:, 0] < 20), ("b", xyz[:, 0] >= 20)):
        write_las(tmp_path / f"{name}.las", dict(zip("XYZ", xyz[inside].T, strict=True)))
    filters = [
        {"type": "filters.radialdensity", "radius": 2.0},
        {"type": "filters.hag_minima", "cell": 3},
    ]
    inputs = [str(tmp_path / f"{name}.las") for name in "ab"]
    whole = ps.run_pipeline([*inputs, *filters]).arrays
    writer = {"type": "writers.las", "filename": str(tmp_path / "o_#.las"), "extra_dims": "all"}
    assert not run_tiled([*inputs, *filters, writer], 15, workers=0, buffer=3.0).failures
    got = [laspy.read(tmp_path / f"o_{name}.las") for name in "ab"]
    for name in ("RadialDensity", "HeightAboveGround"):
        values = np.concatenate([np.asarray(las[name]) for las in got])
        assert np.array_equal(values, np.concatenate([array[name] for array in whole])), name


@pytest.mark.parametrize("corner", [(499_980.0, 5_399_980.0), (0.0, 0.0), (770_000.0, 6_277_000.0)])
def test_a_small_survey_is_one_tile(tmp_path, random_cloud, write_las, corner):
    """Wherever the lines of round grids lie; only those through zero cut every size."""
    for name, at in (("a", 0.0), ("b", 20.0)):
        x, y, z = random_cloud(500, seed=3, extent=(20, 40, 3)).T
        arrays = {"X": x + corner[0] + at, "Y": y + corner[1], "Z": z}
        write_las(tmp_path / f"{name}.las", arrays, offset=(*corner, 0.0))
    stages = [str(tmp_path / "?.las"), {"type": "filters.hag_minima", "cell": 3}]
    run = run_tiled([*stages, str(tmp_path / "o_#.las")], TilingOptions(workers=0), dry_run=True)
    assert len(run.tiles) == 1


# ---- the same as untiled ---------------------------------------------------------------------------------


def test_one_file_comes_back_bit_for_bit(tmp_path, town_file, model_file, whole):
    run = run_tiled(clouds.stages([town_file], tmp_path / "out.laz", model_file), 30, workers=0)
    assert not run.failures
    assert len(run.tiles) == 11  # the hole's tile has no points
    x, y = (np.asarray(v) for v in (laspy.read(town_file).x, laspy.read(town_file).y))
    assert np.isin(x, 500_000.0 + np.array([10.0, 40.0, 70.0])).sum() > 10
    assert np.count_nonzero(y == 5_400_030.0) > 10
    assert any(job.record.read < run.summary["points"] for job in run.tiles)  # some were really cut
    clouds.same_points(whole, tmp_path / "out.laz")
    counted = np.bincount(np.asarray(laspy.read(whole).classification), minlength=7)
    assert run.summary["classes"] == {str(c): int(counted[c]) for c in np.flatnonzero(counted)}
    assert (tmp_path / "out.laz").read_bytes() == whole.read_bytes()


def test_large_files_are_written_in_parts(tmp_path, town_file, model_file, whole, monkeypatch):
    from pdal_stages.tiling import write_outputs as outputs

    monkeypatch.setattr(outputs, "MOST_AT_ONCE", 7_000)
    out = tmp_path / "out.laz"
    assert not run_tiled(clouds.stages([town_file], out, model_file), 60, workers=0).failures
    clouds.same_points(whole, out)
    first, two = laspy.read(whole).header, laspy.read(out).header
    for name in (
        "mins",
        "maxs",
        "number_of_points_by_return",
        "generating_software",
        "point_count",
    ):
        assert np.all(getattr(first, name) == getattr(two, name)), name
    # Automatic offsets would differ from part to part: such a file is written at once.
    stages = clouds.stages(
        [town_file], tmp_path / "auto.las", model_file, offset_x="auto", forward="vlr"
    )
    assert not run_tiled(stages, 60, workers=0).failures
    assert len(laspy.read(tmp_path / "auto.las")) == len(laspy.read(whole))
    assert not clouds.hidden(tmp_path)


def test_input_files_that_do_not_match_the_tiles(tmp_path, town_file, model_file):
    """Cut by a slanted line and by strips, with other offsets, formats and extra dimensions in each."""
    las = laspy.read(town_file)
    x, y = np.asarray(las.x) - 500_000, np.asarray(las.y) - 5_400_000
    part = np.where(x + 2 * y < 80, 0, np.where(np.arange(len(x)) % 2 == 0, 1, 2))
    folder = tmp_path / "in"
    folder.mkdir()
    for number in range(3):
        piece = laspy.LasData(laspy.LasHeader(version="1.4", point_format=(6, 7, 6)[number]))
        piece.header.vlrs = las.header.vlrs
        piece.header.global_encoding.wkt = True
        piece.header.offsets, piece.header.scales = (
            np.array([number * 1000.0, 5_400_000.0, 7.0]),
            np.full(3, 0.001),
        )
        rows = np.flatnonzero(part == number)
        record = laspy.ScaleAwarePointRecord.zeros(len(rows), header=piece.header)
        piece.points = record
        piece.x, piece.y, piece.z = las.xyz[rows].T
        piece.intensity, piece.gps_time = las.intensity[rows], las.gps_time[rows]
        piece.write(folder / f"part{number}.laz")
    pipeline = clouds.stages([folder / "part*.laz"], tmp_path / "c_#.laz", model_file)
    pipeline[0] = {"type": "readers.las", "filename": pipeline[0], "tag": "input"}
    run = run_tiled(pipeline, 30, workers=0)
    assert not run.failures
    # Other offsets round coordinates otherwise in their last bits, so the same files are read untiled.
    untiled = ps.Pipeline([*(str(folder / f"part{n}.laz") for n in range(3)), *pipeline[1:-1]])
    untiled.execute()
    arrays = np.concatenate(untiled.arrays)
    ends = np.cumsum([0, *(np.count_nonzero(part == n) for n in range(3))])
    names = {"classification": "Classification", "gps_time": "GpsTime", "intensity": "Intensity"}
    for number in range(3):
        output, given_ = (
            laspy.read(tmp_path / f"c_part{number}.laz"),
            laspy.read(folder / f"part{number}.laz"),
        )
        expected = arrays[ends[number] : ends[number + 1]]
        assert np.array_equal(output.points.array["X"], given_.points.array["X"])
        assert np.array_equal(output.header.offsets, given_.header.offsets)
        assert output.header.point_format.id == given_.header.point_format.id
        for name in ("classification", "HeightAboveGround", "Reliability", "gps_time", "intensity"):
            assert np.array_equal(output[name], expected[names.get(name, name)]), (number, name)
    run = run_tiled(
        [*pipeline[:-1], {**pipeline[-1], "filename": str(tmp_path / "t_#.laz")}],
        30,
        workers=0,
        per="tile",
    )
    assert not run.failures
    got = np.concatenate([_table(path) for path in sorted(tmp_path.glob("t_*.laz"))])
    parts = np.concatenate([_table(tmp_path / f"c_part{n}.laz") for n in range(3)])
    assert np.array_equal(np.sort(got), np.sort(parts))
    for path in tmp_path.glob("t_*.laz"):
        header = laspy.read(path).header
        assert header.x_max - header.x_min < 30.0


def _table(path):
    las = laspy.read(path)
    out = np.zeros(
        len(las),
        [("t", "f8"), ("x", "i8"), ("y", "i8"), ("z", "i8"), ("h", "f8"), ("c", "u1"), ("r", "f4")],
    )
    out["t"], out["h"], out["c"], out["r"] = (
        las.gps_time,
        las.HeightAboveGround,
        las.classification,
        las.Reliability,
    )
    for name in "xyz":
        out[name] = np.round(np.asarray(las[name]) * 1000)
    return out


def test_feature_stage_and_pdal_filters(tmp_path, town_file):
    """Filters before (dropping points, keeping labels) and after, features with where."""
    pipeline = [
        str(town_file),
        {"type": "filters.ferry", "dimensions": "Classification=>Reference"},
        {"type": "filters.range", "limits": "Intensity[300:]"},
        {
            "type": "filters.multiscalefeatures",
            "neighborhoods": "c1,k10",
            "feature_set": "Linearity,Density",
            "where": "Z > 62",
        },
        {"type": "filters.assign", "assignment": "UserData[:]=7"},
        {
            "type": "writers.las",
            "filename": str(tmp_path / "a.las"),
            "forward": "all",
            "extra_dims": "all",
        },
    ]
    untiled = ps.Pipeline(pipeline)
    untiled.execute(arrays=False)
    pipeline[-1] = {**pipeline[-1], "filename": str(tmp_path / "b.las")}
    run = run_tiled(pipeline, 30, workers=0)
    assert not run.failures
    assert (
        run.summary["dropped"]
        == len(laspy.read(town_file)) - len(laspy.read(tmp_path / "a.las"))
        > 0
    )
    clouds.same_points(tmp_path / "a.las", tmp_path / "b.las")


@pytest.mark.parametrize("names", ["old", "old new"])
def test_flag_bits_of_old_formats_stay_and_are_not_counted(
    tmp_path, town_file, model_file, write_las, names
):
    """Beside a file of a new format, too: old PDAL reads the flags of one as bits of the class, of the other apart."""
    las = laspy.read(town_file)
    number = np.arange(len(las))
    flags = {"Withheld": number % 2, "Synthetic": number % 3 == 0, "KeyPoint": number % 5 == 0}
    for name, point_format, shift in (("old", 1, 0), ("new", 6, 60)):
        arrays = {"X": las.x + shift, "Y": las.y, "Z": las.z, **flags}
        write_las(tmp_path / f"{name}.laz", arrays, point_format=point_format)
    paths = [tmp_path / f"{name}.laz" for name in names.split()]
    run = run_tiled(clouds.stages(paths, tmp_path / "o_#.laz", model_file), 60, workers=0)
    assert not run.failures
    counted = np.zeros(256, int)
    for name in names.split():
        written = laspy.read(tmp_path / f"o_{name}.laz")
        codes = np.asarray(written.classification)
        counted += np.bincount(codes, minlength=256)
        assert not codes[number % 2 == 1].any()  # withheld points keep theirs
        for flag, dimension in (
            ("withheld", "Withheld"),
            ("synthetic", "Synthetic"),
            ("key_point", "KeyPoint"),
        ):
            assert np.array_equal(written[flag], flags[dimension]), (name, flag)
    assert run.summary["classes"] == {str(c): int(counted[c]) for c in np.flatnonzero(counted)}
    assert set(run.summary["classes"]) == {"0", "2", "5", "6"}


# ---- reaches that no halo bounds -------------------------------------------------------------------------


def _features(neighborhoods, chosen):
    return {
        "type": "filters.multiscalefeatures",
        "neighborhoods": neighborhoods,
        "feature_set": chosen,
    }


@pytest.mark.parametrize(
    "stages",
    [
        [
            {"type": "filters.hag_minima", "cell": 4, "tag": "heights", "user_data": {"by": "me"}},
            _features("kopt", "Linearity,Radius"),
        ],
        [
            _features("k2", "surfaces")
        ],  # neighbors' surfaces are made of their own neighbors, which lie farther still
        "model",  # of two passes, which says as well how many neighbors it looks for
    ],
)
def test_sparse_points_widen_the_surroundings(tmp_path, random_cloud, write_las, stages):
    """k nearest neighbors and the terrain reach beyond the halo; the tile is read again, wider."""
    xyz = random_cloud(900, seed=3, extent=(300, 300, 4))
    xyz = xyz[(np.abs(xyz[:, 0] - 150) > 40) | (xyz[:, 1] > 200)]
    path = write_las(tmp_path / "sparse.las", dict(zip("XYZ", xyz.T, strict=True)))
    if stages == "model":
        stages = clouds.stages([], "", clouds.model(tmp_path / "m.model", "k30", "covariance"))[:-1]

    def job(name):
        writer = {"type": "writers.las", "forward": "all", "extra_dims": "all"}
        return [str(path), *stages, {**writer, "filename": str(tmp_path / name)}]

    ps.Pipeline(job("a.las")).execute(arrays=False)
    run = run_tiled(job("b.las"), 60, workers=0)
    assert not run.failures and not any("may differ" in note for note in run.messages)
    assert any(job.record.widened for job in run.tiles) and not any(
        job.record.short for job in run.tiles
    )
    clouds.same_points(tmp_path / "a.las", tmp_path / "b.las")
    if len(stages) == 2 and stages[0].get("tag"):
        run = run_tiled(
            job("c.las"), 60, workers=0, most_points=50
        )  # no room to widen: said, not hidden
        assert any("may differ" in note for note in run.messages)
        assert any(job.record.short for job in run.tiles)


def test_a_stray_point_far_away_is_read_with_all_others(tmp_path, random_cloud, write_las):
    """However often its tile would have to be widened by its own size."""
    xyz = random_cloud(300, seed=1, extent=(40, 40, 4))
    xyz[7, 0] += 30_000
    path = write_las(tmp_path / "stray.las", dict(zip("XYZ", xyz.T, strict=True)))
    stages = [str(path), _features("k8", "covariance")]
    writer = {"type": "writers.las", "forward": "all", "extra_dims": "all"}
    whole, tiles = (
        [*stages, {**writer, "filename": str(tmp_path / name)}] for name in ("a.las", "b.las")
    )
    ps.Pipeline(whole).execute(arrays=False)
    run = run_tiled(tiles, 20, workers=0)
    assert not run.failures and not any("may differ" in note for note in run.messages)
    clouds.same_points(tmp_path / "a.las", tmp_path / "b.las")


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.002, 0.1))
def test_terrain_within_its_reach_is_the_whole_terrain(seed, density):
    """Oracle: heights from the points within the reach equal heights from all points."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(0, 100, (max(3, int(density * 10_000)), 3))
    core = (40.0, 40.0, 60.0, 60.0)
    wanted = (xyz[:, 0] >= 40) & (xyz[:, 0] < 60) & (xyz[:, 1] >= 40) & (xyz[:, 1] < 60)
    if not wanted.any():
        return
    x, y, z = xyz.T
    reach = terrain_reach(x, y, np.ones(len(x), bool), wanted, core, 8.0, 0.5)
    near = (x >= 40 - reach) & (x <= 60 + reach) & (y >= 40 - reach) & (y <= 60 + reach)
    full, part = (
        ps.hag_minima(x, y, z, cell=8.0),
        ps.hag_minima(x[near], y[near], z[near], cell=8.0),
    )
    assert np.array_equal(full[wanted], part[wanted[near]])
    # What a smaller cut believes to need is never less than the truth.
    small = (x >= 38) & (x <= 62) & (y >= 38) & (y <= 62)
    believed = terrain_reach(
        x[small], y[small], np.ones(small.sum(), bool), wanted[small], core, 8.0, 0.5
    )
    assert believed >= reach or believed <= 2.0


# ---- what tiles cannot do --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "stage, message",
    [
        ({"type": "filters.reprojection", "out_srs": "EPSG:25833"}, "moves points"),
        ({"type": "filters.sort", "dimension": "X"}, "all points at once"),
        ({"type": "filters.outlier"}, "--buffer"),
        ({"type": "filters.multiscalefeatures", "feature_set": "shapes"}, "fitted to the points"),
    ],
)
def test_global_stages_are_refused(tmp_path, town_file, stage, message):
    with pytest.raises((PipelineError, OptionError), match=message) as caught:
        run_tiled(
            [str(town_file), stage, {"type": "filters.hag_minima"}, str(tmp_path / "out.laz")], 30
        )
    assert caught.value.cure or "all points" in caught.value.what


@pytest.mark.parametrize(
    "change, message",
    [
        ({"tile": 0}, "from 0.001"),
        ({"tile": 1e300}, "--tile must be a number from 0.001 to 1e"),
        ({"workers": 10_000}, "cores"),
        ({"workers": 1, "scheduler": "tcp://x:1"}, "one of them"),
        ({"per": "day"}, "one of"),
    ],
)
def test_options_are_checked(change, message):
    with pytest.raises(OptionError) as caught:
        TilingOptions(**{"tile": 10.0, **change})
    assert message in str(caught.value)


def test_outputs_need_names(tmp_path, town_file):
    las = laspy.read(town_file)
    for name in ("a", "b"):
        las[:100].write(tmp_path / f"{name}.las")
    with pytest.raises(PipelineError, match="to one file"):
        run_tiled([str(tmp_path / "a.las"), str(tmp_path / "b.las"), str(tmp_path / "out.las")], 30)
    with pytest.raises(StageError, match="one of the inputs"):
        run_tiled([str(tmp_path / "a.las"), str(tmp_path / "b.las"), str(tmp_path / "#.las")], 30)
    (tmp_path / "deep").mkdir()
    with pytest.raises(PipelineError, match="Put a suffix after it"):  # as PDAL writes text there
        run_tiled([str(tmp_path / "a.las"), str(tmp_path / "deep" / "#")], 30)
    las[:100].write(tmp_path / "deep" / "a.las")
    with pytest.raises(PipelineError, match="the same name"):
        run_tiled(
            [str(tmp_path / "a.las"), str(tmp_path / "deep" / "a.las"), str(tmp_path / "o_#.las")],
            30,
        )
    with pytest.raises(PipelineError, match="no file matches"):
        run_tiled([str(tmp_path / "none*.las"), str(tmp_path / "o_#.las")], 30)


def test_outputs_of_tiles_hold_all_that_inputs_of_several_kinds_hold(tmp_path, write_las):
    """The finest scale and the richest format: PDAL forwards only what a tile's inputs have in common."""
    rng = np.random.default_rng(8)
    folder = tmp_path / "in"
    folder.mkdir()
    kinds_of = {"a": (6, 0.01, 500_000.0), "b": (8, 0.001, 500_040.0), "c": (3, 0.01, 0.0)}
    output = {}
    for number, (name, (kind, scale, offset)) in enumerate(kinds_of.items()):
        xyz = (
            np.round(
                (rng.uniform(0, 1, (800, 3)) * (30, 30, 4) + (500_000 + 30 * number, 0, 0)) / scale
            )
            * scale
        )
        arrays = dict(zip("XYZ", xyz.T, strict=True)) | {"UserData": rng.integers(0, 256, 800)}
        if kind != 6:
            arrays["Red"] = rng.integers(0, 65536, 800)
        if kind == 8:
            arrays["Infrared"] = rng.integers(0, 65536, 800)
        write_las(folder / f"{name}.laz", arrays, kind, offset=(offset, 0, 0), scale=scale)
        output[name] = arrays
    task = ClassifyTask(
        (str(folder),), str(tmp_path / "out"), options=TilingOptions(tile=40, per="tile", workers=0)
    )
    run = task.run_tiles()
    assert not run.failures
    tiles = [laspy.read(path) for path in sorted((tmp_path / "out").glob("*.laz"))]
    assert sum(len(tile.points) for tile in tiles) == 2400 and len(tiles) > 1
    assert {
        (tile.header.version.minor, tile.point_format.id, tile.header.scales[0]) for tile in tiles
    } == {(4, 8, 0.001)}
    got = np.concatenate([np.round(np.asarray(tile.x) * 1000) for tile in tiles])
    want = np.concatenate([np.round(arrays["X"] * 1000) for arrays in output.values()])
    assert np.array_equal(np.sort(got), np.sort(want))
    for field, name, part in (("nir", "Infrared", "b"), ("red", "Red", "bc")):
        kept = np.concatenate([np.asarray(tile[field]) for tile in tiles])
        assert kept.astype(int).sum() == sum(int(output[each][name].sum()) for each in part)


@pytest.mark.parametrize("at_once", [10_000, 50])
def test_a_reference_that_stands_after_the_points(
    tmp_path, random_cloud, write_las, monkeypatch, at_once
):
    """In feet: a piece without it would be taken for one in meters. Other records are kept too."""
    monkeypatch.setattr("pdal_stages.tiling.write_outputs.MOST_AT_ONCE", at_once)
    points = dict(zip("XYZ", random_cloud(200, seed=1).T, strict=True))
    las = laspy.read(write_las(tmp_path / "in.las", points, 6))
    wkt = b'LOCAL_CS["feet",UNIT["foot",0.3048]]'
    records = [laspy.VLR("LASF_Projection", 2112, "", wkt), laspy.VLR("mine", 7, "", b"hello")]
    las.header.global_encoding.wkt, las.evlrs = True, laspy.vlrs.vlrlist.VLRList(records)
    las.write(tmp_path / "in.las")
    outputs = []
    for name, run in (
        ("whole", ps.run_pipeline),
        ("tiles", lambda job: run_tiled(job, 20, workers=0)),
    ):
        out = str(tmp_path / f"{name}.las")
        run([str(tmp_path / "in.las"), {"type": "filters.hag_minima", "cell": 5},
             {"type": "writers.las", "filename": out, "forward": "all", "extra_dims": "all"}])  # fmt: skip
        outputs.append(laspy.read(out))
    heights = [np.asarray(entry["HeightAboveGround"]) for entry in outputs]
    assert np.array_equal(*heights) and heights[0].any()
    for entry in outputs:
        assert b"hello" in {
            record.record_data_bytes() for record in [*entry.vlrs, *(entry.evlrs or [])]
        }


def test_odd_headers_are_said_of_the_inputs_alone(tmp_path, town_file):
    """Pieces that are cut out for tiles have the input's header; of many one is named."""
    data = bytearray(town_file.read_bytes())
    data[179:227] = bytes(48)  # no box
    for n in range(8):
        (tmp_path / f"odd{n}.laz").write_bytes(data)
    for inputs, more, dry in (("odd0.laz", "", False), ("odd*.laz", "7 more inputs", True)):
        writer = {"type": "writers.las", "filename": str(tmp_path / "o_#.las")}
        job = [str(tmp_path / inputs), {"type": "filters.hag_minima", "cell": 5}, writer]
        run = run_tiled(job, 30, workers=0, dry_run=dry)
        messages_text = [message for message in run.messages if "box in its header" in message]
        assert (
            not run.failures
            and len(messages_text) == 1
            and messages_text[0].startswith(f"{tmp_path}/odd0.laz: ")
        )
        assert more in messages_text[0]


@pytest.mark.parametrize(
    ("described", "options"),
    [(False, {}), (True, {"ignore_vlr": "LASF_Spec/4"}), (True, {})],
    ids=["undescribed", "ignored", "described"],
)
def test_extra_bytes_are_named_as_the_reader_says(
    tmp_path, random_cloud, write_las, described, options
):
    """PDAL's way whole: before 2.9 their record counts more than the reader's names."""
    x, y, z = random_cloud(3_000, seed=5, extent=(40, 40, 3)).T
    wave = np.arange(len(x), dtype=np.uint16)
    cloud = tmp_path / "cloud.las"
    write_las(cloud, {"X": x, "Y": y, "Z": z, "amp": wave}, point_format=6)
    if not described:
        cloud.write_bytes(cloud.read_bytes().replace(b"LASF_Spec", b"LASF_Gone"))
    reader = {"type": "readers.las", "filename": str(cloud), "extra_dims": "wave=uint16", **options}
    by_record = described and not options and pdal_env.version() < (2, 9, 0)
    name = "amp" if by_record else "wave"
    filters = [
        {"type": "filters.hag_minima", "cell": 3, "where": f"{name} < 2000"},
        {"type": "filters.assign", "value": f"UserData = 7 WHERE {name} > 2900"},
    ]
    (whole,) = ps.run_pipeline([reader, *filters]).arrays
    writer = {"type": "writers.las", "filename": str(tmp_path / "o.las"), "extra_dims": "all"}
    assert not run_tiled([reader, *filters, writer], 15, workers=0).failures
    got = laspy.read(tmp_path / "o.las")
    for dimension in (name, "HeightAboveGround"):
        assert np.array_equal(got[dimension], whole[dimension]), dimension
    assert np.array_equal(got.user_data, whole["UserData"])
    assert got.user_data.any()
