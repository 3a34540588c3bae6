"""Objects as layers of vector files, through pyogrio (extra ``vector``): whole or not at all."""

from __future__ import annotations

import html
import os
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.asprs import class_color
from ..base.errors import DependencyError, StageError
from ..base.files import check_writable, whole_files
from ..base.units import Units, horizontal_part
from ..base.vector import is_odd, vector
from ..objects.attributes import CHECK
from ..objects.cells import CLASSES, Cells, Kind, refuse_unclassified
from ..objects.detect import find_objects
from ..objects.outlines import crown_outlines, raw_outlines, straight_outlines
from ..objects.results import Objects, ObjectSettings, ObjectTable

#: Ending of a file's name -> GDAL's driver, and whether one file holds many layers.
DRIVERS = {
    ".gpkg": ("GPKG", True),
    ".geojson": ("GeoJSON", False),
    ".fgb": ("FlatGeobuf", False),
    ".shp": ("ESRI Shapefile", False),
}
#: Layers of objects, in this order.
LAYERS = ("buildings", "trees", "crowns", "spans", "decks")
_F, _I, _S = np.float64, np.int64, np.str_
_JUDGED = {"points": _I, "reliab": _F, "verdict": _S, "reason": _S}
#: Columns of each layer, none longer than a shapefile's ten characters.
COLUMNS: dict[Kind, dict[str, type]] = {
    Kind.BUILDING: {
        "area": _F, "h_eave": _F, "h_ridge": _F, "ground": _F, "slope": _F, "planes": _I, "planar": _F, **_JUDGED,
    },
    Kind.TREE: {"height": _F, "area": _F, "diam": _F, "dbh": _F, "ground": _F, **_JUDGED},
    Kind.SPAN: {"length": _F, "h_low": _F, "z_high": _F, "sag": _F, **_JUDGED},
    Kind.DECK: {"area": _F, "z": _F, "clear": _F, "ground": _F, **_JUDGED},
}  # fmt: skip


class Layer(NamedTuple):
    """One layer: geometries (shapely), their type, and a value of each column for each."""

    shapes: list[Any]
    kind: str
    columns: dict[str, NDArray]


def object_layers(
    objects: Objects, *, straight: bool = True, units: Units | None = None
) -> dict[str, Layer]:
    """Layers ``buildings``, ``trees``, ``crowns``, ``spans``, ``decks``.

    Parameters
    ----------
    objects : Objects
    straight : bool
        Outlines of buildings and decks along walls, instead of along cells.
    units : Units, optional
        Of the coordinates; measures are in meters whatever these are.
    """
    shapely = vector("shapely")
    across, up = (units.horizontal, units.vertical) if units else (1.0, 1.0)
    size, tables = objects.settings.cell, objects.tables
    columns = {kind: _columns(table, kind) for kind, table in tables.items()}

    def polygons(shapes: list[Any], kind: Kind) -> Layer:
        """In the coordinates' unit, to a thousandth of it where that leaves them valid."""
        exact = [shapely.transform(shape, lambda xy: xy * (size / across)) for shape in shapes]
        rounded = [shapely.transform(shape, lambda xy: np.round(xy, 3)) for shape in exact]
        placed = [r if r.is_valid else e for e, r in zip(exact, rounded, strict=True)]
        many = [s if s.geom_type == "MultiPolygon" else shapely.MultiPolygon([s]) for s in placed]
        return Layer(many, "MultiPolygon", columns[kind])

    layers = {}
    for kind, name in ((Kind.BUILDING, "buildings"), (Kind.DECK, "decks")):
        shapes = raw_outlines(tables[kind], size)
        shapes = straight_outlines(shapes) if straight else shapes
        columns[kind]["area"] = np.round(np.array([shape.area * size**2 for shape in shapes]), 3)
        layers[name] = polygons(shapes, kind)
    trees = tables[Kind.TREE]
    crowns = raw_outlines(trees, size, hole=1.0)
    layers["crowns"] = polygons(crown_outlines(crowns) if straight else crowns, Kind.TREE)
    x, y = (trees.columns.get(axis, np.empty(0)) / across for axis in "xy")
    layers["trees"] = Layer(list(shapely.points(x, y)), "Point", columns[Kind.TREE])
    lines = [shapely.LineString(path / [across, across, up]) for path in tables[Kind.SPAN].paths]
    layers["spans"] = Layer(lines, "LineString Z", columns[Kind.SPAN])
    return {name: layers[name] for name in LAYERS}


def _columns(table: ObjectTable, kind: Kind) -> dict[str, NDArray]:
    out: dict[str, NDArray] = {"object_id": table.ids}
    for name, of in COLUMNS[kind].items():
        values = table.columns.get(name, np.empty(0, of))
        out[name] = (
            np.round(values.astype(of), 3)
            if of is _F
            else values.astype(object if of is _S else of)
        )
    return out


def object_frames(
    xyz: NDArray,
    classification: NDArray,
    *,
    reliability: NDArray | None = None,
    settings: ObjectSettings | None = None,
    classes: Mapping[Kind, Sequence[int]] = CLASSES,
    straight: bool = True,
    crs: Any = None,
) -> dict[str, Any]:
    """Objects of a cloud as GeoDataFrames (needs geopandas): ``buildings``, ``trees``, ``crowns``, ``spans``, ``decks``.

    Parameters
    ----------
    xyz : (n, 3) float64
        Meters.
    classification : (n,) integers
        ASPRS class codes; points that were withheld or are noise are better left out.
    reliability : (n,) float, optional
        0 to 1.
    settings : ObjectSettings, optional
    classes : mapping of Kind to codes, optional
        Which codes are what.
    straight : bool
        Outlines of buildings and decks along walls, instead of along cells.
    crs : optional
        Reference system, as geopandas takes it: ``"EPSG:25832"``.

    Raises
    ------
    StageError
        Where arrays do not fit each other, no point has a class of any kind, or none is ground.
    """
    try:
        import geopandas
    except ImportError as error:
        raise DependencyError(
            "GeoDataFrames need geopandas",
            found=str(error),
            cure="pip install geopandas; without it find_objects and object_layers give plain geometries",
        ) from None
    xyz, codes = np.asarray(xyz, np.float64), np.asarray(classification)
    told = None if reliability is None else np.asarray(reliability)
    if xyz.shape != (len(codes), 3) or (told is not None and told.shape != codes.shape):
        raise StageError("arrays must have one row per point", found=f"{xyz.shape}, {codes.shape}")
    if codes.size and not (codes.min() >= 0 and codes.max() <= 255):
        raise StageError("class codes are 0 to 255", found=f"{codes.min()} to {codes.max()}")
    if not np.isfinite(xyz).all():
        raise StageError("coordinates must be finite", cure="Leave out rows of NaN or infinity")
    codes, chosen = codes.astype(np.uint8), settings or ObjectSettings()
    x, y, z = xyz.T
    cells = Cells.from_points(x, y, z, codes, chosen.cell, reliability=told, classes=classes)
    refuse_unclassified(cells, codes)
    layers = object_layers(find_objects(cells, chosen, progress=False), straight=straight)
    return {
        name: geopandas.GeoDataFrame(layer.columns, geometry=layer.shapes, crs=crs)
        for name, layer in layers.items()
    }


def check_target(path: str | Path, layers: Sequence[str] = LAYERS) -> None:
    """Refuse a name with another ending, and files that cannot be written; `layers`: their names."""
    if Path(path).suffix.lower() not in DRIVERS:
        raise StageError(
            "the output must be a vector file",
            found=str(path),
            cure=f"Give a name that ends in {', '.join(DRIVERS)}",
        )
    if is_odd(str(path)):
        what = "vector files are written to names in UTF-8, without '!' and ';'"
        raise StageError(what, found=ascii(os.path.abspath(path)), cure="Give another")
    vector("pyogrio")
    vector("shapely")
    for name in target_files(path, layers):
        check_writable(name, "objects")


def target_files(path: str | Path, layers: Sequence[str] = LAYERS) -> list[Path]:
    """The files that are written: one of all layers, or one of each, named after it."""
    target = Path(path)
    if DRIVERS.get(target.suffix.lower(), ("", True))[1]:
        return [target]
    return [target.with_name(f"{target.stem}_{name}{target.suffix}") for name in layers]


def write_layers(
    path: str | Path,
    layers: dict[str, Layer],
    wkt: str = "",
    styles: Mapping[str, str] | None = None,
) -> list[Path]:
    """Write layers, all or none; returns the files.

    A GeoPackage holds all of them, with styles for QGIS; other formats get a file for each layer, named after it, with a
    style beside it. Layers without objects are written as well, so that no older ones remain. `styles` are by
    layer; by default those of objects.
    """
    check_target(path, list(layers))
    driver, many = DRIVERS[Path(path).suffix.lower()]
    files = target_files(path, list(layers))
    if styles is None:
        styles = {name: verdict_style(layer.kind, name) for name, layer in layers.items()}
    beside = [] if many else [file.with_suffix(".qml") for file in files]
    with whole_files(*files, *beside, what="objects") as parts:
        for number, (name, layer) in enumerate(layers.items()):
            _write(parts[0 if many else number], name, layer, driver, wkt)
            if not many:
                parts[number + len(files)].write_text(styles[name], encoding="utf-8")
        if many:
            _write_styles(parts[0], styles)
    return files


def write_objects(
    path: str, objects: Objects, straight: bool, units: Units | None, wkt: str
) -> dict[str, Any]:
    """Write all layers; returns the number of objects of each, and the ``files``."""
    layers = object_layers(objects, straight=straight, units=units)
    files = write_layers(path, layers, wkt)
    return {
        **{name: len(layer.shapes) for name, layer in layers.items()},
        "files": [str(f) for f in files],
    }


def _write(path: Path, name: str, layer: Layer, driver: str, wkt: str) -> None:
    """Write a layer and count its features, since GDAL ignores some failed writes."""
    pyogrio, shapely = vector("pyogrio"), vector("shapely")
    named = name if driver == "GPKG" else None
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "'crs' was not provided")  # as the points have none
            warnings.filterwarnings("ignore", "Passed SRS uses EPSG")
            pyogrio.raw.write(
                path,
                shapely.to_wkb(np.array([*layer.shapes, None], object)[:-1]),
                list(layer.columns.values()),
                list(layer.columns),
                driver=driver,
                geometry_type=layer.kind,
                crs=horizontal_part(wkt) or None,
                layer=named,
                **({"VERSION": "1.2"} if named else {}),  # of which GDAL before 3.7 does not warn
            )
        found = pyogrio.read_info(path, layer=named, force_feature_count=True)["features"]
    except (
        pyogrio.errors.DataSourceError,
        pyogrio.errors.DataLayerError,
        pyogrio.errors.CRSError,
    ) as error:
        what, cure = "the vector file could not be written", "Is there room on the disk?"
        raise StageError(what, found=str(error), cure=cure) from None
    if found != len(layer.shapes):
        lost = f"{found:,} of {len(layer.shapes):,} {name}"
        raise StageError(
            "objects could not be written completely", found=lost, cure="Make room on the disk"
        )


#: Class whose color the sure objects of a layer have, and their opacity; objects to be checked are yellow.
_CLASSES = {
    "buildings": (6, 140),
    "trees": (5, 255),
    "crowns": (5, 90),
    "spans": (14, 255),
    "decks": (17, 140),
}
_TO_CHECK = "255,225,0,200"
#: Symbol, its layer and the name of its color, for each type of geometry.
_SYMBOLS = {
    "Point": ("marker", "SimpleMarker", "color"),
    "LineString Z": ("line", "SimpleLine", "line_color"),
    "MultiPolygon": ("fill", "SimpleFill", "color"),
}


def verdict_style(kind: str, name: str) -> str:
    """A style for QGIS that distinguishes sure objects from those to be checked."""
    code, opacity = _CLASSES[name]
    sure = ",".join(map(str, (*class_color(code), opacity)))
    return qml(
        kind, [("sure", "verdict = 'sure'", sure), ("check", f"verdict = '{CHECK}'", _TO_CHECK)]
    )


def qml(kind: str, rules: Sequence[tuple[str, str, str]], **options: Any) -> str:
    """A style for QGIS from rules (label, condition, color) for a type of geometry; `options` apply to all symbols."""
    symbol, layer, color = _SYMBOLS[kind]
    listed = symbols = ""
    for n, (label, condition, ink) in enumerate(rules):
        listed += (
            f'<rule key="{{{n}}}" symbol="{n}" label="{label}" filter="{html.escape(condition)}"/>'
        )
        values = "".join(
            f'<Option type="QString" name="{k}" value="{v}"/>'
            for k, v in {color: ink, **options}.items()
        )
        symbols += (
            f'<symbol type="{symbol}" name="{n}" alpha="1"><layer class="{layer}" enabled="1" pass="0">'
            f'<Option type="Map">{values}</Option></layer></symbol>'
        )
    return (
        "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
        '<qgis version="3.22" styleCategories="Symbology"><renderer-v2 type="RuleRenderer">'
        f'<rules key="{{root}}">{listed}</rules><symbols>{symbols}</symbols></renderer-v2></qgis>\n'
    )


def _write_styles(path: Path, styles: Mapping[str, str]) -> None:
    """The table of styles that QGIS looks for in a GeoPackage."""
    empty, one = [""] * len(styles), np.ones(len(styles), bool)
    columns = {
        "f_table_catalog": empty, "f_table_schema": empty, "f_table_name": list(styles),
        "f_geometry_column": ["geom"] * len(styles), "styleName": list(styles), "styleQML": list(styles.values()),
        "styleSLD": empty, "useAsDefault": one, "description": empty, "owner": empty, "ui": empty,
        "update_time": ["2020-01-01T00:00:00.000Z"] * len(styles),  # QGIS sorts by it, and else loads no style
    }  # fmt: skip
    vector("pyogrio").raw.write(
        path,
        None,
        [np.array(values, bool if values is one else object) for values in columns.values()],
        list(columns),
        layer="layer_styles",
        driver="GPKG",
        FID="id",
    )
