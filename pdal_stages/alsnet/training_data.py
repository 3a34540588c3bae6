"""Labeled clouds as one, cut into batches: those trained on, and the ground held out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import OptionError
from ..base.threads import resolve_threads
from ..classifier.input_dimensions import add_surroundings, take_dimensions
from ..classifier.sampling import Folds
from ..classifier.training_clouds import TrainingCloud, label_classes
from ..classifier.training_options import TrainingOptions
from ..features.cell_means import density
from .batches import Batches, Pyramid, spacing_for
from .classifier import AlsNet, make_pyramid, normalize_inputs
from .configuration import REACH

#: An input whose standard deviation is lower is not divided by it.
_LEAST_DEVIATION = 1e-6
#: Reaches of a batch between two clouds that are joined. Its points lie within one of its grid
#: point, so more than two would do.
_APART = 8.0


class TrainingData:
    """All n points of the training clouds, and the batches that they make.

    Inputs are normalized as those of the network `start`, if there is one.
    """

    def __init__(
        self,
        clouds: Sequence[TrainingCloud],
        options: TrainingOptions,
        inputs: tuple[str, ...],
        start: AlsNet | None,
    ) -> None:
        network = options.alsnet
        self.labeled = label_classes(clouds, options)
        self.n_classes = len(self.labeled.classes.codes)
        self.configuration, self.inputs = network.configuration, inputs
        #: (n,) which class; -1 where a point is only a neighbor
        self.position = np.concatenate([np.asarray(labels) for _, labels in self.labeled])
        values = _concatenate_inputs(clouds, inputs, resolve_threads(options.threads))
        #: mean and standard deviation of each input over the labeled points
        self.mean, self.scale = (
            _mean_and_scale(values, inputs, self.position >= 0)
            if start is None
            else (start.mean, start.scale)
        )
        parts = [cloud.xyz for cloud in clouds]
        points = self.configuration.points
        dense = float(np.median([density(xyz) for xyz in parts]))
        self.spacing = network.spacing or spacing_for(points, dense)  #: of the batches, meters
        self.xyz = join_clouds(
            parts, self.spacing, network.reach
        )  #: (n, 3) meters; the clouds lie side by side
        #: (n, inputs) normalized
        self.columns = normalize_inputs(self.xyz, values, inputs, self.mean, self.scale)
        held = hold_out(
            np.concatenate(parts), self.position, network.validation, network.block_size
        )
        #: (n,) class positions that are trained on, and those on the ground held out; -1 elsewhere
        self.train_labels = np.where(held, -1, self.position).astype(np.int64)
        self.held_labels = np.where(held, self.position, -1).astype(np.int64)
        self.batches = Batches(self.xyz, points, self.spacing, self.columns, network.reach)

    def count_trained(self) -> npt.NDArray[np.int64]:
        """Return the points of each class that are trained on; OptionError where there are none."""
        labels, classes = self.train_labels, self.labeled.classes
        count = np.bincount(labels[labels >= 0], minlength=self.n_classes)
        if not count.all():
            k = int(np.argmin(count))
            raise OptionError(
                f"class {classes.codes[k]} ({classes.names[k]}) has no points outside the ground "
                "held out",
                cure="Make block_size smaller, set validation to 0, or give more training data",
            )
        return count

    def pyramid(
        self, members: npt.NDArray[np.int64], center: npt.NDArray[np.float64], random: Any = None
    ) -> tuple[npt.NDArray[np.int64], Pyramid]:
        """Return the rows of a batch's points in its own order, and its pyramid.

        With a `random` generator the batch is augmented.
        """
        order, pyramid = make_pyramid(
            self.xyz, self.columns, members, center, self.inputs, self.configuration, random
        )
        return members[order], pyramid


def _concatenate_inputs(
    clouds: Sequence[TrainingCloud], inputs: tuple[str, ...], threads: int
) -> dict[str, npt.NDArray[np.float64]]:
    """Return the values (n,) of all inputs that are dimensions, of all clouds."""
    parts = []
    for cloud in clouds:
        known = add_surroundings(inputs, cloud.xyz, cloud.dimensions, threads)
        parts.append(take_dimensions(inputs, known, len(cloud), where=cloud.name))
    return {
        name: np.concatenate([part[name] for part in parts]).astype(np.float64) for name in parts[0]
    }


def _mean_and_scale(
    values: dict[str, npt.NDArray[np.float64]], inputs: Sequence[str], rows: npt.NDArray[np.bool_]
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return mean and standard deviation of inputs at some rows; 0 and 1 for coordinates."""
    columns = [values.get(name, np.zeros(len(rows)))[rows] for name in inputs]
    mean = tuple(float(column.mean()) for column in columns)
    deviation = [float(column.std()) for column in columns]
    return mean, tuple(each if each > _LEAST_DEVIATION else 1.0 for each in deviation)


def join_clouds(
    clouds: Sequence[npt.NDArray[np.float64]], spacing: float, reach: float = REACH
) -> npt.NDArray[np.float64]:
    """Join clouds, moved along x by whole spacings so that no batch holds points of two."""
    out: list[npt.NDArray[np.float64]] = []
    right = None
    for xyz in clouds:
        if len(xyz):
            steps = 0.0 if right is None else np.ceil((right - xyz[:, 0].min()) / spacing)
            xyz = xyz + np.array([steps * spacing, 0.0, 0.0])
            right = float(xyz[:, 0].max()) + _APART * reach * spacing
        out.append(xyz)
    return np.concatenate(out)


def histogram_deviation(histogram: npt.NDArray) -> float:
    """Return the standard deviation of a batch's class shares, in per cent [WM19 4.1].

    The deviation is large where nearly all points are of one class.

    Infinite for a batch without labels.
    """
    total = histogram.sum()
    return float(np.std(histogram / total) * 100.0) if total else float("inf")


def select_batches(
    batches: Batches, labels: npt.NDArray, n_classes: int, threshold: float
) -> tuple[list[int], int]:
    """Return the numbers of batches with a variety of classes, and how many were added to them.

    Where the variety [WM19 4.1] leaves a class without any batch, the most mixed one that has it is
    added. Labels (n,) are class positions; -1 is not looked at.
    """
    parts = (labels[batches.members(number)] for number in range(len(batches)))
    histograms = [np.bincount(part[part >= 0], minlength=n_classes) for part in parts]
    spreads = [histogram_deviation(histogram) for histogram in histograms]
    chosen = {number for number, value in enumerate(spreads) if value < threshold}
    mixed = len(chosen)
    for position in range(n_classes):
        having = [number for number, histogram in enumerate(histograms) if histogram[position]]
        if having and not chosen.intersection(having):
            chosen.add(min(having, key=lambda number: spreads[number]))
    return sorted(chosen), len(chosen) - mixed


def hold_out(
    xyz: npt.NDArray[np.float64], labels: npt.NDArray, share: float, block_size: float
) -> npt.NDArray[np.bool_]:
    """Return which labeled points (not -1) lie in the blocks held out for validation.

    The blocks are one of round(1 / `share`) folds: of `share` 0.4 one of two, a half.
    """
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


def class_weights(count: npt.NDArray, kind: str) -> npt.NDArray[np.float64]:
    """Return the weight of each class in the loss; their mean over the points is 1."""
    share = count / count.sum()
    if kind == "none":
        return np.ones(len(count))
    weight = 1.0 / np.sqrt(share) if kind == "sqrt" else 1.0 / share
    return weight / (weight * share).sum()
