"""Which batches are trained on and how they are changed, and which ground is held out. No PyTorch here."""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import OptionError
from ..classifier.holdout import Folds
from .circles import Circles
from .configuration import NetworkOptions

#: A batch of a cloud: (cloud, circle).
Batch = tuple[int, int]


def spread(histogram: npt.NDArray[Any]) -> float:
    """Standard deviation of a batch's class shares, per cent: large where one class is nearly all [WM19].

    Infinite for a batch without labels.
    """
    total = histogram.sum()
    return float(np.std(histogram / total) * 100.0) if total else float("inf")


def choose(
    circles: Sequence[Circles], labels: Sequence[npt.NDArray[Any]], n_classes: int, threshold: float
) -> list[Batch]:
    """Batches whose classes are mixed; see ``NetworkOptions.histogram_threshold``.

    Where that leaves a class without any batch, the most mixed one that has it is taken too.

    Parameters
    ----------
    circles : one per cloud
    labels : one (n,) array of class positions per cloud; -1 is not looked at
    """
    histograms: dict[Batch, npt.NDArray[np.int64]] = {}
    for cloud, (one, label) in enumerate(zip(circles, labels, strict=True)):
        for number in range(len(one)):
            mine = label[one.members(number)]
            histograms[cloud, number] = np.bincount(mine[mine >= 0], minlength=n_classes)
    spreads = {batch: spread(histogram) for batch, histogram in histograms.items()}
    chosen = {batch for batch, value in spreads.items() if value < threshold}
    for position in range(n_classes):
        having = [batch for batch in histograms if histograms[batch][position]]
        if having and not chosen.intersection(having):
            chosen.add(min(having, key=lambda batch: (spreads[batch], batch)))
    return sorted(chosen)


def hold_out(
    clouds: Sequence[npt.NDArray[np.float64]],
    labels: Sequence[npt.NDArray[Any]],
    share: float,
    block_size: float,
) -> list[npt.NDArray[np.bool_]]:
    """Which points lie in the blocks held out for validation, one mask per cloud."""
    if share == 0.0:
        return [np.zeros(len(xyz), bool) for xyz in clouds]
    use = [np.flatnonzero(label >= 0) for label in labels]
    xy = np.concatenate([xyz[rows, :2] for xyz, rows in zip(clouds, use, strict=True)])
    label = np.concatenate([one[rows] for one, rows in zip(labels, use, strict=True)])
    folds = max(2, round(1.0 / share))
    try:
        fold = Folds.of_blocks(xy, label, np.ones(len(xy)), folds, block_size).points(xy)
    except OptionError as error:
        raise OptionError(
            error.what,
            found=f"validation {share:g}, block_size {block_size:g}",
            cure="Make block_size smaller, or set validation to 0 and choose the number of epochs yourself",
        ) from None
    out, start = [], 0
    for xyz, rows in zip(clouds, use, strict=True):
        mask = np.zeros(len(xyz), bool)
        mask[rows] = fold[start : start + len(rows)] == 0
        out.append(mask)
        start += len(rows)
    return out


def covering(circles: Circles, wanted: npt.NDArray[np.bool_]) -> list[int]:
    """A few circles that hold every wanted point at least once: always the one that adds most."""
    left = wanted.copy()
    out: list[int] = []
    if not left.any():
        return out
    numbers = circles.needed(np.flatnonzero(left)).tolist()
    heap = [(-int(np.count_nonzero(left[circles.members(number)])), number) for number in numbers]
    heapq.heapify(heap)
    while left.any():
        _, number = heapq.heappop(heap)
        members = circles.members(number)
        gain = int(np.count_nonzero(left[members]))  # it only shrinks, so an old value is an upper bound
        if heap and -gain > heap[0][0]:
            heapq.heappush(heap, (-gain, number))
            continue
        left[members] = False
        out.append(number)
    return sorted(out)


def class_weights(count: npt.NDArray[Any], kind: str) -> npt.NDArray[np.float64]:
    """Weight of each class in the loss; their mean over the points is 1."""
    share = count / count.sum()
    if kind == "none":
        return np.ones(len(count))
    weight = 1.0 / np.sqrt(share) if kind == "sqrt" else 1.0 / share
    return weight / (weight * share).sum()


#: Fewest points thinning leaves.
LEAST = 16


def augmented(
    xyz: npt.NDArray[np.float64], options: NetworkOptions, random: np.random.Generator
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
    """A batch turned about z, shaken and thinned: from coordinates (n, 3) around its center to (m, 3), and the rows kept."""
    kept = np.arange(len(xyz))
    if options.thin > 0.0:
        share = 1.0 - random.uniform(0.0, options.thin)
        kept = np.sort(random.permutation(len(xyz))[: max(min(LEAST, len(xyz)), round(share * len(xyz)))])
    out = xyz[kept]
    if options.rotate:
        angle = random.uniform(0.0, 2.0 * math.pi)
        c, s = math.cos(angle), math.sin(angle)
        out = out @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    if options.jitter > 0.0:
        noise = random.normal(0.0, options.jitter, out.shape)
        out = out + np.clip(noise, -3.0 * options.jitter, 3.0 * options.jitter)
    return out, kept
