"""Points that nothing holds: alone, in thin veils or in small clusters apart from everything.

Space is cut into voxels that are the wider the thinner the cloud is around, so that the surfaces
and crowns of a survey fill voxels that touch. They are widened where more than one point in ten has
little company; where that is so in the widest, as in thin clouds of steep forests, gaps tell
nothing, and nothing is detached. A voxel is solid if it belongs to a component of voxels that
touch, none of them nearly empty, and that is large, long and thin as a wire, or of many points
under the open sky. All else is detached: held if something solid is close or if it has many points
under others, loose if not. All is counted on absolute grids, so that the order of points, tiles and
threads do not matter.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.grid import begins_run
from ..base.jit import device, njit
from ..base.key_order import order_by_key
from ..base.threads import map_blocks
from .components import root_of

#: Side of a block in meters, a multiple of all sides of voxels; density is that of 3 x 3 blocks.
BLOCK_M = 12.0
#: Bits of a layer in a key, and the layer 0: what is higher or lower shares the last layer.
BITS = 36
LAYERS = 1 << (BITS - 1)
#: Points or voxels that a thread works on at a time.
SHARE = 1 << 18
#: State of what belongs to a large component.
SOLID: int = 0
#: State of what is detached and has something solid close, or many points under others.
HELD: int = 1
#: State of what is detached and has not.
LOOSE: int = 2
#: State of what nobody has judged.
UNJUDGED: int = 255


class DetachedRules(NamedTuple):
    """Thresholds of what is detached; a NamedTuple, as kernels read it.

    Chosen by noise put into copies of the 29 training surveys and by their good points that are
    marked (benchmarks/noise.py --surveys); what each is worth is in docs/results/ablation.md.
    """

    #: meters, each a whole part of a block: a voxel's side is the first that is not less than the
    #: gap times the cube root of `dense_per_m2` / density, for points fill volumes
    sides: tuple[float, ...] = (1.0, 1.2, 1.5, 2.0, 2.4, 3.0, 4.0, 6.0)
    dense_per_m2: float = 10.0  #: density at which voxels are as wide as the gap
    #: points in a voxel and the 26 around it: fewer, or those of a swarm, lack company
    min_company: int = 24
    max_lonely: float = 0.1  #: where a larger share of the points lacks it voxels are widened
    flat_m: float = 1.5  #: voxels are not higher than this, or than half their side
    #: a voxel is nearly empty with fewer points in it and the 26 around it, where up to three of
    #: these hold any, as along a wire ...
    min_around: int = 3
    min_more: int = 2  #: ... and this many more for each further one, as in a swarm
    #: a cluster may hold as many points as lie on this much ground: of the clusters of more than 30
    #: points in the surveys that are not noise the smallest lies on 3.2 m2
    cluster_area_m2: float = 2.0
    min_covered: float = 0.8  #: larger ones are detached if this share lies under others
    extent_sides: float = 5.0  #: no cluster is longer than this, in sides of a voxel, ...
    extent_m: float = 15.0  #: ... and this, in meters
    line_columns: int = 3  #: a piece of a wire is at least this long, in columns, ...
    line_m: float = 6.0  #: ... and this, in meters, ...
    line_variance: float = 0.5  #: ... with at most this variance across, in columns squared, ...
    line_slope: float = 0.5  #: ... and at most this rise
    hold_columns: int = 2  #: columns around within which something solid holds a voxel
    hold_sides: float = 1.5  #: the same up and down, in sides of a voxel


RULES = DetachedRules()
#: How far away, in meters, points change what is detached: by the density of where it begins, by
#: its component in full, and by those of what may hold it.
REACH = 3 * BLOCK_M + (RULES.extent_sides + RULES.hold_columns + 2) * RULES.sides[-1]


class BlockPoints(NamedTuple):
    """Points and the blocks that they lie in."""

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    z: NDArray[np.float64]
    block: NDArray[np.int64]  #: (n,) its number, row by row
    left: int  #: the first column of blocks
    bottom: int  #: the first row
    shape: tuple[int, int]  #: rows and columns of blocks


class Voxels(NamedTuple):
    """The frame of a grid of voxels."""

    side: float  #: meters
    height: float  #: meters
    left: int  #: column of the frame's first
    bottom: int  #: row of the frame's first
    width: int  #: columns

    @classmethod
    def over(cls, points: BlockPoints, side: float) -> Voxels:
        """Return the voxels of a side over the blocks, with as many columns around as are read."""
        per_block, rim = round(BLOCK_M / side), RULES.hold_columns
        left, bottom = (first * per_block - rim for first in (points.left, points.bottom))
        height = min(side, max(RULES.flat_m, side / 2))
        return cls(side, height, left, bottom, points.shape[1] * per_block + 2 * rim)

    def find_blocks(self, keys: NDArray[np.int64], width: int) -> NDArray[np.int64]:
        """Return the numbers (n,) of the blocks of voxels, row by row, `width` in a row."""
        per_block = round(BLOCK_M / self.side)
        row, column = (
            (place - RULES.hold_columns) // per_block
            for place in np.divmod(keys >> BITS, self.width)
        )
        return row * width + column


def find_detached(
    x: NDArray, y: NDArray, z: NDArray, cluster: int, gap: float, threads: int | None = None
) -> NDArray[np.uint8]:
    """Return which points (n,) are `SOLID`, and which of the others `HELD` and `LOOSE`.

    Parameters
    ----------
    x, y, z : (n,) arrays of float64
        Meters.
    cluster : int
        The most points of a cluster, where these are more than those of `cluster_area_m2`.
    gap : float
        Width in meters of voxels at `dense_per_m2` points/m2.
    """
    column, row = (np.floor(axis / BLOCK_M).astype(np.int64) for axis in (x, y))
    left, bottom = column.min(), row.min()
    shape = int(row.max() - bottom + 1), int(column.max() - left + 1)
    points = BlockPoints(
        x, y, z, (row - bottom) * shape[1] + column - left, int(left), int(bottom), shape
    )
    count = np.bincount(points.block, minlength=shape[0] * shape[1]).reshape(shape)
    density = sum_around(count) / np.maximum(1, sum_around(count > 0)) / BLOCK_M**2
    density = np.where(count > 0, density, 1.0)
    scale = np.searchsorted(RULES.sides, gap * (RULES.dense_per_m2 / density) ** (1 / 3))
    scale = np.where(count > 0, np.minimum(scale, len(RULES.sides) - 1), -1)
    most = np.maximum(cluster, RULES.cluster_area_m2 * density)
    state = np.zeros(len(x), np.uint8)
    for number, side in enumerate(RULES.sides):
        if not (scale == number).any():
            continue
        far = max(RULES.extent_sides * side, RULES.extent_m) + (RULES.hold_columns + 2) * side
        near = _dilate(scale == number, math.ceil(far / BLOCK_M)).ravel()
        frame = Voxels.over(points, side)
        keys, counts = _count(points, near, frame, threads)
        company, voxels = _count_around(keys, counts, frame.width, threads)
        least = RULES.min_around + RULES.min_more * np.maximum(0, voxels - 3)
        lonely = np.where(company < np.maximum(RULES.min_company, least), counts, 0)
        block = frame.find_blocks(keys, shape[1])
        lonely = sum_around(np.bincount(block, lonely, count.size).reshape(shape))
        # Blocks whose voxels are too narrow are judged by the next wider ones, if there are any.
        scale[(scale == number) & (lonely > RULES.max_lonely * sum_around(count))] += 1
        if not (scale == number).any():
            continue
        states = _judge(keys, counts, company >= least, most.ravel()[block], frame, threads)
        detached = np.zeros((keys[-1] >> BITS) + 1, np.bool_)
        detached[keys[states > SOLID] >> BITS] = True
        known = frame, (scale == number).ravel(), detached, keys, states

        def assign(share, known=known):
            _assign(_share(points, share), state[share], *known)

        for _ in map_blocks(assign, _slices(len(x)), threads):
            pass
    return state


def sum_around(values: NDArray) -> NDArray[np.int64]:
    """Return the sums of whole numbers (h, w) over the 3 x 3 places around each."""
    (h, w), padded = values.shape, np.pad(values.astype(np.int64), 1)
    return sum((padded[j : j + h, i : i + w] for j in range(3) for i in range(3)), np.int64(0))


def _dilate(mask: NDArray[np.bool_], radius: int) -> NDArray[np.bool_]:
    """Return the places (h, w) at most `radius` places away, along either axis, from the mask's."""
    for _ in range(radius):
        mask = sum_around(mask) > 0
    return mask


def _slices(number: int) -> list[slice]:
    """Return slices of `SHARE` points."""
    return [slice(start, start + SHARE) for start in range(0, number, SHARE)]


def _share(points: BlockPoints, share: slice) -> BlockPoints:
    """Return some of the points."""
    x, y, z, block = points.x[share], points.y[share], points.z[share], points.block[share]
    return points._replace(x=x, y=y, z=z, block=block)


def _count(
    points: BlockPoints, near: NDArray[np.bool_], frame: Voxels, threads: int | None
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the keys (n,) of the voxels of points in the blocks `near`, and how many they hold."""

    def count(share):
        part = _share(points, share)
        keys, counts = np.empty((2, len(part.x)), np.int64)
        number = _keys(part, frame, near, keys, counts)
        return _sum_by_key(keys[:number], counts[:number])

    parts = list(map_blocks(count, _slices(len(points.x)), threads))
    return _sum_by_key(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def _sum_by_key(
    keys: NDArray[np.int64], counts: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return each key once, ascending, and the sums of its counts."""
    order = order_by_key(keys)
    keys = keys[order]
    starts = np.flatnonzero(begins_run(keys))
    return keys[starts], np.add.reduceat(counts[order], starts) if len(keys) else counts


@device
def _key(x, y, z, frame):
    """Return the key of the voxel that a point lies in."""
    row, column = np.floor(y / frame.side), np.floor(x / frame.side)
    place = (np.int64(row) - frame.bottom) * frame.width + np.int64(column) - frame.left
    layer = max(min(np.floor(z / frame.height), LAYERS - 8.0), 8.0 - LAYERS)
    return (place << BITS) + np.int64(layer) + LAYERS


@njit
def _keys(points, frame, near, keys, counts):
    """Write the voxels of points in the blocks `near`; return how many.

    Points that follow one another in a file are often of one voxel, which is written once.
    """
    number = 0
    for k in range(len(points.x)):
        if near[points.block[k]]:
            key = _key(points.x[k], points.y[k], points.z[k], frame)
            if number > 0 and keys[number - 1] == key:
                counts[number - 1] += 1
            else:
                keys[number], counts[number] = key, 1
                number += 1
    return number


@njit
def _assign(points, state, frame, wanted, detached, keys, found):
    """Give the points in wanted blocks the states of their voxels.

    `detached` (m,) says which columns have any that are not solid.
    """
    for k in range(len(points.x)):
        if wanted[points.block[k]]:
            key = _key(points.x[k], points.y[k], points.z[k], frame)
            if detached[key >> BITS]:
                state[k] = found[np.searchsorted(keys, key)]


def _spans(number: int) -> list[tuple[int, int]]:
    """Return where shares of some voxels begin and end."""
    bounds = np.linspace(0, number, number // SHARE + 2).astype(np.int64)
    return list(itertools.pairwise(bounds.tolist()))


def _count_around(
    keys: NDArray[np.int64], counts: NDArray[np.int64], width: int, threads: int | None
) -> NDArray[np.int64]:
    """Return the points and the voxels (2, n) in each voxel and the 26 around it."""
    sums = np.zeros((2, len(keys)), np.int64)

    def count(span):
        _sum_27(keys, counts, width, *span, sums)

    for _ in map_blocks(count, _spans(len(keys)), threads):
        pass
    return sums


def _judge(keys, counts, full, most, frame: Voxels, threads: int | None) -> NDArray[np.uint8]:
    """Return the states (n,) of voxels; `most` (n,) are points of a cluster where each lies."""
    spans, parent = _spans(len(keys)), np.arange(len(keys))

    def join(span):
        _join(keys, full, frame.width, *span, span[1], parent)

    for _ in map_blocks(join, spans, threads):
        pass
    last_row = (frame.width + 2) << BITS
    for _, end in spans[:-1]:  # what touches across the end of a span
        begin = np.searchsorted(keys, keys[end] - last_row)
        _join(keys, full, frame.width, begin, end, len(keys), parent)
    state = np.empty(len(keys), np.uint8)
    _judge_components(keys, counts, full, parent, most, frame, RULES, state)

    def hold(span):
        _hold(keys, frame, *span, RULES, state)

    for _ in map_blocks(hold, spans, threads):
        pass
    return state


@njit
def _sum_27(keys, counts, width, begin, end, sums):
    """Sum the points and the voxels in the voxels of a span and in the 26 around each."""
    for j in range(-1, 2):
        for i in range(-1, 2):
            offset = (j * width + i) << BITS
            start = np.searchsorted(keys, keys[begin] + offset - 1)
            for k in range(begin, end):
                at = keys[k] + offset
                while start < len(keys) and keys[start] < at - 1:
                    start += 1
                other = start
                while other < len(keys) and keys[other] <= at + 1:
                    sums[0, k] += counts[other]
                    sums[1, k] += 1
                    other += 1


@njit
def _join(keys, full, width, begin, end, stop, parent):
    """Join the full voxels of a span with those that touch them, above and ahead, up to `stop`."""
    for j, i in ((0, 0), (0, 1), (1, -1), (1, 0), (1, 1)):
        offset = (j * width + i) << BITS
        first = 1 if offset == 0 else -1
        start = np.searchsorted(keys, keys[begin] + offset + first)
        for k in range(begin, end):
            at = keys[k] + offset
            while start < stop and keys[start] < at + first:
                start += 1
            other = start
            while other < stop and keys[other] <= at + 1:
                if full[k] and full[other]:
                    a, b = root_of(parent, k), root_of(parent, other)
                    parent[max(a, b)] = min(a, b)
                other += 1


@njit
def _judge_components(keys, counts, full, parent, most, frame, rules, state):
    """Find the states of voxels by their components alone.

    Components are solid that are wide, or long and thin. Those of more points than a cluster are
    solid, too, unless they lie under others, and then they are held: ground in a courtyard or a pit
    has no roof, echoes from below have the ground above them.
    """
    first, label, number = np.empty(len(keys), np.int64), np.full(len(keys), -1), 0
    for k in range(len(keys)):
        if full[k]:
            root = root_of(parent, k)  # the first of its component
            if root == k:
                first[number], label[k] = k, number
                number += 1
            label[k] = label[root]
    size, covered = np.zeros((2, number), np.int64)
    low, high = np.zeros((number, 3), np.int64), np.zeros((number, 3), np.int64)
    sums = np.zeros((number, 6), np.int64)
    for k in range(len(keys)):
        if full[k]:
            n = label[k]
            size[n] += counts[k]
            _extend(keys[first[n]], keys[k], frame.width, low[n], high[n], sums[n])
    solid = np.empty(number, np.bool_)
    longest = max(rules.extent_sides * frame.side, rules.extent_m)
    for n in range(number):
        flat = max(high[n, 0] - low[n, 0], high[n, 1] - low[n, 1])
        rise = (high[n, 2] - low[n, 2]) * frame.height
        solid[n] = max((flat + 1) * frame.side, rise) > longest
        if flat + 1 >= rules.line_columns and (flat + 1) * frame.side >= rules.line_m:
            solid[n] |= _is_line(sums[n], rise / (flat * frame.side), rules)
    top = -1  # the component of a column's highest full voxel
    for k in range(len(keys) - 1, -1, -1):
        if k + 1 == len(keys) or keys[k + 1] >> BITS != keys[k] >> BITS:
            top = -1
        if full[k]:
            top = label[k] if top < 0 else top
            covered[label[k]] += counts[k] * (label[k] != top)
    for k in range(len(keys)):
        state[k] = LOOSE
        if full[k]:
            n = label[k]
            if solid[n]:
                state[k] = SOLID
            elif size[n] > most[first[n]]:
                state[k] = HELD if covered[n] >= rules.min_covered * size[n] else SOLID


@device
def _extend(first, key, width, low, high, sums):
    """Add a voxel to the extents and sums of its component, from the component's first voxel."""
    j, i = divmod(key >> BITS, width)
    first_j, first_i = divmod(first >> BITS, width)
    j, i = j - first_j, i - first_i
    layer = (key & ((1 << BITS) - 1)) - (first & ((1 << BITS) - 1))
    for axis, at in ((0, j), (1, i), (2, layer)):
        low[axis], high[axis] = min(low[axis], at), max(high[axis], at)
    for axis, value in ((0, 1), (1, j), (2, i), (3, j * j), (4, i * i), (5, j * i)):
        sums[axis] += value


@device
def _is_line(sums, slope, rules):
    """Tell whether voxels lie along a line that rises little, by the sums of :func:`_extend`."""
    n, j, i = sums[0], sums[1] / sums[0], sums[2] / sums[0]
    jj, ii, ji = sums[3] / n - j * j, sums[4] / n - i * i, sums[5] / n - j * i
    across = (jj + ii) / 2 - np.sqrt(((jj - ii) / 2) ** 2 + ji * ji)
    return across <= rules.line_variance and slope <= rules.line_slope


@njit
def _hold(keys, frame, begin, end, rules, state):
    """Find which voxels of a span have something solid close, as far up and down as a side."""
    layers = int(np.ceil(rules.hold_sides * frame.side / frame.height))
    for k in range(begin, end):
        if state[k] != LOOSE:
            continue
        for j in range(-rules.hold_columns, rules.hold_columns + 1):
            for i in range(-rules.hold_columns, rules.hold_columns + 1):
                at = keys[k] + ((j * frame.width + i) << BITS)
                other = np.searchsorted(keys, at - layers)
                while other < len(keys) and keys[other] <= at + layers:
                    if state[other] == SOLID:
                        state[k] = HELD
                    other += 1
