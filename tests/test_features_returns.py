"""Return features against a slow reference, and what must hold of them."""

from __future__ import annotations

import numpy as np
import pytest

from pdal_stages.classifier.input_dimensions import (
    add_surroundings,
    optional_dimensions,
    required_dimensions,
    take_dimensions,
)
from pdal_stages.features import FeaturePlan, return_features


def cloud(n=400, seed=0, spread=12.0):
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(0, spread, (n, 3)) + np.array([500_000.0, -3.0, 0.0])
    total = rng.integers(0, 4, n).astype(np.uint8)
    number = np.minimum(rng.integers(0, 4, n), total).astype(np.uint8)
    return xyz, {"ReturnNumber": number, "NumberOfReturns": total}


def slow(name, xyz, dimensions):
    """Point by point, over all others."""
    number, total = (
        dimensions["ReturnNumber"].astype(int),
        dimensions["NumberOfReturns"].astype(int),
    )
    flag = total > 1 if name.startswith("MultipleReturn") else (number > 0) & (number < total)
    axes, side = return_features.SCALES[
        name.removeprefix("MultipleReturn").removeprefix("EarlierReturn")
    ]
    if not axes:
        return flag.astype(float)
    cell = np.floor(xyz[:, :axes] / side).astype(int)
    return np.array([flag[(abs(cell - inside) <= 1).all(axis=1)].mean() for inside in cell])


@pytest.mark.parametrize("name", return_features.NAMES)
@pytest.mark.parametrize("seed", range(3))
def test_they_are_the_slow_reference_s(name, seed):
    xyz, dimensions = cloud(seed=seed)
    got = return_features.return_features([name], xyz, dimensions)[name]
    assert got.dtype == (np.float32 if "_" in name else np.uint8)
    assert got == pytest.approx(slow(name, xyz, dimensions), abs=1e-6)


def test_any_order_of_points_and_a_tile_with_its_halo_give_the_same_bits():
    xyz, dimensions = cloud(3000, seed=5, spread=60.0)
    whole = return_features.return_features(return_features.NAMES, xyz, dimensions)
    order = np.random.default_rng(1).permutation(len(xyz))
    moved = return_features.return_features(
        return_features.NAMES,
        xyz[order],
        {name: values[order] for name, values in dimensions.items()},
    )
    low, high = xyz[:, :2].min(axis=0) + 20, xyz[:, :2].min(axis=0) + 40
    halo = FeaturePlan.parse("s1", "Linearity", return_features.NAMES).halo_m
    near = ((xyz[:, :2] >= low - halo) & (xyz[:, :2] < high + halo)).all(axis=1)
    tile = return_features.return_features(
        return_features.NAMES, xyz[near], {k: v[near] for k, v in dimensions.items()}
    )
    inside = ((xyz[near, :2] >= low) & (xyz[near, :2] < high)).all(axis=1)
    for name in return_features.NAMES:
        assert np.array_equal(moved[name], whole[name][order])
        assert inside.any() and np.array_equal(tile[name][inside], whole[name][near][inside])


def test_without_return_numbers_all_is_zero():
    xyz, _ = cloud(50)
    assert (
        required_dimensions(return_features.NAMES) == ()
        and optional_dimensions(return_features.NAMES) == return_features.SOURCES
    )
    for dimensions in ({}, {name: np.zeros(50, np.uint8) for name in return_features.SOURCES}):
        fed = take_dimensions(
            return_features.NAMES,
            add_surroundings(return_features.NAMES, xyz, dimensions),
            50,
            np.arange(0, 50, 7),
        )
        assert all(len(fed[name]) == 8 and not fed[name].any() for name in return_features.NAMES)
    assert not len(
        return_features.return_features(return_features.NAMES, xyz[:0], {})["MultipleReturn_box2"]
    )


def test_names():
    assert FeaturePlan.parse("s1", "Linearity", "returns,Intensity").dimensions == (
        *return_features.NAMES,
        "Intensity",
    )
