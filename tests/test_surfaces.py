"""Terrain, surface and canopy: exact, unique, the same however a survey is cut."""

from __future__ import annotations

import itertools
from functools import partial
from pathlib import Path

import laspy
import numpy as np
import pytest
from scipy.interpolate import LinearNDInterpolator

from pdal_stages.base.errors import OptionError, StageError
from pdal_stages.cli import main
from pdal_stages.surfaces import make_surfaces, triangulation
from pdal_stages.surfaces.cells import EMPTY, SurfaceOptions, lowest
from pdal_stages.surfaces.make_surfaces import write_surfaces
from pdal_stages.surfaces.rasters import RASTERS, fill
from pdal_stages.surfaces.triangulation import heights_at, triangulate
from pdal_stages.tiling.options import TilingOptions

rasterio = pytest.importorskip("rasterio")
pytest.importorskip("startinpy")
pytestmark = pytest.mark.pdal
X, Y = 500_000.0, 5_400_000.0


# ---- the triangulation ---------------------------------------------------------------------------


def canonical(points):
    points = np.unique(np.asarray(points, np.int64), axis=0)
    return points[np.lexsort((points[:, 1], points[:, 0], points[:, 1] // 7))]


def in_any_order(seed, xy):
    """Triangles as they come when the points are inserted in another order."""
    order = np.random.default_rng(seed).permutation(len(xy))
    return order[original(xy[order])]


original = triangulation._any_triangles
RANDOM = np.random.default_rng(1)
CLOUDS = {
    "grid": list(itertools.product(range(0, 250, 10), range(0, 200, 10))),
    "integers": RANDOM.integers(0, 60, (900, 2)),
    "one circle": [p for p in itertools.product(range(-65, 66), repeat=2) if p[0] ** 2 + p[1] ** 2 == 65**2],
    "far": RANDOM.integers(0, 50, (300, 2)) + np.array([770_000_000, 6_270_000_000]),
}  # fmt: skip


@pytest.mark.parametrize("name", CLOUDS)
def test_triangles_are_exact_and_unique(name, monkeypatch):
    points = canonical(CLOUDS[name])
    triangles = triangulate(points)
    a, b, c = (points[triangles[:, k]] for k in range(3))
    doubled = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    assert (doubled != 0).all()
    for (p, q, r), sign in zip(triangles, np.sign(doubled), strict=True):  # no point in a circle
        away = (points[[p, q, r]][None] - points[:, None]).astype(object)
        assert ((triangulation._in_circle(away)[0] * int(sign)) <= 0).all()
    for seed in range(3):
        monkeypatch.setattr(triangulation, "_any_triangles", partial(in_any_order, seed))
        again = triangulate(points)
        assert set(map(tuple, again)) == set(map(tuple, triangles))


def test_too_few_points_make_no_triangle():
    for points in ([], [(0, 0)], [(0, 0), (5, 5)], [(0, 0), (5, 5), (10, 10)]):
        assert triangulate(np.array(points, np.int64).reshape(-1, 2)).shape == (0, 3)


def everything(points, distance):
    return points


def test_heights_are_those_of_scipy_and_wide_triangles_give_none():
    random = np.random.default_rng(2)
    xy = canonical(random.integers(0, 40_000, (400, 2)))
    points = np.column_stack([xy, random.integers(0, 5000, len(xy))])
    x, y = 1000.0 * np.arange(40) + 500.7, 1000.0 * np.arange(40) + 499.3
    bounds = (0.0, 0.0, 4e4, 4e4)
    found = heights_at((x, y), 1e9, bounds, partial(everything, points))
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    expected = LinearNDInterpolator(xy.astype(float), points[:, 2].astype(float))(grid)
    np.testing.assert_allclose(found, expected, atol=1e-6, rtol=0)
    narrow = heights_at((x, y), 4000.0, bounds, partial(everything, points))
    from scipy.spatial import Delaunay

    network = Delaunay(xy.astype(float))
    a, b, c = (xy[network.simplices[:, k]].astype(float) for k in range(3))
    sides = [np.linalg.norm(p - q, axis=1) for p, q in ((a, b), (b, c), (c, a))]
    area = abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2
    radius = np.prod(sides, axis=0) / (4 * area)
    simplex = network.find_simplex(grid)
    counts = (simplex >= 0) & (radius[simplex] <= 2000.0)
    assert 0.2 < counts.mean() < 0.9
    np.testing.assert_array_equal(np.isfinite(narrow), counts)


def test_the_lowest_of_each_cell():
    random = np.random.default_rng(3)
    points = np.unique(random.integers(0, 9000, (4000, 3)), axis=0)
    kept = lowest(points, 500.0)
    cells = {}
    for x, y, z in points.tolist():
        best = cells.setdefault((x // 500, y // 500), (z, x, y))
        cells[x // 500, y // 500] = min(best, (z, x, y))
    assert {(z, x, y) for x, y, z in kept.tolist()} == set(cells.values())
    np.testing.assert_array_equal(lowest(points[::-1], 500.0), kept)


# ---- cells without points ------------------------------------------------------------------------


def coded(heights, ground):
    known = np.isfinite(heights)
    value = 2 * np.round(np.where(known, heights, 0) * 1000).astype(np.int64) + ~ground
    return np.pad(np.where(known, value, EMPTY), 8, constant_values=EMPTY)


def test_empty_cells():
    heights = np.full((30, 30), 5.0)
    heights[:, 20:] = 9.0  # a roof
    ground = heights < 6
    terrain = np.full((30, 30), 4.5)
    heights[4, 4] = np.nan  # among ground: the terrain
    heights[10, 25] = np.nan  # on the roof: its height
    heights[20:27, 8:15] = np.nan  # wider than fill: its middle stays empty
    inner = (slice(8, -8), slice(8, -8))
    out = fill(coded(heights, ground), terrain, inner, 3.0)
    assert out[4, 4] == 4.5
    assert out[10, 25] == pytest.approx(9.0)
    assert np.isnan(out[23, 9:14]).all() and np.isnan(out[21:26, 11]).all()
    assert (out[20:27, 8] == 4.5).all()  # beside ground: the terrain
    wide = np.full((30, 30), np.nan)
    wide[:, :5] = wide[:, -5:] = 5.0
    out = fill(coded(wide, np.zeros((30, 30), bool)), terrain, inner, 3.0)
    assert np.isnan(out[:, 5:-5]).all()
    raised = fill(coded(heights, ground), terrain + 2, inner, 3.0)
    assert np.nanmin(raised) == 6.5 and np.nanmax(raised) == 9.0


# ---- files ---------------------------------------------------------------------------------------


def write(path, xyz, codes, withheld=None, epsg=25832, scale=0.01, point_format=6):
    header = laspy.LasHeader(version="1.4", point_format=point_format)
    header.scales, header.offsets = [scale] * 3, [0.0, 0.0, 0.0]
    if epsg:
        import pyproj

        header.add_crs(pyproj.CRS.from_user_input(epsg))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = xyz.T
    cloud.classification = codes
    if withheld is not None:
        cloud.withheld = withheld
    cloud.write(str(path))
    return str(path)


@pytest.fixture(scope="module")
def survey():
    """Hilly ground on a grid of whole half meters, so that most circles have four points, with a
    roof, a gap, a wire, trees and noise."""
    random = np.random.default_rng(7)
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(0, 90, 0.5), np.arange(0, 60, 0.5)))
    z = np.round(100 + 4 * np.sin(x / 9) + 0.05 * y + random.normal(0, 0.02, len(x)), 2)
    codes = np.full(len(x), 2, np.uint8)
    roof = (abs(x - 30) < 8) & (abs(y - 20) < 6)
    z[roof], codes[roof] = 112.0, 6
    gone = (np.hypot(x - 65, y - 40) < 15) | ((random.random(len(x)) < 0.3) & ~roof)
    xyz = np.column_stack([x, y, z])[~gone]
    codes = codes[~gone]
    extra = random.random((400, 3)) * [90, 60, 12] + [0, 0, 104]
    more = np.repeat(np.array([5, 14, 18], np.uint8), [200, 100, 100])
    extra[more == 14, 1:] = [50.0, 125.0]
    extra[more == 18, 2] = 400.0
    xyz = np.round(np.concatenate([xyz, extra]), 2) + np.array([X, Y, 0])
    return xyz, np.concatenate([codes, more])


def read(folder):
    out = {}
    for name in RASTERS:
        with rasterio.open(Path(folder) / f"{name}.tif") as file:
            out[name] = file.read(1, masked=True).filled(np.nan)[::-1], file.transform
    return out


def same(a, b):
    for name in RASTERS:
        assert a[name][1] == b[name][1]
        np.testing.assert_array_equal(a[name][0], b[name][0], err_msg=name)


SMALL = SurfaceOptions(resolution=1.0, fill=4.0, max_radius=12.0)


@pytest.fixture(scope="module")
def whole(survey, tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    cloud = write(folder / "cloud.laz", *survey)
    return write_surfaces([cloud], str(folder / "out"), SMALL, progress=False), folder


def test_values(whole, survey):
    result, folder = whole
    xyz, codes = survey
    rasters = read(folder / "out")
    terrain, surface, canopy = (rasters[name][0] for name in RASTERS)
    transform = rasters["terrain"][1]
    west, south = transform.c, transform.f - len(terrain)
    assert (west, south) == (X, Y)
    valid = codes != 18
    column, row = (
        np.floor(xyz[valid, k] - corner).astype(int) for k, corner in ((0, west), (1, south))
    )
    highest = np.full(surface.shape, -np.inf)
    np.maximum.at(highest, (row, column), xyz[valid, 2])
    there = np.isfinite(highest)
    floor = np.where(np.isnan(terrain), -np.inf, terrain)
    np.testing.assert_allclose(surface[there], np.fmax(highest, floor)[there], atol=1e-3)
    assert result["known"]["surface"] == np.isfinite(surface).sum() > there.sum()
    wire = (codes[valid] == 14) & (xyz[valid, 2] == highest[row, column])
    assert np.nanmin(surface[row[wire], column[wire]]) == 125.0
    assert np.nanmax(canopy) < 20.0 and np.nanmin(canopy) == 0.0
    assert (surface >= terrain)[np.isfinite(surface - terrain)].all()
    kept = np.column_stack([np.floor(xyz[:, 0] * 2), np.floor(xyz[:, 1] * 2)])[codes == 2]
    assert len(np.unique(kept, axis=0)) == len(kept)  # every ground point stays: compare with SciPy
    ground = xyz[codes == 2] - [X, Y, 0]
    x, y = np.meshgrid(np.arange(90) + 0.5, np.arange(60) + 0.5)
    expected = LinearNDInterpolator(ground[:, :2], ground[:, 2])(x, y)[
        : len(terrain), : terrain.shape[1]
    ]
    different = np.abs(terrain - expected)
    assert np.nanmedian(different) < 1e-3  # SciPy's diagonals of squares are its own
    assert np.nanmax(different) < 0.15
    assert 112 - 8 > terrain[20, 30] > 95  # under the roof
    assert np.isnan(terrain[40, 65]) and np.isnan(surface[40, 65])  # a gap wider than max_radius


def test_cut_shuffled_tiled(whole, survey, tmp_path):
    _, folder = whole
    expected = read(folder / "out")
    xyz, codes = survey
    order = np.random.default_rng(0).permutation(len(xyz))
    files = []
    for number, part in enumerate(np.array_split(order, 3)):
        files.append(write(tmp_path / f"part{number}.las", xyz[part], codes[part]))
    runs = {
        "tiles": ([str(folder / "cloud.laz")], {"tile": 20.0, "workers": 0}),
        "odd tiles": (files, {"tile": 17.3, "workers": 1}),
        "files": (files[::-1], {}),
        "small": (files[:1] + files[:0:-1], {"tile": 11.0, "workers": 0}),
    }
    for name, (inputs, how) in runs.items():
        write_surfaces(inputs, str(tmp_path / name), SMALL, TilingOptions(**how), progress=False)
        same(read(tmp_path / name), expected)


def test_format(whole):
    _, folder = whole
    for name in RASTERS:
        with rasterio.open(folder / "out" / f"{name}.tif") as file:
            assert file.crs.to_epsg() == 25832 and file.nodata == -9999 and file.units == ("metre",)
            assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
            assert file.profile["compress"] == "deflate" and file.descriptions[0]
    assert not list((folder / "out").glob("*.plain*")) and not list(
        folder.glob("out/.pdal-stages-partial*")
    )


def test_overviews_and_compound_reference_in_feet(tmp_path):
    step = np.arange(0, 1100, 2.0)
    x, y = (axis.ravel() for axis in np.meshgrid(step, step[:20]))
    xyz = np.column_stack([x + 600_000, y + 800_000, 400 + 0.01 * x])
    cloud = write(tmp_path / "feet.laz", xyz, np.full(len(x), 2), epsg="EPSG:2992+6360")
    write_surfaces([cloud], str(tmp_path / "out"), SurfaceOptions(resolution=1.0), progress=False)
    with rasterio.open(tmp_path / "out" / "terrain.tif") as file:
        assert "COMPD_CS" in file.crs.to_wkt() or "COMPOUND" in file.crs.to_wkt().upper()
        assert file.overviews(1) and file.units == ("US survey foot",)
        z = file.read(1, masked=True)
        np.testing.assert_allclose(z[20, 100:105], 400 + 0.01 * (100.5 + np.arange(5)), atol=2e-3)


def test_resume(survey, tmp_path, monkeypatch):
    cloud = write(tmp_path / "cloud.laz", *survey)
    tiles = TilingOptions(tile=30.0, workers=0)

    def fail(*arguments):
        raise StageError("the disk is full")

    with monkeypatch.context() as patch, pytest.raises(StageError, match="the disk is full"):
        patch.setattr(make_surfaces, "write_rasters", fail)
        write_surfaces([cloud], str(tmp_path / "out"), SMALL, tiles, progress=False)
    assert not list((tmp_path / "out").glob("*.tif"))

    def never(*arguments, **options):
        raise AssertionError("computed again")

    with monkeypatch.context() as patch:
        patch.setattr(make_surfaces, "compute_tile", never)
        patch.setattr(make_surfaces, "reduce_points", never)
        again = TilingOptions(workers=0, resume=True)
        write_surfaces([cloud], str(tmp_path / "out"), SMALL, again, progress=False)
    write_surfaces([cloud], str(tmp_path / "new"), SMALL, progress=False)
    same(read(tmp_path / "out"), read(tmp_path / "new"))
    assert not list((tmp_path / "out" / ".pdal-stages" / "kept").glob("*.npz"))


def test_bad_input(survey, tmp_path):
    xyz, codes = survey
    out = tmp_path / "out"

    def refused(match, files, **options):
        with pytest.raises((StageError, OptionError), match=match):
            write_surfaces(files, str(out), SurfaceOptions(**options), progress=False)
        assert not [path for path in out.glob("*.tif") if path.is_file()]
        assert not list(out.glob(".pdal-stages-partial*"))

    no_ground = write(tmp_path / "a.las", xyz, np.where(codes == 2, 1, codes))
    refused("no point is ground", [no_ground])
    degrees = write(tmp_path / "b.las", (xyz - [X, Y, 0]) / 1000, codes, epsg=4326, scale=1e-7)
    refused("geographic", [degrees])
    here = write(tmp_path / "c.las", xyz, codes)
    other = write(tmp_path / "d.las", xyz, codes, epsg=25833)
    refused("different reference systems", [here, other])
    refused("--resolution", [here], resolution=0.0)
    refused("--fill", [here], fill=-1.0)
    empty = write(tmp_path / "e.las", xyz[:0], codes[:0])
    refused("no points", [empty])
    damaged = tmp_path / "f.las"
    damaged.write_bytes(Path(here).read_bytes()[:-5000])
    refused("cannot be read|cut short|shorter", [str(damaged)])
    refused(f"1 of the inputs cannot be read .found {damaged}: the LAS", [here, str(damaged)])
    with pytest.raises(StageError, match="folder of the rasters cannot be created"):
        write_surfaces([here], here, progress=False)
    out.mkdir(exist_ok=True)
    (out / "surface.tif").mkdir()
    refused("names a folder", [here])


def test_a_tile_without_ground_takes_it_from_its_neighbors(tmp_path):
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(0, 60.0), np.arange(0, 20.0)))
    codes = np.where(abs(x - 30) < 10, 6, 2).astype(np.uint8)
    xyz = np.column_stack([x + X, y + Y, np.where(codes == 6, 20.0, 10.0)])
    cloud = write(tmp_path / "cloud.las", xyz, codes)
    for name, how in (("a", {}), ("b", {"tile": 20.0, "workers": 0})):
        write_surfaces(
            [cloud], str(tmp_path / name), SurfaceOptions(), TilingOptions(**how), progress=False
        )
        assert (read(tmp_path / name)["terrain"][0][:-1, :-1] == 10.0).all()
    same(read(tmp_path / "a"), read(tmp_path / "b"))


@pytest.mark.parametrize("tile", [None, 30.0, 1e4])
def test_far_points_that_are_alone_are_left_out_and_named(survey, whole, tmp_path, capsys, tile):
    """Two at one place and one at another, in a file of their own or with the others."""
    xyz, codes = survey
    far = xyz[[0, 0, 0]] + np.array([[90_000, 40_000, 0], [90_000, 40_000, 1], [0, -7_000, 0]])
    both = write(tmp_path / "both.laz", np.vstack([xyz, far]), [*codes, 2, 6, 2])
    tiling = TilingOptions(tile=tile, workers=0)
    result = write_surfaces([both], str(tmp_path / "out"), SMALL, tiling, progress=False)
    same(read(tmp_path / "out"), read(whole[1] / "out"))
    said = capsys.readouterr().err
    assert "3 points left out of rasters" in said and str(both) in said
    assert (
        f"{far[2, 0]:.2f} {far[2, 1]:.2f} of" in said
        or f"{far[0, 0]:.2f} {far[0, 1]:.2f} of" in said
    )
    assert result["width"] < 1000


def test_a_few_points_far_away_make_rasters_wide_and_a_message_says_so(survey, tmp_path, capsys):
    xyz, codes = survey
    far = xyz[:5] + np.array([9_000, 9_000, 0])
    cloud = write(tmp_path / "both.laz", np.vstack([xyz, far]), [*codes, *codes[:5]])
    result = write_surfaces([cloud], str(tmp_path / "out"), SurfaceOptions(), progress=False)
    said = capsys.readouterr().err
    assert "cells have a height: points far from the others" in said and "left out" not in said
    assert f"as near 509000 {np.floor(far[:, 1].min()):.0f} of {cloud}" in said
    assert result["width"] > 9_000


def test_withheld_points_and_flags_of_old_files(tmp_path):
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(0, 20.0, 0.5), np.arange(0, 20.0, 0.5)))
    xyz = np.column_stack([x + X, y + Y, np.full(len(x), 10.0)])
    xyz[::7, 2] = 50.0
    withheld = np.arange(len(x)) % 7 == 0
    cloud = write(tmp_path / "old.las", xyz, np.full(len(x), 2), withheld, point_format=3)
    write_surfaces([cloud], str(tmp_path / "out"), progress=False)
    assert np.nanmax(read(tmp_path / "out")["surface"][0]) == 10.0


def test_the_command(survey, tmp_path, capsys):
    cloud = write(tmp_path / "cloud.laz", *survey)
    assert (
        main(
            [
                "surfaces",
                cloud,
                str(tmp_path / "out"),
                "--fill",
                "4",
                "--max-radius=12",
                "--no-progress",
            ]
        )
        == 0
    )
    shown = capsys.readouterr().out
    assert "terrain.tif: 90 x 60 cells" in shown and shown.count("% known") == 3
    assert main(["surfaces", cloud, str(tmp_path / "out"), "--resolution", "0"]) == 1
    assert "--resolution" in capsys.readouterr().err


@pytest.mark.data
def test_montpellier_in_tiles(data_dir, tmp_path):
    inputs = [str(data_dir / "montpellier" / "*.laz")]
    write_surfaces(inputs, str(tmp_path / "whole"), progress=False)
    tiles = TilingOptions(tile=60.0, workers=0)
    write_surfaces(inputs, str(tmp_path / "tiles"), tiling=tiles, progress=False)
    same(read(tmp_path / "whole"), read(tmp_path / "tiles"))
