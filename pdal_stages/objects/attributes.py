"""Measures of an object, and its verdict: sure, or to be checked and why."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from ..base.json_types import JsonObject
from .cells import THOUSANDTHS

#: Verdicts.
SURE = "sure"
CHECK = "check"


@dataclass(frozen=True)
class CheckRules:
    """Limits beyond which an object is to be checked; lengths in meters, areas in m2.

    Values without a reason are not tuned.
    """

    min_reliability: float = 0.7  #: mean of the object's points
    min_building_area: float = 10.0  #: sheds are kept, yet often something else
    min_building_width: float = 2.0  #: side of the square that it must hold; no wire or wall does
    min_building_height: float = 2.2  #: of the ridge: a door's height
    min_tree_points: int = 10
    min_span: float = 8.0
    min_deck_area: float = 20.0
    min_deck_height: float = 0.5


RULES = CheckRules()
#: Percentile of heights at a building's edge that is its eave; not tuned.
EAVE = 25
#: Percentile of a building's heights that is its ridge: antennas and chimneys may be above it.
RIDGE = 98
#: Width of the pieces of wires whose means form a span's line, meters.
PIECE = 2.0
#: Wires that spread no wider than this across their direction are straight or lie side by side,
#: meters.
MAX_SPREAD = 4.0


class ObjectCells(NamedTuple):
    """Cells of an object, row by row: (n,) arrays."""

    row: NDArray[np.int64]
    column: NDArray[np.int64]
    z: NDArray[np.float64]  #: highest point of the roof, canopy or wires, meters
    low: NDArray[np.float64]  #: lowest point, meters; NaN in cells without points
    ground: NDArray[np.float64]  #: height of the ground, meters; NaN where it is not known
    points: NDArray[np.int64]
    reliability: NDArray[np.float64]  #: sum over points, thousandths
    rated: NDArray[np.int64]  #: points with a reliability

    @property
    def place(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows and columns from the object's own first ones."""
        return self.row - self.row.min(), self.column - self.column.min()

    def raster(self, values: NDArray) -> NDArray:
        """Return values of the cells as a raster (rows, columns), NaN outside."""
        out = np.full((int(np.ptp(self.row)) + 1, int(np.ptp(self.column)) + 1), np.nan)
        out[self.place] = values
        return out

    @property
    def ground_height(self) -> float:
        """Median height of the ground, NaN where it is not known."""
        return float(np.nanmedian(self.ground)) if not np.isnan(self.ground).all() else math.nan

    def describe(self, measures: JsonObject, reasons: dict[str, bool]) -> JsonObject:
        """Return the measures with points, mean reliability (NaN if unknown) and verdict."""
        rated = int(self.rated.sum())
        reliability = float(self.reliability.sum()) / rated / THOUSANDTHS if rated else math.nan
        reasons = {**reasons, "unsure points": reliability < RULES.min_reliability}
        text = ", ".join(reason for reason, holds in reasons.items() if holds)
        verdict = {"verdict": CHECK if text else SURE, "reason": text}
        return {**measures, "points": int(self.points.sum()), "reliab": reliability, **verdict}


def measure_building(cells: ObjectCells, size: float) -> JsonObject:
    """Return heights and verdict of a building."""
    raster, ground = cells.raster(cells.z), cells.ground_height
    inside, area = ~np.isnan(raster), len(cells.row) * size * size
    above = cells.z - (np.nanmin(cells.low) if math.isnan(ground) else ground)
    edge = ~scipy.ndimage.binary_erosion(inside)[cells.place]
    square = np.ones((math.ceil(RULES.min_building_width / size),) * 2, bool)
    ridge = float(np.percentile(above, RIDGE))
    return cells.describe(
        {
            "area": area,
            "h_eave": float(np.percentile(above[edge], EAVE)),
            "h_ridge": ridge,
            "ground": ground,
        },
        {
            "no ground near": math.isnan(ground),
            "small": area < RULES.min_building_area,
            "narrow": not scipy.ndimage.binary_erosion(inside, square).any(),
            "low": ridge < RULES.min_building_height,
        },
    )


def measure_tree(cells: ObjectCells, top_row: int, top_column: int, size: float) -> JsonObject:
    """Return place, height, crown and verdict of a tree."""
    area = len(cells.row) * size * size
    above = cells.z - cells.ground
    highest = int(np.argmax(np.where(np.isnan(above), -np.inf, above)))
    height, diameter = float(above[highest]), 2.0 * math.sqrt(area / math.pi)
    return cells.describe(
        {
            "x": (top_column + 0.5) * size,
            "y": (top_row + 0.5) * size,
            "height": height,
            "area": area,
            "diam": diameter,
            "ground": float(cells.ground[highest]),
        },
        {
            "few points": cells.points.sum() < RULES.min_tree_points,
        },
    )


def measure_span(cells: ObjectCells, size: float) -> JsonObject:
    """Return length, clearance, sag, path and verdict of a conductor."""
    path = wire_path(cells, size)
    along = np.r_[0.0, np.cumsum(np.hypot(*np.diff(path[:, :2], axis=0).T))]
    length, clearance = float(along[-1]), cells.low - cells.ground
    chord = np.interp(along, along[[0, -1]], path[[0, -1], 2])
    return cells.describe(
        {
            "length": length,
            "h_low": float(np.nanmin(clearance)) if not np.isnan(clearance).all() else math.nan,
            "z_high": float(cells.z.max()),
            "sag": float(max(0.0, np.max(chord - path[:, 2]))),
            "path": path,
        },
        {
            "short": length < RULES.min_span,
        },
    )


def wire_path(cells: ObjectCells, size: float) -> NDArray[np.float64]:
    """Return a line along wires (n, 3), meters: means of pieces of `PIECE` along it."""
    x, y = (cells.column + 0.5) * size, (cells.row + 0.5) * size
    u, v = x - x.min(), y - y.min()
    du, dv = u - u.mean(), v - v.mean()
    angle = 0.5 * math.atan2(2.0 * float(du @ dv), float(du @ du - dv @ dv))
    c, s = math.cos(angle), math.sin(angle)
    along, across = u * c + v * s, v * c - u * s
    _, piece = np.unique(np.floor((along - along.min()) / PIECE), return_inverse=True)
    count = np.bincount(piece)
    if len(count) == 1:  # a wire of one piece
        ends = [np.argmin(along), np.argmax(along)]
        return np.column_stack([x, y, cells.z])[ends]
    if np.ptp(across) < MAX_SPREAD:  # wires side by side: one straight line between them
        across = np.full(len(across), across.mean())
    u, v, z = (np.bincount(piece, weights=values) / count for values in (along, across, cells.z))
    u[[0, -1]] = along.min(), along.max()  # from one end to the other
    return np.column_stack([x.min() + u * c - v * s, y.min() + u * s + v * c, z])


def measure_deck(cells: ObjectCells, size: float) -> JsonObject:
    """Return area, height, clearance and verdict of a bridge deck."""
    area, ground, z = len(cells.row) * size * size, cells.ground_height, float(np.median(cells.z))
    return cells.describe(
        {"area": area, "z": z, "clear": z - ground, "ground": ground},
        {"small": area < RULES.min_deck_area, "low": z - ground < RULES.min_deck_height},
    )
