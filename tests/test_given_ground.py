"""Ground that is given forms the surface, stays ground, and nothing far from it joins it."""

from pathlib import Path

import laspy
import numpy as np
import pytest

import pdal_stages as ps
from pdal_stages.base.errors import StageError
from pdal_stages.classifier.model import load_model
from pdal_stages.cli import main
from pdal_stages.pipeline.classify_request import ClassifyRequest
from pdal_stages.pipeline.json_source import parse_overrides
from pdal_stages.stages.registry import stage_from
from pdal_stages.terrain.filter_options import FilterOptions
from pdal_stages.terrain.heights import filtered_ground
from pdal_stages.terrain.smrf import reach_of_given

DATA = Path(__file__).parent / "data"
OPTIONS = FilterOptions(openings=(5, 17))


def clip(name):
    las = laspy.read(DATA / f"{name}.laz")
    return np.asarray(las.xyz), np.asarray(las.classification)


@pytest.fixture
def edited(tmp_path):
    """A clip whose ground a person edited: a terrace of the roofs is ground, and a strip of ground is not marked."""
    las = laspy.read(DATA / "city.laz")
    codes, (x, y, _) = np.array(las.classification), np.asarray(las.xyz).T
    part = (x < x.min() + 30) & (y < y.min() + 30)
    las.points = las.points[part]
    codes, x = codes[part], x[part]
    known = (codes == 2) & ((x < x.min() + 10) | (x > x.min() + 14))
    known[np.flatnonzero(codes == 6)[:40]] = True
    las.classification = np.where(known, 2, 1).astype(np.uint8)
    las.write(tmp_path / "edited.laz")
    return tmp_path / "edited.laz"


def far_from(xyz, given):
    """Which points (n,) have a height above given ground beyond the tolerance."""
    result = filtered_ground(xyz, ground=given, slope_too=True)
    slope = np.tan(np.radians(result["Slope"]))
    return np.abs(result["HeightAboveGround"]) > OPTIONS.threshold + OPTIONS.scalar * slope + 0.05


@pytest.mark.parametrize("name", ["city", "canals", "riverbank", "woods"])
def test_the_surface_is_that_of_the_ground_that_is_given(name):
    xyz, codes = clip(name)
    ground, figures = codes == 2, {}
    known = filtered_ground(xyz, ground=ground, openings=(5, 17), figures=figures)
    result = filtered_ground(xyz, openings=(5, 17))
    height = np.abs(known["HeightAboveGround"][ground])
    assert np.percentile(height, 99) < 0.25 and known["Ground"][ground].all()
    assert np.percentile(height, 99) < np.percentile(
        np.abs(result["HeightAboveGround"][ground]), 99
    )
    assert not known["Ground"][far_from(xyz, ground) & ~ground].any()
    for window in (5, 17):  # of all points, ground or not
        name = f"HeightAboveOpening_{window}"
        assert np.array_equal(known[name], result[name])
    assert figures["ground_points"] == np.count_nonzero(known["Ground"])


def test_points_as_far_as_its_reach_decide():
    """A part of a cloud gives the same bits with the reach around it, in any order."""
    xyz, codes = clip("woods")
    whole = filtered_ground(xyz, ground=codes == 2, openings=(5, 17))
    middle = np.abs(xyz[:, 0] - np.median(xyz[:, 0])) < 20
    near = np.flatnonzero(np.abs(xyz[:, 0] - np.median(xyz[:, 0])) < 20 + reach_of_given(OPTIONS))
    assert len(near) < 0.9 * len(xyz)
    near = np.random.default_rng(0).permutation(near)
    part = filtered_ground(xyz[near], ground=codes[near] == 2, openings=(5, 17))
    for name, values in part.items():
        assert np.array_equal(values[middle[near]], whole[name][near][middle[near]]), name


def test_only_points_near_enough_may_become_ground():
    xyz, _ = clip("riverbank")
    model = load_model("standard")
    free = model.predict(xyz, margin=True)
    may = np.arange(len(xyz)) % 2 == 0
    bound = model.predict(xyz, may_be_ground=may, margin=True)
    assert not (bound.classification[~may] == 2).any()
    same = may | (free.classification != 2)
    assert np.array_equal(bound.classification[same], free.classification[same])
    moved = ~same
    assert moved.any() and (bound.reliability[moved] <= 0.5).all() and not bound.margin[moved].any()
    assert bound.report.figures["too_far_for_ground"] == np.count_nonzero(moved)


def classified(path, out, *words):
    assert main(["classify", str(path), str(out), "--ground", "given", *words]) == 0
    las = laspy.read(out)
    return np.asarray(las.xyz), np.asarray(las.classification), las


@pytest.mark.pdal
def test_classify_keeps_the_ground_that_is_given(edited, tmp_path, capsys):
    known = np.asarray(laspy.read(edited).classification) == 2
    xyz, codes, las = classified(edited, tmp_path / "out.laz")
    assert (codes[known] == 2).all()
    assert not (codes[far_from(xyz, known) & ~known] == 2).any()
    assert (codes[~known] == 2).sum() > 500  # the strip that was not marked
    assert {5, 6} <= set(codes.tolist())
    heights = filtered_ground(xyz, ground=known)["HeightAboveGround"]
    assert np.allclose(las["HeightAboveGround"], heights, atol=1 / 32)
    result = tmp_path / "found.laz"
    assert main(["classify", str(edited), str(result)]) == 0
    assert (np.asarray(laspy.read(result).classification)[known] != 2).sum() > 20  # the terrace
    assert "other heights" not in capsys.readouterr().err


@pytest.mark.pdal
def test_classes_to_keep_are_joined_by_the_ground():
    overrides, _ = parse_overrides(["--filters.modelclassifier.keep=9,17"])
    request = ClassifyRequest(overrides=tuple(overrides), bridges=True, given_ground=True)
    (bridges,) = (stage for stage in request.stages if stage["type"] == "filters.bridges")
    assert stage_from(bridges).keep.codes == (9, 17, 2, 11)


@pytest.mark.pdal
def test_tiles_give_the_same(edited, tmp_path):
    _, whole, _ = classified(edited, tmp_path / "whole.laz")
    _, tiles, _ = classified(edited, tmp_path / "tiles.laz", "--tile", "12", "--workers", "0")
    assert np.array_equal(whole, tiles)


@pytest.mark.pdal
def test_without_ground_there_is_none_to_take(tmp_path, capsys):
    las = laspy.read(DATA / "city.laz")
    las.classification = np.ones(len(las.x), np.uint8)
    las.points = las.points[:2000]
    las.write(tmp_path / "none.laz")
    words = ["classify", str(tmp_path / "none.laz"), str(tmp_path / "o.laz"), "--ground", "given"]
    assert main(words) == 1
    assert "none of the points has class 2, 9 or 11" in capsys.readouterr().err


@pytest.mark.pdal
def test_given_ground_in_a_pipeline_and_in_a_model(edited, tmp_path):
    """A model that was trained on given ground says so, and `classify` then takes what is given."""
    las = laspy.read(DATA / "city.laz")
    keep = {"type": "filters.ferry", "dimensions": "Classification=>Reference"}
    heights = {"type": "filters.hag_morphological", "given_ground": True, "ground": True}
    write = {"type": "writers.classifiermodel", "filename": str(tmp_path / "m.model"), "label": "Reference",
             "classes": {"2": 2, "6": 6, "3,4,5": 5}, "neighborhoods": "k10", "count": 300, "trees": 5,
             "passes": 1, "folds": 0, "dimensions": "HeightAboveGround,Ground"}  # fmt: skip
    las.write(tmp_path / "labeled.laz")
    ps.run_pipeline([str(tmp_path / "labeled.laz"), keep, heights, write])
    model = load_model(tmp_path / "m.model")
    assert model.info["preparation"] == [heights]
    known = np.asarray(laspy.read(edited).classification) == 2
    assert main(["classify", str(edited), str(tmp_path / "o.laz"), "--model", str(tmp_path / "m.model")]) == 0  # fmt: skip
    assert (np.asarray(laspy.read(tmp_path / "o.laz").classification)[known] == 2).all()
    with pytest.raises(StageError, match="HeightAboveGround"):
        load_model(tmp_path / "m.model").predict(np.asarray(las.xyz))  # without classes
    (warning,) = load_model(tmp_path / "m.model").outdated or [None]
    assert warning is None


@pytest.fixture
def harbor(tmp_path):
    """A quay with a house, a road on it, and a basin whose water and road are labeled as such."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, 120, 60_000), rng.uniform(0, 80, 60_000)
    water, road = (x > 60) & (x < 110), (x > 40) & (x < 50)
    house = (x > 10) & (x < 25) & (y > 20) & (y < 40)
    cloud = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
    cloud.header.scales = [0.001] * 3
    cloud.x, cloud.y = x, y
    cloud.z = np.where(water, 0.0, np.where(house, 9.0, 3.0)) + rng.normal(0, 0.02, len(x))
    cloud.classification = np.select([water, road, house], [9, 11, 1], 2).astype(np.uint8)
    cloud.return_number[:] = cloud.number_of_returns[:] = 1
    cloud.write(tmp_path / "harbor.laz")
    return tmp_path / "harbor.laz"


@pytest.mark.pdal
def test_water_and_roads_that_are_given_are_ground_and_keep_their_class(harbor, tmp_path):
    before = np.asarray(laspy.read(harbor).classification)
    _, codes, las = classified(harbor, tmp_path / "o.laz", "--bridges")
    surface = before != 1
    assert np.array_equal(codes[surface], before[surface])
    assert np.percentile(np.abs(las["HeightAboveGround"][surface]), 95) < 0.25
    assert np.mean(codes[~surface] == 6) > 0.9
    heights = {"type": "filters.hag_morphological", "given_ground": True, "ground": True}
    heights["openings"] = [5, 17]
    classifier = {"type": "filters.modelclassifier", "model": "standard", "given_ground": True}
    writer = {"type": "writers.las", "filename": str(tmp_path / "json.laz"), "extra_dims": "all"}
    ps.run_pipeline([str(harbor), heights, classifier, writer])
    result = laspy.read(tmp_path / "json.laz")
    assert np.array_equal(result.classification, codes)
