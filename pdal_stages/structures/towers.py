"""Towers and poles: what stands upright where spans of wires end, which its own shape does not tell from a tree or a lamp.

An axis is a cell round which points fill the height up to the wires near it, narrowly: all within decimeters for a pole, in
a body that is clear of anything else below its arms for a tower. It is a support where the wires say so: towards it they
rise from both sides, as a wire is highest at its ends. Sums are whole numbers and reaches are bounded (:data:`REACH`), so
neither the order of points nor the tile matters.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.jit import device, njit
from ..terrain.cells import CellWindow, cell_numbers, keys_of, patches

#: Side of the cells, meters.
CELL = 1.0
#: What stands begins so high above the ground, and is looked for from there on; meters.
FOOT, FROM = 0.7, 2.0
#: The lowest wires of poles and of towers, and how far from the axis the wires are, meters.
LOW_WIRE, HIGH_WIRE, AT_POLE, AT_TOWER = 5.0, 14.0, 2, 10
#: Half the width of a pole's surroundings and of a tower's body, at least and at most, in cells.
SLIM, BODY = 1, (4, 10)
#: A body ends where so many rings of cells are as good as clear: at most that share of the points inside. Where no ring is,
#: or what widens it lies on one side of it, as a tree does, a slim body does, with the other share in the rings of `ROUND`.
CLEAR, TIDY, ONE_SIDED, CROWDED, ROUND = 3, 0.05, 0.5, 0.5, (6, 8)
#: A body of so many cells is wider than a slim one, and arms reach further in proportion, up to so much.
WIDE, WIDEST = 4.0, 2.0
#: Of the meters up to the wires, such a share is filled; of a pole at least so many.
POLE_FILLED, TOWER_FILLED, LEAST = 0.25, 0.6, 2
#: Part of the height in which nothing else is near: below the arms.
TRUNK = (0.2, 0.5)
#: How far the points of a pole scatter round its axis, and their middle from that of its cell; meters.
SCATTER, CENTER = 0.35, 0.8
#: Wires are looked at from `NEAR` to `FAR` meters from the axis, in pieces of `PIECE`; from both sides together they rise so
#: much, rise over run, and that is known from so many pairs of points.
NEAR, FAR, PIECE, RISE, PAIRS = 2.0, 15.0, 4.0, 0.015, 4
#: Of axes so near to a pole's and to a tower's, in cells, the best one is taken.
APART = (3, 15)
#: How far round an axis its points lie: a pole's, those that were taken for a wire's, and those of its arms; a tower's at
#: the top, and so much more at its foot per meter of height; arms beyond the outermost wire, and along the wires; how far
#: above these, meters, and of a tower's height, as wires hang from long insulators.
STEM, OWN, POLE_ARM, TOP, SPREAD, BESIDE, ALONG, OVER, ABOVE = (
    0.8,
    0.3,
    2.2,
    1.5,
    0.12,
    1.5,
    2.5,
    4.0,
    0.3,
)
#: How far away wires and points matter, meters.
REACH = AT_TOWER * WIDEST + BESIDE + APART[1] + FAR + PIECE + 4.0
_PARTS = 1 << 16
_HIGHEST = 256


class Cloud(NamedTuple):
    """Points in the order of the cells of a raster."""

    x: NDArray[np.float64]  #: (n,) meters from the raster's corner, as `y`
    y: NDArray[np.float64]
    z: NDArray[np.float64]
    height: NDArray[np.float64]  #: above the ground
    wire: NDArray[np.bool_]  #: whether it is a wire's
    row: NDArray[np.int64]
    column: NDArray[np.int64]
    start: NDArray[np.int64]  #: (h * w + 1) the first point of each cell
    h: int
    w: int


def find_towers(
    xyz: NDArray[np.float64],
    height: NDArray[np.float64],
    wire: NDArray[np.bool_],
    use: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Points (n,) of towers and poles: coordinates (n, 3) and heights above ground in meters, finite; which are of wires.

    Only points to `use` count.
    """
    out = np.zeros(len(xyz), bool)
    wires = np.flatnonzero(wire & use)
    if not len(wires):
        return out
    column, row = cell_numbers(xyz[:, 0], CELL), cell_numbers(xyz[:, 1], CELL)
    near = np.flatnonzero(use & (wire | (height > FOOT)) & _near(column, row, wires))
    for points, own in patches(column[near], row[near], int(REACH), int(REACH)):
        at = near[points]
        window = CellWindow.round(column[at], row[at])
        left, bottom, w, h = window
        cell = window.numbers(column[at], row[at])
        order = np.argsort(cell, kind="stable")
        start = np.searchsorted(cell[order], np.arange(h * w + 1))
        some = at[order]
        x, y, z = (xyz[some] - [left * CELL, bottom * CELL, 0.0]).T.copy()
        cloud = Cloud(x, y, z, height[some], wire[some], *np.divmod(cell[order], w), start, h, w)
        found = np.zeros(len(at), bool)
        for axis in _best(_axes(cloud)).tolist():
            _mark(cloud, *axis, found)
        mine = np.zeros(len(at), bool)
        mine[own] = True
        out[some[mine[order]]] = found[mine[order]]
    return out


def _near(
    column: NDArray[np.int64], row: NDArray[np.int64], wires: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Points in blocks at wires, and in those around."""
    side = int(AT_TOWER * WIDEST + BESIDE) + BODY[1] + CLEAR
    key = keys_of(column // side, row // side)
    steps = np.array([(b << 32) + a for b in (-1, 0, 1) for a in (-1, 0, 1)])
    return np.isin(key, np.unique(key[wires])[:, None] + steps)


@device(_nrt=True)
def _around(cloud, j, i, reach):
    """Numbers of the points in the cells up to `reach` away."""
    low, high = max(i - reach, 0), min(i + reach, cloud.w - 1) + 1
    rows, count = range(max(j - reach, 0), min(j + reach + 1, cloud.h)), 0
    for b in rows:
        count += cloud.start[b * cloud.w + high] - cloud.start[b * cloud.w + low]
    out = np.empty(count, np.int64)
    for b in rows:
        for p in range(cloud.start[b * cloud.w + low], cloud.start[b * cloud.w + high]):
            count -= 1
            out[count] = p
    return out


@njit
def _axes(cloud):
    """Cells that may be the axis of a support (m, 9): row, column, whether it is a tower, how high its wires hang, score,
    its middle, the direction of its wires as an angle, and half its width in cells.
    """
    top, there = np.full((cloud.h, cloud.w), -1.0), np.zeros((cloud.h, cloud.w), np.bool_)
    for p in range(len(cloud.x)):
        if cloud.wire[p]:
            top[cloud.row[p], cloud.column[p]] = max(
                top[cloud.row[p], cloud.column[p]], cloud.height[p]
            )
        else:
            there[cloud.row[p], cloud.column[p]] = True
    out, n = np.empty((64, 9)), 0
    for j in range(cloud.h):
        for i in range(cloud.w):
            for tall in range(2 if there[j, i] else 0):
                reach = AT_TOWER if tall else AT_POLE
                high = top[
                    max(j - reach, 0) : j + reach + 1, max(i - reach, 0) : i + reach + 1
                ].max()
                if high < (HIGH_WIRE if tall else LOW_WIRE) or high >= _HIGHEST:
                    continue
                half = _half_width(cloud, j, i, high) if tall else SLIM
                score, x, y = _upright(cloud, j, i, tall, half, high) if half else (0.0, 0.0, 0.0)
                if score <= 0:
                    continue
                rise, turn = _rise(cloud, j, i, x, y)
                if rise >= RISE:
                    if n == len(out):
                        out = np.concatenate((out, out))
                    axis = (float(j), float(i), float(tall), high, score, x, y, turn, float(half))
                    for k, value in enumerate(axis):
                        out[n, k] = value
                    n += 1
    return out[:n].copy()


@device(_nrt=True)
def _half_width(cloud, j, i, high):
    """How many cells a tower's body reaches from its axis, below its arms; 0 where it stands among other things."""
    rings = np.zeros((BODY[1] + CLEAR + 1, 3), np.int64)
    for p in _around(cloud, j, i, len(rings) - 1):
        if not cloud.wire[p] and TRUNK[0] * high <= cloud.height[p] <= TRUNK[1] * high:
            a, b = cloud.column[p] - i, cloud.row[p] - j
            ring = rings[max(abs(a), abs(b))]
            ring[0] += 1
            ring[1] += a
            ring[2] += b
    inside = slim = around = way = across = along = 0
    for k in range(BODY[1] + 1):
        inside += rings[k, 0]
        if k <= BODY[0]:
            slim = inside
        else:
            way += k * rings[k, 0]
            across += rings[k, 1]
            along += rings[k, 2]
        around += rings[k, 0] if ROUND[0] <= k <= ROUND[1] else 0
        beyond = rings[k + 1 : k + CLEAR + 1, 0].sum()
        aside = abs(across) + abs(along) > ONE_SIDED * way  # a tree
        if k >= BODY[0] and inside > 0 and beyond <= TIDY * inside and not aside:
            return k
    return BODY[0] if slim > 0 and around <= CROWDED * slim else 0


@device(_nrt=True)
def _upright(cloud, j, i, tall, half, high):
    """How well the points round a cell fill a narrow column up to the wires, 0 where they do not; and its middle (x, y)."""
    filled, sums = np.zeros(_HIGHEST, np.bool_), np.zeros(4, np.int64)
    for p in _around(cloud, j, i, half):
        height = cloud.height[p]
        if cloud.wire[p]:
            continue
        if FROM <= height < min(high + 1.0, float(_HIGHEST)):
            filled[int(height)] = True
        if (0.5 * high if tall else FROM) <= height <= high:
            dx, dy = cloud.x[p] - (i + 0.5) * CELL, cloud.y[p] - (j + 0.5) * CELL
            sums[0] += 1
            sums[1] += int(np.rint(dx * _PARTS))
            sums[2] += int(np.rint(dy * _PARTS))
            sums[3] += int(np.rint((dx * dx + dy * dy) * _PARTS))
    first, last = int(FROM), int(high)
    count = lower = upper = 0
    for s in range(first, last + 1):
        if filled[s]:
            count += 1
            lower += 2 * s < high
            upper += 4 * s >= 3 * high - 4
    if sums[0] == 0 or lower == 0 or (tall and upper == 0):
        return 0.0, 0.0, 0.0
    share = count / (last - first + 1)
    mean = sums / (sums[0] * _PARTS)
    x, y = mean[1], mean[2]
    if tall:  # the better, the nearer to its middle
        return half * 1000.0 - min(x * x + y * y, 100.0) if share >= TOWER_FILLED else 0.0, x, y
    slim = max(abs(x), abs(y)) <= CENTER and mean[3] - x * x - y * y <= SCATTER**2
    return share if slim and count >= LEAST and share >= POLE_FILLED else 0.0, x, y


@device(_nrt=True)
def _rise(cloud, j, i, x, y):
    """How wires rise towards an axis, from both sides together, and their direction there.

    Of pairs of points, as of pieces of one wire: wires may lie far apart.
    """
    pairs, n = np.empty((256, 5)), 0
    xx = xy = yy = 0
    for p in _around(cloud, j, i, int(FAR / CELL) + 1):
        away_x, away_y = cloud.x[p] - (i + 0.5) * CELL - x, cloud.y[p] - (j + 0.5) * CELL - y
        if not cloud.wire[p] or away_x * away_x + away_y * away_y > FAR * FAR:
            continue
        for o in _around(cloud, cloud.row[p], cloud.column[p], int(PIECE / CELL) + 1):
            dx, dy, dz = cloud.x[o] - cloud.x[p], cloud.y[o] - cloud.y[p], cloud.z[o] - cloud.z[p]
            out = np.sqrt(dx * dx + dy * dy)
            if not cloud.wire[o] or out > PIECE or abs(dz) > 0.3 * out + 0.1:
                continue
            xx += int(np.rint(dx * dx * 1024))
            xy += int(np.rint(dx * dy * 1024))
            yy += int(np.rint(dy * dy * 1024))
            if n == len(pairs):
                pairs = np.concatenate((pairs, pairs))
            for k, value in enumerate((away_x, away_y, dx, dy, dz)):
                pairs[n, k] = value
            n += 1
    turn = 0.5 * np.arctan2(2.0 * float(xy), float(xx - yy))
    ux, uy = np.cos(turn), np.sin(turn)
    total, count = np.zeros(2, np.int64), np.zeros(2, np.int64)
    for k in range(n):
        away_x, away_y, dx, dy = pairs[k, 0], pairs[k, 1], pairs[k, 2], pairs[k, 3]
        along, aside = away_x * ux + away_y * uy, away_y * ux - away_x * uy
        out, askew = dx * ux + dy * uy, abs(dy * ux - dx * uy)
        side = int(along > 0.0)
        out = out if side else -out
        if abs(along) >= NEAR and abs(aside) <= AT_TOWER and out >= max(0.5 * PIECE, askew / 0.3):
            total[side] -= int(np.rint(pairs[k, 4] / out * _PARTS))
            count[side] += 1
    if count.sum() < PAIRS:
        return 0.0, turn
    if count.min() < PAIRS:  # the last one of a line
        side = int(count[1] > count[0])
        return 2.0 * total[side] / count[side] / _PARTS, turn
    return (total[0] / count[0] + total[1] / count[1]) / _PARTS, turn


def _best(axes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of axes near each other the best one: a tower's before a pole's, and then the one first by row and column."""
    from scipy.spatial import cKDTree

    order = np.lexsort((axes[:, 1], axes[:, 0], -axes[:, 4]))
    axes = axes[order]
    tree, beside = cKDTree(axes[:, :2]), np.zeros(len(axes), bool)
    for tall, apart in enumerate(APART):
        better, other = tree.query_pairs(apart, p=np.inf, output_type="ndarray").T
        beside[other[axes[better, 2] == tall]] = True
    return axes[~beside]


@njit
def _mark(cloud, j, i, tall, high, score, x, y, turn, half, out):
    """Say which points are of the support at an axis, see `_axes`."""
    size = min(max(half / WIDE, 1.0), WIDEST)
    over = max(OVER, ABOVE * high) if tall else OVER
    ux, uy = np.cos(turn), np.sin(turn)
    widest, low = 0.0, high
    near = _around(cloud, int(j), int(i), int(AT_TOWER * size + BESIDE) + 1)
    for arms in range(2):  # how far these reach is known after the wires
        for p in near:
            # In this order, whatever the raster's corner is.
            dx, dy = cloud.x[p] - (i + 0.5) * CELL - x, cloud.y[p] - (j + 0.5) * CELL - y
            far, height = np.sqrt(dx * dx + dy * dy), cloud.height[p]
            along, aside = abs(dx * ux + dy * uy), abs(dy * ux - dx * uy)
            if cloud.wire[p]:
                if not arms and along <= 4.0 and aside <= AT_TOWER * size:
                    widest, low = max(widest, aside), min(low, height)
                out[p] |= not tall and far <= OWN
            elif arms and height <= high + over and tall:
                out[p] |= far <= (TOP + SPREAD * max(high - height, 0.0)) * size
                out[p] |= height >= low - 1.5 and along <= ALONG * size and aside <= widest + BESIDE
            elif arms and height <= high + over:
                out[p] |= far <= STEM or (
                    height >= low - 1.0 and along <= STEM and aside <= POLE_ARM
                )
