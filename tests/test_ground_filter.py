"""Heights above filtered ground: against slow references, and what must hold whatever the points."""

from __future__ import annotations

from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

import pdal_stages as ps
from pdal_stages.base.errors import OptionError, StageError
from pdal_stages.base.grid import GridWindow
from pdal_stages.stages.hag_morphological import HagMorphological
from pdal_stages.terrain import filtered_ground, openings, wide_roofs
from pdal_stages.terrain.filter_options import FilterOptions
from pdal_stages.terrain.openings import FILL_RINGS, fill_holes, growing_radii, objects_of
from pdal_stages.terrain.smrf import reach_of_points
from pdal_stages.terrain.surface import GroundRaster, planes_of_blocks

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


def test_holes_are_filled_up_to_some_rings_from_measured_cells():
    """On a slope all around holes the filled cells continue it; far holes stay."""
    height = np.add.outer(0.5 * np.arange(40.0), np.zeros(40)).astype(np.float32)
    raster = height.copy()
    raster[5:36, 5:36] = np.inf
    filled = fill_holes(raster)
    depth = ndimage.distance_transform_cdt(np.isinf(raster), "chessboard")
    assert np.array_equal(np.isfinite(filled), depth <= FILL_RINGS)
    raster = np.where(np.random.default_rng(0).random(height.shape) < 0.5, np.inf, height)
    inside = np.s_[4:-4, 4:-4]
    assert np.abs(fill_holes(raster.astype(np.float32)) - height)[inside].max() < 1.0


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (33, 2), (45, 38), (60, 50)])
@pytest.mark.parametrize("band", [1, 1 << 19])
@np.errstate(invalid="ignore")
def test_openings_and_objects_equal_the_slow_reference(shape, band, monkeypatch):
    """The last of them is as steep as mountains; in bands of rows, too."""
    monkeypatch.setattr(openings, "_BAND_CELLS", band)
    rng = np.random.default_rng(1)
    raster = (rng.normal(0, 3, shape) + np.arange(shape[1]) * 1.7 * (shape[0] == 60)).astype(
        np.float32
    )
    raster[rng.random(shape) < 0.3] = np.inf
    window, measured, filled = 21, np.isfinite(raster), fill_holes(raster)
    objects, floor, opened = objects_of(raster, 1.5, 0.1, window, keep=range(1, 25))
    for radius in range(1, 25):
        assert np.array_equal(opened[radius], slow_opening(filled, radius)), radius
    want, want_floor, before = np.zeros(shape, bool), raster.copy(), filled
    for radius in growing_radii(window):
        after = slow_opening(filled, radius)
        new = measured & ~want & (before - after > np.float32(0.1 * radius * 1.5))
        want_floor[new] = after[new]
        want |= new
        before = after
    assert np.array_equal(objects, want) and np.array_equal(floor, want_floor)


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
        prior = np.array([np.average(known[2], weights=known[3]), 0.0, 0.0])
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
                    prior += share * np.array([plane @ [1, *d], *plane[1:]])
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
    rows += [*np.diag(np.sqrt([0.1, 0.02 * n * size**2, 0.02 * n * size**2]))]
    right += [0, 0, 0]
    return prior + np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0]


@pytest.mark.parametrize("slope", [0.0, 3.0])
def test_planes_equal_the_slow_reference(slope):
    rng = np.random.default_rng(4)
    left, bottom, w, h = window = GridWindow(-13, 40, 26, 30)
    ground = rng.random((h, w)) < 0.05
    place = rng.uniform(-0.5, 0.5, (h, w, 3)) * [1, 1, 40]
    floor = (rng.normal(0, 5, (h, w)) + slope * np.arange(w)).astype(np.float32)
    raster = np.where(rng.random((h, w)) < 0.5, floor, np.float32(np.inf))
    raster[ground] = floor[ground]
    every = np.ones((h, w), bool)
    blocks = GroundRaster(window, raster, place, ground, floor, {})
    planes, (first, lowest) = planes_of_blocks(blocks, 3, every)
    places = [(j, i, (i + left, j + bottom)) for j in range(h) for i in range(w)]
    cells = {c: (place[j, i, :2], place[j, i, 2]) for j, i, c in places if ground[j, i]}
    known = {c: floor[j, i] for j, i, c in places if np.isfinite(raster[j, i])}
    for k in rng.choice(len(places), 4, replace=False):
        column, row = np.array(places[k][2]) // 2
        want = slow_planes(cells, 1, known, (column, row))
        assert planes[row - lowest, column - first] == pytest.approx(want, abs=1e-6)


# ---- land that was dug: real clouds, and what must stay ground ----------------------------------------------

#: West-east and south-north half widths in meters, and depth; "canal" runs through the cloud.
HOLES = {"basement": (12.5, 7.5, 3.5), "pit": (6.0, 6.0, 8.0), "canal": (np.inf, 4.0, 3.0)}


def test_points_are_ground_within_a_distance_that_grows_with_the_slope():
    """By hand: 0.4 m, and 1.25 m more for each meter that the surface rises in one."""
    height, slope = np.array([0.4, 0.41, -0.4, -0.41, 0.65, 0.66]), np.array([0, 0, 0, 0, 0.2, 0.2])
    found = FilterOptions().is_ground(np.ones(6, bool), height, slope)
    assert found.tolist() == [True, False, True, False, True, False]


def share_kept(path, hole, clip=np.inf):
    """Return the share of the ground more than 2 m off a hole that is still ground when the hole is dug.

    Up to 2 m off, cells hold points of both sides of the wall.
    """
    import laspy

    las = laspy.read(path)
    xyz, true = np.column_stack([las.x, las.y, las.z]), np.asarray(las.classification) == 2
    away = np.abs(xyz[:, :2] - np.median(xyz[:, :2], axis=0))
    near = (away < clip).all(axis=1)
    xyz, true, away = xyz[near], true[near], away[near]
    west, south, depth = HOLES[hole]
    land = true & ((away[:, 0] > west + 2) | (away[:, 1] > south + 2))
    land &= filtered_ground(xyz)["Ground"] == 1
    xyz[(away[:, 0] < west) & (away[:, 1] < south), 2] -= depth
    return (filtered_ground(xyz)["Ground"] == 1)[land].mean()


@pytest.mark.parametrize("hole", HOLES)
@pytest.mark.parametrize("name", ["city", "canals", "woods"])
def test_land_around_a_hole_stays_ground(name, hole):
    """A pit in a plot does not make its land a roof; real clouds with a hole dug in their middle."""
    assert share_kept(Path(__file__).parent / "data" / f"{name}.laz", hole) > 0.99


@pytest.mark.data
@pytest.mark.parametrize("hole", HOLES)
@pytest.mark.parametrize(
    "name", ["rural/ahn3_achterhoek", "delft/train", "forest/neon_osbs", "bridge/ign_0299_6802"]
)
def test_land_around_a_hole_in_large_clouds_stays_ground(data_dir, name, hole):
    assert share_kept(data_dir / f"{name}.laz", hole, clip=80) > 0.99


def test_benches_of_a_quarry_stay_ground():
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, 200, (2, 120_000))
    z = -8.0 * np.clip(np.floor((x - 60) / 25), 0, 4) + rng.normal(0, 0.03, len(x))
    assert filtered_ground(x, y, z)["Ground"].mean() > 0.99


# ---- roofs wider than the window ---------------------------------------------------------------------------


def land(side, center, angle=0.0, slope=0.03):
    """Return x, y, z of bare land, and the larger distance along turned axes from a center (n,)."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, side, (2, side * side))
    u, v = x - center[0], y - center[1]
    turn = np.exp(1j * np.radians(angle))
    turned = (u + 1j * v) * turn
    away = np.maximum(np.abs(turned.real), 0.6 * np.abs(turned.imag))
    return x, y, slope * x + rng.normal(0, 0.05, len(x)), away


@pytest.mark.parametrize("angle", [0, 30])
@pytest.mark.parametrize("half", [24, 60])
def test_a_wide_roof_is_no_ground(half, angle):
    x, y, z, away = land(300, (150, 140), angle)
    roof = away < half
    z[roof] = 12.0 + 0.05 * x[roof]
    found = filtered_ground(x, y, z)
    assert found["Ground"][roof].mean() < 0.01 and found["Ground"][~roof].mean() > 0.99
    error = np.abs(found["HeightAboveGround"][roof] - z[roof] + 0.03 * x[roof])
    assert np.percentile(error, 99) < 2


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_wide_roofs_need_no_points_beyond_their_reach(seed):
    rng = np.random.default_rng(seed)
    coarse = rng.choice([0.0, 3.0, 4.0], (30, 30), p=[0.8, 0.1, 0.1])
    z = np.kron(coarse, np.ones((5, 5))) + rng.choice([0.0, 9.0], (150, 150), p=[0.99, 0.01])
    row, column = (at.ravel() - 75 for at in np.indices(z.shape))
    wanted = GridWindow(-2, -2, 4, 4)
    rules = wide_roofs.WideRoofRules(side_m=1.0, radius_m=9.0, max_extent_m=16.0, gap_m=1.0)
    with mock.patch.object(wide_roofs, "RULES", rules):
        reach = rules.reach(1.0, 2.0)
        near = np.maximum(np.abs(row), np.abs(column)) <= reach
        assert near.sum() < 0.9 * len(near)
        whole, part = (
            wide_roofs.level_below_roofs(column[of], row[of], z.ravel()[of], wanted, 1.0, 2.0)
            for of in (slice(None), near)
        )
    assert np.array_equal(whole, part)


def test_a_wide_roof_at_the_clouds_end_is_unknown():
    x, y, z, away = land(200, (200, 100))
    z[away < 40] = 12.0
    assert filtered_ground(x, y, z)["Ground"].mean() > 0.99


@pytest.mark.parametrize("slope", [0.33, 0.5, 0.67, 1.0])
def test_a_heap_with_a_flat_top_stays_ground(slope):
    x, y, z, away = land(300, (150, 150))
    z += 8.0 - np.clip((away - 40) * slope, 0, 8)
    assert filtered_ground(x, y, z)["Ground"].mean() > 0.98


@pytest.mark.parametrize("width", [6, 10, 14])
def test_land_within_a_moat_stays_ground(width):
    x, y, z, away = land(200, (100, 100))
    z[(away > 30) & (away < 30 + width)] -= 4.0
    assert filtered_ground(x, y, z)["Ground"].mean() > 0.98


# ---- what must hold --------------------------------------------------------------------------------------


def test_ground_is_found_in_a_town_on_a_slope():
    x, y, z, height = town()
    figures = {}
    result = filtered_ground(x, y, z, openings=(5, 17), slope_too=True, figures=figures)
    error = np.abs(result["HeightAboveGround"] - height)
    assert np.percentile(error[height == 0], 99) < 0.5
    assert np.median(error[height > 2]) < 0.5
    assert result["Ground"][height == 0].mean() > 0.97
    assert result["Ground"][height > 2].mean() < 0.02
    assert not result["Ground"][height < 0].any()
    assert np.median(result["Slope"]) == pytest.approx(np.degrees(np.arctan(0.2)), abs=3)
    assert figures["without_terrain"] == 0
    assert figures["ground_points"] == result["Ground"].sum()
    low, high = (np.median(result[f"HeightAboveOpening_{k}"][height == 7]) for k in (5, 17))
    assert low < 1 < high


@settings(max_examples=6, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 400), st.integers(-40, 40))
def test_order_and_shifts_by_whole_cells_change_nothing(seed, n, cells):
    rng = np.random.default_rng(seed)
    # Quarter meters are exact in binary, so a shift by whole blocks of the pyramid is exact too.
    x, y, z = rng.integers(0, 160, (3, n)) / 4.0
    result = filtered_ground(x, y, z, **SMALL)
    order = rng.permutation(n)
    same(
        filtered_ground(x[order], y[order], z[order], **SMALL),
        {k: v[order] for k, v in result.items()},
    )
    same(filtered_ground(x + 32 * cells, y - 32 * cells, z, **SMALL), result)


def test_a_tile_with_its_halo_gives_the_same_bits():
    origin = -47.0, -200.0
    x, y, z, _ = town(2, side=2150, density=0.06, origin=origin)  # larger than one raster
    options = {**SMALL, "window": 6.0}
    halo = reach_of_points(FilterOptions(window=6.0, openings=(5, 9)))
    whole = filtered_ground(x, y, z, **options)
    u, v = x - origin[0], y - origin[1]
    core = (u >= 595) & (u < 645) & (v >= 605) & (v < 665)
    near = (u >= 595 - halo) & (u < 645 + halo) & (v >= 605 - halo) & (v < 665 + halo)
    assert near.sum() < 0.9 * len(x)
    tile = filtered_ground(x[near], y[near], z[near], **options)
    same({k: a[core[near]] for k, a in tile.items()}, {k: a[core] for k, a in whole.items()})


def test_land_without_points_changes_nothing():
    """Groups of points that no step of the filter sees across are as each of them alone."""
    rng = np.random.default_rng(2)
    group = np.repeat(np.arange(12), 150)
    x = np.round(700.0 * (group % 4) + rng.normal(0, 6, len(group)), 2)
    y = np.round(700.0 * (group // 4) + rng.normal(0, 6, len(group)), 2)
    height = rng.choice([0.0, 6.0, -20.0], len(group), p=[0.7, 0.29, 0.01])
    z = np.round(0.1 * x + height + rng.normal(0, 0.1, len(group)), 2)
    whole = filtered_ground(x, y, z, **SMALL)
    for each in range(12):
        part = group == each
        alone = filtered_ground(x[part], y[part], z[part], **SMALL)
        same(alone, {name: values[part] for name, values in whole.items()})


def test_ignored_points_change_nothing_but_get_heights():
    x, y, z, _ = town(5, side=60)
    rng = np.random.default_rng(1)
    extra = rng.uniform(0, 60, (2, 50))
    figures = {}
    result = filtered_ground(
        np.append(x, extra[0]), np.append(y, extra[1]), np.append(z, np.full(50, -300.0)),
        mask=np.arange(len(x) + 50) < len(x), figures=figures, **SMALL,
    )  # fmt: skip
    same({k: v[: len(x)] for k, v in result.items()}, filtered_ground(x, y, z, **SMALL))
    assert (result["HeightAboveGround"][len(x) :] < -350).all()
    assert figures["unused_points"] == 50


@pytest.mark.parametrize(
    "x, y, z",
    [
        ([5.0], [5.0], [9.0]),
        (np.full(50, 3.25), np.full(50, -7.5), np.full(50, 2.0)),
        (np.linspace(0, 90, 100), np.zeros(100), np.zeros(100)),
        ([0.0, 1e8, -1e9], [0.0, 1e8, 3.0], [0.0, 1.0, 5.0]),
    ],
)
def test_degenerate_clouds(x, y, z):
    result = filtered_ground(x, y, z, **SMALL)
    assert np.allclose(result["HeightAboveGround"], 0, atol=1e-6)
    assert result["Ground"].all()


def test_above_an_opening_but_far_from_ground():
    """An opening reaches farther than the surface: the height above it is known, the other one 0."""
    x, y = (axis.ravel().astype(float) for axis in np.mgrid[:300, :20])
    far = 150.0
    inside = np.append(x < 60, False)
    result = filtered_ground(
        np.append(x, 60 + far),
        np.append(y, 9.0),
        np.append(0.0 * x, 7.0),
        mask=inside,
        openings=(299,),
    )
    assert result["HeightAboveGround"][-1] == 0.0 and result["HeightAboveOpening_299"][-1] == 7.0


def test_nothing_not_finite_and_nothing_usable():
    empty = filtered_ground([], [], [], **SMALL)
    assert {k: (v.dtype.char, v.size) for k, v in empty.items()} == {
        "HeightAboveGround": ("d", 0), "Ground": ("B", 0), "Slope": ("d", 0),
        "HeightAboveOpening_5": ("f", 0), "HeightAboveOpening_9": ("f", 0),
    }  # fmt: skip
    result = filtered_ground([1.0, np.nan, 2.0], [1.0, 1.0, np.inf], [3.0, 4.0, 5.0])
    assert result["HeightAboveGround"][0] == 0 and np.isnan(result["HeightAboveGround"][1:]).all()
    assert result["Ground"].tolist() == [1, 0, 0]
    figures = {}
    none = filtered_ground([1.0, 2.0], [1.0, 2.0], [3.0, 9.0], mask=[False, False], figures=figures)
    assert none["HeightAboveGround"].tolist() == [0, 0] and figures["without_terrain"] == 2
    high = filtered_ground([1.0, 2.0], [1.0, 2.0], [3.0, 1e300], figures=figures)
    assert high["HeightAboveGround"].tolist() == [0, 1e300] and figures["unused_points"] == 1


def test_sizes_and_shapes_are_checked():
    with pytest.raises(OptionError, match="'cell' must be a number from"):
        filtered_ground([0.0], [0.0], [0.0], cell=0)
    with pytest.raises(OptionError, match="'window' must not be more than 300 cells"):
        filtered_ground([0.0], [0.0], [0.0], cell=0.05)
    with pytest.raises(OptionError, match="'slope' must be a number"):
        filtered_ground([0.0], [0.0], [0.0], slope=-1)
    with pytest.raises(StageError, match="one length"):
        filtered_ground([0.0, 1.0], [0.0], [0.0])
    with pytest.raises(StageError, match="one value per point"):
        filtered_ground([0.0], [0.0], [0.0], mask=[True, False])
    with pytest.raises(StageError, match="too large for the grid"):
        filtered_ground([1e300], [0.0], [0.0])


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "most"), [("samp12", 0.025), ("samp24", 0.04), ("samp31", 0.015), ("samp53", 0.05)]
)
def test_ground_of_real_clouds(data_dir, name, most):
    import laspy

    las = laspy.read(data_dir / "isprs_filter" / f"{name}.laz")
    true = np.asarray(las.classification) == 2
    result = filtered_ground(las.x, las.y, las.z)
    assert ((result["Ground"] == 1) != true).mean() < most
    assert np.median(np.abs(result["HeightAboveGround"][true])) < 0.1


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
    assert HagMorphological({}).halo_m() < 900 < HagMorphological({"window": 75}).halo_m()


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
    assert metadata["ignored"] == (codes == 7).sum()
    assert metadata["ground_points"] == want["Ground"].sum()


@pytest.mark.pdal
@pytest.mark.data
def test_feet_in_feet_out(data_dir):
    stage = {"type": "filters.hag_morphological", "openings": [9], "ground": True}
    array = ps.run_pipeline([str(data_dir / "units" / "autzen_feet.las"), stage]).arrays[0]
    foot = 0.3048
    want = filtered_ground(*(array[k] * foot for k in "XYZ"), openings=(9,))
    for name in ("HeightAboveGround", "HeightAboveOpening_9"):
        assert np.allclose(array[name], want[name] / foot, atol=1e-4)
    ground = array["Classification"] == 2
    assert array["Ground"][ground].mean() > 0.99
    assert np.abs(array["HeightAboveGround"][ground]).mean() < 0.25  # feet
