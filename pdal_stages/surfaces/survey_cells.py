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
from ..base.grid import GridWindow
from ..base.json_types import JsonObject
from ..tiling.inputs import LonePoints
from ..tiling.jobs import load_arrays, save_arrays
from ..tiling.records import JobRecord
from ..tiling.tile_records import Part, ReducedTile
from .cells import HIGHEST, STEPS, CellRule, Integers, cells_at, steps, usable

#: Of points without times: a first time that is later than all.
NEVER = 1e300
_COUNT = CellRule(np.add, 0)
#: Rasters of a survey.
RASTERS = {
    "all": _COUNT, "last": _COUNT, "void": CellRule(np.maximum, 0), "picture": HIGHEST,
    "differing": _COUNT, "squares": _COUNT,
}  # fmt: skip


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
    unit: float = 1.0  #: meters per unit of x and y


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


@dataclass
class ReportFigures(ReducedTile):
    """Figures of a tile that was reduced for the report."""

    files: Mapping[str, JsonObject]  #: see :func:`describe`, by path
    repeated: int  #: points that come twice


@dataclass
class Differences(JobRecord):
    """Cells of a tile in which strips were compared."""

    cells: int


def reduce_tile(
    parts: Sequence[Part], lone: LonePoints, rules: ReportRules, control: NDArray[np.float64]
) -> tuple[dict[str, NDArray], ReportFigures]:
    """Reduce points of a tile: files and their dimensions.

    Returns
    -------
    arrays : dict
        Rasters as of :meth:`.cells.CellRule.rasterize`: ``all`` and ``last`` count points in cells
        of density; ``void`` is 0 without points, 2 with water, else 1; ``picture`` is 256 x height
        in steps + class of the highest point. ``strips`` (k, 5) int64: source, column, row, sum of
        heights in steps, and number of ground points. ``control`` (m, 3) int64: ground points near
        control points (c, 2), in steps. Points that are not usable or come twice are left out.
    figures : ReportFigures
    """
    columns, distinct = [np.empty((0, 6), np.int64)], DistinctPoints()
    for _, part in parts:
        kept = usable(part, lone)
        kept &= distinct.first({**{axis: part[axis] for axis in "XYZ"}, "GpsTime": _times(part)})
        xyz = (steps(part[name]) for name in "XYZ")
        more = part["Classification"], _is_last(part), part["PointSourceId"]
        columns.append(np.column_stack([*xyz, *more]).astype(np.int64)[kept])
    points = np.concatenate(columns)
    z, codes, last, source = points[:, 2:].T
    values = {
        "all": (rules.density, 0 * z + 1),
        "last": (rules.density, last),
        "void": (rules.void, np.where(codes == WATER, 2, 1)),
        "picture": (rules.picture, 256 * z + codes),
    }
    arrays: dict[str, NDArray] = {}
    for name, (side, value) in values.items():
        arrays |= RASTERS[name].rasterize(name, cells_at(points, side * STEPS), value)
    is_ground = np.isin(codes, TERRAIN)
    ground = points[is_ground, :3]
    keys = np.column_stack([source[is_ground], *cells_at(ground, rules.strip * STEPS)])
    near = np.zeros(len(ground), bool)
    for place in control * STEPS:
        near |= np.hypot(*(ground[:, :2] - place).T) <= rules.around_control * STEPS
    arrays["strips"] = sum_up(keys, ground[:, 2])
    arrays["control"] = ground[near]
    files = {path: describe(part) for path, part in parts}
    return arrays, ReportFigures(files, distinct.repeated)


def sum_up(keys: Integers, values: Integers) -> Integers:
    """Return rows of keys (n, k), each once, ascending, with the sum and number of its values."""
    order = np.lexsort(keys.T[::-1])
    keys, first = keys[order], np.ones(len(keys), bool)
    first[1:] = (keys[1:] != keys[:-1]).any(axis=1)
    start = np.flatnonzero(first)
    total = np.add.reduceat(values[order], start)
    return np.column_stack([keys[start], total, np.diff(start, append=len(keys))])


def compare_strips(
    files: list[str], window: GridWindow, rules: ReportRules, target: str
) -> Differences:
    """Compare the ground of strips in a window of cells; save and return what differs.

    The arrays are ``differences`` (k, 4) int64: a source, a greater one, the greater one's mean
    height minus the other's in steps, and the number of cells; and, in cells of density, rasters as
    of :meth:`.cells.CellRule.rasterize`: ``differing``, how many there are, and ``squares``, the
    sum of theirs.
    """
    rows = np.concatenate([load_arrays(name, ("strips",))["strips"] for name in files])
    rows = rows[window.padded(1).contains(rows[:, 1], rows[:, 2])]
    # A tile may be much wider than its points.
    window = window.intersect(GridWindow.enclosing(rows[:, 1], rows[:, 2]))
    surroundings = window.padded(1)
    rows = rows[surroundings.contains(rows[:, 1], rows[:, 2])]

    def means(chosen: Integers) -> NDArray[np.float64]:
        """Return mean heights of cells in steps, NaN for none."""
        cell = surroundings.flat_index(chosen[:, 1], chosen[:, 2])
        size = surroundings.width * surroundings.height
        total, count = (np.bincount(cell, chosen[:, k], size) for k in (3, 4))
        with np.errstate(invalid="ignore"):
            return (total / count).reshape(surroundings.shape)

    inner = window.slices_in(surroundings)
    slope = np.hypot(*np.gradient(means(rows) / STEPS, rules.strip)) * rules.vertical
    flat = (slope <= rules.max_slope)[inner]
    by_source = {s: means(rows[rows[:, 0] == s])[inner] for s in np.unique(rows[:, 0]).tolist()}
    columns = [np.empty((0, 5), np.int64)]
    for (a, lower), (b, upper) in combinations(by_source.items(), 2):
        difference = upper - lower
        row, column = np.nonzero(np.isfinite(difference) & flat)
        value = np.rint(difference[row, column]).astype(np.int64)
        at = column + window.left, row + window.bottom
        columns.append(np.column_stack([0 * row + a, 0 * row + b, value, *at]))
    rows = np.concatenate(columns)
    value, centers = rows[:, 2], steps((rows[:, 3:] + 0.5) * rules.strip)
    cells = cells_at(centers, rules.density * STEPS)
    arrays = {"differences": sum_up(rows[:, :3], 0 * value)[:, [0, 1, 2, 4]]}
    arrays |= RASTERS["differing"].rasterize("differing", cells, 0 * value + 1)
    arrays |= RASTERS["squares"].rasterize("squares", cells, value**2)
    save_arrays(target, arrays)
    return Differences(len(rows))
