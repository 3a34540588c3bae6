"""Pictures: valid PNG, the right pixel in the right color, clear errors, any extent."""

from __future__ import annotations

import io
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image
from scipy import ndimage

from pdal_stages.base.asprs import class_color, class_name
from pdal_stages.base.errors import StageError
from pdal_stages.reports import views
from pdal_stages.reports.panels import legend, triptych
from pdal_stages.reports.pictures import fit_text, plain, png, text_width, write_png
from pdal_stages.reports.raster import BACKGROUND, blur, shading
from pdal_stages.reports.views import (
    RIGHT,
    WRONG,
    error_view,
    nice_step,
    ramp,
    section_view,
    top_view,
    window,
)


def has_color(image: np.ndarray, color) -> bool:
    return bool((image.reshape(-1, 3) == np.array(color)).all(axis=1).any())


@pytest.fixture()
def even_light(monkeypatch):
    """No shading: colors come out as they are."""
    monkeypatch.setattr(views, "shading", lambda s: np.ones(s.z.shape))


def block(n=40, step=0.5, origin=(0.0, 0.0)):
    """A full grid of points, n x n."""
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    return origin[0] + (i.ravel() + 0.5) * step, origin[1] + (j.ravel() + 0.5) * step, np.zeros(n * n)


# ---- PNG ---------------------------------------------------------------------------------------------------


def pixels(data: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))


@settings(max_examples=40, deadline=None)
@given(
    st.tuples(st.integers(1, 12), st.integers(1, 12)).flatmap(lambda s: arrays(np.uint8, (*s, 3))),
    st.booleans(),
)
def test_png_holds_the_pixels(rgb, palette):
    assert np.array_equal(pixels(png(rgb, palette)), rgb)  # 144 colors at most, so a palette holds them


def test_a_palette_is_close_and_keeps_rare_colors():
    shades = np.zeros((256, 256, 3), np.uint8)
    shades[..., 0] = np.arange(256)
    shades[..., 1] = np.arange(256)[:, None] // 64
    shades[7, 7] = (0, 0, 255)
    assert np.abs(pixels(png(shades, palette=True)).astype(int) - shades).max() <= 4
    noise = np.random.default_rng(0).integers(0, 256, (300, 200, 3), dtype=np.uint8)
    assert np.abs(pixels(png(noise, palette=True)).astype(int) - noise).max() <= 32


def test_png_file_is_the_bytes_and_appears_whole(tmp_path):
    rgb = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    path = write_png(tmp_path / "a.png", rgb)
    assert path.read_bytes() == png(rgb) == png(rgb[:, ::-1][:, ::-1])
    with pytest.raises(StageError, match="does not exist"):
        write_png(tmp_path / "no" / "a.png", rgb)
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]


def test_two_pictures_written_at_once(tmp_path):
    """They shared one temporary name, so that one of them could be lost or mixed with the other."""
    images = [np.full((300, 300, 3), n, np.uint8) for n in range(8)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda rgb: write_png(tmp_path / "a.png", rgb), images * 8))
    assert any(np.array_equal(pixels((tmp_path / "a.png").read_bytes()), rgb) for rgb in images)
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]


@pytest.mark.parametrize("bad", [np.zeros((4, 4)), np.zeros((4, 4, 3)), np.zeros((0, 4, 3), np.uint8)])
def test_png_refuses_other_arrays(bad):
    with pytest.raises(StageError, match="uint8"):
        png(bad)


# ---- from above --------------------------------------------------------------------------------------------


def test_north_is_up_and_east_is_right(even_light):
    x, y, z = block()
    classes = np.where(y > 10, np.where(x > 10, 5, 6), np.where(x > 10, 9, 2))
    image = top_view(x, y, z, classes, width=200)
    height, width = image.shape[:2]
    assert abs(height - width) <= 2
    for row, column, code in ((10, 10, 6), (10, -10, 5), (-10, 10, 2), (-10, -10, 9)):
        assert tuple(image[row, column]) == class_color(code)


def test_the_highest_point_wins(even_light):
    x, y, z = block()
    low = top_view(np.r_[x, x], np.r_[y, y], np.r_[z + 5, z], np.r_[z + 6, z + 2].astype(int), width=150)
    assert has_color(low, class_color(6)) and not has_color(low, class_color(2))


def test_gaps_close_but_holes_stay(even_light):
    rng = np.random.default_rng(1)
    x, y = rng.uniform(0, 100, (2, 20_000))
    keep = (np.abs(x - 50) > 10) | (np.abs(y - 50) > 10)
    image = top_view(x[keep], y[keep], 0 * x[keep], np.full(keep.sum(), 2), width=600)
    empty = (image == np.array(BACKGROUND)).all(axis=2)
    assert empty[270:330, 270:330].all()
    assert empty[:200].mean() < 0.001


@pytest.mark.parametrize(
    ("extent", "points", "origin"), [(1.0, 50, 0.0), (5e4, 3000, 5e6), (1e-2, 10, 1e3), (30.0, 1, 0)]
)
def test_any_extent_and_density(extent, points, origin):
    rng = np.random.default_rng(2)
    x, y = origin + rng.uniform(0, extent, (2, points))
    image = top_view(x, y, rng.uniform(0, 5, points), rng.integers(0, 20, points), width=300)
    assert image.dtype == np.uint8 and image.shape[2] == 3 and max(image.shape) <= 752


def test_one_stray_point_cannot_exhaust_memory():
    x, y, z = block()
    image = top_view(np.r_[x, 1e9], np.r_[y, -4e9], np.r_[z, 0.0], width=400)
    assert image.shape[0] <= 1001 and image.shape[1] <= 401


def test_points_that_are_not_finite_are_left_out():
    x, y, z = block()
    codes = np.full(x.size, 2)
    clean = top_view(x, y, z, codes, width=120)
    for bad in (np.nan, np.inf, -np.inf):
        dirty = top_view(
            np.r_[x, bad, 1, 1], np.r_[y, 1, bad, 1], np.r_[z, 1, 1, bad], np.r_[codes, 6, 6, 6], width=120
        )
        assert np.array_equal(clean, dirty)


def test_values_take_the_ramp_and_nan_is_gray(even_light):
    x, y, z = block()
    value = np.where(x > 10, 1.0, 0.0)
    value[0] = np.nan
    image = top_view(x, y, z, values=value, width=200, limits=(0, 1))
    assert tuple(image[50, 10]) == tuple(ramp(np.array(0.0), 0, 1))
    assert tuple(image[50, -10]) == tuple(ramp(np.array(1.0), 0, 1))
    assert tuple(image[-1, 0]) == (150, 150, 150)


def test_shading_lights_slopes_that_face_the_sun():
    x, y, _ = block(60)
    ridge = 8.0 - np.abs(x - 15.0)  # runs south to north; its west side faces the sun
    lit = shading(window(x, y, ridge, 300))
    assert lit[100:200, 60:100].mean() > 1.05 * lit[100:200, 200:240].mean()


def test_errors_are_red_even_under_a_roof():
    x, y, z = block()
    truth = np.full(x.size, 2)
    roof = np.full(x.size, 6)
    below = truth.copy()
    below[x < 5] = 5
    wrong = np.r_[below, roof] != np.r_[truth, roof]
    xyz = np.r_[x, x], np.r_[y, y], np.r_[z, z + 8]
    image = error_view(*xyz, wrong, np.zeros_like(wrong), width=200)
    red = (image[..., 0] > 1.8 * image[..., 1].astype(int)).mean(axis=0)
    assert red[5:45].mean() > 0.2 and red[55:].max() == 0.0
    left_out = error_view(x, y, z, np.zeros(x.size, bool), np.ones(x.size, bool), width=100)
    assert not (left_out[..., 0] > 1.5 * left_out[..., 1].astype(int)).any()


# ---- section -----------------------------------------------------------------------------------------------


def test_section_shows_only_its_slice_upright():
    x, y, z = block(80)
    codes = np.where(np.abs(y - 20) < 1, 6, 2)
    z = np.where(x > 20, 10.0, 0.0)
    image = section_view(x, y, z, codes, start=(0, 20), end=(40, 20), thickness=1.0, width=600)
    assert has_color(image, class_color(6)) and not has_color(image, class_color(2))
    where = np.argwhere((image == np.array(class_color(6))).all(axis=2))
    left, right = where[where[:, 1] < 300], where[where[:, 1] > 350]
    assert left[:, 0].min() > right[:, 0].max()  # the eastern half is higher, so further up
    across = section_view(x, y, z, width=600)
    assert across.shape[1] == 600


@pytest.mark.parametrize(
    "bad", [{"start": (0, 0), "end": (0, 0)}, {"thickness": 0}, {"start": (900, 900), "end": (950, 950)}]
)
def test_section_errors(bad):
    with pytest.raises(StageError):
        section_view(*block(), **bad)


# ---- legend, captions, triptych ----------------------------------------------------------------------------


def test_legend_shows_every_class_in_any_width():
    codes = [1, 2, 3, 5, 6, 64, 200]
    heights = []
    for width in (220, 500, 1500):
        band = legend(codes, width)
        heights.append(band.shape[0])
        assert band.shape[1] == width
        for code in codes:
            assert has_color(band, class_color(code)), (width, code)
    assert heights[0] > heights[1] > heights[2]


def test_every_class_name_can_be_drawn():
    for code in range(256):
        name = class_name(code)
        assert plain(name) == name
    assert plain("Größe – 5 m²\n☃") == "Grosse - 5 m2??"
    assert plain(plain("Wände")) == plain("Wände") == "Wande"


def test_text_is_shortened():
    short = fit_text("a rather long caption", 60)
    assert short.endswith("..") and text_width(short) <= 60
    assert fit_text("abc", 200) == "abc" and fit_text("abc", 1) == ""
    assert text_width("") == 0 and text_width("abc") > text_width("ab")


def test_triptych():
    x, y, z = block(60)
    truth = np.where(x > 15, 6, 2)
    predicted = truth.copy()
    predicted[(x > 20) & (y > 20)] = 5
    image = triptych(x, y, z, predicted, truth, width=1200)
    assert image.shape[1] == 1200
    for code in (2, 5, 6):
        assert has_color(image, class_color(code))
    assert has_color(image, RIGHT) and has_color(image, WRONG)
    two = triptych(x, y, z, predicted, width=800)
    assert two.shape[1] == 800 and not has_color(two, WRONG)


@settings(max_examples=15, deadline=None)
@given(st.integers(1, 60), st.floats(0.01, 3e4), st.floats(0.01, 3e4), st.integers(0, 99))
def test_triptych_of_anything(n, wide, tall, seed):
    rng = np.random.default_rng(seed)
    x, y, z = rng.uniform(0, wide, n), rng.uniform(0, tall, n), rng.normal(0, 10, n)
    codes = rng.integers(0, 256, (2, n))
    image = triptych(x, y, z, codes[0], codes[1], width=400)
    assert image.shape[1] == 400 and image.dtype == np.uint8


@pytest.mark.parametrize("step", [0.013, 0.9, 1.0, 17.0, 4999.0])
def test_nice_step(step):
    nice = nice_step(step)
    assert step * 0.99 <= nice < 2.6 * step
    assert f"{nice:e}"[0] in "125"


# ---- errors ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("view", [top_view, section_view])
def test_an_empty_cloud_is_a_clear_error(view):
    with pytest.raises(StageError, match="empty"):
        view(np.zeros(0), np.zeros(0), np.zeros(0))
    with pytest.raises(StageError, match="finite"):
        view(np.full(3, np.nan), np.zeros(3), np.zeros(3))


def test_arrays_that_do_not_fit_are_errors():
    x, y, z = block()
    with pytest.raises(StageError, match="one value per point"):
        top_view(x, y[:-1], z)
    with pytest.raises(StageError, match="one value per point"):
        top_view(x, y, z, np.zeros(3, int))
    with pytest.raises(StageError, match="0 to 255"):
        top_view(x, y, z, np.full(x.size, 300))
    with pytest.raises(StageError, match="0 to 255"):
        top_view(x, y, z, np.full(x.size, 2.5))
    with pytest.raises(StageError, match="not both"):
        top_view(x, y, z, np.zeros(x.size, int), values=z)
    with pytest.raises(StageError, match="width"):
        top_view(x, y, z, width=3)
    with pytest.raises(StageError, match="ramp"):
        ramp(z, 0, 1, "rainbow")


@pytest.mark.parametrize(
    ("shape", "size"), [((60, 90), 2.0), ((200, 131), 9.0), ((97, 300), 25.0), ((3, 50), 12.0)]
)
def test_wide_blur_equals_the_plain_one(shape, size):
    image = ndimage.gaussian_filter(np.random.default_rng(0).normal(0, 50, shape), 3)
    plain = ndimage.gaussian_filter(image, size, mode="nearest")
    assert np.abs(blur(image, size) - plain).max() < 0.12 * np.abs(image).max()
