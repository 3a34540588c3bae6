"""Compare objects of two vector files: as objects, by area, by boundary; trees by place and height.

Completeness is the share of the reference that was detected, correctness the share of detected
objects that are in the reference, F1 their harmonic mean. Coordinates must be in meters: those of
files in feet are not converted.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from ..base.errors import StageError
from ..base.units import horizontal_part
from ..base.vector import reading, vector

# Values without a reason are not tuned.
#: Intersection over union from which outlines match: each then covers at least half of the other.
MIN_IOU = 0.5
#: Farthest that matching trees are from each other, meters.
MAX_DISTANCE = 4.0
#: Largest difference of matching trees' heights, as a share of the true one.
MAX_HEIGHT_ERROR = 0.3
#: Share of a true outline's area from which it counts as covered.
COVERED = 0.8
#: Share of a building's area in the compared area from which it counts.
MIN_SHARE_INSIDE = 0.5
#: Distance between the places at which boundaries are compared, meters.
BOUNDARY_STEP = 0.5
#: Names of columns that hold heights of trees.
HEIGHT_NAMES = ("height", "h", "height_m", "hoehe", "hauteur", "hoogte", "z_height")
#: Layers, and the geometry that each must have.
_GEOMETRY = {"buildings": "Polygon", "trees": "Point"}

Pairs = list[tuple[int, int]]


def match_by_overlap(
    detected: Sequence[Any], true: Sequence[Any], min_iou: float = MIN_IOU
) -> Pairs:
    """Return pairs (detected, true) by intersection over union, each object once."""
    shapely = vector("shapely")
    if not len(detected) or not len(true):
        return []
    a, b = shapely.STRtree(true).query(detected, predicate="intersects")
    shapes, others = np.asarray(detected, object)[a], np.asarray(true, object)[b]
    shared = shapely.area(shapely.intersection(shapes, others))
    iou = shared / np.maximum(shapely.area(shapes) + shapely.area(others) - shared, 1e-12)
    return _match_greedily(a, b, -iou, iou >= min_iou)


def match_by_place(
    places: NDArray,
    heights: NDArray,
    true_places: NDArray,
    true_heights: NDArray,
    max_distance: float = MAX_DISTANCE,
    max_height_error: float = MAX_HEIGHT_ERROR,
) -> Pairs:
    """Return pairs (detected, true) of trees, the nearest first, each tree once.

    Parameters
    ----------
    places, true_places : (n, 2), (m, 2) float64
    heights, true_heights : (n,), (m,) float64
        Meters; where the true one is not known (NaN), the place alone decides.
    max_distance : float
        Meters.
    max_height_error : float
        Share of the true height.
    """
    if not len(places) or not len(true_places):
        return []
    near = scipy.spatial.cKDTree(places).sparse_distance_matrix(
        scipy.spatial.cKDTree(true_places), max_distance, output_type="ndarray"
    )
    a, b = near["i"], near["j"]
    with np.errstate(invalid="ignore"):
        differs = np.abs(heights[a] - true_heights[b]) > max_height_error * true_heights[b]
    return _match_greedily(a, b, near["v"], ~differs)


def _match_greedily(a: NDArray, b: NDArray, cost: NDArray, allowed: NDArray[np.bool_]) -> Pairs:
    pairs: dict[int, int] = {}
    matched: set[int] = set()
    for n in np.lexsort((b, a, np.round(cost, 9))).tolist():
        if allowed[n] and a[n] not in pairs and b[n] not in matched:
            pairs[int(a[n])] = int(b[n])
            matched.add(int(b[n]))
    return list(pairs.items())


def compare_buildings(detected: Sequence[Any], true: Sequence[Any]) -> dict[str, Any]:
    """Compare outlines (shapely polygons, meters) with true ones.

    Returns
    -------
    dict
        ``objects`` (matched by :data:`MIN_IOU`), ``area`` (completeness,
        correctness and intersection over union of all area), ``covered`` (share of true outlines
        that detected ones cover by :data:`COVERED`), ``boundary`` (distance of places along the
        true boundary from the detected one, of blocks that match: median and 95th percentile,
        meters).
    """
    shapely = vector("shapely")
    detected, true = list(shapely.make_valid(list(detected))), list(shapely.make_valid(list(true)))
    whole, whole_true = shapely.union_all(detected), shapely.union_all(true)
    shared, areas = whole.intersection(whole_true).area, shapely.area(true)
    covered = shapely.area(shapely.intersection(true, whole)) / np.maximum(areas, 1e-12)
    blocks, true_blocks = shapely.get_parts(whole), shapely.get_parts(whole_true)
    offsets = [np.empty(0)]
    for a, b in match_by_overlap(blocks, true_blocks):
        edge = true_blocks[b].boundary
        places = shapely.line_interpolate_point(edge, np.arange(0.0, edge.length, BOUNDARY_STEP))
        offsets.append(shapely.distance(places, blocks[a].boundary))
    offset = np.concatenate(offsets)
    pairs = match_by_overlap(detected, true)
    return {
        "objects": _scores(pairs, len(detected), len(true)),
        "area": {
            "reference": whole_true.area,
            "found": whole.area,
            "completeness": _share(shared, whole_true.area),
            "correctness": _share(shared, whole.area),
            "iou": _share(shared, whole.area + whole_true.area - shared),
        },
        "covered": _mean(covered >= COVERED),
        "boundary": {
            "places": len(offset),
            "median": _percentile(offset, 50),
            "p95": _percentile(offset, 95),
        },
    }


def compare_trees(
    places: NDArray, heights: NDArray, true_places: NDArray, true_heights: NDArray
) -> dict[str, Any]:
    """Compare trees, (n, 2) places and (n,) heights (meters or NaN), with true ones."""
    pairs = match_by_place(places, heights, true_places, true_heights)
    a, b = np.array(pairs, np.int64).reshape(-1, 2).T
    distance = np.hypot(*(places[a] - true_places[b]).T)
    error = heights[a] - true_heights[b]
    error = error[~np.isnan(error)]
    return {
        "objects": _scores(pairs, len(heights), len(true_heights)),
        "place": {"median": _percentile(distance, 50)},
        "height": {"bias": _mean(error), "rmse": float(np.sqrt(_mean(error**2)))},
    }


def _scores(pairs: Pairs, detected: int, true: int) -> dict[str, Any]:
    """Return the scores of a number of detected and of true objects."""
    return {
        "reference": true,
        "found": detected,
        "completeness": _share(len(pairs), true),
        "correctness": _share(len(pairs), detected),
        "matched": len(pairs),
        "f1": _share(2 * len(pairs), detected + true),
    }


def _share(part: float, whole: float) -> float:
    return part / whole if whole else np.nan


def _mean(values: NDArray) -> float:
    return float(np.mean(values)) if len(values) else np.nan


def _percentile(values: NDArray, percent: float) -> float:
    return float(np.percentile(values, percent)) if len(values) else np.nan


@dataclass(frozen=True)
class VectorObjects:
    """Buildings and trees of a vector file, as far as it has them."""

    path: str
    shapes: dict[str, NDArray]  #: geometries of ``buildings`` and ``trees``
    crs: dict[str, str]  #: reference system of each
    heights: NDArray[np.float64]  #: (n,) heights of the trees, meters; NaN where not known

    @classmethod
    def read(cls, path: str) -> VectorObjects:
        """Read the layers of a file; of several those named ``buildings`` and ``trees``."""
        shapes, crs, heights = {}, {}, np.empty(0)
        shapely, pyogrio = vector("shapely"), vector("pyogrio")
        if not Path(path).exists():
            raise StageError("there is no such file", found=path)
        what = "objects are compared in vector files, and GDAL cannot read this one"
        cure = "Of a cloud make one first: pdal-stages objects classified.laz town.gpkg"
        with reading(path, what, cure) as plain:
            layers = pyogrio.list_layers(plain)
        for (name, kind), (what, geometry) in itertools.product(layers, _GEOMETRY.items()):
            if geometry not in str(kind) or (len(layers) > 1 and name != what):
                continue
            with reading(path) as plain:
                about, _, wkb, values = pyogrio.raw.read(plain, layer=name)
                read = shapely.force_2d(shapely.from_wkb(wkb))
                exists = ~shapely.is_missing(read) & ~shapely.is_empty(read)
                bounds = shapely.bounds(read[exists])
            if not np.isfinite(bounds).all():
                what = "coordinates are not finite (NaN or infinite)"
                raise StageError(what, where=path, found=name)
            shapes[what], crs[what] = read[exists], str(about["crs"] or "")
            if what == "trees":
                columns = {str(n).lower(): v for n, v in zip(about["fields"], values, strict=True)}
                title = next((n for n in HEIGHT_NAMES if n in columns), "")
                column = columns.get(title, exists * np.nan)
                try:  # a height of None or an empty text is not known
                    heights = np.array([v or np.nan for v in column.tolist()], float)[exists]
                except ValueError as error:
                    what = f"the column '{title}' must hold heights of trees, in meters"
                    raise StageError(what, where=path, found=str(error)) from None
        if not shapes:
            raise StageError(
                "the file holds neither buildings nor trees",
                found=f"{path}: " + ", ".join(f"{name} ({kind})" for name, kind in layers),
                cure="Give a layer of polygons, or of points; of several layers 'buildings' and "
                "'trees' are read",
            )
        return cls(path, shapes, crs, heights)

    @property
    def trees(self) -> tuple[NDArray, NDArray]:
        """Places (n, 2) and heights (n,) of the trees."""
        shapely = vector("shapely")
        return shapely.get_coordinates(shapely.centroid(self.shapes["trees"])), self.heights

    def clip(self, area: Any) -> VectorObjects:
        """Return the objects in an area: buildings at least half in it, trees by place."""
        shapely, shapes, heights = vector("shapely"), dict(self.shapes), self.heights
        if "trees" in shapes:
            inside = shapely.contains_xy(area, *self.trees[0].T)
            shapes["trees"], heights = shapes["trees"][inside], heights[inside]
        if "buildings" in shapes:
            valid = shapely.make_valid(shapes["buildings"])
            inside = shapely.area(
                shapely.intersection(valid, area)
            ) >= MIN_SHARE_INSIDE * shapely.area(valid)
            shapes["buildings"] = shapes["buildings"][inside]
        return replace(self, shapes=shapes, heights=heights)


def compare_objects(
    detected: str, reference: str, area: str | None = None
) -> tuple[dict[str, Any], list[str]]:
    """Compare the ``buildings`` and ``trees`` that both files have.

    Parameters
    ----------
    detected, reference : str
        Vector files.
    area : str, optional
        Vector file of polygons, of several layers the one named ``buildings``; objects outside are
        not counted.

    Returns
    -------
    figures : dict
        By layer, see :func:`compare_buildings` and :func:`compare_trees`.
    warnings : list of str
    """
    shapely = vector("shapely")
    both = VectorObjects.read(detected), VectorObjects.read(reference)
    for layer in both[0].crs.keys() & both[1].crs.keys():
        a, b = (objects.crs[layer] for objects in both)
        if a and b and len({vector("pyproj").CRS(horizontal_part(crs)) for crs in (a, b)}) > 1:
            target = a if a.startswith("EPSG") else "EPSG:CODE"
            raise StageError(
                "the reference has another reference system",
                found=f"{detected}: {a[:60]}; {reference}: {b[:60]}",
                cure=f"Reproject it first: ogr2ogr -t_srs {target} new.gpkg {reference}",
            )
    if area:
        polygons = VectorObjects.read(area).shapes.get("buildings", ())
        if not len(polygons):
            raise StageError("the area must be of polygons", found=area)
        whole = shapely.union_all(shapely.make_valid(polygons))
        both = both[0].clip(whole), both[1].clip(whole)
    figures: dict[str, Any] = {}
    common = both[0].shapes.keys() & both[1].shapes.keys()
    if "buildings" in common:
        shapes = (list(objects.shapes["buildings"]) for objects in both)
        figures["buildings"] = compare_buildings(*shapes)
    if "trees" in common and len(both[0].heights) + len(both[1].heights):
        figures["trees"] = compare_trees(*both[0].trees, *both[1].trees)
    if not figures:
        listed = (f"{objects.path}: {', '.join(objects.crs)}" for objects in both)
        raise StageError("the two files have nothing in common", found="; ".join(listed))
    return figures, _warnings(*both)


def _warnings(detected: VectorObjects, reference: VectorObjects) -> list[str]:
    """Return warnings about files that lie apart, and about missing heights."""
    out = []
    a, b = (
        vector("shapely").total_bounds(np.concatenate([*objects.shapes.values()]))
        for objects in (detected, reference)
    )
    if (a[2:] < b[:2]).any() or (b[2:] < a[:2]).any():
        places = [f"{w:.0f} to {e:.0f}, {s:.0f} to {n:.0f}" for w, s, e, n in (a, b)]
        out.append(
            f"objects and reference lie apart, so nothing matches: {detected.path} is at "
            f"{places[0]}, {reference.path} at {places[1]}. Check the reference system of both, "
            "and the order of its axes"
        )
    if len(reference.heights) and np.isnan(reference.heights).all():
        out.append(
            f"{reference.path}: its trees have no heights, so they are matched by place alone. "
            f"Name a column {HEIGHT_NAMES[0]} (or {', '.join(HEIGHT_NAMES[1:])})"
        )
    return out


def table(figures: dict[str, Any]) -> str:
    """Return the figures as text."""
    lines: list[str] = []
    for layer, scores in figures.items():
        objects = scores["objects"]
        shares = [_percent(objects[key]) for key in ("completeness", "correctness")]
        lines += [
            f"{layer}: {objects['found']:,} found, {objects['reference']:,} in the reference",
            f"complete {shares[0]}, correct {shares[1]}",
        ]
        if layer == "trees":
            place, height = scores["place"], scores["height"]
            lines += [
                f"F1, matched at {MAX_DISTANCE:g} m, {100 * MAX_HEIGHT_ERROR:g} % of height: "
                f"{_percent(objects['f1'])}",
                f"distance, median: {place['median']:.2f} m",
                f"height, bias and RMSE: {height['bias']:+.2f} m, {height['rmse']:.2f} m",
                "",
            ]
            continue
        area, edge = scores["area"], scores["boundary"]
        both = f"{_percent(area['completeness'])}, {_percent(area['correctness'])}"
        covered = _percent(scores["covered"])
        lines += [
            f"F1, matched at IoU {MIN_IOU:g}: {_percent(objects['f1'])}",
            f"area, complete and correct: {both}",
            f"area, intersection over union: {_percent(area['iou'])}",
            f"covered by at least {100 * COVERED:g} %: {covered} of the reference",
            f"boundary offset, median and 95 %: {edge['median']:.2f} m, {edge['p95']:.2f} m",
            "",
        ]
    return "\n".join(lines)


def _percent(value: float) -> str:
    return "" if math.isnan(value) else f"{100 * value:.1f} %"


def to_json(value: Any) -> Any:
    """Return figures with None (null) in place of NaN."""
    if isinstance(value, dict):
        return {name: to_json(each) for name, each in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value
