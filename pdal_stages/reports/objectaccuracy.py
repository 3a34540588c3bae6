"""Objects of a vector file held against those of another: table, JSON, a page with a map."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..base.errors import StageError
from ..objects.compare import compare_buildings, compare_trees
from ..objects.outlines import reading, vector
from .page import render

#: What columns of tree heights are called.
HEIGHT_NAMES = ("height", "h", "height_m", "hoehe", "hauteur", "hoogte", "z_height")
#: Layers that hold buildings and trees, in files of more than one.
_LAYERS = {"buildings": "Polygon", "trees": "Point"}
_MOST_DRAWN = 5000


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

    def within(self, area: Any) -> None:
        """Keep what lies in an area: buildings by most of theirs, trees by their place."""
        shapely = vector("shapely")
        if self.buildings is not None:
            shapes = shapely.make_valid(self.buildings)
            inside = shapely.area(shapely.intersection(shapes, area)) >= 0.5 * shapely.area(shapes)
            self.buildings = [s for s, i in zip(shapes, inside, strict=True) if i]
        if self.trees is not None:
            inside = shapely.contains_xy(area, *self.trees[0].T)
            self.trees = self.trees[0][inside], self.trees[1][inside]


def _heights(path: str, name: str, values: Any) -> np.ndarray:
    """A column of heights as numbers, NaN where there is none; texts of numbers count as such."""
    out = np.full(len(values), np.nan)
    for n, value in enumerate(values.tolist()):
        try:
            out[n] = math.nan if value in (None, "") else float(value)
        except (TypeError, ValueError):
            raise StageError(
                f"the column '{name}' must hold heights of trees, in meters",
                where=path,
                found=repr(value),
                cure="Make it a number, or name it otherwise if it is something else",
            ) from None
    return out


def area_of(path: str) -> Any:
    """The union of a file's polygons."""
    things = Things(path)
    if not things.buildings:
        raise StageError("the area must be of polygons", found=path)
    return vector("shapely").union_all(vector("shapely").make_valid(things.buildings))


def compare_objects(
    found: str, reference: str, area: str | None = None
) -> tuple[dict[str, Any], Things, Things]:
    """Figures of ``buildings`` and ``trees``, as far as both files have them, and what was read."""
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
        place = area_of(area)
        one.within(place)
        two.within(place)
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
    boxes = [box for one in (found, reference) if (box := _box(one)) is not None]
    if len(boxes) == 2 and (boxes[0][2:] < boxes[1][:2]).any() | (boxes[1][2:] < boxes[0][:2]).any():
        places = [f"{w:.0f} to {e:.0f}, {s:.0f} to {n:.0f}" for w, s, e, n in boxes]
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


def _box(things: Things) -> np.ndarray | None:
    """Where a file's objects lie: west, south, east, north."""
    shapely = vector("shapely")
    shapes = list(things.buildings or ())
    shapes += (
        [] if things.trees is None or not len(things.trees[0]) else [shapely.MultiPoint(things.trees[0])]
    )
    return shapely.total_bounds(shapes) if shapes else None


def _axes(crs: str) -> str:
    """Of a compound system the name of the plane one."""
    return crs.split('"')[3] if crs.startswith(("COMPD_CS", "COMPOUNDCRS")) and crs.count('"') > 3 else crs


def table(figures: dict[str, Any]) -> str:
    """The figures as text."""
    lines: list[str] = []
    for what, of in figures.items():
        rule = "IoU 0.5" if what == "buildings" else "4 m, 30 % of height"
        lines += [
            f"{what}: {of['objects']['found']:,} found, {of['objects']['reference']:,} in the reference",
            f"{'':24s}{'reference':>10s}{'found':>10s}{'complete':>10s}{'correct':>10s}{'F1':>8s}",
        ]
        rows = [(f"matched at {rule}", {**of["objects"]})]
        rows += [(name, one) for name, one in of["sizes"].items() if one["reference"] or one["found"]]
        for name, one in rows:
            lines.append(
                f"{name:24s}{one['reference']:10,}{one['found']:10,}{_percent(one['completeness']):>10s}"
                f"{_percent(one['correctness']):>10s}{_percent(one.get('f1', math.nan)):>8s}"
            )
        lines += [f"{name}: {text}" for name, text in _more(what, of)]
        lines.append("")
    return "\n".join(lines)


def _more(what: str, of: dict[str, Any]) -> list[tuple[str, str]]:
    if what == "trees":
        return [
            ("distance, median", f"{of['place']['median']:.2f} m"),
            ("height, bias and RMSE", f"{of['height']['bias']:+.2f} m, {of['height']['rmse']:.2f} m"),
        ]
    area = of["area"]
    return [
        ("area, complete and correct", f"{_percent(area['completeness'])}, {_percent(area['correctness'])}"),
        ("area, intersection over union", f"{_percent(area['iou'])}"),
        ("covered by at least 80 %", f"{_percent(of['covered'])} of the reference"),
        (
            "boundary offset, median and 95 %",
            f"{of['boundary']['median']:.2f} m, {of['boundary']['p95']:.2f} m",
        ),
    ]


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
    tables = []
    for what, of in figures.items():
        rows = [("all", of["objects"])] + [
            (k, v) for k, v in of["sizes"].items() if v["reference"] or v["found"]
        ]
        shown = [
            (n, v["reference"], v["found"], _percent(v["completeness"]), _percent(v["correctness"]))
            for n, v in rows
        ]
        tables.append({"what": what, "rows": shown, "more": _more(what, of)})
    return render(
        "objects.html",
        title=title,
        subtitle=f"{Path(found.path).name} against {Path(reference.path).name}",
        tables=tables,
        map=_map(figures, found, reference),
    )


def _map(figures: dict[str, Any], found: Things, reference: Things) -> dict[str, Any]:
    """Shapes to be drawn, in a frame 1000 wide."""
    shapely = vector("shapely")
    rings: list[tuple[str, Any]] = []
    spots: list[tuple[str, float, float]] = []
    if "buildings" in figures:
        pairs = figures["buildings"]["matched"]
        hit_found, hit_true = {a for a, _ in pairs}, {b for _, b in pairs}
        rings += [("true" if n in hit_true else "missed", s) for n, s in enumerate(reference.buildings or [])]
        rings += [("hit" if n in hit_found else "wrong", s) for n, s in enumerate(found.buildings or [])]
    if "trees" in figures and found.trees and reference.trees:
        pairs = figures["trees"]["matched"]
        hit_found, hit_true = {a for a, _ in pairs}, {b for _, b in pairs}
        spots += [("hit" if n in hit_found else "wrong", *p) for n, p in enumerate(found.trees[0].tolist())]
        spots += [("missed", *p) for n, p in enumerate(reference.trees[0].tolist()) if n not in hit_true]
    drawn = len(rings) + len(spots)
    rings, spots = rings[:_MOST_DRAWN], spots[:_MOST_DRAWN]
    places = [shapely.get_coordinates(s) for _, s in rings] + [np.array([[x, y]]) for _, x, y in spots]
    if not places:
        return {"wide": 0, "high": 0, "paths": [], "spots": [], "left_out": 0}
    low, high = np.min([p.min(0) for p in places], axis=0), np.max([p.max(0) for p in places], axis=0)
    scale = 1000.0 / max(float(high[0] - low[0]), 1e-9)

    def shown(xy: Any) -> Sequence[tuple[float, float]]:
        return [((x - low[0]) * scale, (high[1] - y) * scale) for x, y in xy]

    paths = []
    for kind, shape in rings:
        text = ""
        for part in shapely.get_parts(shape):
            if part.geom_type == "Polygon":
                for ring in (part.exterior, *part.interiors):
                    text += "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in shown(ring.coords)) + "Z"
        paths.append((kind, text))
    return {
        "wide": 1000,
        "high": round(float(high[1] - low[1]) * scale, 1),
        "paths": paths,
        "spots": [(kind, *shown([(x, y)])[0]) for kind, x, y in spots],
        "left_out": drawn - len(rings) - len(spots),
    }
