"""Compare objects of two vector files: as objects, by area, by boundary; trees by place and height.

python benchmarks/object_accuracy.py FOUND REFERENCE [--area FILE]

Layers named `buildings` and `trees`, or a file's only layer, are compared; coordinates in meters.
Complete is the share of the reference that was found, correct the share of found objects that are
in the reference, F1 their harmonic mean. --area: polygons in which the reference is complete.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import pyogrio
import scipy
import shapely

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


def match_by_overlap(found, true, min_iou=MIN_IOU):
    """Pairs (found, true) by intersection over union, each object once."""
    if not len(found) or not len(true):
        return []
    a, b = shapely.STRtree(true).query(found, predicate="intersects")
    shapes, others = np.asarray(found, object)[a], np.asarray(true, object)[b]
    shared = shapely.area(shapely.intersection(shapes, others))
    iou = shared / np.maximum(shapely.area(shapes) + shapely.area(others) - shared, 1e-12)
    return match_greedily(a, b, -iou, iou >= min_iou)


def match_by_place(
    places,
    heights,
    true_places,
    true_heights,
    max_distance=MAX_DISTANCE,
    max_height_error=MAX_HEIGHT_ERROR,
):
    """Pairs (found, true) of trees, the nearest first, each tree once.

    Where the true height is not known (NaN), the place alone decides.
    """
    if not len(places) or not len(true_places):
        return []
    near = scipy.spatial.cKDTree(places).sparse_distance_matrix(
        scipy.spatial.cKDTree(true_places), max_distance, output_type="ndarray"
    )
    a, b = near["i"], near["j"]
    with np.errstate(invalid="ignore"):
        differs = np.abs(heights[a] - true_heights[b]) > max_height_error * true_heights[b]
    return match_greedily(a, b, near["v"], ~differs)


def match_greedily(a, b, cost, allowed):
    pairs, matched = {}, set()
    for n in np.lexsort((b, a, np.round(cost, 9))).tolist():
        if allowed[n] and a[n] not in pairs and b[n] not in matched:
            pairs[int(a[n])] = int(b[n])
            matched.add(int(b[n]))
    return list(pairs.items())


def compare_buildings(found, true):
    """Figures of outlines (polygons, meters) against true ones.

    `boundary` is the distance of places along the true boundary from the found one, of blocks
    (outlines that touch) that match.
    """
    found, true = list(shapely.make_valid(list(found))), list(shapely.make_valid(list(true)))
    whole, whole_true = shapely.union_all(found), shapely.union_all(true)
    shared, areas = whole.intersection(whole_true).area, shapely.area(true)
    covered = shapely.area(shapely.intersection(true, whole)) / np.maximum(areas, 1e-12)
    blocks, true_blocks = shapely.get_parts(whole), shapely.get_parts(whole_true)
    offsets = [np.empty(0)]
    for a, b in match_by_overlap(blocks, true_blocks):
        edge = true_blocks[b].boundary
        places = shapely.line_interpolate_point(edge, np.arange(0.0, edge.length, BOUNDARY_STEP))
        offsets.append(shapely.distance(places, blocks[a].boundary))
    offset = np.concatenate(offsets)
    return {
        "objects": scores(len(match_by_overlap(found, true)), len(found), len(true)),
        "area": {
            "reference": whole_true.area,
            "found": whole.area,
            "completeness": share(shared, whole_true.area),
            "correctness": share(shared, whole.area),
            "iou": share(shared, whole.area + whole_true.area - shared),
        },
        "covered": mean(covered >= COVERED),
        "boundary": {
            "places": len(offset),
            "median": percentile(offset, 50),
            "p95": percentile(offset, 95),
        },
    }


def compare_trees(places, heights, true_places, true_heights):
    """Figures of trees, (n, 2) places and (n,) heights (meters or NaN), against true ones."""
    pairs = match_by_place(places, heights, true_places, true_heights)
    a, b = np.array(pairs, np.int64).reshape(-1, 2).T
    distance = np.hypot(*(places[a] - true_places[b]).T)
    error = heights[a] - true_heights[b]
    error = error[~np.isnan(error)]
    return {
        "objects": scores(len(pairs), len(heights), len(true_heights)),
        "place": {"median": percentile(distance, 50)},
        "height": {"bias": mean(error), "rmse": float(np.sqrt(mean(error**2)))},
    }


def scores(matched, found, true):
    return {
        "reference": true,
        "found": found,
        "completeness": share(matched, true),
        "correctness": share(matched, found),
        "matched": matched,
        "f1": share(2 * matched, found + true),
    }


def share(part, whole):
    return part / whole if whole else np.nan


def mean(values):
    return float(np.mean(values)) if len(values) else np.nan


def percentile(values, percent):
    return float(np.percentile(values, percent)) if len(values) else np.nan


def read(path, name):
    """The geometries of a layer, and heights (NaN without a column `height`); None if missing."""
    layers = [layer for layer, _ in pyogrio.list_layers(path)]
    if name not in layers and len(layers) > 1:
        return None
    about, _, wkb, values = pyogrio.raw.read(path, layer=name if name in layers else layers[0])
    shapes = shapely.force_2d(shapely.from_wkb(wkb))
    points = shapely.get_type_id(shapes) == shapely.GeometryType.POINT
    if points.any() != (name == "trees"):
        return None
    columns = dict(zip(about["fields"], values, strict=True))
    return shapes, np.asarray(columns.get("height", np.full(len(shapes), np.nan)), float)


def clip(layer, area):
    """The objects of a layer that lie in an area by at least half."""
    shapes, heights = layer
    inside = shapely.area(shapely.intersection(shapes, area)) >= MIN_SHARE_INSIDE * shapely.area(
        shapes
    )
    inside &= shapely.intersects(shapes, area)
    return shapes[inside], heights[inside]


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("found", type=Path)
    parser.add_argument("reference", type=Path)
    parser.add_argument("--area", type=Path)
    options = parser.parse_args()
    figures = {}
    for name in ("buildings", "trees"):
        both = read(options.found, name), read(options.reference, name)
        if both[0] is None or both[1] is None:
            continue
        both = [(shapely.make_valid(shapes), heights) for shapes, heights in both]
        if options.area:
            area = shapely.union_all(shapely.make_valid(read(options.area, "buildings")[0]))
            both = [clip(layer, area) for layer in both]
        if name == "buildings":
            figures[name] = compare_buildings(both[0][0], both[1][0])
        else:
            (shapes, heights), (true, true_heights) = both
            places, true_places = (shapely.get_coordinates(each) for each in (shapes, true))
            figures[name] = compare_trees(places, heights, true_places, true_heights)
    print(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
