"""Trees of closed forests on slopes, generated with every tree known, by several methods.

python benchmarks/crowns.py [--seeds 1 2 3] [--grown]

Crowns are cones (conifers) and half ellipsoids whose leaves let pulses through, so what stands below has returns, too.
Trees of 7.5 m or more, 4 m and more from the edge, are matched within 4 m and 30 % of height.
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy.spatial import cKDTree

from pdal_stages.objects import Cells, ObjectSettings, find_objects
from pdal_stages.objects.cells import Kind
from pdal_stages.objects.compare import matched_by_place

SIDE, LEAST, RIM = 70.0, 7.5, 4.0
#: Kind, slope in degrees, pulses per m2, trees per hectare.
STANDS = (
    ("conifers", 25, 8, 550),
    ("conifers", 38, 20, 700),
    ("mixed", 35, 12, 450),
    ("mixed", 20, 5, 420),
    ("mixed", 40, 25, 560),
    ("broadleaves", 30, 10, 320),
)


def planted(rng, kind, per_hectare):
    """Trees (n, 5): x, y, height, crown's radius, whether a conifer; the highest first, lower ones nearer to them."""
    many = int(per_hectare * SIDE**2 / 1e4)
    over = rng.normal(24, 4.5, many)
    heights = np.sort(np.where(rng.random(many) < 0.72, over, rng.uniform(5, 18, many)).clip(4, 38))[::-1]
    trees = np.empty((0, 5))
    for height in heights:
        conifer = kind == "conifers" or (kind == "mixed" and rng.random() < 0.6)
        radius = (0.8 + 0.085 * height) if conifer else (1.2 + 0.12 * height)
        radius *= rng.lognormal(0, 0.15 if conifer else 0.18)
        for _ in range(60):
            x, y = rng.uniform(-5, SIDE + 5, 2)
            apart = np.where(trees[:, 2] < 1.35 * height, 0.62, 0.45) * (trees[:, 3] + radius)
            if (np.hypot(trees[:, 0] - x, trees[:, 1] - y) >= np.maximum(1.2, apart)).all():
                trees = np.vstack([trees, [x, y, height, radius, conifer]])
                break
    return trees


def flown(seed, kind, slope, density, per_hectare, step=0.25):
    """Points (n, 3), their classes, heights above the ground, and the trees."""
    rng = np.random.default_rng(seed)
    rise = np.tan(np.radians(slope)) * np.array([np.cos(seed), np.sin(seed)])
    phase = rng.uniform(0, 2 * np.pi, 4)

    def ground(x, y):
        rough = 1.5 * np.sin(x / 11 + phase[0]) * np.cos(y / 13 + phase[1])
        return (
            500
            + rise[0] * x
            + rise[1] * y
            + rough
            + 0.6 * np.sin(x / 4 + phase[2]) * np.sin(y / 5 + phase[3])
        )

    trees = planted(rng, kind, per_hectare)
    foot, near = ground(trees[:, 0], trees[:, 1]), cKDTree(trees[:, :2])
    many = rng.poisson(density * (SIDE + 10) ** 2)
    x0, y0 = rng.uniform(-5, SIDE + 5, (2, many))
    lean, z0 = np.tan(np.radians(rng.uniform(-18, 18, many))), ground(x0, y0)
    left, last, returns = np.ones(many), np.full(many, np.inf), np.zeros(many, int)
    alive, made = np.ones(many, bool), []
    for above in np.arange(trees[:, 2].max() + 14, -3.0, -step):
        on = np.flatnonzero(alive)
        x, y, z = x0[on] + 0.54 * lean[on] * above, y0[on] + 0.84 * lean[on] * above, z0[on] + above
        leaves = np.zeros(len(on))
        away, which = near.query(np.column_stack([x, y]), k=7, distance_upper_bound=7.0)
        for d, tree in zip(away.T, which.T, strict=True):
            seen = np.isfinite(d)
            _, _, height, radius, conifer = trees[tree[seen]].T
            up, d = z[seen] - foot[tree[seen]], d[seen]
            base = height * np.where(conifer > 0, 0.3, 0.4)
            depth = np.clip((height - up) / (height - base), 0, 1)
            round_top = np.sqrt(1 - (1 - np.clip(1.6 * depth, 0, 1)) ** 2)
            wide = radius * np.where(conifer > 0, depth**0.8, round_top)
            inside = (up <= height) & (up >= base) & (d <= wide)
            thick = np.where(inside, np.where(d >= 0.55 * wide, 0.55, 0.18), 0.0)
            stem = (up < base) & (up > 0) & (d < 0.012 * height)
            leaves[seen] = np.maximum(leaves[seen], np.where(stem, 3.0, thick))
        low = ground(x, y) >= z
        hit = low | (rng.random(len(on)) < 1 - np.exp(-1.6 * step * leaves))
        apart = hit & (low | (last[on] - z > 1.0))
        z = np.where(low, ground(x, y), z)
        hag = z - ground(x, y)
        made.append(
            np.column_stack([x, y, z + rng.normal(0, 0.03, len(on)), np.where(low, 2, 5), hag])[apart]
        )
        last[on[apart]] = z[apart]
        returns[on[apart]] += 1
        left[on[hit]] *= rng.uniform(0.25, 0.75, np.count_nonzero(hit))
        alive[on[low]] = False
        alive &= (returns < 5) & (left > 0.12)
    points = np.concatenate(made)
    points = points[((points[:, :2] >= 0) & (points[:, :2] <= SIDE)).all(axis=1)]
    return (
        points[:, :3],
        np.where((points[:, 3] == 5) & (points[:, 4] < 0.5), 3, points[:, 3]).astype(np.uint8),
        points[:, 4],
        trees,
    )


def ours(xyz, codes, above, **settings):
    """Places and heights by ``filters.objects``."""
    found = find_objects(Cells.of(*xyz.T, codes, 0.5), ObjectSettings(**settings), progress=False)
    table = found.tables[Kind.TREE].columns
    return np.column_stack([table["x"], table["y"]]), table["height"]


def grown(xyz, codes, above, near=1.5, far=2.0, high=15.0, radius=2.0):
    """The same by growing crowns point by point from the highest down (Li, Guo, Jakubowski, Kelly 2012).

    Of the highest point of each half meter.
    """
    high_enough = (codes == 5) & (above > 2)
    points = np.column_stack([xyz[high_enough, :2], above[high_enough]])
    points = points[np.argsort(-points[:, 2], kind="stable")]
    _, first = np.unique(np.floor(points / 0.5), axis=0, return_index=True)
    points = points[np.sort(first)]
    beside = cKDTree(points[:, :2]).query_ball_point(points[:, :2], radius)
    peak = np.array([points[n, 2] >= points[m, 2].max() for n, m in enumerate(beside)])
    tops = []
    while len(points):
        mine, others = [points[0, :2]], [points[0, :2] + 100.0]
        taken = [0]
        for n in np.flatnonzero(np.hypot(*(points[:, :2] - points[0, :2]).T) <= 10.0)[1:]:
            to_mine = np.hypot(*(np.array(mine) - points[n, :2]).T).min()
            to_others = np.hypot(*(np.array(others) - points[n, :2]).T).min()
            most = far if points[n, 2] > high else near
            if to_mine <= to_others and (to_mine <= most or not peak[n]):
                taken.append(n)
                mine = [*mine, points[n, :2]][:160]
            else:
                others = [*others, points[n, :2]][:400]
        if len(taken) >= 8:
            tops.append(points[0])
        points, peak = np.delete(points, taken, axis=0), np.delete(peak, taken)
    return np.array(tops)[:, :2], np.array(tops)[:, 2]


def scored(places, heights, trees):
    """Completeness, correctness and F1."""
    true = trees[trees[:, 2] >= LEAST]
    pairs = matched_by_place(places, heights, true[:, :2], true[:, 2])

    def inner(xy):
        return ((xy > RIM) & (xy < SIDE - RIM)).all(axis=1)

    of_true, of_found = inner(true[:, :2]), inner(places) & (heights >= LEAST)
    complete = sum(of_true[b] for _, b in pairs) / of_true.sum()
    correct = sum(of_found[a] for a, _ in pairs) / max(of_found.sum(), 1)
    return complete, correct, 2 * complete * correct / max(complete + correct, 1e-9)


METHODS = {
    "canopy maxima, basins joined (filters.objects)": ours,
    "the same, narrower window": lambda *cloud: ours(*cloud, window=1.0, window_slope=0.05),
    "the same, marker-controlled watershed without joining": lambda *cloud: ours(
        *cloud, saddle=0.0, smoothing=0.6
    ),
    "growing point by point (Li and others 2012)": grown,
}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="*", default=[1, 2, 3])
    parser.add_argument("--grown", action="store_true", help="Also by growing point by point: minutes")
    options = parser.parse_args()
    for seed in options.seeds:
        scores = {name: [] for name in METHODS}
        for number, stand in enumerate(STANDS):
            *cloud, trees = flown(100 * number + seed, *stand)
            for name, method in METHODS.items():
                if method is grown and (not options.grown or stand[2] > 12):  # minutes
                    continue
                scores[name].append(scored(*method(*cloud), trees))
                print(f"{seed} {stand}: {name}: {np.round(scores[name][-1], 2)}", flush=True)
        for name, rows in scores.items():
            if rows:
                print(
                    f"seed {seed}, mean of {len(rows)} stands: {name}: {np.round(np.mean(rows, axis=0), 3)}"
                )
