"""Spans: cubes with points of wires are joined to conductors, one by one.

Wires are few, so all of an area are looked at together. Cubes are joined where they lie
close; then each piece goes on straight ahead of its ends over gaps, as thin wires give few echoes.
Cubes are those of an absolute grid and sorted, so that the order of points changes nothing.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..base.grid import cell_keys, group_by_key, key_offset, places_among
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
    label = np.arange(len(cubes.place))
    if not len(label):
        return label
    middles = cubes.middles()
    join_near(cubes.place[:, :2], middles / GAP, GAP / cubes.size, label)
    join_near(cubes.place[:, :2], cubes.place[:, 2:], 2.0**0.5, label)
    tree, tube = cKDTree(middles), max(TUBE, cubes.size)
    ahead = [np.zeros((0, 2), np.int64)]
    for rows in group_by_key(label):
        for tip, direction in _ends(middles, rows):
            other = np.array(tree.query_ball_point(middles[tip], AHEAD))
            away = middles[other] - middles[tip]
            along = away @ direction
            beside = np.linalg.norm(away - np.outer(along, direction), axis=1)
            met = other[(along > 0) & (beside <= tube) & (label[other] != label[tip])]
            ahead.append(np.column_stack([np.full(len(met), tip), met]))
    first, second = np.concatenate(ahead).T
    _join(first, second, label)
    large = np.bincount(label) >= MIN_CUBES
    number = np.where(large, np.cumsum(large) - 1, -1)
    return number[label]


def join_near(
    columns: NDArray[np.int64], positions: NDArray, reach: float, label: NDArray[np.int64]
) -> None:
    """Join the sets (n,) of cubes whose positions (n, k) are at most 1 apart.

    `columns` (n, 2) are the columns of cubes that they lie in; others than those within `reach`
    columns are not looked at. The last axis of the positions is the height.

    Of each column around, a cube is compared with the next cube above and below alone: any other
    that is near it is nearer to these, and joined with them in its own column. So there are no more
    pairs than cubes at a time, however close together they lie.
    """
    keys, column = np.unique(cell_keys(*columns.T), return_inverse=True)
    level = np.unique(positions[:, -1], return_inverse=True)[1]
    place = column * len(level) + level
    order = np.argsort(place, kind="stable")
    ascending = place[order]
    side = range(-int(reach), int(reach) + 1)
    steps = [(i, j) for j in side for i in side if (j, i) >= (0, 0)]  # each pair of columns once
    for step in (each for each in steps if np.hypot(*each) <= reach):
        other, there = places_among(keys, keys + key_offset(*step))
        rows = np.flatnonzero(there[column])
        above = np.searchsorted(ascending, other[column[rows]] * len(level) + level[rows])
        for index in (above, above - 1):
            inside = (index >= 0) & (index < len(order))
            first, second = rows[inside], order[index[inside]]
            apart = positions[first] - positions[second]
            near = (column[second] == other[column[first]]) & ((apart**2).sum(axis=1) <= 1)
            _join(first[near], second[near], label)


def _join(first: NDArray[np.int64], second: NDArray[np.int64], label: NDArray[np.int64]) -> None:
    """Join the sets (n,) of the rows of pairs (m,), and number them by their first rows, from 0."""
    sets = np.empty(label.max() + 1, np.int64)
    number_sets(label[first], label[second], sets)
    label[:] = sets[label]


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
