"""Sampling and grouping [Qi et al. 2017b]: the geometry of a batch, level by level.

It follows from the coordinates alone, so it is computed once, and the network only gathers and
multiplies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from ..base.hashing import hash_rows
from ..base.jit import njit
from .configuration import Configuration

#: Points of a bucket of the farthest point sampling.
BUCKET = 64


def farthest_point_sampling(
    xyz: npt.NDArray[np.float64], count: int, start: int = 0
) -> npt.NDArray[np.int64]:
    """Return `count` points, each the one farthest from those chosen before it.

    Exact; the first one is `start`.

    Indices come in the order they were chosen, each once (points that coincide included). Points
    are kept in buckets, in the order of a tree; one whose box is farther from the new point than
    its own farthest point cannot change and is passed over (the idea of QuickFPS, Han et al. 2023).
    """
    n = len(xyz)
    if not 0 < count <= n or not 0 <= start < n:
        raise ValueError(f"{count} of {n} points from {start}")
    order = cKDTree(xyz, leafsize=8).indices
    return _farthest(
        np.ascontiguousarray(xyz[order]), order, count, int(np.flatnonzero(order == start)[0])
    )


@njit
def _farthest(p, order, count, first):
    n = len(p)
    buckets = (n + BUCKET - 1) // BUCKET
    far = np.full(n, np.inf)
    low = np.empty((buckets, 3))
    high = np.empty((buckets, 3))
    best = np.full(buckets, np.inf)
    place = np.empty(buckets, np.int64)
    for b in range(buckets):
        lo, hi = b * BUCKET, min(n, (b + 1) * BUCKET)
        place[b] = lo
        for axis in range(3):
            low[b, axis] = high[b, axis] = p[lo, axis]
            for i in range(lo + 1, hi):
                low[b, axis] = min(low[b, axis], p[i, axis])
                high[b, axis] = max(high[b, axis], p[i, axis])
    out = np.empty(count, np.int64)
    now = first
    for k in range(count):
        out[k] = order[now]
        far[now] = -1.0  # never chosen again, even where points coincide
        x, y, z = p[now, 0], p[now, 1], p[now, 2]
        bucket = now // BUCKET
        top, at = -2.0, 0
        for b in range(buckets):
            dx = max(low[b, 0] - x, x - high[b, 0], 0.0)
            dy = max(low[b, 1] - y, y - high[b, 1], 0.0)
            dz = max(low[b, 2] - z, z - high[b, 2], 0.0)
            if b == bucket or dx * dx + dy * dy + dz * dz < best[b]:
                value, where = -2.0, 0
                for i in range(b * BUCKET, min(n, (b + 1) * BUCKET)):
                    dx, dy, dz = p[i, 0] - x, p[i, 1] - y, p[i, 2] - z
                    d = dx * dx + dy * dy + dz * dz
                    if d < far[i]:
                        far[i] = d
                    if far[i] > value or (far[i] == value and order[i] < order[where]):
                        value, where = far[i], i
                best[b], place[b] = value, where
            if best[b] > top or (best[b] == top and order[place[b]] < order[at]):
                top, at = best[b], place[b]
        now = at
    return out


def ball_query(
    xyz: npt.NDArray[np.float64], centers: npt.NDArray[np.int64], radius: float, samples: int
) -> npt.NDArray[np.int32]:
    """Return rows (m, samples) int32 of points within `radius` (included) of each center (m,).

    Of more points the first ones by index are taken.

    A center is within its own ball, so none is empty. A ball with fewer points repeats its first
    one, which a maximum over the ball does not notice (as PointNet++ does).
    """
    out = np.empty((len(centers), samples), np.int32)
    balls = cKDTree(xyz).query_ball_point(xyz[centers], radius, return_sorted=True)
    for row, ball in zip(out, balls, strict=True):
        row[:] = ball[0]
        row[: len(ball)] = ball[:samples]
    return out


def interpolation_weights(
    xyz: npt.NDArray[np.float64], coarse: npt.NDArray[np.float64]
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32]]:
    """Return the three nearest coarse points (n, 3) of each point, and their weights (n, 3).

    Weights fall with the squared distance.

    They sum to 1. Where there are fewer than three coarse points the rest weigh nothing. [WM19]
    says inverse distance, but its authors' program, which gave the published figures, takes the
    squared distances of its search as they are, as PointNet++ does; so do we.
    """
    k = min(3, len(coarse))
    distance, near = cKDTree(coarse).query(xyz, k=[1, 2, 3][:k])
    index = np.zeros((len(xyz), 3), np.int32)
    weight = np.zeros((len(xyz), 3))
    index[:, :k] = near
    weight[:, :k] = 1.0 / np.maximum(distance * distance, 1e-10)
    weight /= weight.sum(axis=1, keepdims=True)
    return index, weight.astype(np.float32)


@dataclass(frozen=True, eq=False)
class Step:
    """Set abstraction from one level to the next coarser one, and feature propagation back."""

    groups: npt.NDArray[np.int32]  #: (m, samples) points of each ball, as rows of the finer level
    #: (m, samples, 3) their coordinates from the ball's center, divided by the radius
    offsets: npt.NDArray[np.float32]
    nearest: npt.NDArray[
        np.int32
    ]  #: (n, 3) for each point of the finer level, three rows of the coarser one
    weights: npt.NDArray[np.float32]  #: (n, 3) of those; they sum to 1


@dataclass(frozen=True, eq=False)
class Pyramid:
    """A batch ready for the network."""

    inputs: npt.NDArray[np.float32]  #: (n, inputs) of each point, in the batch's own order
    steps: tuple[Step, ...]  #: from fine to coarse


def random_order(xyz: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    """Return an order that looks random and follows from the coordinates alone.

    A ball takes its first points by index: in this order that is a fair sample of it.
    """
    mixed = hash_rows(xyz.T, 0)
    return np.lexsort((xyz[:, 2], xyz[:, 1], xyz[:, 0], mixed))


def build_pyramid(
    xyz: npt.NDArray[np.float64], inputs: npt.NDArray[np.float32], configuration: Configuration
) -> Pyramid:
    """Return the pyramid of a batch.

    Parameters
    ----------
    xyz : (n, 3) float64
        Coordinates from the batch's center, in the order of :func:`random_order`.
    inputs : (n, c) float32
    configuration : Configuration
    """
    start = int(np.argmin((xyz[:, :2] ** 2).sum(axis=1)))
    steps = []
    for level in configuration.levels:
        centers = farthest_point_sampling(xyz, min(level.centers, len(xyz)), start)
        groups = ball_query(xyz, centers, level.radius, level.samples)
        offsets = (xyz[groups] - xyz[centers][:, None, :]) / level.radius
        coarse = xyz[centers]
        near, weights = interpolation_weights(xyz, coarse)
        steps.append(Step(groups, offsets.astype(np.float32), near, weights))
        xyz, start = coarse, 0
    return Pyramid(inputs, tuple(steps))


def join_pyramids(pyramids: Sequence[Pyramid]) -> Pyramid:
    """Join batches into one that never mixes them: rows follow each other."""
    if len(pyramids) == 1:
        return pyramids[0]
    steps = []
    fine = [len(pyramid.inputs) for pyramid in pyramids]
    for parts in zip(*(pyramid.steps for pyramid in pyramids), strict=True):
        coarse = [len(part.groups) for part in parts]
        above = np.concatenate(([0], np.cumsum(fine)[:-1])).astype(np.int32)
        below = np.concatenate(([0], np.cumsum(coarse)[:-1])).astype(np.int32)
        steps.append(
            Step(
                np.concatenate([part.groups + k for part, k in zip(parts, above, strict=True)]),
                np.concatenate([part.offsets for part in parts]),
                np.concatenate([part.nearest + k for part, k in zip(parts, below, strict=True)]),
                np.concatenate([part.weights for part in parts]),
            )
        )
        fine = coarse
    return Pyramid(np.concatenate([pyramid.inputs for pyramid in pyramids]), tuple(steps))
