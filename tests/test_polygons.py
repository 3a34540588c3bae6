"""Polygons of a map over the points: parsing, reprojection, layers, tiles, and the command."""

from __future__ import annotations

import os
from pathlib import Path

import laspy
import numpy as np
import pytest

import pdal_stages as ps
from pdal_stages.base.errors import OptionError, StageError
from pdal_stages.base.vector import Overlay, points_inside
from pdal_stages.stages.base import WHOLE_CLOUD, StageContext
from pdal_stages.stages.polygons import Polygons
from pdal_stages.synthetic import write_town

pyogrio, shapely, pyproj = (pytest.importorskip(name) for name in ("pyogrio", "shapely", "pyproj"))
RD = 28992
LAKE = shapely.Polygon(
    [(85010, 446010), (85050, 446000), (85080, 446060), (85020, 446070)],
    [[(85030, 446030), (85050, 446030), (85050, 446045), (85030, 446045)]],
)
ISLET = shapely.box(85035, 446035, 85040, 446040)


def write(path, shapes, epsg: int | None = RD, layer=None, kind="MultiPolygon", append=False):
    """An OGR file of polygons given in RD New, in another reference system if wanted."""
    shapes = [shapely.MultiPolygon([s]) if s.geom_type == "Polygon" else s for s in shapes]
    if epsg not in (None, RD):
        move = pyproj.Transformer.from_crs(RD, epsg, always_xy=True).transform
        shapes = [
            shapely.transform(shapely.segmentize(s, 5), move, interleaved=False) for s in shapes
        ]
    pyogrio.raw.write(
        str(path), np.array([shapely.to_wkb(s) for s in shapes], object), [np.arange(len(shapes))], ["id"],
        crs=None if epsg is None else f"EPSG:{epsg}", geometry_type=kind, layer=layer, append=append,
    )  # fmt: skip
    return str(path)


def cloud(n=6000, seed=0):
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, 100, (2, n)).round(2)
    x, y = x + 85000, y + 446000
    codes = rng.choice([2, 5, 6, 7, 12], n, p=[0.6, 0.2, 0.1, 0.05, 0.05]).astype(np.uint8)
    return {"X": x, "Y": y, "Z": np.zeros(n), "Classification": codes}


def inside(arrays, *shapes):
    points = shapely.points(arrays["X"], arrays["Y"])
    return np.any([shapely.intersects(shape, points) for shape in shapes], axis=0)


def run(polygons, arrays, epsg=RD, **more):
    stage = Polygons({"polygons": polygons, **more})
    points = stage.points(arrays, wkt=pyproj.CRS(epsg).to_wkt("WKT1_GDAL") if epsg else "")
    return stage.run(points, WHOLE_CLOUD)["Classification"], points.report


def test_what_is_written_for_a_file_and_a_class():
    assert Overlay.parse("a=b/lakes.gpkg=9") == Overlay("a=b/lakes.gpkg", "", 9, (2,))
    assert Overlay.parse("b.gpkg|layername=deck 1=17: 2, 6") == Overlay(
        "b.gpkg", "deck 1", 17, (2, 6)
    )
    assert Overlay.parse("C:\\maps\\r.shp=11:all") == Overlay("C:\\maps\\r.shp", "", 11, ())
    for text in [
        "lakes.gpkg",
        "=9",
        "l.gpkg=",
        "l.gpkg=256",
        "l.gpkg=²",
        "l.gpkg=9:",
        "l.gpkg=9:x",
        "l=-1",
    ]:
        with pytest.raises(OptionError, match="polygons are written FILE=CODE"):
            Overlay.parse(text)


@pytest.mark.filterwarnings("ignore:'crs' was not provided")
@pytest.mark.parametrize(
    ("suffix", "epsg"), [("gpkg", RD), ("gpkg", None), ("geojson", 4326), ("shp", 25831)]
)
def test_ground_inside_becomes_the_class_and_nothing_else(tmp_path, suffix, epsg):
    arrays = cloud()
    path = write(tmp_path / f"lakes.{suffix}", [LAKE, ISLET], epsg)
    classes, report = run([f"{path}=9"], arrays)
    codes = arrays["Classification"]
    want = np.where(inside(arrays, LAKE, ISLET) & (codes == 2), 9, codes)
    edge = shapely.distance(
        shapely.union_all([LAKE.boundary, ISLET.boundary]), shapely.points(arrays["X"], arrays["Y"])
    )
    certain = edge > (0.0 if epsg in (RD, None) else 0.01)
    assert np.array_equal(classes[certain], want[certain]) and (want == 9).sum() > 300
    assert report.figures["polygons"] == {
        f"{path}=9": {"polygons": 2, "points": int((classes == 9).sum())}
    }
    assert bool(report.notes) == (epsg is None)


def test_other_classes_and_several_files_in_their_order(tmp_path):
    arrays = cloud()
    lake, islet = write(tmp_path / "a.gpkg", [LAKE]), write(tmp_path / "b.gpkg", [ISLET])
    codes, at = arrays["Classification"], inside(arrays, LAKE)
    classes, _ = run([f"{lake}=17:5,6"], arrays)
    assert np.array_equal(classes, np.where(at & np.isin(codes, (5, 6)), 17, codes))
    classes, _ = run([f"{lake}=40:all", f"{islet}=41:2,40"], arrays, ignore="", keep="")
    want = np.where(at, 40, codes)
    assert np.array_equal(
        classes, np.where(inside(arrays, ISLET) & np.isin(want, (2, 40)), 41, want)
    )
    classes, _ = run([f"{lake}=40:all"], arrays)
    assert np.array_equal(classes == 40, at & ~np.isin(codes, (7, 12)))
    classes, _ = run([f"{lake}=9"], arrays, where="X > 85040")
    assert np.array_equal(classes == 9, at & (codes == 2) & (arrays["X"] > 85040))


def test_layers_of_a_file(tmp_path):
    path = write(tmp_path / "map.gpkg", [LAKE], layer="lakes")
    write(path, [ISLET], layer="islets", append=True)
    arrays = cloud()
    with pytest.raises(StageError, match=r"must have one layer of polygons.*lakes, islets"):
        run([f"{path}=9"], arrays)
    with pytest.raises(StageError, match=r"no such layer of polygons"):
        run([f"{path}|layername=seas=9"], arrays)
    classes, report = run([f"{path}|layername=islets=9"], arrays)
    assert np.array_equal(classes == 9, inside(arrays, ISLET) & (arrays["Classification"] == 2))
    assert list(report.figures["polygons"]) == [f"{path}|layername=islets=9"]


def test_shapes_of_all_kinds(tmp_path):
    arrays = cloud()
    bow = shapely.Polygon([(85000, 446000), (85020, 446020), (85020, 446000), (85000, 446020)])
    solid = shapely.force_3d(shapely.MultiPolygon([shapely.box(85060, 446070, 85090, 446090)]), 3.0)
    parts = [shapely.Point(85001, 446099), shapely.box(85000, 446080, 85020, 446099)]
    mixed = shapely.GeometryCollection(parts)
    shapes = [bow, solid, mixed]
    path = tmp_path / "kinds.gpkg"
    pyogrio.raw.write(
        str(path), np.array([*map(shapely.to_wkb, shapes), None], object), [np.arange(4)], ["id"],
        crs=f"EPSG:{RD}", geometry_type="Unknown",
    )  # fmt: skip
    classes, _ = run([f"{path}=9"], arrays)
    shapes = [shapely.make_valid(bow), shapely.force_2d(solid), mixed.geoms[1]]
    assert np.array_equal(classes == 9, inside(arrays, *shapes) & (arrays["Classification"] == 2))
    _, report = run([f"{write(tmp_path / 'far.gpkg', [shapely.box(0, 0, 1, 1)])}=9"], arrays)
    assert not next(iter(report.figures["polygons"].values()))["points"]


@pytest.mark.parametrize("name", ["a!b.gpkg", "a;b.gpkg", "\udce9.gpkg"])
def test_names_that_pyogrio_takes_for_others(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    Path(name).touch()
    with pytest.raises(StageError, match="without '!' and ';'"):
        Polygons({"polygons": [f"{name}=9"]})


def test_points_on_an_edge_are_inside():
    x, y = np.array([0.0, 1, 0.5, 1.0000001]), np.array([0.0, 1, 0, 0.5])
    assert points_inside(x, y, [shapely.box(0, 0, 1, 1)]).tolist() == [True, True, True, False]
    assert not points_inside(x, y, []).any() and not len(points_inside(x[:0], y[:0], [LAKE]))


def test_points_inside_many_thin_polygons():
    """They overlap, some twice, some are empty or have parts; points lie on edges, too."""
    rng = np.random.default_rng(0)
    ends = rng.uniform(0, 100, (400, 2, 2))
    polygons = list(shapely.buffer(shapely.linestrings(ends), 0.2, quad_segs=1))
    polygons += [*polygons[:5], shapely.Polygon(), shapely.box(20, 20, 30, 30)]
    x, y = np.append(rng.uniform(-5, 105, (2, 3000)), [[20, 25, 20], [25, 30, 20]], axis=1)
    expected = inside({"X": x, "Y": y}, shapely.union_all(polygons))
    assert np.array_equal(points_inside(x, y, polygons), expected)
    assert 0.3 < expected.mean() < 0.9 and expected[-3:].all()
    assert not points_inside(x, y, []).any()


def test_commas_may_be_split_or_joined():
    """Stock PDAL splits the items of a list at commas."""
    one, two = "a b,c.gpkg=9:2,6", "d=e.gpkg|layername=x=17:all"
    parsed = [Overlay("a b,c.gpkg", "", 9, (2, 6)), Overlay("d=e.gpkg", "x", 17, ())]
    for texts in ([one, two], [f"{one},{two}"], f"{one},{two}".split(",")):
        assert Overlay.parse_all(texts) == parsed


def test_what_is_wrong_is_said_before_any_work(tmp_path):
    with pytest.raises(StageError, match="the file of polygons does not exist"):
        Polygons({"polygons": [f"{tmp_path}/none.gpkg=9"]})
    lines = tmp_path / "lines.gpkg"
    wkb = np.array([shapely.to_wkb(LAKE.exterior)], object)
    pyogrio.raw.write(
        str(lines), wkb, [np.arange(1)], ["id"], crs="EPSG:28992", geometry_type="LineString"
    )
    with pytest.raises(StageError, match="must have one layer of polygons"):
        Polygons({"polygons": [f"{lines}=9"]})
    path = write(tmp_path / "a.gpkg", [LAKE])
    stage = Polygons({"polygons": [f"{path}=9", f"{path}=65:9"]})
    assert (
        max(stage.written_classes()) == 65
        and stage.inputs() == [path, path]
        and stage.halo_m() == 0
    )


@pytest.mark.pdal
def test_in_tiles_as_in_one_piece(tmp_path, write_las, run_job):
    """Polygons that lie elsewhere are told once of all tiles; a map is no output."""
    path, out = write(tmp_path / "lakes.gpkg", [LAKE]), tmp_path / "out.las"
    elsewhere = write(tmp_path / "elsewhere.gpkg", [shapely.box(1000, 1000, 1010, 1010)])
    source = write_las(tmp_path / "in.las", cloud(), point_format=1)
    lay = {"type": "filters.polygons", "polygons": [f"{path}=9", f"{elsewhere}=9:all"]}
    results = []
    for words in ([], ["--tile", "30", "--workers", "0", "--no-progress"]):
        code, _, err = run_job([source, lay, out], *words)
        results.append(np.asarray(laspy.read(out).classification))
        lines = [line for line in err.splitlines() if "no polygon lies where" in line]
        assert code == 0 and len(lines) == 1 and "elsewhere.gpkg" in lines[0]
    assert np.array_equal(*results) and (results[0] == 9).sum() > 300
    with pytest.raises(StageError):
        ps.Pipeline([str(source), lay, {"type": "writers.las", "filename": path}]).execute()


def test_damaged_files_are_errors_of_ours(tmp_path):
    """A file may be damaged after the check."""
    path = write(tmp_path / "lake.gpkg", [LAKE])
    stage = Polygons({"polygons": [f"{path}=9"]})
    points = stage.points(cloud(), wkt=pyproj.CRS(RD).to_wkt("WKT1_GDAL"))
    Path(path).write_bytes(b"no GeoPackage any more")
    with pytest.raises(StageError, match=r"lake.gpkg: GDAL knows no format"):
        stage.run(points, WHOLE_CLOUD)


def test_a_file_that_is_no_map_is_named_for_what_it_is(tmp_path):
    (tmp_path / "lake.gpkg").write_bytes(b"")
    write_town(ps.make_town(20.0, 2.0, seed=1, progress=False), tmp_path / "town.laz")
    nothing = "an empty file or a device"
    files = {"/dev/null": nothing, tmp_path / "lake.gpkg": nothing, tmp_path / "town.laz": "LAS"}
    for path, kind in files.items():
        with pytest.raises(StageError, match=f"GDAL knows no format .*{kind}.*Give a GeoPackage"):
            Polygons({"polygons": [f"{path}=9"]})


def test_points_inside_are_counted_in_the_tile_alone(tmp_path):
    arrays = cloud()
    path = write(tmp_path / "lakes.gpkg", [LAKE, ISLET])
    stage = Polygons({"polygons": [f"{path}=9"]})
    own = arrays["X"] < 85045
    tile = arrays | {"Outside": np.where(own, -1.0, 1.0)}
    context = StageContext(outside="Outside", used_m=5.0)
    points = stage.points(tile, context, wkt=pyproj.CRS(RD).to_wkt("WKT1_GDAL"))
    codes = stage.run(points, context)["Classification"]
    changed = codes != arrays["Classification"]
    assert (changed & ~own).any()
    assert points.report.figures["inside"] == np.count_nonzero(changed & own)
    assert points.report.counts == {Polygons.inside: points.report.figures["inside"]}


@pytest.mark.pdal
def test_a_map_of_the_same_size_and_time_is_noticed_at_resume(tmp_path, write_las):
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(40.0), np.arange(40.0)))
    arrays = {"X": x, "Y": y, "Z": 0 * x, "Classification": np.full(len(x), 2, np.uint8)}
    wkt = pyproj.CRS(RD).to_wkt("WKT1_GDAL")
    source = write_las(tmp_path / "in.las", arrays, point_format=6, wkt=wkt)
    out, lake = tmp_path / "out.las", tmp_path / "lake.shp"
    stages = [str(source), {"type": "filters.polygons", "polygons": [f"{lake}=9"]}, str(out)]
    for west in (11.5, 21.5):
        write(lake, [shapely.box(west, 11.5, west + 9, 19.5)])
        os.utime(lake, ns=(10**18, 10**18))
        assert not ps.run_tiled(stages, 20.0, resume=True, workers=0).failures
        water = np.asarray(laspy.read(out).classification) == 9
        assert np.array_equal(water, (abs(x - west - 4.5) < 4.5) & (y > 11.5) & (y < 19.5))
