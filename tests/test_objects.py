"""Objects: against a slow twin, in any order, in blocks and tiles, of bad input."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage
from scipy.sparse.csgraph import connected_components

import pdal_stages as ps
from pdal_stages import Cells, ObjectSettings, find_objects
from pdal_stages.base.errors import StageError
from pdal_stages.objects.cells import Kind, object_id
from pdal_stages.objects.crowns import crown_cells
from pdal_stages.objects.spans import GAP, join_near, number_spans


def house(x0, y0, x1, y1, z, step=0.3, code=6):
    """Points of a flat roof."""
    x, y = np.meshgrid(np.arange(x0, x1, step), np.arange(y0, y1, step))
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z)]), np.full(
        x.size, code, np.uint8
    )


def scene(*parts, size=40.0, origin=(0.0, 0.0)):
    """Parts on flat ground (not below buildings)."""
    ground, codes = house(-5, -5, size + 5, size + 5, 0.0, 0.5, 2)
    free = np.ones(len(ground), bool)
    for xyz, _ in parts:
        if len(xyz):
            low, high = xyz[:, :2].min(0), xyz[:, :2].max(0)
            free &= ~((ground[:, :2] >= low) & (ground[:, :2] <= high)).all(1)
    xyz = np.concatenate([ground[free], *(p for p, _ in parts)])
    xyz[:, :2] += origin
    return xyz, np.concatenate([codes[free], *(c for _, c in parts)])


def found_in(xyz, codes, **options):
    chosen = ObjectSettings(**options)
    return find_objects(Cells.from_points(*xyz.T, codes, chosen.cell), chosen, progress=False)


def same(a, b):
    assert a.tables.keys() == b.tables.keys()
    for kind, table in a.tables.items():
        other = b.tables[kind]
        np.testing.assert_array_equal(table.ids, other.ids)
        assert list(table.columns) == list(other.columns)
        for name in table.columns:
            np.testing.assert_array_equal(table.columns[name], other.columns[name])
        for first, theirs in ((table.cells, other.cells), (table.paths, other.paths)):
            for part, twin in zip(first, theirs, strict=True):
                np.testing.assert_array_equal(part, twin)
    np.testing.assert_array_equal(a.key, b.key)
    np.testing.assert_array_equal(a.owner, b.owner)
    np.testing.assert_array_equal(a.wires.place, b.wires.place)
    np.testing.assert_array_equal(a.span, b.span)


@pytest.fixture(scope="module")
def town():
    return ps.make_town(150.0, 6.0, seed=4, progress=False)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 6))
def test_records_do_not_depend_on_order_or_parts(seed, parts):
    rng = np.random.default_rng(seed)
    xyz, codes = rng.normal(0, 20, (300, 3)), rng.choice([2, 5, 6], 300).astype(np.uint8)
    whole = Cells.from_points(*xyz.T, codes, 0.5)
    order = np.array_split(rng.permutation(300), parts)
    joined = Cells.join([Cells.from_points(*xyz[part].T, codes[part], 0.5) for part in order])
    np.testing.assert_array_equal(joined.key, whole.key)
    for name in whole.columns:
        np.testing.assert_array_equal(joined.columns[name], whole.columns[name])


def test_a_house_is_measured():
    got = found_in(*scene(house(10, 10, 22, 18, 6.0)))
    table = got.tables[Kind.BUILDING]
    assert len(table) == 1
    row = {name: values[0] for name, values in table.columns.items()}
    assert row["area"] == pytest.approx(96, abs=6) and row["h_ridge"] == row["h_eave"] == 6.0
    assert row["ground"] == 0 and row["verdict"] == "sure"
    assert int(table.ids[0]) == int(object_id(Kind.BUILDING, np.array(20), np.array(20)))


def test_decks_have_room_below():
    decks = found_in(*scene(house(5, 20, 30, 26, 5.0, code=17))).tables[Kind.DECK]
    assert len(decks) == 1
    assert decks.columns["clear"][0] == 5.0
    assert decks.columns["area"][0] == pytest.approx(150, abs=8)


@pytest.mark.parametrize("cell", [0.5, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("degrees", [0, 20, 45, 60])
def test_a_wire_in_any_direction_is_one_span(cell, degrees):
    along, direction = np.arange(0, 80, 1.0), np.radians(degrees)
    sag = 2 - 2 * (along / 40 - 1) ** 2
    wire = np.column_stack([along * np.cos(direction), along * np.sin(direction), 20 - sag])
    codes = np.full(len(along), 14, np.uint8)
    spans = found_in(*scene((wire, codes), size=250.0), cell=cell).tables[Kind.SPAN]
    assert len(spans) == 1
    assert spans.columns["length"].min() > 70


def conductors(seed, length=180.0, slope=0.0):
    """Return conductors side by side and above each other, sagging, with gaps; the one of each."""
    rng = np.random.default_rng(seed)
    parts = []
    for across, up in ((0.0, 20.0), (3.0, 20.0), (0.0, 23.5), (3.0, 23.5), (1.5, 28.0)):
        x = np.sort(rng.uniform(0, length, int(2.5 * length)))
        lost = rng.uniform(20, length - 30)
        x = x[(x < lost) | (x > lost + 8.0)]
        sag = 5.0 * (1 - (2 * x / length - 1) ** 2)
        parts.append(np.column_stack([x, across + slope * x, up - sag]))
    return np.concatenate(parts), np.repeat(np.arange(len(parts)), [len(each) for each in parts])


@pytest.mark.parametrize("slope", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("seed", range(3))
def test_each_conductor_is_a_span_over_gaps_in_any_order_and_in_blocks(seed, slope):
    wires, number = conductors(seed, slope=slope)
    xyz, codes = scene((wires, np.full(len(wires), 14, np.uint8)), size=200.0)
    cells = Cells.from_points(*xyz.T, codes, 0.5)
    got = find_objects(cells, progress=False)
    table = got.tables[Kind.SPAN]
    assert len(table) == len(set(table.ids.tolist())) == 5
    ids = got.ids_at(*wires.T, np.full(len(wires), Kind.SPAN))
    for each in range(5):
        assert len(np.unique(ids[number == each])) == 1
    assert set(ids.tolist()) == set(table.ids.tolist())
    assert (table.columns["sag"] > 4.0).all() and (table.columns["sag"] < 5.5).all()
    assert np.sort(table.columns["h_low"]) == pytest.approx([15, 15, 18.5, 18.5, 23], abs=0.4)
    order = np.random.default_rng(seed).permutation(len(xyz))
    halves = [Cells.from_points(*xyz[part].T, codes[part], 0.5) for part in np.split(order, [900])]
    same(got, find_objects(Cells.join(halves), block=100, progress=False))


def test_wires_that_cross_far_apart_in_height_are_two_spans_and_close_ones_one():
    along = np.arange(0, 60, 0.5)
    level = np.zeros(len(along))
    one = np.column_stack([along, level + 30, level + 12])
    for above, spans in ((18.0, 2), (13.0, 1)):
        wires = np.concatenate([one, np.column_stack([level + 30, along, level + above])])
        codes = np.full(len(wires), 14, np.uint8)
        assert len(found_in(*scene((wires, codes), size=60.0)).tables[Kind.SPAN]) == spans


@pytest.mark.parametrize("seed", range(20))
def test_cubes_are_joined_as_all_pairs_join_them(seed):
    rng = np.random.default_rng(seed)
    size = rng.choice([0.1, 0.25, 0.4, 0.5, 1.0, 4.0])
    extent, count = rng.choice([2.0, 10.0, 40.0], 3), rng.integers(1, 400)
    xyz = rng.uniform(0, 1, (count, 3)) * extent + (500_000, -30, 20)
    xyz[::3, 2] = np.round(xyz[::3, 2])
    cubes = Cells.from_points(*xyz.T, np.full(count, 14, np.uint8), size).wires
    label = np.arange(len(cubes.place))
    join_near(cubes.place[:, :2], cubes.middles() / GAP, GAP / size, label)
    apart = cubes.middles()[:, None] - cubes.middles()
    near = (apart**2).sum(axis=2) <= GAP**2
    assert np.array_equal(label, connected_components(near)[1])
    join_near(cubes.place[:, :2], cubes.place[:, 2:], 2.0**0.5, label)
    near |= np.abs(cubes.place[:, None] - cubes.place).max(axis=2) <= 1
    assert np.array_equal(label, connected_components(near)[1])


def test_false_wires_that_fill_a_volume_take_little_memory():
    """Each of 83,200 cubes has some 250 others within the gap: 2,000 bytes as pairs."""
    middle = np.stack(np.mgrid[:80, :80, :13], axis=-1).reshape(-1, 3) * 0.5 + 0.25
    cubes = Cells.from_points(*middle.T, np.full(len(middle), 14, np.uint8), 0.5).wires
    tracemalloc.start()
    number = number_spans(cubes)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(number) == len(middle) and not number.any()
    assert peak < 500 * len(middle)


def test_a_building_larger_than_any_block_and_its_margin():
    long, _ = house(0, 10, 500, 16, 6.0, 0.4)
    ground, codes = house(-10, 0, 510, 30, 0.0, 0.9, 2)
    xyz = np.concatenate([long, ground])
    codes = np.r_[np.full(len(long), 6, np.uint8), codes]
    cells = Cells.from_points(*xyz.T, codes, 0.5)
    whole = find_objects(cells, progress=False)
    assert len(whole.tables[Kind.BUILDING]) == 1
    same(whole, find_objects(cells, block=100, progress=False))


@pytest.mark.parametrize("slope", [0.0, 0.8])
def test_a_roof_that_is_partly_called_leaves_is_whole(slope):
    """A classifier gives a part of a shed's roof, and its chimney, to vegetation; a tree stands beside it."""
    roof, codes = house(10, 10, 16, 15, 3.0)
    roof[:, 2] += slope * (roof[:, 0] - 10)
    codes[roof[:, 0] >= 13.4] = 5
    rng = np.random.default_rng(1)
    crown = np.column_stack([rng.uniform(16, 20, 400), rng.uniform(11, 15, 400), np.zeros(400)])
    away = np.hypot(crown[:, 0] - 18, crown[:, 1] - 13) / 2
    crown[:, 2] = 4.0 + 3.0 * np.sqrt(np.maximum(0, 1 - away**2)) * rng.uniform(0.5, 1, 400)
    chimney, _ = house(12, 12, 13, 13.1, 3.4 + slope * 2, 0.3, 5)
    parts = [
        (roof, codes),
        (crown, np.full(400, 5, np.uint8)),
        (chimney, np.full(len(chimney), 5, np.uint8)),
    ]
    objects = found_in(*scene(*parts))
    columns = objects.tables[Kind.BUILDING].columns
    assert columns["area"].tolist() == pytest.approx([30.0], abs=3.0)
    trees = objects.tables[Kind.TREE].columns
    assert len(trees["x"]) == 1 and abs(trees["x"][0] - 18) < 1.5


@pytest.mark.parametrize("height", [3.0, 3.1])
def test_a_hedge_as_high_as_a_roof_is_not_of_it(height):
    """Nor where a classifier takes some of its points for a building."""
    rng = np.random.default_rng(2)
    roof, codes = house(10, 10, 16, 15, 3.0)
    hedge = np.column_stack(
        [rng.uniform(16, 26, 4000), rng.uniform(11.5, 13.5, 4000), np.zeros(4000)]
    )
    hedge[:, 2] = height * np.sqrt(rng.uniform(0.3, 1, 4000))
    other = np.where(rng.random(4000) < 0.02, 6, 5).astype(np.uint8)
    columns = found_in(*scene((roof, codes), (hedge, other))).tables[Kind.BUILDING].columns
    assert columns["area"].max() == pytest.approx(30.0, abs=4.0)


@pytest.mark.parametrize("turned", [0.0, 0.6])
def test_a_roof_from_whose_inside_nothing_came_back(turned):
    """A wet roof has points at its rim only; of a courtyard the ground is, and of a third square cars."""
    c, s = np.cos(turned), np.sin(turned)
    ground, codes = house(-5, -5, 65, 45, 0.0, 0.4, 2)

    def inside(xyz, x, rim):
        u, v = np.array([[c, s], [-s, c]]) @ (xyz[:, :2] - [x, 20]).T
        return np.maximum(abs(u), abs(v)) < 4 - rim

    parts = []
    for x in (10, 30, 50):
        rim, _ = house(x - 8, 12, x + 8, 28, 3.0, 0.2)
        rim = rim[inside(rim, x, 0) & ~inside(rim, x, 0.7)]
        keep = ~inside(ground, x, 0) | (inside(ground, x, 1.0) & (x == 30))
        ground, codes = ground[keep], codes[keep]
        parts.append((rim, np.full(len(rim), 6, np.uint8)))
    cars, ones = house(42, 12, 58, 28, 1.0, 0.4, 1)
    keep = inside(cars, 50, 1.0)
    parts.append((cars[keep], ones[keep]))
    xyz = np.concatenate([ground, *(p for p, _ in parts)])
    buildings = found_in(xyz, np.concatenate([codes, *(c for _, c in parts)])).tables[Kind.BUILDING]
    area = {
        round(float(buildings.cells[n][1].mean()) / 40): a
        for n, a in enumerate(buildings.columns["area"])
    }
    assert area[0] == pytest.approx(64, abs=8)
    assert all(area.get(n, 0) < 35 for n in (1, 2))


def test_blocks_change_nothing(town):
    """Patches of buildings that are called vegetation, and of vegetation that is called a building."""
    rng = np.random.default_rng(7)
    codes = np.array(town.classification)
    for x, y in rng.uniform(0, 150, (200, 2)) + town.xyz[:, :2].min(0):
        near = np.hypot(town.xyz[:, 0] - x, town.xyz[:, 1] - y) < 2.5
        codes[near] = np.where(codes[near] == 6, 5, np.where(codes[near] == 5, 6, codes[near]))
    part = (town.xyz[:, :2] < town.xyz[:, :2].min(0) + 90).all(axis=1)
    cells = Cells.from_points(*town.xyz[part].T, codes[part], 0.5)
    same(find_objects(cells, progress=False), find_objects(cells, block=64, progress=False))


def test_a_shift_by_whole_cells_shifts_the_objects(town):
    original = found_in(town.xyz, town.classification)
    two = found_in(town.xyz + np.array([1024.0, -512.0, 0.0]), town.classification)
    for kind in (Kind.BUILDING, Kind.TREE):
        a, b = original.tables[kind], two.tables[kind]
        assert len(a) == len(b) > 0
        for part, twin in zip(a.cells, b.cells, strict=True):
            np.testing.assert_array_equal(part[0] - 1024, twin[0])
        np.testing.assert_array_equal(a.columns["area"], b.columns["area"])


def test_far_points_cost_nothing():
    """Two thousand rasters of a kilometer would take an hour."""
    xyz, codes = scene(house(10, 10, 22, 18, 6.0))
    stray, more = np.random.default_rng(1).uniform(-1e6, 1e6, (2000, 3)), np.full(2000, 6, np.uint8)
    got = found_in(np.concatenate([xyz, stray]), np.r_[codes, more])
    assert len(got.tables[Kind.BUILDING]) == 1
    with pytest.raises(StageError, match="too large for the grid"):
        found_in(np.concatenate([xyz, stray * [1e4, 1e4, 1]]), np.r_[codes, more])


def test_what_is_nowhere_two_meters_wide_is_to_be_checked():
    wire, shed = house(5, 5, 35, 6.4, 7.0), house(10, 20, 13.5, 23.5, 3.0)
    table = found_in(*scene(wire, shed)).tables[Kind.BUILDING]
    assert len(table) == 2
    assert ["narrow" in reason for reason in table.columns["reason"]] == [True, False]


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.5, 2.0]), st.booleans())
def test_tops_of_trees_are_h_maxima_and_a_part_has_those_of_the_whole(seed, depth, whole_meters):
    reach, least = 8, 3.0
    s = 10.0 + 15.0 * ndimage.gaussian_filter(
        np.random.default_rng(seed).normal(size=(60, 64)), 1.2
    )
    s = np.maximum(np.round(s) if whole_meters else s, 0.0)
    owner = crown_cells(s, least, depth, float(reach))
    r, c = np.indices(s.shape)
    numbers = r * s.shape[1] + c
    above = [
        (s > z) | ((s == z) & (numbers < n)) for z, n in zip(s.ravel(), range(s.size), strict=True)
    ]
    tops = []
    for n in range(s.size):
        y, x = divmod(n, s.shape[1])
        near = (r - y) ** 2 + (c - x) ** 2 <= reach**2 / 4
        parts, _ = ndimage.label((s >= s[y, x] - depth) & near & ~above[n], np.ones((3, 3)))
        led_to = ndimage.binary_dilation(parts == parts[y, x], np.ones((3, 3))) & near & above[n]
        if s[y, x] >= 0.8 * least and not (led_to & (s >= s[y, x] - depth)).any():
            tops.append(n)
    assert np.unique(owner[owner >= 0]).tolist() == tops
    y, x = np.divmod(owner, s.shape[1])
    assert ((y - r) ** 2 + (x - c) ** 2 <= reach**2)[owner >= 0].all()
    part = crown_cells(s[7:, 5:], least, depth, float(reach))
    moved = np.where(part >= 0, (part // 59 + 7) * 64 + part % 59 + 5, -1)
    np.testing.assert_array_equal(moved[20:, 20:], owner[27:, 25:])
