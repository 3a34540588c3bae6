"""Clusters of low noise under the ground filter: against a slow reference, in scenes, on real clouds."""

from __future__ import annotations

import laspy
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from test_detached_noise import slow_plane

from pdal_stages.terrain import filtered_ground
from pdal_stages.terrain.islands import FAR, REACH, mark_islands
from pdal_stages.terrain.lowest import pits
from pdal_stages.terrain.openings import HOLE

# ---- a slow reference -----------------------------------------------------------------------------------


def slow_islands(raster, cell=1.0):
    """Number of each cell's set of linked cells, and which sets are small."""
    cells = np.argwhere(np.isfinite(raster))
    z = raster[tuple(cells.T)]
    away = np.linalg.norm(cells[:, None] - cells[None], axis=2)
    step = np.abs(z[:, None] - z[None]) <= (0.35 + 0.15 * cell * away).astype(np.float32)
    one, other = np.nonzero((away <= 3) & step)
    count, label = connected_components(coo_matrix((np.ones(len(one)), (one, other)), shape=(len(z),) * 2))
    number = np.full(raster.shape, -1)
    number[tuple(cells.T)] = label
    small = []
    for k in range(count):
        mine = cells[label == k]
        small.append(len(mine) <= 30 and (np.ptp(mine, axis=0) < 6).all())
    return number, np.array(small)


def number_of(base, j, i, radius):
    b, a = np.nonzero(np.isfinite(base))
    return int(((b - j) ** 2 + (a - i) ** 2 <= radius * radius).sum() - np.isfinite(base[j, i]))


def slow_marks(raster, cell=1.0):
    number, small = slow_islands(raster, cell)
    island = (number >= 0) & small[number]
    base = np.where(island, np.inf, raster).astype(float)
    rows, columns = np.mgrid[: raster.shape[0], : raster.shape[1]]
    firsts = [tuple(np.argwhere(number == k)[0]) for k in np.flatnonzero(small)]
    out = np.zeros(raster.shape, bool)
    for j, i in np.argwhere(island):
        z = float(raster[j, i])

        def lowest(around, j=j, i=i):
            part = base[max(j - around, 0) : j + around + 1, max(i - around, 0) : i + around + 1]
            return part.min(), np.isfinite(part).sum()

        level, number_near = lowest(2)
        if level < z + 0.5 or (number_near < 12 and lowest(4)[0] < z + 0.5):
            continue
        n, found = number_of(base, j, i, 6), slow_plane(base, j, i, 6)
        spacing = cell / np.sqrt(-np.log(1 - min((n + 1) / 113, 0.95)))
        found = found or slow_plane(base, j, i, 13)
        if not found:
            continue
        *plane, scatter = found
        if plane[0] - z <= 1.0 + 2.0 * max(spacing - 0.7, 0) + 4 * scatter:
            continue
        half = (plane[0] - z) / 2
        away = np.hypot(rows - j, columns - i)
        under = plane[0] + plane[1] * (columns - i) + plane[2] * (rows - j) - raster
        room = np.minimum(half, 1.0 + 0.05 * cell * away)
        deep = (base <= z + room) & (under >= np.maximum(half, 0.15 * cell * away)) & (away <= FAR)
        company = 0
        for b, a in np.argwhere(deep):
            part = base[max(b - 2, 0) : b + 3, max(a - 2, 0) : a + 3]
            level = (np.abs(part - base[b, a]) <= 1.0).sum()
            company += level > 2 + 0.2 * np.isfinite(part).sum()
        ring = [(b, a) for b, a in firsts if 5 < away[b, a] <= 20 and under[b, a] >= half]
        others = sum(abs(float(raster[b, a]) - z) <= room[b, a] for b, a in ring)
        out[j, i] = company < 4 and not (others >= 4 and others >= 0.5 * len(ring))
    return out


def rough(seed, shape=(44, 50), holes=0.2):
    """Two terraces, a slope, noise in clusters, a wood of which few cells are ground."""
    rng = np.random.default_rng(seed)
    j, i = np.mgrid[: shape[0], : shape[1]]
    z = 0.1 * i + np.where(j > 30, 4.0, 0.0) + rng.normal(0, 0.05, shape)
    wood = (i < 15) & (j < 20)
    z[wood & (rng.random(shape) < 0.9)] += rng.uniform(4, 9)
    for _ in range(14):
        b, a = rng.integers(shape[0]), rng.integers(shape[1])
        size = rng.integers(1, 4)
        part = z[b : b + size, a : a + size]
        part -= rng.uniform(1, 12) + rng.normal(0, 0.3, part.shape)
    z[rng.random(shape) < holes] = HOLE
    return z.astype(np.float32)


@pytest.mark.parametrize("seed", range(4))
def test_marks_equal_the_slow_reference(seed):
    raster = rough(seed, holes=0.2 if seed % 2 else 0.7)
    found = np.zeros(raster.shape, np.uint8)
    mark_islands(raster, 1.0, 3, found)
    assert np.array_equal(found == 3, slow_marks(raster))
    assert found.any()


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000))
def test_marks_do_not_depend_on_where_the_raster_ends(seed):
    far = REACH + 3
    raster = rough(seed, (2 * far + 12, 2 * far + 20))
    whole = np.zeros(raster.shape, np.uint8)
    mark_islands(raster, 1.0, 3, whole)
    part = raster[3:-3, 3:-3].copy()
    cut = np.zeros(part.shape, np.uint8)
    mark_islands(part, 1.0, 3, cut)
    inner = slice(REACH, -REACH)
    assert np.array_equal(cut[inner, inner], whole[3:-3, 3:-3][inner, inner])


# ---- scenes ---------------------------------------------------------------------------------------------


def field(seed=0, shape=(70, 70)):
    rng = np.random.default_rng(seed)
    return rng.normal(0, 0.03, shape).astype(np.float32), rng


def test_clusters_at_one_depth_are_pits():
    """They keep each other company: nine clusters of 3 x 3 cells, all about 6 m below."""
    raster, rng = field()
    for j in (10, 30, 50):
        for i in (12, 32, 52):
            raster[j : j + 3, i : i + 3] = rng.normal(-6, 0.3, (3, 3)) - 0.5 * j / 10
    low = raster < -2
    assert np.array_equal(pits(raster, 1.0), low)


@pytest.mark.parametrize("what", ["ditch", "quarry", "cellar beside a street", "wells of a block", "wood"])
def test_what_is_deep_but_ground_is_kept(what):
    raster, rng = field()
    if what == "ditch":
        raster[:, 30:32] -= 2
    elif what == "quarry":
        raster[20:29, 20:30] -= 12
    elif what == "cellar beside a street":
        raster[:, :] += 9
        raster[:, 60:] -= 9
        raster[40:45, 40:44] -= 9
    elif what == "wells of a block":  # no street near, but most of them as deep
        for j in (15, 26, 37, 48):
            for i in (15, 25, 35, 45):
                raster[j : j + 5, i : i + 4] -= rng.uniform(11, 12)
    else:
        raster[:] = rng.uniform(6, 16, raster.shape)
        seen = rng.random(raster.shape) < 0.05
        raster[seen] = 0
        assert pits(raster, 1.0)[seen].mean() < 0.05
        return
    deep = raster < (4 if what.startswith("cellar") else -1.5)
    if what.startswith("wells"):  # the outer ones see too few others
        deep[:20] = deep[45:] = deep[:, :22] = deep[:, 42:] = False
        assert deep.sum() == 80
    assert not pits(raster, 1.0)[deep].any()


def points_of(side=60.0, density=10, seed=1):
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, side, (int(side * side * density), 2))
    return np.column_stack([xy, 0.05 * xy[:, 0] + rng.normal(0, 0.03, len(xy))]), rng


def test_terrain_stands_clusters_of_noise():
    """In a cloud narrower than the largest window one cluster took all ground with it."""
    xyz, rng = points_of()
    centers = np.column_stack([rng.uniform(2, 58, (20, 2)), rng.uniform(-30, -3, 20)])
    noise = [center + rng.normal(0, 0.4, (rng.integers(2, 31), 3)) for center in centers]
    both = np.vstack([xyz, *noise])
    clean, found = filtered_ground(xyz), filtered_ground(both)
    moved = np.abs(found["HeightAboveGround"][: len(xyz)] - clean["HeightAboveGround"])
    assert moved.max() < 0.2
    assert found["Ground"][: len(xyz)].mean() > 0.99
    assert not found["Ground"][len(xyz) :].any()


@pytest.mark.parametrize(
    "name", ["montpellier/train_77055_627755.laz", "rural/lidarhd_bank.laz", "seville/plazanueva.laz"]
)
def test_real_ground_stands_noise(data_dir, name):
    """0.3 % of noise in clusters, 2 to 25 m below the ground: nearly all ground stays, with its heights."""
    las = laspy.read(data_dir / name)
    codes = np.asarray(las.classification)
    xyz = np.asarray(las.xyz)[codes != 7]
    ground = codes[codes != 7] == 2
    rng = np.random.default_rng(3)
    noise, put = [], 0
    while put < 0.003 * len(xyz):
        at, size = xyz[ground][rng.integers(ground.sum())], rng.integers(2, 31)
        spread = rng.normal(0, 0.4, (size, 3))
        top = min(at[2], xyz[np.hypot(*(xyz[:, :2] - at[:2]).T) < 3, 2].min())
        spread += [at[0], at[1], top - rng.uniform(2, 25) - spread[:, 2].max()]
        noise.append(spread)
        put += size
    clean, found = filtered_ground(xyz), filtered_ground(np.vstack([xyz, *noise]))
    lost = clean["Ground"][ground] > found["Ground"][: len(xyz)][ground]
    moved = np.abs(found["HeightAboveGround"][: len(xyz)] - clean["HeightAboveGround"]) > 0.3
    assert lost.mean() < 0.005
    assert moved.mean() < 0.02
