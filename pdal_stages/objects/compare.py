"""Objects of a vector file against those of another: as objects, by area, by boundary; trees by place and height.

Completeness is the share of the reference that was found, correctness the share of what was found that is in the reference,
quality their harmonic mean (F1). Coordinates are meters.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from ..base.errors import StageError
from ..base.vector import reading, vector

#: Buildings are told apart by area, m2, and trees by height, m.
AREAS = (0.0, 25.0, 100.0, 500.0, np.inf)
HEIGHTS = (0.0, 5.0, 10.0, 20.0, np.inf)
#: Boundaries are compared at places so far apart, meters.
EVERY = 0.5
#: What columns of tree heights are called.
HEIGHT_NAMES = ("height", "h", "height_m", "hoehe", "hauteur", "hoogte", "z_height")
#: Layers that hold buildings and trees, in files of more than one.
_LAYERS = {"buildings": "Polygon", "trees": "Point"}

Pairs = list[tuple[int, int]]


def matched_by_overlap(found: Sequence[Any], true: Sequence[Any], least: float = 0.5) -> Pairs:
    """Pairs (found, true) whose intersection over union is at least `least`, the most alike first, each once."""
    shapely = vector("shapely")
    if not len(found) or not len(true):
        return []
    a, b = shapely.STRtree(true).query(found, predicate="intersects")
    shapes, others = np.asarray(found, object)[a], np.asarray(true, object)[b]
    shared = shapely.area(shapely.intersection(shapes, others))
    alike = shared / np.maximum(shapely.area(shapes) + shapely.area(others) - shared, 1e-12)
    return _each_once(a, b, -alike, alike >= least)


def matched_by_place(
    found: NDArray,
    found_height: NDArray,
    true: NDArray,
    true_height: NDArray,
    away: float = 4.0,
    share: float = 0.3,
) -> Pairs:
    """Pairs (found, true) of trees within `away` meters whose heights differ by at most a `share` of the true one.

    The nearest first, each once. Where the true height is not known (NaN) the place alone decides.
    """
    if not len(found) or not len(true):
        return []
    near = scipy.spatial.cKDTree(found).sparse_distance_matrix(
        scipy.spatial.cKDTree(true), away, output_type="ndarray"
    )
    a, b = near["i"], near["j"]
    with np.errstate(invalid="ignore"):
        unlike = np.abs(found_height[a] - true_height[b]) > share * true_height[b]
    return _each_once(a, b, near["v"], ~unlike)


def _each_once(a: NDArray, b: NDArray, cost: NDArray, allowed: NDArray[np.bool_]) -> Pairs:
    one: dict[int, int] = {}
    other: set[int] = set()
    for n in np.lexsort((b, a, np.round(cost, 9))).tolist():
        if allowed[n] and a[n] not in one and b[n] not in other:
            one[int(a[n])] = int(b[n])
            other.add(int(b[n]))
    return list(one.items())


def compare_buildings(found: Sequence[Any], true: Sequence[Any]) -> dict[str, Any]:
    """Figures of outlines (shapely polygons, meters) against true ones.

    Returns
    -------
    dict
        ``objects`` (matched at an intersection over union of 0.5), ``sizes`` (the same by area), ``area`` (completeness,
        correctness and intersection over union of all area), ``covered`` (the share of true outlines of which found ones
        cover at least 80 %), ``boundary`` (how far places along the true boundary lie from the found one, of blocks that
        match: median and 95th percentile, meters).
    """
    shapely = vector("shapely")
    found, true = list(shapely.make_valid(list(found))), list(shapely.make_valid(list(true)))
    whole_found, whole_true = shapely.union_all(found), shapely.union_all(true)
    shared = whole_found.intersection(whole_true).area
    parts = shapely.area(shapely.intersection(true, whole_found)) / np.maximum(
        shapely.area(true), 1e-12
    )
    blocks, true_blocks = shapely.get_parts(whole_found), shapely.get_parts(whole_true)
    offsets = [np.empty(0)]
    for a, b in matched_by_overlap(blocks, true_blocks):
        edge = true_blocks[b].boundary
        places = shapely.line_interpolate_point(edge, np.arange(0.0, edge.length, EVERY))
        offsets.append(shapely.distance(places, blocks[a].boundary))
    away = np.concatenate(offsets)
    return {
        **_scores(
            matched_by_overlap(found, true), shapely.area(found), shapely.area(true), AREAS, "m2"
        ),
        "area": {
            "reference": whole_true.area,
            "found": whole_found.area,
            "completeness": _share(shared, whole_true.area),
            "correctness": _share(shared, whole_found.area),
            "iou": _share(shared, whole_found.area + whole_true.area - shared),
        },
        "covered": _mean(parts >= 0.8),
        "boundary": {
            "places": len(away),
            "median": float(np.median(away)) if len(away) else np.nan,
            "p95": float(np.percentile(away, 95)) if len(away) else np.nan,
        },
    }


def compare_trees(
    found: NDArray, found_height: NDArray, true: NDArray, true_height: NDArray
) -> dict[str, Any]:
    """Figures of trees, (n, 2) places and (n,) heights in meters, against true ones; heights may be NaN."""
    pairs = matched_by_place(found, found_height, true, true_height)
    a, b = np.array(pairs, np.int64).reshape(-1, 2).T
    away, higher = np.hypot(*(found[a] - true[b]).T), found_height[a] - true_height[b]
    higher = higher[~np.isnan(higher)]
    return {
        **_scores(pairs, found_height, true_height, HEIGHTS, "m"),
        "place": {"median": float(np.median(away)) if len(away) else np.nan},
        "height": {"bias": _mean(higher), "rmse": float(np.sqrt(_mean(higher**2)))},
    }


def _scores(
    pairs: Pairs, found: NDArray, true: NDArray, limits: Sequence[float], unit: str
) -> dict[str, Any]:
    """Scores of all objects and of those of a size; `found` and `true` are sizes."""
    hit_found, hit_true = np.zeros(len(found), bool), np.zeros(len(true), bool)
    a, b = np.array(pairs, np.int64).reshape(-1, 2).T
    hit_found[a], hit_true[b] = True, True

    def score(which_found: Any, which_true: Any) -> dict[str, float]:
        right, hit = hit_found[which_found], hit_true[which_true]
        return {
            "reference": len(hit),
            "found": len(right),
            "completeness": _mean(hit),
            "correctness": _mean(right),
        }

    sizes = {}
    for low, high in itertools.pairwise(limits):
        name = f"{low:g} to {high:g} {unit}" if np.isfinite(high) else f"{low:g} {unit} and more"
        sizes[name] = score((found >= low) & (found < high), (true >= low) & (true < high))
    objects = {**score(slice(None), slice(None)), "matched": len(pairs)}
    objects["f1"] = _share(2 * len(pairs), len(found) + len(true))
    return {"objects": objects, "sizes": sizes}


def _share(part: float, whole: float) -> float:
    return part / whole if whole else np.nan


def _mean(values: NDArray) -> float:
    return float(np.mean(values)) if len(values) else np.nan


class Things:
    """Shapes of ``buildings`` and ``trees`` of a vector file, as far as it has them, and heights of the trees, meters."""

    def __init__(self, path: str) -> None:
        self.path = path
        self.shapes: dict[str, np.ndarray] = {}
        self.crs: dict[str, str] = {}
        self.heights = np.empty(0)
        shapely, pyogrio = vector("shapely"), vector("pyogrio")
        if not Path(path).exists():
            raise StageError("there is no such file", found=path)
        what = "objects are compared in vector files, and GDAL cannot read this one"
        cure = "Of a cloud make one first: pdal-stages objects classified.laz town.gpkg"
        with reading(path, what, cure) as plain:
            layers = pyogrio.list_layers(plain)
        for name, kind in layers:
            for what, wanted in _LAYERS.items():
                if wanted not in str(kind) or (len(layers) > 1 and name != what):
                    continue
                with reading(path) as plain:
                    about, _, geometry, values = pyogrio.raw.read(plain, layer=name)
                    shapes = shapely.force_2d(shapely.from_wkb(geometry))
                    there = ~shapely.is_missing(shapes) & ~shapely.is_empty(shapes)
                    bounds = shapely.bounds(shapes[there])
                if not np.isfinite(bounds).all():
                    raise StageError(
                        "coordinates are not finite (NaN or infinite)", where=path, found=name
                    )
                self.shapes[what], self.crs[what] = shapes[there], str(about["crs"] or "")
                columns = {str(n).lower(): v for n, v in zip(about["fields"], values, strict=True)}
                if what == "trees":
                    title = next((n for n in HEIGHT_NAMES if n in columns), "")
                    self.heights = _heights(path, title, columns.get(title, there * np.nan))[there]
        if not self.shapes:
            raise StageError(
                "the file holds neither buildings nor trees",
                found=f"{path}: " + ", ".join(f"{name} ({kind})" for name, kind in layers),
                cure="Give a layer of polygons, or of points; of several layers 'buildings' and 'trees' are read",
            )

    @property
    def trees(self) -> tuple[np.ndarray, np.ndarray]:
        """Places (n, 2) and heights (n,) of the trees."""
        shapely = vector("shapely")
        return shapely.get_coordinates(shapely.centroid(self.shapes["trees"])), self.heights

    def within(self, area: Any) -> None:
        """Keep what lies in an area: buildings by most of theirs, trees by their place."""
        shapely = vector("shapely")
        for what, shapes in self.shapes.items():
            if what == "trees":
                inside = shapely.contains_xy(area, *self.trees[0].T)
                self.heights = self.heights[inside]
            else:
                valid = shapely.make_valid(shapes)
                inside = shapely.area(shapely.intersection(valid, area)) >= 0.5 * shapely.area(
                    valid
                )
            self.shapes[what] = shapes[inside]


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
        polygons = Things(area).shapes.get("buildings", ())
        if not len(polygons):
            raise StageError("the area must be of polygons", found=area)
        for things in (one, two):
            things.within(shapely.union_all(shapely.make_valid(polygons)))
    out: dict[str, Any] = {}
    both = one.shapes.keys() & two.shapes.keys()
    if "buildings" in both:
        out["buildings"] = compare_buildings(
            *(list(things.shapes["buildings"]) for things in (one, two))
        )
    if "trees" in both and len(one.heights) + len(two.heights):
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
        vector("shapely").total_bounds(np.concatenate([*things.shapes.values()]))
        for things in (found, reference)
    )
    if (one[2:] < two[:2]).any() or (two[2:] < one[:2]).any():
        places = [f"{w:.0f} to {e:.0f}, {s:.0f} to {n:.0f}" for w, s, e, n in (one, two)]
        out.append(
            f"objects and reference lie apart, so nothing matches: {found.path} is at {places[0]}, "
            f"{reference.path} at {places[1]}. See whether both have the system that they say, and its order of axes"
        )
    if len(reference.heights) and np.isnan(reference.heights).all():
        out.append(
            f"{reference.path}: its trees have no heights, so they are matched by place alone. "
            f"Name a column {HEIGHT_NAMES[0]} (or {', '.join(HEIGHT_NAMES[1:])})"
        )
    return out


def _axes(crs: str) -> str:
    """Of a compound system the name of the plane one."""
    return (
        crs.split('"')[3]
        if crs.startswith(("COMPD_CS", "COMPOUNDCRS")) and crs.count('"') > 3
        else crs
    )


def table(figures: dict[str, Any]) -> str:
    """The figures as text."""
    lines: list[str] = []
    for what, of in figures.items():
        objects = of["objects"]
        rows = {
            "all": objects,
            **{n: v for n, v in of["sizes"].items() if v["reference"] or v["found"]},
        }
        lines += [
            f"{what}: {objects['found']:,} found, {objects['reference']:,} in the reference",
            f"{'':24s}{'reference':>10s}{'found':>10s}{'complete':>10s}{'correct':>10s}",
        ]
        for name, row in rows.items():
            shares = "".join(
                f"{_percent(row[key]):>10s}" for key in ("completeness", "correctness")
            )
            lines.append(f"{name:24s}{row['reference']:10,}{row['found']:10,}{shares}")
        if what == "trees":
            lines += [
                f"F1, matched at 4 m, 30 % of height: {_percent(objects['f1'])}",
                f"distance, median: {of['place']['median']:.2f} m",
                f"height, bias and RMSE: {of['height']['bias']:+.2f} m, {of['height']['rmse']:.2f} m",
                "",
            ]
            continue
        area, edge = of["area"], of["boundary"]
        lines += [
            f"F1, matched at IoU 0.5: {_percent(objects['f1'])}",
            f"area, complete and correct: {_percent(area['completeness'])}, {_percent(area['correctness'])}",
            f"area, intersection over union: {_percent(area['iou'])}",
            f"covered by at least 80 %: {_percent(of['covered'])} of the reference",
            f"boundary offset, median and 95 %: {edge['median']:.2f} m, {edge['p95']:.2f} m",
            "",
        ]
    return "\n".join(lines)


def _percent(value: float) -> str:
    return "" if math.isnan(value) else f"{100 * value:.1f} %"


def to_json(value: Any) -> Any:
    """Figures with null where there is no number."""
    if isinstance(value, dict):
        return {name: to_json(one) for name, one in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value
