"""Height above a coarse terrain: the minima of a grid, interpolated [W18 section 3.2].

The terrain is the lowest point of each cell of a coarse grid (20 m), interpolated
bilinearly between cell centers and evaluated on a fine grid (0.5 m); a point's height is
its z minus the value of the fine cell it falls in. Both grids are anchored to absolute
coordinates (``floor(x / cell)``), so every tile of a survey sees the same cells. No raster
is held: the fine value is computed where a point falls, and only cells with points and
their neighbors are stored, so one stray coordinate costs one cell.

[W18] Weinmann, Blomley, Weinmann, Jutzi (2018), Investigations on the potential of binary and
multi-class classification for object extraction from airborne laser scanning point clouds, DGPF.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..base import checks
from ..base.arrays import begins_run
from ..base.errors import NoTerrainError, OptionError
from .cells import bounded, cell_numbers, columns


@dataclass
class MinimaTerrain:
    """The coarse terrain of a cloud: build with :meth:`fit`, read with :meth:`at`."""

    #: Sides of a coarse and of a fine cell, in the unit of the coordinates.
    cell: float
    resolution: float
    #: Counts: ``cells`` (with points), ``interpolated_cells`` (empty ones that were needed), ``farthest_fill`` (distance
    #: to the nearest filled cell, the worst case), ``unused_points`` (not finite, or excluded by the mask).
    figures: dict = field(default_factory=dict)
    _keys: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64), repr=False)
    _minima: NDArray[np.float64] = field(default_factory=lambda: np.empty(0), repr=False)

    @classmethod
    def fit(
        cls,
        x: ArrayLike,
        y: ArrayLike,
        z: ArrayLike,
        *,
        cell: float = 20.0,
        resolution: float = 0.5,
        mask: ArrayLike | None = None,
    ) -> MinimaTerrain:
        """Take the lowest point of each coarse cell; parameters as for :func:`hag_minima`."""
        check_sizes(cell, resolution)
        x, y, z = (np.asarray(a, np.float64) for a in (x, y, z))
        usable = np.isfinite(x) & np.isfinite(y) & np.isfinite(z)
        if mask is not None:
            usable &= np.asarray(mask, bool)
        terrain = cls(float(cell), float(resolution))
        column, row = cell_numbers(x[usable], cell), cell_numbers(y[usable], cell)
        key = _key(column, row)
        order = np.argsort(key, kind="stable")
        key = key[order]
        starts = np.flatnonzero(begins_run(key))
        terrain._keys = key[starts]
        if starts.size:
            terrain._minima = np.minimum.reduceat(z[usable][order], starts)
        terrain.figures = {
            "cells": int(terrain._keys.size),
            "interpolated_cells": 0,
            "farthest_fill": 0.0,
            "unused_points": int(x.size - np.count_nonzero(usable)),
        }
        return terrain

    def at(self, x: ArrayLike, y: ArrayLike) -> NDArray[np.float64]:
        """Terrain height where points fall: bilinear, at the center of their fine cell; NaN for those not finite.

        NoTerrainError if no point formed a terrain.
        """
        x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
        out = np.full(x.shape, np.nan)
        finite = np.isfinite(x) & np.isfinite(y)
        if not finite.any():
            return out
        if self._keys.size == 0:
            raise NoTerrainError(
                "no terrain: none of the points may form one",
                found=f"{x.size:,} points, all of them not finite, noise, or outside 'where'",
                cure="Relax 'ignore' or 'where'",
            )
        # Distinct fine cells first: many points share one.
        fine_x = np.floor(x[finite] / self.resolution)
        fine_y = np.floor(y[finite] / self.resolution)
        u = (fine_x + 0.5) * (self.resolution / self.cell) - 0.5
        v = (fine_y + 0.5) * (self.resolution / self.cell) - 0.5
        i, j = np.floor(u), np.floor(v)
        wu, wv = u - i, v - j
        i, j = bounded(i), bounded(j)
        corners = [_key(i + a, j + b) for b in (0, 1) for a in (0, 1)]
        keys = np.unique(np.concatenate([np.unique(k) for k in corners]))
        values = self._filled(keys)
        z00, z10, z01, z11 = (values[np.searchsorted(keys, k)] for k in corners)
        lower = z00 + (z10 - z00) * wu
        upper = z01 + (z11 - z01) * wu
        out[finite] = lower + (upper - lower) * wv
        return out

    def _filled(self, keys: NDArray[np.int64]) -> NDArray[np.float64]:
        """Values of the cells `keys`; empty ones from the filled ones about as near as the nearest.

        Weights are one over the fourth power of the distance between cell centers. [W18] does not say what becomes
        of empty cells.
        """
        place = np.minimum(np.searchsorted(self._keys, keys), self._keys.size - 1)
        values = self._minima[place].copy()
        empty = np.flatnonzero(self._keys[place] != keys)
        if empty.size:
            from scipy.spatial import cKDTree  # most clouds have no gaps: not loaded at start

            filled_at = np.column_stack(_unkey(self._keys)).astype(np.float64)
            wanted_at = np.column_stack(_unkey(keys[empty])).astype(np.float64)
            tree = cKDTree(filled_at)
            nearest = tree.query(wanted_at, k=1)[0]
            # All filled cells within reach of the nearest one: a set, so the outcome
            # does not depend on how a search tree orders equal distances.
            for at, center, radius in zip(empty, wanted_at, nearest + 1.5, strict=True):
                near = np.sort(tree.query_ball_point(center, radius))
                squared = ((filled_at[near] - center) ** 2).sum(axis=1)
                weight = 1.0 / squared**2  # distance to the fourth power
                values[at] = np.dot(weight, self._minima[near]) / weight.sum()
            self.figures["interpolated_cells"] = int(empty.size)
            self.figures["farthest_fill"] = float(nearest.max() * self.cell)
        return values


def hag_minima(
    x: ArrayLike,
    y: ArrayLike | None = None,
    z: ArrayLike | None = None,
    *,
    cell: float = 20.0,
    resolution: float = 0.5,
    mask: ArrayLike | None = None,
) -> NDArray[np.float64]:
    """Height of every point above the coarse terrain of the cloud [W18 section 3.2].

    Parameters
    ----------
    x, y, z : array_like, shape (n,)
        Coordinates in meters (or any one unit, with `cell` and `resolution` in it too); or `x` alone, of shape (n, 3).
    cell : float, default 20
        Side of the coarse cells whose lowest points form the terrain.
    resolution : float, default 0.5
        Side of the fine cells on which the terrain is evaluated.
    mask : array_like of bool, shape (n,), optional
        Points that may form the terrain, e.g. all but noise.

    Returns
    -------
    ndarray of float64, shape (n,)
        z minus terrain; NaN only where a coordinate is not finite.

    Raises
    ------
    OptionError
        If a size is not positive, or `resolution` is larger than `cell`.
    StageError
        If no point may form the terrain, or shapes differ.

    Examples
    --------
    >>> hag_minima([1.0, 2.0], [1.0, 2.0], [10.0, 13.5]).tolist()
    [0.0, 3.5]
    """
    x, y, z = columns(x, y, z)
    if x.size == 0:
        check_sizes(cell, resolution)
        return np.empty(0)
    terrain = MinimaTerrain.fit(x, y, z, cell=cell, resolution=resolution, mask=mask)
    return z - terrain.at(x, y)


def terrain_reach(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    forms: NDArray[np.bool_],
    wanted: NDArray[np.bool_],
    box: Sequence[float],
    cell: float,
    resolution: float,
) -> float:
    """How far around a box lies all that decides the terrain under the wanted points.

    A height takes the four coarse cells around a point; an empty one is filled from all cells within its
    nearest filled one's distance and 1.5 cells. All of these must be known whole. What is found with too few
    points bounds the true reach from above. `forms` and `wanted` (n,) are the points that form the terrain, and those
    whose heights matter; the box is (min x, min y, max x, max y). In the unit of x and y; 0 where the box suffices.
    """
    from scipy.spatial import cKDTree

    if not wanted.any():
        return 0.0
    if not forms.any():  # farther than what was read
        around = max(box[0] - x.min(), box[1] - y.min(), x.max() - box[2], y.max() - box[3], 0.0)
        return float(around + box[2] - box[0])
    filled = np.unique(np.column_stack([np.floor(x[forms] / cell), np.floor(y[forms] / cell)]), axis=0)
    fine = np.unique(
        np.column_stack([np.floor(x[wanted] / resolution), np.floor(y[wanted] / resolution)]), axis=0
    )
    low = np.floor((fine + 0.5) * (resolution / cell) - 0.5)
    cells = np.unique(np.concatenate([low + np.array([a, b]) for a in (0, 1) for b in (0, 1)]), axis=0)
    nearest = cKDTree(filled).query(cells)[0]
    radius = np.where(nearest > 0, nearest + 1.5, 0.0)[:, None] + 0.5  # whole cells around it
    center = cells + 0.5
    below = np.asarray(box[:2]) - (center - radius) * cell
    above = (center + radius) * cell - np.asarray(box[2:])
    return float(max(0.0, below.max(), above.max()))


def check_sizes(cell: float, resolution: float) -> None:
    for name, value in (("cell", cell), ("resolution", resolution)):
        checks.number(f"'{name}'", value, 0, above=True)
    if resolution > cell:
        raise OptionError(
            "'resolution' must not be larger than 'cell'",
            found=f"resolution {resolution:g}, cell {cell:g}",
            cure="Swap them, or lower 'resolution'",
        )


def _key(column: NDArray[np.int64], row: NDArray[np.int64]) -> NDArray[np.int64]:
    return (row << 32) + (column + 2**31)


def _unkey(key: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    return (key & 0xFFFFFFFF) - 2**31, key >> 32
