"""Low outliers under the ground filter, alone or in clusters: against a slow reference, in scenes, on real clouds."""

from __future__ import annotations

import laspy
import numpy as np
import pytest
from test_noise import slow_below, slow_linked

from pdal_stages.terrain import filtered_ground
from pdal_stages.terrain.cells import HOLE
from pdal_stages.terrain.low_outliers import find_low_outliers

# ---- a slow reference -----------------------------------------------------------------------------------


def slow_outliers(raster, cell=1.0):
    number = slow_linked(raster, cell)
    sets = [np.argwhere(number == k) for k in range(number.max() + 1)]
    small = [len(cells) <= 30 and (np.ptp(cells, axis=0) < 20).all() for cells in sets]
    island = np.append(small, False)[number]
    low, base = np.where(island, raster, np.inf), np.where(island, np.inf, raster)
    return np.isfinite(slow_below(low.astype(float), base.astype(float), cell))


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


@pytest.mark.parametrize("seed", range(2))
def test_outliers_equal_the_slow_reference(seed):
    raster = rough(seed, holes=0.2 if seed % 2 else 0.7)
    outliers = find_low_outliers(raster, 1.0)
    assert np.array_equal(outliers, slow_outliers(raster))
    assert outliers.any()


# ---- scenes ---------------------------------------------------------------------------------------------


def field(seed=0, shape=(70, 70)):
    rng = np.random.default_rng(seed)
    return rng.normal(0, 0.03, shape).astype(np.float32), rng


def test_clusters_at_one_depth_are_outliers():
    """They keep each other company: nine clusters of 3 x 3 cells, all about 6 m below."""
    raster, rng = field()
    for j in (10, 30, 50):
        for i in (12, 32, 52):
            raster[j : j + 3, i : i + 3] = rng.normal(-6, 0.3, (3, 3)) - 0.5 * j / 10
    low = raster < -2
    assert np.array_equal(find_low_outliers(raster, 1.0), low)


@pytest.mark.parametrize("what", ["ditch", "quarry", "cellar beside a street"])
def test_what_is_deep_but_ground_is_kept(what):
    raster, _ = field()
    if what == "ditch":
        raster[:, 30:32] -= 2
    elif what == "quarry":
        raster[20:29, 20:30] -= 12
    else:
        raster[:, :] += 9
        raster[:, 60:] -= 9
        raster[40:45, 40:44] -= 9
    assert not find_low_outliers(raster, 1.0)[
        raster < (4 if what.startswith("cellar") else -1.5)
    ].any()


def test_terrain_stands_clusters_of_noise():
    """In a cloud narrower than the largest window one cluster took all ground with it."""
    rng = np.random.default_rng(1)
    xy = rng.uniform(0, 60, (36_000, 2))
    xyz = np.column_stack([xy, 0.05 * xy[:, 0] + rng.normal(0, 0.03, len(xy))])
    centers = np.column_stack([rng.uniform(2, 58, (20, 2)), rng.uniform(-30, -3, 20)])
    noise = [center + rng.normal(0, 0.4, (rng.integers(2, 31), 3)) for center in centers]
    both = np.vstack([xyz, *noise])
    clean, result = filtered_ground(xyz), filtered_ground(both)
    moved = np.abs(result["HeightAboveGround"][: len(xyz)] - clean["HeightAboveGround"])
    assert moved.max() < 0.2
    assert result["Ground"][: len(xyz)].mean() > 0.99
    assert not result["Ground"][len(xyz) :].any()


@pytest.mark.parametrize("name", ["montpellier/train_77055_627755.laz", "rural/lidarhd_bank.laz"])
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
    clean, result = filtered_ground(xyz), filtered_ground(np.vstack([xyz, *noise]))
    lost = clean["Ground"][ground] > result["Ground"][: len(xyz)][ground]
    moved = np.abs(result["HeightAboveGround"][: len(xyz)] - clean["HeightAboveGround"]) > 0.3
    assert lost.mean() < 0.005
    assert moved.mean() < 0.02
