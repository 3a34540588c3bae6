"""Context: what the pass before said of a point's surroundings, as features of the next pass.

Space is cut into cells of an absolute grid. The probabilities of the pass before, counted in 65535ths, are added as
whole numbers over a point's own cell and the cells around it and divided by the number of points there. So a value
has the same bits for any order of points, number of threads, and in any tile that holds those cells; and a point
costs as much in a dense cloud as in a sparse one.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import OptionError
from ..base.jit import njit
from ..base.threads import map_blocks
from ..features.index import cell_numbers
from .smoothing import WHOLE


@dataclass(frozen=True)
class Kind:
    """What a word of a context token means: cells in space or columns of them, probabilities or votes."""

    axes: int
    votes: bool
    text: str


#: Word of a token, which the side of a cell in metres follows.
KINDS = {
    "box": Kind(3, False, "mean probabilities of the points in 3 x 3 x 3 cells around the point's"),
    "column": Kind(2, False, "mean probabilities of the points in 3 x 3 columns, of any height, around the point's"),
    "boxvotes": Kind(3, True, "share of the points in 3 x 3 x 3 cells whose most probable class it is"),
    "columnvotes": Kind(2, True, "share of the points in 3 x 3 columns whose most probable class it is"),
}  # fmt: skip

#: The token of the point's own probabilities.
OWN = "own"

#: Sides of cells that can be asked for, metres: powers of two, so that corners are exact.
SIDES = tuple(2.0**k for k in range(-3, 7))


@dataclass(frozen=True)
class Scale:
    """One token's cells."""

    token: str
    side: float
    kind: Kind


@dataclass(frozen=True)
class Context:
    """Which features of the surroundings a pass reads.

    Attributes
    ----------
    tokens : tuple of str
        ``own``, or a word of :data:`KINDS` and a side: ``box1``, ``column2``, ``columnvotes8``.

    Raises
    ------
    OptionError
        For a token that is not one.
    """

    tokens: tuple[str, ...]

    def __post_init__(self) -> None:
        self.scales  # noqa: B018  refused when it is made

    @classmethod
    def parse(cls, tokens: str | Iterable[str]) -> Context:
        """From a list of tokens, or text with commas between them."""
        parts = tokens.split(",") if isinstance(tokens, str) else list(tokens)
        return cls(tuple(dict.fromkeys(str(part).strip() for part in parts if str(part).strip())))

    @property
    def scales(self) -> tuple[Scale, ...]:
        """The tokens that have cells."""
        found = []
        for token in self.tokens:
            match = re.fullmatch(rf"({'|'.join(KINDS)})(\d+(?:\.\d+)?)", token)
            if token != OWN and (match is None or float(match[2]) not in SIDES):
                raise OptionError(
                    "a token of 'context' is not known",
                    found=repr(token)[:60],
                    cure=f"Write {OWN}, or {', '.join(KINDS)} and a side in metres that is a power of two "
                    f"from {SIDES[0]:g} to {SIDES[-1]:g}: box1, column8",
                )
            if match:
                found.append(Scale(token, float(match[2]), KINDS[match[1]]))
        return tuple(found)

    @property
    def reach(self) -> float:
        """Metres, along x or y, to the farthest point that can matter."""
        return 2.0 * max((scale.side for scale in self.scales), default=0.0)

    @property
    def strip(self) -> float:
        """Width in metres of strips such that a point's cells all lie in its own and the two beside it."""
        return max((scale.side for scale in self.scales), default=SIDES[-1])

    def names(self, codes: Sequence[int]) -> tuple[str, ...]:
        """Columns, token by token, in each the classes of these codes: ``Probability_2_box0_5``."""
        return tuple(
            f"Probability_{code}_{token.replace('.', '_')}" for token in self.tokens for code in codes
        )

    # ---- computing -----------------------------------------------------------------------------------------

    def tables(
        self, xyz: npt.NDArray[np.float64], shares: npt.NDArray[np.uint16], threads: int | None = None
    ) -> Tables:
        """Everything that :meth:`Tables.fill` needs for these points.

        Parameters
        ----------
        xyz : (n, 3) float64
            Metres. Cells that points at hand lie in must be complete, and so must those around them.
        shares : (n, classes) uint16
            Of each point; see ``smoothing.count_shares``.
        """
        parts = map_blocks(lambda scale: cell_means(xyz, shares, scale), self.scales, threads)
        return Tables(self.tokens, shares, dict(zip((s.token for s in self.scales), parts, strict=True)))


@dataclass(frozen=True, eq=False)
class Tables:
    """Means of cells, and the cell of each point, for every token."""

    tokens: tuple[str, ...]
    shares: npt.NDArray[np.uint16]
    cells: dict[str, tuple[npt.NDArray[np.int32], npt.NDArray[np.float32]]]

    def fill(self, points: npt.NDArray[np.int64], out: npt.NDArray[np.float32]) -> None:
        """Write the columns of some points (rows of what the tables were made of) into `out`."""
        classes = self.shares.shape[1]
        for k, token in enumerate(self.tokens):
            part = out[:, k * classes : (k + 1) * classes]
            if token == OWN:
                take_shares(self.shares, points, part)
            else:
                take_means(*self.cells[token], points, part)


def cell_means(
    xyz: npt.NDArray[np.float64], shares: npt.NDArray[np.uint16], scale: Scale
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32]]:
    """(cell of each point, means (cells, classes) over each cell and those around it)."""
    keys, offsets = cell_keys(xyz[:, : scale.kind.axes], scale.side)
    order = np.argsort(keys)
    ascending = keys[order]
    new = np.ones(len(keys), np.bool_)
    np.not_equal(ascending[1:], ascending[:-1], out=new[1:])
    start = np.append(np.flatnonzero(new), len(keys))
    occupied = ascending[start[:-1]]
    cell = np.empty(len(keys), np.int32)
    sums = np.zeros((len(occupied), shares.shape[1] + 1), np.int64)
    add_cells(order, start, shares, scale.kind.votes, cell, sums)
    means = np.empty((len(occupied), shares.shape[1]), np.float32)
    average_around(occupied, sums, offsets, means)
    return cell, means


def cell_keys(
    coordinates: npt.NDArray[np.float64], side: float
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """A number for each point's cell, such that cells beside each other along the last axis follow each other.

    Returns
    -------
    keys : (n,) int64
    offsets : (3 or 9,) int64
        Added to a key, the middle cells of the rows of three around it.
    """
    numbers = [cell_numbers(coordinates[:, k], side) for k in _ORDER[coordinates.shape[1]]]
    lengths = []
    for attempt in (_from_zero, _without_gaps):
        numbers = [attempt(number) for number in numbers]
        # One empty cell beside the last, so that no cell has neighbors at the other end of the grid.
        lengths = [int(number.max(initial=0)) + 2 for number in numbers]
        if float(np.prod(np.array(lengths, float))) < 2.0**62:
            break
    keys = numbers[0]
    steps = [1]
    for number, length in zip(numbers[1:], lengths[1:], strict=True):
        keys = keys * length + number
        steps = [step * length for step in steps] + [1]
    offsets = np.zeros(1, np.int64)
    for step in steps[:-1]:
        offsets = np.add.outer(offsets, np.array([-step, 0, step])).reshape(-1)
    return keys, np.sort(offsets)


#: Axes from the slowest to the fastest.
_ORDER = {2: (1, 0), 3: (1, 0, 2)}


def _from_zero(number: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    return number - number.min() if len(number) else number


def _without_gaps(number: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Strays far apart: empty stretches become one empty cell."""
    there, at = np.unique(number, return_inverse=True)
    return np.concatenate(([0], np.cumsum(np.minimum(np.diff(there), 2))))[at]


# ---- kernels -----------------------------------------------------------------------------------------------


@njit
def add_cells(order, start, shares, votes, cell, sums):
    """Fill `cell` with each point's, and `sums` with each cell's shares (or votes) and, last, its points."""
    classes = shares.shape[1]
    for k in range(len(start) - 1):
        for j in range(start[k], start[k + 1]):
            i = order[j]
            cell[i] = k
            if votes:
                best = 0
                for c in range(1, classes):
                    if shares[i, c] > shares[i, best]:
                        best = c
                sums[k, best] += WHOLE
            else:
                for c in range(classes):
                    sums[k, c] += np.int64(shares[i, c])
        sums[k, classes] = start[k + 1] - start[k]


@njit
def average_around(keys, sums, offsets, means):
    """Fill `means`: over each cell and those around it, sums of shares / (WHOLE x points)."""
    classes = sums.shape[1] - 1
    rows = len(offsets)
    cursor = np.zeros(rows, np.int64)
    total = np.empty(classes + 1, np.int64)
    n = len(keys)
    for k in range(n):
        total[:] = 0
        for r in range(rows):
            middle = keys[k] + offsets[r]
            at = cursor[r]
            while at < n and keys[at] < middle - 1:
                at += 1
            cursor[r] = at
            while at < n and keys[at] <= middle + 1:
                for c in range(classes + 1):
                    total[c] += sums[at, c]
                at += 1
        whole = float(total[classes]) * WHOLE
        for c in range(classes):
            means[k, c] = float(total[c]) / whole


@njit
def take_shares(shares, points, out):
    """The points' own probabilities."""
    for i in range(len(points)):
        for c in range(shares.shape[1]):
            out[i, c] = float(shares[points[i], c]) / WHOLE


@njit
def take_means(cell, means, points, out):
    """The means of the points' cells."""
    for i in range(len(points)):
        k = cell[points[i]]
        for c in range(means.shape[1]):
            out[i, c] = means[k, c]


def around(
    xyz: npt.NDArray[np.float64], rows: npt.NDArray[np.int64] | None, context: Context
) -> npt.NDArray[np.int64] | None:
    """Points whose probabilities the context of some points can depend on, ascending; None for all.

    These are whole cells: what of a cell is asked for is all of it.
    """
    if rows is None or not len(rows) or not context.scales:
        return rows
    keys, offsets = cell_keys(xyz[:, :2], context.strip)
    wanted = np.unique(keys[rows])
    near = np.unique(np.add.outer(np.add.outer(wanted, offsets), np.array([-1, 0, 1])))
    at: Any = np.minimum(np.searchsorted(near, keys), len(near) - 1)
    found = np.flatnonzero(near[at] == keys)
    return None if len(found) == len(xyz) else found
