"""Towers: supports of generated corridors, what holds no wires, tiles, the stage, a real tower."""

from __future__ import annotations

import functools

import laspy
import numpy as np
import pytest
from corridor_scenes import CORRIDORS
from scipy.cluster.hierarchy import fcluster, linkage

from pdal_stages.stages.base import WHOLE_CLOUD
from pdal_stages.stages.wires import Wires
from pdal_stages.structures import towers
from pdal_stages.structures import wires as lines
from pdal_stages.structures.towers import find_towers
from pdal_stages.structures.wires import find_wires
from pdal_stages.terrain.heights import filtered_ground


@functools.cache
def scene(name):
    xyz, codes = CORRIDORS[name](8.0 if name == "highest voltage" else 4.0)  # whose towers are wide
    height = filtered_ground(xyz)["HeightAboveGround"]
    return xyz, codes, height, find_wires(xyz, height, np.ones(len(xyz), bool))


def detect(xyz, height, wire):
    return find_towers(xyz, height, wire, np.ones(len(xyz), bool))


@pytest.mark.parametrize(
    ("name", "share"),
    [
        ("highest voltage", 1.0),
        ("high voltage, uphill", 1.0),
        ("two lines beside each other", 0.8),
    ],
)
def test_supports_of_lines(name, share):
    xyz, codes, height, wire = scene(name)
    tower = detect(xyz, height, wire)
    true = np.flatnonzero(codes == 15)
    support = fcluster(linkage(xyz[true, :2], "single"), 8, "distance")
    held = [tower[true[support == k]].mean() >= 0.5 for k in range(1, support.max() + 1)]
    assert np.mean(held) >= share
    false = tower & ~np.isin(codes, (14, 15))
    assert false.sum() <= 0.0005 * len(xyz)
    # What stands alone, as lamps and masts do, is no support.
    assert not tower[codes == 1].any()


def test_without_wires_there_are_no_towers():
    xyz, codes, height, wire = scene("two lines beside each other")
    assert not detect(xyz, height, np.zeros(len(xyz), bool)).any()
    assert not find_towers(xyz, height, wire, codes == 2).any()
    for few in (
        np.empty((0, 3)),
        np.zeros((1, 3)),
        np.random.default_rng(0).normal(0, 30, (300, 3)),
    ):
        for kind in (np.zeros(len(few), bool), np.ones(len(few), bool)):
            assert not detect(few, few[:, 2], kind).any()


def test_wires_that_do_not_rise_have_no_support():
    xyz, _, height, wire = scene("two lines beside each other")
    level = np.where(
        wire, xyz[:, 2] - height + 8.0, xyz[:, 2]
    )  # no sag: nothing tells where they are held
    assert not detect(np.column_stack([xyz[:, :2], level]), np.where(wire, 8.0, height), wire).any()


@pytest.mark.parametrize("name", ["two lines beside each other", "high voltage, uphill"])
def test_order_of_points_and_tiles_change_nothing(name):
    xyz, _, height, wire = scene(name)
    whole = detect(xyz, height, wire)
    order = np.random.default_rng(0).permutation(len(xyz))
    assert np.array_equal(detect(xyz[order], height[order], wire[order]), whole[order])
    middle = np.median(xyz[whole, 1])
    for low in (middle - 40.0, middle - 3.5, middle + 11.0):
        core = (xyz[:, 1] >= low) & (xyz[:, 1] < low + 30)
        near = (xyz[:, 1] >= low - towers.RULES.reach_m) & (
            xyz[:, 1] < low + 30 + towers.RULES.reach_m
        )
        assert near.sum() < 0.8 * len(xyz)
        assert np.array_equal(detect(xyz[near], height[near], wire[near])[core[near]], whole[core])


def test_a_real_tower(data_dir):
    las = laspy.read(data_dir / "rural/ahn4_powerline.laz")
    codes = np.asarray(las.classification)
    real = codes != 26  # cranes that were added by computer
    height = filtered_ground(las.xyz, mask=real)["HeightAboveGround"]
    tower = find_towers(las.xyz, height, find_wires(las.xyz, height, real), real)
    assert tower[codes == 15].mean() > 0.8
    assert np.isin(codes[tower], (1, 14, 15)).all()  # its feet, up to 6 m, have no label
    assert (codes[tower] == 14).mean() < 0.08  # ends of wires
    place = las.xyz[tower]
    away = np.hypot(*(place[:, :2] - las.xyz[codes == 15, :2].mean(axis=0)).T)
    # The next tower stands beyond the eastern edge: its insulators are in the cloud, without label.
    assert np.all((away < 15) | (place[:, 0] > las.xyz[:, 0].max() - 7))


def test_the_stage_gives_towers_their_class():
    xyz, codes, height, wire = scene("two lines beside each other")
    before = np.where(np.isin(codes, (14, 15)), 5, codes).astype(np.uint8)
    arrays = dict(zip("XYZ", xyz.T.copy(), strict=True)) | {
        "Classification": before,
        "HeightAboveGround": height,
    }
    stage = Wires({"towers": True, "tower_code": 65})
    points = stage.points(arrays)
    after = stage.run(points, WHOLE_CLOUD)["Classification"]
    tower = detect(xyz, height, wire)
    assert np.array_equal(after, np.where(tower, 65, np.where(wire, 14, before)))
    assert points.report.figures["towers"] == tower.sum() > 1000
    assert (
        points.report.figures["left"]["5"]
        == (after != before).sum() - (tower & (before != 5)).sum()
    )
    assert (
        stage.halo_m() == lines.RULES.reach_m + towers.RULES.reach_m
        and max(stage.written_classes()) == 65
    )
