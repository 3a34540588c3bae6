"""Outlines, ``writers.objects`` and ``pdal-stages objects``: files as GDAL reads them back."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing

import laspy
import numpy as np
import pytest

import pdal_stages as ps
from pdal_stages import Cells, cli
from pdal_stages.base.errors import StageError
from pdal_stages.objects.outlines import raw_outlines, straight_outlines
from pdal_stages.pipeline.run import Pipeline
from pdal_stages.synthetic import write_town

shapely = pytest.importorskip("shapely")
pytest.importorskip("shapely.affinity")
pyogrio = pytest.importorskip("pyogrio")
pyproj = pytest.importorskip("pyproj")
LAYERS = ("buildings", "trees", "crowns", "spans", "decks")


def layer(path, name=None):
    """Columns and shapes of a layer as GDAL reads it, and its description."""
    about, _, geometry, fields = pyogrio.raw.read(path, layer=name)
    return dict(zip(about["fields"], fields, strict=True)), shapely.from_wkb(geometry), about


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    town = ps.make_town(100.0, 8.0, seed=4, progress=False)
    write_town(town, folder / "town.laz")
    las = laspy.read(folder / "town.laz")
    (folder / "parts").mkdir()
    for number in range(4):
        inside = (las.x >= 500_050) == number % 2
        inside &= (las.y >= 5_400_050) == number // 2
        las[inside].write(folder / "parts" / f"{number}.laz")
    return folder


@pytest.mark.parametrize("angle", [0.0, 0.7])
def test_walls_are_straight(angle):
    true = shapely.affinity.rotate(shapely.box(5, 5, 45, 25), angle, (0, 0), use_radians=True)
    grid = [shapely.box(x, y, x + 1, y + 1) for x in range(-60, 80) for y in range(-20, 90)]
    cells = shapely.union_all([cell for cell in grid if true.contains(cell.centroid)])
    (outline,) = straight_outlines([cells])
    assert outline.is_valid and len(outline.exterior.coords) == 5
    assert outline.symmetric_difference(true).area < 0.05 * true.area


def test_holes_stay_and_small_ones_close():
    from pdal_stages import find_objects
    from pdal_stages.objects.cells import Kind

    x, y = (v.ravel() for v in np.meshgrid(np.arange(0, 40, 0.25), np.arange(0, 40, 0.25)))
    court = (np.abs(x - 20) < 5) & (np.abs(y - 20) < 5)
    chimney = (np.abs(x - 8) < 0.8) & (np.abs(y - 8) < 0.8)
    roof = (x > 4) & (x < 36) & (y > 4) & (y < 36) & ~court & ~chimney
    objects = find_objects(
        Cells.from_points(
            x, y, np.where(roof, 6.0, 0.0), np.where(roof, 6, 2).astype(np.uint8), 0.5
        ),
        progress=False,
    )
    raw = raw_outlines(objects.tables[Kind.BUILDING], 0.5)
    for (shape,) in (raw, straight_outlines(raw)):
        assert shape.is_valid and len(shape.interiors) == 1
        assert shapely.Polygon(shape.interiors[0]).area * 0.25 == pytest.approx(100, rel=0.15)


@pytest.mark.pdal
def test_one_file_or_four_give_the_same(folder, capsys):
    assert cli.main(["objects", str(folder / "town.laz"), str(folder / "one.gpkg")]) == 0
    assert (
        cli.main(["objects", str(folder / "parts"), str(folder / "four.gpkg"), "--workers", "2"])
        == 0
    )
    assert "buildings, " in capsys.readouterr().out
    assert not list(folder.glob(".*"))
    for name in LAYERS:
        info, shapes, about = layer(folder / "one.gpkg", name)
        four, others, _ = layer(folder / "four.gpkg", name)
        assert about["crs"] == "EPSG:25832" and list(info) == list(four)
        for column in info:
            np.testing.assert_array_equal(info[column], four[column])
        assert all(shapely.equals_exact(shapes, others)) and shapely.is_valid(shapes).all()
        assert len(set(info["object_id"].tolist())) == len(shapes)
    buildings, shapes, _ = layer(folder / "one.gpkg", "buildings")
    assert len(shapes) > 8 and (buildings["h_ridge"] >= buildings["h_eave"]).all()
    overlap = shapely.area(shapes).sum() - shapely.union_all(shapes).area
    assert overlap < 1e-2 * len(shapes)
    with closing(sqlite3.connect(folder / "one.gpkg")) as base:
        table = "layer_styles ORDER BY update_time"  # as QGIS asks
        styled = base.execute(f"SELECT f_table_name, styleQML FROM {table}").fetchall()
    assert [name for name, _ in styled] == list(LAYERS) and all(
        "verdict" in text for _, text in styled
    )


@pytest.mark.pdal
def test_other_formats_hold_the_same(folder, tmp_path, ending="shp"):
    target = tmp_path / f"town.{ending}"
    job = [str(folder / "town.laz"), {"type": "writers.objects", "filename": str(target)}]
    Pipeline(job).execute(arrays=False)
    Pipeline([job[0], {**job[1], "filename": str(tmp_path / "town.gpkg")}]).execute(arrays=False)
    info, shapes, about = layer(tmp_path / f"town_buildings.{ending}")
    two, others, _ = layer(tmp_path / "town.gpkg", "buildings")
    order, other = np.argsort(info["object_id"]), np.argsort(two["object_id"])
    np.testing.assert_array_equal(info["object_id"][order], two["object_id"][other])
    np.testing.assert_allclose(info["h_ridge"][order], two["h_ridge"][other], atol=1e-3)
    np.testing.assert_allclose(shapely.area(shapes[order]), shapely.area(others[other]), atol=1e-3)
    assert about["crs"] and (tmp_path / "town_buildings.qml").read_text().startswith(
        "<!DOCTYPE qgis"
    )


@pytest.mark.pdal
@pytest.mark.parametrize("ending", ["gpkg", "geojson", "fgb", "shp"])
def test_layers_without_objects_are_written_without_a_word(tmp_path, write_las, run, ending):
    x, y = (v.ravel() * 0.5 for v in np.meshgrid(np.arange(40.0), np.arange(40.0)))
    arrays = {"X": x, "Y": y, "Z": 0 * x, "Classification": np.full(len(x), 2, np.uint8)}
    source = write_las(tmp_path / "flat.laz", arrays, point_format=6)
    code, _, err = run("objects", source, tmp_path / f"o.{ending}", "--no-progress")
    assert code == 0 and "arning" not in err, err


@pytest.mark.pdal
def test_measures_have_the_unit_of_the_coordinates(folder, tmp_path):
    """A survey in feet: shapes and columns alike; heights may have a unit of their own."""
    las = laspy.read(folder / "town.laz")
    z_unit = 0.5
    feet = laspy.LasHeader(point_format=6, version="1.4")
    feet.scales, feet.offsets = [0.001] * 3, [1_640_000, 17_716_000, 0]
    out = laspy.LasData(feet)
    out.x, out.y, out.z = las.x / 0.3048, las.y / 0.3048, las.z / z_unit
    out.classification = las.classification
    out.write(tmp_path / "feet.laz")
    compound = pyproj.CRS.from_wkt(
        'COMPD_CS["survey",' + pyproj.CRS(2992).to_wkt("WKT1_GDAL") + ',VERT_CS["heights",'
        f'VERT_DATUM["d",2005],UNIT["half meter",{z_unit}],AXIS["Up",UP]]]'
    )
    reader = {"type": "readers.las", "filename": str(tmp_path / "feet.laz")}
    reader["override_srs"] = compound.to_wkt("WKT1_GDAL")
    writer = {"type": "writers.objects", "filename": str(tmp_path / "feet.gpkg"), "cell": 0.5}
    Pipeline([reader, writer]).execute(arrays=False)
    writer["filename"] = str(tmp_path / "meters.gpkg")
    Pipeline([str(folder / "town.laz"), writer]).execute(arrays=False)
    for name in ("buildings", "decks"):
        columns, shapes, _ = layer(tmp_path / "feet.gpkg", name)
        np.testing.assert_allclose(columns["area"], shapely.area(shapes), rtol=0.01)
    for name, column, unit in (
        ("buildings", "h_ridge", z_unit),
        ("buildings", "ground", z_unit),
        ("buildings", "area", 0.3048**2),
        ("trees", "height", z_unit),
        ("trees", "diam", 0.3048),
        ("spans", "length", 0.3048),
        ("spans", "z_high", z_unit),
    ):
        here, there = (layer(tmp_path / f"{kind}.gpkg", name)[0] for kind in ("feet", "meters"))
        ours, theirs = np.median(here[column]) * unit, np.median(there[column])
        assert ours == pytest.approx(theirs, rel=0.1), (name, column)


@pytest.mark.pdal
def test_settings_and_metadata(folder, tmp_path):
    def run(*more):
        files = [
            str(folder / "town.laz"),
            str(tmp_path / "t.gpkg"),
            "--metadata",
            str(tmp_path / "m.json"),
        ]
        assert cli.main(["objects", *files, *more]) == 0
        return json.loads((tmp_path / "m.json").read_text())

    plain, two = run(), run("--writers.objects.tree_height=9", "--cell", "1", "--outlines", "cells")
    assert two["settings"]["tree_height"] == 9 and two["settings"]["cell"] == 1
    assert two["objects"]["trees"]["objects"] < plain["objects"]["trees"]["objects"]


@pytest.mark.pdal
def test_larger_cells_where_points_are_few(folder, tmp_path, capsys):
    las = laspy.read(folder / "town.laz")
    las.points = las.points[np.arange(0, len(las.points), 8)]
    las.write(tmp_path / "thin.laz")

    def run(*words):
        files = [str(tmp_path / name) for name in ("thin.laz", "t.gpkg", "m.json")]
        assert cli.main(["objects", *files[:2], "--metadata", files[2], *words]) == 0
        size = json.loads((tmp_path / "m.json").read_text())["settings"]["cell"]
        return size, capsys.readouterr().err

    size, message = run()
    assert size in (1, 2) and f"cells of {size:g} m are used" in message
    size, message = run("--filters.objects.cell=0.5")
    assert size == 0.5 and "cells of 0.5 m are used, others with --cell" in message
    stage = ps.Pipeline([str(tmp_path / "thin.laz"), {"type": "filters.objects"}])
    stage.execute()
    assert "set cell to" in " ".join(map(str, stage.messages))


@pytest.mark.pdal
def test_layers_are_written_all_or_none_and_nothing_older_is_left(folder, tmp_path, capsys):
    target, names = tmp_path / "t.geojson", [f"t_{name}.geojson" for name in LAYERS]
    old = tmp_path / "t_decks.geojson"
    without = {"type": "filters.range", "limits": "Classification![17:17]"}
    job = [
        str(folder / "parts" / "0.laz"),
        without,
        {"type": "writers.objects", "filename": str(target)},
    ]
    stage = Pipeline(job).expanded.ours[0].stage
    assert [output.path for output in stage.outputs()] == [str(tmp_path / name) for name in names]
    old.write_text('{"type": "FeatureCollection", "features": []}')
    Pipeline(job).execute(arrays=False)
    assert not capsys.readouterr().err
    assert {path.name for path in tmp_path.glob("*.geojson")} == set(names)
    assert len(layer(old)[1]) == 0  # there are none here
    kept = {
        path: path.read_bytes() for path in tmp_path.iterdir() if path.name != "t_spans.geojson"
    }
    later = tmp_path / "t_spans.geojson"
    later.unlink()
    later.mkdir()
    with pytest.raises(StageError, match="names a folder"):
        Pipeline(job).execute(arrays=False)
    assert {path: path.read_bytes() for path in kept} == kept


def cloud(path, xyz, codes, epsg=25832):
    pyproj = pytest.importorskip("pyproj")
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = [1e-7, 1e-7, 0.01] if epsg == 4326 else [0.01] * 3
    header.offsets = np.floor(xyz.min(axis=0))
    header.add_crs(pyproj.CRS(epsg))
    las = laspy.LasData(header)
    las.xyz = xyz
    las.classification = codes
    las.write(path)


@pytest.mark.pdal
@pytest.mark.parametrize(
    ("codes", "epsg", "text"),
    [
        ((2, 5, 6), 4326, "degrees"),
        ((0,), 25832, "no point has a class"),
        ((6,), 25832, "there is no ground"),
        ((2,), 25832, ""),
        ((2, 2, 2, 2, 2, 2, 2, 2, 2, 5, 6, 14, 17), 25832, ""),
    ],
)
def test_bad_clouds_give_an_error_or_a_whole_file(tmp_path, codes, epsg, text, capsys):
    """Degrees, no classes, one class only, objects of one point each."""
    rng = np.random.default_rng(1)
    xyz = rng.uniform(0, 1, (400, 3)) * ([1e-3, 1e-3, 10] if epsg == 4326 else [400, 400, 10])
    xyz += [8, 50, 0] if epsg == 4326 else [500_000, 5_400_000, 0]
    cloud(tmp_path / "in.laz", xyz, rng.choice(codes, 400).astype(np.uint8), epsg)
    target = tmp_path / "out.gpkg"
    code = cli.main(["objects", str(tmp_path / "in.laz"), str(target)])
    errors = capsys.readouterr().err
    assert not list(tmp_path.glob(".out*"))
    if text:
        assert code == 1 and text in errors and not target.exists()
    else:
        assert code == 0
        assert all(not len(layer(target, name)[1]) for name in ("buildings", "trees", "decks"))


@pytest.mark.data
def test_delft_covers_official_outlines(tmp_path, run, data_dir):
    """Houses stand wall to wall there, so they are covered rather than found one by one."""
    assert run("objects", f"{data_dir}/delft/train.laz", tmp_path / "delft.gpkg")[0] == 0
    official = layer(f"{data_dir}/delft/buildings_train.geojson")[1]
    found = shapely.union_all(layer(tmp_path / "delft.gpkg", "buildings")[1])
    covered = shapely.area(shapely.intersection(official, found)) / shapely.area(official)
    assert np.mean(covered >= 0.8) >= 0.96
    whole = shapely.union_all(official)
    assert whole.intersection(found).area >= 0.96 * whole.area
