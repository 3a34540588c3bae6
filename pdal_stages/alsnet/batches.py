"""Circular batches [WM19 3] and their geometry level by level [Qi et al. 2017b].

A batch is the points nearest to a grid point; four batches hold a point on average.
The grid is anchored to absolute coordinates and its spacing is fixed when a model is trained, so a
tile sees the same batches as the whole cloud. What a batch holds follows from the coordinates,
never from the points' order. So does its geometry: it is computed once, and the network only
gathers and multiplies.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from ..base.errors import OptionError
from ..base.hashing import hash_rows
from ..base.jit import njit
from .configuration import REACH, Configuration

#: Batches each point is in, on average, in a cloud of even density.
COVERAGE = 4.0
#: How often a cell may be halved: of a spacing of 16 m a cell is then a micrometer.
DEEPEST = 24
#: Points of a bucket of the farthest point sampling: for speed alone.
BUCKET = 64
# [WM19] does not augment; the numbers of augmentation were not tuned.
#: Augmentation: most that a batch's center moves along x and y, in spacings.
SHIFT = 0.5
#: Augmentation: standard deviation of noise on coordinates, meters; it is cut at three times that.
JITTER = 0.01
#: Augmentation: largest share of points that a batch loses.
THIN = 0.4
#: Augmentation: fewest points that are left, where there are so many.
LEAST = 16


def spacing_for(points: int, per_square_meter: float) -> float:
    """Return the spacing in meters at which batches cover each point :data:`COVERAGE` times.

    A batch covers points / density square meters and each grid point stands for spacing^2 of them.
    """
    return max(round(math.sqrt(points / (COVERAGE * per_square_meter)), 2), 0.05)


def halo_m(spacing: float, reach: float = REACH) -> float:
    """Return the meters around a tile that its results depend on.

    A point's batches have their grid points within `reach` spacings of it and take points as far
    again; which grid points there are depends on the cell they were halved from, whose center is up
    to half a cell's diagonal away, and on what lies within reach of that.
    """
    return (2.0 * reach + math.sqrt(0.5)) * spacing


class Batches:
    """The circular batches of a cloud.

    A cell of the grid is quartered, and its grid point replaced by four, while it holds more than
    half a batch, or while its own batch does not hold all of its points: so each point is in at
    least one batch, always.

    Parameters
    ----------
    xyz : (n, 3) float64
        Coordinates in meters.
    points : int
        Points of a batch; a batch in sparse surroundings has fewer.
    spacing : float
        Of the grid, meters.
    inputs : (n, c) array, optional
        Other values of the points, to tell points at the same place apart.
    reach : float
        Farthest point of a batch from its grid point, in spacings: a batch is the `points` nearest
        ones, or fewer where there are not so many within reach.

    Attributes
    ----------
    centers : (m, 2) float64
        Grid points, in an order that follows from the coordinates.
    sizes : (m,) int64
        Points a batch may hold: `points`, but for more than `points` at one and the same place.
    """

    def __init__(
        self,
        xyz: npt.NDArray[np.float64],
        points: int,
        spacing: float,
        inputs: npt.NDArray | None = None,
        reach: float = REACH,
    ) -> None:
        if not spacing > 0.0:
            raise OptionError("the spacing of batches must be more than 0 m", found=spacing)
        self.points, self.spacing, self.reach = int(points), float(spacing), reach * float(spacing)
        more = () if inputs is None else inputs.T
        self._row = np.lexsort([*more, xyz[:, 2], xyz[:, 1], xyz[:, 0]])  # the canonical order
        self._xy = np.ascontiguousarray(xyz[self._row, :2])
        self._tree = cKDTree(self._xy)
        self.centers, self.sizes = self._place()

    def __len__(self) -> int:
        """Return the number of batches."""
        return len(self.centers)

    def nearest_points(self, x: float, y: float, size: int | None = None) -> npt.NDArray[np.int64]:
        """Return rows of the points nearest to a place within ``reach``, in canonical order.

        Of points equally far the first in that order are taken.
        """
        size = self.points if size is None else size
        radius = self.reach * (1.0 + 1e-9)  # a few beyond too
        at = np.array(self._tree.query_ball_point((x, y), radius, return_sorted=True), np.int64)
        d2 = ((self._xy[at] - (x, y)) ** 2).sum(axis=1)
        at, d2 = at[d2 <= self.reach**2], d2[d2 <= self.reach**2]
        if len(at) > size:
            limit = np.partition(d2, size - 1)[size - 1]
            nearest = d2 < limit
            nearest[np.flatnonzero(d2 == limit)[: size - np.count_nonzero(nearest)]] = True
            at = at[nearest]
        return self._row[at]

    def members(self, number: int) -> npt.NDArray[np.int64]:
        """Return the rows of the points of a batch, in the canonical order."""
        x, y = self.centers[number]
        return self.nearest_points(float(x), float(y), int(self.sizes[number]))

    def holding(self, rows: npt.NDArray[np.int64] | None) -> npt.NDArray[np.int64]:
        """Return the numbers of the batches that can hold any of these rows; all for None."""
        if rows is None or not len(rows) or not len(self):
            return np.arange(len(self) if rows is None else 0)
        wanted = np.zeros(len(self._xy), bool)
        wanted[rows] = True
        distance, _ = cKDTree(self._xy[wanted[self._row]]).query(self.centers)
        return np.flatnonzero(distance <= self.reach * (1.0 + 1e-9))

    def _place(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
        """Return the grid points (m, 2) of the batches and the most points (m,) of each."""
        placed: list[tuple[float, float, int]] = []
        waiting = [(0, *part) for part in _parts(np.arange(len(self._xy)), self._xy, self.spacing)][
            ::-1
        ]
        while waiting:
            level, cell, at = waiting.pop()
            side = self.spacing / 2.0**level
            x, y = (cell + 0.5) * side
            if size := self._fits(at, x, y, level):
                placed.append((x, y, size))
            else:
                waiting += [(level + 1, *part) for part in _parts(at, self._xy, side / 2.0)][::-1]
        table = np.array(placed, dtype=np.float64).reshape(-1, 3)
        return table[:, :2].copy(), table[:, 2].astype(np.int64)

    def _fits(self, at: npt.NDArray[np.int64], x: float, y: float, level: int) -> int:
        """Return the size of the cell's batch, or 0 where the cell must be quartered."""
        if level < DEEPEST and len(at) > max(self.points // 2, 1):
            return 0
        far2 = float(((self._xy[at] - (x, y)) ** 2).sum(axis=1).max())
        radius = math.sqrt(far2) * (1.0 + 1e-9)
        count = int(self._tree.query_ball_point((x, y), radius, return_length=True))
        if count <= self.points:
            return self.points
        return 0 if level < DEEPEST else count


def _parts(at: npt.NDArray[np.int64], xy: npt.NDArray[np.float64], side: float):
    """Return the occupied cells of some points and their places, ordered by row, then column."""
    cell = np.floor(xy[at] / side)
    order = np.lexsort(cell.T)
    cell, at = cell[order], at[order]
    starts = np.flatnonzero((cell[1:] != cell[:-1]).any(axis=1)) + 1
    return list(zip(cell[[0, *starts]], np.split(at, starts), strict=True)) if len(at) else []


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


def farthest_point_sampling(
    xyz: npt.NDArray[np.float64], count: int, start: int = 0
) -> npt.NDArray[np.int64]:
    """Return `count` points from `start` on, each exactly the one farthest from those before it.

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
