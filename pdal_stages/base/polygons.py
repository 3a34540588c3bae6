"""Points inside the polygons of an OGR file: a map's lakes, roads or bridges laid over a cloud (extra ``vector``)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import OptionError, StageError
from .vector import reading, vector

#: Between a file and a layer of it, as QGIS writes them.
_LAYER = "|layername="
#: Types of layers that may hold polygons.
_POLYGONS = re.compile("Polygon|Surface|^Unknown$|^GeometryCollection$")
#: West, south, east, north.
Box = tuple[float, float, float, float]
#: What surfaces are made of: the class that a polygon changes unless told otherwise.
GROUND = 2


@dataclass(frozen=True)
class Overlay:
    """A file of polygons, the class of points inside, and the classes that it is put in place of (empty: all)."""

    file: str
    layer: str
    code: int
    over: tuple[int, ...]

    @classmethod
    def parse(cls, text: str) -> Overlay:
        """From ``FILE=CODE``, ``FILE=CODE:FROM,FROM`` or ``FILE=CODE:all``; FILE may be ``FILE|layername=NAME``."""
        source, _, codes = text.rpartition("=")
        file, _, layer = source.partition(_LAYER)
        code, told, over = codes.partition(":")
        given = [one.strip() for one in over.split(",")] if told else [str(GROUND)]
        given = [] if given == ["all"] else given
        if not file.strip() or not all(
            c.strip().isdecimal() and int(c) <= 255 for c in [code, *given]
        ):
            raise OptionError(
                "polygons are written FILE=CODE",
                found=text,
                cure="For example lakes.gpkg=9, which makes ground inside water; bridges.gpkg=17:2,6 is for ground and "
                "buildings, 17:all for all classes; a layer is named as in lakes.gpkg|layername=canals=9",
            )
        return cls(file.strip(), layer.strip(), int(code), tuple(map(int, given)))

    def check(self) -> str:
        """The layer that will be read."""
        if "://" not in self.file and not Path(self.file).exists():
            raise StageError(
                "the file of polygons does not exist", where=self.file, cure="Check the path"
            )
        with reading(self.file) as name:
            listed = vector("pyogrio").list_layers(name)
        layers = [str(name) for name, kind in listed if _POLYGONS.search(str(kind))]
        layer = self.layer or (layers[0] if len(layers) == 1 else "")
        if layer not in layers:
            raise StageError(
                "the file has no such layer of polygons"
                if self.layer
                else "the file must have one layer of polygons",
                where=self.file,
                found=", ".join(layers) or "none",
                cure=f"Name one: {self.file}{_LAYER}NAME={self.code}",
            )
        return layer


def inside_of(
    overlay: Overlay, wkt: str, x: NDArray[np.float64], y: NDArray[np.float64], box: Box
) -> tuple[NDArray[np.bool_], int, str]:
    """Which points (n,) lie inside an overlay's polygons near a box, how many these are, and what the user should know."""
    shapes, note = polygons_of(overlay, wkt, box)
    return points_inside(x, y, shapes), len(shapes), note


def polygons_of(overlay: Overlay, wkt: str, box: Box, where: str = "") -> tuple[list[Any], str]:
    """Polygons near a box, in the reference system of `wkt`, as the box is; and what the user should know.

    `where`: a condition on the file's columns, in SQL.
    """
    pyogrio, shapely = vector("pyogrio"), vector("shapely")
    layer = overlay.check()
    note, forward = "", None
    with reading(overlay.file) as name:
        crs = pyogrio.read_info(name, layer=layer)["crs"]
    if crs and wkt:
        forward, box = _transform(overlay.file, crs, wkt, box)
    else:
        note = f"{overlay.file}: {'the points have' if crs else 'it has'} no reference system: the same was assumed"
    with reading(overlay.file) as name:
        _, _, geometry, _ = pyogrio.raw.read(
            name, layer=layer, columns=[], bbox=box, where=where or None
        )
        shapes = shapely.force_2d(shapely.get_parts(shapely.get_parts(shapely.from_wkb(geometry))))
        shapes = shapes[shapely.get_type_id(shapes) == shapely.GeometryType.POLYGON]
        if forward is not None:
            shapes = shapely.transform(shapes, forward, interleaved=False)
        return list(shapely.make_valid(shapes)), note


def _transform(file: str, crs: str, wkt: str, box: Box) -> tuple[Any, Any]:
    """How to get from the file's reference system to the points', and their box in the file's; None where they are one."""
    pyproj = vector("pyproj")
    try:
        mine, theirs = (_flat(pyproj.CRS.from_user_input(one)) for one in (wkt, crs))
        if mine.equals(theirs, ignore_axis_order=True):
            return None, box
        forward = pyproj.Transformer.from_crs(theirs, mine, always_xy=True)
        west, south, east, north = forward.transform_bounds(*box, direction="INVERSE")
    except Exception as error:  # pyproj's own
        raise StageError(
            "the polygons' reference system cannot be made the points'",
            where=file,
            found=str(error),
            cure="Reproject the file first: ogr2ogr -t_srs",
        ) from None
    aside = 0.01 * max(east - west, north - south)
    return lambda x, y: forward.transform(x, y), (
        west - aside,
        south - aside,
        east + aside,
        north + aside,
    )


def _flat(crs: Any) -> Any:
    """The horizontal part of a reference system."""
    return (
        _flat(crs.sub_crs_list[0])
        if crs.is_compound
        else crs.to_2d()
        if len(crs.axis_info) > 2
        else crs
    )


def points_inside(
    x: NDArray[np.float64], y: NDArray[np.float64], polygons: list[Any]
) -> NDArray[np.bool_]:
    """Which points (n,) lie inside polygons, or on their edge."""
    shapely, inside = vector("shapely"), np.zeros(len(x), bool)
    whole = shapely.union_all(polygons)
    west, south, east, north = whole.bounds
    near = (x >= west) & (x <= east) & (y >= south) & (y <= north)
    shapely.prepare(whole)
    inside[near] = shapely.intersects_xy(whole, x[near], y[near])
    return inside
