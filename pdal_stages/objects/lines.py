"""Straight lines that cells of wires which touch lie along: two lines of wires that cross are two spans, and so are both
sides of a bend.

Lines are taken out one after the other, each the strip of any direction that holds most cells (a Hough transform, on whole
cells), and those that run side by side are put together again: conductors of one span.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

#: Width of a strip, meters.
STRIP = 1.6
#: The least length of a line, meters.
LEAST = 8.0
#: Lines that run side by side are at most so far from parallel, degrees.
PARALLEL = 9
#: What is wider on average, for the length of the lines in it, is left in one piece: no wires, meters.
WIDTH = 2.5
#: What reaches farther is left in one piece, meters: a line for which towers are no class of their own.
FARTHEST = 1000.0


def parted(row: NDArray[np.int64], column: NDArray[np.int64], size: float, gap: float) -> NDArray[np.int64]:
    """Number of each cell's line, from 0 in the order of their first cells; all 0 where there is one.

    Parameters
    ----------
    row, column : (n,) int64
        Of cells, row by row.
    size : float
        Side of a cell, meters.
    gap : float
        Lines side by side are apart by more, or one, meters.
    """
    one = np.zeros(len(row), np.int64)
    if not LEAST <= np.hypot(float(np.ptp(row)), float(np.ptp(column))) * size <= FARTHEST:
        return one
    xy = np.column_stack([column - column.min(), row - row.min()]).astype(np.float64) * size
    turns = np.radians(np.arange(180.0))
    ways = np.column_stack([np.cos(turns), np.sin(turns)])
    owner = one - 1
    found: list[Any] = []
    while (left := np.flatnonzero(owner < 0)).size:
        line = _longest(xy[left], ways, max(STRIP, 2 * size))
        if line is None:
            break
        way, inside = line
        owner[left[inside]] = len(found)
        found.append(way)
    if len(found) < 2:
        return one
    known = owner >= 0
    owner[~known] = owner[known][scipy.spatial.cKDTree(xy[known]).query(xy[~known])[1]]
    owner = _side_by_side(xy, owner, found, gap + 1.5 * size)
    length = sum(np.ptp(xy[owner == n] @ ways[found[n]]) + size for n in np.unique(owner).tolist())
    if len(row) * size**2 > max(WIDTH, 2 * size) * length:
        return one
    _, first, at = np.unique(owner, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[at]


def _longest(xy: NDArray, ways: NDArray, width: float) -> tuple[int, NDArray[np.bool_]] | None:
    """The direction of the strip with most cells, and which cells lie in it; None where it is too short."""
    best, line = 0, None
    for number, (c, s) in enumerate(ways):
        aside = xy[:, 1] * c - xy[:, 0] * s
        for shift in (0.0, 0.5):  # strips overlap by half
            strip = np.floor(aside / width + shift).astype(np.int64)
            count = np.bincount(strip - strip.min())
            most = int(count.argmax())
            if count[most] > best:
                best, line = int(count[most]), (number, strip == most + strip.min())
    if line is None or np.ptp(xy[line[1]] @ ways[line[0]]) < LEAST:
        return None
    return line


def _side_by_side(xy: NDArray, owner: NDArray, ways: list[int], near: float) -> NDArray[np.int64]:
    """Owners with nearly parallel lines that lie near each other put together: the first of them."""
    out = owner.copy()
    for n in range(len(ways)):
        for m in range(n):
            turn = abs(ways[n] - ways[m])
            if min(turn, 180 - turn) > PARALLEL:
                continue
            away, _ = scipy.spatial.cKDTree(xy[owner == m]).query(xy[owner == n], distance_upper_bound=near)
            if np.isfinite(away).any():
                a, b = out[owner == n][0], out[owner == m][0]
                out[out == max(a, b)] = min(a, b)
    return out
