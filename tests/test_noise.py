"""Detached noise: against a slow reference, what must hold whatever the points, and on real clouds."""

from __future__ import annotations

import inspect
import itertools
import json
import math
from collections import Counter

import laspy
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

import pdal_stages as ps
from pdal_stages.base.errors import StageError
from pdal_stages.stages.base import WHOLE_CLOUD
from pdal_stages.stages.detached_noise import DetachedNoise
from pdal_stages.terrain import detached, low_outliers, noise
from pdal_stages.terrain.noise import detached_noise

SIDE = noise.SIDE
RULES = detached.RULES
GAP = inspect.signature(detached_noise).parameters["gap"].default


def scene(seed=0, side=90, density=6.0, origin=(0.0, 0.0, 0.0)):
    """A hillside with houses, a courtyard, a wood, a wire, and noise of all kinds: xyz and 0, 7 or 18."""
    rng = np.random.default_rng(seed)
    n = int(side * side * density)
    x, y = rng.uniform(0, side, (2, n))
    ground = 0.15 * x + 2 * np.sin(y / 15)
    z = ground + rng.normal(0, 0.03, n)
    house = (x > 20) & (x < 45) & (y > 20) & (y < 45)
    court = (np.abs(x - 32) < 3) & (np.abs(y - 32) < 3)
    z[house] = 15 + rng.normal(0, 0.03, house.sum())
    z[court] = ground[court]
    wood = (x > 60) & (y > 55)
    z[wood] += rng.uniform(0, 12, wood.sum()) * (rng.random(wood.sum()) < 0.8)
    along = np.linspace(0, side, 400)
    wire = np.column_stack(
        [along, np.full(400, 10.0), 25 + 0.002 * (along - side / 2) ** 2 + 0.1 * along]
    )
    noise, codes = [], []
    for _ in range(24):
        at = np.array([*rng.uniform(5, side - 5, 2), 0.0])
        low = rng.random() < 0.5
        level = 0.15 * at[0] + 2 * np.sin(at[1] / 15)
        at[2] = level - rng.uniform(4, 25) if low else 45 + rng.uniform(0, 200)
        size = 1 if rng.random() < 0.5 else rng.integers(2, 30)
        noise.append(at + rng.normal(0, 0.3, (size, 3)))
        codes += [7 if low else 18] * size
    xyz = np.round(np.vstack([np.column_stack([x, y, z]), wire, *noise]) + origin, 3)
    return xyz, np.r_[np.zeros(n + 400, np.uint8), np.array(codes, np.uint8)]


# ---- a slow reference -----------------------------------------------------------------------------------


def slow_components(voxels):
    """Lists of those that touch, the first by row, column and level at the head of each."""
    if not voxels:
        return
    members = np.array(sorted(voxels))
    touching = np.abs(members[:, None] - members[None]).max(axis=2) <= 1
    number = connected_components(coo_matrix(touching))[1]
    for k in range(number.max() + 1):
        yield [tuple(map(int, m)) for m in members[number == k]]


def slow_is_wire(members, side, height):
    """Whether voxels lie along a line that is long, thin and rises little."""
    row, column, layer = np.ptp(np.array(members), axis=0)
    flat = max(row, column)
    if flat + 1 < RULES.line_columns or (flat + 1) * side < RULES.line_m:
        return False
    across = np.linalg.eigvalsh(np.cov(np.array(members)[:, :2].T, bias=True))[0]
    return across <= RULES.line_variance and layer * height <= RULES.line_slope * flat * side


def voxels_of(xyz, side):
    """Return the row, column and layer of each point's voxel."""
    height = min(side, max(RULES.flat_m, side / 2))
    at = np.floor(xyz[:, [1, 0, 2]] / [side, side, height]).astype(int)
    return list(map(tuple, at.tolist()))


def slow_states(xyz, side, most):
    """Solid 0, held 1 or loose 2 of voxels of one side, from the definition."""
    height = min(side, max(RULES.flat_m, side / 2))
    voxel = voxels_of(xyz, side)
    count = Counter(voxel)
    full = [k for k, (company, least) in slow_company(count).items() if company >= least]
    solid, heavy = set(), []
    longest, tops = max(RULES.extent_sides * side, RULES.extent_m), {}
    for number, members in enumerate(slow_components(full)):
        for j, i, n in members:
            tops[j, i] = max(tops.get((j, i), (n, number)), (n, number))
        row, column, layer = np.ptp(np.array(members), axis=0)
        long = max((max(row, column) + 1) * side, layer * height) > longest
        if long or slow_is_wire(members, side, height):
            solid.update(members)
        elif sum(count[k] for k in members) > most(members[0], side):
            heavy.append((number, members))
    covered = set()
    for number, members in heavy:
        under = sum(count[j, i, n] for j, i, n in members if tops[j, i][1] != number)
        whole = under >= RULES.min_covered * sum(count[k] for k in members)
        (covered if whole else solid).update(members)
    states, up = {}, math.ceil(RULES.hold_sides * side / height)
    for k in count:
        away = np.abs(np.array(sorted(solid)).reshape(-1, 3) - k)
        held = (away[:, :2].max(axis=1) <= RULES.hold_columns) & (away[:, 2] <= up)
        states[k] = 0 if k in solid else 1 if held.any() or k in covered else 2
    return np.array([states[k] for k in voxel])


def slow_company(count):
    """Points in the 27 voxels around each, and how many these must hold for it to be full."""
    out, steps = {}, list(itertools.product((-1, 0, 1), repeat=3))
    for j, i, n in count:
        near = [count[at] for b, a, c in steps if (at := (j + b, i + a, n + c)) in count]
        out[j, i, n] = sum(near), RULES.min_around + RULES.min_more * max(0, len(near) - 3)
    return out


def slow_detached(xyz, cluster, gap):
    """The states of points: by voxels as wide as the density around needs."""
    size = detached.BLOCK_M
    block = list(map(tuple, np.floor(xyz[:, :2] / size).astype(int).tolist()))
    count, density = Counter(block), {}
    for i, j in count:
        near = [(i + a, j + b) for a in (-1, 0, 1) for b in (-1, 0, 1) if (i + a, j + b) in count]
        density[i, j] = sum(count[k] for k in near) / len(near) / size**2

    def most(first, side):
        at = (int(first[1] * side // size), int(first[0] * side // size))
        return max(cluster, RULES.cluster_area_m2 * density[at])

    wide = {k: gap * (RULES.dense_per_m2 / d) ** (1 / 3) for k, d in density.items()}
    scale = {
        k: min([n for n, s in enumerate(RULES.sides) if s >= w] or [len(RULES.sides) - 1])
        for k, w in wide.items()
    }
    states = np.zeros(len(xyz), int)
    for number, side in enumerate(RULES.sides):
        lonely = Counter(k for k, n in zip(block, slow_lonely(xyz, side), strict=True) if n)
        for k in [k for k in count if scale[k] == number]:
            near = [(k[0] + a, k[1] + b) for a in (-1, 0, 1) for b in (-1, 0, 1)]
            if sum(lonely[n] for n in near) > RULES.max_lonely * sum(count[n] for n in near):
                scale[k] += 1
        mine = np.array([scale[k] == number for k in block])
        if mine.any():
            states[mine] = slow_states(xyz, side, most)[mine]
    return states


def slow_lonely(xyz, side):
    """Return which points lack company in the 27 voxels around."""
    voxel = voxels_of(xyz, side)
    company = slow_company(Counter(voxel))
    return [company[k][0] < max(RULES.min_company, company[k][1]) for k in voxel]


def slow_plane(low, j, i):
    """Height under a column, and rise per column: least squares, reweighted eight times."""
    near = low_outliers.RULES.near
    v, u = (np.argwhere(np.isfinite(low)) - (j, i)).T
    v, u = (axis[u**2 + v**2 <= near**2] for axis in (v, u))
    if len(u) < low_outliers.RULES.min_columns:
        return None
    z = low[j + v, i + u]
    lowest, off = z.min(), z - z.min()
    design, ordered = np.column_stack([np.ones(len(u)), u, v]), np.sort(off)
    trusted = (off >= ordered[len(u) // 10]) & (off <= ordered[len(u) // 2])
    weight = np.where(trusted, 1.0, 0.01)
    for _ in range(8):
        normal = design.T @ (weight[:, None] * design) + np.diag([0, 1, 1]) * 1e-3 * weight.sum()
        plane = np.linalg.solve(normal, design.T @ (weight * (z - lowest)))
        off = z - lowest - design @ plane
        weight = np.where(off < 0, 1 / (1 + off**2) ** 2, 0.1 / (1 + off**2))
    return plane[0] + lowest, plane[1], plane[2]


def slow_noise(xyz, cluster=30, gap=GAP, depth=1.0):
    """From the definition, with dictionaries and searches over everything."""
    states = slow_detached(xyz, cluster, gap)
    at = np.floor(xyz[:, [1, 0]] / SIDE).astype(int)
    at -= at.min(axis=0) - 1
    base, low = (np.full(at.max(axis=0) + 2, np.inf) for _ in range(2))
    for points, lowest in ((states == 0, base), (states > 0, low)):
        np.minimum.at(lowest, tuple(at[points].T), xyz[points, 2])
    limit = slow_below(low, base, SIDE, depth, noise.BELOW_RULES.min_land)
    codes = np.where((states > 0) & (xyz[:, 2] < limit[tuple(at.T)]), 7, 0)
    for p in np.flatnonzero(states == 2):
        plane = slow_plane(base, *at[p])
        if plane and xyz[p, 2] >= plane[0] + noise.ABOVE_M:
            codes[p] = 18
    return codes


def slow_below(low, base, side, depth=1.0, min_land=0.0):
    """Below which height low places are below the ground: by planes, land and company."""
    limit, supported = np.full(low.shape, -np.inf), slow_supported(base)
    j, i = np.mgrid[: base.shape[0], : base.shape[1]]
    for at in np.argwhere(np.isfinite(low)):
        plane = slow_plane(base, *at)
        lowest = plane[0] - depth if plane else -np.inf
        near = (j - at[0]) ** 2 + (i - at[1]) ** 2 <= low_outliers.RULES.near**2
        has_land = (near & supported).sum() >= min_land * (near & np.isfinite(base)).sum()
        if (low[tuple(at)] < lowest and has_land) and not slow_deep_company(
            base, supported, at, low[tuple(at)], plane, side
        ):
            limit[tuple(at)] = lowest
    return limit


def slow_supported(base):
    out = np.zeros(base.shape, bool)
    for b, a in np.argwhere(np.isfinite(base)):
        square = base[max(b - 2, 0) : b + 3, max(a - 2, 0) : a + 3]
        level = (np.abs(square - base[b, a]) <= low_outliers.RULES.level_m).sum()
        share = low_outliers.RULES.min_support_share * np.isfinite(square).sum()
        out[b, a] = level > low_outliers.RULES.min_support + share
    return out


def slow_linked(raster, side):
    """Number of each cell's set, of those linked across small steps, -1 in holes."""
    cells = np.argwhere(np.isfinite(raster))
    z, number = raster[tuple(cells.T)], np.full(raster.shape, -1)
    away = np.linalg.norm(cells[:, None] - cells[None], axis=2)
    step = np.abs(z[:, None] - z[None]) <= (0.35 + 0.15 * side * away).astype(np.float32)
    first, other = np.nonzero((away <= 3) & step)
    pairs = coo_matrix((np.ones(len(first)), (first, other)), shape=(len(z),) * 2)
    number[tuple(cells.T)] = connected_components(pairs)[1]
    return number


def slow_deep_company(base, supported, at, z, plane, side):
    """Return whether enough columns are about as deep as z, below the plane."""
    j, i = np.mgrid[: base.shape[0], : base.shape[1]]
    away = side * np.hypot(j - at[0], i - at[1])
    half = 0.5 * (plane[0] - z)
    below = plane[0] + plane[1] * (i - at[1]) + plane[2] * (j - at[0]) - base
    most = np.minimum(half, low_outliers.RULES.level_m + low_outliers.RULES.max_rise * away)
    deep = (base <= z + most) & (below >= half) & (away <= low_outliers.RULES.far_m)
    return (deep & supported).sum() >= low_outliers.RULES.min_company


@pytest.mark.parametrize(("seed", "density"), [(0, 6.0), (1, 0.4), (3, 70.0)])
def test_the_kernels_equal_the_slow_reference(seed, density):
    xyz, _ = scene(seed, 60 if density < 1 else 30, density)
    rng = np.random.default_rng(seed)
    many = [rng.uniform(at, np.add(at, 3), (250, 3)) for at in ((6, 6, -9), (22, 10, -6))]
    xyz = np.concatenate([xyz, *many])
    noise_codes = detached_noise(xyz)
    assert np.array_equal(noise_codes, slow_noise(xyz))
    assert noise_codes[:-500].any()
    assert noise_codes[-500:].all() == (density > 1)


def test_clusters_below_thin_clouds():
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, 60, (2, 1440))
    z = -0.3 * np.maximum(x - 32, 0) + rng.normal(0, 0.03, len(x))
    balls = rng.normal(0, 1, (3, 30, 3))
    balls *= 2 * rng.random((3, 30, 1)) ** (1 / 3) / np.linalg.norm(balls, axis=2, keepdims=True)
    balls += [[[20, 15 * k + 15, -24]] for k in range(3)]
    noise_codes = detached_noise(np.vstack([np.column_stack([x, y, z]), *balls]))
    assert np.array_equal(noise_codes == 7, np.arange(len(noise_codes)) >= len(x))


# ---- what must hold -------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(2))
def test_noise_is_found_and_nothing_else(seed):
    xyz, truth = scene(seed)
    noise_codes = detached_noise(xyz)
    assert (noise_codes[truth == 0] == 0).all()  # wires, courtyards and trees too
    assert (noise_codes == truth)[truth > 0].mean() > 0.95


@settings(max_examples=6, deadline=None)
@given(
    seed=st.integers(0, 1000),
    steps=st.tuples(*[st.integers(-400, 400)] * 3),
    density=st.sampled_from([0.4, 5.0]),
)
def test_order_and_shifts_by_whole_blocks_change_nothing(seed, steps, density):
    xyz, _ = scene(seed, 60, density)
    xyz = np.round(xyz * 8) / 8  # so that a shift rounds nothing
    noise_codes = detached_noise(xyz)
    order = np.random.default_rng(seed).permutation(len(xyz))
    assert np.array_equal(detached_noise(xyz[order]), noise_codes[order])
    shift = np.array(steps) * detached.BLOCK_M
    assert np.array_equal(detached_noise(xyz + shift), noise_codes)


@pytest.mark.parametrize("density", [0.5, 3.0])
def test_a_tile_with_its_surroundings_gets_what_the_whole_gets(density):
    xyz, _ = scene(5, 420, density)
    noise_codes = detached_noise(xyz)
    for x0, y0 in ((0, 0), (201.3, 177.7), (333, 40)):
        beyond = np.max([[x0, y0] - xyz[:, :2], xyz[:, :2] - [x0 + 60, y0 + 60]], axis=(0, 2))
        inside, near = beyond < 0, beyond < noise.REACH
        assert near.sum() < len(xyz)
        part = detached_noise(xyz[near])
        assert np.array_equal(part[inside[near]], noise_codes[inside])


def test_degenerate_clouds_hold_no_noise():
    for xyz in (np.empty((0, 3)), np.zeros((1, 3)), np.zeros((500, 3)), np.full((3, 3), np.nan)):
        assert not detached_noise(xyz).any()
    assert not detached_noise([[0.0, 0, 2e6], [0, 0, -2e6], [0, 0, 1e300]]).any()
    with pytest.raises(StageError, match="'mask' must have one value per point"):
        detached_noise(np.zeros((3, 3)), mask=[True])


def test_no_point_is_noise_for_its_height_alone():
    xyz, truth = scene(2, origin=(0.0, 0.0, 2_400_000.0))
    noise_codes = detached_noise(xyz)
    assert (noise_codes[truth == 0] == 0).all()
    assert (noise_codes[truth == 18] == 18).mean() > 0.95


def test_points_that_lie_alone_are_no_noise_and_many_are_refused():
    xyz = np.random.default_rng(0).uniform(0, [2e7, 2e7, 50], (4500, 3))
    assert not detached_noise(xyz[:500]).any()
    for find in (detached_noise, ps.filtered_ground):
        with pytest.raises(StageError, match=r"of 4,500 points.* scale and unit"):
            find(xyz)


@pytest.mark.parametrize(
    ("spacing", "wires", "density"), [(0.3, 1, 1.3), (2.0, 1, 0.2), (1.0, 2, 8.0)]
)
def test_wires_stay_however_thin_the_cloud(spacing, wires, density):
    rng = np.random.default_rng(1)
    x, y = rng.uniform(0, 150, (2, int(150 * 150 * density)))
    ground = np.column_stack([x, y, rng.normal(0, 0.05, len(x))])
    along = np.tile(np.arange(2, 148, spacing), wires)
    apart = np.repeat(6.0 * np.arange(wires), len(along) // wires)
    along += rng.uniform(-0.7, 0.7, len(along)) * spacing
    wire = np.column_stack([along, 40 + 0.5 * along + apart, 30 + 0.001 * (along - 75) ** 2])
    noise_codes = detached_noise(np.vstack([ground, wire]))
    assert (noise_codes[len(ground) :] > 0).mean() <= 0.05


@pytest.mark.parametrize("density", [0.04, 0.1, 0.2, 0.4])
def test_thin_clouds_of_steep_woods_lose_nothing(density):
    rng = np.random.default_rng(3)
    x, y = rng.uniform(0, 250, (2, int(250 * 250 * density)))
    wood = np.abs(y - 125) < 90
    z = 0.8 * x + np.where(wood, 25 * np.sqrt(rng.random(len(x))), 0)
    assert (detached_noise(x, y, z) > 0).mean() <= 0.0003


def test_ground_seen_in_single_points_under_closed_crowns_is_no_noise():
    rng = np.random.default_rng(1)
    x, y = rng.uniform(0, 200, (2, 80_000))
    wood, at = np.hypot(x - 100, y - 100) < 80, ((y / 6).astype(int), (x / 6).astype(int))
    seen = ~wood | (rng.random(len(x)) < 0.02)
    crown = rng.uniform(12, 26, (34, 34))[at] * rng.beta(5, 1.3, len(x))
    noise_codes = detached_noise(x, y, 0.3 * x + np.where(seen, 0, crown))
    assert (noise_codes[wood & seen] > 0).mean() <= 0.01


#: What is low by x and y, in meters: bare above, wide, or with returns on the way down.
LOW_PLACES = {
    "basement": lambda x, y: -6 * (np.maximum(abs(x), abs(y)) < 5),
    "well of light in a block": lambda x, y: (
        18.0 * (np.maximum(abs(x), abs(y)) < 50) - 18 * (np.maximum(abs(x), abs(y)) < 2.5)
    ),
    "lanes that go down under a street": lambda x, y: (
        -6 * np.clip((30 - abs(y)) / 15, 0, 1) * ((abs(x) < 5) & (abs(y) >= 8))
    ),
    "terraces": lambda x, y: -5 * np.floor(np.clip(x, 0, 40) / 10),
    "ditch and pit": lambda x, y: -2.5 * (abs(x - 20) < 1) - 6 * (np.hypot(x + 15, y - 15) < 4),
    "gorge": lambda x, y: -25 * (abs(x - 8 * np.sin(y / 20)) < 4),
    "quarry": lambda x, y: -20 * (np.hypot(x, y) < 15),
}


@pytest.mark.parametrize("what", LOW_PLACES)
def test_true_low_places_are_no_noise(what):
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-60, 60, (2, 120_000))
    assert not detached_noise(x, y, rng.normal(0, 0.02, len(x)) + LOW_PLACES[what](x, y)).any()


@pytest.mark.parametrize(
    ("count", "wide", "deep", "density"),
    [(300, 2, 5, 9.4), (1000, 10, 30, 9.4), (1000, 10, 3, 9.4), (300, 6, 40, 0.3)],
)
def test_many_echoes_from_below_are_noise(count, wide, deep, density):
    rng = np.random.default_rng(2)
    land = rng.uniform((-80, -80, 0), (80, 80, 0.1), (int(160**2 * density), 3))
    part = rng.uniform(-wide / 2, wide / 2, (count, 3)) - [0, 0, wide / 2 + deep]
    codes = detached_noise(np.concatenate([land, part]))
    assert not codes[: len(land)].any()
    assert (codes[len(land) :] == 7).mean() > 0.95


def test_threads_change_nothing(monkeypatch):
    xyz, _ = scene(4, 60)
    every = detached_noise(xyz, threads=1)
    assert set(every) == {0, 7, 18}
    monkeypatch.setattr(detached, "SHARE", 1000)
    for threads in (1, 2, 5):
        assert np.array_equal(detached_noise(xyz, threads=threads), every)


# ---- the stage ------------------------------------------------------------------------------------------


def arrays_of(xyz, codes):
    return dict(zip("XYZ", xyz.T, strict=True)) | {"Classification": codes.astype(np.uint8)}


def test_the_stage_keeps_classes_and_where():
    xyz, truth = scene(8)
    codes = np.where(truth == 0, 2, 1)
    codes[truth == 18] = 5
    stage = DetachedNoise({"where": "Classification != 5"})
    points = stage.points(arrays_of(xyz, codes))
    out = stage.run(points, WHOLE_CLOUD)["Classification"]
    assert (out[truth == 18] == 5).all() and (out[truth == 0] == 2).all()
    assert (out[truth == 7] == 7).mean() > 0.9
    assert points.report.figures["low"] == (out == 7).sum() and points.report.figures["high"] == 0
    assert stage.written_classes() == {7, 18} and stage.creates() == {"Classification": "uint8_t"}


def test_what_is_noise_already_is_as_good_as_not_there():
    xyz, truth = scene(9)
    marked = DetachedNoise({}).points(arrays_of(xyz, truth))
    assert np.array_equal(DetachedNoise({}).run(marked, WHOLE_CLOUD)["Classification"], truth)
    assert (
        marked.report.figures["ignored"] == (truth > 0).sum()
        and not marked.report.figures["low"] + marked.report.figures["high"]
    )


@pytest.mark.pdal
def test_in_tiles_as_in_one_piece_and_in_feet(tmp_path, write_las):
    xyz, truth = scene(10, 120, 2.0)
    source = write_las(tmp_path / "in.las", arrays_of(xyz, np.ones(len(xyz))), point_format=1)
    stages = [str(source), {"type": "filters.detachednoise"}, str(tmp_path / "whole.las")]
    whole = ps.Pipeline(stages)
    whole.execute()
    stages[2] = {"type": "writers.las", "filename": str(tmp_path / "tiled.las"), "forward": "all"}
    ps.run_tiled(stages, tile=60, workers=0)
    first, two = (laspy.read(tmp_path / f"{name}.las") for name in ("whole", "tiled"))
    assert np.array_equal(first.classification, two.classification)
    assert (np.asarray(first.classification) == np.where(truth == 0, 1, truth)).mean() > 0.999
    report = whole.metadata["metadata"]["filters.detachednoise"]
    assert report["low"] == (np.asarray(first.classification) == 7).sum()
    feet = DetachedNoise({"horizontal_unit": "foot", "vertical_unit": "foot"})
    measured = feet.points(arrays_of(xyz / 0.3048, np.ones(len(xyz))))
    in_feet = feet.run(measured, WHOLE_CLOUD)["Classification"]
    assert np.mean(in_feet == np.asarray(first.classification)) > 0.9999


@pytest.mark.pdal
def test_classify_marks_noise_first_unless_told_not_to(tmp_path, capsys, write_las):
    from pdal_stages.cli import main

    xyz, truth = scene(11, 60)
    source = write_las(tmp_path / "in.las", arrays_of(xyz, np.ones(len(xyz))), point_format=1)
    out = tmp_path / "out.las"
    assert main(["classify", str(source), str(out), "--metadata", str(tmp_path / "m.json")]) == 0
    codes = np.asarray(laspy.read(out).classification)
    assert (codes == truth)[truth > 0].mean() > 0.9
    output = capsys.readouterr().out
    assert "  7 Low point (noise)" in output and " 18 High noise" in output
    assert "filters.detachednoise" in json.dumps(json.loads((tmp_path / "m.json").read_text()))
    assert main(["classify", str(source), str(out), "--no-noise"]) == 0
    assert not np.isin(laspy.read(out).classification, (7, 18)).any()
    assert "(noise)" not in capsys.readouterr().out


# ---- real clouds ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["seville/plazanueva", "rural/lidarhd_bank", "forest/neon_osbs", "rural/ahn4_powerline"]
)
def test_real_clouds_lose_next_to_nothing_and_lose_their_noise(name, data_dir):
    las = laspy.read(data_dir / f"{name}.laz")
    xyz, codes = np.column_stack([las.x, las.y, las.z]), np.asarray(las.classification)
    noise_codes = detached_noise(xyz)
    good = np.isin(codes, (2, 3, 4, 5, 6, 9, 12, 14, 15, 17))
    assert (noise_codes[good] > 0).mean() <= 0.0002
    assert not (codes == 14).any() or (noise_codes[codes == 14] > 0).mean() <= 0.005
    rng = np.random.default_rng(0)
    ground = xyz[codes == 2]
    at = ground[rng.integers(len(ground), size=60)]
    deep = at - np.column_stack([np.zeros((60, 2)), rng.uniform(5, 30, 60)])
    high = at + np.column_stack([np.zeros((60, 2)), rng.uniform(60, 300, 60)])
    codes = detached_noise(np.vstack([xyz, deep, high]))[len(xyz) :]
    assert (codes[:60] == 7).mean() >= 0.9 and (codes[60:] == 18).mean() >= 0.95
