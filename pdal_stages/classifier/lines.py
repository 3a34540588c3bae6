"""Lines: connected cells in space that a pass calls one class (wires), described for the next pass.

A wire is long; what a pass takes for one in a crown or on a roof is short, or surrounded by others.
Here the cubes of a grid in which a class has no fewer votes than all others but ground are joined
where they touch, and each point reads what the line of its own cube is like.

Lines are cut at windows of 3 x 3 blocks of an absolute grid, as segments are
(:mod:`.segments`), so results have the same bits in any tile that holds the blocks around a point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..base.grid import cell_numbers, places_among
from ..features.cell_means import WHOLE
from ..terrain.components import number_sets


@dataclass(frozen=True)
class LineRules:
    """Sizes of cells and windows in meters; not tuned but the cell (docs/trials.md).

    Whoever changes one changes what models of older releases read: see CONTRIBUTING.md.
    """

    cell: float = 4.0  #: side of a cube: at 0.6 points per square meter those of a wire still touch
    block: float = 16.0  #: side of a block, a multiple of the cell; windows are three as wide


RULES = LineRules()
#: What is reported of each point's line, in the order of the columns.
COLUMNS = (
    "LineLength",  # diagonal of its bounding rectangle in plan, meters
    "LineCells",  # its cubes for each cube along that diagonal
    "LineHeightRange",  # meters
    "LineOtherVotes",  # share of votes for classes other than its own and ground
    "LineProbability",  # mean probability of its class over the points that vote for it
)
#: Blocks of a window around the block in its middle: (columns, rows).
_BLOCKS = [(columns, rows) for rows in (-1, 0, 1) for columns in (-1, 0, 1)]
_MIDDLE = _BLOCKS.index((0, 0))
#: Half of the neighbors of a cube: (columns, rows, layers).
_NEIGHBORS = [(0, 0, 1)] + [
    (columns, rows, layers)
    for columns, rows in ((1, 0), (-1, 1), (0, 1), (1, 1))
    for layers in (-1, 0, 1)
]
#: Bits of a key for a cube's column, row and layer; cubes beyond are taken for the last.
_BITS = (22, 24, 17)
#: What a point outside any line reads.
_NO_LINE = -1.0


@dataclass(frozen=True, eq=False)
class LineContext:
    """Lines of a class, as the n points of a cloud read them."""

    cell: npt.NDArray[np.int64]  #: (n,) row of each point's cube in the table
    table: npt.NDArray[np.float32]  #: (cubes + 1, columns) what COLUMNS names; last: no line

    def columns(self, rows: npt.NDArray[np.int64]) -> npt.NDArray[np.float32]:
        """Return :data:`COLUMNS` (b, columns) of some of the points."""
        return self.table[self.cell[rows]]


def describe_lines(
    xyz: npt.NDArray[np.float64],
    shares: npt.NDArray[np.uint16],
    target: int,
    ground: int | None,
) -> LineContext:
    """Describe the lines of a class, as each point reads the one in its cube.

    Parameters
    ----------
    xyz : (n, 3) float64
        Meters.
    shares : (n, classes) uint16
        Probabilities of a pass in 65535ths.
    target, ground : int
        Columns of `shares`: of the class that lines are made of, and of ground, if there is one.
    """
    winner = shares.argmax(axis=1)
    is_vote = winner == target
    if not is_vote.any():
        none = np.full((1, len(COLUMNS)), _NO_LINE, np.float32)
        return LineContext(np.zeros(len(xyz), np.int64), none)
    keys = _cube_keys([cell_numbers(xyz[:, axis], RULES.cell) for axis in range(3)])
    voted = np.unique(keys[is_vote])
    place, inside = places_among(voted, keys)
    cell = np.where(inside, place, len(voted))

    def total(values: npt.NDArray) -> npt.NDArray[np.float64]:
        sums = np.bincount(cell, values.astype(np.float64), minlength=len(voted) + 1)
        return sums[:-1].astype(np.float64)

    votes = total(is_vote)
    others = total(~is_vote & (winner != (-1 if ground is None else ground)))
    probability = total(np.where(is_vote, shares[:, target], 0)) / WHOLE
    table = np.full((len(voted) + 1, len(COLUMNS)), _NO_LINE, np.float32)
    won = np.flatnonzero(votes >= others)
    if len(won):
        sums = np.stack([votes, others, probability])[:, won]
        table[won] = _measure(voted[won], sums)
    return LineContext(cell, table)


def _cube_keys(numbers: Sequence[npt.NDArray[np.int64]]) -> npt.NDArray[np.int64]:
    """Return one number for each cube, from its column, row and layer."""
    keys = np.zeros(len(numbers[0]), np.int64)
    for bits, axis in zip(_BITS[::-1], numbers[::-1], strict=True):
        most = 2 ** (bits - 1) - 2
        keys = (keys << bits) + np.clip(axis, -most, most) + 2 ** (bits - 1)
    return keys


def _split(keys: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return column, row and layer (3, m) of keys."""
    out = []
    for bits in _BITS:
        out.append((keys & (2**bits - 1)) - 2 ** (bits - 1))
        keys = keys >> bits
    return np.stack(out)


def _measure(keys: npt.NDArray[np.int64], sums: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return :data:`COLUMNS` (m, columns) of cubes that the class wins, by their ascending keys.

    `sums` (3, m) are votes, votes of others and probabilities of votes.
    """
    cells = _split(keys)
    size, count = round(RULES.block / RULES.cell), len(keys)
    block = cells[:2] // size
    ends = [np.zeros((2, 0), np.int64)]
    for neighbor in _NEIGHBORS:
        columns, rows, layers = neighbor
        step = columns + (rows << _BITS[0]) + (layers << (_BITS[0] + _BITS[1]))
        other, there = places_among(keys, keys + step)
        first, other = np.flatnonzero(there), other[there]
        for number, offset in enumerate(_BLOCKS):
            # The window of the block at this offset from the first cube's: the other's place in it.
            columns, rows = block[:, first] - block[:, other] + np.array(offset)[:, None]
            both = (abs(columns) <= 1) & (abs(rows) <= 1)
            number_there = (rows[both] + 1) * 3 + columns[both] + 1
            ends.append(
                np.stack([number * count + first[both], number_there * count + other[both]])
            )
    label = np.empty(len(_BLOCKS) * count, np.int64)
    sets = number_sets(*np.concatenate(ends, axis=1), label)

    def total(values: npt.NDArray) -> npt.NDArray[np.float64]:
        tiled = np.tile(values, len(_BLOCKS)).astype(np.float64)
        return np.bincount(label, tiled, minlength=sets).astype(np.float64)

    sides = np.empty((3, sets))
    for axis, values in enumerate(cells):
        highest, lowest = np.full((2, sets), -(2.0**40))
        np.maximum.at(highest, label, np.tile(values, len(_BLOCKS)))
        np.maximum.at(lowest, label, np.tile(-values, len(_BLOCKS)))
        sides[axis] = highest + lowest + 1.0
    votes, others, probability = map(total, sums)
    along = np.hypot(sides[0], sides[1])
    described = np.stack(
        [
            RULES.cell * along,
            np.bincount(label, minlength=sets) / along,
            RULES.cell * sides[2],
            others / (votes + others),
            probability / votes,
        ],
        axis=1,
    )
    return described[label.reshape(len(_BLOCKS), -1)[_MIDDLE]]
