"""Steps of the ground filter look as far as they say, and no farther; what each made can be kept."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple
from unittest import mock

import laspy
import numpy as np
import pytest
from test_ground_filter import town

import pdal_stages as ps
from pdal_stages import run_tiled
from pdal_stages.base.errors import DependencyError
from pdal_stages.base.grid import GridWindow
from pdal_stages.stages.hag_morphological import HagMorphological
from pdal_stages.terrain import filtered_ground, wide_roofs
from pdal_stages.terrain.cells import HOLE
from pdal_stages.terrain.filter_options import FilterOptions
from pdal_stages.terrain.minimum_grid import GroundPoints
from pdal_stages.terrain.smrf import (
    given_steps,
    ground_filter,
    holes,
    reach_of_given,
    reach_of_points,
)
from pdal_stages.terrain.steps import POINTS, Chain
from pdal_stages.terrain.surface import GroundRaster

OPTIONS = FilterOptions(window=9.0, openings=(5, 9))
#: So that roofs are seen from less far.
SMALL_ROOFS = wide_roofs.WideRoofRules(radius_m=12.0, max_extent_m=24.0, gap_m=2.0)
STEPS = [step.name for step in ground_filter(OPTIONS).steps]
PAIRS = [(step.name, source) for step in ground_filter(OPTIONS).steps for source in step.reach]


def in_cells(x, y, z):
    return GroundPoints.in_cells(x, y, z, np.ones(len(x), bool), OPTIONS.cell)


def before(chain, name, points, window):
    """Return a step, and the raster that it gets of some points."""
    at = [step.name for step in chain.steps].index(name)
    raster = Chain(chain.steps[:at]).run(points, holes(window)) if at else holes(window)
    return chain.steps[at], raster


def shown(step, points, raster):
    made = step.run(points, raster, raster.window)
    return np.where(np.isfinite(step.shows(made)), step.shows(made), np.nan)


# ---- no farther ------------------------------------------------------------------------------------------


class Planes(NamedTuple):
    """A surface whose planes are all given."""

    window: GridWindow
    every: np.ndarray

    def planes(self, rows):
        return self.every[rows]


def every_plane(raster):
    return raster.surface.planes(slice(0, raster.surface.window.height))


def outside(raster, other, away, reach):
    """Return a raster with another one's cells beyond the reach."""
    far = away > reach
    cells = {}
    for name in ("lowest", "place", "ground", "floor"):
        one, two = getattr(raster, name), getattr(other, name)
        cells[name] = np.where(far.reshape(*far.shape, *[1] * (one.ndim - 2)), two, one)
    if raster.surface is not None:
        one, two = (every_plane(each) for each in (raster, other))
        cells["surface"] = Planes(raster.window, np.where(far[..., None], two, one))
    opened = {r: np.where(far, other.opened[r], values) for r, values in raster.opened.items()}
    return replace(raster, opened=opened, **cells)


@pytest.mark.parametrize("given", [False, True])
@pytest.mark.parametrize("seed", range(2))
def test_nothing_beyond_a_steps_reach_changes_what_it_makes(seed, given):
    """Not the points there, nor what steps before it made there."""
    with mock.patch.object(wide_roofs, "RULES", SMALL_ROOFS):
        side, middle = 250, (125, 130)
        rng = np.random.default_rng(seed)
        x, y, z, height = town(seed, side=side, density=1.2)
        chain = given_steps(OPTIONS, height == 0) if given else ground_filter(OPTIONS)
        moved = z + rng.choice([0.0, -9.0, 9.0, 0.6], len(z), p=[0.4, 0.2, 0.2, 0.2])
        window = GridWindow(0, 0, side, side)
        j, i = np.mgrid[:side, :side]
        away = np.maximum(abs(j - middle[1]), abs(i - middle[0]))
        points, others = in_cells(x, y, z), in_cells(x, y, moved)
        looked = 0
        for each in chain.steps:
            step, raster = before(chain, each.name, points, window)
            _, other = before(chain, each.name, others, window)
            want = shown(step, points, raster)[middle[::-1]]
            far = away[points.row, points.column] > step.reach.get(POINTS, -1)
            changed = points._replace(z=np.where(far, moved, z))
            reach = max([0, *(r for name, r in step.reach.items() if name != POINTS)])
            got = shown(step, changed, outside(raster, other, away, reach))[middle[::-1]]
            assert got == want or np.isnan([got, want]).all(), step.name
            assert reach + 10 < side // 2, "something must lie beyond"
            looked += 1
        assert looked == len(chain.steps)


@pytest.mark.parametrize("given", [False, True])
def test_nothing_beyond_a_gap_without_points_changes_what_a_step_makes(given):
    with mock.patch.object(wide_roofs, "RULES", SMALL_ROOFS):
        x, y, z, height = town(3, side=60, density=1.2)
        there = in_cells(np.append(x, x), np.append(y, y), np.append(z, z))
        ground = np.append(height == 0, height == 0)
        chain = given_steps(OPTIONS, ground) if given else ground_filter(OPTIONS)
        for each in chain.steps:
            far, shift = np.repeat([False, True], len(x)), 61 + each.gap
            column = there.column + shift * far
            points = there._replace(x=there.x + shift * far, column=column)
            moved = points.z + far * np.random.default_rng(0).uniform(-9, 9, len(far))
            changed, window = points._replace(z=moved), GridWindow(0, 0, 60 + shift, 60)
            step, raster = before(chain, each.name, points, window)
            _, other = before(chain, each.name, changed, window)
            beyond = np.broadcast_to(np.arange(60 + shift) >= 60, window.shape)
            made = (
                shown(step, points, raster),
                shown(step, changed, outside(raster, other, beyond, 0)),
            )
            assert np.array_equal(*(each[:, :60] for each in made), equal_nan=True), step.name


# ---- as far ----------------------------------------------------------------------------------------------

SIDE = 301
MIDDLE = SIDE // 2


def plane(height=0.0):
    """Return heights of level ground."""
    return np.full((SIDE, SIDE), height, np.float32)


def raster_of(lowest, ground=None, planes=None):
    """Return a raster whose cells are measured in their middle; all that are not holes are ground."""
    place = np.zeros((*lowest.shape, 3))
    place[..., 2] = np.where(lowest < HOLE, lowest, 0.0)
    ground = np.isfinite(lowest) if ground is None else ground
    window = GridWindow(-MIDDLE, -MIDDLE, SIDE, SIDE)
    surface = None if planes is None else Planes(window, planes)
    return GroundRaster(window, lowest, place, ground, lowest, {}, surface)


def lone_ground(away, height):
    """Return a raster whose middle is no ground, and whose only ground is a patch that far away."""
    lowest, ground = np.full((SIDE, SIDE), HOLE), np.zeros((SIDE, SIDE), bool)
    lowest[MIDDLE, MIDDLE] = 0.3
    patch = np.s_[MIDDLE - 2 : MIDDLE + 3, MIDDLE + away : MIDDLE + away + 3]
    lowest[patch], ground[patch] = height, True
    return raster_of(lowest, ground)


def point_in_the_middle(z=0.3):
    return in_cells(np.array([0.5]), np.array([0.5]), np.array([z]))


def points_of(lowest):
    """Return a point in the middle of each cell that is not a hole."""
    j, i = np.nonzero(lowest < HOLE)
    return in_cells(i - MIDDLE + 0.5, j - MIDDLE + 0.5, lowest[j, i].astype(float))


def deep_cell(company):
    """A deep cell, and ground as deep 28 cells away: it is an outlier without that."""
    lowest = plane()
    lowest[MIDDLE, MIDDLE] = -5.0
    if company:
        lowest[:, MIDDLE + 28 :] = -5.0
    return point_in_the_middle(), raster_of(lowest)


def window_that_fits(fits):
    """Cells as wide as the widest window, with the middle at their end."""
    lowest, wide = plane(), 2 * OPTIONS.radius
    lowest[:, MIDDLE : MIDDLE + wide + 1] = 9.0
    if not fits:
        lowest[MIDDLE, MIDDLE + wide] = 0.0
    return point_in_the_middle(), raster_of(lowest)


def roof(length):
    """A roof that begins in the middle: too long for one, or not."""
    lowest = plane()
    lowest[MIDDLE - 10 : MIDDLE + 10, MIDDLE : MIDDLE + length] = 9.0
    return points_of(lowest), raster_of(lowest)


def of_raster(build):
    return lambda value: (point_in_the_middle(), build(value))


def judged(height):
    """A point judged by the planes of a cell beside it."""
    planes = np.zeros((SIDE, SIDE, 3))
    planes[MIDDLE, MIDDLE + 1, 0] = height
    return in_cells(np.array([0.9]), np.array([0.5]), np.array([0.3])), raster_of(
        plane(), planes=planes
    )


#: Step -> what it reads -> how far away what differs, and two clouds that differ there alone.
FAR = {
    "minimum_grid": {POINTS: (0, lambda z: (point_in_the_middle(z), holes(raster_of(plane()).window)), 1.0, 2.0)},
    "low_outliers": {"minimum_grid": (28, deep_cell, False, True)},
    "openings": {"low_outliers": (18, window_that_fits, True, False)},
    "wide_roofs": {POINTS: (20, roof, 20, 30)},
    **{f"round_{k}": {before: (28, of_raster(lambda z: lone_ground(28, z)), 0.0, 9.0)}
       for k, before in enumerate(("wide_roofs", "round_1", "round_2"), 1)},
    "provisional_surface": {"round_3": (28, of_raster(lambda z: lone_ground(28, z)), 0.0, 9.0)},
    "ground_points": {"provisional_surface": (1, judged, 0.0, 9.0),
                      POINTS: (0, lambda z: (point_in_the_middle(z), raster_of(plane(), planes=np.zeros((SIDE, SIDE, 3)))), 0.1, 0.2)},
    "surface": {name: (60, of_raster(lambda z: lone_ground(60, z)), 0.0, 9.0)
                for name in ("round_3", "ground_points")},
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "source"), [pair for pair in PAIRS if pair != ("wide_roofs", "openings")]
)
def test_what_is_within_a_steps_reach_changes_what_it_makes(name, source):
    """What differs lies in the outer part of the reach, and only what the step reads differs."""
    away, build, one, two = FAR[name][source]
    with mock.patch.object(wide_roofs, "RULES", SMALL_ROOFS):
        step = next(step for step in ground_filter(OPTIONS).steps if step.name == name)
        made = [shown(step, *build(value))[MIDDLE, MIDDLE] for value in (one, two)]
        assert made[0] != made[1] and not np.isnan(made).all()
        assert away <= step.reach[source] <= 5 * away


# ---- chains ----------------------------------------------------------------------------------------------


def test_a_chain_adds_up_the_longest_way():
    chain = ground_filter(FilterOptions())
    assert chain.last == "surface" and chain.reach("surface") == 0
    ways = {step.name: step.reach for step in chain.steps}
    assert chain.reach("low_outliers", "openings") == ways["openings"]["low_outliers"]
    rounds = sum(max(ways[f"round_{k}"].values()) for k in (1, 2, 3))
    assert chain.reach("wide_roofs", "round_3") == rounds
    assert chain.reach(last="round_3") == ways["wide_roofs"][POINTS] + rounds
    assert reach_of_points(FilterOptions()) == HagMorphological({}).halo_m() == 842
    assert (
        reach_of_given(FilterOptions()) == HagMorphological({"given_ground": True}).halo_m() == 97
    )


def test_a_part_with_its_surroundings_is_made_as_in_the_whole():
    """Whatever the cells around are, which each step needs fewer of."""
    x, y, z, _ = town(1, side=300, density=1.0)
    chain, points = ground_filter(OPTIONS), in_cells(x, y, z)
    window, wanted = GridWindow(0, 0, 300, 300), GridWindow(140, 150, 20, 12)
    kept = {}
    with mock.patch.object(wide_roofs, "RULES", SMALL_ROOFS):
        whole = chain.run(points, holes(window))
        part = chain.run(
            points, holes(window), wanted, lambda name, *made: kept.update({name: made})
        )
    assert part.window == wanted and list(kept) == STEPS
    want = chain.steps[-1].shows(whole)[wanted.slices_in(window)]
    assert np.array_equal(chain.steps[-1].shows(part), want, equal_nan=True)
    sizes = [made[0].width for made in kept.values()]
    assert sizes == sorted(sizes, reverse=True) and sizes[0] > sizes[-1]


# ---- rasters of steps ------------------------------------------------------------------------------------


def test_filtered_ground_hands_out_what_each_step_made():
    x, y, z, _ = town(2, side=90)
    kept = {}
    filtered_ground(x, y, z, keep=lambda name, *made: kept.update({name: made}), window=9.0)
    assert list(kept) == STEPS
    assert len({window for window, _ in kept.values()}) == 1
    made = {name: values for name, (_, values) in kept.items()}
    measured = np.isfinite(made["minimum_grid"])
    assert (measured & np.isnan(made["low_outliers"])).any()
    assert (made["openings"] < made["low_outliers"]).any()  # objects, and what is below them
    ground = [np.isfinite(made[name]) for name in ("round_1", "round_2", "round_3")]
    assert all((more >= fewer).all() for fewer, more in pairwise(ground))
    assert np.isfinite(made["surface"][measured]).all()


@pytest.mark.pdal
def test_rasters_are_kept_as_geotiff_in_tiles_too(tmp_path, write_las):
    rasterio = pytest.importorskip("rasterio")
    x, y, z, _ = town(2, side=90, origin=(1000.0, 2000.0))
    source = write_las(tmp_path / "in.las", {"X": x, "Y": y, "Z": z})
    heights = {"type": "filters.hag_morphological", "window": 9}
    with laspy.open(source) as reader:
        wkt = reader.header.parse_crs()
    folders = {name: tmp_path / name for name in ("whole", "tiles")}
    whole = {**heights, "keep_rasters": str(folders["whole"])}
    ps.run_pipeline([str(source), whole])
    tiles = {**heights, "keep_rasters": str(folders["tiles"])}
    result = run_tiled([str(source), tiles, str(tmp_path / "o.las")], 40, workers=0, progress=False)
    assert not result.failures
    with rasterio.open(next((folders["whole"] / "minimum_grid").glob("*.tif"))) as raster:
        measured = np.isfinite(raster.read(1))
    for name in STEPS:
        (file,) = (folders["whole"] / name).glob("*.tif")
        with rasterio.open(file) as raster:
            want, corner, crs = raster.read(1), raster.bounds, raster.crs
        assert (corner.left, corner.bottom) == (1000.0, 2000.0) and bool(crs) == bool(wkt)
        filled = np.zeros(want.shape, bool)
        parts = list((folders["tiles"] / name).glob("*.tif"))
        assert len(parts) > 1
        for part in parts:
            with rasterio.open(part) as raster:
                values, bounds = raster.read(1), raster.bounds
            at = np.s_[
                int(corner.top - bounds.top) : int(corner.top - bounds.bottom),
                int(bounds.left - corner.left) : int(bounds.right - corner.left),
            ]
            here = np.isfinite(values)
            assert np.array_equal(values[here], want[at][here]), name
            filled[at] |= here
        assert np.array_equal(filled & measured, np.isfinite(want) & measured), name


def test_without_rasterio_nothing_begins(monkeypatch, tmp_path):
    monkeypatch.setitem(__import__("sys").modules, "rasterio", None)
    with pytest.raises(DependencyError, match=r"rasterio.*raster"):
        HagMorphological({"keep_rasters": str(tmp_path)})
