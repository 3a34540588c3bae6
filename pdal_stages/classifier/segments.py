"""Segments: connected cells that a pass calls one class (building), described for the next pass.

Cells around a point (:mod:`.context_features`) report how many votes a class has there, but not
whether these form one house, a hedge or specks in a crown. Here the cells of a grid in plan that a
class wins are joined where they touch and their heights agree, and each point reads what the
segment of its own cell is like, and how far the nearest large one is.

Segments are cut at windows of 3 x 3 blocks of an absolute grid, one window around each block, and
a point reads the window of its own block. So nothing farther than two blocks away matters, and the
results have the same bits in any tile that holds those blocks, in any order of the points. A
segment as wide as its window is large; how large beyond that is not known.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ..base.grid import begins_run, cell_keys, cell_numbers, key_offset, places_among, split_keys
from ..base.jit import njit
from ..base.key_order import order_by_key
from ..features.cell_means import WHOLE
from ..terrain.components import number_sets


@dataclass(frozen=True)
class SegmentRules:
    """Sizes of cells and windows, and the limits of what is reported; lengths in meters.

    Limits (``max_...``) keep the forest from splitting at heights that only one town of its
    training has. The values were not tuned; docs/trials.md has what segments gain as they are.
    Whoever changes one changes what models of older releases read: see CONTRIBUTING.md.
    """

    cell: float = 2.0  #: side of a cell: at 0.3 points per square meter they still touch
    block: float = 16.0  #: side of a block, a multiple of the cell; windows are three as wide
    max_step: float = 2.0  #: cells are joined whose mean heights differ by less: about a storey
    drop: float = 1.5  #: an edge counts as a drop from this height on
    large: tuple[float, ...] = (32.0, 128.0)  #: square meters: a small house, a large one
    distance: float = 16.0  #: distances to large segments are searched up to here
    max_drop: float = 6.0
    max_height: float = 12.0
    max_spread: float = 4.0
    max_offset: float = 5.0


RULES = SegmentRules()
#: What is reported of each point's segment, in the order of the columns.
COLUMNS = (
    "SegmentArea",  # square meters
    "SegmentRimDrop",  # mean height of the segment above the lowest points beside it
    "SegmentRimDropShare",  # share of the rim that drops
    "SegmentFill",  # share of its bounding rectangle that it covers
    "SegmentRim",  # length of the rim over the root of the area
    "SegmentOtherVotes",  # share of votes for classes other than its own and ground
    "SegmentHeightStd",  # standard deviation of its cells' heights
    "SegmentProbability",  # mean probability of its class over the points that vote for it
    "SegmentHeight",  # mean height above ground of these
    "HeightAboveSegment",  # of the point, above the mean of these in its cell
    *(f"DistanceToSegment_{area:g}" for area in RULES.large),
)
#: Blocks of a window around the block in its middle: (columns, rows).
_BLOCKS = [(columns, rows) for rows in (-1, 0, 1) for columns in (-1, 0, 1)]
_MIDDLE = _BLOCKS.index((0, 0))
#: Neighbors of a cell: (columns, rows).
_NEIGHBORS = [block for block in _BLOCKS if block != (0, 0)]
#: Largest number of a cell, either side of zero.
_FARTHEST = 2**30
#: What a point outside any segment reads.
_NO_SEGMENT = -1.0


class VoteCells(NamedTuple):
    """The occupied cells (m,), ascending by row and column, and the votes of their points."""

    column: npt.NDArray[np.int64]
    row: npt.NDArray[np.int64]
    keys: npt.NDArray[np.int64]
    points: npt.NDArray[np.int64]  #: number of points
    votes: npt.NDArray[np.int64]  #: of them, those that vote for the class
    others: npt.NDArray[np.int64]  #: those that vote for neither the class nor ground
    probability: npt.NDArray[np.float64]  #: sum of the probabilities of those that vote
    height: npt.NDArray[np.float64]  #: sum of their heights above ground, meters
    z: npt.NDArray[np.float64]  #: their mean elevation, meters
    lowest: npt.NDArray[np.float64]  #: elevation of the lowest point of the cell


class Segments(NamedTuple):
    """Segments by their cells: in each window the cells of all its blocks, block by block."""

    cells: npt.NDArray[np.int64]  #: (p,) numbers of the cells that the class wins
    label: npt.NDArray[np.int64]  #: (9 p,) number of the segment; the p cells for each of _BLOCKS
    rim: npt.NDArray[np.float64]  #: (3, 9 p) sides of a rim: number, sum of drops, number of drops


@dataclass(frozen=True, eq=False)
class SegmentContext:
    """Segments of a class, as the n points of a cloud read them."""

    z: npt.NDArray[np.float64]  #: (n,) elevation of the points, meters
    cell: npt.NDArray[np.int64]  #: (n,) number of each point's cell
    table: npt.NDArray[np.float32]  #: (cells, columns) what COLUMNS names
    segment_z: npt.NDArray[np.float64]  #: (cells,) elevation of the segment; NaN outside segments

    def columns(self, rows: npt.NDArray[np.int64]) -> npt.NDArray[np.float32]:
        """Return :data:`COLUMNS` (b, columns) of some of the points."""
        cell, most = self.cell[rows], RULES.max_offset
        values = self.table[cell]
        above = np.clip(self.z[rows] - self.segment_z[cell], -most, most)
        values[:, COLUMNS.index("HeightAboveSegment")] = np.nan_to_num(above, nan=-2.0 * most)
        return values


def describe_segments(
    xyz: npt.NDArray[np.float64],
    shares: npt.NDArray[np.uint16],
    height: npt.NDArray[np.float64],
    target: int,
    ground: int | None,
) -> SegmentContext:
    """Describe the segments of a class, as each point reads the one in its cell.

    Parameters
    ----------
    xyz : (n, 3) float64
        Meters.
    shares : (n, classes) uint16
        Probabilities of a pass in 65535ths.
    height : (n,) float
        Heights above ground, meters.
    target, ground : int
        Columns of `shares`: of the class that segments are made of, and of ground, if there is one.
    """
    cell, cells = _count_votes(xyz, shares, height, target, ground)
    table = np.full((len(cells.keys), len(COLUMNS)), _NO_SEGMENT, np.float32)
    table[:, -len(RULES.large) :] = RULES.distance
    z = np.full(len(cells.keys), np.nan)
    segments = _join_cells(cells)
    if len(segments.cells):
        described = _measure(cells, segments)
        label = segments.label.reshape(len(_BLOCKS), -1)[_MIDDLE]
        table[segments.cells, : described.shape[1]] = described[label]
        z[segments.cells] = cells.z[segments.cells]
        for number, area in enumerate(RULES.large, len(COLUMNS) - len(RULES.large)):
            table[:, number] = _distances(cells, segments, described[:, 0] >= area)
    return SegmentContext(xyz[:, 2], cell, table, z)


def _count_votes(
    xyz: npt.NDArray[np.float64],
    shares: npt.NDArray[np.uint16],
    height: npt.NDArray[np.float64],
    target: int,
    ground: int | None,
) -> tuple[npt.NDArray[np.int64], VoteCells]:
    """Return the cell of each point (n,), and the cells."""
    numbers = [cell_numbers(xyz[:, axis], RULES.cell) for axis in (0, 1)]
    # Stray points farther away than keys can tell share cells at the end of the grid.
    keys = cell_keys(*(np.clip(axis, -_FARTHEST, _FARTHEST) for axis in numbers))
    order = order_by_key(keys)
    start = np.flatnonzero(begins_run(keys[order]))
    cell = np.empty(len(keys), np.int64)
    cell[order] = np.repeat(np.arange(len(start)), np.diff(np.append(start, len(keys))))
    winner = shares.argmax(axis=1)
    votes, is_ground = winner == target, winner == (-1 if ground is None else ground)

    def add(values: npt.NDArray) -> npt.NDArray[np.int64]:
        """Sum whole numbers over the points of each cell, so that their order does not matter."""
        return np.add.reduceat(values[order].astype(np.int64), start)

    count = add(votes)
    column, row, _ = split_keys(keys[order[start]])
    millimeters = [np.where(votes, np.rint(1000.0 * v), 0.0) for v in (height, xyz[:, 2])]
    return cell, VoteCells(
        column,
        row,
        keys[order[start]],
        np.diff(np.append(start, len(keys))),
        count,
        add(~votes & ~is_ground),
        add(np.where(votes, shares[:, target], 0)) / WHOLE,
        add(millimeters[0]) / 1000.0,
        add(millimeters[1]) / (1000.0 * np.maximum(count, 1)),
        np.minimum.reduceat(xyz[order, 2], start),
    )


def _join_cells(cells: VoteCells) -> Segments:
    """Join neighboring cells that the class wins into segments, in each window by itself."""
    is_won = (cells.votes > 0) & (cells.votes >= cells.others)
    won = np.flatnonzero(is_won)
    count, size = len(won), round(RULES.block / RULES.cell)
    place = np.zeros(len(is_won), np.int64)
    place[won] = np.arange(count)
    block = np.stack([cells.column // size, cells.row // size])
    rim = np.zeros((3, len(_BLOCKS) * count))
    ends: list[npt.NDArray[np.int64]] = [np.zeros((2, 0), np.int64)]
    for neighbor in _NEIGHBORS:
        other, there = places_among(cells.keys, cells.keys[won] + key_offset(*neighbor))
        first, other = won[there], other[there]
        joined = is_won[other] & (np.abs(cells.z[first] - cells.z[other]) < RULES.max_step)
        drop = np.clip(cells.z[first] - cells.lowest[other], -RULES.max_drop, RULES.max_drop)
        for number, offset in enumerate(_BLOCKS):
            # The window of the block at this offset from the first cell's: the other's place in it.
            columns, rows = block[:, first] - block[:, other] + np.array(offset)[:, None]
            inside = (np.abs(columns) <= 1) & (np.abs(rows) <= 1)
            node = number * count + place[first]
            edge = node[inside & ~joined]  # each once: a cell is one side of its neighbor
            rim[0, edge] += 1
            rim[1, edge] += drop[inside & ~joined]
            rim[2, edge] += drop[inside & ~joined] > RULES.drop
            both = inside & joined
            number_there = (rows[both] + 1) * 3 + columns[both] + 1
            ends.append(np.stack([node[both], number_there * count + place[other[both]]]))
    label = np.empty(len(_BLOCKS) * count, np.int64)
    number_sets(*np.concatenate(ends, axis=1), label)
    return Segments(won, label, rim)


def _measure(cells: VoteCells, segments: Segments) -> npt.NDArray[np.float64]:
    """Return :data:`COLUMNS` (segments, columns), without the distances."""
    label, count = segments.label, int(segments.label.max()) + 1

    def tiled(values: npt.NDArray) -> npt.NDArray:
        return np.tile(values[segments.cells], len(_BLOCKS))

    def total(values: npt.NDArray) -> npt.NDArray[np.float64]:
        return np.bincount(label, values, minlength=count).astype(np.float64)

    def extent(values: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
        ends = np.stack([tiled(values), -tiled(values)])
        highest = np.full((2, count), np.iinfo(np.int64).min)
        for axis in (0, 1):
            np.maximum.at(highest[axis], label, ends[axis])
        return highest.sum(axis=0) + 1.0

    size = np.bincount(label, minlength=count)
    votes, z = total(tiled(cells.votes)), tiled(cells.z)
    sides, drops, dropping = (total(values) for values in segments.rim)
    mean = total(z) / size
    spread = np.sqrt(total((z - mean[label]) ** 2) / size)
    height = total(tiled(cells.height)) / votes
    return np.stack(
        [
            size * RULES.cell**2,
            drops / np.maximum(sides, 1),
            dropping / np.maximum(sides, 1),
            size / (extent(cells.column) * extent(cells.row)),
            sides / np.sqrt(size),
            total(tiled(cells.others)) / total(tiled(cells.points)),
            np.minimum(spread, RULES.max_spread),
            total(tiled(cells.probability)) / votes,
            np.clip(height, 0.0, RULES.max_height),
        ],
        axis=1,
    )


def _distances(
    cells: VoteCells, segments: Segments, is_large: npt.NDArray[np.bool_]
) -> npt.NDArray[np.float64]:
    """Return the distance (m,) of each cell to the nearest one of a large segment of its window."""
    size, count = round(RULES.block / RULES.cell), len(segments.cells)
    column, row = cells.column // size, cells.row // size
    large = np.flatnonzero(is_large[segments.label])
    at = segments.cells[large % count]
    columns, rows = np.array(_BLOCKS)[large // count].T
    window = cell_keys(column[at] + columns, row[at] + rows)
    order = np.argsort(window, kind="stable")
    window, at = window[order], at[order]
    block = cell_keys(column, row)
    first, end = (np.searchsorted(window, block, side) for side in ("left", "right"))
    places = np.stack([cells.column, cells.row], axis=1)
    squared = _nearest(places, places[at], first, end, (RULES.distance / RULES.cell) ** 2)
    return RULES.cell * np.sqrt(squared)


@njit
def _nearest(places, others, first, end, most):
    """Return the squared distance (m,) of each place to the nearest of its others, `most` at most.

    Others of a place are `others` (k, 2) from `first` to `end`.
    """
    out = np.full(len(places), most)
    for place in range(len(places)):
        for other in range(first[place], end[place]):
            across = others[other, 0] - places[place, 0]
            along = others[other, 1] - places[place, 1]
            out[place] = min(out[place], float(across * across + along * along))
    return out
