"""Spans: cubes with points of wires are joined to conductors, one by one.

Wires are few, so all of an area are looked at together. Cubes are joined where they lie
close; then each piece goes on straight ahead of its ends over gaps, as thin wires give few echoes.
Cubes are those of an absolute grid and sorted, so that the order of points changes nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..base.grid import group_by_key
from ..terrain.components import number_sets
from .cells import WireCubes

# Values are not tuned.
#: Wires closer than this are one conductor, meters; in wide cubes those that touch are.
GAP = 2.0
#: How far ahead a conductor goes on over a gap, meters, ...
AHEAD = 16.0
#: ... within a tube of this radius, meters; in wide cubes one of a cube's side, ...
TUBE = 0.75
#: ... in the direction of this much of its end, meters, ...
END = 12.0
#: ... if it is at least this long, meters.
MIN_LENGTH = 4.0
#: Fewest cubes of a span.
MIN_CUBES = 4


def number_spans(cubes: WireCubes) -> NDArray[np.int64]:
    """Return the number of the span of each cube (n,), from 0 by their first cubes; -1 for none."""
    label = np.empty(len(cubes.place), np.int64)
    if not len(label):
        return label
    middles = cubes.middles()
    tree = cKDTree(middles)
    close = tree.query_pairs(GAP, output_type="ndarray")
    touching = cKDTree(cubes.place).query_pairs(1.0, p=math.inf, output_type="ndarray")
    pairs = np.concatenate([close, touching])
    _join(pairs, label)
    tube = max(TUBE, cubes.size)
    ahead = [pairs]
    for rows in group_by_key(label):
        for tip, direction in _ends(middles, rows):
            other = np.array(tree.query_ball_point(middles[tip], AHEAD))
            away = middles[other] - middles[tip]
            along = away @ direction
            beside = np.linalg.norm(away - np.outer(along, direction), axis=1)
            met = other[(along > 0) & (beside <= tube) & (label[other] != label[tip])]
            ahead.append(np.column_stack([np.full(len(met), tip), met]))
    _join(np.concatenate(ahead), label)
    large = np.bincount(label) >= MIN_CUBES
    number = np.where(large, np.cumsum(large) - 1, -1)
    return number[label]


def _join(pairs: NDArray[np.int64], label: NDArray[np.int64]) -> None:
    """Give each set (n,) that pairs (m, 2) of rows join a number, from 0."""
    first, second = np.ascontiguousarray(pairs.T)
    number_sets(first, second, label)


def _ends(
    middles: NDArray[np.float64], rows: NDArray[np.int64]
) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """Yield the row of each end of a piece of wires that is long enough, and where it points."""
    if len(rows) < MIN_CUBES - 1:
        return
    along = _along(middles[rows])
    if np.ptp(along) < MIN_LENGTH:
        return
    for places in (along, -along):
        tip, end = int(np.argmax(places)), rows[places >= places.max() - END]
        direction = _direction(middles[end])
        outward = (middles[rows[tip]] - middles[end].mean(axis=0)) @ direction
        yield int(rows[tip]), direction if outward >= 0 else -direction


def _direction(xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the direction (3,) along which points (n, 3) are spread most."""
    return np.linalg.svd(xyz - xyz.mean(axis=0), full_matrices=False)[2][0]


def _along(xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how far points (n, 3) lie along the direction of their spread."""
    return (xyz - xyz.mean(axis=0)) @ _direction(xyz)
