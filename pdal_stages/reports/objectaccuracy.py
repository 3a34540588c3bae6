"""Objects of a vector file held against those of another: table, JSON, a page with a map."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import StageError
from ..objects.compare import compare_buildings, compare_trees
from ..objects.outlines import reading, vector
from .objectmap import draw_map
from .page import render
from .views import embedded

#: What columns of tree heights are called.
HEIGHT_NAMES = ("height", "h", "height_m", "hoehe", "hauteur", "hoogte", "z_height")
#: Layers that hold buildings and trees, in files of more than one.
_LAYERS = {"buildings": "Polygon", "trees": "Point"}
#: Fill and edge of what is in the reference and was found, what was missed, what was found there, and what is wrong.
_INKS = {
    "true": (None, "#3c84d6"),
    "missed": ("#e8b4b4", "#c42d2d"),
    "hit": ("#b4dcc0", "#2f8f4a"),
    "wrong": ("#fad9a0", "#d07a00"),
}


class Things:
    """Buildings and trees of a vector file."""

    def __init__(self, path: str) -> None:
        self.path = path
        self.crs: dict[str, str] = {}  #: of each kind
        self.buildings: list[Any] | None = None
        self.trees: tuple[np.ndarray, np.ndarray] | None = None
        shapely, pyogrio = vector("shapely"), vector("pyogrio")
        if not Path(path).exists():
            raise StageError("there is no such file", found=path)
        try:
            layers = pyogrio.list_layers(path)
        except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError) as error:
            raise StageError(
                "objects are compared in vector files, and GDAL cannot read this one",
                found=f"{path}: {error}",
                cure="Of a cloud make one first: pdal-stages objects classified.laz town.gpkg",
            ) from None
        for name, kind in layers:
            for what, wanted in _LAYERS.items():
                if wanted not in str(kind) or (len(layers) > 1 and name != what):
                    continue
                with reading(path):
                    about, _, geometry, values = pyogrio.raw.read(path, layer=name)
                    shapes = shapely.force_2d(shapely.from_wkb(geometry))
                    there = ~shapely.is_missing(shapes) & ~shapely.is_empty(shapes)
                    places = shapely.get_coordinates(shapely.centroid(shapes[there]))
                self.crs[what] = str(about["crs"] or "")
                if not np.isfinite(places).all():
                    raise StageError("coordinates are not finite (NaN or infinite)", where=path, found=name)
                columns = {str(n).lower(): v for n, v in zip(about["fields"], values, strict=True)}
                if what == "buildings":
                    self.buildings = list(shapes[there])
                    continue
                title = next((n for n in HEIGHT_NAMES if n in columns), "")
                self.trees = places, _heights(path, title, columns[title] if title else there * np.nan)[there]
        if self.buildings is None and self.trees is None:
            raise StageError(
                "the file holds neither buildings nor trees",
                found=f"{path}: " + ", ".join(f"{name} ({kind})" for name, kind in layers),
                cure="Give a layer of polygons, or of points; of several layers 'buildings' and 'trees' are read",
            )

    def spots(self) -> list[Any]:
        """Points of the trees."""
        return list(vector("shapely").points(self.trees[0])) if self.trees else []

    def within(self, area: Any) -> None:
        """Keep what lies in an area: buildings by most of theirs, trees by their place."""
        shapely = vector("shapely")
        if self.buildings is not None:
            shapes = shapely.make_valid(self.buildings)
            inside = shapely.area(shapely.intersection(shapes, area)) >= 0.5 * shapely.area(shapes)
            self.buildings = list(shapes[inside])
        if self.trees is not None:
            inside = shapely.contains_xy(area, *self.trees[0].T)
            self.trees = self.trees[0][inside], self.trees[1][inside]


def _heights(path: str, name: str, values: Any) -> np.ndarray:
    """A column of heights as numbers, NaN where there is none; texts of numbers count as such."""
    try:
        return np.array([math.nan if v in (None, "") else float(v) for v in values.tolist()])
    except (TypeError, ValueError) as error:
        raise StageError(
            f"the column '{name}' must hold heights of trees, in meters",
            where=path,
            found=str(error),
            cure="Make it a number, or name it otherwise if it is something else",
        ) from None


def compare_objects(
    found: str, reference: str, area: str | None = None
) -> tuple[dict[str, Any], Things, Things]:
    """Figures of ``buildings`` and ``trees``, as far as both files have them, and what was read."""
    shapely = vector("shapely")
    one, two = Things(found), Things(reference)
    for what in one.crs.keys() & two.crs.keys():
        a, b = one.crs[what], two.crs[what]
        if a and b and a != b and _axes(a) != _axes(b):
            raise StageError(
                "the reference has another reference system",
                found=f"{found}: {a[:60]}; {reference}: {b[:60]}",
                cure=f"Reproject it first: ogr2ogr -t_srs {a if a.startswith('EPSG') else 'EPSG:CODE'} new.gpkg {reference}",
            )
    if area:
        polygons = Things(area).buildings
        if not polygons:
            raise StageError("the area must be of polygons", found=area)
        for things in (one, two):
            things.within(shapely.union_all(shapely.make_valid(polygons)))
    out: dict[str, Any] = {}
    if one.buildings is not None and two.buildings is not None:
        out["buildings"] = compare_buildings(one.buildings, two.buildings)
    if one.trees is not None and two.trees is not None and len(one.trees[0]) + len(two.trees[0]):
        out["trees"] = compare_trees(*one.trees, *two.trees)
    if not out:
        raise StageError(
            "the two files have nothing in common",
            found=f"{found}: {', '.join(one.crs)}; {reference}: {', '.join(two.crs)}",
        )
    return out, one, two


def remarks(found: Things, reference: Things) -> list[str]:
    """What a user should know of two files before he believes their figures: that they lie apart, or heights are missing."""
    out = []
    one, two = (
        vector("shapely").total_bounds([*(things.buildings or ()), *things.spots()])
        for things in (found, reference)
    )
    if (one[2:] < two[:2]).any() or (two[2:] < one[:2]).any():
        places = [f"{w:.0f} to {e:.0f}, {s:.0f} to {n:.0f}" for w, s, e, n in (one, two)]
        out.append(
            f"objects and reference lie apart, so nothing matches: {found.path} is at {places[0]}, "
            f"{reference.path} at {places[1]}. See whether both have the system that they say, and its order of axes"
        )
    if reference.trees is not None and len(reference.trees[1]) and np.isnan(reference.trees[1]).all():
        out.append(
            f"{reference.path}: its trees have no heights, so they are matched by place alone. "
            f"Name a column {HEIGHT_NAMES[0]} (or {', '.join(HEIGHT_NAMES[1:])})"
        )
    return out


def _axes(crs: str) -> str:
    """Of a compound system the name of the plane one."""
    return crs.split('"')[3] if crs.startswith(("COMPD_CS", "COMPOUNDCRS")) and crs.count('"') > 3 else crs


def _rows(of: dict[str, Any]) -> list[tuple[str, Any, Any, str, str]]:
    """Name, numbers in the reference and found, completeness and correctness of all objects and of those of a size."""
    rows = [("all", of["objects"]), *((n, v) for n, v in of["sizes"].items() if v["reference"] or v["found"])]
    return [
        (n, v["reference"], v["found"], _percent(v["completeness"]), _percent(v["correctness"]))
        for n, v in rows
    ]


def _more(what: str, of: dict[str, Any]) -> list[tuple[str, str]]:
    f1 = "F1, matched at " + ("IoU 0.5" if what == "buildings" else "4 m, 30 % of height")
    out = [(f1, _percent(of["objects"]["f1"]))]
    if what == "trees":
        return [
            *out,
            ("distance, median", f"{of['place']['median']:.2f} m"),
            ("height, bias and RMSE", f"{of['height']['bias']:+.2f} m, {of['height']['rmse']:.2f} m"),
        ]
    area, edge = of["area"], of["boundary"]
    return [
        *out,
        ("area, complete and correct", f"{_percent(area['completeness'])}, {_percent(area['correctness'])}"),
        ("area, intersection over union", _percent(area["iou"])),
        ("covered by at least 80 %", f"{_percent(of['covered'])} of the reference"),
        ("boundary offset, median and 95 %", f"{edge['median']:.2f} m, {edge['p95']:.2f} m"),
    ]


def table(figures: dict[str, Any]) -> str:
    """The figures as text."""
    lines: list[str] = []
    for what, of in figures.items():
        objects = of["objects"]
        lines += [
            f"{what}: {objects['found']:,} found, {objects['reference']:,} in the reference",
            f"{'':24s}{'reference':>10s}{'found':>10s}{'complete':>10s}{'correct':>10s}",
            *(f"{n:24s}{true:10,}{found:10,}{a:>10s}{b:>10s}" for n, true, found, a, b in _rows(of)),
            *(f"{name}: {text}" for name, text in _more(what, of)),
            "",
        ]
    return "\n".join(lines)


def _percent(value: float) -> str:
    return "" if math.isnan(value) else f"{100 * value:.1f} %"


def to_json(figures: dict[str, Any]) -> dict[str, Any]:
    """The figures with null where there is no number, and without the pairs."""

    def clean(value: Any) -> Any:
        if isinstance(value, dict):
            return {k: clean(v) for k, v in value.items() if not isinstance(v, list)}
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return clean(figures)


def page(figures: dict[str, Any], found: Things, reference: Things, title: str) -> str:
    """The page: tables, and a map of what was found, missed, and found where nothing is."""
    drawn: list[tuple[Any, str | None, str]] = []
    for what, of in figures.items():
        hits = [{pair[k] for pair in of["matched"]} for k in (0, 1)]
        for things, hit, right, wrong in (
            (reference, hits[1], "true", "missed"),
            (found, hits[0], "hit", "wrong"),
        ):
            shapes = things.buildings if what == "buildings" else things.spots()
            drawn += [(s, *_INKS[right if n in hit else wrong]) for n, s in enumerate(shapes or ())]
    return render(
        "objects.html",
        title=title,
        subtitle=f"{Path(found.path).name} against {Path(reference.path).name}",
        tables=[{"what": what, "rows": _rows(of), "more": _more(what, of)} for what, of in figures.items()],
        map=embedded(draw_map(drawn)) if drawn else None,
    )
