"""Trees of closed forests against stem maps and trees told apart by hand.

python benchmarks/trees.py FOLDER [--part chosen|scored] [--others]

FOLDER holds, as far as they are there,
- clouds NAME_als_veg.laz in which each point has the number of its tree (`itc_ref`, from
terrestrial scans), published with
  Xi, Hopkinson, Chasmer 2024 (ISPRS Journal of Photogrammetry and Remote Sensing 209, 324-343), MIT
  license;
- Demo_Data_1ha_Traunstein.rda, heights above the ground and mapped stems of a hectare of mixed
forest, from the package
  MeanShiftR (Knapp, Fischer, Huth 2018, Remote Sensing of Environment 205, 424-437); it needs `pip
  install rdata`.

A found tree and a true one are a pair within 4 m and 30 % of height (beside it: 2 m and 15 %), the
nearest first, each once; trees are those of 5 m or more (Traunstein: of stems of 10 cm or more) in
the hull of the true ones. True heights are those of the trees' highest points; in Traunstein they
are guessed from diameters (Naeslund's curve), so there the stricter match says little. `--others`
adds methods of other kinds, each with the settings that were best for the chosen plots.
"""

from __future__ import annotations

import argparse
import itertools
import time
from pathlib import Path
from typing import NamedTuple

import laspy
import numpy as np
import scipy
import shapely
from object_accuracy import match_by_place

from pdal_stages import Cells, ObjectSettings, find_objects
from pdal_stages.objects.cells import Kind
from pdal_stages.objects.crowns import canopy

#: Plots by which settings were chosen, and those that were only scored; points/m2 where they are
#: thinned, or None.
PARTS = {
    "chosen": {"LPine1": 15, "LPine4": None, "LPine5": None, "RPine": None, "Traunstein south": None},
    "scored": {"LPine2": 15, "LPine3": None, "LPine6": None, "LPine7": None, "SMaple": None, "TAspen": None,
               "Traunstein north": None},
}  # fmt: skip
LEAST = 5.0
TOLERANCES = ((4.0, 0.3), (2.0, 0.15))
#: Layers of trees by their share of the height that a tenth of the stand's trees have.
LAYERS = (0.0, 0.5, 0.75, 0.9, np.inf)


class Plot(NamedTuple):
    xyz: np.ndarray
    height: np.ndarray  # of points above the ground
    true: np.ndarray  # x, y, height, diameter in cm or NaN
    area: shapely.Geometry

    @property
    def codes(self):
        return np.where(self.height < 0.4, 2, np.where(self.height > 2.0, 5, 1)).astype(np.uint8)

    @property
    def cells(self):
        cells = Cells.from_points(*self.xyz.T, self.codes, 0.5)
        while cells.sparse_kind():
            cells = cells.doubled()
        return cells

    def canopy(self, low=2.0):
        """Points of vegetation; heights above the ground."""
        above = self.height >= low
        return np.column_stack([self.xyz[above, :2], self.height[above]])


def labeled(path, density=None):
    """A plot of a cloud whose points have the number of their tree."""
    las = laspy.read(path)
    xyz, tree = las.xyz.copy(), np.asarray(las["itc_ref"])
    cell, inverse = np.unique(np.floor(xyz[:, :2] / 2), axis=0, return_inverse=True)
    low = np.full(len(cell), np.inf)
    np.minimum.at(low, inverse.ravel(), xyz[:, 2])
    _, near = scipy.spatial.cKDTree(2 * cell + 1).query(xyz[:, :2], k=5)
    height = xyz[:, 2] - np.median(low[near], axis=1)
    each = [tree == n for n in np.unique(tree[tree > 0])]
    true = np.array(
        [[*xyz[members, :2].mean(axis=0), height[members].max(), np.nan] for members in each]
    )
    true = true[true[:, 2] >= LEAST]
    kept = np.ones(len(xyz), bool)
    if density:
        kept = np.random.default_rng(0).random(len(xyz)) < density * np.prod(
            np.ptp(xyz[:, :2], 0)
        ) / len(xyz)
    return Plot(
        xyz[kept], height[kept], true, shapely.MultiPoint(true[:, :2]).convex_hull.buffer(1.0)
    )


def traunstein(path, south):
    import rdata

    data = rdata.read_rda(path)
    points, stems = (
        data["lid.dt"].to_numpy(float)[:, :3],
        data["inv.dt"][["X", "Y", "DBH"]].to_numpy(float),
    )
    dbh = 100 * stems[:, 2]
    true = np.column_stack([stems[:, :2], 1.3 + dbh**2 / (1.7 + 0.15 * dbh) ** 2, dbh])
    area = shapely.box(0, 0, 100, 50) if south else shapely.box(0, 50, 100, 100)
    true = true[(dbh >= 10) & shapely.intersects_xy(area, *true[:, :2].T)]
    return Plot(points, points[:, 2].copy(), true, area)


def package(plot):
    """x, y and height of the trees that `pdal-stages objects` finds."""
    cells = plot.cells
    columns = (
        find_objects(cells, ObjectSettings(cell=cells.size), progress=False)
        .tables[Kind.TREE]
        .columns
    )
    return np.column_stack([columns[name] for name in ("x", "y", "height")])


def windows(plot, base=0.8, slope=0.03):
    """Points that are the highest within a radius that grows with height (Popescu, Wynne 2004)."""
    points = plot.canopy()
    near = scipy.spatial.cKDTree(points[:, :2]).query_ball_point(
        points[:, :2], base + slope * points[:, 2]
    )
    return points[[points[n, 2] >= points[neighbors, 2].max() for n, neighbors in enumerate(near)]]


def li(plot, low=1.0, high=1.5, above=15.0, most=10.0):
    """Growing point by point from the top down (Li, Guo, Jakubowski, Kelly 2012); `low`, `high`:
    spacing of trees."""
    points = plot.canopy()
    points, tops = points[np.argsort(-points[:, 2], kind="stable")], []
    while len(points):
        tops.append(points[0])
        near = np.flatnonzero(np.hypot(*(points[:, :2] - points[0, :2]).T) < most)
        members = points[near]
        neighbors = scipy.spatial.cKDTree(members[:, :2]).query_ball_point(members[:, :2], high)
        highest = np.array([members[n, 2] >= members[a, 2].max() for n, a in enumerate(neighbors)])
        inside, outside = [0], [members[0, :2] + 100.0]
        for n in range(1, len(members)):
            to_tree = np.hypot(*(members[inside, :2] - members[n, :2]).T).min()
            to_rest = np.hypot(*(np.array(outside) - members[n, :2]).T).min()
            spacing = high if members[n, 2] > above else low
            if to_tree <= to_rest and not (highest[n] and to_tree > spacing):
                inside.append(n)
            else:
                outside.append(members[n, :2])
        points = np.delete(points, near[inside], axis=0)
    return np.array(tops)


def mean_shift(plot, wide=0.2, deep=0.4, apart=1.0):
    """Modes under a kernel that grows with height (Ferraz and others 2016); one point a voxel of
    0.5 m."""
    points = plot.canopy()
    _, first = np.unique(np.floor(points / 0.5), axis=0, return_index=True)
    points = points[np.sort(first)]
    tree, modes = scipy.spatial.cKDTree(points[:, :2]), points.copy()
    for n, mode in enumerate(modes):
        for _ in range(20):
            radius, depth = mode[2] * wide / 2, mode[2] * deep
            near = points[tree.query_ball_point(mode[:2], radius)]
            low, high = mode[2] - depth / 4, mode[2] + 3 * depth / 4
            near = near[(near[:, 2] >= low) & (near[:, 2] <= high)]
            if not len(near):
                break
            edge = np.minimum(near[:, 2] - low, high - near[:, 2]) / (depth / 2)
            away = ((near[:, :2] - mode[:2]) ** 2).sum(axis=1) / radius**2
            weight = np.exp(-5 * away) * (1 - (1 - edge) ** 2)
            if not weight.sum():
                break
            moved = weight @ near / weight.sum()
            step, mode = np.abs(moved - mode).sum(), moved
            if step < 0.02:
                break
        modes[n] = mode
    pairs = scipy.spatial.cKDTree(modes * [1, 1, 0.5]).query_pairs(apart, output_type="ndarray")
    graph = scipy.sparse.coo_array((np.ones(len(pairs)), pairs.T), (len(points), len(points)))
    _, group = scipy.sparse.csgraph.connected_components(graph, directed=False)
    trees = [points[group == n] for n in np.flatnonzero(np.bincount(group) >= 3)]
    return np.array([[*p[:, :2].mean(axis=0), p[:, 2].max()] for p in trees])


def raster(points, size):
    corner = np.floor(points[:, :2].min(axis=0) - 6)
    at = tuple(((points[:, :2] - corner) / size).astype(int).T)
    high = np.zeros(np.max(at, axis=1) + round(6 / size))
    np.maximum.at(high, at, points[:, 2])
    return high, corner, at


def peaks(image, high, corner, size, radius):
    """Places where an image is positive and highest within a radius, with the canopy's height
    there."""
    r, c = np.indices((2 * int(np.ceil(radius)) + 1,) * 2) - int(np.ceil(radius))
    top = (image > 0) & (
        image == scipy.ndimage.maximum_filter(image, footprint=r * r + c * c <= radius * radius)
    )
    at = np.argwhere(top)
    return np.column_stack([corner + (at + 0.5) * size, scipy.ndimage.maximum_filter(high, 3)[top]])


def layers(plot, size=0.5, sigma=0.4, radius=1.0, reach=0.6):
    """Maxima of how many layers of 1 m there is vegetation in (Ayrey and others 2017)."""
    points = plot.canopy(1.0)
    high, corner, at = raster(points, size)
    stack, level = np.zeros(high.shape), np.floor(points[:, 2] - 0.5)
    for label in np.unique(level):
        free = np.ones(high.shape, bool)
        free[at[0][level == label], at[1][level == label]] = False
        stack += scipy.ndimage.distance_transform_edt(free) * size <= reach
    return peaks(
        scipy.ndimage.gaussian_filter(stack, sigma / size), high, corner, size, radius / size
    )


def curvature(plot, sigma=1.0, radius=1.5, least=0.1):
    """Maxima of the canopy's smallest curvature (FGI_MCV in Kaartinen and others 2012)."""
    size = plot.cells.size
    high, corner, _ = raster(plot.canopy(0.0), size)
    high = canopy(high, np.zeros(high.shape))
    xx, yy, xy = (
        scipy.ndimage.gaussian_filter(high, sigma / size, order)
        for order in ((2, 0), (0, 2), (1, 1))
    )
    smallest = -((xx + yy) / 2 + np.hypot((xx - yy) / 2, xy)) * (sigma / size) ** 2
    return peaks(np.where(smallest > least, smallest, 0), high, corner, size, radius / size)


OTHERS = (windows, li, mean_shift, layers, curvature)


def f1(pairs, found, true):
    return 2 * pairs / max(found + true, 1)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--part", choices=PARTS, default="chosen")
    parser.add_argument("--others", action="store_true")
    options = parser.parse_args()
    plots = {}
    for name, density in PARTS[options.part].items():
        demo, cloud = (
            options.folder / "Demo_Data_1ha_Traunstein.rda",
            options.folder / f"{name}_als_veg.laz",
        )
        if name.startswith("Traunstein") and demo.exists():
            plots[name] = traunstein(demo, name.endswith("south"))
        elif cloud.exists():
            plots[name] = labeled(cloud, density)
    for method in (package, *(OTHERS if options.others else ())):
        rows, layered = [], []
        started = time.process_time()
        for name, plot in plots.items():
            tops, true = method(plot), plot.true
            tops = tops[shapely.contains_xy(plot.area, *tops[:, :2].T) & (tops[:, 2] >= LEAST)]
            matched = [
                match_by_place(tops[:, :2], tops[:, 2], true[:, :2], true[:, 2], *by)
                for by in TOLERANCES
            ]
            rows.append([f1(len(pairs), len(tops), len(true)) for pairs in matched])
            a, b = np.array(matched[0], int).reshape(-1, 2).T
            hit = np.isin(np.arange(len(true)), b)
            layered.append(np.column_stack([true[:, 2] / np.percentile(true[:, 2], 90), hit]))
            if method is package:
                print(
                    f"{name}: {len(true) / plot.area.area * 1e4:.0f} trees/ha, "
                    f"{len(plot.xyz) / np.prod(np.ptp(plot.xyz[:, :2], axis=0)):.1f} points/m2, "
                    f"{len(true)} true, "
                    f"{len(tops)} found, {len(a)} pairs: precision "
                    f"{len(a) / max(len(tops), 1):.2f}, "
                    f"recall {hit.mean():.2f}, F1 {rows[-1][0]:.2f} ({rows[-1][1]:.2f})"
                )
        mean = np.mean(rows, axis=0)
        print(
            f"{method.__name__}: mean F1 {mean[0]:.3f} ({mean[1]:.3f}); "
            f"{time.process_time() - started:.1f} CPU s"
        )
        if method is package:
            share, hit = np.concatenate(layered).T
            for low, high in itertools.pairwise(LAYERS):
                in_band = (share >= low) & (share < high)
                print(
                    f"  of {in_band.sum()} trees at {low:g} to {high:g} of the top height found: "
                    f"{hit[in_band].mean():.2f}"
                )


if __name__ == "__main__":
    main()
