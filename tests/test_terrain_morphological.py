"""Heights above filtered ground: against slow references, and what must hold whatever the points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage
from test_detached_noise import closed_wood

import pdal_stages as ps
from pdal_stages.base.errors import OptionError, StageError
from pdal_stages.stages.hag_morphological import HagMorphological
from pdal_stages.terrain import cells, filtered_ground, groundcells, openings
from pdal_stages.terrain.cells import CellWindow
from pdal_stages.terrain.groundcells import FilterOptions
from pdal_stages.terrain.hillside import roofs_of_hillsides
from pdal_stages.terrain.openings import LARGEST_DROP, objects_of, opening_radii, remove_plateaus
from pdal_stages.terrain.planes import GroundRaster, planes_of_blocks

SMALL = {"window": 12.0, "openings": (5, 9), "slope_too": True}


def town(seed=0, side=120, density=3.0, origin=(0.0, 0.0)):
    """A hillside with houses, trees, pits and a pond: x, y, z, true height."""
    rng = np.random.default_rng(seed)
    n = int(side * side * density)
    x, y = rng.uniform(0, side, (2, n))
    terrain = 0.2 * x + 3 * np.sin(y / 17)
    height = np.where((x % 40 < 14) & (y % 30 < 12), 7.0, 0.0)
    tree = (np.hypot(x % 25 - 20, y % 27 - 20) < 4) & (rng.random(n) < 0.7)
    height = np.where(tree, rng.uniform(1, 12, n), height)
    height[rng.random(n) < 0.0005] = -15.0
    keep = np.hypot(x - 80, y - 80) > 15
    x, y, height, terrain = x[keep], y[keep], height[keep], terrain[keep]
    z = terrain + height + rng.normal(0, 0.03, len(x))
    return np.round(x + origin[0], 3), np.round(y + origin[1], 3), np.round(z + 100, 3), height


def same(one, two):
    assert one.keys() == two.keys()
    for name in one:
        assert np.array_equal(one[name], two[name]), name


# ---- the steps, each against a slow reference -------------------------------------------------------------


def octagon(radius):
    """Squares (+) diamonds, by the definition of their sum."""
    squares = int(0.41421356 * radius)
    j, i = np.abs(np.mgrid[-radius : radius + 1, -radius : radius + 1])
    return np.maximum(i - squares, 0) + np.maximum(j - squares, 0) <= radius - squares


def slow_opening(raster, radius):
    eroded = ndimage.grey_erosion(raster, footprint=octagon(radius), mode="constant", cval=np.inf)
    centers = np.where(np.isinf(raster), -np.inf, eroded).astype(np.float32)
    return ndimage.grey_dilation(centers, footprint=octagon(radius), mode="constant", cval=-np.inf)


def slow_steepness(opened, measured, radius):
    form = {"footprint": octagon(radius), "mode": "constant"}
    highest = ndimage.grey_dilation(np.where(measured, opened, -np.inf), cval=-np.inf, **form)
    lowest = ndimage.grey_erosion(np.where(measured, opened, np.inf), cval=np.inf, **form)
    both = np.minimum(highest - opened, opened - lowest) / np.float32(radius)
    return ndimage.grey_dilation(np.where(measured, both, 0), cval=0, **form)


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (33, 2), (45, 38), (60, 50)])
@np.errstate(invalid="ignore")
def test_openings_and_objects_equal_the_slow_reference(shape):
    """The last of them is as steep as mountains."""
    rng = np.random.default_rng(1)
    raster = (rng.normal(0, 3, shape) + np.arange(shape[1]) * 1.7 * (shape[0] == 60)).astype(
        np.float32
    )
    raster[rng.random(shape) < 0.3] = np.inf
    window, measured = 21, np.isfinite(raster)
    objects, floor, opened, steep = objects_of(raster, 1.5, 0.1, window, keep=range(1, 25))
    for radius in range(1, 25):
        assert np.array_equal(opened[radius], slow_opening(raster, radius)), radius
    want, want_floor, before = np.zeros(shape, bool), raster.copy(), raster
    want_steep = slow_steepness(slow_opening(raster, 14), measured, 14)  # the first radius of 20 m
    for radius in opening_radii(window):
        after = slow_opening(raster, radius)
        land = radius * want_steep
        drop = before - after > np.maximum(
            min(0.1 * radius * 1.5, LARGEST_DROP), 0.5 * (radius >= 14) * land
        )
        again = before - after > np.maximum(LARGEST_DROP, 3 * land)
        new = measured & np.where(want, again, drop)
        want_floor[new] = after[new]
        want |= new
        before = after
    for one, other in ((objects, want), (steep, want_steep), (floor, want_floor)):
        assert np.array_equal(one, other)


def slow_planes(cells, level, floor, at):
    """Plane (height, gradient) of one block of the pyramid, by least squares over its cells, and recursion."""
    size = 2**level
    center = (np.array(at) + 0.5) * size

    def weight(cell):
        far = np.abs(cell // size - np.array(at))
        return 0.0 if far.max() > 1 else float(np.prod(1 - 0.5 * far))

    ground = [(np.array(c), p, z) for c, (p, z) in cells.items() if weight(np.array(c)) > 0]
    if level == 3:
        known = [(*(np.array(c) + 0.5 - center), f, weight(np.array(c))) for c, f in floor.items()]
        known = np.array([row for row in known if row[3] > 0]).T
        if not known.size:
            return None
        *middle, level = np.average(known[:3], axis=1, weights=known[3])
        spread = np.cov(known[:3], aweights=known[3], ddof=0)
        slope = np.linalg.solve(spread[:2, :2] + 0.02 * size**2 * np.eye(2), spread[:2, 2])
        near = slope @ spread[:2, 2] >= 0.6 * spread[2, 2] and known[3].sum() >= 0.3 * 4 * size**2
        slope = slope if near and np.hypot(*slope) >= 0.5 else np.zeros(2)
        prior = np.array([level - slope @ middle, *slope])
    else:
        uv = center / (2 * size) - 0.5
        base = np.floor(uv).astype(int)
        total, prior = 0.0, np.zeros(3)
        for a in (0, 1):
            for b in (0, 1):
                parent = base + np.array([a, b])
                plane = slow_planes(cells, level + 1, floor, tuple(parent))
                share = (1 - abs(uv[0] - parent[0])) * (1 - abs(uv[1] - parent[1]))
                if plane is not None and share > 0:
                    d = center - (parent + 0.5) * 2 * size
                    prior += share * np.array(
                        [plane[0] + plane[1] * d[0] + plane[2] * d[1], *plane[1:]]
                    )
                    total += share
        if total == 0:
            return None
        prior /= total
    if not ground:
        return prior
    rows, right = [], []
    n = sum(weight(c) for c, _, _ in ground)
    for c, p, z in ground:
        d = c + 0.5 + p - center
        k = np.sqrt(weight(c))
        rows.append(k * np.array([1, *d]))
        right.append(k * (z - prior[0] - prior[1:] @ d))
    rows += [
        np.sqrt([0.1, 0, 0]),
        np.sqrt([0, 0.02 * n * size**2, 0]),
        np.sqrt([0, 0, 0.02 * n * size**2]),
    ]
    right += [0, 0, 0]
    return prior + np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0]


@pytest.mark.parametrize("slope", [0.0, 3.0])
def test_planes_equal_the_slow_reference(slope):
    rng = np.random.default_rng(4)
    left, bottom, w, h = window = CellWindow(-13, 40, 26, 30)
    ground = rng.random((h, w)) < 0.05
    place = rng.uniform(-0.5, 0.5, (h, w, 3)) * [1, 1, 40]
    floor = (rng.normal(0, 5, (h, w)) + slope * np.arange(w)).astype(np.float32)
    raster = np.where(rng.random((h, w)) < 0.5, floor, np.float32(np.inf))
    raster[ground] = floor[ground]
    planes = planes_of_blocks(GroundRaster(window, raster, place, ground, floor, {}), 3, 0.5)
    places = [(j, i, (i + left, j + bottom)) for j in range(h) for i in range(w)]
    cells = {c: (place[j, i, :2], place[j, i, 2]) for j, i, c in places if ground[j, i]}
    known = {c: floor[j, i] for j, i, c in places if np.isfinite(raster[j, i])}
    for k in rng.choice(len(places), 4, replace=False):
        column, row = np.array(places[k][2]) // 2
        want = slow_planes(cells, 1, known, (column, row))
        assert planes.values[row - planes.bottom, column - planes.left] == pytest.approx(
            want, abs=1e-6
        )


def square(place, reach):
    return [
        (place[0] + b, place[1] + a)
        for b in range(-reach, reach + 1)
        for a in range(-reach, reach + 1)
    ]


def heights_of(raster):
    return {
        (j, i): float(raster[j, i]) for j, i in zip(*np.nonzero(np.isfinite(raster)), strict=True)
    }


def walked(cells, cell, reach):
    """Sets of cells {place: height} among which one walks from one to the next."""
    seen = set()
    for start in cells:
        if start in seen:
            continue
        members, todo = {start}, [start]
        while todo:
            here = todo.pop()
            for other in square(here, int(reach)):
                far = np.hypot(*np.subtract(other, here))
                if other not in cells or other in members or far > reach:
                    continue
                if abs(cells[other] - cells[here]) <= max(0.75, 0.3 * cell * far):
                    members.add(other)
                    todo.append(other)
        seen |= members
        yield members


def turn_of(place, middle):
    return int(np.floor(16 * (np.arctan2(*np.subtract(place, middle)) / (2 * np.pi) + 1))) % 16


def slow_plateaus(ground, raster, steep, cell):
    """Ground cells of plateaus, and the level around them, by walking."""
    cells, taken = heights_of(raster), {}
    for members in walked(cells, cell, 4):
        at = np.array(sorted(members))
        own = [c for c in members if ground[c]]
        if len(own) <= 0.05 * len(members) or np.ptp(at, axis=0).max() >= int(200 / cell):
            continue
        middle, lower, level, directions, uphill, rim = at.mean(axis=0), [], 0, set(), 0, set()
        for here in members:
            for other in square(here, 8):
                if other in cells and ground[other] and other not in members:
                    drop, far = cells[here] - cells[other], np.hypot(*np.subtract(other, here))
                    jump = max(1.5, 0.75 * cell * far)
                    if ground[here]:
                        uphill += 1.0 if drop < -jump else -0.5 if drop > jump else 0.0
                    if drop > max(jump, 3 * steep[here] * far):
                        lower.append(cells[other])
                        directions.add(turn_of(other, middle))
                        rim |= {here} if far < 3 else set()
                    elif abs(drop) < 0.75:
                        level += 1
        if (
            len(directions) >= 14
            and len(lower) >= 0.8 * (len(lower) + level)
            and uphill <= 0
            and len(rim) <= 14 * len(members) ** 0.5
        ):
            taken |= dict.fromkeys(own, np.mean(lower))
    return taken


@pytest.mark.parametrize("seed", range(3))
def test_plateaus_equal_the_slow_reference(seed):
    rng = np.random.default_rng(seed)
    h, w = 40, 44
    cell = (1.0, 0.5, 6.0)[seed % 3]
    j, i = np.mgrid[:h, :w]
    level = 0.05 * i * cell
    for _ in range(6):
        y, x, size, high = (
            rng.integers(0, h),
            rng.integers(0, w),
            rng.integers(3, 9),
            rng.uniform(1, 30),
        )
        level = np.where((abs(j - y) < size) & (abs(i - x) < size), level.min() + high, level)
    raster = (level + rng.normal(0, 0.1, (h, w))).astype(np.float32)
    raster[rng.random((h, w)) < (0.2 + 0.1 * seed)] = np.inf
    ground = np.isfinite(raster) & (rng.random((h, w)) < 0.7)
    left, floor = ground.copy(), raster.copy()
    steep = np.where(i < w / 2, 0.0, rng.uniform(0, 2, (h, w))).astype(np.float32)
    remove_plateaus(left, floor, raster, steep, cell)
    want = slow_plateaus(ground, raster, steep, cell)
    assert {tuple(map(int, at)) for at in np.argwhere(ground & ~left)} == set(want)
    assert [floor[at] for at in want] == pytest.approx(list(want.values()), abs=1e-4)
    assert seed % 3 == 2 or want


def slow_roofs(ground, raster, cell):
    """What lies below ground cells of roofs that a slope runs into, by walking and looking around."""
    cells, below = heights_of(raster), {}
    reach, arm = max(1, int(2 / cell)), max(1.0, 4 / cell)

    def bends(j, i, dj, di):
        length, ends = np.hypot(dj, di), []
        for t in (-1, 1):
            steps = range(int(arm / length + 0.5), 0, -1)
            ends.append(
                [(s, cells[c]) for s in steps if (c := (j + t * s * dj, i + t * s * di)) in cells]
            )
        if not all(ends):
            return False
        (n, one), (m, other) = ends[0][0], ends[1][0]
        most = 0.3 + 0.3 * abs(one - other) / ((n + m) * length * cell)
        return (one * m + other * n) / (n + m) - cells[j, i] > most * 2 * n * m / ((n + m) * arm)

    creases = {c for c in cells if any(bends(*c, *d) for d in ((0, 1), (1, 0), (1, 1), (1, -1)))}
    for members in walked({c: cells[c] for c in cells if c not in creases}, cell, 1.5):
        at = np.array(sorted(members))
        footing = sum(map(ground.__getitem__, members)) > 0.05 * len(at)
        if not footing or len(at) * cell**2 < 40 or np.ptp(at, axis=0).max() * cell >= 35:
            continue
        feet, high, others, creased, directions = [], 0, 0, 0, set()
        for here in members:
            beside = [
                c for c in square(here, reach) if c in cells and ground[c] and c not in members
            ]
            far = {c: max(1, cell * np.hypot(*np.subtract(c, here))) for c in beside}
            walls = {c: cells[here] - cells[c] for c in beside if cells[here] - cells[c] > far[c]}
            directions |= {turn_of(c, at.mean(axis=0)) for c in walls}
            feet += [cells[here] - max(walls.values())] if walls else []
            high = max([high, *walls.values()])
            near = any(
                c in creases and abs(cells[c] - cells[here]) <= 0.75 for c in square(here, 1)
            )
            others += not walls and bool(beside or near)
            creased += near
        rim = len(feet) >= 0.5 * (len(feet) + others) and len(directions) >= 10 and high >= 1.8
        plane = np.column_stack([cell * at, np.ones(len(at))])
        tilt = np.hypot(*np.linalg.lstsq(plane, [cells[c] for c in map(tuple, at)])[0][:2])
        if rim and tilt < 0.4 and creased <= 0.4 * len(members):
            below |= dict.fromkeys(members, np.mean(feet))
    beside = {c: [below[b] for b in square(c, reach) if b in below] for c in creases}
    below |= {c: min(levels) for c, levels in beside.items() if levels}
    return {c: level for c, level in below.items() if ground[c]}


@pytest.mark.parametrize(("seed", "cell"), [(0, 1.0), (1, 1.0), (2, 0.8), (3, 2.0)])
def test_roofs_of_hillsides_equal_the_slow_reference(seed, cell):
    rng = np.random.default_rng(seed)
    j, i = np.mgrid[:44, :120]
    raster = 0.5 * cell * j + rng.normal(0, 0.02, j.shape)
    for y, x in ((4, 6), (6, 30), (25, 8), (24, 29), (20, 90), (5, 100)):
        deep, wide = rng.integers(8, 14, 2)
        house = (j >= y) & (j < y + deep) & (i >= x) & (i < x + wide)
        raster[house] = 0.5 * cell * (y + deep) + 0.4 * cell * np.minimum(j - y, y + deep - j)[
            house
        ] * (seed % 2)
    raster[rng.random(raster.shape) < 0.1 * seed] = np.inf
    raster = raster.astype(np.float32)
    ground = np.isfinite(raster) & (rng.random(raster.shape) < 0.9)
    found, want = roofs_of_hillsides(ground, raster, cell), slow_roofs(ground, raster, cell)
    assert {tuple(map(int, at)) for at in np.argwhere(np.isfinite(found))} == set(want) and len(
        want
    ) > 100
    assert [found[at] for at in want] == pytest.approx(list(want.values()), abs=1e-4)
    part = roofs_of_hillsides(ground[:, 40:], raster[:, 40:], cell)
    assert np.array_equal(part[:, 50:], found[:, 90:])


@pytest.mark.parametrize(("tilt", "roof"), [(0.0, True), (0.3, True), (0.5, False)])
def test_what_is_tilted_as_a_steep_slope_is_no_roof(tilt, roof):
    j, i = np.mgrid[:44, :60]
    lifted = (abs(j - 22) < 7) & (abs(i - 30) < 8)
    raster = (0.6 * j + np.where(lifted, 4 - (0.6 - tilt) * (j - 22), 0)).astype(np.float32)
    found = np.isfinite(roofs_of_hillsides(np.ones(raster.shape, bool), raster, 1.0))
    assert found[lifted].mean() > 0.9 if roof else not found.any()


def test_a_roof_is_no_ground_whatever_its_width_and_steps():
    """190 m wide, with a storey on it; a terrace with a ramp, a plateau of 260 m and a ridge stay."""
    rng = np.random.default_rng(2)
    x, y = rng.uniform(0, 500, (2, 60_000))
    far = np.maximum(np.abs(x - 250), np.abs(y - 250))

    def ground_of(height):
        found = filtered_ground(x, y, 0.02 * x + height + rng.normal(0, 0.03, len(x)))
        return found["Ground"] == 1, found["HeightAboveGround"]

    for storey in (0.0, 3.0):
        ground, height = ground_of(np.where(far < 95, 3.0, 0.0) + np.where(far < 50, storey, 0.0))
        assert not ground[far < 93].any()
        assert ground[far > 97].mean() > 0.999
        assert height[far < 90].min() > 1.0
    ramp = np.clip((x - 320) / 25, 0, 1) * 5.0
    hill = np.where(
        (far < 95) & (x > 320) & (abs(y - 250) < 10), 5.0 - ramp, np.where(far < 95, 5.0, 0.0)
    )
    ground, _ = ground_of(hill)
    assert ground[far < 30].mean() > 0.99
    ground, _ = ground_of(np.where(far < 130, 6.0, 0.0))
    assert ground[far < 40].mean() > 0.99
    assert (np.abs(ground_of(-0.6 * np.abs(x - y))[1]) < 1).mean() > 0.97


@pytest.mark.parametrize(
    ("slope", "scarp", "seen"), [(1.0, 0.0, 0.05), (0.46, 12.0, 0.05), (0.46, 12.0, 0.1)]
)
def test_wooded_land_that_the_rim_cuts_off_uphill_is_ground(slope, scarp, seen):
    """All windows round it reach far down, and from its crowns it goes down in all directions: it is no hall."""
    xyz, ground = closed_wood(slope, seen, 6.0, 100, 1)
    xyz[:, 2] += scarp / (1 + np.exp((10 - (xyz[:, :2] - 50) @ (0.9, 0.4)) / 1.8))
    found = filtered_ground(xyz)
    assert found["Ground"][ground].all()
    assert np.abs(found["HeightAboveGround"][ground]).max() < 1.5  # no treetops stand for it


def test_rock_steps_on_a_steep_slope_are_ground(monkeypatch):
    """Openings take it where nobody asks how steep the land is, and less is regained from level planes."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, 200, (2, 40_000))
    steps = 4 * np.floor((x + 6 * np.sin(y / 15)) / 40)
    z = 1.2 * x + 2 * np.sin(x / 9) * np.cos(y / 13) + steps + rng.normal(0, 0.2, len(x))
    for wide, steep, missed in ((20.0, 0.5, 0.0), (np.inf, 0.5, 0.1), (np.inf, np.inf, 0.2)):
        monkeypatch.setattr(openings, "WIDE", wide)
        monkeypatch.setattr(groundcells, "STEEP", steep)
        assert missed <= (filtered_ground(x, y, z)["Ground"] == 0).mean() < missed + 0.1


# ---- what must hold --------------------------------------------------------------------------------------


def test_ground_is_found_in_a_town_on_a_slope():
    x, y, z, height = town()
    figures = {}
    found = filtered_ground(x, y, z, openings=(5, 17), slope_too=True, figures=figures)
    error = np.abs(found["HeightAboveGround"] - height)
    assert np.percentile(error[height == 0], 99) < 0.5
    assert np.median(error[height > 2]) < 0.5
    assert found["Ground"][height == 0].mean() > 0.97
    assert found["Ground"][height > 2].mean() < 0.02
    assert not found["Ground"][height < 0].any()
    assert np.median(found["Slope"]) == pytest.approx(np.degrees(np.arctan(0.2)), abs=3)
    assert figures["pits"] > 0 and figures["without_terrain"] == 0
    assert figures["ground_points"] == found["Ground"].sum()
    roofs = height == 7
    assert (
        np.median(found["HeightAboveOpening_5"][roofs])
        < 1
        < np.median(found["HeightAboveOpening_17"][roofs])
    )


@settings(max_examples=6, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 400), st.integers(-40, 40))
def test_order_and_shifts_by_whole_cells_change_nothing(seed, n, cells):
    rng = np.random.default_rng(seed)
    # Quarter meters are exact in binary, so a shift by whole blocks of the pyramid is exact too.
    x, y, z = rng.integers(0, 160, (3, n)) / 4.0
    found = filtered_ground(x, y, z, **SMALL)
    order = rng.permutation(n)
    same(
        filtered_ground(x[order], y[order], z[order], **SMALL),
        {k: v[order] for k, v in found.items()},
    )
    same(filtered_ground(x + 32 * cells, y - 32 * cells, z, **SMALL), found)


def test_a_tile_with_its_halo_gives_the_same_bits():
    origin = -47.0, -200.0
    x, y, z, _ = town(2, side=1240, density=0.2, origin=origin)
    options = {**SMALL, "window": 6.0}
    halo = FilterOptions(window=6.0, openings=(5, 9)).reach_of_points
    whole = filtered_ground(x, y, z, **options)
    u, v = x - origin[0], y - origin[1]
    core = (u >= 595) & (u < 645) & (v >= 605) & (v < 665)
    near = (u >= 595 - halo) & (u < 645 + halo) & (v >= 605 - halo) & (v < 665 + halo)
    assert near.sum() < 0.9 * len(x)
    tile = filtered_ground(x[near], y[near], z[near], **options)
    same({k: a[core[near]] for k, a in tile.items()}, {k: a[core] for k, a in whole.items()})


def test_a_tile_above_a_scarp_at_the_rim_gives_the_same_bits(monkeypatch):
    rng = np.random.default_rng(0)
    x, y = np.round(rng.uniform([[400], [0]], [[640], [1500]], (2, 180_000)), 2)
    z = 0.3 * x + 16 / (1 + np.exp((570 - x) / 1.8)) + np.sin(x / 9) * np.cos(y / 13)
    z = np.round(z + rng.normal(0, 0.1, len(x)), 2)
    whole, halo = filtered_ground(x, y, z), FilterOptions().reach_of_points
    core = (x >= 560) & (y >= 715) & (y < 775)
    near = (y >= 715 - halo) & (y < 775 + halo)
    assert near.sum() < 0.96 * len(x)
    tile = filtered_ground(x[near], y[near], z[near])
    same({k: a[core[near]] for k, a in tile.items()}, {k: a[core] for k, a in whole.items()})
    monkeypatch.setattr(openings, "WIDE", 100.0)
    less = filtered_ground(x[near], y[near], z[near])["Ground"][core[near]]
    assert less.mean() + 0.1 < whole["Ground"][core].mean()


@pytest.mark.parametrize("spacing", [40, 250])
def test_land_without_points_costs_nothing_and_changes_nothing(monkeypatch, spacing):
    """Groups of points that no step of the filter sees across are worked on apart: as on one raster."""
    rng = np.random.default_rng(spacing)
    n = 800
    cluster = rng.uniform(0, 8 * spacing, (2, 16))[:, rng.integers(0, 16, n)]
    x, y = np.round(cluster + rng.normal(0, 4, (2, n)) - 700.0, 2)
    z = np.round(
        0.1 * x + rng.choice([0.0, 6.0, -20.0], n, p=[0.7, 0.29, 0.01]) + rng.normal(0, 0.1, n), 2
    )
    mask = rng.random(n) < 0.95
    options = {"openings": (5, 120), "slope_too": True, "window": 40.0, "mask": mask}
    shapes, real = [], groundcells.pits

    def looked_at(raster, *others):
        shapes.append(raster.size)
        return real(raster, *others)

    monkeypatch.setattr(groundcells, "pits", looked_at)
    monkeypatch.setattr(cells, "_FEW", 1 << 40)
    monkeypatch.setattr(cells, "LARGEST", 1 << 40)
    figures, again = {}, {}
    whole = filtered_ground(x, y, z, figures=figures, threads=1, **options)
    assert len(shapes) == 1
    for few, largest, side in ((0, 1 << 40, 1024), (0, 20_000, 256)):
        shapes.clear()
        monkeypatch.setattr(cells, "_FEW", few)
        monkeypatch.setattr(cells, "_EMPTY", 1)
        monkeypatch.setattr(cells, "LARGEST", largest)
        monkeypatch.setattr(cells, "SIDE", side)
        same(filtered_ground(x, y, z, figures=again, threads=2, **options), whole)
        assert again == figures
        if spacing == 250:
            assert len(shapes) > 5
            assert sum(shapes) < 0.1 * 8**2 * spacing**2


def test_one_stray_point_costs_little_memory():
    x, y, z, _ = town(1, side=60)
    whole = filtered_ground(x, y, z, **SMALL)
    for far in (1e5, -1e7, 1e9):
        found = filtered_ground(np.append(x, far), np.append(y, -far), np.append(z, 5.0), **SMALL)
        same({k: v[:-1] for k, v in found.items()}, whole)
        assert found["HeightAboveGround"][-1] == pytest.approx(0, abs=1e-9)


def test_ignored_points_change_nothing_but_get_heights():
    x, y, z, _ = town(5, side=60)
    rng = np.random.default_rng(1)
    extra = rng.uniform(0, 60, (2, 50))
    figures = {}
    found = filtered_ground(
        np.append(x, extra[0]), np.append(y, extra[1]), np.append(z, np.full(50, -300.0)),
        mask=np.arange(len(x) + 50) < len(x), figures=figures, **SMALL,
    )  # fmt: skip
    same({k: v[: len(x)] for k, v in found.items()}, filtered_ground(x, y, z, **SMALL))
    assert (found["HeightAboveGround"][len(x) :] < -350).all()
    assert figures["unused_points"] == 50


@pytest.mark.parametrize(
    "x, y, z",
    [
        ([5.0], [5.0], [9.0]),
        (np.full(50, 3.25), np.full(50, -7.5), np.full(50, 2.0)),
        (np.linspace(0, 90, 100), np.zeros(100), np.zeros(100)),
        ([0.0, 1e8], [0.0, 1e8], [0.0, 1.0]),
    ],
)
def test_degenerate_clouds(x, y, z):
    found = filtered_ground(x, y, z, **SMALL)
    assert np.allclose(found["HeightAboveGround"], 0, atol=1e-6)
    assert found["Ground"].all()


def test_nothing_not_finite_and_nothing_usable():
    empty = filtered_ground([], [], [], **SMALL)
    assert {k: (v.dtype.char, v.size) for k, v in empty.items()} == {
        "HeightAboveGround": ("d", 0), "Ground": ("B", 0), "Slope": ("d", 0),
        "HeightAboveOpening_5": ("f", 0), "HeightAboveOpening_9": ("f", 0),
    }  # fmt: skip
    found = filtered_ground([1.0, np.nan, 2.0], [1.0, 1.0, np.inf], [3.0, 4.0, 5.0])
    assert found["HeightAboveGround"][0] == 0 and np.isnan(found["HeightAboveGround"][1:]).all()
    assert found["Ground"].tolist() == [1, 0, 0]
    figures = {}
    none = filtered_ground([1.0, 2.0], [1.0, 2.0], [3.0, 9.0], mask=[False, False], figures=figures)
    assert none["HeightAboveGround"].tolist() == [0, 0] and figures["without_terrain"] == 2
    high = filtered_ground([1.0, 2.0], [1.0, 2.0], [3.0, 1e300], figures=figures)
    assert high["HeightAboveGround"].tolist() == [0, 1e300] and figures["unused_points"] == 1


def test_sizes_and_shapes_are_checked():
    with pytest.raises(OptionError, match="'cell' must be a number above 0"):
        filtered_ground([0.0], [0.0], [0.0], cell=0)
    with pytest.raises(OptionError, match="'window' must not be more than 300 cells"):
        filtered_ground([0.0], [0.0], [0.0], cell=0.1)
    with pytest.raises(OptionError, match="'slope' must be a number"):
        filtered_ground([0.0], [0.0], [0.0], slope=-1)
    with pytest.raises(StageError, match="one length"):
        filtered_ground([0.0, 1.0], [0.0], [0.0])
    with pytest.raises(StageError, match="one value per point"):
        filtered_ground([0.0], [0.0], [0.0], mask=[True, False])
    with pytest.raises(StageError, match="too large for the grid"):
        filtered_ground([1e300], [0.0], [0.0])


@pytest.mark.data
@pytest.mark.parametrize("name", ["samp12", "samp31"])
def test_ground_of_real_clouds(data_dir, name):
    import laspy

    las = laspy.read(data_dir / "isprs_filter" / f"{name}.laz")
    true = np.asarray(las.classification) == 2
    found = filtered_ground(las.x, las.y, las.z)
    wrong = (found["Ground"] == 1) != true
    assert wrong.mean() < 0.04
    assert np.abs(found["HeightAboveGround"][true]).mean() < 0.1


# ---- the stage -------------------------------------------------------------------------------------------


def test_the_stage_declares_what_it_makes_and_how_far_it_looks():
    stage = HagMorphological({"ground": True, "terrain_slope": "true", "openings": "5, 16.5"})
    assert stage.creates() == {
        "HeightAboveGround": "float",
        "Ground": "uint8_t",
        "Slope": "float",
        "HeightAboveOpening_5": "float",
        "HeightAboveOpening_16_5": "float",
    }
    assert HagMorphological({}).creates() == {"HeightAboveGround": "float"}
    assert 650 < HagMorphological({}).halo_m() < 700
    assert HagMorphological({"window": 20}).halo_m() < 600
    with pytest.raises(
        StageError, match=r"filters\.hag_morphological.*'window' must not be more than 300 cells"
    ):
        HagMorphological({"cell": 0.2})
    with pytest.raises(StageError, match="'openings' must be a number"):
        HagMorphological({"openings": "five"})


@pytest.mark.pdal
def test_through_pdal_with_noise_where_and_classes_kept(tmp_path, write_las):
    x, y, z, height = town(7, side=80)
    codes = np.where(height < 0, 7, 1).astype(np.uint8)
    source = write_las(tmp_path / "in.las", {"X": x, "Y": y, "Z": z, "Classification": codes})
    options = {"ground": True, "terrain_slope": True, "openings": [5, 17], "tag": "h"}
    pipeline = ps.run_pipeline([str(source), {"type": "filters.hag_morphological", **options}])
    array = pipeline.arrays[0]
    want = filtered_ground(
        array["X"], array["Y"], array["Z"], mask=codes != 7, openings=(5, 17), slope_too=True
    )
    for name, values in want.items():
        assert np.array_equal(array[name], values.astype(array[name].dtype)), name
    assert np.array_equal(array["Classification"], codes)
    assert (array["Ground"].dtype, array["HeightAboveOpening_5"].dtype) == (np.uint8, np.float32)
    metadata = pipeline.metadata["metadata"]["filters.hag_morphological"]
    assert (
        metadata["ignored"] == (codes == 7).sum()
        and metadata["ground_points"] == want["Ground"].sum()
    )


@pytest.mark.pdal
@pytest.mark.data
def test_feet_in_feet_out(data_dir):
    stage = {"type": "filters.hag_morphological", "openings": [9], "ground": True}
    array = ps.run_pipeline([str(data_dir / "units" / "autzen_feet.las"), stage]).arrays[0]
    foot = 0.3048
    want = filtered_ground(*(array[k] * foot for k in "XYZ"), openings=(9,))
    assert np.allclose(array["HeightAboveGround"], want["HeightAboveGround"] / foot, atol=1e-4)
    assert np.allclose(
        array["HeightAboveOpening_9"], want["HeightAboveOpening_9"] / foot, atol=1e-4
    )
    ground = array["Classification"] == 2
    assert array["Ground"][ground].mean() > 0.99
    assert np.abs(array["HeightAboveGround"][ground]).mean() < 0.25  # feet
