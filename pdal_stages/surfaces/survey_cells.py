"""Reduce the points of a survey to what its report needs: counts of files, and cells."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ..base.asprs import OVERLAP, TERRAIN, WATER
from ..base.distinct import DistinctPoints
from ..base.grid import GridWindow, cell_numbers
from ..base.json_types import JsonObject
from ..tiling.inputs import LonePoints
from ..tiling.jobs import load_arrays, save_arrays
from ..tiling.tile_records import Part
from .cells import EMPTY, STEPS, Integers, steps, usable

#: Of points without times: a first time that is later than all.
NEVER = 1e300


@dataclass(frozen=True)
class ReportRules:
    """Sizes of cells in the unit of the coordinates, and limits."""

    density: float = 10.0  #: side of a cell of density
    void: float = 2.0  #: side of a cell that holds a point, or is a void
    strip: float = 1.0  #: side of a cell in which strips are compared
    picture: float = 1.0  #: side of a pixel
    around_control: float = 10.0  #: ground points are kept within this distance of a control point
    max_slope: float = math.tan(math.radians(10.0))  #: steeper cells tell of shifts in x and y, too
    vertical: float = 1.0  #: unit of z / unit of x and y

    @property
    def sides(self) -> dict[str, float]:
        """Return the sides of the cells of rasters, by their names."""
        return {"density": self.density, "void": self.void, "picture": self.picture}


def describe(part: Mapping[str, NDArray]) -> JsonObject:
    """Return counts, and extents of x, y, z and times, of points as JSON types."""
    codes = part["Classification"]
    overlap = part["Overlap"] != 0 if "Overlap" in part else codes == OVERLAP
    times = _times(part)
    flags = {"last_returns": _is_last(part), "withheld": part["Withheld"], "overlap": overlap}
    counts = {"points": len(codes)} | {name: int(np.sum(flag)) for name, flag in flags.items()}
    counted = {"classes": codes, "returns": part["ReturnNumber"], "sources": part["PointSourceId"]}
    for name, values in counted.items():
        unique, count = np.unique(values, return_counts=True)
        counts |= {f"{name} {v}": n for v, n in zip(unique.tolist(), count.tolist(), strict=True)}
    axes = [*(part[name] for name in "XYZ"), times[np.isfinite(times) & (times != 0)]]
    extent = [[float(v.min(initial=NEVER)), float(v.max(initial=-NEVER))] for v in axes]
    return {"counts": counts, "extent": extent}


def combine(parts: Sequence[JsonObject]) -> JsonObject:
    """Return the description of several parts (:func:`describe`) together."""
    low, high = (pick([part["extent"] for part in parts], axis=0) for pick in (np.min, np.max))
    extent = np.column_stack([low[:, 0], high[:, 1]]).tolist()
    counts: Counter[str] = Counter()
    for part in parts:
        counts.update(part["counts"])
    return {"counts": counts, "extent": extent}


def figures_of(part: JsonObject) -> JsonObject:
    """Return a description as it is reported: counts by class, return and source, in order."""
    out: JsonObject = {"classes": {}, "returns": {}, "sources": {}}
    for key, count in sorted(part["counts"].items(), key=lambda item: (len(item[0]), item[0])):
        name, _, value = key.partition(" ")
        out |= {name: {**out[name], value: count} if value else count}
    *out["extent"], times = part["extent"]
    return {**out, "times": times if times[0] < NEVER else None}


def _times(part: Mapping[str, NDArray]) -> NDArray[np.float64]:
    """Return the GPS times of points (n,), 0 where they are not known."""
    return part["GpsTime"] if "GpsTime" in part else np.zeros(len(part["X"]))


def _is_last(part: Mapping[str, NDArray]) -> NDArray[np.bool_]:
    """Return which points (n,) are the last of their pulse; those without numbers are."""
    return part["ReturnNumber"] >= part["NumberOfReturns"]


def reduce_for_report(
    parts: Sequence[Part], lone: LonePoints, rules: ReportRules, control: NDArray[np.float64]
) -> tuple[dict[str, NDArray], JsonObject]:
    """Reduce points of a tile: files and their dimensions.

    Returns
    -------
    arrays : dict
        For each raster a ``*_window``, a :class:`GridWindow`, and (rows, columns) int64: ``all``
        and ``last`` count points in cells of density; ``void`` is 0 without points, 2 with water,
        else 1; ``picture`` is 256 x height in steps + class of the highest point. ``strips``
        (k, 5) int64: source, column, row, sum of heights in steps, and number of ground points.
        ``control`` (m, 3) int64: ground points near control points (c, 2), in steps.
        Points that are not usable or come twice are left out.
    figures : dict
        ``files``: see :func:`describe`; ``repeated``: points that come twice.
    """
    columns, distinct = [], DistinctPoints()
    for _, part in parts:
        codes = part["Classification"]
        kept = usable(part, lone)
        kept &= distinct.first({**{axis: part[axis] for axis in "XYZ"}, "GpsTime": _times(part)})
        xyz = [steps(part[name]) for name in "XYZ"]
        more = codes, _is_last(part), part["PointSourceId"]
        columns.append(np.column_stack([*xyz, *(np.asarray(v, np.int64) for v in more)])[kept])
    points = np.concatenate([np.empty((0, 6), np.int64), *columns])
    files = {path: describe(part) for path, part in parts}
    figures = {"files": files, "repeated": distinct.repeated}
    x, y, z, codes, last, source = points.T
    values = {
        "all": ("density", np.add, 1, 0),
        "last": ("density", np.add, last, 0),
        "void": ("void", np.maximum, np.where(codes == WATER, 2, 1), 0),
        "picture": ("picture", np.maximum, 256 * z + codes, EMPTY),
    }
    arrays: dict[str, NDArray] = {}
    for name, (cells, merge, value, empty) in values.items():
        window, cell = _cells(x, y, rules.sides[cells])
        raster = np.full(window.width * window.height, empty)
        merge.at(raster, cell, value)
        arrays |= {name: raster.reshape(window.shape), f"{name}_window": np.array(window)}
    ground = np.isin(codes, TERRAIN)
    window, cell = _cells(x[ground], y[ground], rules.strip)
    size = max(1, window.width * window.height)
    both = source[ground] * size + cell
    key, which, count = np.unique(both, return_inverse=True, return_counts=True)
    sums = np.zeros(len(key), np.int64)
    np.add.at(sums, which, z[ground])
    row, column = np.divmod(key % size, max(1, window.width))
    near = np.zeros(np.count_nonzero(ground), bool)
    for place in control * STEPS:
        near |= np.hypot(x[ground] - place[0], y[ground] - place[1]) <= rules.around_control * STEPS
    places = key // size, column + window.left, row + window.bottom
    arrays["strips"] = np.column_stack([*places, sums, count])
    arrays["control"] = points[ground][near][:, :3]
    return arrays, figures


def _numbers(x: Integers, y: Integers, side: float) -> tuple[Integers, Integers]:
    """Return columns and rows of cells of places in steps."""
    column, row = (cell_numbers(values.astype(float), side * STEPS) for values in (x, y))
    return column, row


def _cells(x: Integers, y: Integers, side: float) -> tuple[GridWindow, Integers]:
    """Return the window of the cells of places, and the index of each place in it."""
    if not len(x):
        return GridWindow(0, 0, 0, 0), np.empty(0, np.int64)
    column, row = _numbers(x, y, side)
    window = GridWindow.enclosing(column, row)
    return window, window.flat_index(column, row)


def compare_strips(files: list[str], window: GridWindow, rules: ReportRules, target: str) -> dict:
    """Compare the ground of strips in a window of cells; save and return what differs.

    The arrays are ``differences`` (k, 4) int64: a source, a greater one, the greater one's mean
    height minus the other's in steps, and the number of cells; ``cells`` (m, 4): column and row of
    a cell of density, sum of squares, and number of differences.
    """
    rows = np.concatenate([load_arrays(name, ("strips",))["strips"] for name in files])
    rows = rows[window.padded(1).contains(rows[:, 1], rows[:, 2])]
    held = GridWindow.enclosing(rows[:, 1], rows[:, 2]) if len(rows) else GridWindow(0, 0, 0, 0)
    window = window.intersect(held)  # a tile may be much wider than its points
    around = window.padded(1)
    rows = rows[around.contains(rows[:, 1], rows[:, 2])]
    cell = around.flat_index(rows[:, 1], rows[:, 2])
    mean = _means(rows, cell, around)
    slope = np.hypot(*np.gradient(mean / STEPS, rules.strip)) * rules.vertical
    inner = window.slices_in(around)
    flat = (slope <= rules.max_slope)[inner]
    sources = np.unique(rows[:, 0]).tolist()
    chosen = {source: rows[:, 0] == source for source in sources}
    of_source = {s: _means(rows[own], cell[own], around)[inner] for s, own in chosen.items()}
    differences, cells = [np.empty((0, 4), np.int64)], [np.empty((0, 4), np.int64)]
    for a, b in combinations(sources, 2):
        both = of_source[b] - of_source[a]
        row, column = np.nonzero(np.isfinite(both) & flat)
        if len(row):
            value = np.rint(both[row, column]).astype(np.int64)
            number, count = np.unique(value, return_counts=True)
            differences.append(np.column_stack([0 * number + a, 0 * number + b, number, count]))
            places = column + window.left, row + window.bottom
            x, y = (steps((number + 0.5) * rules.strip) for number in places)
            at = np.column_stack(_numbers(x, y, rules.density))
            cells.append(np.column_stack([at, value**2, 0 * value + 1]))
    arrays = {"differences": _sum_up(differences, 3), "cells": _sum_up(cells, 2)}
    save_arrays(target, arrays)
    return {"cells": int(arrays["differences"][:, 3].sum())}


def _means(rows: Integers, cell: Integers, window: GridWindow) -> NDArray[np.float64]:
    """Return mean heights of cells in steps, NaN for none."""
    total, count = (np.bincount(cell, rows[:, k], window.width * window.height) for k in (3, 4))
    with np.errstate(invalid="ignore"):
        return (total / count).reshape(window.shape)


def _sum_up(parts: Sequence[Integers], keys: int) -> Integers:
    """Return rows with each combination of the first columns once, and the others added."""
    rows = np.concatenate(parts)
    unique, which = np.unique(rows[:, :keys], axis=0, return_inverse=True)
    sums = np.zeros((len(unique), rows.shape[1] - keys), np.int64)
    np.add.at(sums, which.reshape(-1), rows[:, keys:])
    return np.column_stack([unique, sums])
