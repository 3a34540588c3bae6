"""The gap below a point against a slow reference, and what must hold of it."""

from __future__ import annotations

import numpy as np
import pytest

from pdal_stages.classifier.input_dimensions import add_surroundings, required_dimensions
from pdal_stages.features import FeaturePlan
from pdal_stages.features.gap_below import LEAST, MOST, NAME, REACH, SIDE, gap_below


def slow(xyz):
    """Point by point, over all others."""
    cell = np.floor(xyz[:, :2] / SIDE)
    out = []
    for place, z in zip(cell, xyz[:, 2], strict=True):
        near = (abs(cell - place) <= 1).all(axis=1) & (xyz[:, 2] <= z - LEAST)
        out.append(z - max(xyz[near, 2].max(initial=-np.inf), z - MOST))
    return np.array(out)


def cloud(seed, n=500):
    rng = np.random.default_rng(seed)
    return rng.uniform((5e5, -8.0, 0.0), (5e5 + 12.0, 4.0, 30.0), (n, 3))


@pytest.mark.parametrize("seed", range(3))
def test_gaps_are_the_slow_reference_s(seed):
    xyz = cloud(seed)
    gap = gap_below([NAME], xyz)[NAME]
    assert gap.dtype == np.float32
    np.testing.assert_allclose(gap, slow(xyz), atol=1e-5)
    order = np.random.default_rng(9).permutation(len(xyz))
    assert np.array_equal(gap_below([NAME], xyz[order])[NAME], gap[order])


def test_a_wire_hangs_and_a_facade_stands():
    ground = np.array([[x, y, 0.0] for x in range(10) for y in range(10)], float)
    wire = np.array([[x, 5.0, 8.0] for x in range(10)], float)
    wall = np.array([[0.0, 0.0, z] for z in np.arange(0.5, 8.0, 0.5)])
    gap = gap_below([NAME], np.concatenate([ground, wire, wall]))[NAME]
    assert (gap[100:110] == 8.0).all() and gap[-1] == 1.0
    assert (gap[:100] == MOST).all()


def test_models_need_nothing_for_it_but_surroundings():
    xyz = cloud(0)
    assert required_dimensions([NAME, "Z"]) == ()
    assert NAME in add_surroundings([NAME], xyz, {}) and not add_surroundings([], xyz, {})
    assert FeaturePlan.parse("s1", "Linearity", [NAME]).halo_m >= REACH
    assert gap_below([NAME], np.zeros((0, 3)))[NAME].shape == (0,)
