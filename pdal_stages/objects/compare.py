"""Objects against a reference: as objects, by area, by boundary; trees by place and height.

Completeness is the share of the reference that was found, correctness the share of what was found that is in the reference,
quality their harmonic mean (F1). Coordinates are meters.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from .outlines import vector

#: Buildings are told apart by area, m2, and trees by height, m.
AREAS = (0.0, 25.0, 100.0, 500.0, np.inf)
HEIGHTS = (0.0, 5.0, 10.0, 20.0, np.inf)
#: Boundaries are compared at places so far apart, meters.
EVERY = 0.5

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
        match: median and 95th percentile, meters), and which were ``matched``.
    """
    shapely = vector("shapely")
    found, true = list(shapely.make_valid(list(found))), list(shapely.make_valid(list(true)))
    whole_found, whole_true = shapely.union_all(found), shapely.union_all(true)
    shared = whole_found.intersection(whole_true).area
    parts = shapely.area(shapely.intersection(true, whole_found)) / np.maximum(shapely.area(true), 1e-12)
    blocks, true_blocks = shapely.get_parts(whole_found), shapely.get_parts(whole_true)
    offsets = [np.empty(0)]
    for a, b in matched_by_overlap(blocks, true_blocks):
        edge = true_blocks[b].boundary
        places = shapely.line_interpolate_point(edge, np.arange(0.0, edge.length, EVERY))
        offsets.append(shapely.distance(places, blocks[a].boundary))
    away = np.concatenate(offsets)
    return {
        **_scores(matched_by_overlap(found, true), shapely.area(found), shapely.area(true), AREAS, "m2"),
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
    """Scores of all objects and of those of a size, and which were matched; `found` and `true` are sizes."""
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
    return {"objects": objects, "sizes": sizes, "matched": pairs}


def _share(part: float, whole: float) -> float:
    return part / whole if whole else np.nan


def _mean(values: NDArray) -> float:
    return float(np.mean(values)) if len(values) else np.nan
