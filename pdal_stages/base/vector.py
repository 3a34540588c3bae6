"""Vector data through shapely, pyogrio and pyproj (extra ``vector``); points inside polygons."""

from __future__ import annotations

import ctypes
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from .asprs import GROUND
from .errors import OptionError, StageError, optional_import
from .files import kind_of
from .processes import PythonProcess

if TYPE_CHECKING:
    from pyproj import CRS
    from shapely import Polygon

_Result = TypeVar("_Result")


def vector(name: str) -> ModuleType:
    """Import shapely, pyogrio or pyproj, or raise DependencyError with the way to install it."""
    return optional_import(name, "vector", "work with vector data")


def refuse_odd_name(path: str) -> None:
    """Refuse a path that pyogrio misreads.

    It takes the part before '!' for an archive, that after ';' for parameters, and reads UTF-8
    only.
    """
    if "://" not in path and re.search("[!\ud800-\udfff]|;[^/]*$", os.path.abspath(path)):
        what = "vector files have names in UTF-8, without '!' and ';'"
        raise StageError(what, found=ascii(os.path.abspath(path)), cure="Give another")


#: How GDAL says that no driver takes a file.
_NO_DRIVER = "not recognized as being in a supported file format"


@contextmanager
def reading(
    path: str,
    what: str = "the vector file cannot be read",
    cure: str = "Check it with ogrinfo -al; ogr2ogr -makevalid new.gpkg FILE often repairs it",
) -> Iterator[str]:
    """Yield the path of a vector file to read; errors of GDAL and GEOS become StageError."""
    refuse_odd_name(path)
    try:
        yield path
    except (StageError, MemoryError):
        raise
    except Exception as error:  # each package has its own
        if _NO_DRIVER in str(error):
            raise StageError(
                "GDAL knows no format of vector data that this file is in",
                where=path,
                found=kind_of(path) or "an empty file or a device",
                cure="Give a GeoPackage, a shapefile, GeoJSON or FlatGeobuf",
            ) from None
        raise StageError(
            what, where=path, found=f"{type(error).__name__}: {error}", cure=cure
        ) from error


def with_vector(function: Callable[..., _Result], *arguments: object) -> _Result:
    """Call a function that uses the extra ``vector``, where necessary in a process of its own.

    On Linux the libraries that a program is linked to come first for everything it loads. Inside
    the program `pdal`, which is linked to GEOS and GDAL, a Python package with other versions of
    them would mix both and crash. Python itself is linked to neither.
    """
    linked = sys.platform.startswith("linux") and any(
        hasattr(ctypes.CDLL(None), name) for name in ("GEOSversion", "GDALVersionInfo")
    )
    if not linked:
        return function(*arguments)
    with PythonProcess() as process:
        return process.call(function, *arguments)


#: Between a file and a layer of it, as QGIS writes them.
_LAYER = "|layername="
#: FILE=CODE, FILE=CODE:FROM,FROM or FILE=CODE:all at the beginning of a list of them.
_OVERLAY = re.compile(r"\s*(.*?=\s*\d+\s*(?::\s*(?:all|\d+\s*(?:,\s*\d+\s*)*))?)(?:,|$)", re.DOTALL)
#: Types of layers that may hold polygons.
_POLYGONS = re.compile("Polygon|Surface|^Unknown$|^GeometryCollection$")
#: West, south, east, north.
Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class Overlay:
    """A file of polygons, the class for points inside, and the classes it replaces (empty: all)."""

    file: str
    layer: str
    code: int
    over: tuple[int, ...]

    @classmethod
    def parse(cls, text: str) -> Overlay:
        """Parse ``FILE=CODE``, ``FILE=CODE:FROM,FROM`` or ``FILE=CODE:all``.

        FILE may be ``FILE|layername=NAME``.
        """
        source, _, codes = text.rpartition("=")
        file, _, layer = source.partition(_LAYER)
        code, colon, over = codes.partition(":")
        replaced = [each.strip() for each in over.split(",")] if colon else [str(GROUND)]
        replaced = [] if replaced == ["all"] else replaced
        if not file.strip() or not all(
            c.strip().isdecimal() and int(c) <= 255 for c in [code, *replaced]
        ):
            raise OptionError(
                "polygons are written FILE=CODE",
                found=text,
                cure="For example lakes.gpkg=9, which makes ground inside water; "
                "bridges.gpkg=17:2,6 is for ground and buildings, 17:all for all classes; a layer "
                "is named as in lakes.gpkg|layername=canals=9",
            )
        return cls(file.strip(), layer.strip(), int(code), tuple(map(int, replaced)))

    @classmethod
    def parse_all(cls, texts: Sequence[str]) -> list[Overlay]:
        """Parse a list that may have been joined or split at any comma, as stock PDAL does."""
        text, overlays = ",".join(texts), []
        while text.strip():
            match = _OVERLAY.match(text)
            overlays.append(cls.parse(match[1] if match else text))
            text = text[match.end() :] if match else ""
        return overlays

    def find_layer(self) -> str:
        """Return the layer to read; StageError where there is not exactly one."""
        if "://" not in self.file and not Path(self.file).exists():
            raise StageError(
                "the file of polygons does not exist", where=self.file, cure="Check the path"
            )
        with reading(self.file) as name:
            listed = vector("pyogrio").list_layers(name)
        layers = [str(name) for name, kind in listed if _POLYGONS.search(str(kind))]
        layer = self.layer or (layers[0] if len(layers) == 1 else "")
        if layer not in layers:
            what = "has no such layer" if self.layer else "must have one layer"
            raise StageError(
                f"the file {what} of polygons",
                where=self.file,
                found=", ".join(layers) or "none",
                cure=f"Name one: {self.file}{_LAYER}NAME={self.code}",
            )
        return layer


def inside_of(
    overlay: Overlay, wkt: str, x: NDArray[np.float64], y: NDArray[np.float64], box: Box
) -> tuple[NDArray[np.bool_], int, str]:
    """Return which points (n,) lie inside polygons, the number of polygons, and a warning."""
    shapes, note = polygons_of(overlay, wkt, box)
    return points_inside(x, y, shapes), len(shapes), note


def polygons_of(overlay: Overlay, wkt: str, box: Box, where: str = "") -> tuple[list[Polygon], str]:
    """Return the polygons near a box, and a warning or an empty text.

    Polygons and box are in the reference system `wkt`. `where` is a condition on the file's
    columns, in SQL.
    """
    pyogrio, shapely = vector("pyogrio"), vector("shapely")
    layer = overlay.find_layer()
    note, forward = "", None
    with reading(overlay.file) as name:
        crs = pyogrio.read_info(name, layer=layer)["crs"]
    if crs and wkt:
        forward, box = _transform(overlay.file, crs, wkt, box)
    else:
        side = "the points have" if crs else "it has"
        note = f"{overlay.file}: {side} no reference system: the same was assumed"
    with reading(overlay.file) as name:
        _, _, geometry, _ = pyogrio.raw.read(
            name, layer=layer, columns=[], bbox=box, where=where or None
        )
        shapes = shapely.force_2d(shapely.get_parts(shapely.get_parts(shapely.from_wkb(geometry))))
        shapes = shapes[shapely.get_type_id(shapes) == shapely.GeometryType.POLYGON]
        if forward is not None:
            shapes = shapely.transform(shapes, forward, interleaved=False)
        return list(shapely.make_valid(shapes)), note


def _transform(file: str, crs: str, wkt: str, box: Box) -> tuple[Callable | None, Box]:
    """Return the transformation from the file's reference system to the points', and the box in it.

    The transformation is None where both are the same.
    """
    pyproj = vector("pyproj")
    try:
        to, theirs = (_horizontal(pyproj.CRS.from_user_input(each)) for each in (wkt, crs))
        if to.equals(theirs, ignore_axis_order=True):
            return None, box
        forward = pyproj.Transformer.from_crs(theirs, to, always_xy=True)
        west, south, east, north = forward.transform_bounds(*box, direction="INVERSE")
    except Exception as error:  # pyproj's own
        what = "the polygons' reference system cannot be made the points'"
        cure = "Reproject the file first: ogr2ogr -t_srs"
        raise StageError(what, where=file, found=str(error), cure=cure) from None
    # The box's edges are curves in the other system, of which pyproj takes 21 points each.
    rim = 0.01 * max(east - west, north - south)
    padded = (west - rim, south - rim, east + rim, north + rim)
    return lambda x, y: forward.transform(x, y), padded


def horizontal_wkt(wkt: str) -> str:
    """Return the horizontal part of a reference system, as well-known text."""
    return _horizontal(vector("pyproj").CRS.from_user_input(wkt)).to_wkt() if wkt else ""


def _horizontal(crs: CRS) -> CRS:
    """Return the horizontal part of a reference system."""
    if crs.is_compound:
        return _horizontal(crs.sub_crs_list[0])
    return crs.to_2d() if len(crs.axis_info) > 2 else crs


def points_inside(
    x: NDArray[np.float64], y: NDArray[np.float64], polygons: list[Polygon]
) -> NDArray[np.bool_]:
    """Return which points (n,) lie inside polygons, or on their edge.

    Each polygon is compared with the points in its box that lie in none before it.
    """
    shapely, inside = vector("shapely"), np.zeros(len(x), bool)
    order = np.argsort(x, kind="stable")
    x, y = x[order], y[order]
    boxes = shapely.bounds(np.array(polygons, object)).reshape(-1, 4)
    first = np.searchsorted(x, boxes[:, 0])
    last = np.searchsorted(x, boxes[:, 2], side="right")
    for number in np.flatnonzero(first < last):  # an empty polygon has no box
        _, south, _, north = boxes[number]
        rows = slice(first[number], last[number])
        near = np.flatnonzero(~inside[rows] & (y[rows] >= south) & (y[rows] <= north))
        if len(near):
            near += rows.start
            shapely.prepare(polygons[number])
            inside[near] = shapely.intersects_xy(polygons[number], x[near], y[near])
    out = np.zeros(len(x), bool)
    out[order] = inside
    return out
