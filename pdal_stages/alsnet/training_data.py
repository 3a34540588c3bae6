"""Labeled clouds as one, cut into batches: what is trained on, and the ground held out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import OptionError
from ..base.threads import resolve_threads
from ..classifier.input_dimensions import add_return_features, take_dimensions
from ..classifier.training_clouds import Labeled, TrainingCloud, label_classes
from ..classifier.training_options import TrainingOptions
from ..features.cell_means import density
from . import training_batches
from .batches import Batches, spacing_for
from .classifier import AlsNet, make_pyramid, normalize_inputs
from .configuration import Configuration
from .sampling_and_grouping import Pyramid

#: An input whose standard deviation is lower is not divided by it.
_LEAST_DEVIATION = 1e-6


@dataclass(frozen=True, eq=False)
class TrainingData:
    """All n points of the training clouds, and the batches that they make."""

    labeled: Labeled
    counts: tuple[int, ...]  #: points of each cloud
    configuration: Configuration
    inputs: tuple[str, ...]
    mean: tuple[float, ...]  #: of each input over the labeled points
    scale: tuple[float, ...]  #: standard deviation of each input
    spacing: float  #: of the batches, meters
    xyz: npt.NDArray[np.float64]  #: (n, 3) meters; the clouds lie side by side
    columns: npt.NDArray[np.float32]  #: (n, inputs) normalized
    position: npt.NDArray[np.int64]  #: (n,) which class; -1 where a point is only a neighbor
    held: npt.NDArray[np.bool_]  #: (n,) points on the ground held out
    batches: Batches

    @classmethod
    def prepare(
        cls,
        clouds: Sequence[TrainingCloud],
        options: TrainingOptions,
        inputs: tuple[str, ...],
        start: AlsNet | None,
    ) -> TrainingData:
        """Return the data of clouds; inputs are normalized as those of a network to start from."""
        network = options.alsnet
        labeled = label_classes(clouds, options)
        position = np.concatenate([np.asarray(labels) for _, labels in labeled])
        values = _concatenate_inputs(clouds, inputs, resolve_threads(options.threads))
        if start is None:
            mean, scale = _mean_and_scale(values, inputs, position >= 0)
        else:
            mean, scale = start.mean, start.scale
        parts = [cloud.xyz for cloud in clouds]
        points = network.configuration.points
        dense = float(np.median([density(xyz) for xyz in parts]))
        spacing = network.spacing or spacing_for(points, dense)
        xyz = training_batches.join_clouds(parts, spacing)
        columns = normalize_inputs(xyz, values, inputs, mean, scale)
        held = training_batches.hold_out(
            np.concatenate(parts), position, network.validation, network.block_size
        )
        return cls(
            labeled,
            tuple(map(len, parts)),
            network.configuration,
            inputs,
            mean,
            scale,
            spacing,
            xyz,
            columns,
            position,
            held,
            Batches(xyz, points, spacing, columns),
        )

    @property
    def n_classes(self) -> int:
        """Number of classes."""
        return len(self.labeled.classes.codes)

    @cached_property
    def train_labels(self) -> npt.NDArray[np.int64]:
        """(n,) class positions that are trained on; -1 elsewhere."""
        return np.where(self.held, -1, self.position).astype(np.int64)

    @cached_property
    def held_labels(self) -> npt.NDArray[np.int64]:
        """(n,) class positions on the ground held out; -1 elsewhere."""
        return np.where(self.held, self.position, -1).astype(np.int64)

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
        known = add_return_features(inputs, cloud.xyz, cloud.dimensions, threads)
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
