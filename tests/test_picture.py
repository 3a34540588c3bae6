"""Pictures: the right pixel in the right color, few colors in small files, clear errors, any extent."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdal_stages.base.asprs import class_color
from pdal_stages.base.errors import StageError
from pdal_stages.reports.pictures import (
    BACKGROUND,
    CLASS_COLORS,
    RIGHT,
    WRONG,
    error_colors,
    paint,
    shading,
    surface,
    triptych,
)


def has_color(image: np.ndarray, color) -> bool:
    return bool((image.reshape(-1, 3) == np.array(color)).all(axis=1).any())


def top_view(x, y, z, classes, width):
    """Classes from above, unshaded."""
    s = surface(x, y, z, width)
    return paint(s, CLASS_COLORS[s.per_pixel(classes, 0)], np.ones(s.z.shape))


def block(n=40, step=0.5):
    """A full grid of points, n x n."""
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    return (i.ravel() + 0.5) * step, (j.ravel() + 0.5) * step, np.zeros(n * n)


def test_north_is_up_and_east_is_right():
    x, y, z = block()
    classes = np.where(y > 10, np.where(x > 10, 5, 6), np.where(x > 10, 9, 2))
    image = top_view(x, y, z, classes, width=200)
    assert abs(image.shape[0] - image.shape[1]) <= 2
    for row, column, code in ((10, 10, 6), (10, -10, 5), (-10, 10, 2), (-10, -10, 9)):
        assert tuple(image[row, column]) == class_color(code)


def test_the_highest_point_wins():
    x, y, z = block()
    low = top_view(
        np.r_[x, x], np.r_[y, y], np.r_[z + 5, z], np.r_[z + 6, z + 2].astype(int), width=150
    )
    assert has_color(low, class_color(6)) and not has_color(low, class_color(2))


def test_gaps_close_but_holes_stay():
    rng = np.random.default_rng(1)
    x, y = rng.uniform(0, 100, (2, 20_000))
    keep = (np.abs(x - 50) > 10) | (np.abs(y - 50) > 10)
    image = top_view(x[keep], y[keep], 0 * x[keep], np.full(keep.sum(), 2), width=600)
    empty = (image == np.array(BACKGROUND)).all(axis=2)
    assert empty[270:330, 270:330].all()
    assert empty[:200].mean() < 0.001


@settings(max_examples=8, deadline=None)
@given(
    st.integers(1, 60),
    st.floats(0.01, 3e4),
    st.floats(0.01, 3e4),
    st.integers(0, 99),
    st.sampled_from([0, 5e6]),
)
def test_pictures_of_anything(n, wide, tall, seed, origin):
    rng = np.random.default_rng(seed)
    x, y, z = (
        origin + rng.uniform(0, wide, n),
        origin + rng.uniform(0, tall, n),
        rng.normal(0, 10, n),
    )
    codes = rng.integers(0, 256, (2, n))
    image = triptych(x, y, z, codes[0], codes[1], width=400)
    assert image.shape[1] <= 403 and image.dtype == np.uint8
    assert surface(x, y, z, 100).z.shape[0] <= 252


def test_points_that_are_not_finite_are_left_out():
    x, y, z = block()
    codes = np.full(x.size, 2)
    clean = top_view(x, y, z, codes, width=120)
    for bad in (np.nan, np.inf, -np.inf):
        more = np.r_[x, bad, 1, 1], np.r_[y, 1, bad, 1], np.r_[z, 1, 1, bad]
        assert np.array_equal(clean, top_view(*more, np.r_[codes, 6, 6, 6], width=120))


def test_errors_are_red_even_under_a_roof():
    x, y, z = block()
    wrong = np.r_[x < 5, np.zeros(x.size, bool)]
    xyz = np.r_[x, x], np.r_[y, y], np.r_[z, z + 8]
    s = surface(*xyz, 200)
    image = error_colors(s, *xyz, wrong, np.zeros_like(wrong))
    red = (image == np.array(WRONG)).all(axis=2).mean(axis=0)
    assert red[5:45].mean() > 0.2 and red[55:].max() == 0.0
    assert not has_color(error_colors(s, *xyz, np.zeros_like(wrong), np.ones_like(wrong)), WRONG)


def test_triptych():
    x, y, z = block(60)
    light = shading(surface(x, y, z, 160)).flat[0]  # the same everywhere on level ground
    truth = np.where(x > 15, 6, 2)
    predicted = truth.copy()
    predicted[(x > 20) & (y > 20)] = 5
    image = triptych(x, y, z, predicted, truth, width=500)
    assert abs(image.shape[1] - 500) <= 3
    colors = np.round(np.array([*map(class_color, (2, 5, 6)), RIGHT, WRONG]) * light)
    assert all(has_color(image, color) for color in colors)


def test_what_cannot_be_drawn_is_told():
    x, y, z = block()
    with pytest.raises(StageError, match="finite"):
        surface(x * np.nan, y, z, 100)
    with pytest.raises(StageError, match="width"):
        surface(x, y, z, 3)
