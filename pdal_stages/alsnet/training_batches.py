"""Batches that are trained on, their augmentation, and ground held out. No PyTorch here."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ..classifier.sampling import Folds
from .batches import REACH, Batches


def join_clouds(
    clouds: Sequence[npt.NDArray[np.float64]], spacing: float
) -> npt.NDArray[np.float64]:
    """Join clouds, moved along x by whole spacings so that no batch holds points of two."""
    out: list[npt.NDArray[np.float64]] = []
    right = None
    for xyz in clouds:
        if len(xyz):
            steps = 0.0 if right is None else np.ceil((right - xyz[:, 0].min()) / spacing)
            xyz = xyz + np.array([steps * spacing, 0.0, 0.0])
            right = float(xyz[:, 0].max()) + 8.0 * REACH * spacing
        out.append(xyz)
    return np.concatenate(out)


def histogram_deviation(histogram: npt.NDArray[Any]) -> float:
    """Return the standard deviation of a batch's class shares, in per cent [WM19 4.1].

    It is large where one class is nearly all.

    Infinite for a batch without labels.
    """
    total = histogram.sum()
    return float(np.std(histogram / total) * 100.0) if total else float("inf")


def select_batches(
    batches: Batches, labels: npt.NDArray[Any], n_classes: int, threshold: float
) -> list[int]:
    """Return the numbers of batches with a variety of classes [WM19 4.1].

    Where that leaves a class without any batch, the most mixed one that has it is taken too. Labels
    (n,) are class positions; -1 is not looked at.
    """
    parts = (labels[batches.members(number)] for number in range(len(batches)))
    histograms = [np.bincount(part[part >= 0], minlength=n_classes) for part in parts]
    spreads = [histogram_deviation(histogram) for histogram in histograms]
    chosen = {number for number, value in enumerate(spreads) if value < threshold}
    for position in range(n_classes):
        having = [number for number, histogram in enumerate(histograms) if histogram[position]]
        if having and not chosen.intersection(having):
            chosen.add(min(having, key=lambda number: spreads[number]))
    return sorted(chosen)


def hold_out(
    xyz: npt.NDArray[np.float64], labels: npt.NDArray[Any], share: float, block_size: float
) -> npt.NDArray[np.bool_]:
    """Return which labeled points (not -1) lie in the blocks held out for validation."""
    out, use = np.zeros(len(xyz), bool), np.flatnonzero(labels >= 0)
    if share == 0.0:
        return out
    folds = Folds.of_blocks(
        xyz[use, :2], labels[use], np.ones(len(use)), max(2, round(1.0 / share)), block_size
    )
    out[use] = folds.points(xyz[use, :2]) == 0
    return out


def cover(batches: Batches, wanted: npt.NDArray[np.bool_]) -> list[int]:
    """Return batches that hold every wanted point at least once, those with most of them first."""
    left, out = wanted.copy(), []
    numbers = batches.holding(np.flatnonzero(wanted)).tolist()
    for number in sorted(
        numbers, key=lambda number: -np.count_nonzero(wanted[batches.members(number)])
    ):
        members = batches.members(number)
        if left[members].any():
            left[members] = False
            out.append(number)
    return sorted(out)


def class_weights(count: npt.NDArray[Any], kind: str) -> npt.NDArray[np.float64]:
    """Return the weight of each class in the loss; their mean over the points is 1."""
    share = count / count.sum()
    if kind == "none":
        return np.ones(len(count))
    weight = 1.0 / np.sqrt(share) if kind == "sqrt" else 1.0 / share
    return weight / (weight * share).sum()


#: Augmentation: most that a batch's center moves along x and y, in spacings.
SHIFT = 0.5
#: Augmentation: standard deviation of noise on coordinates, meters; it is cut at three times that.
JITTER = 0.01
#: Augmentation: largest share of points that a batch loses.
THIN = 0.4
#: Augmentation: fewest points that are left, where there are so many.
LEAST = 16


def augment(
    xyz: npt.NDArray[np.float64], random: np.random.Generator
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
    """Rotate a batch about z, shake and thin it.

    Return coordinates (m, 3) and the rows kept, of coordinates (n, 3) around its center.
    """
    share = 1.0 - random.uniform(0.0, THIN)
    kept = np.sort(
        random.permutation(len(xyz))[: max(min(LEAST, len(xyz)), round(share * len(xyz)))]
    )
    angle = random.uniform(0.0, 2.0 * math.pi)
    c, s = math.cos(angle), math.sin(angle)
    out = xyz[kept] @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return out + np.clip(random.normal(0.0, JITTER, out.shape), -3.0 * JITTER, 3.0 * JITTER), kept
