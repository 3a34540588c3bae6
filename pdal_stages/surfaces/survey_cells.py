"""Reduce the points of a survey to what its report needs: counts of files, and cells."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.asprs import NOISE, OVERLAP, TERRAIN, WATER
from ..base.grid import GridWindow, cell_numbers
from ..tiling.jobs import load_arrays, save_arrays
from .cells import EMPTY, STEPS, Integers, steps


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


def describe(part: Any) -> dict[str, Any]:
    """Return counts, extent and times of points (a laspy record) as JSON types."""
    codes = np.asarray(part.classification)
    names = set(part.point_format.dimension_names)
    flagged = np.asarray(part.overlap, bool) if "overlap" in names else codes == OVERLAP
    times = np.asarray(part.gps_time) if "gps_time" in names else np.zeros(0)
    known = times[np.isfinite(times) & (times != 0)]
    counted = {"classes": codes, "returns": part.return_number, "sources": part.point_source_id}
    extent = [[float(np.min(part[name])), float(np.max(part[name]))] for name in "xyz"]
    return {
        "points": len(codes),
        "last_returns": int(_is_last(part).sum()),
        "withheld": int(np.asarray(part.withheld, bool).sum()),
        "overlap": int(flagged.sum()),
        **{name: _count(np.asarray(values)) for name, values in counted.items()},
        "extent": extent,
        "times": [float(known.min()), float(known.max())] if len(known) else None,
    }


def combine(parts: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the description of several parts (:func:`describe`) together."""
    first, *others = parts
    out = dict(first)
    for part in others:
        for name, value in part.items():
            if isinstance(value, dict):
                out[name] = dict(Counter(out[name]) + Counter(value))
            elif isinstance(value, int):
                out[name] += value
            elif name == "extent":
                both = zip(out[name], value, strict=True)
                out[name] = [[min(a[0], b[0]), max(a[1], b[1])] for a, b in both]
            elif value is not None:
                a = out[name] or value
                out[name] = [min(a[0], value[0]), max(a[1], value[1])]
    return {
        name: dict(sorted(value.items(), key=lambda item: int(item[0])))
        if isinstance(value, dict)
        else value
        for name, value in out.items()
    }


def _count(values: NDArray) -> dict[str, int]:
    """Return how often each value occurs."""
    return {
        str(value): int(n) for value, n in zip(*np.unique(values, return_counts=True), strict=True)
    }


def _is_last(part: Any) -> NDArray[np.bool_]:
    """Return which points (n,) are the last of their pulse; those without numbers are."""
    return np.asarray(part.return_number) >= np.asarray(part.number_of_returns)


def reduce_for_report(
    parts: Sequence[tuple[str, Any]], rules: ReportRules, control: NDArray[np.float64]
) -> tuple[dict[str, NDArray], dict[str, Any]]:
    """Reduce points of a tile: files and their laspy records.

    Returns
    -------
    arrays : dict
        For each raster a ``*_window``, a :class:`GridWindow`, and (rows, columns) int64: ``all``
        and ``last`` count points in cells of density; ``void`` is 0 without points, 2 with water,
        else 1; ``picture`` is 256 x height in steps + class of the highest point. ``strips``
        (k, 5) int64: source, column, row, sum of heights in steps, and number of ground points.
        ``control`` (m, 3) int64: ground points near control points (c, 2), in steps.
        Noise and withheld points are left out.
    figures : dict
        ``files``: see :func:`describe`.
    """
    columns = []
    for _, part in parts:
        codes = np.asarray(part.classification)
        kept = ~np.isin(codes, NOISE) & ~np.asarray(part.withheld, bool)
        xyz = [steps(np.asarray(part[name])) for name in "xyz"]
        more = codes, _is_last(part), np.asarray(part.point_source_id)
        columns.append(np.column_stack([*xyz, *(np.asarray(v, np.int64) for v in more)])[kept])
    points = np.concatenate([np.empty((0, 6), np.int64), *columns])
    figures = {"files": {path: describe(part) for path, part in parts}}
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
    key, which, count = np.unique(
        source[ground] * size + cell, return_inverse=True, return_counts=True
    )
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


def compare_strips(
    files: Sequence[str], window: GridWindow, rules: ReportRules, target: str
) -> dict:
    """Compare the ground of strips in a window of cells; save and return what differs.

    The arrays are ``differences`` (k, 4) int64: a source, a greater one, the greater one's mean
    height minus the other's in steps, and the number of cells; ``cells`` (m, 4): column and row of
    a cell of density, sum of squares, and number of differences.
    """
    around = window.padded(1)
    rows = np.concatenate([load_arrays(name, ("strips",))["strips"] for name in files])
    rows = rows[around.contains(rows[:, 1], rows[:, 2])]
    cell = around.flat_index(rows[:, 1], rows[:, 2])
    mean = _means(rows, cell, around)
    slope = np.hypot(*np.gradient(mean / STEPS, rules.strip)) * rules.vertical
    inner = window.slices_in(around)
    flat = (slope <= rules.max_slope)[inner]
    sources = np.unique(rows[:, 0]).tolist()
    of_source = {
        s: _means(rows[rows[:, 0] == s], cell[rows[:, 0] == s], around)[inner] for s in sources
    }
    differences, cells = [np.empty((0, 4), np.int64)], [np.empty((0, 4), np.int64)]
    for a, b in combinations(sources, 2):
        both = of_source[b] - of_source[a]
        row, column = np.nonzero(np.isfinite(both) & flat)
        if len(row):
            value = np.rint(both[row, column]).astype(np.int64)
            number, count = np.unique(value, return_counts=True)
            differences.append(np.column_stack([0 * number + a, 0 * number + b, number, count]))
            x, y = (
                steps((k + 0.5) * rules.strip) for k in (column + window.left, row + window.bottom)
            )
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
