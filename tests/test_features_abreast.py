"""Sorting networks, moments of eight queries at once, and sums written as vectors, against plain sorting and adding."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from pdal_stages.base.jit import njit
from pdal_stages.features.abreast import MOST, STEP, make_networks
from pdal_stages.features.lanes import HIGH, LANES, LOW, SUMS, add_members, exchange
from pdal_stages.features.moments import MOMENTS, cylinder_sums, sphere_sums


@njit
def networks(need):
    return make_networks(need)


@njit
def run_network(keys, low, high, first, last):
    for c in range(first, last):
        exchange(keys, np.int64(low[c]) * LANES, np.int64(high[c]) * LANES)


@njit
def add(x, y, z, height, first, last, sums):
    add_members(x, y, z, height, first, last, sums)


@njit
def within(px, py, pz, q, r2, spherical, out):
    if spherical:
        sphere_sums(px, py, pz, q[0], q[1], q[2], r2, out, np.int64(0))
    else:
        cylinder_sums(px, py, pz, q[0], q[1], q[2], r2, out, np.int64(0))


@pytest.mark.parametrize("need", [1, 2, 11, 21, 51, 100, 128])
def test_networks_sort_what_is_needed_and_one_more(need):
    low, high, starts = networks(need)
    random = np.random.default_rng(need)
    for size in range(STEP, MOST + 1, STEP):
        first, last = starts[size // STEP]
        if size < need:
            assert first == last
            continue
        for values in (random.random((size, LANES)), random.integers(0, 3, (size, LANES)) + 0.0):
            keys = values.ravel().copy()
            run_network(keys, low, high, first, last)
            found, wanted = keys.reshape(size, LANES), np.sort(values, axis=0)
            assert np.array_equal(found[: need + 1], wanted[: need + 1])
            assert np.array_equal(np.sort(found, axis=0), wanted)


def test_too_many_neighbors_have_no_network():
    assert not networks(MOST + 1)[2].any()


def test_zeros_and_ones_are_sorted_for_all_first_places():
    # What sorts all sequences of zeros and ones sorts everything; here those of the smallest network, all 256.
    low, high, starts = networks(8)
    bits = ((np.arange(256)[:, None] >> np.arange(8)) & 1).astype(float)
    for part in bits.reshape(-1, LANES, 8):
        keys = part.T.ravel().copy()
        run_network(keys, low, high, *starts[1])
        assert np.array_equal(keys.reshape(8, LANES), np.sort(part.T, axis=0))


def test_moments_of_eight_queries_are_added_in_order():
    random = np.random.default_rng(3)
    x, y, z, height = random.normal(size=(4, 20, LANES))
    sums = np.zeros((SUMS, LANES))
    sums[-2:] = [[np.inf], [-np.inf]]
    add(x, y, z, height, 0, 7, sums)
    add(x, y, z, height, 7, 20, sums)
    for r in range(LANES):
        wanted = [0.0] * 9
        for a, b, c in zip(x[:, r], y[:, r], z[:, r], strict=True):
            for k, term in enumerate((a, b, c, a * a, a * b, a * c, b * b, b * c, c * c)):
                wanted[k] += term
        assert sums[:9, r].tolist() == wanted
        assert sums[9:, r].tolist() == [height[:, r].min(), height[:, r].max()]


@pytest.mark.parametrize("spherical", [True, False])
@pytest.mark.parametrize("size", [0, 8, 64])
def test_sums_within_a_radius(spherical, size):
    random = np.random.default_rng(size)
    points = random.uniform(-2, 2, (3, size))
    query, out = np.array([0.1, -0.2, 0.3]), np.empty((MOMENTS, 1))
    within(*points, query, 2.0, spherical, out)
    offsets = points - query[:, None]
    inside = (offsets[: 3 if spherical else 2] ** 2).sum(axis=0) <= 2.0
    d = offsets[:, inside]
    wanted = [inside.sum(), *d.sum(axis=1), *(d[a] @ d[b] for a in range(3) for b in range(a, 3))]
    assert np.allclose(out[:LOW, 0], wanted, rtol=1e-13, atol=1e-13)
    heights = points[2, inside]
    assert out[LOW, 0] == heights.min(initial=np.inf) and out[HIGH, 0] == heights.max(initial=-np.inf)


WORK = """
import hashlib, numpy as np
from pdal_stages.features import compute_features
xyz = np.random.default_rng(0).uniform(0, 12, (2000, 3)) * [1, 1, 0.2]
table = compute_features(xyz, neighborhoods="c2,s2,k10,k20", feature_set="covariance,geometric")
print(hashlib.sha256(table.values.tobytes()).hexdigest())
"""


@pytest.mark.slow
def test_shorter_registers_give_the_same_bits(tmp_path):
    def said(**more):
        env = {**os.environ, **more}
        done = subprocess.run(
            [sys.executable, "-c", WORK], env=env, text=True, capture_output=True, check=True
        )
        return done.stdout

    if os.uname().machine != "x86_64":
        pytest.skip("the names are of x86 processors")
    shorter = said(NUMBA_CPU_NAME="haswell", NUMBA_CPU_FEATURES="+avx2,+fma", NUMBA_CACHE_DIR=str(tmp_path))
    assert shorter == said()
