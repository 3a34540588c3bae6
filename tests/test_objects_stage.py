"""``filters.objects`` in real pipelines: dimensions, tiles, `where`, errors."""

from __future__ import annotations

import laspy
import numpy as np
import pytest
from test_objects import conductors

import pdal_stages as ps
from pdal_stages.base.errors import StageError
from pdal_stages.pipeline.run import Pipeline
from pdal_stages.stages.base import WHOLE_CLOUD, StageContext
from pdal_stages.stages.registry import stage_type
from pdal_stages.synthetic import write_town

pytestmark = pytest.mark.pdal


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    path = tmp_path_factory.mktemp("objects") / "town.laz"
    write_town(ps.make_town(110.0, 5.0, seed=5, progress=False), path)
    return path


def run_stage(arrays, **options):
    """The stage on arrays, as PDAL's runtime calls it."""
    stage = stage_type("filters.objects")(options)
    outputs = {
        name: np.zeros(len(arrays["X"]), "u8") for name in stage.creates() if name not in arrays
    }
    return stage.run(stage.points({**arrays, **outputs}), WHOLE_CLOUD)


def stages(source, target, **options):
    writer = {"type": "writers.las", "filename": str(target), "forward": "all", "extra_dims": "all"}
    return [str(source), {"type": "filters.objects", **options}, writer]


def test_ids_of_points(town, tmp_path):
    job = Pipeline(stages(town, tmp_path / "out.laz"))
    job.execute(arrays=False)
    las = laspy.read(tmp_path / "out.laz")
    ids, codes = np.asarray(las["ObjectID"]), np.asarray(las.classification)
    assert (ids[codes == 6] > 0).mean() > 0.95 and (ids[codes == 5] > 0).mean() > 0.9
    assert not ids[codes == 2].any()
    assert set((ids[ids > 0] >> np.uint64(50)).tolist()) <= {1, 2, 3, 4}
    figures = job.reports[-1][1][-1].figures
    assert figures["buildings"]["objects"] == len(np.unique(ids[(ids >> np.uint64(50)) == 1]))


def test_a_reliability_that_one_input_lacks_is_not_taken_for_zero(town, tmp_path):
    las = laspy.read(town)
    east = np.asarray(las.x) > np.median(las.x)
    las[~east].write(tmp_path / "west.laz")
    las.add_extra_dim(laspy.ExtraBytesParams("Reliability", "f4"))
    las["Reliability"] = np.full(len(las), 0.9, np.float32)
    las[east].write(tmp_path / "east.laz")
    vector = {"type": "writers.objects", "filename": str(tmp_path / "o.geojson")}
    with pytest.raises(StageError, match="'Reliability' is missing in 1 input"):
        Pipeline([*map(str, sorted(tmp_path.glob("*.laz"))), vector]).execute(arrays=False)
    source = {"type": "readers.las", "filename": str(tmp_path / "*.laz")}
    with pytest.raises(StageError, match="'Reliability' is missing in 1 input"):
        ps.run_tiled([source, *stages("", tmp_path / "#.las")[1:]], 60, workers=0, progress=False)
    heights = {"type": "filters.hag_minima", "where": "reliability > 0.5"}
    with pytest.raises(StageError, match="'reliability' is missing in 1 input"):
        Pipeline([source, heights]).execute()


def test_a_dimension_that_one_input_lacks_and_a_stage_makes_is_read_by_any_case(town, tmp_path):
    las = laspy.read(town)
    east = np.asarray(las.x) > np.median(las.x)
    las[~east].write(tmp_path / "west.laz")
    las.add_extra_dim(laspy.ExtraBytesParams("HeightAboveGround", "f8"))
    las[east].write(tmp_path / "east.laz")
    source = {"type": "readers.las", "filename": str(tmp_path / "*.laz")}
    noise = {"type": "filters.detachednoise", "where": "heightaboveground > 2"}
    with pytest.raises(StageError, match="'heightaboveground' is missing in 1 input"):
        Pipeline([source, noise]).execute()
    Pipeline([source, {"type": "filters.hag_minima"}, noise]).execute()


def test_tiles_give_the_same(town, tmp_path):
    Pipeline(stages(town, tmp_path / "whole.laz")).execute(arrays=False)
    run = ps.run_tiled(stages(town, tmp_path / "tiled.laz"), 60, workers=0, progress=False)
    assert not run.failures
    whole, tiled = laspy.read(tmp_path / "whole.laz"), laspy.read(tmp_path / "tiled.laz")
    np.testing.assert_array_equal(whole["ObjectID"], tiled["ObjectID"])


def test_a_building_longer_than_what_a_tile_sees(tmp_path):
    x, y = (v.ravel() for v in np.meshgrid(np.arange(0, 400, 0.5), np.arange(0, 12, 0.5)))
    roof = (y > 3) & (y < 9)
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = np.full(3, 0.001)
    las = laspy.LasData(header)
    las.x, las.y, las.z = x, y, np.where(roof, 6.0, 0.0)
    las.classification = np.where(roof, 6, 2).astype(np.uint8)
    las.write(tmp_path / "row.las")
    Pipeline(stages(tmp_path / "row.las", tmp_path / "whole.laz")).execute(arrays=False)
    ps.run_tiled(
        stages(tmp_path / "row.las", tmp_path / "tiled.laz"), 100, workers=0, progress=False
    )
    whole, tiled = laspy.read(tmp_path / "whole.laz"), laspy.read(tmp_path / "tiled.laz")
    assert len(np.unique(whole["ObjectID"])) == 2
    np.testing.assert_array_equal(whole["ObjectID"], tiled["ObjectID"])


def test_where(town):
    las = laspy.read(town)
    points = {"X": las.x, "Y": las.y, "Z": las.z, "Classification": np.asarray(las.classification)}
    half = run_stage(points, where="X < 500050 || Classification == 2")
    ids = half["ObjectID"]
    assert not ids[(points["X"] >= 500050)].any() and ids[points["X"] < 500050].any()


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"buildings": [2]}, "class 2 cannot stand for"),
        ({"cell": 0}, "cell"),
    ],
)
def test_wrong_options(options, text):
    with pytest.raises(StageError, match=text):
        stage_type("filters.objects")(options)


def test_points_without_classes_or_ground():
    rng = np.random.default_rng(1)
    points = {axis: rng.uniform(0, 9, 50) for axis in "XYZ"}
    with pytest.raises(StageError, match="no point has a class"):
        run_stage({**points, "Classification": np.ones(50, np.uint8)})
    with pytest.raises(StageError, match="there is no ground"):
        run_stage({**points, "Classification": np.full(50, 6, np.uint8)})
    with pytest.raises(StageError, match="Classification"):
        run_stage(points)


def test_a_tile_without_ground_is_only_warned_of(tmp_path, write_las):
    x = np.arange(0, 900, 0.5)
    x = x[x % 30 < 20]
    x, y = np.tile(x, 8), np.repeat(np.arange(8) * 0.5, len(x))
    codes = np.where(x < 30, 2, 6).astype(np.uint8)
    points = {"X": x, "Y": y, "Z": np.where(codes == 2, 0.0, 6.0), "Classification": codes}
    source = write_las(tmp_path / "roofs.las", points)
    Pipeline(stages(source, tmp_path / "whole.laz")).execute(arrays=False)
    run = ps.run_tiled(stages(source, tmp_path / "tiled.laz"), 100, workers=0, progress=False)
    assert not run.failures
    whole, tiled = laspy.read(tmp_path / "whole.laz"), laspy.read(tmp_path / "tiled.laz")
    np.testing.assert_array_equal(whole["ObjectID"], tiled["ObjectID"])


def test_conductors_that_are_longer_than_surroundings_are_whole_in_tiles(tmp_path, write_las):
    wires, _ = conductors(4, length=900.0, slope=0.3)
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(0.0, 900, 3), np.arange(0.0, 290, 3)))
    xyz = np.concatenate([wires, np.column_stack([x, y, np.zeros(len(x))])])
    codes = np.repeat([14, 2], [len(wires), len(x)]).astype(np.uint8)
    points = {**dict(zip("XYZ", xyz.T, strict=True)), "Classification": codes}
    source = write_las(tmp_path / "line.las", points)
    Pipeline(stages(source, tmp_path / "whole.laz")).execute(arrays=False)
    run = ps.run_tiled(stages(source, tmp_path / "tiled.laz"), 300, workers=0, progress=False)
    assert not run.failures
    whole, tiled = laspy.read(tmp_path / "whole.laz"), laspy.read(tmp_path / "tiled.laz")
    assert len(np.unique(np.asarray(whole["ObjectID"])[codes == 14])) == 5
    np.testing.assert_array_equal(whole["ObjectID"], tiled["ObjectID"])


@pytest.mark.parametrize(("unit", "meters"), [("meter", 1.0), ("foot", 0.3048)])
def test_a_building_reaches_as_far_in_feet_as_in_meters(unit, meters):
    """The left 30 m of a building lie in the tile, 50 m beside it."""
    x, y = (axis.ravel() for axis in np.mgrid[1000.25:1100:0.5, 0.25:20:0.5])
    roof = (x > 1000) & (x < 1080)
    arrays = {
        "X": x / meters,
        "Y": y / meters,
        "Z": np.where(roof, 8.0, 0.0) / meters,
        "Classification": np.where(roof, 6, 2).astype(np.uint8),
        "Outside": np.where(x < 1030, -1.0, x - 1030),
    }
    stage = stage_type("filters.objects")({"horizontal_unit": unit, "vertical_unit": unit})
    context = StageContext(outside="Outside")
    reach = stage.reach_of(stage.points(arrays, context), context, (1000, 0, 1030, 20))
    assert reach == pytest.approx(50 + stage.halo_m(), abs=1.0)
