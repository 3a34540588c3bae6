"""Training samples: as many of each class, spread over space, whatever the order of the points.

Each class's points are put in the order of a space-filling curve (Morton's, over 0.5 m cells) and taken from it at equal
steps, from a place drawn by the seed on. So samples follow the class wherever it is, none of them clumped, and a class's
dense parts weigh as they do in the cloud. Ties within a cell are ordered by a hash of the coordinates.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any
from zlib import crc32

import numpy as np
import numpy.typing as npt

from ..base.arrays import coordinate_hash
from ..base.errors import OptionError
from ..base.progress import Progress

#: Side of a cell of the curve in meters.
CELL = 0.5
#: Points of a class that are put in order at a time; of more, those with the smallest hashes.
MOST = 5_000_000


@dataclass(frozen=True, eq=False)
class Samples:
    """Points drawn for training; each once, with the number of times it counts."""

    cloud: npt.NDArray[np.int64]  #: (m,) which cloud
    row: npt.NDArray[np.int64]  #: (m,) which of its points
    label: npt.NDArray[np.int16]  #: (m,) position of the class
    #: (m,) times the sample counts; above 1 where a class has fewer points than samples asked for
    weight: npt.NDArray[np.int64]
    available: tuple[int, ...]  #: points each class has in all clouds

    def __len__(self) -> int:
        return len(self.row)

    def of_cloud(self, number: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """A cloud's samples: their places here, and their rows in the cloud, ascending."""
        at = np.flatnonzero(self.cloud == number)
        at = at[np.argsort(self.row[at], kind="stable")]
        return at, self.row[at]

    def take(self, array_of: Callable[[int], npt.NDArray[Any]]) -> npt.NDArray[Any]:
        """The samples' values, of one value or row per point of each cloud; called for clouds with samples alone."""
        places, values = [], []
        for number in np.unique(self.cloud).tolist():
            places.append(np.flatnonzero(self.cloud == number))
            values.append(array_of(number)[self.row[places[-1]]])
        made = np.concatenate(values)
        out = np.empty_like(made)
        out[np.concatenate(places)] = made
        return out

    def counts(self, position: int) -> dict[str, int]:
        """Points available, different points drawn, and duplicates of one class."""
        weight = self.weight[self.label == position]
        return {
            "available": self.available[position],
            "samples": len(weight),
            "duplicates": int(weight.sum()) - len(weight),
        }


def draw_samples(
    clouds: Any,
    n_classes: int,
    count: int,
    seed: int,
    groups: Sequence[str] | None = None,
    *,
    progress: Progress | None = None,
) -> Samples:
    """Draw `count` samples of each class from several clouds.

    Parameters
    ----------
    clouds : sequence of ((n, 3) float64 coordinates in meters, (n,) class positions)
        A position of -1 leaves the point out.
    n_classes : int
    count : int
        Samples per class; no more than the largest class has points. A class with fewer points gives each of them
        count/n times, rounded down or up.
    seed : int
    groups : sequence of str, optional
        The group of each cloud: each gives as many samples of a class as the others, as far as it has them.
    progress : Progress, optional
        Updated with the points looked at: all of them once, and once more for each class.
    """
    of_cloud = np.zeros(len(clouds), np.int64)
    names: Any = [""]
    if groups is not None:
        names, of_cloud = np.unique(np.asarray(groups, dtype=str), return_inverse=True)
    there = np.zeros((len(names), n_classes), np.int64)
    for number, (_, position) in enumerate(clouds):
        there[of_cloud[number]] += np.bincount(position[position >= 0], minlength=n_classes)
        if progress is not None:
            progress.update(len(position))
    available = there.sum(axis=0)
    if not available.all():
        raise OptionError("a class has no samples", found=f"class position {int(np.argmin(available))}")
    count = min(count, int(available.max()))
    alone = np.count_nonzero(there.any(axis=1)) == 1
    parts = []
    for position in range(n_classes):
        quota = share_out(there[:, position], count)
        for group in np.flatnonzero(quota):
            random = [seed, position] if alone else [seed, position, crc32(str(names[group]).encode())]
            limit = np.uint64(min(1.0, MOST / there[group, position]) * (2.0**64 - 2048.0))
            keys, rows, where = [], [], []
            for number in np.flatnonzero(of_cloud == group).tolist():
                xyz, label = clouds[number]
                mine = np.flatnonzero(label == position)
                key = curve_keys(xyz[mine], seed)
                keep = key["hash"] <= limit
                keys.append(key[keep])
                rows.append(mine[keep])
                where.append(np.full(len(rows[-1]), number))
                if progress is not None:
                    progress.update(len(label))
            found, row, cloud = np.concatenate(keys), np.concatenate(rows), np.concatenate(where)
            order = np.lexsort((found["hash"], found["cell"]))
            place, weight = spread(len(order), int(quota[group]), np.random.default_rng(random))
            chosen = order[place]
            parts.append((cloud[chosen], row[chosen], np.full(len(chosen), position, np.int16), weight))
    cloud, row, label, weight = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Samples(cloud, row, label, weight, tuple(available.tolist()))


def share_out(available: npt.NDArray[np.int64], count: int) -> npt.NDArray[np.int64]:
    """How many of `count` samples each group gives: alike, as far as there are so many; else in proportion."""
    total = int(available.sum())
    if count >= total:  # all of them, the rest as copies
        exact = available * (count / total)
    else:
        exact, open_ = np.zeros(len(available)), len(available)
        for place in np.argsort(available).tolist():  # the smallest give what they have
            exact[place] = min(available[place], (count - exact.sum()) / open_)
            open_ -= 1
    quota = np.floor(exact + 1e-9).astype(np.int64)
    for place in np.argsort(quota - exact, kind="stable")[: count - int(quota.sum())]:
        quota[place] += 1
    return quota


def spread(
    n: int, count: int, random: np.random.Generator
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """`count` of `n` places in a row, equally far apart from a random one on, and their weights."""
    share, rest = divmod(count, n)
    picks = np.floor((np.arange(rest) + random.random()) * (n / max(rest, 1))).astype(np.int64)
    picks = np.minimum(picks, n - 1)
    if share == 0:
        return picks, np.ones(rest, np.int64)
    weight = np.full(n, share, np.int64)
    weight[picks] += 1
    return np.arange(n), weight


def curve_keys(xyz: npt.NDArray[np.float64], seed: int) -> npt.NDArray[Any]:
    """Morton code of each point's cell in plan, and a hash of its coordinates and the seed."""
    # Anchored to absolute coordinates, so a larger extent changes nothing; 31 bits an axis hold
    # half a million kilometers either way.
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
