"""Objects as layers of shapes with attributes, and as vector files."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..base.asprs import class_color
from ..base.json_types import JsonObject
from ..base.units import Units
from ..base.vector import vector
from ..objects.attributes import CHECK, SURE
from ..objects.cells import Kind
from ..objects.outlines import RULES as OUTLINE_RULES
from ..objects.outlines import crown_outlines, raw_outlines, straight_outlines
from ..objects.results import Objects, ObjectTable
from .vector_files import Layer, qml, write_layers

if TYPE_CHECKING:
    from ..objects.outlines import Polygonal

#: Layers of objects, in this order.
LAYERS = ("buildings", "trees", "crowns", "spans", "decks")
#: Columns of each kind, none longer than a shapefile's ten characters; `_TYPES` lists texts and
#: whole numbers.
COLUMNS = {
    Kind.BUILDING: "area h_eave h_ridge ground points reliab verdict reason",
    Kind.TREE: "height area diam ground points reliab verdict reason",
    Kind.SPAN: "length h_low z_high sag points reliab verdict reason",
    Kind.DECK: "area z clear ground points reliab verdict reason",
}
#: Columns of measures by the power of the coordinates' horizontal and vertical unit in them.
_POWERS: dict[str, tuple[int, int]] = {
    "area": (2, 0),
    **dict.fromkeys(("diam", "length"), (1, 0)),
    **dict.fromkeys(("h_eave", "h_ridge", "height", "h_low", "z_high", "sag"), (0, 1)),
    **dict.fromkeys(("ground", "z", "clear"), (0, 1)),
}
_TYPES = {"points": np.int64, "verdict": object, "reason": object}
#: Class whose color the sure objects of a layer have, and their opacity of 255.
_COLORS = {
    "buildings": (6, 140),
    "trees": (5, 255),
    "crowns": (5, 90),
    "spans": (14, 255),
    "decks": (17, 140),
}
#: Color (red, green, blue, opacity) of objects to be checked, in all layers.
_CHECK_COLOR = "255,225,0,200"


def object_layers(
    objects: Objects, *, straight: bool = True, units: Units | None = None
) -> dict[str, Layer]:
    """Return the layers ``buildings``, ``trees``, ``crowns``, ``spans``, ``decks``.

    Parameters
    ----------
    objects : Objects
    straight : bool
        Outlines of buildings and decks along walls, instead of along cells.
    units : Units, optional
        Of the coordinates, which shapes and measures are written in; by default meters.
    """
    shapely = vector("shapely")
    size, tables = objects.settings.cell, objects.tables
    units = units or Units()
    horizontal, vertical = units.horizontal, units.vertical
    columns = {kind: _columns(table, kind, units) for kind, table in tables.items()}

    def polygons(shapes: list[Polygonal], kind: Kind) -> Layer:
        """Return shapes in the coordinates' unit, to a thousandth where that keeps them valid."""
        exact = [shapely.transform(shape, lambda xy: xy * (size / horizontal)) for shape in shapes]
        rounded = [shapely.transform(shape, lambda xy: np.round(xy, 3)) for shape in exact]
        placed = [r if r.is_valid else e for e, r in zip(exact, rounded, strict=True)]
        many = [s if s.geom_type == "MultiPolygon" else shapely.MultiPolygon([s]) for s in placed]
        return Layer(many, "MultiPolygon", columns[kind])

    layers = {}
    for kind, name in ((Kind.BUILDING, "buildings"), (Kind.DECK, "decks")):
        shapes = raw_outlines(tables[kind], size)
        shapes = straight_outlines(shapes) if straight else shapes
        areas = np.array([shape.area * size**2 for shape in shapes])
        columns[kind]["area"] = _in_unit("area", areas, units)
        layers[name] = polygons(shapes, kind)
    trees = tables[Kind.TREE]
    crowns = raw_outlines(trees, size, hole=OUTLINE_RULES.min_crown_hole)
    layers["crowns"] = polygons(crown_outlines(crowns) if straight else crowns, Kind.TREE)
    x, y = (trees.columns.get(axis, np.empty(0)) / horizontal for axis in "xy")
    layers["trees"] = Layer(list(shapely.points(x, y)), "Point", columns[Kind.TREE])
    scale = [horizontal, horizontal, vertical]
    lines = [shapely.LineString(path / scale) for path in tables[Kind.SPAN].paths]
    layers["spans"] = Layer(lines, "LineString Z", columns[Kind.SPAN])
    return {name: layers[name] for name in LAYERS}


def _columns(table: ObjectTable, kind: Kind, units: Units) -> dict[str, NDArray]:
    """Return the attributes of a table by name, measures in the unit of the coordinates."""
    out: dict[str, NDArray] = {"object_id": table.ids}
    for name in COLUMNS[kind].split():
        values = table.columns.get(name, np.empty(0)).astype(_TYPES.get(name, np.float64))
        out[name] = _in_unit(name, values, units) if values.dtype == np.float64 else values
    return out


def _in_unit(name: str, values: NDArray[np.float64], units: Units) -> NDArray[np.float64]:
    """Return measures (n,) in meters in the unit of the coordinates, rounded to 3 decimals."""
    across, upward = _POWERS.get(name, (0, 0))
    return np.round(values / (units.horizontal**across * units.vertical**upward), 3)


def write_objects(
    path: str, objects: Objects, straight: bool, units: Units | None, wkt: str
) -> JsonObject:
    """Write all layers; return the number of objects of each, and the ``files``."""
    layers = object_layers(objects, straight=straight, units=units)
    styles = {name: _style(layer.kind, name) for name, layer in layers.items()}
    files = write_layers(path, layers, wkt, styles)
    counts = {name: len(layer.shapes) for name, layer in layers.items()}
    return {**counts, "files": [str(file) for file in files]}


def _style(kind: str, name: str) -> str:
    """Return a style for QGIS that distinguishes sure objects from those to be checked."""
    code, opacity = _COLORS[name]
    sure = ",".join(map(str, (*class_color(code), opacity)))
    check = ("check", f"verdict = '{CHECK}'", _CHECK_COLOR)
    return qml(kind, [("sure", f"verdict = '{SURE}'", sure), check])
