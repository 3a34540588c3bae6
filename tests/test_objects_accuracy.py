"""``pdal-stages accuracy --objects``: figures against counting by hand, files, errors."""

from __future__ import annotations

import json

import numpy as np
import pytest

from pdal_stages.objects.comparison import (
    compare_buildings,
    compare_trees,
    match_by_overlap,
)

shapely = pytest.importorskip("shapely")
pyogrio = pytest.importorskip("pyogrio")


def write(path, shapes, kind="Polygon", layer=None, crs="EPSG:25832", **columns):
    pyogrio.raw.write(
        path,
        np.array([shapely.to_wkb(s) for s in shapes], object),
        [np.asarray(v) for v in columns.values()],
        list(columns),
        geometry_type=kind,
        crs=crs,
        layer=layer or "buildings",
        driver="GPKG",
    )
    return str(path)


def test_overlaps_are_matched_as_by_hand():
    rng = np.random.default_rng(2)

    def boxes(n):
        low = rng.uniform(0, 40, (n, 2))
        return [
            shapely.box(*p, *(p + s)) for p, s in zip(low, rng.uniform(2, 12, (n, 2)), strict=True)
        ]

    detected, true = boxes(60), boxes(60)
    all_pairs = sorted(
        (-f.intersection(t).area / f.union(t).area, a, b)
        for a, f in enumerate(detected)
        for b, t in enumerate(true)
        if f.intersection(t).area / f.union(t).area >= 0.3
    )
    kept, ours, other = [], set(), set()
    for _, a, b in all_pairs:
        if a not in ours and b not in other:
            ours.add(a)
            other.add(b)
            kept.append((a, b))
    assert len(kept) > 5 and sorted(match_by_overlap(detected, true, 0.3)) == sorted(kept)


def test_figures_of_buildings():
    true = [shapely.box(0, 0, 10, 10), shapely.box(20, 0, 30, 10), shapely.box(60, 0, 62, 2)]
    detected = [
        shapely.box(0, 0, 10, 10.5),
        shapely.box(20, 0, 24, 10),
        shapely.box(100, 0, 110, 10),
    ]
    got = compare_buildings(detected, true)
    assert got["objects"]["matched"] == 1 and got["objects"]["completeness"] == pytest.approx(1 / 3)
    assert got["area"]["iou"] == pytest.approx(140 / (204 + 245 - 140))
    assert got["covered"] == pytest.approx(1 / 3)
    assert got["boundary"]["p95"] == pytest.approx(0.5) and got["boundary"]["median"] == 0
    empty = compare_buildings([], true)
    assert empty["objects"]["completeness"] == 0 and np.isnan(empty["objects"]["correctness"])


def test_figures_of_trees():
    got = compare_trees(
        np.array([[0.0, 0], [10, 0]]),
        np.array([10.0, 8]),
        np.array([[1.0, 0], [11, 0]]),
        np.array([9.0, np.nan]),
    )
    assert (
        got["objects"]["matched"] == 2
        and got["height"]["bias"] == 1.0
        and got["place"]["median"] == 1.0
    )


def test_the_command(tmp_path, run):
    houses = [shapely.box(0, 0, 10, 10), shapely.box(20, 0, 30, 10)]
    detected, true = tmp_path / "found.gpkg", tmp_path / "true.gpkg"
    write(detected, houses[:1], verdict=["sure"])
    write(detected, [shapely.Point(5, 30)], "Point", "trees", height=[8.0])
    write(true, houses)
    write(true, [shapely.Point(6, 30), shapely.Point(50, 30)], "Point", "trees", height=[8.5, 9.0])
    command = ["accuracy", detected, "--objects", true, "--json", tmp_path / "a.json"]
    code, out, _ = run(*command)
    assert code == 0 and "buildings: 1 found, 2 in the reference" in out
    figures = json.loads((tmp_path / "a.json").read_text())
    assert (
        figures["buildings"]["objects"]["completeness"] == 0.5
        and figures["trees"]["objects"]["matched"] == 1
    )
    area = write(tmp_path / "area.gpkg", [shapely.box(-1, -1, 12, 40)])
    assert run(*command, "--area", area)[0] == 0
    figures = json.loads((tmp_path / "a.json").read_text())
    assert figures["buildings"]["objects"]["f1"] == 1 and figures["trees"]["objects"]["f1"] == 1


def test_errors(tmp_path, run):
    house = [shapely.box(0, 0, 10, 10)]
    detected = write(tmp_path / "found.gpkg", house)
    other = write(tmp_path / "other.gpkg", house, crs="EPSG:2154")
    (tmp_path / "cloud.laz").write_bytes(b"LASF" + b"\0" * 400)
    for command, text in (
        (["accuracy", detected, "--objects", other], "another reference system"),
        (
            ["accuracy", tmp_path / "cloud.laz", "--objects", detected],
            "pdal-stages objects classified.laz",
        ),
        (["accuracy", detected, "--objects", tmp_path / "none.gpkg"], "no such file"),
        (["accuracy", detected, detected, "--objects", other], "one vector file"),
        (
            ["accuracy", detected, "--objects", detected, "--html", "a.html"],
            "--area and --json alone",
        ),
        (["accuracy", detected, "--area", other], "--area needs --objects"),
    ):
        code, _, err = run(*command)
        assert code == 1 and text in err


@pytest.mark.data
@pytest.mark.pdal
def test_files_that_lie_apart_and_trees_without_heights_are_told(tmp_path, run):
    for name, x in (("one", 0), ("near", 5), ("far", 5000)):
        write(tmp_path / f"{name}.gpkg", [shapely.box(x, 0, x + 10, 10)])
    write(tmp_path / "bare.gpkg", [shapely.Point(1, 1)], "Point", "trees")
    write(tmp_path / "high.gpkg", [shapely.Point(1, 1)], "Point", "trees", height=[7.0])

    def message_of(found, reference):
        code, _, err = run(
            "accuracy", tmp_path / f"{found}.gpkg", "--objects", tmp_path / f"{reference}.gpkg"
        )
        assert code == 0
        return " ".join(err.split())

    assert "lie apart" not in message_of("one", "near") + message_of("one", "one")
    assert "5000 to 5010, 0 to 10" in message_of("one", "far") and "lie apart" in message_of(
        "far", "one"
    )
    assert "no heights" in message_of("high", "bare") and "no heights" not in message_of(
        "high", "high"
    )


def test_delft_against_official_outlines(tmp_path, run, data_dir):
    """Houses stand wall to wall, so they are covered rather than told apart."""
    outlines = tmp_path / "delft.gpkg"
    assert run("objects", f"{data_dir}/delft/train.laz", outlines)[0] == 0
    command = ["accuracy", outlines, "--objects", f"{data_dir}/delft/buildings_train.geojson"]
    assert run(*command, "--json", tmp_path / "a.json")[0] == 0
    figures = json.loads((tmp_path / "a.json").read_text())["buildings"]
    assert figures["covered"] >= 0.96 and figures["area"]["completeness"] >= 0.96
    assert figures["boundary"]["median"] <= 0.4


def test_heights_of_trees_may_be_texts_of_numbers_or_missing(tmp_path):
    from pdal_stages.objects.comparison import VectorObjects

    spots = [shapely.Point(10 * n, 5) for n in range(4)]
    path = write(
        tmp_path / "t.gpkg",
        spots,
        "Point",
        "trees",
        height=np.array(["12.5", "", "nan", "7"], object),
    )
    np.testing.assert_array_equal(VectorObjects.read(path).trees[1], [12.5, np.nan, np.nan, 7])
    path = write(tmp_path / "u.gpkg", spots, "Point", "trees", h_m=[1, 2, 3, 4])
    assert np.isnan(VectorObjects.read(path).trees[1]).all()


def test_heights_that_are_none(tmp_path, run, bad="12,5 m"):
    spots = [shapely.Point(0, 0), shapely.Point(9, 9)]
    first = write(tmp_path / "one.gpkg", spots, "Point", "trees", height=[4.0, 5.0])
    two = write(tmp_path / "two.gpkg", spots, "Point", "trees", height=np.array(["5", bad], object))
    code, _, errors = run("accuracy", first, "--objects", two)
    assert (
        code == 1
        and "the column 'height' must hold heights" in errors
        and bad in errors
        and "two.gpkg" in errors
    )


def test_a_damaged_file_of_objects_is_told(tmp_path, run):
    shapes = [shapely.box(10 * n, 0, 10 * n + 8, 8) for n in range(400)]
    good, bad = write(tmp_path / "good.gpkg", shapes), tmp_path / "bad.gpkg"
    data = bytearray((tmp_path / "good.gpkg").read_bytes())
    at = data.find(shapely.to_wkb(shapes[200])[:9])
    assert at > 0
    data[at + 1 : at + 5] = b"\xff\xff\xff\x7f"  # no kind of geometry
    bad.write_bytes(data)
    code, _, errors = run("accuracy", good, "--objects", bad)
    assert code in (0, 1) and "Traceback" not in errors and "report it" not in errors
    bad.write_bytes(data[: len(data) // 2])
    code, _, errors = run("accuracy", good, "--objects", bad)
    assert (
        code == 1
        and "bad.gpkg" in errors
        and "Traceback" not in errors
        and "report it" not in errors
    )
