"""Bridge decks: ways against a slow reference, what must hold whatever the points, scenes, real clouds, the stages."""

from __future__ import annotations

import functools
import json

import laspy
import numpy as np
import pytest
from bridge_scenes import DECK, GROUND, LEAF, OTHER, SCENES, Scene, Slab, scan, viaduct
from hypothesis import given, settings
from hypothesis import strategies as st
from more_bridge_scenes import MORE_SCENES, TRAPS, UPRIGHT_SCENES

import pdal_stages as ps
from pdal_stages.cli import main
from pdal_stages.stages.bridges import Bridges
from pdal_stages.stages.hag_morphological import HagMorphological
from pdal_stages.terrain import decks, walkable
from pdal_stages.terrain.cells import GAP, levels
from pdal_stages.terrain.decks import PARTS, SURFACE, find_decks, level_points
from pdal_stages.terrain.groundcells import FilterOptions
from pdal_stages.terrain.morphological import filtered_ground
from pdal_stages.terrain.walkable import ACROSS, DOWN, NOTHING, ON, ROUGH, SMOOTH, SOLID, WALLED


def found(xyz, use=None):
    use = np.ones(len(xyz), bool) if use is None else use
    return find_decks(*(np.ascontiguousarray(axis) for axis in np.asarray(xyz, float).T), use)


@functools.cache
def seen(name, density=4.0):
    return scan({**SCENES, **MORE_SCENES}[name](), density)


def small(seed=0, water=False):
    """A bridge of 8 m over a ditch of 20 m, a wall, a tree, a roof: the pieces that kernels tell apart."""

    def terrain(s, t):
        z = -np.clip((10.5 - np.abs(s)) * 0.9, 0, 5.0)
        if water:
            z = np.where(np.abs(s) < 7, np.where(np.sin(97 * s + 31 * t) > 0.9, -5.0, np.nan), z)
        return z, np.full(len(s), GROUND)

    slabs = [
        Slab(-11, 11, -4, 4, lambda s: 0.0 * s, 1.0, DECK),
        Slab(-9, -4, 0, 1.8, lambda s: 1.5 + 0.0 * s, 1.5, OTHER),
    ]
    slabs.append(Slab(14, 24, 8, 16, lambda s: 4.0 + 0.4 * (s - 14), 4.0, 6))
    return scan(Scene(terrain, slabs, [(-18.0, -10.0, 3.0, 8.0)], 0.3, 56.0, 40.0), 6.0, seed)


# ---- a slow reference -----------------------------------------------------------------------------------


def slow_levels(xyz):
    cells = {}
    for x, y, z in xyz:
        cells.setdefault((int(np.floor(y)), int(np.floor(x))), []).append(z)
    out = {}
    for cell, heights in cells.items():
        heights = sorted(heights)
        out[cell] = [z for n, z in enumerate(heights) if n == 0 or z - heights[n - 1] > GAP]
    return out


def slow_kinds(held):
    def plane(cell, z, steep, around, least):
        rows = []
        for b in range(-around, around + 1):
            for a in range(-around, around + 1):
                near = [
                    q
                    for q in held.get((cell[0] + b, cell[1] + a), ())
                    if abs(q - z) <= 0.35 + steep * np.hypot(a, b)
                ]
                if near:
                    rows.append((a, b, min(near, key=lambda q: (abs(q - z), -q)) - z))
        if len(rows) < least:
            return None
        a = np.array(rows)
        if np.linalg.det(np.cov(a[:, :2].T, bias=True)) < 0.05:
            return None
        design = np.column_stack([a[:, :2], np.ones(len(a))])
        fit = np.linalg.lstsq(design, a[:, 2], rcond=None)[0]
        return np.hypot(*fit[:2]), np.mean((design @ fit - a[:, 2]) ** 2)

    kinds = {}
    for cell, heights in held.items():
        ring = [(cell[0] + b, cell[1] + a) for b in (-1, 0, 1) for a in (-1, 0, 1)]
        for z in heights:
            near = sum(
                any(
                    abs(q - z) <= 0.35 + 0.25 * np.hypot(c[0] - cell[0], c[1] - cell[1])
                    for q in held.get(c, ())
                )
                for c in ring
            )
            kind = ROUGH
            if 2 * near >= sum(c in held for c in ring):
                wide, narrow, roof = (
                    plane(cell, z, 0.25, 2, 7),
                    plane(cell, z, 0.25, 1, 6),
                    plane(cell, z, 1.5, 2, 7),
                )
                if (wide and wide[0] <= 0.25 and wide[1] <= 0.12**2) or (
                    narrow and narrow[0] <= 0.25 and narrow[1] <= 0.06**2
                ):
                    kind = SOLID
                elif roof and roof[0] <= 1.5 and roof[1] <= 0.12**2 * (1 + roof[0] ** 2):
                    kind = SMOOTH
            kinds[cell, z] = kind
    return kinds


def slow_ways(held, kinds, most=600):
    """Of each level and direction: how far to a drop or to nothing, which of them it is, and how it ends at once."""
    directions = list(zip(walkable.RIGHT.tolist(), walkable.UP.tolist(), strict=True))

    @functools.cache
    def go(cell, z, d):
        di, dj = directions[d]
        straight = di * dj == 0
        edge, ahead = (3, 5) if straight else (2, 4)
        for s in range(1, ahead + 1):
            there = cell[0] + s * dj, cell[1] + s * di
            far = s * np.hypot(di, dj)
            steps = [
                q
                for q in held.get(there, ())
                if kinds[there, q] == SOLID and abs(q - z) <= 0.35 + 0.25 * far
            ]
            if steps:
                way, last, _ = go(there, min(steps, key=lambda q: (abs(q - z), -q)), d)
                way = None if way is None else way + s * (10 if straight else 14)
                return (None, WALLED, ON) if way is None or way > most else (way, last, ON)
            if any(q < z - max(2.0, 1.25 * far) for q in held.get(there, ())):
                # Something to step on farther ahead comes first.
                farther = [
                    (t * np.hypot(di, dj), (cell[0] + t * dj, cell[1] + t * di))
                    for t in range(s + 1, ahead + 1)
                ]
                if not any(
                    kinds[c, q] == SOLID and abs(q - z) <= 0.35 + 0.25 * away
                    for away, c in farther
                    for q in held.get(c, ())
                ):
                    return 0, DOWN, DOWN
        patch = [(s, 0) for s in range(edge + 1, ahead + 1)]
        patch += [(s, side) for s in range(edge + 1, ahead + 2) for side in (-1, 0, 1)]
        for s, side in patch:
            there = cell[0] + s * dj + side * di, cell[1] + s * di - side * dj
            if any(q < z + 1.5 or kinds[there, q] != ROUGH for q in held.get(there, ())):
                return None, WALLED, WALLED
        nothing, far_below = True, False
        for there, heights in held.items():
            b, a = there[0] - cell[0], there[1] - cell[1]
            r2, along = a * a + b * b, (a * di + b * dj) / np.hypot(di, dj)
            if along <= 0:
                continue
            turn = np.degrees(np.arccos(min(along / np.sqrt(r2), 1.0)))
            q = heights[0]
            if r2 <= 16**2 and r2 > 4 and turn <= 30 + 1e-9 and q < z - 1.2:
                return 0, ACROSS, ACROSS
            if (
                r2 <= 16**2
                and turn <= 45 + 1e-9
                and along > 5 + 1e-9
                and (q < z + 1.5 or kinds[there, q] != ROUGH)
            ):
                nothing = False
            if r2 <= 80**2 and turn <= 60 + 1e-9 and q < z - max(3.0, 0.1 * np.sqrt(r2)):
                far_below = True
        if nothing:
            return (0, ACROSS, ACROSS) if far_below else (0, NOTHING, NOTHING)
        return None, WALLED, WALLED

    return {
        (*key, d): go(*key, d) for key, kind in kinds.items() if kind == SOLID for d in range(8)
    }


@pytest.mark.parametrize(("seed", "water"), [(0, False), (1, True)])
def test_the_kernels_equal_the_slow_reference(seed, water):
    xyz = small(seed, water)[0] - (85_000, 447_000, 0)
    held = slow_levels(xyz)
    column, row = np.floor(xyz[:, :2].T).astype(np.int64)
    left, bottom = column.min(), row.min()
    h, w = row.max() + 1 - bottom, column.max() + 1 - left
    cell = (row - bottom) * w + column - left
    order, begins = levels(xyz[:, 2], cell)
    lowest = order[begins]
    z, start = xyz[lowest, 2], np.searchsorted(cell[lowest], np.arange(h * w + 1))
    cells = [(k // w + bottom, k % w + left) for k in np.repeat(np.arange(h * w), np.diff(start))]
    assert sorted(zip(cells, z, strict=True)) == sorted(
        (c, q) for c, heights in held.items() for q in heights
    )
    assert np.array_equal(xyz[lowest, 2], z)
    kinds = slow_kinds(held)
    kind = walkable.surfaces(z, start, h, w)
    assert kind.tolist() == [kinds[c, q] for c, q in zip(cells, z, strict=True)]
    assert {ROUGH, SMOOTH, SOLID} <= set(kind.tolist())
    way, last, end = walkable.ways(z, start, h, w, kind, 600)
    slow = slow_ways(held, kinds)
    ends = set()
    for n in np.flatnonzero(kind == SOLID):
        for d in range(8):
            far, at, how = slow[cells[n], z[n], d]
            assert (way[n, d], last[n, d], end[n, d]) == (
                walkable.ENDLESS if far is None else far,
                at,
                how,
            )
            ends.add(how)
    assert {ON, DOWN, WALLED} <= ends and (not water or ACROSS in ends)


# ---- scenes ---------------------------------------------------------------------------------------------


def f1(deck, true, known):
    deck, true = deck & known, true & known
    return 2 * (deck & true).sum() / max(deck.sum() + true.sum(), 1)


@pytest.mark.parametrize("name", [*SCENES, *MORE_SCENES])
def test_decks_of_scenes_are_found_whole(name):
    xyz, codes = seen(
        name, 8.0 if name == "walled ramps" else 4.0
    )  # walls show their faces in dense clouds
    deck = found(xyz) > 0
    assert f1(deck, codes == DECK, codes != OTHER) > (
        0.86 if name in ("skewed", "overpass") else 0.9
    )
    wrong = deck & ~np.isin(codes, (DECK, OTHER, LEAF))
    assert wrong.mean() < 0.002  # a strip of a meter at the ends


@pytest.mark.parametrize("name", UPRIGHT_SCENES)
def test_bridges_whose_ground_is_seen_or_whose_river_is_not_are_found(name):
    xyz, codes = UPRIGHT_SCENES[name](6.0)
    deck = found(xyz) > 0
    assert deck[codes == DECK].mean() > 0.9 and (deck & (codes != DECK)).mean() < 0.005


@pytest.mark.parametrize("name", TRAPS)
def test_what_is_no_bridge_is_none(name):
    xyz, codes = scan(TRAPS[name](), 8.0)
    assert (found(xyz)[codes != OTHER] > 0).mean() < 0.005


def test_without_a_bridge_nothing_is_found():
    for name in ("viaduct", "river"):
        scene = SCENES[name]()
        scene.slabs = [slab for slab in scene.slabs if slab.code != DECK]
        xyz, _ = scan(scene, 4.0)
        assert not found(xyz).any(), name


def test_wires_side_by_side_are_no_deck():
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(0, 150, (2, 50_000)).T, rng.normal(0, 0.03, 50_000)])
    along = np.arange(0, 150, 0.3)
    wires = [
        np.column_stack([along, np.full_like(along, 60 + 2.0 * k), np.full_like(along, 20.0)])
        for k in range(8)
    ]
    assert not found(np.vstack([ground, *wires])).any()


def test_a_town_of_roofs_and_wires_has_no_false_decks():
    """Its own bridges lie 1.4 m above the water, which is no drop."""
    town = ps.make_town(150.0, 6.0, 1, progress=False)
    assert (found(town.xyz) > 0)[town.classification != DECK].sum() <= 0.0005 * len(town.xyz)


def test_a_hall_of_300_meters_is_no_viaduct():
    def terrain(s, t):
        return 0.1 * np.sin(s / 9), np.full(len(s), GROUND)

    slabs = [Slab(-150, 150, -25, 25, lambda s: 9.0 + 0 * s, 9.0, 6)]
    slabs.append(
        Slab(-150, -149.8, -60, -25, lambda s: 9.0 + 0 * s, 0.1, 14)
    )  # a wire that hangs on to it
    xyz, _ = scan(Scene(terrain, slabs, [], 0.2, 360.0, 120.0), 6.0)
    assert not found(xyz).any()


def test_a_deck_that_the_rim_of_the_cloud_cuts():
    xyz, codes = seen("viaduct")
    cut = xyz[:, 0] < 85_010
    deck = found(xyz[cut]) > 0
    assert f1(deck, codes[cut] == DECK, codes[cut] != OTHER) > 0.9


# ---- properties ---------------------------------------------------------------------------------------


@settings(max_examples=3, deadline=None)
@given(st.integers(0, 100), st.tuples(st.integers(-3000, 3000), st.integers(-3000, 3000)))
def test_order_and_shifts_by_whole_cells_change_nothing(seed, cells):
    xyz, _ = small(seed % 3, seed % 2 == 0)
    # Of binary fractions, so that shifts are exact.
    xyz = np.round(xyz - (85_000, 447_000, 0), 3) * 1024 // 1 / 1024
    deck = found(xyz)
    order = np.random.default_rng(seed).permutation(len(xyz))
    assert np.array_equal(found(xyz[order]), deck[order])
    assert np.array_equal(found(xyz + np.array([*cells, 0])), deck)


def test_squares_of_a_large_cloud_give_what_the_whole_gives(monkeypatch):
    xyz = np.vstack([seen("viaduct of two decks")[0], seen("river")[0] + (700, 300, 0)])
    whole = found(xyz)
    assert (whole > 0).sum() > 10_000
    monkeypatch.setattr("pdal_stages.terrain.cells.LARGEST", 100)
    monkeypatch.setattr("pdal_stages.terrain.cells.SIDE", 128)
    assert np.array_equal(found(xyz), whole)


@functools.cache
def long_viaduct():
    return scan(viaduct(reach=420.0, length=1100.0), 2.0)


def test_a_long_viaduct_in_tiles_as_in_one_piece():
    xyz, codes = long_viaduct()
    whole = found(xyz)
    assert f1(whole > 0, codes == DECK, codes != OTHER) > 0.85
    for low in (-340, 200):
        core = (xyz[:, 0] >= 85_000 + low) & (xyz[:, 0] < 85_000 + low + 120)
        near = (xyz[:, 0] >= 85_000 + low - decks.REACH) & (
            xyz[:, 0] < 85_000 + low + 120 + decks.REACH
        )
        assert near.sum() < len(xyz)
        assert np.array_equal(found(xyz[near])[core[near]], whole[core])


def test_levels_of_far_points_stand_for_all():
    xyz, _ = seen("viaduct")
    near = np.abs(xyz[:, 0] - 85_000) < 40
    left = level_points(*xyz.T.copy(), np.ones(len(xyz), bool))
    assert len(left) < 0.6 * len(xyz)
    some = np.union1d(left, np.flatnonzero(near))
    assert np.array_equal(found(xyz[some])[np.isin(some, np.flatnonzero(near))], found(xyz)[near])


def test_degenerate_clouds_and_points_left_out():
    clouds = [np.zeros((n, 3)) for n in (0, 1, 50)] + [
        np.random.default_rng(0).normal(0, 50, (500, 3))
    ]
    assert not any(found(xyz).any() for xyz in clouds)
    far = np.vstack([np.random.default_rng(0).uniform(0, 9, (200, 3)), [[1e7, 1e7, 0.0]]])
    assert not found(far).any()
    xyz, codes = seen("overpass")
    use = codes != DECK
    assert not found(xyz, use).any()


# ---- heights, stages, PDAL ------------------------------------------------------------------------------


def test_the_terrain_runs_below_the_deck():
    xyz, codes = seen("viaduct")
    made = filtered_ground(xyz, decks=True)
    on = (made["Deck"] == SURFACE) & (codes == DECK)
    middle = on & (np.hypot(*(xyz[:, :2] - (85_000, 447_000)).T) < 80)
    assert not made["Ground"][made["Deck"] > 0].any()
    assert (
        np.abs(made["HeightAboveGround"][middle] - xyz[middle, 2]).max() < 0.6
    )  # the land is at 0
    plain = filtered_ground(xyz)
    land = (codes == GROUND) & (np.abs(xyz[:, 0] - 85_000) > 140)
    assert np.array_equal(plain["Ground"][land], made["Ground"][land])
    assert "Deck" not in plain


def test_the_stage_says_what_it_makes_and_how_far_it_looks():
    plain, made = HagMorphological({}), HagMorphological({"decks": True})
    assert "Deck" not in plain.creates() and made.creates()["Deck"] == "uint8_t"
    assert plain.halo_m() <= made.halo_m() == FilterOptions(decks=True).reach_of_points < 820
    assert Bridges({}).halo_m() == 0 and Bridges({}).largest_class() == 17


def test_bridges_leave_ground_and_buildings():
    codes = np.array([2, 6, 5, 6, 2, 5, 12, 7, 6], np.uint8)
    deck = np.array([1, 1, 1, 2, 2, 2, 1, 1, 0], np.uint8)
    arrays = {name: np.zeros(9) for name in "XYZ"} | {"Classification": codes, "Deck": deck}
    stage = Bridges({})
    points = stage.points(arrays)
    assert stage.run(points)["Classification"].tolist() == [17, 17, 17, 17, 17, 5, 12, 7, 6]
    figures = points.report.figures
    assert (figures["decks"], figures["parts"], figures["left"]) == (5, 2, {"2": 2, "5": 1, "6": 2})
    stage = Bridges({"code": 20, "keep": "", "where": "Deck == 1"})
    assert stage.run(stage.points(arrays))["Classification"].tolist() == [
        20,
        20,
        20,
        6,
        2,
        5,
        20,
        7,
        6,
    ]


def write(path, xyz):
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = [0.001] * 3, [85_000, 447_000, 0]
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    las.return_number = las.number_of_returns = np.ones(len(xyz), np.uint8)
    las.write(str(path))


@pytest.mark.pdal
def test_classify_finds_decks_unless_told_not_to(tmp_path, capsys):
    xyz, codes = seen("overpass", 6.0)
    write(tmp_path / "in.las", xyz)
    out = tmp_path / "out.las"
    assert main(["classify", str(tmp_path / "in.las"), str(out), "--no-progress"]) == 0
    assert "bridge decks (bridges)" in capsys.readouterr().out
    made = laspy.read(out)
    assert f1(np.asarray(made.classification) == 17, codes == DECK, codes != OTHER) > 0.85
    assert set(made.point_format.extra_dimension_names) == {"HeightAboveGround", "Reliability"}
    assert (
        main(["classify", str(tmp_path / "in.las"), str(out), "--no-progress", "--no-bridges"]) == 0
    )
    assert not np.any(np.asarray(laspy.read(out).classification) == 17)


@pytest.mark.pdal
def test_in_tiles_as_in_one_piece_through_pdal(tmp_path):
    xyz, _ = long_viaduct()
    write(tmp_path / "in.las", xyz)
    job = [
        str(tmp_path / "in.las"),
        {"type": "filters.hag_morphological", "decks": True, "window": 20},
        {"type": "filters.assign", "value": "Classification = 2"},
        {"type": "filters.bridges"},
        {
            "type": "writers.las",
            "filename": str(tmp_path / "whole.las"),
            "extra_dims": "all",
            "scale_z": 1e-6,
        },
    ]
    (tmp_path / "job.json").write_text(json.dumps(job))
    assert main(["pipeline", str(tmp_path / "job.json"), "--no-progress"]) == 0
    job[-1]["filename"] = str(tmp_path / "tiled.las")
    (tmp_path / "job.json").write_text(json.dumps(job))
    assert (
        main(
            [
                "pipeline",
                str(tmp_path / "job.json"),
                "--tile",
                "200",
                "--workers",
                "0",
                "--no-progress",
            ]
        )
        == 0
    )
    whole, tiled = laspy.read(tmp_path / "whole.las"), laspy.read(tmp_path / "tiled.las")
    assert (np.asarray(whole.classification) == 17).sum() > 10_000
    for name in ("X", "classification", "Deck", "HeightAboveGround"):
        assert np.array_equal(whole[name], tiled[name]), name


# ---- real clouds ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name",
    [
        "seville/plazanueva.laz",
        "isprs_filter/samp21.laz",
        "rural/ahn4_powerline.laz",
        "rural/lidarhd_bank.laz",
    ],
)
def test_real_clouds_without_bridges_have_none(name, data_dir):
    las = laspy.read(data_dir / name)
    assert (found(las.xyz) > 0).sum() <= 0.0005 * len(las)


def test_the_bridge_of_delft_over_a_canal_is_found(data_dir):
    las = laspy.read(data_dir / "delft/train.laz")
    near = np.hypot(las.x - 84_946, las.y - 447_460) < 60
    deck, true = found(las.xyz[near]), np.asarray(las.classification)[near] == 26
    assert f1(deck > 0, true, np.ones(len(deck), bool)) > 0.75
    assert (deck == PARTS).any()
