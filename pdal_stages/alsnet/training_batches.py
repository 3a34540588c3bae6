"""Which batches are trained on and how they are changed, and which ground is held out. No PyTorch
here."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ..classifier.sampling import Folds
from .batches import REACH, Circles


def side_by_side(
    clouds: Sequence[npt.NDArray[np.float64]], spacing: float
) -> npt.NDArray[np.float64]:
    """All clouds as one, moved along x by whole spacings until no batch can hold points of two."""
    out: list[npt.NDArray[np.float64]] = []
    right = None
    for xyz in clouds:
        if len(xyz):
            steps = 0.0 if right is None else np.ceil((right - xyz[:, 0].min()) / spacing)
            xyz = xyz + np.array([steps * spacing, 0.0, 0.0])
            right = float(xyz[:, 0].max()) + 8.0 * REACH * spacing
        out.append(xyz)
    return np.concatenate(out)


def spread(histogram: npt.NDArray[Any]) -> float:
    """Standard deviation of a batch's class shares, per cent: large where one class is nearly all
    [WM19].

    Infinite for a batch without labels.
    """
    total = histogram.sum()
    return float(np.std(histogram / total) * 100.0) if total else float("inf")


def choose(
    circles: Circles, labels: npt.NDArray[Any], n_classes: int, threshold: float
) -> list[int]:
    """Batches whose classes are mixed; see ``NetworkOptions.histogram_threshold``.

    Where that leaves a class without any batch, the most mixed one that has it is taken too. Labels
    (n,) are class positions; -1 is not looked at.
    """
    mine = (labels[circles.members(number)] for number in range(len(circles)))
    histograms = [np.bincount(part[part >= 0], minlength=n_classes) for part in mine]
    spreads = [spread(histogram) for histogram in histograms]
    chosen = {number for number, value in enumerate(spreads) if value < threshold}
    for position in range(n_classes):
        having = [number for number, histogram in enumerate(histograms) if histogram[position]]
        if having and not chosen.intersection(having):
            chosen.add(min(having, key=lambda number: spreads[number]))
    return sorted(chosen)


def hold_out(
    xyz: npt.NDArray[np.float64], labels: npt.NDArray[Any], share: float, block_size: float
) -> npt.NDArray[np.bool_]:
    """Which labeled points (not -1) lie in the blocks held out for validation."""
    out, use = np.zeros(len(xyz), bool), np.flatnonzero(labels >= 0)
    if share == 0.0:
        return out
    folds = Folds.of_blocks(
        xyz[use, :2], labels[use], np.ones(len(use)), max(2, round(1.0 / share)), block_size
    )
    out[use] = folds.points(xyz[use, :2]) == 0
    return out


def covering(circles: Circles, wanted: npt.NDArray[np.bool_]) -> list[int]:
    """Circles that hold every wanted point at least once, those with most of them first."""
    left, out = wanted.copy(), []
    numbers = circles.needed(np.flatnonzero(wanted)).tolist()
    for number in sorted(
        numbers, key=lambda number: -np.count_nonzero(wanted[circles.members(number)])
    ):
        members = circles.members(number)
        if left[members].any():
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


#: Augmentation: most that a batch's center moves, in spacings; standard deviation of noise on
#: coordinates, meters, cut at three times that; most points a batch loses, and fewest that are
#: left.
SHIFT, JITTER, THIN, LEAST = 0.5, 0.01, 0.4, 16


def augmented(
    xyz: npt.NDArray[np.float64], random: np.random.Generator
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
    """A batch turned about z, shaken and thinned: from coordinates (n, 3) around its center to (m,
    3), and the rows kept."""
    share = 1.0 - random.uniform(0.0, THIN)
    kept = np.sort(
        random.permutation(len(xyz))[: max(min(LEAST, len(xyz)), round(share * len(xyz)))]
    )
    angle = random.uniform(0.0, 2.0 * math.pi)
    c, s = math.cos(angle), math.sin(angle)
    out = xyz[kept] @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return out + np.clip(random.normal(0.0, JITTER, out.shape), -3.0 * JITTER, 3.0 * JITTER), kept
