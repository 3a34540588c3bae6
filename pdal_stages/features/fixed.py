"""All cylinders and spheres of a plan, prepared once for a grid: what the engine calls for every block."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .candidates import LANES
from .index import CellGrid
from .names import MOMENT_FEATURES, SHAPE_FEATURES
from .plan import FeaturePlan
from .radius import ShapeColumns, count_block, radius_block, radius_values, width_table
from .shapes import PULLS, make_work, point_seeds

#: Estimated cost on one core, to cut blocks of about equal time: nanoseconds.
NS_CANDIDATE, NS_NEIGHBORHOOD, NS_SHAPES, NS_MEMBER = 0.6, 100.0, 1500.0, 1.2


@dataclass(frozen=True)
class _Spec:
    token: str
    radius: float
    spherical: bool
    shaped: bool


class FixedRadius:
    """Kernels' tables for the fixed-radius neighborhoods of `plan` on `grid`, the sorted cloud."""

    def __init__(self, grid: CellGrid, plan: FeaturePlan) -> None:
        self.grid = grid
        chosen = [c for c in plan.layout if c.neighborhood.kind in ("cylinder", "sphere") and c.at]
        self.specs = [
            _Spec(
                c.neighborhood.token, c.neighborhood.parameters[0], c.neighborhood.kind == "sphere", c.shapes
            )
            for c in chosen
        ]
        self.tokens = [spec.token for spec in self.specs]
        self.radii = np.array(sorted({spec.radius for spec in self.specs}), np.float64)
        self.wanted = np.full((len(self.radii), 2), -1, np.int64)
        for number, spec in enumerate(self.specs):
            self.wanted[np.searchsorted(self.radii, spec.radius), int(spec.spherical)] = number
        self.columns = _columns(chosen, MOMENT_FEATURES)
        self.shape_columns = _columns(chosen, SHAPE_FEATURES)
        self.shaped = np.array([spec.shaped for spec in self.specs], np.bool_)
        if self.specs:
            self.widths, self.reaches = width_table(self.radii, grid.cell)

    def __len__(self) -> int:
        return len(self.specs)

    def candidates(self, iy: np.ndarray, ix: np.ndarray) -> np.ndarray:
        """Candidates of the largest radius in the cells (iy, ix), sorted by row, then column."""
        if not self.specs:
            return np.zeros(len(ix), np.int64)
        g = self.grid
        return count_block(
            g.cell_ix, g.cell_start, g.row_iy, g.row_start, iy, ix, self._width(len(self.radii) - 1)
        )

    def cost(self, candidates: np.ndarray) -> np.ndarray:
        """Estimated nanoseconds of one query in cells with so many candidates; for plans with such neighborhoods."""
        area = (self.radii / self.radii[-1]) ** 2
        each = NS_NEIGHBORHOOD + NS_CANDIDATE * np.multiply.outer(candidates, area)
        listed = NS_SHAPES + NS_MEMBER * np.multiply.outer(candidates, area)
        number = (self.wanted >= 0).sum(axis=1)
        shaped = np.where(self.wanted >= 0, self.shaped[self.wanted], False).sum(axis=1)
        return each @ number.astype(float) + listed @ shaped.astype(float)

    def scratch_bytes(self, room: int) -> int:
        """Memory of one call of :meth:`fill` besides its output."""
        return (24 + (16 if self.shaped.any() else 0)) * (room + 4 * LANES) + 30_000 * (len(self.specs) + 2)

    def fill(
        self,
        qx: np.ndarray,
        qy: np.ndarray,
        qz: np.ndarray,
        copies: np.ndarray,
        bins: Any,
        seed: int,
        room: int,
        few: np.ndarray,
        out: np.ndarray,
    ) -> None:
        """Compute the columns of these neighborhoods for queries sorted by cell; see ``radius.radius_block``."""
        shapes = self._shapes(qx, qy, qz, bins, seed, room) if self.shaped.any() else None
        radius_block(
            self.grid.tables(), self.grid.cell, qx, qy, qz, copies, self.radii, self.widths, self.reaches,
            self.wanted, self.columns, shapes, few, room, out,
        )  # fmt: skip

    def _shapes(
        self, qx: np.ndarray, qy: np.ndarray, qz: np.ndarray, bins: Any, seed: int, room: int
    ) -> ShapeColumns:
        thresholds = np.zeros((len(self.specs), 5, 9), np.float32)
        seeds = np.zeros((len(self.specs), len(qx)), np.uint64)
        for number, spec in enumerate(self.specs):
            if spec.shaped:
                thresholds[number] = bins.comparable([spec.token])[0]
                seeds[number] = point_seeds(qx, qy, qz, seed, spec.token)
        record, counts = np.empty((room + 4 * LANES, 4), np.float32), np.empty(50, np.float32)
        return ShapeColumns(self.shaped, self.shape_columns, thresholds, seeds, record, counts, make_work())

    def shape_values(
        self, token: str, points: tuple[np.ndarray, np.ndarray, np.ndarray], seed: int
    ) -> np.ndarray:
        """Metrics of all pulls of a neighborhood for a few points, (m, 5, 255) float32, comparable."""
        spec = self.specs[self.tokens.index(token)]
        k = int(np.searchsorted(self.radii, spec.radius))
        cells = [np.floor(points[axis] / self.grid.cell).astype(np.int64) for axis in (1, 0)]
        g = self.grid
        width = self._width(k)
        room = 0
        for iy, ix in zip(*cells, strict=True):  # the points need not be sorted by cell
            one = np.array([iy]), np.array([ix])
            room = max(room, int(count_block(g.cell_ix, g.cell_start, g.row_iy, g.row_start, *one, width)[0]))
        out = np.empty((len(points[0]), 5, PULLS), np.float32)
        radius_values(
            g.tables(), g.cell, *points, spec.radius, width, float(spec.spherical),
            point_seeds(*points, seed, token), make_work(), room, out,
        )  # fmt: skip
        return out

    def _width(self, k: int) -> np.ndarray:
        return np.ascontiguousarray(self.widths[k, :, : 2 * self.reaches[k] + 1])


def _columns(chosen, features) -> np.ndarray:
    """Where each feature (column) of each neighborhood (row) goes; -1: nowhere."""
    table = [[columns.at.get(feature, -1) for feature in features] for columns in chosen]
    return np.array(table, np.int64).reshape(len(chosen), len(features))
