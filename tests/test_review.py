"""Where to look: cells that any order and cut makes, patches, and the command."""

from __future__ import annotations

import json
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import laspy
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdal_stages.review import review_files
from pdal_stages.review.expected_errors import RULES, ReviewCells, find_patches
from pdal_stages.review.review_files import Review, styles


def cloud(seed, n=3000, wide=60.0):
    random = np.random.default_rng(seed)
    xyz = np.round(random.random((n, 3)) * [wide, wide, 8.0] + [500_000.0, 5_400_000.0, 40.0], 3)
    return (
        xyz,
        random.choice([1, 2, 3, 5, 6, 9], n).astype(np.uint8),
        random.random(n).astype(np.float32),
    )


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 400), st.integers(1, 5))
def test_order_and_cuts_change_nothing(seed, n, parts):
    points, random = cloud(seed, n, 20.0), np.random.default_rng(seed)
    order, part = random.permutation(n), random.integers(0, parts, n)
    whole = ReviewCells.from_points(*points, 2.0)
    several = [
        ReviewCells.from_points(*(values[order[part[order] == k]] for values in points), 2.0)
        for k in range(parts)
        if (part == k).any()
    ]
    joined = ReviewCells.join(several)
    for name in ("place", "points", "parts"):
        assert np.array_equal(getattr(whole, name), getattr(joined, name)), name


def test_cells_are_what_they_say():
    xyz, codes, reliability = cloud(3)
    known = np.where(np.arange(len(codes)) % 50, reliability, np.nan)  # not known: never right
    reliability = np.nan_to_num(known)
    cells = ReviewCells.from_points(xyz, codes, known, 2.0, file=4)
    place = np.floor(xyz[:, :2] / 2.0)
    groups = [codes == 2, np.isin(codes, (3, 4, 5)), codes == 6]
    assert cells.points.sum() == sum(group.sum() for group in groups)
    for k in range(0, len(cells), 37):
        file, row, column = cells.place[k]
        inside = (place[:, 1] == row) & (place[:, 0] == column)
        assert file == 4 and cells.points[k].tolist() == [
            (inside & group).sum() for group in groups
        ]
        errors = [(1.0 - reliability[inside & group]).sum() for group in groups]
        assert np.allclose(cells.errors[k], errors, atol=1e-3)


def test_places_are_told_in_the_coordinates_of_the_files():
    shapely = pytest.importorskip("shapely")
    cells, foot = ReviewCells.from_points(*cloud(3), 2.0), 0.3048
    meters, feet = (
        Review(cells, find_patches(cells), 1, ["a.laz"], across) for across in (1.0, foot)
    )
    x, y = feet.rows[0]["at"]
    assert np.allclose(np.multiply((x, y), foot), meters.rows[0]["at"], atol=1e-3)
    assert review_files.lines(feet.to_dict())[-1].endswith(f"a.laz at {x:.1f}, {y:.1f}")
    patches = review_files.review_layers(feet)["patches"]
    assert patches.shapes[0].contains(shapely.Point(x, y))
    assert np.allclose(patches.columns["area"], shapely.area(patches.shapes), rtol=1e-3)


def test_patches_hold_each_cell_once_and_come_best_first():
    assert all("looked at" in styles(np.full(n, 0.2))["patches"] for n in (0, 1, 5))
    cells = ReviewCells.from_points(*cloud(9, 6000, 150.0), 2.0)
    patches = find_patches(cells)
    assert np.array_equal(np.unique(patches.of_cell), np.arange(len(patches)))
    assert (
        np.isclose(patches.errors.sum(), cells.errors.sum())
        and patches.points.sum() == cells.points.sum()
    )
    assert (np.diff(patches.errors / patches.minutes) <= 1e-6).all()
    for number in range(len(patches)):
        members = np.flatnonzero(patches.of_cell == number)
        assert (np.ptp(cells.corners[members][:, :2], axis=0) < RULES.block).all()
        errors = cells.errors[members].sum(axis=1)
        worst = cells.corners[members[errors == errors.max()]]
        assert patches.at[number].tolist() in (0.5 * (worst[:, :2] + worst[:, 2:])).tolist()


@pytest.fixture(scope="module")
def folder(ready_town, tmp_path_factory):
    """A town whose buildings are half called vegetation in the east, in two files, with reliabilities."""
    folder = tmp_path_factory.mktemp("review")
    shutil.copy(ready_town, folder / "town.laz")
    las = laspy.read(folder / "town.laz")
    las.add_extra_dim(laspy.ExtraBytesParams("Reliability", "float32"))
    east = np.asarray(las.x) > np.median(las.x)
    unsure = east & (np.asarray(las.classification) == 6)
    las["Reliability"] = np.where(unsure, 0.5, 0.99).astype(np.float32)
    (folder / "parts").mkdir()
    for name, side in (("east", east), ("west", ~east)):
        las[side].write(folder / "parts" / f"{name}.laz")
    las.write(folder / "whole.laz")
    return folder


@pytest.mark.pdal
def test_the_command_lists_where_a_model_was_unsure(folder, tmp_path, run):
    pytest.importorskip("pyogrio")
    out = tmp_path / "review.gpkg"
    code, output, _ = run("review", folder / "parts", out, "--json", tmp_path / "r.json")
    assert code == 0 and "east.laz" in output and "written to" in output
    figures = json.loads((tmp_path / "r.json").read_text())
    east, west = figures["tiles"]
    assert (east["tile"], west["tile"]) == ("east.laz", "west.laz")
    assert east["expected"] > 2 * west["expected"]
    assert (
        figures["worst"][0]["tile"] == "east.laz"
        and "building, reliability 0.5" in figures["worst"][0]["reason"]
    )
    assert np.isclose(figures["expected"], sum(t["expected"] for t in figures["tiles"]))
    with closing(sqlite3.connect(out)) as base:
        rank, reason, expected = zip(
            *base.execute("SELECT rank, reason, expected FROM patches ORDER BY fid"), strict=True
        )
        styles = dict(base.execute("SELECT f_table_name, styleQML FROM layer_styles"))
    assert rank == tuple(range(1, len(rank) + 1)) and all(reason) and min(expected) >= 0
    assert set(styles) == {"patches", "tiles"} and "looked at" in styles["patches"]
    # One file or two: the same is expected in all.
    assert (
        run("review", folder / "whole.laz", tmp_path / "w.gpkg", "--json", tmp_path / "w.json")[0]
        == 0
    )
    assert np.isclose(
        json.loads((tmp_path / "w.json").read_text())["expected"], figures["expected"]
    )


@pytest.mark.pdal
def test_what_speaks_against_the_worst_patches_is_named(folder, tmp_path, run):
    """Two inputs of each, in words and in the vector file; of as many patches as asked for."""
    pytest.importorskip("pyogrio")
    out = tmp_path / "review.gpkg"
    words = ["review", folder / "whole.laz", out, "--json", tmp_path / "r.json", "--reasons"]
    code, output, err = run(*words, 3)
    assert code == 0, err
    worst = json.loads((tmp_path / "r.json").read_text())["worst"]
    named = [row["against"] for row in worst]
    assert all(": " in text and text.count(";") <= 1 for text in named[:3] if text)
    assert any(named[:3]) and not any(named[3:])
    assert output.count("against it: ") == sum(map(bool, named))
    with closing(sqlite3.connect(out)) as base:
        column = base.execute("SELECT against FROM patches ORDER BY fid").fetchall()
    assert [text or "" for (text,) in column] == named[: len(column)]
    assert "against it" not in run(*words, 0)[1]
    code, _, err = run(*words[:-1])
    assert code == 0, err
    worst = json.loads((tmp_path / "r.json").read_text())["worst"]
    assert [row["against"] for row in worst[:3]] == named[:3]
    assert np.mean([bool(row["against"]) for row in worst]) > 0.8
    code, _, err = run(*words, 3, "--model", Path(__file__).parent / "data" / "frozen-3.model")
    assert code == 0, err


@pytest.mark.pdal
def test_what_is_missing_is_made_and_said(folder, tmp_path, run):
    pytest.importorskip("pyogrio")
    code, _, err = run("review", folder / "town.laz", tmp_path / "r.gpkg")
    assert code == 0 and "has no Reliability: it is computed with the model standard" in err


@pytest.mark.pdal
@pytest.mark.parametrize(
    ("words", "what"),
    [
        (["--share", "0"], "'--share'"),
        (["--cell", "0.1"], "'--cell'"),
        (["--workers", "0"], "--workers"),
    ],
)
def test_what_cannot_be_is_refused(folder, tmp_path, words, what, run):
    code, _, err = run("review", folder / "whole.laz", tmp_path / "r.gpkg", *words)
    assert code == 1 and what in err and not list(tmp_path.iterdir())


@pytest.mark.pdal
def test_points_that_nobody_classified_are_refused(folder, tmp_path, run):
    las = laspy.read(folder / "whole.laz")
    las.classification[:] = 1
    las.write(tmp_path / "raw.laz")
    code, _, err = run("review", tmp_path / "raw.laz", tmp_path / "r.gpkg")
    assert code == 1 and "no point is ground, vegetation or a building" in err
    assert run("review", folder / "whole.laz", tmp_path / "r.txt")[0] == 1


@pytest.mark.pdal
def test_files_without_points(tmp_path, run, write_las):
    """Nothing to look at, as `classify` and `objects` have nothing to do."""
    pytest.importorskip("pyogrio")
    nothing = {**dict.fromkeys("XYZ", np.zeros(0)), "Classification": np.zeros(0, np.uint8)}
    source = write_las(tmp_path / "in.las", nothing, point_format=6)
    code, output, err = run("review", source, tmp_path / "r.gpkg", "--json", tmp_path / "r.json")
    assert code == 0, err
    assert (
        "0 points judged" in output and json.loads((tmp_path / "r.json").read_text())["points"] == 0
    )
    with closing(sqlite3.connect(tmp_path / "r.gpkg")) as base:
        for name in ("patches", "tiles"):
            assert base.execute(f"select count(*) from {name}").fetchone() == (0,)


@pytest.mark.pdal
@pytest.mark.parametrize(
    ("values", "kind", "shown"),
    [
        (80.0, "f4", "80 to 80"),
        (255, "u1", "255 to 255"),
        (np.inf, "f4", "inf"),
        (-0.1, "f8", "-0.1"),
    ],
)
@pytest.mark.parametrize("command", ["review", "objects", "accuracy", "corrections"])
def test_a_reliability_beyond_0_to_1_is_refused(
    tmp_path, run, write_las, command, values, kind, shown
):
    x, y = (v.ravel() * 0.5 for v in np.meshgrid(np.arange(60.0), np.arange(60.0)))
    arrays = {"X": x, "Y": y, "Z": 0 * x, "Classification": np.full(len(x), 2, np.uint8)}
    arrays["Reliability"] = np.full(len(x), values, kind)
    source = str(write_las(tmp_path / "a.laz", arrays, point_format=6))
    words = [str(tmp_path / "o.gpkg")]
    if command == "accuracy":
        words = ["--reference", source]
    if command == "corrections":
        arrays["Classification"][:9] = 6
        words = [str(write_las(tmp_path / "after.laz", arrays, point_format=6))]
        words += ["--out", str(tmp_path / "o.gpkg.laz")]
    code, _, err = run(command, source, *words)
    assert code == 1 and "'Reliability' must be the probability" in err and shown in err
    assert not [*tmp_path.glob("o.gpkg*")]
