"""Wires: what must hold whatever the points, a scene, the generated town, real clouds, the stage."""

from __future__ import annotations

import functools

import laspy
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pdal_stages as ps
import pdal_stages.synthetic
from pdal_stages.stages.base import WHOLE_CLOUD
from pdal_stages.stages.wires import Wires
from pdal_stages.structures import wires
from pdal_stages.structures.wires import find_wires
from pdal_stages.terrain.heights import filtered_ground


def f1(detect, true):
    return 2 * (detect & true).sum() / max(detect.sum() + true.sum(), 1)


@functools.cache
def scene(seed=0, density=8.0, side=150):
    """Two spans of three conductors between towers, trees, a house with a straight ridge and gutters, lamps, a crane."""
    rng = np.random.default_rng(seed)
    n = int(side * side * density)
    ground = np.column_stack([rng.uniform(0, side, (2, n)).T, rng.normal(0, 0.03, n)])
    parts, codes = [ground], [np.full(n, 2)]

    def add(points, code):
        parts.append(points)
        codes.append(np.full(len(points), code))

    for k in range(3):  # lowest between the towers
        s = rng.uniform(0, side, int(side * 4))
        z = 14 + 3 * k + 0.0009 * (75**2 - (np.abs(s - 75) - 75) ** 2)
        wire = np.column_stack([s, 30 + 0.4 * s + 0.3 * k, z])
        add(wire + rng.normal(0, (0, 0.03, 0.03), wire.shape), 14)
    for x, y in ((40, 110), (60, 115), (120, 20), (100, 15)):
        m = 1500
        p = rng.normal(0, 1, (m, 3))
        p *= (rng.random(m) ** (1 / 3) / np.linalg.norm(p, axis=1))[:, None]
        add(p * (4, 4, 5) + (x, y, 9), 5)
    u, v = rng.uniform(-15, 15, 3000), rng.uniform(-6, 6, 3000)
    add(np.column_stack([90 + u, 125 + v, 9 - 0.6 * np.abs(v)]), 6)
    jib = np.linspace(0, 25, 200)
    add(np.column_stack([10 + 0.3 * jib, 100 + 0.6 * jib, 3 + 0.8 * jib]), 26)
    for x in range(10, 140, 12):
        add(np.column_stack([np.full(20, x), np.full(20, 8.0), np.linspace(0, 8, 20)]), 1)
    return np.round(np.vstack(parts), 3), np.concatenate(codes)


def detect(xyz, use=None):
    return find_wires(xyz, xyz[:, 2], np.ones(len(xyz), bool) if use is None else use)


def test_wires_are_found_and_nothing_else():
    xyz, codes = scene(1)
    wire = detect(xyz)
    assert f1(wire, codes == 14) > 0.95
    assert (wire & (codes != 14)).sum() < 0.0005 * len(xyz)
    left = codes != 14
    assert not detect(xyz[left]).any()


@settings(max_examples=3, deadline=None)
@given(st.integers(0, 100), st.tuples(st.integers(-3000, 3000), st.integers(-3000, 3000)))
def test_order_and_shifts_by_whole_cells_change_nothing(seed, cells):
    xyz, _ = scene(seed % 2, 2.0)
    xyz = np.floor(xyz * 1024) / 1024
    wire = detect(xyz)
    order = np.random.default_rng(seed).permutation(len(xyz))
    assert np.array_equal(detect(xyz[order]), wire[order])
    shifted = xyz + np.array([*cells, 0])
    assert np.array_equal(find_wires(shifted, xyz[:, 2], np.ones(len(xyz), bool)), wire)


def test_a_tile_with_its_surroundings_gets_what_the_whole_gets():
    xyz, _ = scene(0)
    whole = detect(xyz)
    for low in (2.0, 5.5, 40.0):
        core = (xyz[:, 0] >= low) & (xyz[:, 0] < low + 20)
        near = (xyz[:, 0] >= low - wires.RULES.reach_m) & (
            xyz[:, 0] < low + 20 + wires.RULES.reach_m
        )
        assert near.sum() < len(xyz) and whole[core].any()
        assert np.array_equal(detect(xyz[near])[core[near]], whole[core])


def test_degenerate_clouds_and_points_left_out():
    for xyz in (
        np.empty((0, 3)),
        np.zeros((1, 3)),
        np.full((50, 3), 9.0),
        np.random.default_rng(0).normal(0, 50, (500, 3)),
    ):
        assert not detect(xyz).any()
    xyz, codes = scene(0)
    assert not detect(xyz, codes != 14).any()


def edge(kind, density):
    """A house 70 m long: a terrace in front of its upper floor, a cornice under a steep roof, or a balcony on its wall."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform((0, 0), (140, 80), (int(140 * 80 * density), 2)).T
    inside, away, z = (x > 30) & (x < 100), np.abs(y - 40), np.zeros(len(x))
    wall = rng.uniform((30, 29.92, 0), (100, 29.98, 20), (int(140 * density), 3))  # hit from aside
    if kind == "terrace":
        z[inside & (away < 10)] = 20.0
        z[(x > 33) & (x < 97) & (away < 7)] = 24.0
    elif kind == "cornice":
        house = inside & (away < 10)
        z[house] = np.where(away > 8.8, 12.0, 13.5 + 1.2 * (10 - away))[house]
    else:
        z[inside & (away < 10)] = 20.0
        z[inside & (y > 28.6) & (y <= 30)] = 6.0
    xyz = np.column_stack([x, y, z + rng.normal(0, 0.05, len(x))])
    return np.round(np.vstack([xyz, wall] if kind == "balcony" else [xyz]), 3)


@pytest.mark.parametrize(
    ("kind", "density"), [("terrace", 1.0), ("cornice", 1.0), ("balcony", 2.0)]
)
def test_what_hides_the_ground_is_no_wire(kind, density):
    xyz = edge(kind, density)
    assert detect(xyz).sum() <= 0.001 * len(xyz)


def test_a_street_of_poles_in_the_town():
    town = ps.synthetic.make_town(150.0, 6.0, 4, progress=False)
    wire = find_wires(town.xyz, town.height_above_ground.astype(float), town.classification != 7)
    assert f1(wire, town.classification == 14) > 0.85
    assert (wire & ~np.isin(town.classification, (14, 15))).sum() < 0.0005 * len(wire)


def test_the_stage_gives_wires_their_class():
    xyz, codes = scene(0)
    before = np.where(codes == 14, 5, codes).astype(np.uint8)
    before[np.flatnonzero(codes == 14)[:5]] = 12
    arrays = dict(zip("XYZ", xyz.T.copy(), strict=True)) | {
        "Classification": before,
        "HeightAboveGround": xyz[:, 2].copy(),
    }
    stage = Wires({})
    points = stage.points(arrays)
    after = stage.run(points, WHOLE_CLOUD)["Classification"]
    wire = detect(xyz) & (before != 12)
    assert np.array_equal(after, np.where(wire, 14, before))
    assert points.report.figures["wires"] == wire.sum()
    assert stage.halo_m() == wires.RULES.reach_m < 90 and max(stage.written_classes()) == 14


def test_a_corridor(data_dir):
    las = laspy.read(data_dir / "rural/ahn4_powerline.laz")
    codes = np.asarray(las.classification)
    real = codes != 26  # cranes that were added by computer
    height = filtered_ground(las.xyz, mask=real)["HeightAboveGround"]
    wire = find_wires(las.xyz, height, real)
    assert f1(wire, codes == 14) > 0.9
    assert (wire & ~np.isin(codes, (14, 15))).sum() < 0.001 * len(codes)


@pytest.mark.parametrize("name", ["isprs_filter/samp41", "seville/plazanueva", "rural/ign_0p3ppm2"])
def test_clouds_without_wires(name, data_dir):
    las = laspy.read(data_dir / f"{name}.laz")
    height = filtered_ground(las.xyz)["HeightAboveGround"]
    assert find_wires(las.xyz, height, np.ones(len(las), bool)).sum() <= 0.0005 * len(las)
