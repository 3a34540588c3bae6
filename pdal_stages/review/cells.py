"""What cells of an absolute grid say of the classified points in them: whole numbers, so that any order gives the same.

Records are joined by adding and comparing, so files are read one after the other, in parts, and those of a country need
not be in memory together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: Groups that points are counted in, and the codes of the first three; all others are the last.
GROUPS = ("ground", "vegetation", "building", "other")
GROUND, VEGETATION, BUILDING, OTHER = range(4)
_CODES = {2: GROUND, 3: VEGETATION, 4: VEGETATION, 5: VEGETATION, 6: BUILDING}
GROUP_OF = np.full(256, OTHER, np.uint8)
GROUP_OF[list(_CODES)] = list(_CODES.values())

#: Bounds of the bins of reliability and of height above ground (meters) in which points are counted.
RELIABILITY = (0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98, 0.995)
HEIGHT = (-0.5, 0.2, 0.5, 1.0, 2.0, 4.0, 8.0, 20.0)
BINS = (len(RELIABILITY) + 1, len(HEIGHT) + 1)
#: Below this reliability a point is unsure.
UNSURE = 0.8
#: A building is on the ground below this height, and heights are doubtful below that, meters.
LOW_BUILDING, NEGATIVE = 0.5, -0.5
#: Smallest side of a cell in meters, points it should hold, and the largest side there is.
SIDE, HELD, WIDEST = 1.0, 4.0, 16.0
#: Cells that are held at once, about: for more ground they are larger.
MOST_CELLS = 1 << 24
#: Heights are whole millimeters.
MM = 1000.0
_HALF = np.int64(1) << 30
#: No height.
NONE = np.int32(2**31 - 1)
#: Expected errors are whole numbers of this part of a point.
PARTS = 65536
_ADDED = ("points", "expected", "unsure", "doubtful", "contrary", "wrong", "known")


def side_for(points: int, area: float) -> float:
    """The side of cells for so many points on so many square meters: a power of two, :data:`SIDE` at least."""
    side = SIDE
    while side < WIDEST and (points < HELD / side**2 * area or area > MOST_CELLS * side**2):
        side *= 2.0
    return side


@dataclass(frozen=True)
class Settings:
    """How points become patches.

    Attributes
    ----------
    cell : float
        Side of a cell, meters.
    block : float
        Patches end at the borders of blocks of this side, meters.
    getting_there : float
        Seconds until a person sees a patch.
    looking : float
        Seconds a person looks at 100 square meters.
    """

    cell: float = SIDE
    block: float = 64.0
    getting_there: float = 5.0
    looking: float = 2.5


def cell_keys(row: ArrayLike, column: ArrayLike) -> NDArray[np.int64]:
    """One number for each cell; sorted row by row from the south."""
    return ((np.asarray(row, np.int64) + _HALF) << np.int64(31)) | (np.asarray(column, np.int64) + _HALF)


def rows_and_columns(keys: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The rows and columns of keys."""
    return (keys >> np.int64(31)) - _HALF, (keys & np.int64((1 << 31) - 1)) - _HALF


def bins_of(codes: NDArray[np.uint8], reliability: ArrayLike, height: ArrayLike) -> NDArray[np.int64]:
    """(n,) the place of each point in a table of (groups, bins of reliability, bins of height), flat."""
    sure = np.searchsorted(RELIABILITY, np.asarray(reliability, np.float64), side="right")
    above = np.searchsorted(HEIGHT, np.asarray(height, np.float64), side="right")
    return (GROUP_OF[codes].astype(np.int64) * BINS[0] + sure) * BINS[1] + above


@dataclass
class Records:
    """What is known of each cell that holds points.

    Attributes
    ----------
    side : float
        Meters.
    key : (n,) int64, ascending
    points, expected : (n, 4) int64
        Points of each group, and how many of them would be wrong elsewhere, by their reliability and height, in
        :data:`PARTS`.
    unsure, doubtful : (n,) int32
        Points of little reliability, and points below the ground.
    contrary : (n,) int32
        Buildings on the ground.
    low, lowest, highest : (n,) int32
        Height of the lowest ground point, of the lowest and of the highest, mm; no ground: the largest number.
    tile, most : (n,) int32
        The number of the file most of its points are of, and how many these are.
    strip : (n, 2) int64
        The lowest and the highest number of a flight line; -1 where these are not known.
    of_strip : (n, 2, 4) int32
        Points of each group of these two.
    wrong, known : (n, 4) int32
        With true classes: points of another group than the true one, and points whose class is known.
    """

    side: float
    key: NDArray[np.int64]
    points: NDArray[np.int64]
    expected: NDArray[np.int64]
    unsure: NDArray[np.int32]
    doubtful: NDArray[np.int32]
    contrary: NDArray[np.int32]
    low: NDArray[np.int32]
    lowest: NDArray[np.int32]
    highest: NDArray[np.int32]
    tile: NDArray[np.int32]
    most: NDArray[np.int32]
    strip: NDArray[np.int64]
    of_strip: NDArray[np.int32]
    wrong: NDArray[np.int32]
    known: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.key)

    @classmethod
    def of(
        cls,
        xyz: NDArray[np.float64],
        codes: NDArray[np.uint8],
        reliability: ArrayLike,
        height: ArrayLike,
        side: float,
        rates: NDArray[np.float64],
        *,
        tile: int = 0,
        strip: ArrayLike | None = None,
        truth: NDArray[np.uint8] | None = None,
    ) -> Records:
        """Records of points.

        Parameters
        ----------
        xyz : (n, 3) float64
            Meters.
        codes : (n,) uint8
            The classes they have.
        reliability, height : (n,) float
            0 to 1, and meters above ground.
        side : float
            Of a cell, meters.
        rates : (4, reliabilities, heights) float64
            Share of wrong points in each bin; see :func:`bins_of`.
        tile : int
            The number of their file.
        strip : (n,) int, optional
            The flight line of each.
        truth : (n,) uint8, optional
            True classes, 0 where they are not known.
        """
        column, row = (np.floor(xyz[:, axis] / side).astype(np.int64) for axis in (0, 1))
        key, at, number = np.unique(cell_keys(row, column), return_inverse=True, return_counts=True)
        at, n = at.reshape(-1), len(key)
        group = GROUP_OF[codes]
        reliability, height = np.asarray(reliability, np.float64), np.asarray(height, np.float64)
        share = np.rint(rates.ravel() * PARTS).astype(np.int64)[bins_of(codes, reliability, height)]
        expected = np.zeros(n * 4, np.int64)
        np.add.at(expected, at * 4 + group, share)
        z = np.rint(xyz[:, 2] * MM).astype(np.int32)
        low, lowest, highest = (np.full(n, value, np.int32) for value in (NONE, NONE, -NONE))
        np.minimum.at(low, at[group == GROUND], z[group == GROUND])
        np.minimum.at(lowest, at, z)
        np.maximum.at(highest, at, z)

        def counted(chosen: NDArray[np.bool_]) -> NDArray[np.int32]:
            return np.bincount(at[chosen], minlength=n).astype(np.int32)

        told = np.zeros(len(at), bool) if truth is None else truth > 0
        wrong = told if truth is None else told & (GROUP_OF[truth] != group)
        return cls(
            side,
            key,
            _by_group(at, group, n).astype(np.int64),
            expected.reshape(n, 4),
            counted((reliability < UNSURE) & (group != OTHER)),
            counted(height < NEGATIVE),
            counted((group == BUILDING) & (height < LOW_BUILDING)),
            low,
            lowest,
            highest,
            np.full(n, tile, np.int32),
            number.astype(np.int32),
            *_strips(at, n, group, strip),
            _by_group(at[wrong], group[wrong], n),
            _by_group(at[told], group[told], n),
        )

    @classmethod
    def join(cls, parts: Sequence[Records]) -> Records:
        """Records of several parts as one."""
        if len(parts) == 1:
            return parts[0]
        key, at = np.unique(np.concatenate([part.key for part in parts]), return_inverse=True)
        at, n = at.reshape(-1), len(key)

        def joined(name: str, how: np.ufunc, start: int) -> NDArray:
            values = np.concatenate([getattr(part, name) for part in parts])
            out = np.full((n, *values.shape[1:]), start, values.dtype)
            how.at(out, at, values)
            return out

        made = {name: joined(name, np.add, 0) for name in _ADDED}
        made |= {name: joined(name, np.minimum, int(NONE)) for name in ("low", "lowest")}
        made |= {name: joined(name, np.maximum, -int(NONE)) for name in ("highest", "most")}
        tile, number = (np.concatenate([getattr(part, name) for part in parts]) for name in ("tile", "most"))
        largest = number == made["most"][at]
        strip, counts = (
            np.concatenate([getattr(part, name) for part in parts]) for name in ("strip", "of_strip")
        )
        made["strip"], made["of_strip"] = np.full((n, 2), -1, np.int64), np.zeros((n, 2, 4), np.int32)
        for end, sign in ((0, -1), (1, 1)):
            best = np.full(n, -(1 << 40), np.int64)
            np.maximum.at(best, at, sign * strip[:, end])
            made["strip"][:, end] = sign * best
            mine = strip[:, end] == sign * best[at]
            np.add.at(made["of_strip"][:, end], at[mine], counts[mine, end])
        made["tile"] = np.full(n, NONE, np.int32)
        np.minimum.at(made["tile"], at[largest], tile[largest])  # the first of equals
        return cls(parts[0].side, key, **made)

    @property
    def disagreeing(self) -> NDArray[np.float64]:
        """Points of each cell that its first and its last flight line disagree on: by how much shares of groups differ,
        times the smaller number of points."""
        number = self.of_strip.sum(axis=2, dtype=np.int64)
        share = self.of_strip / np.maximum(number, 1)[:, :, None]
        apart = 0.5 * np.abs(share[:, 0] - share[:, 1]).sum(axis=1)
        return apart * number.min(axis=1) * (self.strip[:, 0] != self.strip[:, 1]) * (number.min(axis=1) >= 3)

    def taken(self, chosen: NDArray[np.bool_]) -> Records:
        """Some of the cells."""
        arrays = {name: values[chosen] for name, values in vars(self).items() if name != "side"}
        return Records(self.side, **arrays)


def _by_group(at: NDArray[np.int64], group: NDArray[np.uint8], n: int) -> NDArray[np.int32]:
    return np.bincount(at * 4 + group, minlength=4 * n).reshape(n, 4).astype(np.int32)


def _strips(
    at: NDArray[np.int64], n: int, group: NDArray[np.uint8], strip: ArrayLike | None
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """The first and the last flight line of each cell, and the points of each group of these."""
    ends, counts = np.full((n, 2), -1, np.int64), np.zeros((n, 2, 4), np.int32)
    if strip is None:
        return ends, counts
    line = np.asarray(strip).astype(np.int64)
    ends[:, 0] = 1 << 32
    np.minimum.at(ends[:, 0], at, line)
    np.maximum.at(ends[:, 1], at, line)
    for end in (0, 1):
        mine = line == ends[at, end]
        counts[:, end] = _by_group(at[mine], group[mine], n)
    return ends, counts
