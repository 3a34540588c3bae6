"""Draw training samples, and hold ground out.

Samples: as many of each class, spread over space, whatever the order of the points. Each class's
points are put in the order of a space-filling curve (Morton's, over 0.5 m cells) and taken from it
at equal steps, from a place drawn by the seed on. So samples follow the class wherever it is, none
of them clumped, and a class's dense parts weigh as they do in the cloud. Ties within a cell are
ordered by a hash of the coordinates.

Neighboring points share most of their features, so a forest nearly knows the neighbors of its
samples: a score on them flatters, and a next pass that is trained on its votes there would trust
votes that are worse elsewhere. So whole surveys or blocks of ground are held out in turn.
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
from ..base.hashing import hash_rows
from ..base.json_types import JsonObject
from ..base.progress import Progress
from .model_info import SampleCounts

#: Side of a cell of the curve in meters (not tuned).
CELL = 0.5
#: Points of a class that are put in order at a time, to bound memory (not tuned); of more, those
#: with the smallest hashes.
MOST_IN_ORDER = 5_000_000
#: Side of a block of ground held out, in meters: wider than the neighborhoods of features.
BLOCK_M = 25.0
#: Where too few blocks have samples the side is halved, but not below this many meters.
SMALLEST_BLOCK = 0.02
#: Fewer surveys than this are cut into blocks: else too little would be left to train on.
FEWEST_SURVEYS = 3


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
        """Return the number of samples."""
        return len(self.row)

    def of_cloud(self, number: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Return the places of a cloud's samples here, and their rows in the cloud, ascending."""
        at = np.flatnonzero(self.cloud == number)
        at = at[np.argsort(self.row[at], kind="stable")]
        return at, self.row[at]

    def take(self, array_of: Callable[[int], npt.NDArray]) -> npt.NDArray:
        """Return the samples' values (m, ...) from an array of values for all points of each cloud.

        `array_of` returns the array of a cloud by its number, and is called for clouds with samples
        alone.
        """
        places, parts = [], []
        for number in np.unique(self.cloud).tolist():
            places.append(np.flatnonzero(self.cloud == number))
            parts.append(array_of(number)[self.row[places[-1]]])
        values = np.concatenate(parts)
        out = np.empty_like(values)
        out[np.concatenate(places)] = values
        return out

    def counts(self, position: int) -> SampleCounts:
        """Return the points available, different points drawn, and duplicates of one class."""
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
    fill_up: bool = True,
    random_order: bool = False,
    progress: Progress | None = None,
) -> Samples:
    """Draw `count` samples of each class from several clouds.

    `clouds` are pairs of (n, 3) coordinates in meters and (n,) class positions, -1 to leave the
    point out. No more samples are drawn than the largest class has points; a class with fewer gives
    each of them count/n times, rounded down or up. With `random_order` samples are drawn at random
    from all points of a class instead of spread over the ground, and each class gives `count`, if
    only as duplicates. Without `fill_up` no point is drawn twice. Clouds of one of the `groups`
    give as many of a class as those of the others, as far as they have them. `progress` is updated
    with the points looked at: all of them once, and once more for each class.
    """
    names, of_cloud = np.unique(groups or [""] * len(clouds), return_inverse=True)
    there = np.zeros((len(names), n_classes), np.int64)
    for number, (_, position) in enumerate(clouds):
        there[of_cloud[number]] += np.bincount(position[position >= 0], minlength=n_classes)
        if progress is not None:
            progress.update(len(position))
    available = there.sum(axis=0)
    if not available.all():
        raise OptionError("a class has no samples", found=f"position {int(np.argmin(available))}")
    if not random_order:
        count = min(count, int(available.max()))
    is_alone = np.count_nonzero(there.any(axis=1)) == 1
    parts = []
    for position in range(n_classes):
        of_class = count if fill_up else min(count, int(available[position]))
        quota = share_out(there[:, position], of_class)
        for group in np.flatnonzero(quota):
            state = [seed, position]
            if not is_alone:
                state.append(crc32(str(names[group]).encode()))
            share = min(1.0, MOST_IN_ORDER / there[group, position])
            numbers = np.flatnonzero(of_cloud == group).tolist()
            keys, row, cloud = _keys_of_class(clouds, numbers, position, seed, share, progress)
            cell = np.zeros_like(keys["cell"]) if random_order else keys["cell"]
            order = np.lexsort((keys["hash"], cell))
            place, weight = spread(len(order), int(quota[group]), np.random.default_rng(state))
            drawn = order[place]
            label = np.full(len(drawn), position, np.int16)
            parts.append((cloud[drawn], row[drawn], label, weight))
    cloud, row, label, weight = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Samples(cloud, row, label, weight, tuple(available.tolist()))


def _keys_of_class(
    clouds: Any,
    numbers: Sequence[int],
    position: int,
    seed: int,
    share: float,
    progress: Progress | None,
) -> tuple[npt.NDArray, npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Return keys (m,) of a share of a class's points in some clouds, their rows, and their clouds.

    A point stays or goes by the hash of its key.
    """
    limit = np.uint64(share * (2.0**64 - 2048.0))
    keys, rows, cloud = [], [], []
    for number in numbers:
        xyz, label = clouds[number]
        members = np.flatnonzero(label == position)
        key = curve_keys(xyz[members], seed)
        keep = key["hash"] <= limit
        keys.append(key[keep])
        rows.append(members[keep])
        cloud.append(np.full(len(rows[-1]), number))
        if progress is not None:
            progress.update(len(label))
    return np.concatenate(keys), np.concatenate(rows), np.concatenate(cloud)


def share_out(available: npt.NDArray[np.int64], count: int) -> npt.NDArray[np.int64]:
    """Return how many of `count` samples each group gives, from how many it has (groups,).

    All give as many, as far as they have them; where there are fewer than `count` in all, each
    gives its share, with copies.
    """
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
    """Return places and weights of `count` of `n` in a row, equally far apart, first at random."""
    share, rest = divmod(count, n)
    picks = np.floor((np.arange(rest) + random.random()) * (n / max(rest, 1))).astype(np.int64)
    picks = np.minimum(picks, n - 1)
    if share == 0:
        return picks, np.ones(rest, np.int64)
    weight = np.full(n, share, np.int64)
    weight[picks] += 1
    return np.arange(n), weight


def curve_keys(xyz: npt.NDArray[np.float64], seed: int) -> npt.NDArray:
    """Morton code of each point's cell in plan, and a hash of its coordinates and the seed."""
    # Anchored to absolute coordinates, so a larger extent changes nothing; 31 bits an axis hold
    # half a million kilometers either way.
    cells = np.clip(np.floor(xyz[:, :2] / CELL) + 2**30, 0, 2**31 - 1).astype(np.uint64)
    keys = np.empty(len(xyz), dtype=[("cell", np.uint64), ("hash", np.uint64)])
    keys["cell"] = _spread_bits(cells[:, 0]) | (_spread_bits(cells[:, 1]) << np.uint64(1))
    keys["hash"] = hash_rows(xyz.T, seed)
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
    """Parts of the training ground, of which each point belongs to one."""

    count: int
    surveys: dict[str, int]  #: fold of each, where whole surveys are folds
    #: of blocks in meters, which are anchored to absolute coordinates: overlapping clouds share
    #: them
    side: float = BLOCK_M
    #: (m,) number of each block that has samples, ascending; other blocks are dealt by their number
    blocks: npt.NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    #: (m,) their folds
    fold: npt.NDArray[np.int16] = field(default_factory=lambda: np.zeros(0, np.int16))

    @classmethod
    def of_blocks(
        cls,
        xy: npt.NDArray[np.float64],
        label: npt.NDArray,
        weight: npt.NDArray,
        folds: int,
        side: float,
    ) -> Folds:
        """Deal out blocks so that every fold has its share of each class of the samples.

        `xy` (n, 2) are their places in meters, `label` (n,) their class positions, `weight` (n,)
        how often they count.
        """
        blocks, block = np.unique(_numbers(xy, side), return_inverse=True)
        if len(blocks) < folds:
            raise OptionError(
                f"the samples cover {len(blocks)} block(s) of {side:g} m, fewer than the folds",
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
        label: npt.NDArray,
        weight: npt.NDArray,
        surveys: Sequence[str],
        folds: int,
    ) -> Folds:
        """Hold out whole surveys where there are enough, else blocks as small as need be.

        Of surveys there are up to twice as many folds.
        """
        names = sorted(set(surveys))
        if len(names) >= FEWEST_SURVEYS:
            folds = min(2 * folds, len(names))
            return cls(folds, {name: number % folds for number, name in enumerate(names)})
        side = BLOCK_M
        while side >= SMALLEST_BLOCK:
            try:
                return cls.of_blocks(xy, label, weight, folds, side)
            except OptionError:
                side /= 2.0
        raise OptionError(
            f"the labeled ground is too small to be cut into {folds} parts",
            cure="Give more training data, or set passes to 1",
        )

    def points(self, xyz: npt.NDArray[np.float64], survey: str = "") -> npt.NDArray[np.int16]:
        """Return the fold (n,) of each point of a cloud."""
        if self.surveys:
            return np.full(len(xyz), self.surveys[survey], np.int16)
        number = _numbers(xyz, self.side)
        at, there = places_among(self.blocks, number)
        return np.where(there, self.fold[at], number % self.count).astype(np.int16)


def _numbers(xyz: npt.NDArray[np.float64], side: float) -> npt.NDArray[np.int64]:
    """Return the number (n,) of each point's block."""
    cell = np.floor(xyz[:, :2] / side).astype(np.int64)
    return (cell[:, 0] << 32) + cell[:, 1]


def split(
    xy: npt.NDArray[np.float64], fold: npt.NDArray, number: int, gap: float
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.int64]]:
    """Return the training mask (n,) and the rows held out (m,) of one fold.

    Samples closer than `gap` meters to those held out are in neither.
    """
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


def figures(matrix: npt.NDArray[np.int64], codes: Sequence[int]) -> JsonObject:
    """Return the measures kept in a model file; rows of the matrix are the truth."""
    accuracy = Accuracy.from_confusion(matrix, codes)
    measures = summary(accuracy)
    del measures["points"]
    scores = {str(each.code): each.f1 if each.support else None for each in accuracy.per_class}
    return {**measures, "f1": scores}
