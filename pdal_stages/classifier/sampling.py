"""Training samples: as many of each class, spread over space, whatever the order of the points.

Each class's points are put in the order of a space-filling curve (Morton's, over 0.5 m cells), the
curve is cut into `count` equal pieces and one point is taken from each, at a position drawn from the seed.
So samples follow the class wherever it is, none of them clumped, and a class's dense parts weigh as they do
in the cloud. Ties within a cell are ordered by a hash of the coordinates, never by the order of the points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import OptionError
from ..base.hashing import coordinate_hash

#: Side of a cell of the curve in metres.
CELL = 0.5


@dataclass(frozen=True, eq=False)
class Samples:
    """Points drawn for training; each once, with the number of times it counts.

    Attributes
    ----------
    cloud, row : (m,) int64
        Which cloud, and which of its points.
    label : (m,) int16
        Position of the class.
    weight : (m,) int64
        Times the sample counts; above 1 where a class has fewer points than samples asked for.
    available : tuple of int
        Points each class has in all clouds.
    """

    cloud: npt.NDArray[np.int64]
    row: npt.NDArray[np.int64]
    label: npt.NDArray[np.int16]
    weight: npt.NDArray[np.int64]
    available: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.row)

    def of_cloud(self, number: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """A cloud's samples: their places here, and their rows in the cloud, ascending."""
        at = np.flatnonzero(self.cloud == number)
        at = at[np.argsort(self.row[at], kind="stable")]
        return at, self.row[at]

    def counts(self, position: int) -> dict[str, int]:
        """Points available, different points drawn, and duplicates of one class."""
        weight = self.weight[self.label == position]
        return {
            "available": self.available[position],
            "samples": len(weight),
            "duplicates": int(weight.sum()) - len(weight),
        }


def draw_samples(
    clouds: Sequence[tuple[npt.NDArray[np.float64], npt.NDArray[Any]]], n_classes: int, count: int, seed: int
) -> Samples:
    """Draw `count` samples of each class from several clouds together.

    Parameters
    ----------
    clouds : sequence of ((n, 3) float64 coordinates in metres, (n,) class positions)
        A position of -1 leaves the point out.
    n_classes : int
    count : int
        Samples per class. A class with fewer points gives each of them count/n times, rounded down or up.
    seed : int

    Raises
    ------
    OptionError
        If a class has no points at all. (The caller knows the labels and says which were found.)
    """
    parts, available = [], []
    for position in range(n_classes):
        rows = [np.flatnonzero(labels == position) for _, labels in clouds]
        n = sum(len(r) for r in rows)
        available.append(n)
        if n == 0:
            raise OptionError("a class has no samples", found=f"class position {position}")
        keys = np.concatenate([curve_keys(xyz[r], seed) for (xyz, _), r in zip(clouds, rows, strict=True)])
        where = np.concatenate([np.full(len(r), c, np.int64) for c, r in enumerate(rows)])
        order = np.lexsort((keys["hash"], keys["cell"]))
        place, weight = spread(n, count, np.random.default_rng([seed, position]))
        chosen = order[place]
        parts.append(
            (where[chosen], np.concatenate(rows)[chosen], np.full(len(chosen), position, np.int16), weight)
        )
    cloud, row, label, weight = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Samples(cloud, row, label, weight, tuple(available))


def spread(
    n: int, count: int, random: np.random.Generator
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """`count` of `n` places in a row, one at random in each of `count` equal pieces, and their weights."""
    share, rest = divmod(count, n)
    picks = np.zeros(0, np.int64)
    if rest:
        picks = np.floor((np.arange(rest) + random.random(rest)) * (n / rest)).astype(np.int64)
        picks = np.minimum(picks, n - 1)
        # Where pieces are shorter than two places neighbors can meet in one; push them apart.
        picks = np.maximum.accumulate(picks - np.arange(rest)) + np.arange(rest)
        picks = np.minimum(picks, n - rest + np.arange(rest))
    if share == 0:
        return picks, np.ones(rest, np.int64)
    weight = np.full(n, share, np.int64)
    weight[picks] += 1
    return np.arange(n), weight


def curve_keys(xyz: npt.NDArray[np.float64], seed: int) -> npt.NDArray[Any]:
    """Morton code of each point's cell in plan, and a hash of its coordinates and the seed."""
    # Anchored to absolute coordinates, so a larger extent changes nothing; 31 bits an axis hold
    # half a million kilometres either way.
    cells = np.clip(np.floor(xyz[:, :2] / CELL) + 2**30, 0, 2**31 - 1).astype(np.uint64)
    keys = np.empty(len(xyz), dtype=[("cell", np.uint64), ("hash", np.uint64)])
    keys["cell"] = _spread_bits(cells[:, 0]) | (_spread_bits(cells[:, 1]) << np.uint64(1))
    keys["hash"] = coordinate_hash(xyz, seed)
    return keys


def _spread_bits(value: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    """Put a zero between each of the 32 low bits."""
    for shift, mask in (
        (16, 0x0000FFFF0000FFFF),
        (8, 0x00FF00FF00FF00FF),
        (4, 0x0F0F0F0F0F0F0F0F),
        (2, 0x3333333333333333),
        (1, 0x5555555555555555),
    ):
        value = (value | (value << np.uint64(shift))) & np.uint64(mask)
    return value
