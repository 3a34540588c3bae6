"""Towers and poles: scenes, a slow reference, what must hold whatever the points, the stage."""

from __future__ import annotations

import json
import math
from itertools import product

import laspy
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdal_stages.cli import main
from pdal_stages.pipeline.classify_request import ClassifyRequest
from pdal_stages.stages.base import WHOLE_CLOUD
from pdal_stages.stages.towers import Towers
from pdal_stages.structures.towers import RULES, find_towers

GROUND, TREE, HOUSE, WIRE, TOWER = 2, 5, 6, 14, 15  # codes of ASPRS
#: South-west corner of the scenes: coordinates as surveys have them.
CORNER = np.array([85_000.0, 447_000.0, 3.0])


def slope(x, y):
    """Return the ground's height."""
    return 0.03 * x + 0.02 * y


def box(random, low, high, density):
    """Return random points in a box, by points per cubic meter."""
    count = random.poisson(density * np.prod(np.subtract(high, low)))
    return random.uniform(low, high, (count, 3))


def line(places, height=20.0, tower=True, length=120.0, density=4.0, seed=0):
    """Return points above the ground (n, 3), x along the line, and their classes.

    Conductors hang at `places` (across, above `height`); towers stand at 20, 70 and 120 m.
    """
    random = np.random.default_rng(seed)
    parts = [(box(random, (0, -40, 0), (length, 40, 0.05), density / 0.05), GROUND)]
    for across, above in places:
        x = np.arange(0.0, length, 0.6) + random.uniform(0, 0.1)
        part = ((x - 20.0) / 50.0) % 1.0
        hangs = height + above - 1.5 - 8.0 * part * (1 - part)
        parts.append((np.column_stack([x, np.full(len(x), across), hangs]), WIRE))
    top = height + max(above for _, above in places)
    for x in np.arange(20.0, length, 50.0) if tower else ():
        half = max(0.4, 0.05 * height)
        parts.append((box(random, (x - half, -half, 0.5), (x + half, half, top + 1.0), 1.5), TOWER))
        for _, above in places:
            wide, z = max(abs(a) for a, _ in places) + 0.5, height + above
            parts.append((box(random, (x - 0.4, -wide, z - 0.4), (x + 0.4, wide, z), 4.0), TOWER))
    return join(parts)


def join(parts):
    """Return points (n, 3) and codes (n,) of parts."""
    codes = np.concatenate([np.full(len(xyz), code, np.uint8) for xyz, code in parts])
    return np.concatenate([xyz for xyz, _ in parts]), codes


def lattice():
    """Return a line of three levels on towers, with trees below, beside and in it, and a house."""
    random = np.random.default_rng(5)
    places = [(side * apart, up) for up, apart in ((0, 7), (5, 5), (10, 3)) for side in (-1, 1)]
    xyz, codes = line(places)
    parts = [(xyz, codes)]
    trees = ((45, 0, 9, 12), (95, 18, 6, 26), (60, -30, 5, 18), (100, 0, 5, 22))
    for x, y, wide, high in trees:
        parts.append((box(random, (x - wide, y - wide, 1), (x + wide, y + wide, high), 0.5), TREE))
    parts.append((box(random, (10, 20, 0), (40, 35, 8), 0.6), HOUSE))
    every = [
        np.concatenate(each)
        for each in zip(
            *[(xyz, np.broadcast_to(code, len(xyz))) for xyz, code in parts], strict=True
        )
    ]
    return every[0], every[1].astype(np.uint8)


def detect(heights, codes):
    """Return what is found where points have these heights above a slope, all but wires trees."""
    usable = np.ones(len(codes), bool)
    return find_towers(on_slope(heights), heights[:, 2], usable, codes == WIRE)


def on_slope(heights):
    """Return coordinates of points with heights above ground."""
    xyz = heights + CORNER
    xyz[:, 2] += slope(heights[:, 0], heights[:, 1])
    return xyz


# ---- scenes -------------------------------------------------------------------------------------


def test_towers_of_a_line_are_found_and_trees_are_not():
    heights, codes = lattice()
    tower = detect(heights, codes)
    high = heights[:, 2] > RULES.min_height_m
    assert tower[(codes == TOWER) & high].mean() > 0.97
    assert not tower[codes != TOWER].any()


@pytest.mark.parametrize("density", [1.0, 4.0])
def test_poles_of_a_low_line_are_found(density):
    places = [(-0.4, 0.0), (0.0, 0.0), (0.4, 0.0)]
    heights, codes = line(places, height=9.0, density=density)
    tower = detect(heights, codes)
    assert tower[(codes == TOWER) & (heights[:, 2] > RULES.min_height_m)].mean() > 0.9
    assert not tower[codes != TOWER].any()


def test_without_wires_there_are_no_towers():
    heights, codes = lattice()
    assert not detect(heights, np.where(codes == WIRE, TREE, codes)).any()
    kept = codes != WIRE
    assert not detect(heights[kept], codes[kept]).any()
    assert not detect(heights[:0], codes[:0]).any()
    assert not detect(heights, np.full_like(codes, WIRE)).any()


def test_wires_without_towers_have_none():
    heights, codes = line([(-2.0, 0.0), (2.0, 0.0)], tower=False)
    assert not detect(heights, codes).any()


# ---- the definition -----------------------------------------------------------------------------


def slow_towers(xyz, height, wire, rules=RULES):
    """Return what :func:`find_towers` finds, cube by cube."""
    cubes, wires = {}, {}
    for n, (place, above) in enumerate(zip(np.floor(xyz / rules.cube_m), height, strict=True)):
        if wire[n] or above > rules.min_height_m:
            (wires if wire[n] else cubes).setdefault(tuple(map(int, place)), []).append(n)

    def apart(one, other, axes=3):
        return rules.cube_m * math.dist(one[:axes], other[:axes])

    limits, out = {}, np.zeros(len(xyz), bool)
    for cube in cubes:
        near = [height[n] for w in wires for n in wires[w] if apart(w, cube, 2) <= rules.near_m]
        if near:
            cut = max(rules.min_height_m, rules.head_ratio * min(near))
            cuts = [cut, *(max(cut, ratio * max(near)) for ratio in rules.higher_ratios)]
            limits[cube] = cuts, max(near)
    for number in range(1 + len(rules.higher_ratios)):
        spacing = {}
        for cube, (cuts, _) in limits.items():
            if out[cubes[cube]].any() or max(height[cubes[cube]]) <= cuts[number]:
                continue
            cell = np.floor((np.array(cube[:2]) + 0.5) * rules.cube_m / rules.density_m)
            count = (np.floor(xyz[:, :2] / rules.density_m) == cell).all(axis=1).sum()
            gap = rules.link_spacings * rules.density_m / math.sqrt(count)
            spacing[cube] = min(max(gap, rules.min_link_m), rules.max_link_m)
        left = set(spacing)
        lowest = {cube: limits[cube][0][number] for cube in left}
        highest = {cube: limits[cube][1] for cube in left}
        while left:
            head, new = set(), {left.pop()}
            while new:
                cube = new.pop()
                head.add(cube)
                linked = {c for c in left if apart(c, cube) <= max(spacing[c], spacing[cube])}
                left -= linked
                new |= linked
            out[slow_tower(cubes, wires, head, height, lowest, highest, apart, rules)] = True
    return out


def slow_tower(cubes, wires, head, height, lowest, highest, apart, rules):
    """Return the points of a head and under it, if it is a tower's."""
    points = [n for cube in head for n in cubes[cube]]
    top, bottom = max(height[points]), min(height[points])
    directions = ((1, 0, 1.0), (0, 1, 1.0), (1, 1, math.sqrt(2)), (1, -1, math.sqrt(2)))
    width = rules.cube_m * max(
        1 + np.ptp([a * column + b * row for column, row, _ in head]) / length
        for a, b, length in directions
    )
    begins = min(map(lowest.get, head)) + rules.max_bottom_ratio * top
    if (
        len(points) < rules.min_points
        or width > rules.max_width_m
        or top < rules.min_slenderness * width
        or top < rules.min_top_ratio * max(map(highest.get, head))
        or bottom > max(rules.max_bottom_m, begins)
        or not any(apart(cube, w) <= rules.touch_m for cube, w in product(head, wires))
    ):
        return []
    middle = np.mean([cube[:2] for cube in head], axis=0)
    radius = max(rules.min_core_m, rules.core_ratio * width)
    under = [
        cube
        for cube in cubes
        if apart(cube, middle, 2) <= radius and max(height[cubes[cube]]) <= bottom + rules.cube_m
    ]
    return points + [n for cube in under for n in cubes[cube]]


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([0.5, 2.0, 8.0]))
def test_as_the_slow_reference(seed, density):
    random = np.random.default_rng(seed)
    height = random.uniform(6.0, 25.0)
    places = [(random.uniform(-4, 4), random.uniform(0, 6)) for _ in range(random.integers(1, 4))]
    heights, codes = line(places, height, length=45.0, density=density, seed=seed)
    parts = [(heights, codes)]
    for _ in range(random.integers(0, 4)):
        x, y, wide = random.uniform(0, 45), random.uniform(-12, 12), random.uniform(0.5, 4)
        high = random.uniform(4, height + 8)
        tree = box(random, (x - wide, y - wide, 1), (x + wide, y + wide, high), 0.2)
        parts.append((tree, np.full(len(tree), TREE)))
    heights, codes = (np.concatenate(each) for each in zip(*parts, strict=True))
    tower = detect(heights, codes)
    assert np.array_equal(tower, slow_towers(on_slope(heights), heights[:, 2], codes == WIRE))


def test_neither_the_order_of_points_nor_what_lies_beyond_the_reach_matters():
    heights, codes = lattice()
    expected, random = detect(heights, codes), np.random.default_rng(1)
    order = random.permutation(len(codes))
    assert np.array_equal(detect(heights[order], codes[order]), expected[order])
    for middle in range(0, 121, 15):
        inside = abs(heights[:, 0] - middle) < 5.0
        seen = np.flatnonzero(abs(heights[:, 0] - middle) < 5.0 + RULES.reach_m)
        assert np.array_equal(detect(heights[seen], codes[seen])[inside[seen]], expected[inside])


# ---- the stage ----------------------------------------------------------------------------------


def arrays_of(heights, codes):
    """Return the arrays of a stage: unlabeled but for wires."""
    arrays = dict(zip("XYZ", on_slope(heights).T.copy(), strict=True))
    given_codes = np.where(codes == TOWER, TREE, codes).astype(np.uint8)
    return {**arrays, "Classification": given_codes, "HeightAboveGround": heights[:, 2]}


def test_the_stage_leaves_what_is_ignored_kept_or_outside():
    heights, codes = lattice()
    expected, arrays = detect(heights, codes), arrays_of(heights, codes)
    tower = np.flatnonzero(expected)
    arrays["Classification"][tower[:4]] = 12, 1, 4, 6
    arrays["Choice"] = (heights[:, 0] < 50).astype(np.uint8)
    stage = Towers({"code": 70, "where": "Choice == 1"})
    points = stage.points(arrays)
    out = stage.run(points, WHOLE_CLOUD)["Classification"]
    assert out[tower[:4]].tolist() == [12, 70, 70, 70]
    changed = out != arrays["Classification"]
    assert np.array_equal(np.flatnonzero(changed), tower[1:][arrays["Choice"][tower[1:]] == 1])
    assert points.report.figures["towers"] == changed.sum()
    arrays["Classification"][codes == WIRE] = 7  # ignored: there are no wires
    assert np.array_equal(
        Towers({}).run(Towers({}).points(arrays), WHOLE_CLOUD)["Classification"],
        arrays["Classification"],
    )


def test_classify_runs_it_where_a_model_has_wires():
    def types(**options):
        return [stage["type"] for stage in ClassifyRequest(**options).stages]

    assert types()[-1] == "filters.towers" == types(bridges=True)[-2]
    assert "filters.towers" not in types(towers=False)


def write(path, heights, codes):
    """Write a scene as LAS."""
    las = laspy.create(point_format=6, file_version="1.4")
    las.header.scales, las.header.offsets = [0.001] * 3, CORNER
    las.x, las.y, las.z = on_slope(heights).T
    las.return_number = las.number_of_returns = np.ones(len(codes), np.uint8)
    las.classification = np.where(codes == TOWER, TREE, codes)
    las.write(str(path))
    return str(path)


@pytest.mark.pdal
def test_in_tiles_as_in_one_piece_through_pdal(tmp_path):
    heights, codes = lattice()
    job = [
        write(tmp_path / "in.las", heights, codes),
        {"type": "filters.hag_morphological"},
        {"type": "filters.towers"},
        {"type": "writers.las", "extra_dims": "all", "scale_z": 1e-6},
    ]
    for name, words in (("whole", ()), ("tiled", ("--tile", "17", "--workers", "0"))):
        job[-1]["filename"] = str(tmp_path / f"{name}.las")
        (tmp_path / "job.json").write_text(json.dumps(job))
        assert main(["pipeline", str(tmp_path / "job.json"), "--no-progress", *words]) == 0
    whole, tiled = (laspy.read(tmp_path / f"{name}.las") for name in ("whole", "tiled"))
    high = heights[:, 2] > RULES.min_height_m + 0.5
    assert (np.asarray(whole.classification)[high & (codes == TOWER)] == TOWER).mean() > 0.9
    assert np.array_equal(whole.classification, tiled.classification)


def test_a_real_line_in_tiles_as_in_one_piece(data_dir, tmp_path, capsys):
    """AHN4's line around its tower: 1,229 labeled points of it."""
    every = laspy.read(data_dir / "rural/ahn4_powerline.laz")
    code, xyz = np.asarray(every.classification), every.xyz
    middle = xyz[code == TOWER].mean(axis=0)
    near = (abs(xyz - middle)[:, :2] < (60.0, 60.0)).all(axis=1)
    every.points = every.points[near]
    every.write(str(tmp_path / "in.las"))
    labels = code[near]
    for name, words in (("whole", ()), ("tiled", ("--tile", "40", "--workers", "0"))):
        out = str(tmp_path / f"{name}.las")
        assert main(["classify", str(tmp_path / "in.las"), out, "--no-progress", *words]) == 0
        assert "points of towers (towers)" in capsys.readouterr().out
    whole, tiled = (laspy.read(tmp_path / f"{name}.las") for name in ("whole", "tiled"))
    for name in ("classification", "Reliability", "HeightAboveGround"):
        assert np.array_equal(whole[name], tiled[name]), name
    tower = np.asarray(whole.classification) == TOWER
    assert tower[labels == TOWER].mean() > 0.85  # near it, some are wires
    assert not np.isin(labels[tower], (GROUND, TREE, 9)).any()
