"""The minima terrain against a brute-force reference, and what must always hold."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdal_stages.base.errors import OptionError, StageError
from pdal_stages.terrain.minima import hag_minima


def slow_hag(x, y, z, cell, resolution):
    """[W18 3.2] word by word, with dictionaries and loops."""
    minima: dict[tuple[int, int], float] = {}
    for a, b, c in zip(x, y, z, strict=True):
        key = (math.floor(a / cell), math.floor(b / cell))
        minima[key] = min(minima.get(key, math.inf), c)

    def value(i, j):
        if (i, j) in minima:
            return minima[i, j]
        distances = {k: math.hypot(k[0] - i, k[1] - j) for k in minima}
        reach = min(distances.values()) + 1.5
        near = {k: 1.0 / d**4 for k, d in distances.items() if d <= reach}
        return sum(minima[k] * w for k, w in near.items()) / sum(near.values())

    out = []
    for a, b, c in zip(x, y, z, strict=True):
        u = (math.floor(a / resolution) + 0.5) * resolution / cell - 0.5
        v = (math.floor(b / resolution) + 0.5) * resolution / cell - 0.5
        i, j = math.floor(u), math.floor(v)
        s, t = u - i, v - j
        ground = (
            value(i, j) * (1 - s) * (1 - t)
            + value(i + 1, j) * s * (1 - t)
            + value(i, j + 1) * (1 - s) * t
            + value(i + 1, j + 1) * s * t
        )
        out.append(c - ground)
    return np.array(out)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("offset", [0.0, -35.0, 6_276_000.0])
def test_equals_the_slow_reference(seed, offset):
    rng = np.random.default_rng(seed)
    n = 300
    x, y = rng.uniform(0, 130, (2, n)) + offset
    z = rng.normal(40, 10, n) + 0.1 * (x - offset)
    got = hag_minima(x, y, z, cell=20, resolution=0.5)
    assert np.allclose(got, slow_hag(x, y, z, 20.0, 0.5), atol=1e-9 * max(1, abs(offset) / 1e4))


def test_gaps_are_filled_and_counted():
    x, z, figures = [1.0, 201.0, 100.0, 55.0], [0.0, 10.0, 50.0, 0.0], {}
    forms = [True, True, True, False]
    height = hag_minima(x, np.zeros(4), z, mask=forms, figures=figures)
    assert -50.0 < height[3] < 0.0
    assert figures["interpolated_cells"] > 0 and figures["farthest_fill"] >= 20.0


def test_not_finite_coordinates_stay_apart():
    height = hag_minima([1.0, np.nan, 2.0], [1.0, 1.0, np.inf], [3.0, 4.0, 5.0])
    assert height[0] == 0.0
    assert np.isnan(height[1:]).all()


def test_sizes_and_shapes_are_checked():
    with pytest.raises(OptionError, match="'cell' must be a number above 0"):
        hag_minima([0.0], [0.0], [0.0], cell=0)
    with pytest.raises(OptionError, match="'resolution' must not be larger"):
        hag_minima([0.0], [0.0], [0.0], cell=1, resolution=2)
    with pytest.raises(StageError, match="one length"):
        hag_minima([0.0, 1.0], [0.0], [0.0])
    with pytest.raises(StageError, match="too large for the grid"):
        hag_minima([1e300], [0.0], [0.0])
    with pytest.raises(StageError, match="no terrain"):
        hag_minima([1.0], [1.0], [1.0], mask=[False])
    assert hag_minima([], [], []).size == 0


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 200), st.integers(-50, 50))
def test_order_and_whole_cell_shifts_change_nothing(seed, n, cells):
    rng = np.random.default_rng(seed)
    # Quarter meters are exact in binary, so a shift by whole cells is exact too.
    x, y, z = rng.integers(0, 800, (3, n)) / 4.0
    height = hag_minima(x, y, z)
    order = rng.permutation(n)
    assert np.array_equal(hag_minima(x[order], y[order], z[order]), height[order])
    assert np.allclose(hag_minima(x + 20.0 * cells, y - 20.0 * cells, z + 3.0), height, atol=1e-9)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_tile_with_its_halo_gives_the_same_bits(seed):
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, 400, (2, 4000))
    z = rng.normal(0, 3, 4000)
    whole = hag_minima(x, y, z)
    core = (x >= 150) & (x < 250) & (y >= 150) & (y < 250)
    near = (x >= 70) & (x < 330) & (y >= 70) & (y < 330)
    assert np.array_equal(hag_minima(x[near], y[near], z[near])[core[near]], whole[core])


def test_features_page_tells_of_cells_without_points():
    """[W18 3.2] does not speak of them; a cloud without gaps needs some all around its edge."""
    random = np.random.default_rng(0)
    x, y, z = random.uniform(0, 100, (3, 5000))
    figures = {}
    hag_minima(x, y, z, figures=figures)
    assert (figures["cells"], figures["interpolated_cells"]) == (
        25,
        24,
    )  # 7 x 7 corners, 5 x 5 cells
    page = (Path(__file__).parent.parent / "docs" / "features.md").read_text()
    (told,) = [item for item in page.split("\n- ") if "filters.hag_minima" in item]
    assert all(word in told for word in ("1.5 cells", "fourth power", "interpolated_cells"))
