"""Training samples, as many of each class, spread over space, whatever the order of the points; and ground held out.

Each class's points are put in the order of a space-filling curve (Morton's, over 0.5 m cells) and taken from it at equal
steps, from a place drawn by the seed on. So samples follow the class wherever it is, none of them clumped, and a class's
dense parts weigh as they do in the cloud. Ties within a cell are ordered by a hash of the coordinates.

Neighboring points share most of their features, so a forest nearly knows the neighbors of its samples: a score on them
flatters, and a next pass trained on what it says there would trust what nobody knows elsewhere. So whole surveys or blocks
of ground are held out in turn.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any
from zlib import crc32

import numpy as np
import numpy.typing as npt

from ..accuracy.measures import Accuracy
from ..accuracy.text import summary
from ..base.errors import OptionError
from ..base.grid import places_among
from ..base.hashing import hash_of
from ..base.progress import Progress

#: Side of a cell of the curve in meters.
CELL = 0.5
#: Points of a class that are put in order at a time; of more, those with the smallest hashes.
MOST = 5_000_000


#: Side of a block in meters; where too few have samples it is halved down to the other.
BLOCK, SMALLEST = 25.0, 0.02
#: Fewer surveys than this are cut into blocks: else too little would be left to train the next pass on.
SURVEYS = 3


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
    random_order: bool = False,
    progress: Progress | None = None,
) -> Samples:
    """Draw `count` samples of each class from several clouds.

    `clouds` are pairs of (n, 3) coordinates in meters and (n,) class positions, -1 to leave the
    point out. No more samples are drawn than the largest class has points; a class with fewer gives
    each of them count/n times, rounded down or up. With `random_order` samples are drawn at random
    from all points of a class instead of spread over the ground, and each class gives `count`, if
    only as duplicates. Clouds of one of the `groups` give as many of a class as those of the
    others, as far as they have them. `progress` is updated with the points looked at: all of them
    once, and once more for each class.
    """
    names, of_cloud = np.unique(groups or [""] * len(clouds), return_inverse=True)
    there = np.zeros((len(names), n_classes), np.int64)
    for number, (_, position) in enumerate(clouds):
        there[of_cloud[number]] += np.bincount(position[position >= 0], minlength=n_classes)
        if progress is not None:
            progress.update(len(position))
    available = there.sum(axis=0)
    if not available.all():
        raise OptionError(
            "a class has no samples", found=f"class position {int(np.argmin(available))}"
        )
    if not random_order:
        count = min(count, int(available.max()))
    alone = np.count_nonzero(there.any(axis=1)) == 1
    parts = []
    for position in range(n_classes):
        quota = share_out(there[:, position], count)
        for group in np.flatnonzero(quota):
            random = (
                [seed, position] if alone else [seed, position, crc32(str(names[group]).encode())]
            )
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
            cell = np.zeros_like(found["cell"]) if random_order else found["cell"]
            order = np.lexsort((found["hash"], cell))
            place, weight = spread(len(order), int(quota[group]), np.random.default_rng(random))
            chosen = order[place]
            parts.append(
                (cloud[chosen], row[chosen], np.full(len(chosen), position, np.int16), weight)
            )
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
    keys["hash"] = hash_of(xyz.T, seed)
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


@dataclass(frozen=True, eq=False)
class Folds:
    """Which part of the training ground a point belongs to."""

    count: int
    surveys: dict[str, int]  #: fold of each, where whole surveys are folds
    #: of blocks, meters; they are anchored to absolute coordinates, so that clouds that overlap share them
    side: float = BLOCK
    #: (m,) number of each block that has samples, ascending, and its fold; others follow from their number
    blocks: npt.NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    fold: npt.NDArray[np.int16] = field(default_factory=lambda: np.zeros(0, np.int16))

    @classmethod
    def of_blocks(
        cls,
        xy: npt.NDArray[np.float64],
        label: npt.NDArray[Any],
        weight: npt.NDArray[Any],
        folds: int,
        side: float,
    ) -> Folds:
        """Blocks dealt out so that every fold has its share of each class of the samples, (n, 2) meters; `label` is their
        class positions, `weight` how often they count."""
        blocks, block = np.unique(_numbers(xy, side), return_inverse=True)
        if len(blocks) < folds:
            raise OptionError(
                f"the samples cover {len(blocks)} block(s) of {side:g} m, fewer than the {folds} folds",
                found=f"folds {folds}",
                cure="Take smaller blocks, fewer folds, or more training data",
            )
        content = np.zeros((len(blocks), int(label.max()) + 1))
        np.add.at(content, (block, label), weight)
        # Dealt out in turn, to and fro, those with most of the rarest class first.
        rarest_last = np.argsort(-(content > 0).sum(axis=0), kind="stable")
        order = np.lexsort(-content[:, rarest_last].T)
        fold = np.empty(len(blocks), np.int16)
        turn = np.arange(len(blocks)) % (2 * folds)
        fold[order] = np.minimum(turn, 2 * folds - 1 - turn)
        return cls(folds, {}, side, blocks, fold)

    @classmethod
    def of_ground(
        cls,
        xy: npt.NDArray[np.float64],
        label: npt.NDArray[Any],
        weight: npt.NDArray[Any],
        surveys: Sequence[str],
        folds: int,
    ) -> Folds:
        """Whole surveys where there are enough, up to twice as many folds, else blocks as small as need be."""
        names = sorted(set(surveys))
        if len(names) >= SURVEYS:
            folds = min(2 * folds, len(names))
            return cls(folds, {name: number % folds for number, name in enumerate(names)})
        side = BLOCK
        while side >= SMALLEST:
            try:
                return cls.of_blocks(xy, label, weight, folds, side)
            except OptionError:
                side /= 2.0
        raise OptionError(
            f"the labeled ground is too small to be cut into {folds} parts",
            cure="Give more training data, or set passes to 1",
        )

    def points(self, xyz: npt.NDArray[np.float64], survey: str = "") -> npt.NDArray[np.int16]:
        """The fold of each point of a cloud."""
        if self.surveys:
            return np.full(len(xyz), self.surveys[survey], np.int16)
        number = _numbers(xyz, self.side)
        at, there = places_among(self.blocks, number)
        return np.where(there, self.fold[at], number % self.count).astype(np.int16)


def _numbers(xyz: npt.NDArray[np.float64], side: float) -> npt.NDArray[np.int64]:
    """The number of each point's block."""
    cell = np.floor(xyz[:, :2] / side).astype(np.int64)
    return (cell[:, 0] << 32) + cell[:, 1]


def split(
    xy: npt.NDArray[np.float64], fold: npt.NDArray[Any], number: int, gap: float
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.int64]]:
    """(training mask, rows held out) of one fold; none of the former is within `gap` meters of the latter."""
    from scipy.spatial import cKDTree

    held = fold == number
    train = ~held
    if gap > 0 and held.any():
        others = np.flatnonzero(train)
        distance, _ = cKDTree(xy[held]).query(
            xy[others], distance_upper_bound=np.nextafter(gap, np.inf)
        )
        train[others[distance <= gap]] = False
    return train, np.flatnonzero(held)


def figures(matrix: npt.NDArray[np.int64], codes: Sequence[int]) -> dict[str, Any]:
    """The measures kept in a model file; rows of the matrix are the truth."""
    accuracy = Accuracy.from_confusion(matrix, codes)
    found = summary(accuracy)
    del found["points"]
    return {
        **found,
        "f1": {str(one.code): one.f1 if one.support else None for one in accuracy.per_class},
    }
