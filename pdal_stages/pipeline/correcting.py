"""What is behind ``corrections``: what a person changed, or looked at and found right, marked in the points."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.asprs import LEGACY_LIMIT
from ..base.errors import OptionError, StageError
from ..base.files import whole_files
from ..base.outputs import Output, check_outputs
from ..base.units import Units
from ..classifier.dimensions import CHECKED
from ..objects.outlines import vector
from ..objects.overlay import Overlay, points_inside, polygons_of
from ..review.matching import near_any, nearest_points, partners
from .parts import las_chunks, reads_in_parts, reference_and_wkt

#: Points without a partner beyond this share: the files are of other points.
_MOST_LOST = 0.1
#: Names of the columns of a table of points.
_NAMES = {
    "x": ("x", "east", "easting", "e"),
    "y": ("y", "north", "northing", "n"),
    "z": ("z", "height", "elevation", "h"),
    "class": ("class", "classification", "code", "asprs"),
}
_VECTORS = (".gpkg", ".geojson", ".fgb", ".shp")
_TABLES = (".csv", ".txt")
#: The layer of ``review``, and its column of what was looked at.
_PATCHES, _DONE = "patches", "done"


@dataclass(frozen=True)
class CorrectionRequest:
    """What was corrected, and where the marked points go.

    Attributes
    ----------
    before : str
        The file as it was classified.
    after : str
        The same points as a person left them, or a table of points with true classes; empty for neither.
    output : str
    areas : tuple of str
        Files of polygons inside of which all was looked at, and what was not changed is right.
    around : float
        Meters around a changed point within which all was looked at.
    within : float
        Meters between a point of a table and the one it is about.
    """

    before: str
    output: str
    after: str = ""
    areas: tuple[str, ...] = ()
    around: float = 1.0
    within: float = 0.5


@dataclass
class Corrections:
    """What was found.

    Attributes
    ----------
    points, changed, checked : int
        All points; those with another class now; those that a person has checked, then or now.
    moves : dict
        (class before, class after) -> points.
    notes : list of str
        What the user should know.
    """

    points: int
    changed: int
    checked: int
    moves: dict[tuple[int, int], int]
    notes: list[str] = field(default_factory=list)

    def lines(self) -> list[str]:
        """As text."""
        share = 100.0 * self.checked / max(self.points, 1)
        out = [f"{self.points:,} points, {self.changed:,} changed, {self.checked:,} checked ({share:.2f} %)"]
        out += [
            f"  {a} became {b}{n:>14,}" for (a, b), n in sorted(self.moves.items(), key=lambda one: -one[1])
        ]
        return out + self.notes


def write_corrections(request: CorrectionRequest) -> Corrections:
    """Mark what was checked, and write the points of `before` with the classes of `after`.

    All else stays as it is in `before`, whatever the program of the person dropped.

    Raises
    ------
    StageError
        If a file cannot be read, or the two do not hold the same points.
    """
    if not request.after and not request.areas:
        raise OptionError(
            "there is nothing to mark: neither corrected points nor an area that was looked at",
            cure="Give the corrected file as the second, or --area patches.gpkg",
        )
    for name in filter(None, (request.before, "" if _is_table(request.after) else request.after)):
        if not reads_in_parts(name):
            raise StageError("corrections are read from LAS and LAZ files", found=name)
    if request.output.lower().endswith(".copc.laz"):
        raise OptionError("corrections are written as LAS or LAZ", found=request.output, cure="Name it .laz")
    outputs = [Output(request.output, "output")]
    check_outputs(outputs, [one for one in (request.before, request.after, *request.areas) if one])
    reference, wkt = reference_and_wkt(request.before)
    units = reference.units
    las = _read(request.before)
    xyz = np.column_stack([las.x, las.y, las.z])
    codes = np.asarray(las.classification).astype(np.uint8)
    notes: list[str] = []
    new = codes.copy()
    named = np.zeros(len(codes), bool)
    if request.after and _is_table(request.after):
        named = _from_table(request, xyz, units, wkt, new, notes)
    elif request.after:
        _from_points(request, las, xyz, new, notes)
    changed = new != codes
    meters = xyz * [units.horizontal, units.horizontal, units.vertical]
    # A point of a table says nothing of its neighbors.
    checked = named if named.any() else near_any(meters, changed, request.around)
    for area in request.areas:
        checked |= _inside(area, xyz, wkt, notes)
    if CHECKED in las.point_format.extra_dimension_names:
        checked |= np.asarray(las[CHECKED]) > 0
    elif _holds(las, CHECKED):
        raise StageError(f"'{CHECKED}' is a dimension of another kind", where=request.before)
    if not checked.any():
        raise StageError(
            "nothing was changed, and no point lies in an area that was looked at",
            found=", ".join(filter(None, (request.after, *request.areas))),
        )
    _write(request, las, new, checked)
    pairs, number = np.unique(np.stack([codes[changed], new[changed]], axis=1), axis=0, return_counts=True)
    moves = {(int(a), int(b)): int(n) for (a, b), n in zip(pairs, number, strict=True)}
    return Corrections(len(codes), int(changed.sum()), int(checked.sum()), moves, notes)


def _read(path: str) -> Any:
    """A whole file, as laspy holds it; a COPC file as the LAZ file that it is."""
    import laspy

    with laspy.open(path) as reader:
        header = reader.header
    header.vlrs[:] = [one for one in header.vlrs if one.user_id != "copc"]
    if header.evlrs:
        header.evlrs[:] = [one for one in header.evlrs if one.user_id != "copc"]
    records = list(las_chunks(path))
    out = laspy.LasData(header)
    if records:
        joined = np.concatenate([one.array for one in records])
        out.points = laspy.ScaleAwarePointRecord(joined, header.point_format, header.scales, header.offsets)
    return out


def _holds(las: Any, name: str) -> bool:
    return name in las.point_format.dimension_names


def _is_table(name: str) -> bool:
    return Path(name).suffix.lower() in (*_TABLES, *_VECTORS)


def _from_points(
    request: CorrectionRequest, las: Any, xyz: NDArray[np.float64], new: NDArray[np.uint8], notes: list[str]
) -> None:
    """Take over the classes of the same points in another file."""
    other = _read(request.after)
    theirs = np.column_stack([other.x, other.y, other.z])
    step = float(max(*las.header.scales, *other.header.scales))
    named = [
        n for n in ("gps_time", "return_number", "number_of_returns") if _holds(las, n) and _holds(other, n)
    ]
    more = [(np.asarray(las[n]), np.asarray(other[n])) for n in (*named, "classification")]
    found = partners(xyz, theirs, step, more, apart=3.0 * step)
    lost, extra = int((found < 0).sum()), len(theirs) - int((found >= 0).sum())
    if lost > _MOST_LOST * len(xyz) or extra > _MOST_LOST * len(xyz):
        raise StageError(
            "the two files do not hold the same points",
            found=f"{lost:,} of {len(xyz):,} points of {request.before} are not in {request.after}, and "
            f"{extra:,} of its {len(theirs):,} not in the former",
            cure="Save all points from the program they were corrected in, in the same reference system",
        )
    if lost:
        notes.append(f"{lost:,} points are missing in {request.after}: they keep their class, unchecked")
    if extra:
        notes.append(f"{extra:,} points of {request.after} are in no place of {request.before}: left out")
    there = found >= 0
    new[there] = np.asarray(other.classification).astype(np.uint8)[found[there]]


def _from_table(
    request: CorrectionRequest,
    xyz: NDArray[np.float64],
    units: Units,
    wkt: str,
    new: NDArray[np.uint8],
    notes: list[str],
) -> NDArray[np.bool_]:
    """Give the points nearest to those of a table their classes; which points these are."""
    places, given = read_table(request.after, wkt)
    if not len(places):
        raise StageError("the table holds no points", where=request.after)
    scale = [units.horizontal, units.horizontal, units.vertical]
    at = nearest_points(xyz * scale, places * scale, request.within)
    named = np.zeros(len(xyz), bool)
    there = at >= 0
    new[at[there]] = given[there]
    named[at[there]] = True
    if not there.any():
        raise StageError(
            f"no point of the cloud lies within {request.within:g} m of one of the table",
            where=request.after,
            found=f"{len(places):,} points, the first at {places[0, 0]:g}, {places[0, 1]:g}, {places[0, 2]:g}",
            cure="Check its reference system and heights, or give a larger --within",
        )
    if not there.all():
        notes.append(
            f"{int((~there).sum()):,} of {len(places):,} points of the table have no point within {request.within:g} m"
        )
    return named


def read_table(path: str, wkt: str = "") -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Coordinates (n, 3) and classes (n,) of a CSV file or a layer of points.

    Columns are x, y, z and class, or what people call them. A layer's geometry gives what no column does, in the reference
    system of `wkt` where both have one.

    Raises
    ------
    StageError
        If a column is missing, or a value is not a number.
    """
    if not Path(path).exists():
        raise StageError("there is no such file", found=path)
    columns = _of_layer(path, wkt) if Path(path).suffix.lower() in _VECTORS else _of_csv(path)
    found = {}
    for name, words in _NAMES.items():
        found[name] = next((columns[word] for word in words if word in columns), None)
    missing = [name for name, values in found.items() if values is None]
    if missing:
        raise StageError(
            "the table lacks a column",
            where=path,
            found=f"no {', no '.join(missing)}; there are {', '.join(list(columns)[:20])}",
            cure="Name the columns x, y, z, class in the first line",
        )
    try:
        numbers = np.column_stack([np.asarray(found[name], np.float64) for name in _NAMES])
    except (TypeError, ValueError) as error:
        raise StageError("the table has a value that is not a number", where=path, found=str(error)) from None
    codes = numbers[:, 3]
    good = np.isfinite(numbers).all(axis=1) & (codes >= 0) & (codes <= 255) & (codes == np.floor(codes))
    if not good.all():
        row = int(np.flatnonzero(~good)[0])
        raise StageError(
            "a row of the table is not a point with a class code",
            where=path,
            found=f"row {row + 1}: {', '.join(f'{v:g}' for v in numbers[row])}",
        )
    return numbers[:, :3], codes.astype(np.uint8)


def _of_csv(path: str) -> dict[str, list[str]]:
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            head = file.read(4096)
            file.seek(0)
            mark = next((c for c in (";", "\t", ",") if c in head.partition("\n")[0]), ",")
            rows = [row for row in csv.reader(file, delimiter=mark) if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise StageError("the table cannot be read", where=path, found=str(error)) from None
    if not rows:
        return {}
    names = [name.strip().lower() for name in rows[0]]
    short = next((k for k, row in enumerate(rows[1:], 2) if len(row) != len(names)), None)
    if short is not None:
        raise StageError(
            "a line of the table has another number of values", where=path, found=f"line {short}"
        )
    columns = zip(*rows[1:], strict=True) if rows[1:] else [()] * len(names)
    return {name: list(values) for name, values in zip(names, columns, strict=True)}


def _of_layer(path: str, wkt: str) -> dict[str, Any]:
    pyogrio, shapely = vector("pyogrio"), vector("shapely")
    try:
        about, _, geometry, values = pyogrio.raw.read(path)
    except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError) as error:
        raise StageError("the table cannot be read", where=path, found=str(error)) from None
    columns = {str(n).lower(): v for n, v in zip(about["fields"], values, strict=True)}
    shapes = shapely.from_wkb(geometry) if len(geometry) else np.empty(0, object)
    if len(shapes) and (shapely.get_type_id(shapes) == 0).all():
        place = shapely.get_coordinates(shapes, include_z=True)
        crs = str(about["crs"] or "")
        if crs and wkt:
            pyproj = vector("pyproj")
            move = pyproj.Transformer.from_crs(
                pyproj.CRS(crs).to_2d(), pyproj.CRS(wkt).to_2d(), always_xy=True
            )
            place[:, 0], place[:, 1] = move.transform(place[:, 0], place[:, 1])
        for axis, name in enumerate("xyz"):
            if not np.isnan(place[:, axis]).all():
                columns.setdefault(name, place[:, axis])
    return columns


def _inside(area: str, xyz: NDArray[np.float64], wkt: str, notes: list[str]) -> NDArray[np.bool_]:
    """Which points lie in the polygons of a file; of the patches of ``review`` those that were looked at."""
    file, _, layer = area.partition("|layername=")
    done = ""
    if Path(file).exists():
        pyogrio = vector("pyogrio")
        try:
            layers = [str(name) for name, _ in pyogrio.list_layers(file)]
            layer = layer or (_PATCHES if _PATCHES in layers else "")
            about = pyogrio.read_info(file, **({"layer": layer} if layer else {}))
            done = f"{_DONE} = 1" if _DONE in about["fields"] else ""
        except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError) as error:
            raise StageError("the polygons cannot be read", where=file, found=str(error)) from None
    x, y = xyz[:, 0], xyz[:, 1]
    box = float(x.min()), float(y.min()), float(x.max()), float(y.max())
    shapes, note = polygons_of(Overlay(file, layer, 0, ()), wkt, box, where=done)
    if done and not shapes:
        raise StageError(
            "no patch is marked as looked at",
            where=area,
            cure=f"Set '{_DONE}' to 1 where all that is wrong was corrected, e.g. in the table of attributes of QGIS",
        )
    if not shapes:
        raise StageError(
            "no polygon of the area lies over the points",
            where=area,
            found=note or "none in the box of the points",
            cure="Check its reference system; GeoJSON without one is in degrees",
        )
    inside = points_inside(x, y, shapes)
    notes += [note] if note else []
    notes.append(
        f"{int(inside.sum()):,} points lie in the {len(shapes):,} polygons of {file} that were looked at"
    )
    return inside


def _write(
    request: CorrectionRequest, las: Any, codes: NDArray[np.uint8], checked: NDArray[np.bool_]
) -> None:
    import laspy

    if las.header.point_format.id < 6 and codes.max() > LEGACY_LIMIT:
        raise StageError(
            f"classes above {LEGACY_LIMIT} do not fit the file, which is of LAS 1.0-1.3",
            where=request.before,
            found=f"class {int(codes.max())}",
            cure="Convert it to LAS 1.4 first (minor_version 4, dataformat_id 6)",
        )
    if CHECKED not in las.point_format.extra_dimension_names:
        las.add_extra_dim(laspy.ExtraBytesParams(CHECKED, "uint8", "1: a person has checked it"))
    las.classification = codes
    las[CHECKED] = checked.astype(np.uint8)
    with whole_files(request.output) as (part,):
        las.write(str(part))


def request_of(
    before: str, after: str | None, output: str, areas: Sequence[str], around: float, within: float
) -> CorrectionRequest:
    """What the command asks for."""
    for name, value in (("--around", around), ("--within", within)):
        if not 0.0 <= value <= 100.0:
            raise OptionError(f"'{name}' must be from 0 to 100 m", found=value)
    return CorrectionRequest(before, output, after or "", tuple(areas), around, within)
