"""Boundaries of sets of cells as polygons (extra ``vector``), walked round cell by cell."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.jit import njit


@njit
def rings(row: NDArray, column: NDArray) -> tuple[NDArray, NDArray]:
    """The rings around cells: corners (n, 2) as column and row, and where each ring ends in them.

    Cells lie on the right: shells run clockwise, holes the other way. Cells that meet at a corner alone are apart there, so
    no ring touches itself.
    """
    low_row, low_column = row.min(), column.min()
    rows, columns = row.max() - low_row + 1, column.max() - low_column + 1
    inside = np.zeros((rows + 2, columns + 2), np.bool_)
    for n in range(len(row)):
        inside[row[n] - low_row + 1, column[n] - low_column + 1] = True
    walked = np.zeros((rows + 2, columns + 2), np.bool_)  # northern edges of cells
    place = np.full((rows + 3, columns + 3), -1, np.int64)  # of a corner on the way
    way = np.empty((4 * len(row) + 4, 2), np.int64)
    corners = np.empty((4 * len(row) + 4, 2), np.int64)
    ends = np.empty(len(row) + 1, np.int64)
    many, count = 0, 0
    for r0 in range(1, rows + 1):
        for c0 in range(1, columns + 1):
            if not inside[r0, c0] or inside[r0 + 1, c0] or walked[r0, c0]:
                continue
            # A corner between cells: the southwestern one of cell (r, c).
            r, c, dr, dc, top = r0 + 1, c0, 0, 1, 0
            turned = True
            while True:
                if turned:
                    if place[r, c] >= 0:  # here before: what lies between is a ring
                        first = place[r, c]
                        for n in range(first, top):
                            corners[many, 0], corners[many, 1] = way[n, 1], way[n, 0]
                            place[way[n, 0], way[n, 1]] = -1
                            many += 1
                        ends[count], top = many, first
                        count += 1
                    if r == r0 + 1 and c == c0 and dr == 0 and dc == 1 and walked[r0, c0]:
                        break
                    way[top, 0], way[top, 1] = r, c
                    place[r, c] = top
                    top += 1
                if dc == 1:
                    walked[r - 1, c] = True
                r, c = r + dr, c + dc
                # Cells ahead to the right and to the left of the way.
                right_r, right_c = r + (dr - dc - 1) // 2, c + (dc + dr - 1) // 2
                left_r, left_c = r + (dr + dc - 1) // 2, c + (dc - dr - 1) // 2
                turned = True
                if not inside[right_r, right_c]:
                    dr, dc = -dc, dr
                elif inside[left_r, left_c]:
                    dr, dc = dc, -dr
                else:
                    turned = False
    out = corners[:many].copy()
    out[:, 0] += low_column - 1
    out[:, 1] += low_row - 1
    return out, ends[:count].copy()


def areas(corners: NDArray, ends: NDArray) -> NDArray[np.float64]:
    """Areas of rings: positive where they run clockwise."""
    x, y = corners.T.astype(np.float64)
    begins = np.r_[0, ends[:-1]]
    after = np.arange(1, len(corners) + 1)
    after[ends - 1] = begins
    return np.add.reduceat((x[after] - x) * (y[after] + y), begins) / 2.0


def polygon(shapely: Any, row: NDArray, column: NDArray, hole: float) -> Any:
    """The cells' polygon, or polygons where they are parts; without holes smaller than `hole` cells."""
    corners, ends = rings(row, column)
    area = areas(corners, ends)
    begins = np.r_[0, ends[:-1]]
    shells: list[NDArray] = []
    holes: list[NDArray] = []
    for n in np.flatnonzero((area > 0) | (area <= -hole)).tolist():
        (shells if area[n] > 0 else holes).append(corners[begins[n] : ends[n]])
    if len(shells) == 1:
        return shapely.Polygon(shells[0], holes)
    whole = shapely.polygons([shapely.linearrings(shell) for shell in shells])
    own: list[list[NDArray]] = [[] for _ in shells]
    for ring in holes:
        around = np.flatnonzero(shapely.covers(whole, shapely.Polygon(ring)))
        own[int(around[np.argmin(shapely.area(whole[around]))])].append(ring)
    return shapely.MultiPolygon(
        [shapely.Polygon(shell, inner) for shell, inner in zip(shells, own, strict=True)]
    )
