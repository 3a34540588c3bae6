"""Objects against a reference: as objects, by area, by boundary; trees by place and height.

Completeness is the share of the reference that was found, correctness the share of what was found that is in the reference,
quality their harmonic mean (F1). Coordinates are meters.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .outlines import vector

#: Buildings are told apart by area, m2, and trees by height, m.
AREAS = (0.0, 25.0, 100.0, 500.0, np.inf)
HEIGHTS = (0.0, 5.0, 10.0, 20.0, np.inf)
#: Boundaries are compared at places so far apart, meters.
EVERY = 0.5


def _scores(true: int, found: int, matched: int) -> dict[str, float]:
    complete = matched / true if true else float("nan")
    correct = matched / found if found else float("nan")
    total = true + found
    return {
        "reference": true,
        "found": found,
        "matched": matched,
        "completeness": complete,
        "correctness": correct,
        "f1": 2 * matched / total if total else float("nan"),
    }


def matched_by_overlap(
    found: Sequence[Any], true: Sequence[Any], least: float = 0.5
) -> list[tuple[int, int]]:
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
) -> list[tuple[int, int]]:
    """Pairs (found, true) of trees within `away` meters whose heights differ by at most a `share` of the true one.

    The nearest first, each once. Where the true height is not known (NaN) the place alone decides.
    """
    from scipy.spatial import cKDTree

    if not len(found) or not len(true):
        return []
    near = cKDTree(true).query_ball_point(found, away)
    a = np.repeat(np.arange(len(found)), [len(n) for n in near])
    b = np.array([m for n in near for m in n], np.int64)
    distance = np.hypot(*(found[a] - true[b]).T)
    with np.errstate(invalid="ignore"):
        unlike = np.abs(found_height[a] - true_height[b]) > share * true_height[b]
    return _each_once(a, b, distance, ~unlike)


def _each_once(a: NDArray, b: NDArray, cost: NDArray, allowed: NDArray[np.bool_]) -> list[tuple[int, int]]:
    pairs: list[tuple[int, int]] = []
    one: set[int] = set()
    other: set[int] = set()
    for n in np.lexsort((b, a, np.round(cost, 9))).tolist():
        if allowed[n] and a[n] not in one and b[n] not in other:
            one.add(int(a[n]))
            other.add(int(b[n]))
            pairs.append((int(a[n]), int(b[n])))
    return pairs


def compare_buildings(found: Sequence[Any], true: Sequence[Any]) -> dict[str, Any]:
    """Figures of outlines (shapely polygons, meters) against true ones.

    Returns
    -------
    dict
        ``objects`` (matched at an intersection over union of 0.5), ``sizes`` (the same by area), ``area`` (completeness,
        correctness and intersection over union of all area), ``covered`` (the share of true outlines of which found ones
        cover at least 80 %), ``boundary`` (how far places along the true boundary lie from the found one, of blocks that
        match: median and 95th percentile, meters), and which were matched.
    """
    shapely = vector("shapely")
    found, true = [shapely.make_valid(s) for s in found], [shapely.make_valid(s) for s in true]
    pairs = matched_by_overlap(found, true)
    whole_found, whole_true = shapely.union_all(found), shapely.union_all(true)
    shared = whole_found.intersection(whole_true).area
    union = whole_found.area + whole_true.area - shared
    parts = shapely.area(shapely.intersection(true, whole_found)) / np.maximum(shapely.area(true), 1e-12)
    sizes = {}
    for low, high in itertools.pairwise(AREAS):
        of_true = [n for n, s in enumerate(true) if low <= s.area < high]
        of_found = [n for n, s in enumerate(found) if low <= s.area < high]
        sizes[_range(low, high, "m2")] = {
            "reference": len(of_true),
            "found": len(of_found),
            "completeness": _share(of_true, {b for _, b in pairs}),
            "correctness": _share(of_found, {a for a, _ in pairs}),
        }
    offsets = boundary_offsets(list(shapely.get_parts(whole_found)), list(shapely.get_parts(whole_true)))
    return {
        "objects": _scores(len(true), len(found), len(pairs)),
        "sizes": sizes,
        "area": {
            "reference": whole_true.area,
            "found": whole_found.area,
            "completeness": shared / whole_true.area if whole_true.area else float("nan"),
            "correctness": shared / whole_found.area if whole_found.area else float("nan"),
            "iou": shared / union if union else float("nan"),
        },
        "covered": float(np.mean(parts >= 0.8)) if len(true) else float("nan"),
        "boundary": {
            "places": len(offsets),
            "median": float(np.median(offsets)) if len(offsets) else float("nan"),
            "p95": float(np.percentile(offsets, 95)) if len(offsets) else float("nan"),
        },
        "matched": pairs,
    }


def boundary_offsets(found: Sequence[Any], true: Sequence[Any]) -> NDArray[np.float64]:
    """How far places along the boundaries of true blocks lie from those of the blocks that match them, meters."""
    shapely = vector("shapely")
    out = [np.empty(0)]
    for a, b in matched_by_overlap(found, true):
        edge = true[b].boundary
        places = shapely.line_interpolate_point(edge, np.arange(0.0, edge.length, EVERY))
        out.append(shapely.distance(places, found[a].boundary))
    return np.concatenate(out)


def compare_trees(
    found: NDArray, found_height: NDArray, true: NDArray, true_height: NDArray
) -> dict[str, Any]:
    """Figures of trees, (n, 2) places and (n,) heights in meters, against true ones; heights may be NaN."""
    pairs = matched_by_place(found, found_height, true, true_height)
    a, b = (np.array([p[k] for p in pairs], np.int64) for k in (0, 1))
    away = np.hypot(*(found[a] - true[b]).T) if pairs else np.empty(0)
    higher = (found_height[a] - true_height[b])[~np.isnan(true_height[b])] if pairs else np.empty(0)
    sizes = {}
    for low, high in itertools.pairwise(HEIGHTS):
        of_true = np.flatnonzero((true_height >= low) & (true_height < high)).tolist()
        of_found = np.flatnonzero((found_height >= low) & (found_height < high)).tolist()
        sizes[_range(low, high, "m")] = {
            "reference": len(of_true),
            "found": len(of_found),
            "completeness": _share(of_true, set(b.tolist())),
            "correctness": _share(of_found, set(a.tolist())),
        }
    return {
        "objects": _scores(len(true), len(found), len(pairs)),
        "sizes": sizes,
        "place": {"median": float(np.median(away)) if len(away) else float("nan")},
        "height": {
            "bias": float(higher.mean()) if len(higher) else float("nan"),
            "rmse": float(np.sqrt((higher**2).mean())) if len(higher) else float("nan"),
        },
        "matched": pairs,
    }


def _share(these: list[int], hit: set[int]) -> float:
    return len(hit.intersection(these)) / len(these) if these else float("nan")


def _range(low: float, high: float, unit: str) -> str:
    return f"{low:g} to {high:g} {unit}" if np.isfinite(high) else f"{low:g} {unit} and more"
