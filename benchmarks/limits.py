"""What the machine could do at best, and how far the kernels are from it: operations and bytes of each part of a job.

    python benchmarks/limits.py                                # a generated town, 500,000 points, 7 per square meter
    python benchmarks/limits.py --cloud delft --json FILE      # a real cloud, from PDAL_STAGES_DATA

The bounds are measured here, on one core, by loops that do nothing else:

- *bytes*: copying arrays much larger than the caches; read and written bytes count.
- *sums*: adding the ten moments of points that lie in order in the first cache, with their distance from a query: what a
  neighbor cannot cost less than, were all neighbors found and lined up for nothing.
- *nodes*: walking one tree that fits the first cache, eight rows at a time.

What a part needs is counted on the cloud: neighbors by SciPy's kd-tree round a sample of the points, visited nodes in the
forest's own trees, bytes from the sizes of what must be read and written once. Its bound is the larger of the two times.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from features import TWELVE, load, machine, ours
from forests import Forests, clocked
from numba import njit
from scipy.spatial import cKDTree

from pdal_stages.classifier.forest import Forest
from pdal_stages.features import FeatureEngine, FeaturePlan

SAMPLE = 2_000


def best(work: Callable[[], object], repeats: int = 5) -> float:
    """CPU seconds, the least of some runs after one that compiles."""
    work()
    return min(clocked(work)[0] for _ in range(repeats))


# ---- what the machine can do -------------------------------------------------------------------------------


def bytes_per_second() -> float:
    source = np.ones(1 << 25)
    target = np.empty_like(source)
    return 2 * source.nbytes / best(lambda: np.copyto(target, source))


@njit(fastmath=True)
def add_moments(x, y, z, queries, radius):
    """Ten moments of points within a radius of queries, all of which lie in the first cache."""
    n = sx = sy = sz = xx = xy = xz = yy = yz = zz = 0.0
    for q in range(queries):
        for j in range(len(x)):
            dx, dy, dz = x[j] - q, y[j] - q, z[j] - q
            inside = 1.0 if dx * dx + dy * dy + dz * dz <= radius else 0.0
            dx, dy, dz = dx * inside, dy * inside, dz * inside
            n += inside
            sx, sy, sz = sx + dx, sy + dy, sz + dz
            xx, xy, xz = xx + dx * dx, xy + dx * dy, xz + dx * dz
            yy, yz, zz = yy + dy * dy, yz + dy * dz, zz + dz * dz
    return n + sx + sy + sz + xx + xy + xz + yy + yz + zz


def sums_per_second() -> float:
    x, y, z = np.random.default_rng(0).random((3, 512))
    return 512 * 4_000 / best(lambda: add_moments(x, y, z, 4_000, 1e6))


def nodes_per_second() -> float:
    """Of a full tree of eight levels over eight features, walked by rows that lie in the first cache."""
    depth, features, rows = 8, 8, 256
    splits = (1 << depth) - 1
    random = np.random.default_rng(0)
    feature = np.append(random.integers(0, features, splits), np.full(splits + 1, -1)).astype(np.int16)
    threshold = np.append(random.random(splits), np.zeros(splits + 1)).astype(np.float32)
    leaves = np.ones((splits + 1, 5), np.uint32)
    trees = 40
    forest = Forest(
        np.full(trees, len(feature), np.int32),
        np.tile(feature, trees),
        np.tile(threshold, trees),
        np.tile(leaves, (trees, 1)),
        features,
    )
    values = random.random((rows, features), np.float32)
    return trees * rows * depth * 50 / best(lambda: [forest.predict_proba(values) for _ in range(50)])


# ---- what parts need ---------------------------------------------------------------------------------------


def neighbors(xyz: np.ndarray, radius: float, axes: int) -> float:
    """Mean number of points within a radius, in 3 axes or in the plane."""
    tree = cKDTree(xyz[:, :axes])
    some = np.random.default_rng(0).choice(len(xyz), min(SAMPLE, len(xyz)), replace=False)
    return float(tree.query_ball_point(xyz[some, :axes], radius, return_length=True).mean())


def visited(forest: Forest, values: np.ndarray) -> float:
    """Mean number of nodes that a row visits in all trees, leaves left out."""
    total, start = 0.0, 0
    for size in forest.tree_sizes:
        feature, threshold = (a[start : start + size] for a in (forest.feature, forest.threshold))
        left = 2 * np.cumsum(feature >= 0) - 1
        at = np.zeros(len(values), np.int64)
        while (on := np.flatnonzero(feature[at] >= 0)).size:
            node = at[on]
            at[on] = left[node] + (values[on, feature[node]] > threshold[node])
            total += len(on) / len(values)
        start += size
    return total


# ---- the table ---------------------------------------------------------------------------------------------


def main() -> None:
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("--cloud", default="town", help="town, delft, montpellier, oakland, or a file")
    options.add_argument("--points", type=int, default=500_000, help="of the town")
    options.add_argument("--density", type=float, default=7.0, help="of the town, per square meter")
    options.add_argument("--json", type=Path)
    given = options.parse_args()
    cloud = load(given.cloud, given.points, given.density)
    xyz, n = cloud.xyz, len(cloud.xyz)
    values, _, forest = Forests(1).of(*cloud)
    rate = {"bytes": bytes_per_second(), "sums": sums_per_second(), "nodes": nodes_per_second()}
    plan = FeaturePlan.parse("s5", "covariance")
    eight = ours("c1,c2,c3,c5,s1,s2,s3,s5", TWELVE, 1)
    four = ours("s5,k10,k20,k50", "covariance,Verticality,HeightRange,HeightStd", 1)
    sphere, cylinder = neighbors(xyz, 5.0, 3), neighbors(xyz, 5.0, 2)
    coordinates, row = 24, 4
    parts = {  # operation, how many a point, bytes a point, what is timed
        # Coordinates are read, keys written, sorted (read and written once at least), coordinates gathered.
        "index": ("", 0.0, 4 * coordinates + 8 + 16, lambda: FeatureEngine(xyz, plan, threads=1)),
        "12 features of eight neighborhoods": (
            "sums",
            cylinder,
            coordinates + 96 * row,
            lambda: eight(xyz, cloud.labels),
        ),
        "11 features of s5 k10 k20 k50": (
            "sums",
            sphere + 50,
            coordinates + 44 * row,
            lambda: four(xyz, cloud.labels),
        ),
        "a forest of 50 trees": (
            "nodes",
            visited(forest, values[:: max(n // SAMPLE, 1)]),
            values.shape[1] * row + 8 * forest.n_classes,
            lambda: forest.predict_proba(values),
        ),
    }
    print(f"{given.cloud}: {n:,} points; {machine()}, one of them used, {time.strftime('%Y-%m-%d')}\n")
    print(
        f"copying {rate['bytes'] / 1e9:.1f} GB/s; {rate['sums'] / 1e9:.2f} neighbors a nanosecond; "
        f"{rate['nodes'] / 1e9:.2f} nodes a nanosecond\n"
    )
    print("| part | operations a point | bytes a point | at best, us | measured, us | times the best |")
    print("|---|---:|---:|---:|---:|---:|")
    found = []
    for name, (what, count, moved, work) in parts.items():
        bound = max(count / rate[what] if what else 0.0, moved / rate["bytes"]) * 1e6
        took = best(work, 3) / n * 1e6
        number = f"{count:,.0f} {what}" if what else ""
        print(f"| {name} | {number} | {moved:,} | {bound:.2f} | {took:.2f} | {took / bound:.1f} |")
        found.append({"part": name, "needs": count, "of": what, "bytes": moved, "best": bound, "took": took})
    if given.json:
        data = {"machine": machine(), "python": platform.python_version(), "rates": rate, "parts": found}
        given.json.write_text(json.dumps(data, indent=1) + "\n")


if __name__ == "__main__":
    main()
