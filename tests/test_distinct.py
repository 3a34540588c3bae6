"""Points that come twice count once in objects, review and train: copies, overlaps, one file twice."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import laspy
import numpy as np
import pytest

import pdal_stages as ps
from pdal_stages.base.distinct import DistinctPoints, count_shared, overlaps_of, take_first
from pdal_stages.synthetic import write_town

pytest.importorskip("pyogrio")


def test_the_first_of_each_is_kept_in_any_parts():
    rng = np.random.default_rng(0)
    whole = {axis: rng.integers(0, 6, 900) * 0.001 + 1e6 for axis in "XYZ"}
    whole["GpsTime"] = rng.integers(0, 2, 900).astype(float)
    rows = np.column_stack(list(whole.values())).round(4)
    _, first = np.unique(rows, axis=0, return_index=True)
    expected = np.isin(np.arange(900), first)
    for cuts in ([], [1, 400], [300, 301, 899]):
        parts = [
            dict(zip(whole, values, strict=True))
            for values in zip(*(np.split(v, cuts) for v in whole.values()), strict=True)
        ]
        distinct = DistinctPoints()
        assert np.array_equal(np.concatenate([distinct.first(p) for p in parts]), expected)
        assert distinct.repeated == 900 - len(first)
    nudged = {**whole, "X": whole["X"] + 1e-9}  # another offset rounds otherwise
    distinct = DistinctPoints()
    distinct.first(whole)
    assert not distinct.first(nudged).any()


def test_earlier_clouds_have_the_points():
    keys = [np.array(each, np.uint64) for each in ([1, 5, 9], [5, 6], [], [1, 6, 7])]
    assert [each.tolist() for each in take_first(keys)] == [[], [5], [], [1, 6]]
    boxes = [(0, 0, 10, 10), (10, 0, 20, 10), (30, 0, 40, 10)]
    assert overlaps_of(boxes)[:2] == [[(10, 0, 10, 10)]] * 2 and overlaps_of(boxes)[2] == []
    assert overlaps_of([*boxes, None])[2] == [(30, 0, 40, 10)]


def test_points_that_clouds_share_are_counted_by_pair():
    x = np.arange(9.0)
    clouds = [{"X": x[part], "Y": x[part], "Z": x[part]} for part in np.split(np.arange(9), [4])]
    assert count_shared(clouds) == {}
    clouds += [dict.fromkeys("XYZ", x[2:6] + 1e-09)]  # another offset rounds otherwise
    assert count_shared(clouds) == {(0, 2): 2, (1, 2): 2}
    assert (
        count_shared([{**cloud, "GpsTime": cloud["X"] * 0 + n} for n, cloud in enumerate(clouds)])
        == {}
    )


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A classified town: once, with a copy of another scale, in files that overlap, twice in one file."""
    base = tmp_path_factory.mktemp("twice")
    for name in ("once", "copy", "thirds", "one", "neighbors"):
        (base / name).mkdir()
    write_town(ps.make_town(60.0, 8.0, seed=4, progress=False), base / "town.laz")
    las = laspy.read(base / "town.laz")
    las.add_extra_dim(laspy.ExtraBytesParams("Reliability", "f4"))
    las.Reliability = np.random.default_rng(0).uniform(0.5, 1, len(las))
    las.write(base / "once" / "a.laz")
    for name in ("a.laz", "a_again.laz"):
        shutil.copy(base / "once" / "a.laz", base / "copy" / name)
    east = (las.x - las.x.min()) / np.ptp(las.x)
    las[east < 0.66].write(base / "thirds" / "w.laz")
    las[east > 0.33].write(base / "thirds" / "e.laz")
    las[east < 0.5].write(base / "neighbors" / "w.laz")
    las[east >= 0.5].write(base / "neighbors" / "e.laz")
    double = laspy.LasData(las.header)
    double.points = laspy.ScaleAwarePointRecord(
        np.concatenate([las.points.array] * 2),
        las.header.point_format,
        las.header.scales,
        las.header.offsets,
    )
    double.write(base / "one" / "a.laz")
    return base, len(las), int(np.count_nonzero((east < 0.66) & (east > 0.33)))


def objects(run, source, target, workers):
    import pyogrio

    code, _, err = run(
        "objects", source, target, "--workers", workers, "--cell", 1, "--no-progress"
    )
    assert code == 0, err
    found = {}
    for name, _ in pyogrio.list_layers(target):
        _, _, geometry, fields = pyogrio.raw.read(target, layer=name)
        if name != "layer_styles":
            found[name] = (geometry.tolist(), [values.tolist() for values in fields])
    return found, err


@pytest.mark.parametrize(
    ("name", "workers"), [("copy", 1), ("copy", 2), ("thirds", 1), ("thirds", 2), ("one", 1)]
)
def test_objects_and_review_count_points_once(folders, tmp_path, run, name, workers):
    base, points, both = folders
    alone, said = objects(run, base / "once", tmp_path / "once.gpkg", 1)
    assert "come twice" not in said
    twice, said = objects(run, base / name, tmp_path / f"{name}.gpkg", workers)
    assert twice == alone
    count = {"thirds": both}.get(name, points)
    assert f"{count:,} points come twice, at the same place and time, and are counted once" in said
    expected = {}
    for folder in ("once", name):
        words = ["review", base / folder, tmp_path / "r.gpkg", "--json", tmp_path / "r.json"]
        code, _, said = run(*words, "--workers", workers, "--cell", 2, "--no-progress")
        assert code == 0, said
        figures = json.loads((tmp_path / "r.json").read_text())
        expected[folder] = figures["points"], round(figures["expected"], 3)
    assert expected[name] == expected["once"]
    assert f"{count:,} points come twice" in said


def test_files_beside_each_other_are_as_one(folders, tmp_path, run):
    base, _, _ = folders
    one, _ = objects(run, base / "once", tmp_path / "one.gpkg", 1)
    two, said = objects(run, base / "neighbors", tmp_path / "two.gpkg", 2)
    assert one == two and "twice" not in said


@pytest.mark.pdal
@pytest.mark.parametrize("name", ["copy", "thirds", "one"])
def test_train_counts_points_once(folders, tmp_path, run, name):
    base, points, both = folders
    few = ["count=60", "trees=3", "neighborhoods=k10", "folds=0", "dimensions=HeightAboveGround"]
    samples = {}
    for folder in ("once", name):
        model = tmp_path / f"{folder}.model"
        words = [f"--writers.classifiermodel.{option}" for option in few]
        code, _, said = run("train", base / folder, "--model", model, *words, "--no-progress")
        assert code == 0, said
        samples[folder] = ps.load_model(model).info["training"]["clouds"]
        assert ("come twice" in said) == (folder == name)
    assert sum(c["points"] for c in samples[name]) == sum(c["points"] for c in samples["once"])
    count = {"thirds": both}.get(name, points)
    assert f"{count:,} of {points + count:,} points come twice" in said


@pytest.mark.pdal
def test_classify_writes_every_point_and_names_the_pair(folders, tmp_path, run):
    """Also of a file beside its COPC, which are the same name but for the suffix."""
    base, points, _ = folders
    (tmp_path / "in").mkdir()
    shutil.copy(base / "once" / "a.laz", tmp_path / "in" / "a.laz")
    shutil.copy(base / "once" / "a.laz", tmp_path / "in" / "a.copc.laz")
    code, _, said = run(
        "classify", tmp_path / "in", tmp_path / "out", "--workers", 0, "--no-progress"
    )
    assert code == 0, said
    names = [str(tmp_path / "in" / name) for name in ("a.copc.laz", "a.laz")]
    assert (
        f"{names[0]} and {names[1]} have the same number of points within the same bounds" in said
    )
    counts = {path.name: len(laspy.read(path)) for path in (tmp_path / "out").glob("*.laz")}
    assert counts == {"a.laz": points, "a_copc.laz": points}


@pytest.mark.pdal
@pytest.mark.parametrize("tile", ["auto", "25"])
def test_classify_names_files_that_overlap_by_a_third(folders, tmp_path, run, tile):
    base, _, both = folders
    words = ["classify", base / "thirds", tmp_path / "out", "--tile", tile, "--workers", 0]
    code, _, said = run(*words, "--no-progress")
    assert code == 0, said
    names = [str(base / "thirds" / name) for name in ("e.laz", "w.laz")]
    assert f"{names[0]} and {names[1]} both hold {both:,} points at the same place and time" in said
    for name in names:
        written = len(laspy.read(tmp_path / "out" / Path(name).name))
        assert written == len(laspy.read(name))
    code, _, said = run("classify", base / "neighbors", tmp_path / "two", "--workers", 0)
    assert code == 0 and "same place" not in said
