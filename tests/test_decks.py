"""Bridge decks: scenes, what must hold whatever the points, the stage, real clouds."""

from __future__ import annotations

import functools
import json

import laspy
import numpy as np
import pytest
from bridge_scenes import DECK, OTHER, SCENES, Scene, Slab, scan
from hypothesis import given, settings
from hypothesis import strategies as st

from pdal_stages.cli import main
from pdal_stages.stages.base import WHOLE_CLOUD
from pdal_stages.stages.bridges import Bridges
from pdal_stages.structures.decks import DeckRules, find_decks
from pdal_stages.terrain import filtered_ground


def detect(xyz, use=None, ground=None):
    xyz = np.asarray(xyz, float)
    use = np.ones(len(xyz), bool) if use is None else use
    if ground is None:
        ground = filtered_ground(xyz, mask=use, threads=1)["Ground"] > 0
    return find_decks(*(np.ascontiguousarray(axis) for axis in xyz.T), use, ground)


@functools.cache
def seen(name, density=4.0):
    return scan(SCENES[name](), density)


def f1(deck, true, known):
    deck, true = deck & known, true & known
    return 2 * (deck & true).sum() / max(deck.sum() + true.sum(), 1)


# ---- scenes ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["viaduct", "viaduct of two decks", "river", "overpass"])
def test_decks_of_scenes_are_found(name):
    xyz, codes = seen(name, 6.0)
    deck = detect(xyz)
    assert f1(deck, codes == DECK, codes != OTHER) > 0.85
    assert (deck & ~np.isin(codes, (DECK, OTHER))).mean() < 0.002


@pytest.mark.parametrize("name", ["viaduct", "river"])
def test_without_a_deck_nothing_is_found(name):
    scene = SCENES[name]()
    scene.slabs = [slab for slab in scene.slabs if slab.code != DECK]
    assert not detect(scan(scene, 4.0)[0]).any()


@pytest.mark.parametrize(
    "roof",
    [
        Slab(-150, 150, -25, 25, lambda s: 9.0 + 0 * s, 9.0, 6),  # a hall
        Slab(-40, 40, -6, 6, lambda s: 7.0 + 0 * s, 7.0, 6),  # a row of houses
        Slab(-40, 40, -4, 4, lambda s: 0.1 * (s + 40), 9.0, 6),  # a ramp that ends in the air
    ],
)
def test_roofs_and_ramps_are_no_decks(roof):
    def terrain(s, t):
        return 0.1 * np.sin(s / 9), np.full(len(s), 2)

    assert not detect(scan(Scene(terrain, [roof], 0.2, 360.0, 120.0), 6.0)[0]).any()


def test_what_lies_beyond_the_survey_is_no_drop():
    """A strip of land, flown along a dike: nothing is known of either side."""
    rng = np.random.default_rng(0)
    strip = np.column_stack([rng.uniform(0, 200, 40_000), rng.uniform(0, 12, 40_000)])
    height = 3.0 * np.clip(1.5 - abs(strip[:, 1] - 6.0) / 4.0, 0.0, 1.0)
    xyz = np.column_stack([strip, height + rng.normal(0, 0.02, 40_000)])
    assert not detect(xyz, ground=np.ones(len(xyz), bool)).any()


# ---- properties -----------------------------------------------------------------------------------------


@settings(max_examples=3, deadline=None)
@given(st.integers(0, 100), st.tuples(st.integers(-3000, 3000), st.integers(-3000, 3000)))
def test_order_and_shifts_by_whole_cells_change_nothing(seed, cells):
    xyz, _ = seen("overpass")
    # Of binary fractions, so that shifts are exact.
    xyz = np.round(xyz - (85_000, 447_000, 0), 3) * 1024 // 1 / 1024
    ground = np.random.default_rng(seed).random(len(xyz)) < 0.9
    deck = detect(xyz, ground=ground)
    order = np.random.default_rng(seed).permutation(len(xyz))
    assert deck.any()
    assert np.array_equal(detect(xyz[order], ground=ground[order]), deck[order])
    assert np.array_equal(detect(xyz + np.array([*cells, 0]), ground=ground), deck)


def test_squares_of_a_large_cloud_give_what_the_whole_gives(monkeypatch):
    xyz = np.vstack([seen("viaduct of two decks")[0], seen("river")[0] + (700, 300, 0)])
    ground = filtered_ground(xyz, threads=1)["Ground"] > 0
    whole = detect(xyz, ground=ground)
    assert whole.sum() > 10_000
    monkeypatch.setattr("pdal_stages.terrain.pieces.LARGEST_RASTER", 100)
    monkeypatch.setattr("pdal_stages.terrain.pieces.SQUARE_SIDE", 128)
    assert np.array_equal(detect(xyz, ground=ground), whole)


def test_points_within_the_reach_are_enough():
    xyz, _ = seen("viaduct")
    ground = filtered_ground(xyz, threads=1)["Ground"] > 0
    rules = DeckRules(max_length=60, max_width=20)  # of a scene as wide as its bridge is long
    whole = find_decks(*xyz.T.copy(), np.ones(len(xyz), bool), ground, rules)
    for low in (-140, 0):
        outside = np.abs(xyz[:, 0] - 85_000 - low - 20) - 20
        near = outside < rules.reach_m
        subset = find_decks(*xyz[near].T.copy(), np.ones(near.sum(), bool), ground[near], rules)
        assert near.sum() < len(xyz)
        assert np.array_equal(subset[outside[near] < 0], whole[outside < 0])


def test_degenerate_clouds_and_points_left_out():
    clouds = [np.zeros((n, 3)) for n in (0, 1, 50)]
    clouds.append(np.random.default_rng(0).normal(0, 50, (500, 3)))
    clouds.append(np.vstack([clouds[-1], [[1e7, 1e7, 0.0]]]))
    assert not any(detect(xyz, ground=np.ones(len(xyz), bool)).any() for xyz in clouds)
    xyz, codes = seen("overpass")
    assert not detect(xyz, codes != DECK).any()


# ---- the stage, PDAL ------------------------------------------------------------------------------------


def test_bridges_leave_ground_and_buildings():
    xyz, _ = seen("overpass")
    ground = filtered_ground(xyz, threads=1)["Ground"]
    deck = np.flatnonzero(detect(xyz, ground=ground > 0))
    given_codes = np.full(len(xyz), 2, np.uint8)
    given_codes[deck[:7]] = 6, 5, 12, 18, 1, 14, 15
    arrays = dict(zip("XYZ", xyz.T.copy(), strict=True))
    arrays |= {"Classification": given_codes, "Ground": ground}
    stage = Bridges({"code": 20})
    points = stage.points(arrays)
    out = stage.run(points, WHOLE_CLOUD)["Classification"]
    assert out[deck[:7]].tolist() == [20, 5, 12, 18, 20, 14, 15]
    assert (out == 20).sum() == points.report.figures["decks"] > 0.9 * len(deck)
    assert {"1", "2", "6"} >= set(points.report.figures["left"])


def write(path, xyz):
    las = laspy.create(point_format=6, file_version="1.4")
    las.header.scales, las.header.offsets = [0.001] * 3, [85_000, 447_000, 0]
    las.x, las.y, las.z = xyz.T
    las.return_number = las.number_of_returns = np.ones(len(xyz), np.uint8)
    las.write(str(path))
    return str(path)


@pytest.mark.pdal
def test_classify_finds_decks_where_asked(tmp_path, capsys):
    xyz, codes = seen("overpass", 6.0)
    source, out = write(tmp_path / "in.las", xyz), tmp_path / "out.las"
    assert main(["classify", source, str(out), "--no-progress", "--bridges"]) == 0
    assert "bridge decks (bridges)" in capsys.readouterr().out
    written = laspy.read(out)
    assert f1(np.asarray(written.classification) == 17, codes == DECK, codes != OTHER) > 0.85
    assert set(written.point_format.extra_dimension_names) == {"HeightAboveGround", "Reliability"}
    assert main(["classify", source, str(out), "--no-progress"]) == 0
    assert not np.any(np.asarray(laspy.read(out).classification) == 17)


@pytest.mark.pdal
def test_in_tiles_as_in_one_piece_through_pdal(tmp_path):
    job = [
        write(tmp_path / "in.las", seen("river")[0]),
        {"type": "filters.hag_morphological", "ground": True, "window": 20},
        {"type": "filters.bridges"},
        {"type": "writers.las", "extra_dims": "all", "scale_z": 1e-6},
    ]
    for name, words in (("whole", ()), ("tiled", ("--tile", "100", "--workers", "0"))):
        job[-1]["filename"] = str(tmp_path / f"{name}.las")
        (tmp_path / "job.json").write_text(json.dumps(job))
        assert main(["pipeline", str(tmp_path / "job.json"), "--no-progress", *words]) == 0
    whole, tiled = (laspy.read(tmp_path / f"{name}.las") for name in ("whole", "tiled"))
    assert (np.asarray(whole.classification) == 17).sum() > 2_000
    for name in ("X", "classification", "HeightAboveGround"):
        assert np.array_equal(whole[name], tiled[name]), name


# ---- real clouds ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["seville/plazanueva.laz", "rural/lidarhd_bank.laz"])
def test_real_clouds_without_bridges_have_none(name, data_dir):
    assert not detect(laspy.read(data_dir / name).xyz).any()


def test_a_real_bridge_is_found_and_no_ground_with_it(data_dir):
    """Labels of LiDAR HD: 10,542 points of a deck, 105,034 of ground."""
    las = laspy.read(data_dir / "bridge/pont.laz")
    codes = np.asarray(las.classification)
    deck = detect(las.xyz, ~np.isin(codes, (65, 66))) & ~np.isin(codes, (3, 4, 5))
    assert f1(deck, codes == 17, np.ones(len(codes), bool)) > 0.9
    assert (deck & (codes == 2)).sum() <= 0.003 * (codes == 2).sum()
