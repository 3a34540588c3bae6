"""Where to look: records that any order and cut makes, signals as their definitions say, patches, and the command."""

from __future__ import annotations

import json
import sqlite3
from pathlib import Path

import laspy
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pdal_stages as ps
from pdal_stages import cli
from pdal_stages.review import (
    Calibration,
    Records,
    Settings,
    find_patches,
    outlook,
    side_for,
    standard_calibration,
)
from pdal_stages.review.cells import BINS, GROUP_OF, NONE, PARTS, rows_and_columns
from pdal_stages.review.expected import BOUNDS, binned
from pdal_stages.review.signals import FAR, NEAR, signals
from pdal_stages.synthetic import write_town

FIELDS = (
    "key",
    "points",
    "expected",
    "unsure",
    "doubtful",
    "contrary",
    "low",
    "lowest",
    "highest",
    "wrong",
    "known",
    "strip",
    "of_strip",
)


def points(seed, n=3000, wide=60.0):
    random = np.random.default_rng(seed)
    return {
        "xyz": np.round(random.random((n, 3)) * [wide, wide, 8.0] + [500_000.0, 5_400_000.0, 40.0], 3),
        "codes": random.choice([1, 2, 3, 5, 6, 9], n).astype(np.uint8),
        "reliability": np.round(random.random(n) * 64) / 64,
        "height": random.normal(2, 3, n),
        "truth": random.choice([0, 2, 5, 6], n).astype(np.uint8),
        "strip": random.integers(3, 7, n).astype(np.uint16),
    }


def records(given, rows=slice(None), tile=0, side=2.0):
    rates = standard_calibration().rates
    part = {name: values[rows] for name, values in given.items()}
    xyz, codes, truth = part["xyz"], part["codes"], part["truth"]
    return Records.of(
        xyz,
        codes,
        part["reliability"],
        part["height"],
        side,
        rates,
        tile=tile,
        truth=truth,
        strip=part["strip"],
    )


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 400), st.integers(1, 5))
def test_order_and_cuts_change_nothing(seed, n, parts):
    cloud, random = points(seed, n, 20.0), np.random.default_rng(seed)
    whole = records(cloud)
    order = random.permutation(n)
    of = random.integers(0, parts, n)
    joined = Records.join([records(cloud, order[of[order] == k], k) for k in range(parts) if (of == k).any()])
    for name in FIELDS:
        assert np.array_equal(getattr(whole, name), getattr(joined, name)), name
    assert whole.points.sum() == n
    one, other = (outlook(each, standard_calibration()) for each in (whole, joined))
    assert np.array_equal(one.total, other.total)


def test_records_are_what_they_say():
    cloud = points(3)
    made = records(cloud)
    cell = np.floor(cloud["xyz"][:, :2] / 2.0).astype(int)
    group = GROUP_OF[cloud["codes"]]
    row, column = rows_and_columns(made.key)
    for k in range(0, len(made), 37):
        mine = (cell[:, 1] == row[k]) & (cell[:, 0] == column[k])
        assert made.points[k].tolist() == np.bincount(group[mine], minlength=4).tolist()
        z = np.rint(cloud["xyz"][mine, 2] * 1000)
        assert (made.lowest[k], made.highest[k]) == (z.min(), z.max())
        ground = z[group[mine] == 0]
        assert made.low[k] == (ground.min() if len(ground) else NONE)
        wrong = mine & (cloud["truth"] > 0) & (GROUP_OF[cloud["truth"]] != group)
        assert made.wrong[k].sum() == wrong.sum()


def test_strips_that_disagree():
    xyz = np.column_stack([np.full(40, 1.0), np.full(40, 1.0), np.arange(40.0)])
    strip = np.repeat([7, 9], 20)
    rates = standard_calibration().rates
    same = np.tile(np.array([2, 6], np.uint8), 20)
    other = np.repeat(np.array([2, 6], np.uint8), 20)
    for codes, expected in ((same, 0), (other, 20)):
        made = Records.of(xyz, codes, np.ones(40), np.zeros(40), 2.0, rates, strip=strip)
        assert made.disagreeing.tolist() == [expected]
        assert Records.of(xyz, codes, np.ones(40), np.zeros(40), 2.0, rates).disagreeing.tolist() == [0]


def test_signals_are_what_their_definitions_say():
    """Held against sums and minima over all cells, one by one."""
    cloud = points(5, 2500, 90.0)
    hole = (np.abs(cloud["xyz"][:, 0] - 500_040) < 9) & (cloud["codes"] == 2)
    cloud["codes"][hole] = 5
    made = records(cloud)
    found, side = signals(made), made.side
    row, column = rows_and_columns(made.key)
    near, far = round(NEAR / side), round(FAR / side)
    low = made.low / 1000.0
    there = made.low < NONE
    for k in range(0, len(made), 41):
        dr, dc = row - row[k], column - column[k]
        close = (np.abs(dr) <= near) & (np.abs(dc) <= near)
        shares = made.points[close].sum(axis=0) / made.points[close].sum()
        assert np.allclose(found.around[k], shares)
        rate = made.expected[close, 0].sum() / PARTS / max(made.points[close, 0].sum(), 1)
        assert np.isclose(found.rate_around[k, 0], rate)
        away = np.hypot(dr, dc)[there].min() * side
        assert np.isclose(found.void[k], min(away, FAR))
        if there[k]:
            lower = []
            for line, ahead in ((dr == 0, dc), (dr == 0, -dc), (dc == 0, dr), (dc == 0, -dr)):
                mine = line & (ahead > 0) & (ahead <= far) & there
                lower.append(low[mine].min() if mine.any() else np.inf)
            raised = low[k] - max(lower) if np.isfinite(max(lower)) else 0.0
            assert np.isclose(found.raised[k], max(raised, 0.0)), k
            assert np.isclose(found.relief[k], np.ptp(low[close & there]))


def test_blocks_have_no_seams():
    """Cells on both sides of the border of the grid's blocks get what they get elsewhere."""
    cloud = points(8, 4000, 60.0)
    cloud["xyz"] -= cloud["xyz"].min(axis=0)
    shifted = dict(cloud, xyz=cloud["xyz"] + [512 * 2.0 - 30.0, 512 * 2.0 - 30.0, 0.0])
    one, other = signals(records(cloud)), signals(records(shifted))
    for name, values in vars(one).items():
        assert np.array_equal(np.sort(values, axis=0), np.sort(getattr(other, name), axis=0)), name


def test_a_calibration_makes_expected_and_true_agree(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks" / "surveys"))
    from calibrating import learned_factors, learned_rates

    random = np.random.default_rng(0)
    bins = np.stack([random.integers(0, len(b) + 1, 20_000) for b in BOUNDS.values()], axis=1)
    rate, known = np.full(20_000, 0.05), np.full(20_000, 40.0)
    true_rate = 0.05 * np.where(bins[:, 0] > 4, 0.4, 2.0)
    wrong = random.poisson(true_rate * known).astype(float)
    base, factors = learned_factors(
        bins, rate, wrong, known, np.ones(20_000), strength=30.0, rounds=60, trust=1.0
    )
    found = base * rate * known
    for column, factor in enumerate(factors):
        found = found * factor[bins[:, column]]
    assert abs(found.sum() / wrong.sum() - 1) < 0.01
    for low in (True, False):
        mine = (bins[:, 0] > 4) == low
        assert abs(found[mine].sum() / wrong[mine].sum() - 1) < 0.05
    wrong = np.zeros((1, 4, *BINS))
    rates = learned_rates(wrong, wrong + 100.0, np.ones(1))
    assert ((rates > 0) & (rates < 0.05)).all()


def test_a_calibration_is_the_same_after_a_file():
    own = standard_calibration()
    again = Calibration.from_json(own.to_json())
    assert np.array_equal(own.rates, again.rates) and own.known == again.known
    assert own.to_json() == again.to_json()
    found = signals(records(points(1)))
    assert np.array_equal(own.shares(found), again.shares(found))
    assert binned(found, 2).max() <= max(map(len, BOUNDS.values()))


def test_patches_hold_each_cell_once_and_come_best_first():
    seen = outlook(records(points(9, 6000, 150.0)), standard_calibration())
    found = find_patches(seen, Settings())
    assert np.array_equal(np.unique(found.of_cell), np.arange(len(found)))
    assert np.isclose(found.errors.sum(), seen.total.sum()) and found.points.sum() == 6000
    worth = found.errors / found.minutes
    assert (np.diff(worth) <= 1e-6).all()
    row, column = rows_and_columns(seen.records.key)
    for number in range(len(found)):
        mine = found.of_cell == number
        box = [column[mine].min(), row[mine].min(), column[mine].max() + 1, row[mine].max() + 1]
        assert found.box[number].tolist() == [2.0 * v for v in box]
        assert max(box[2] - box[0], box[3] - box[1]) * 2.0 <= Settings().block
        assert found.reasons[number]


def test_cells_grow_where_points_are_few():
    assert side_for(8_000_000, 1_000_000.0) == 1.0
    assert side_for(300_000, 1_000_000.0) == 4.0
    assert side_for(10**10, 1e9) == 8.0  # 1,000 square kilometers: not more cells than memory holds
    assert side_for(1, 1_000_000.0) == 16.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A town whose buildings are half called vegetation in the east, in two files, with heights and reliabilities."""
    folder = tmp_path_factory.mktemp("review")
    write_town(ps.make_town(100.0, 6.0, seed=3, progress=False), folder / "town.laz")
    las = laspy.read(folder / "town.laz")
    height = ps.hag_minima(np.asarray(las.xyz)).astype(np.float32)
    las.add_extra_dim(laspy.ExtraBytesParams("HeightAboveGround", "float32"))
    las.add_extra_dim(laspy.ExtraBytesParams("Reliability", "float32"))
    las["HeightAboveGround"] = height
    east = np.asarray(las.x) > np.median(las.x)
    unsure = east & (np.asarray(las.classification) == 6)
    las["Reliability"] = np.where(unsure, 0.5, 0.99).astype(np.float32)
    (folder / "parts").mkdir()
    for name, mine in (("east", east), ("west", ~east)):
        part = laspy.LasData(las.header)
        part.points = las.points[mine]
        part.write(folder / "parts" / f"{name}.laz")
    las.write(folder / "whole.laz")
    return folder


@pytest.mark.pdal
def test_the_command_lists_where_a_model_was_unsure(folder, tmp_path, capsys):
    pytest.importorskip("pyogrio")
    out = tmp_path / "review.gpkg"
    assert cli.main(["review", str(folder / "parts"), str(out), "--json", str(tmp_path / "r.json")]) == 0
    said = capsys.readouterr().out
    assert "east.laz" in said and "written to" in said
    figures = json.loads((tmp_path / "r.json").read_text())
    east, west = figures["tiles"]
    assert (east["tile"], west["tile"]) == ("east.laz", "west.laz") and east["expected"] > 3 * west[
        "expected"
    ]
    assert figures["worst"][0]["tile"] == "east.laz" and "unsure" in figures["worst"][0]["reason"]
    assert np.isclose(figures["expected"], sum(t["expected"] for t in figures["tiles"]))
    page = (tmp_path / "review.html").read_text()
    assert page.count("<article>") == min(40, figures["listed"]) and "Where to look" in page
    base = sqlite3.connect(out)
    rank, reason, expected = zip(
        *base.execute("SELECT rank, reason, expected FROM patches ORDER BY fid"), strict=True
    )
    styles = dict(base.execute("SELECT f_table_name, styleQML FROM layer_styles"))
    base.close()
    assert rank == tuple(range(1, len(rank) + 1)) and all(reason) and min(expected) >= 0
    assert set(styles) == {"patches", "tiles"} and "looked at" in styles["patches"]
    # In two processes: the same.
    again = [
        "review",
        str(folder / "parts"),
        str(tmp_path / "again.gpkg"),
        "--workers",
        "2",
        "--pictures",
        "0",
    ]
    assert cli.main([*again, "--json", str(tmp_path / "again.json")]) == 0
    assert json.loads((tmp_path / "again.json").read_text()) == figures
    # One file or two: the same cells are expected to hold the same.
    assert cli.main(["review", str(folder / "whole.laz"), str(tmp_path / "w.gpkg"), "--json", str(tmp_path / "w.json"),
                     "--pictures", "0"]) == 0  # fmt: skip
    whole = json.loads((tmp_path / "w.json").read_text())
    assert whole["expected"] == figures["expected"] and whole["listed"] == figures["listed"]
    assert [w["box"] for w in whole["worst"]] == [w["box"] for w in figures["worst"]]


@pytest.mark.pdal
def test_what_is_missing_is_made_and_said(folder, tmp_path, capsys):
    pytest.importorskip("pyogrio")
    out = str(tmp_path / "r.gpkg")
    assert cli.main(["review", str(folder / "town.laz"), out, "--pictures", "1"]) == 0
    said = capsys.readouterr()
    assert "has no Reliability and no HeightAboveGround: made now by the model standard" in said.err
    las = laspy.read(folder / "whole.laz")
    las.remove_extra_dim("HeightAboveGround")
    las.write(tmp_path / "flat.laz")
    assert cli.main(["review", str(tmp_path / "flat.laz"), out, "--pictures", "0"]) == 0
    assert "has no HeightAboveGround: made now\n" in capsys.readouterr().err


@pytest.mark.pdal
@pytest.mark.parametrize(
    ("words", "what"),
    [
        (["--share", "0"], "'--share'"),
        (["--cell", "0"], "'--cell'"),
        (["--pictures", "-1"], "'--pictures'"),
        (["--workers", "0"], "'--workers'"),
    ],
)
def test_what_cannot_be_is_refused(folder, tmp_path, words, what, capsys):
    assert cli.main(["review", str(folder / "whole.laz"), str(tmp_path / "r.gpkg"), *words]) == 1
    assert what in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.pdal
def test_points_that_nobody_classified_are_refused(folder, tmp_path, capsys):
    las = laspy.read(folder / "whole.laz")
    las.classification[:] = 1
    las.write(tmp_path / "raw.laz")
    assert cli.main(["review", str(tmp_path / "raw.laz"), str(tmp_path / "r.gpkg")]) == 1
    assert "no point is ground, vegetation or a building" in capsys.readouterr().err
    assert cli.main(["review", str(folder / "whole.laz"), str(tmp_path / "r.txt")]) == 1
