"""Pipelines through PDAL itself: three doors, chaining, and the traps of filters.python."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor

import laspy
import numpy as np
import pytest
from processes import printed

import pdal_stages as ps
from pdal_stages import run_tiled
from pdal_stages.base.errors import DimensionError, OptionError, PipelineError
from pdal_stages.cli import main
from pdal_stages.pipeline import pdal as pdal_env
from pdal_stages.pipeline.expansion import fuse_scripts
from pdal_stages.terrain.minima import hag_minima

pytestmark = pytest.mark.pdal


def scene(n=3000, seed=0, size=59.9):
    """Ground with boxes on it: X, Y, Z, Classification and some LAS dimensions."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, size, (2, n)).round(2)
    block = ((x // 10 + y // 10) % 3 == 0) & (x % 10 > 3) & (y % 10 > 3)
    z = (0.02 * x + np.where(block, 6.0, rng.normal(0, 0.03, n))).round(2)
    return {
        "X": x + 500_000,
        "Y": y + 5_400_000,
        "Z": z + 100,
        "Classification": np.where(block, 6, 2).astype(np.uint8),
        "Intensity": rng.integers(0, 65535, n).astype(np.uint16),
        "GpsTime": rng.uniform(0, 1e6, n),
        "Red": rng.integers(0, 65535, n).astype(np.uint16),
        "UserData": rng.integers(0, 255, n).astype(np.uint8),
        "PointSourceId": rng.integers(0, 99, n).astype(np.uint16),
    }


@pytest.fixture()
def cloud(tmp_path, write_las):
    return write_las(tmp_path / "in.laz", scene(), point_format=3)


@pytest.fixture(scope="module")
def model(tmp_path_factory, write_las):
    """A small model of ground and building, trained through PDAL."""
    folder = tmp_path_factory.mktemp("model")
    source = write_las(folder / "train.las", scene(seed=9), point_format=3)
    path = folder / "small.model"
    writer = {"type": "writers.classifiermodel", "filename": str(path), "count": 300, "trees": 10}
    features = {"neighborhoods": "c1,s2", "feature_set": "covariance,geometric"}
    ps.run_pipeline([str(source), {"type": "filters.hag_minima"}, {**writer, **features}])
    return path


# ---- the three doors -------------------------------------------------------------------------------------


def expected_heights(path):
    las = laspy.read(path)
    return hag_minima(np.asarray(las.x), np.asarray(las.y), np.asarray(las.z))


def test_door_1_expanded_runs_in_stock_pdal(cloud, tmp_path, pdal_program):
    out = tmp_path / "out.las"
    writer = {"type": "writers.las", "filename": str(out), "extra_dims": "all"}
    pipeline = ps.Pipeline([str(cloud), {"type": "filters.hag_minima"}, writer])
    (tmp_path / "plain.json").write_text(pipeline.json)
    assert "from pdal_stages import run_stage" in pipeline.json
    printed(pdal_program, "pipeline", tmp_path / "plain.json")
    assert np.allclose(laspy.read(out)["HeightAboveGround"], expected_heights(cloud))


def test_door_2_python_objects(cloud, pdal_module, model):
    pipeline = (
        pdal_module.Reader.las(str(cloud))
        | ps.Filter.hag_minima(cell=20, tag="h")
        | ps.Filter.modelclassifier(model=str(model), margin=True)
    )
    assert pipeline.execute() == 3000
    array = pipeline.arrays[0]
    assert np.allclose(array["HeightAboveGround"], expected_heights(cloud))
    right = np.mean(array["Classification"] == scene()["Classification"])
    assert right > 0.95
    assert array["Margin"].max() <= 1.0
    with pytest.raises(OptionError, match="Did you mean 'cell'"):
        ps.Filter.hag_minima(cel=20)


def test_door_3_filters_python_by_hand(cloud, pdal_module):
    source = "from pdal_stages import run_stage\ndef f(ins, outs):\n    return run_stage(globals(), ins, outs)\n"
    stages = [
        str(cloud),
        {
            "type": "filters.python",
            "module": "by_hand",
            "function": "f",
            "source": source,
            "pdalargs": {"stage": "filters.hag_minima", "options": {"cell": 10}},
            "add_dimension": "HeightAboveGround=double",
        },
    ]
    pipeline = pdal_module.Pipeline(json.dumps(stages))
    assert pipeline.execute() == 3000
    assert pipeline.arrays[0]["HeightAboveGround"].max() > 5


def test_a_stage_of_earlier_releases_names_the_cure(cloud):
    cure = "filters.wires' is no longer in.*class 14"
    with pytest.raises(PipelineError, match=cure):
        ps.Pipeline([str(cloud), {"type": "filters.wires"}])
    with pytest.raises(AttributeError, match=cure):
        ps.Filter.wires()


# ---- several stages in one filter ------------------------------------------------------------------------


def test_stages_that_follow_one_another_are_one_filter(cloud, model):
    """Those with tags stay apart: the same values, of dimensions that a later stage forgets too."""
    heights = {"type": "filters.hag_morphological", "ground": True, "terrain_slope": True}
    classifier = {"type": "filters.modelclassifier", "model": str(model)}
    ours = [{"type": "filters.detachednoise"}, heights, classifier, {"type": "filters.bridges"}]
    stages = [str(cloud), *ours, {"type": "filters.hag_minima"}]
    alone = [stages[0], *({**stage, "tag": f"t{n}"} for n, stage in enumerate(stages[1:]))]
    pipelines = [ps.Pipeline(each) for each in (stages, alone)]
    plain, tagged = (fuse_scripts(pipeline.expanded.stages) for pipeline in pipelines)
    assert tagged == pipelines[1].expanded.stages
    several = [[entry["stage"] for entry in stage["pdalargs"]["stages"]] for stage in plain[1:]]
    types = [stage["type"] for stage in stages[1:]]
    assert several == [types[:3], types[3:]]  # the classifier ends a row: it gives memory back
    result, expected = ([pipeline.execute(), *pipeline.arrays][1] for pipeline in pipelines)
    assert result["Slope"].any()
    assert result["Ground"].any()
    for name in expected.dtype.names:
        assert result[name].tobytes() == expected[name].tobytes(), name
    reports = [
        [[entry.to_dict() for entry in each] for _, each in pipeline.reports]
        for pipeline in pipelines
    ]
    assert reports[0] == reports[1]


# ---- class codes that do not fit -------------------------------------------------------------------------


def test_codes_above_31_need_las_14(cloud, tmp_path, wide_model):
    out = tmp_path / "out.las"
    stages = [str(cloud), {"type": "filters.modelclassifier", "model": str(wide_model)}]
    with pytest.raises(OptionError, match=r"above 31.*\"minor_version\": 4.*\"dataformat_id\": 6"):
        ps.Pipeline([*stages, {"type": "writers.las", "filename": str(out), "forward": "all"}])
    ps.run_pipeline(
        [
            *stages,
            {"type": "writers.las", "filename": str(out), "minor_version": 4, "dataformat_id": 7},
        ]
    )
    assert set(np.unique(laspy.read(out).classification)) == {2, 64}


@pytest.mark.parametrize("tiles", [None, "file"])
def test_codes_above_31_in_laz_14(tmp_path, write_las, wide_model, tiles):
    """PDAL 2.2 cannot compress them, and is not asked to; `classify` does not need it."""
    arrays = scene() | {"Withheld": (np.arange(3000) == 7).astype(np.uint8)}
    arrays["Classification"] = np.where(arrays["Withheld"], 65, arrays["Classification"]).astype(
        np.uint8
    )
    source, out = write_las(tmp_path / "in.laz", arrays, point_format=7), tmp_path / "out_#.laz"
    last = {"type": "writers.las", "filename": str(out), "forward": "all"}
    stages = [str(source), {"type": "filters.modelclassifier", "model": str(wide_model)}, last]
    if not pdal_env.compresses_las_14():
        with pytest.raises(OptionError, match=r"cannot compress LAS 1\.4.*classify"):
            ps.run_pipeline(stages)
        more = ["--tile", "10000", "--workers", "0"] if tiles else []
        assert main(["classify", str(source), str(out), "--model", str(wide_model), *more]) == 0
    elif tiles:
        run_tiled(stages, 10_000, workers=0, per=tiles)
    else:
        ps.run_pipeline(stages)
    (output,) = tmp_path.glob("out_*.laz")
    las = laspy.read(output)
    assert las.header.point_format.id == 7 and las.header.are_points_compressed
    assert np.flatnonzero(las.classification == 65).tolist() == [7] and las.withheld[7]
    assert set(np.unique(las.classification)) == {2, 64, 65}
    assert np.array_equal(las.gps_time, laspy.read(source).gps_time)
    assert not list(tmp_path.glob(".*partial*"))


# ---- views, merging, empty views -------------------------------------------------------------------------


def test_points_of_two_readers_see_each_other(tmp_path, write_las):
    arrays = scene()
    west = arrays["X"] < 500_030
    files = [
        write_las(tmp_path / f"{i}.las", {k: v[m] for k, v in arrays.items()}, point_format=3)
        for i, m in enumerate((west, ~west))
    ]
    both = ps.Pipeline([*map(str, files), {"type": "filters.hag_minima"}])
    assert [s["type"] for s in both.expanded.stages[2:]] == ["filters.merge", "filters.python"]
    assert both.execute() == 3000
    order = np.concatenate([np.flatnonzero(west), np.flatnonzero(~west)])
    whole = hag_minima(arrays["X"], arrays["Y"], arrays["Z"])[order]
    assert np.allclose(both.arrays[0]["HeightAboveGround"], whole, atol=1e-6)


def test_split_views_stay_apart(cloud, tmp_path):
    squares = {"type": "filters.splitter", "length": 30, "origin_x": 500000, "origin_y": 5400000}
    writer = {"type": "writers.las", "filename": str(tmp_path / "tile_#.las")}
    pipeline = ps.run_pipeline([str(cloud), squares, {"type": "filters.hag_minima"}, writer])
    assert len(list(tmp_path.glob("tile_*.las"))) == 4
    assert len(pipeline.reports[0][1]) == 4
    assert not list(tmp_path.glob(".*partial*"))


# ---- errors ----------------------------------------------------------------------------------------------


def test_too_many_features_for_one_las_record(cloud, tmp_path):
    writer = {"type": "writers.las", "filename": str(tmp_path / "o.las")}
    many = {
        "type": "filters.multiscalefeatures",
        "neighborhoods": "blomley2016,s1,s2",
        "feature_set": "all",
    }
    with pytest.raises(DimensionError, match="extra dimensions"):
        ps.Pipeline([str(cloud), many, {**writer, "minor_version": 4, "extra_dims": "all"}])


# ---- threads ---------------------------------------------------------------------------------------------


def test_pipelines_run_in_threads(cloud):
    features = {"type": "filters.multiscalefeatures", "neighborhoods": "c1,s2"}

    def work(_):
        pipeline = ps.run_pipeline([str(cloud), {"type": "filters.hag_minima"}, features])
        return pipeline.arrays[0]["Linearity_s2"]

    with ThreadPoolExecutor(4) as threads:
        results = list(threads.map(work, range(4)))
    assert all(np.array_equal(results[0], result) for result in results)
