"""Write layers of shapes, with styles for QGIS, to vector files (extra ``vector``)."""

from __future__ import annotations

import contextlib
import html
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.errors import StageError
from ..base.files import check_writable, whole_files
from ..base.vector import horizontal_wkt, refuse_odd_name, vector

if TYPE_CHECKING:
    from shapely import Geometry

#: GDAL's drivers by the ending of a file's name.
DRIVERS = {
    ".gpkg": "GPKG",
    ".geojson": "GeoJSON",
    ".fgb": "FlatGeobuf",
    ".shp": "ESRI Shapefile",
}
#: The driver whose files hold all layers; of others each layer is a file.
MANY_LAYERS = "GPKG"


class Layer(NamedTuple):
    """Shapes of one type with their attributes."""

    shapes: list[Geometry]
    kind: str  #: their type, as GDAL names it
    columns: dict[str, NDArray]  #: a value for each shape, by name


def check_target(path: str | Path, layers: Sequence[str]) -> None:
    """Raise StageError for a file that cannot be written with these layers."""
    if Path(path).suffix.lower() not in DRIVERS:
        raise StageError(
            "the output must be a vector file",
            found=str(path),
            cure=f"Give a name that ends in {', '.join(DRIVERS)}",
        )
    refuse_odd_name(str(path))
    vector("pyogrio")
    vector("shapely")
    for name in target_files(path, layers):
        check_writable(name, "vector")


def target_files(path: str | Path, layers: Sequence[str]) -> list[Path]:
    """Return the files to write: one of all layers, or one of each, named after it."""
    target = Path(path)
    if DRIVERS.get(target.suffix.lower(), MANY_LAYERS) == MANY_LAYERS:
        return [target]
    return [target.with_name(f"{target.stem}_{name}{target.suffix}") for name in layers]


def write_layers(
    path: str | Path, layers: dict[str, Layer], wkt: str, styles: Mapping[str, str]
) -> list[Path]:
    """Write layers, all or none, and return the files.

    A GeoPackage holds all layers and their styles; other formats get a file for each layer, named
    after it, with a style beside it. Layers without shapes are written as well, so that no older
    ones remain.

    Parameters
    ----------
    path : str or path
    layers : dict of Layer
        By name.
    wkt : str
        Reference system of the shapes; empty for none.
    styles : mapping
        Styles for QGIS (see :func:`qml`) by layer.
    """
    check_target(path, list(layers))
    driver, files = DRIVERS[Path(path).suffix.lower()], target_files(path, list(layers))
    many_layers = driver == MANY_LAYERS
    style_files = [] if many_layers else [file.with_suffix(".qml") for file in files]
    with whole_files(*files, *style_files, what="vector") as parts:
        for number, (name, layer) in enumerate(layers.items()):
            _write(parts[0 if many_layers else number], name, layer, driver, wkt)
            if not many_layers:
                parts[number + len(files)].write_text(styles[name], encoding="utf-8")
        if many_layers:
            _write_styles(parts[0], styles)
    return files


@contextlib.contextmanager
def _writing() -> Iterator[None]:
    """Leave out GDAL's warnings about what is right here, and report its errors as the file's."""
    errors = vector("pyogrio").errors
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "'crs' was not provided")  # as the points have none
            warnings.filterwarnings("ignore", "Passed SRS uses EPSG")
            # GDAL takes an empty shapefile of lines for one with measures.
            warnings.filterwarnings("ignore", "Measured .M. geometry types")
            yield
    except (errors.DataSourceError, errors.DataLayerError, errors.CRSError) as error:
        what, cure = "the vector file could not be written", "Is there room on the disk?"
        raise StageError(what, found=str(error), cure=cure) from None


def _write(path: Path, name: str, layer: Layer, driver: str, wkt: str) -> None:
    """Write a layer and count its features, since GDAL ignores some failed writes."""
    pyogrio, shapely = vector("pyogrio"), vector("shapely")
    layer_name = name if driver == MANY_LAYERS else None
    with _writing():
        pyogrio.raw.write(
            path,
            shapely.to_wkb(np.array(layer.shapes, object)),
            list(layer.columns.values()),
            list(layer.columns),
            driver=driver,
            geometry_type=layer.kind,
            crs=horizontal_wkt(wkt) or None,
            layer=layer_name,
            **({"VERSION": "1.2"} if layer_name else {}),  # GDAL before 3.7 warns of others
        )
        info = pyogrio.read_info(path, layer=layer_name, force_feature_count=True)
    if info["features"] != len(layer.shapes):
        lost = f"{info['features']:,} of {len(layer.shapes):,} {name}"
        what = "the vector file could not be written completely"
        raise StageError(what, found=lost, cure="Make room on the disk")


#: Symbol, its layer and the name of its color, for each type of geometry.
_SYMBOLS = {
    "Point": ("marker", "SimpleMarker", "color"),
    "LineString Z": ("line", "SimpleLine", "line_color"),
    "MultiPolygon": ("fill", "SimpleFill", "color"),
}


def qml(kind: str, rules: Sequence[tuple[str, str, str]], **options: Any) -> str:
    """Return a style for QGIS.

    Parameters
    ----------
    kind : str
        Type of geometry.
    rules : sequence of (label, condition, color)
    **options
        Options of all symbols, such as ``outline_width``.
    """
    symbol, layer, color = _SYMBOLS[kind]
    listed = symbols = ""
    for n, (label, condition, ink) in enumerate(rules):
        where = html.escape(condition)
        listed += f'<rule key="{{{n}}}" symbol="{n}" label="{label}" filter="{where}"/>'
        values = "".join(
            f'<Option type="QString" name="{k}" value="{v}"/>'
            for k, v in {color: ink, **options}.items()
        )
        symbols += (
            f'<symbol type="{symbol}" name="{n}" alpha="1">'
            f'<layer class="{layer}" enabled="1" pass="0">'
            f'<Option type="Map">{values}</Option></layer></symbol>'
        )
    return (
        "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
        '<qgis version="3.22" styleCategories="Symbology"><renderer-v2 type="RuleRenderer">'
        f'<rules key="{{root}}">{listed}</rules><symbols>{symbols}</symbols></renderer-v2></qgis>\n'
    )


def _write_styles(path: Path, styles: Mapping[str, str]) -> None:
    """Write the table of styles that QGIS looks for in a GeoPackage."""
    names = "f_table_catalog f_table_schema f_table_name f_geometry_column styleName styleQML "
    names += "styleSLD useAsDefault description owner ui update_time"
    rows = [  # QGIS sorts by the last column, and ignores styles without a time
        ("", "", name, "geom", name, qml, "", True, "", "", "", "2020-01-01T00:00:00.000Z")
        for name, qml in styles.items()
    ]
    columns = [
        np.array(values, bool if values[0] is True else object)
        for values in zip(*rows, strict=True)
    ]
    options = {"layer": "layer_styles", "driver": MANY_LAYERS, "FID": "id"}
    with _writing():
        vector("pyogrio").raw.write(path, None, columns, names.split(), **options)
