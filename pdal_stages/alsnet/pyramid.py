"""The geometry of a batch, level by level: who is sampled, who is in which ball, who passes features back up.

It follows from the coordinates alone, so it is computed once, with NumPy and compiled kernels, and the
network only gathers and multiplies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..base.hashing import coordinate_hash
from .configuration import Configuration
from .farthest import ball_query, farthest_points, three_nearest


@dataclass(frozen=True, eq=False)
class Step:
    """From one level to the next coarser one, and back."""

    groups: npt.NDArray[np.int32]  #: (m, samples) points of each ball, as rows of the finer level
    #: (m, samples, 3) their coordinates from the ball's center, divided by the radius
    offsets: npt.NDArray[np.float32]
    near: npt.NDArray[np.int32]  #: (n, 3) for each point of the finer level, three rows of the coarser one
    weights: npt.NDArray[np.float32]  #: (n, 3) of those; they sum to 1


@dataclass(frozen=True, eq=False)
class Pyramid:
    """A batch ready for the network."""

    inputs: npt.NDArray[np.float32]  #: (n, inputs) of each point, in the batch's own order
    steps: tuple[Step, ...]  #: from fine to coarse


def scramble(xyz: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    """An order that looks random and follows from the coordinates, whatever order the points come in.

    A ball takes its first points by index: in this order that is a fair sample of it.
    """
    mixed = coordinate_hash(xyz, 0)
    return np.lexsort((xyz[:, 2], xyz[:, 1], xyz[:, 0], mixed))


def build(
    xyz: npt.NDArray[np.float64], inputs: npt.NDArray[np.float32], configuration: Configuration
) -> Pyramid:
    """The pyramid of a batch.

    Parameters
    ----------
    xyz : (n, 3) float64
        Coordinates from the batch's center, in the order of :func:`scramble`.
    inputs : (n, c) float32
    configuration : Configuration
    """
    start = int(np.argmin((xyz[:, :2] ** 2).sum(axis=1)))
    steps = []
    for level in configuration.levels:
        centers = farthest_points(xyz, min(level.centers, len(xyz)), start)
        groups = ball_query(xyz, centers, level.radius, level.samples)
        offsets = (xyz[groups] - xyz[centers][:, None, :]) / level.radius
        coarse = xyz[centers]
        near, weights = three_nearest(xyz, coarse)
        steps.append(Step(groups, offsets.astype(np.float32), near, weights))
        xyz, start = coarse, 0
    return Pyramid(inputs, tuple(steps))


def stack(pyramids: Sequence[Pyramid]) -> Pyramid:
    """Several batches as one that never mixes them: rows follow each other."""
    if len(pyramids) == 1:
        return pyramids[0]
    steps = []
    fine = [len(one.inputs) for one in pyramids]
    for parts in zip(*(one.steps for one in pyramids), strict=True):
        coarse = [len(part.groups) for part in parts]
        above = np.concatenate(([0], np.cumsum(fine)[:-1])).astype(np.int32)
        below = np.concatenate(([0], np.cumsum(coarse)[:-1])).astype(np.int32)
        steps.append(
            Step(
                np.concatenate([part.groups + k for part, k in zip(parts, above, strict=True)]),
                np.concatenate([part.offsets for part in parts]),
                np.concatenate([part.near + k for part, k in zip(parts, below, strict=True)]),
                np.concatenate([part.weights for part in parts]),
            )
        )
        fine = coarse
    return Pyramid(np.concatenate([one.inputs for one in pyramids]), tuple(steps))
