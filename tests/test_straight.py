"""Points straight from a file's records to stages give what PDAL in between would."""

from __future__ import annotations

import laspy
import numpy as np
import pytest

from pdal_stages.base.errors import DimensionError
from pdal_stages.pipeline import pdal as pdal_env
from pdal_stages.pipeline import straight
from pdal_stages.pipeline.callbacks import Callbacks
from pdal_stages.pipeline.run import Pipeline
from pdal_stages.pipeline.straight import NeedsPdal, View, may_run, reading_of
from pdal_stages.tiling import headrun, run_tiled
from pdal_stages.tiling.extract import SAMPLE, sampled
from pdal_stages.tiling.tileplan import make_plan

pytestmark = pytest.mark.pdal
WKT = (
    'PROJCS["a",GEOGCS["b",DATUM["c",SPHEROID["d",6378137,298.257]],PRIMEM["e",0],UNIT["degree",0.0174532925199433]],'
    'PROJECTION["Transverse_Mercator"],UNIT["US survey foot",0.304800609601219]]'
)


def cloud(count=2000, seed=0, extra=()):
    rng = np.random.default_rng(seed)
    arrays = {
        "X": rng.uniform(1000, 1060, count),
        "Y": rng.uniform(2000, 2060, count),
        "Z": rng.uniform(-5, 20, count),
        "Intensity": rng.integers(0, 65536, count).astype(np.uint16),
        "ReturnNumber": rng.integers(1, 6, count).astype(np.uint8),
        "NumberOfReturns": rng.integers(1, 8, count).astype(np.uint8),
        "Classification": rng.integers(0, 19, count).astype(np.uint8),
        "UserData": rng.integers(0, 256, count).astype(np.uint8),
        "PointSourceId": rng.integers(0, 65536, count).astype(np.uint16),
        "ScanAngleRank": rng.integers(-40, 41, count).astype(np.float64),
    }
    return arrays | {name: rng.uniform(0, 9, count).astype(np.float32) for name in extra}


def view_of(path, tag="in0", **reader):
    """The records of a file, read as those of a piece of a tile."""
    records = laspy.read(path).points.array
    few = laspy.read(path)
    few.points = few.points[np.linspace(0, len(records) - 1, min(len(records), SAMPLE)).astype(np.int64)]
    small = path.with_name(f"few_{path.name}")
    few.write(small)
    reader = {"type": "readers.las", **reader, "filename": str(small)}
    return View.of_file(reading_of(reader, sampled(records)), records), {**reader, "tag": tag}


@pytest.mark.parametrize("point_format", [0, 1, 2, 3, 6, 7, 8])
def test_dimensions_are_what_pdal_s_reader_gives(tmp_path, write_las, point_format):
    path = write_las(tmp_path / "a.las", cloud(extra=["Mine"]), point_format=point_format, scale=0.01)
    las = laspy.read(path)
    for name in (
        "gps_time",
        "red",
        "green",
        "blue",
        "nir",
        "synthetic",
        "edge_of_flight_line",
        "scan_direction_flag",
    ):
        if name in las.point_format.dimension_names:
            most = 2 if name in ("synthetic", "edge_of_flight_line", "scan_direction_flag") else 60_000
            las[name] = np.random.default_rng(1).integers(0, most, len(las))
    las.write(path)
    view, _ = view_of(path)
    (expected,) = pdal_env.execute([{"type": "readers.las", "filename": str(path)}]).arrays
    assert list(view) == list(expected.dtype.names) and view.count == len(expected)
    decoded = 0
    for name in expected.dtype.names:
        try:
            values = view[name]
        except NeedsPdal:
            continue
        decoded += 1
        assert values.dtype == expected[name].dtype and values.flags.c_contiguous, name
        assert np.array_equal(values, expected[name]), name
    others = set()
    if point_format < 6 and pdal_env.splits_class_flags():
        others |= {"Classification", *pdal_env.FLAGS}
    assert decoded >= len(expected.dtype.names) - len(others)
    assert ("Mine" in view) == (point_format >= 6)  # of older formats PDAL leaves it out unless told
    with pytest.raises(KeyError):
        view["HeightAboveGround"]


def test_a_scaled_extra_dimension_takes_pdal(tmp_path, write_las):
    path = write_las(tmp_path / "a.las", cloud(), point_format=6)
    las = laspy.read(path)
    las.add_extra_dim(laspy.ExtraBytesParams("Mine", "f8", scales=np.array([2.0]), offsets=np.array([0.0])))
    las.write(path)  # whose zeros are the same, scaled or not
    view, _ = view_of(path)
    assert "Mine" in view
    with pytest.raises(NeedsPdal):
        view["Mine"]


@pytest.mark.parametrize("where", [None, "Classification < 10 && Z > 0"])
@pytest.mark.parametrize("wkt", [None, WKT])
def test_stages_give_the_same_bits(tmp_path, write_las, where, wkt):
    stages = [
        {"type": "filters.detachednoise", "where": where},
        {"type": "filters.hag_morphological", "window": 8, "ground": True},
        {
            "type": "filters.multiscalefeatures",
            "neighborhoods": "k10",
            "feature_set": "covariance",
            "where": where,
        },
    ]
    stages = [{name: value for name, value in stage.items() if value is not None} for stage in stages]
    old = (
        6 if pdal_env.splits_class_flags() else 3
    )  # whose classes are read by PDAL alone where it splits them
    options = {"point_format": 6, "wkt": wkt} if wkt else {"point_format": old}
    if where and not wkt:
        where = None
    paths = [write_las(tmp_path / f"{n}.las", cloud(seed=n), **options) for n in (1, 2)]
    views, readers, found = {}, [], []
    for number, path in enumerate(paths):
        views[f"in{number}"], reader = view_of(path, f"in{number}")
        readers.append(reader)
    with Callbacks() as callbacks:
        kept = callbacks.filter(
            lambda module, ins, outs: found.append({name: np.array(ins[name]) for name in ins})
        )
        pipeline = Pipeline([*readers, *stages, kept], whole=False)
        assert may_run(pipeline.lowered.stages)
        assert pipeline.execute(arrays=False, read=views) == 4000
    whole = Pipeline([*(str(path) for path in paths), *stages])
    whole.execute()
    (expected,) = whole.arrays
    assert set(found[0]) == set(expected.dtype.names)
    for name, values in found[0].items():
        assert values.dtype == expected[name].dtype and np.array_equal(values, expected[name]), name
    assert [r.to_dict() for _, each in pipeline.reports for r in each] == [
        r.to_dict() for _, each in whole.reports for r in each
    ]


def test_a_stage_that_fails_says_what_it_would(tmp_path, write_las):
    view, reader = view_of(write_las(tmp_path / "a.las", cloud()))
    stages = [
        {
            "type": "filters.multiscalefeatures",
            "neighborhoods": "k10",
            "feature_set": "covariance",
            "where": "Mine > 1",
        }
    ]
    with pytest.raises(DimensionError, match="'Mine', which the points do not have"):
        Pipeline([reader, *stages], whole=False).execute(arrays=False, read={"in0": view})


@pytest.mark.parametrize(
    "stage",
    [
        {"type": "filters.outlier"},
        {"type": "filters.range", "limits": "Z[0:5]"},
        {"type": "filters.hag_minima", "where": "Mine > 1"},
        {"type": "filters.ferry", "dimensions": "Z=>Mine"},
    ],
)
def test_what_takes_pdal_is_told(tmp_path, write_las, stage):
    view, reader = view_of(write_las(tmp_path / "a.las", cloud(extra=["Mine"]), point_format=6))
    with pytest.raises(NeedsPdal):
        straight.execute(Pipeline([reader, stage], whole=False).lowered.stages, {"in0": view})
        raise AssertionError(stage)


@pytest.mark.parametrize("option", ["start", "where", "fix_dims"])
def test_readers_that_choose_take_pdal(option):
    assert not may_run([{"type": "readers.las", "filename": "a.las", option: 1}])
    assert not may_run([{"type": "readers.text", "filename": "a.txt"}])


@pytest.mark.parametrize("there", ["Mine", "HeightAboveGround", "scaled HeightAboveGround"])
def test_tiles_of_files_with_what_stages_make(tmp_path, write_las, monkeypatch, there):
    """Heights that the input has are kept outside `where`, as in one piece; scaled ones are read by PDAL."""
    extra = [there] if " " not in there else []
    path = write_las(tmp_path / "a.las", cloud(4000, extra=extra), point_format=6)
    if not extra:
        las = laspy.read(path)
        params = {"scales": np.array([0.01]), "offsets": np.array([1.0])}
        las.add_extra_dim(laspy.ExtraBytesParams("HeightAboveGround", "u2", **params))
        las["HeightAboveGround"] = np.arange(4000) / 100 + 1
        las.write(path)
    stage = {"type": "filters.hag_minima", "cell": 5, "where": "Classification < 10"}
    ran = []
    monkeypatch.setattr(headrun, "_write", lambda cuts: ran.append([piece.write() for piece in cuts]))
    writer = {
        "type": "writers.las",
        "filename": str(tmp_path / "#_out.las"),
        "forward": "all",
        "extra_dims": "all",
    }
    run = run_tiled([str(path), stage, writer], 30, workers=0, progress=False)
    assert not run.failures and bool(ran) == (not extra)
    whole = Pipeline([str(path), stage])
    whole.execute()
    made = np.asarray(laspy.read(tmp_path / "a_out.las")["HeightAboveGround"])
    assert np.array_equal(made, whole.arrays[0]["HeightAboveGround"].astype(made.dtype))


def test_blocks_take_less_memory_in_tiles_where_nobody_says_how_much():
    def memory(**given):
        stages = ["in.las", {"type": "filters.hag_morphological", "ground": True, "openings": [5, 17]}]
        stages += [{"type": "filters.modelclassifier", "model": "standard", **given}, "out.las"]
        return make_plan(Pipeline(stages, whole=False)).head[1].get("memory")

    assert memory() == 256 and memory(memory=700) == 700
