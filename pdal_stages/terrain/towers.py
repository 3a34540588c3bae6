"""Towers and poles: what stands upright where spans of wires end, which its own shape does not tell from a tree or a lamp.

An axis is a cell round which points fill the height up to the wires near it, narrowly: all within decimeters for a pole, in
a body that is clear of anything else below its arms for a tower. It is a support where the wires say so: towards it they
rise from both sides, as a wire is highest at its ends. Sums are whole numbers and reaches are bounded (:data:`REACH`), so
neither the order of points nor the tile matters.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..base.jit import device, njit
from .cells import cell_numbers
from .patches import patches

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
STEM, OWN, POLE_ARM, TOP, SPREAD, BESIDE, ALONG, OVER, ABOVE = 0.8, 0.3, 2.2, 1.5, 0.12, 1.5, 2.5, 4.0, 0.3
#: How far away wires and points matter, meters.
REACH = AT_TOWER * WIDEST + BESIDE + APART[1] + FAR + PIECE + 4.0
_PARTS = 1 << 16
_HIGHEST = 256


def find_towers(
    xyz: NDArray[np.float64], height: NDArray[np.float64], wire: NDArray[np.bool_], use: NDArray[np.bool_]
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
    x, y, z, h = (np.ascontiguousarray(values[near]) for values in (*xyz.T, height))
    c, r, w = column[near], row[near], wire[near]
    for points, own in patches(c, r, int(REACH), int(REACH)):
        at = np.arange(len(near))[points]
        left, bottom = int(c[at].min()), int(r[at].min())
        size = int(r[at].max()) + 1 - bottom, int(c[at].max()) + 1 - left
        cell = (r[at] - bottom) * size[1] + c[at] - left
        order = np.argsort(cell, kind="stable")
        start = np.searchsorted(cell[order], np.arange(size[0] * size[1] + 1))
        cloud = (x[at], y[at], z[at], h[at], w[at], order, start, *size, left, bottom)
        found = np.zeros(len(at), bool)
        axes = _axes(*cloud)
        _mark(*cloud, _best(axes), found)
        out[near[at[own]]] = found[own]
    return out


def _near(column: NDArray[np.int64], row: NDArray[np.int64], wires: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Points in blocks at wires, and in those around."""
    side = int(AT_TOWER * WIDEST + BESIDE) + BODY[1] + CLEAR
    across, along = column // side, row // side
    key = (along << 32) + across
    steps = np.array([(b << 32) + a for b in (-1, 0, 1) for a in (-1, 0, 1)])
    return np.isin(key, np.unique(key[wires])[:, None] + steps)


@njit
def _axes(x, y, z, height, wire, order, start, h, w, left, bottom):
    """Cells that may be the axis of a support (m, 9): row, column, whether it is a tower, how high its wires hang, score,
    its middle, the direction of its wires as an angle, and half its width in cells.
    """
    top = np.full(h * w, -1.0)
    there = np.zeros(h * w, np.bool_)
    for k in range(h * w):
        for q in range(start[k], start[k + 1]):
            if wire[order[q]]:
                top[k] = max(top[k], height[order[q]])
            else:
                there[k] = True
    out = np.empty((64, 9))
    n = 0
    filled = np.empty(_HIGHEST, np.bool_)
    sums, rings = np.empty(4, np.int64), np.empty((BODY[1] + CLEAR + 1, 3), np.int64)
    for j in range(h):
        for i in range(w):
            if not there[j * w + i]:
                continue
            for tall in range(2):
                reach = AT_TOWER if tall else AT_POLE
                high = -1.0
                for b in range(max(j - reach, 0), min(j + reach + 1, h)):
                    for a in range(max(i - reach, 0), min(i + reach + 1, w)):
                        high = max(high, top[b * w + a])
                if high < (HIGH_WIRE if tall else LOW_WIRE) or high >= _HIGHEST:
                    continue
                half = SLIM
                if tall:
                    half = _half_width(height, wire, order, start, h, w, j, i, high, rings)
                    if half == 0:
                        continue
                score = _upright(
                    x, y, height, wire, order, start, h, w, left, bottom, j, i, tall, half, high, filled, sums
                )
                if score <= 0:
                    continue
                middle_x, middle_y = sums[1] / sums[0] / _PARTS, sums[2] / sums[0] / _PARTS
                rise, turn = _rise(x, y, z, wire, order, start, h, w, left, bottom, j, i, middle_x, middle_y)
                if rise < RISE:
                    continue
                if n == len(out):
                    out = np.concatenate((out, np.empty((n, 9))))
                out[n, 0], out[n, 1], out[n, 2], out[n, 3] = j, i, tall, high
                out[n, 4], out[n, 5], out[n, 6], out[n, 7] = score, middle_x, middle_y, turn
                out[n, 8] = half
                n += 1
    return out[:n].copy()


@device
def _half_width(height, wire, order, start, h, w, j, i, high, rings):
    """How many cells a tower's body reaches from its axis, below its arms; 0 where it stands among other things."""
    rings[:] = 0
    reach = len(rings) - 1
    for b in range(max(j - reach, 0), min(j + reach + 1, h)):
        for a in range(max(i - reach, 0), min(i + reach + 1, w)):
            far = max(abs(b - j), abs(a - i))
            for q in range(start[b * w + a], start[b * w + a + 1]):
                p = order[q]
                if not wire[p] and TRUNK[0] * high <= height[p] <= TRUNK[1] * high:
                    rings[far, 0] += 1
                    rings[far, 1] += a - i
                    rings[far, 2] += b - j
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
        beyond = 0
        for far in range(k + 1, k + CLEAR + 1):
            beyond += rings[far, 0]
        aside = abs(across) + abs(along) > ONE_SIDED * way  # a tree
        if k >= BODY[0] and inside > 0 and beyond <= TIDY * inside and not aside:
            return k
    return BODY[0] if slim > 0 and around <= CROWDED * slim else 0


@device
def _upright(x, y, height, wire, order, start, h, w, left, bottom, j, i, tall, half, high, filled, sums):
    """How well the points round a cell fill a narrow column up to the wires, 0 where they do not; fills `sums` of its middle
    (how many, x, y, their squares).
    """
    filled[:] = False
    sums[:] = 0
    for b in range(max(j - half, 0), min(j + half + 1, h)):
        for a in range(max(i - half, 0), min(i + half + 1, w)):
            for q in range(start[b * w + a], start[b * w + a + 1]):
                p = order[q]
                if wire[p]:
                    continue
                if FROM <= height[p] < min(high + 1.0, float(_HIGHEST)):
                    filled[int(height[p])] = True
                if (0.5 * high if tall else FROM) <= height[p] <= high:
                    dx, dy = x[p] - (left + i + 0.5) * CELL, y[p] - (bottom + j + 0.5) * CELL
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
    share = count / (last - first + 1)
    if sums[0] == 0 or lower == 0 or (tall and upper == 0):
        return 0.0
    if tall:  # the better, the nearer to its middle
        away = min((sums[1] ** 2 + sums[2] ** 2) / (float(sums[0]) * _PARTS) ** 2, 100.0)
        return half * 1000.0 - away if share >= TOWER_FILLED else 0.0
    spread = sums[3] / sums[0] / _PARTS - (sums[1] ** 2 + sums[2] ** 2) / (float(sums[0]) * _PARTS) ** 2
    far = max(abs(sums[1]), abs(sums[2])) / sums[0] / _PARTS
    if far > CENTER or count < LEAST or share < POLE_FILLED or spread > SCATTER**2:
        return 0.0
    return share


@device
def _rise(x, y, z, wire, order, start, h, w, left, bottom, j, i, middle_x, middle_y):
    """How wires rise towards an axis, from both sides together, and their direction there."""
    reach = int(FAR / CELL) + 1
    cx, cy = (left + i + 0.5) * CELL + middle_x, (bottom + j + 0.5) * CELL + middle_y
    step = int(PIECE / CELL) + 1
    xx = xy = yy = 0
    for b in range(max(j - reach, 0), min(j + reach + 1, h)):
        for a in range(max(i - reach, 0), min(i + reach + 1, w)):
            for q in range(start[b * w + a], start[b * w + a + 1]):
                p = order[q]
                if not wire[p] or (x[p] - cx) ** 2 + (y[p] - cy) ** 2 > FAR * FAR:
                    continue
                for d in range(
                    max(b - step, 0), min(b + step + 1, h)
                ):  # of pieces of one wire: wires may lie far apart
                    for c in range(max(a - step, 0), min(a + step + 1, w)):
                        for t in range(start[d * w + c], start[d * w + c + 1]):
                            o = order[t]
                            dx, dy = x[o] - x[p], y[o] - y[p]
                            out = np.sqrt(dx * dx + dy * dy)
                            if wire[o] and out <= PIECE and abs(z[o] - z[p]) <= 0.3 * out + 0.1:
                                xx += int(np.rint(dx * dx * 1024))
                                xy += int(np.rint(dx * dy * 1024))
                                yy += int(np.rint(dy * dy * 1024))
    turn = 0.5 * np.arctan2(2.0 * float(xy), float(xx - yy))
    ux, uy = np.cos(turn), np.sin(turn)
    total, count = np.zeros(2, np.int64), np.zeros(2, np.int64)
    for b in range(max(j - reach, 0), min(j + reach + 1, h)):
        for a in range(max(i - reach, 0), min(i + reach + 1, w)):
            for q in range(start[b * w + a], start[b * w + a + 1]):
                p = order[q]
                if not wire[p]:
                    continue
                along, aside = (x[p] - cx) * ux + (y[p] - cy) * uy, (y[p] - cy) * ux - (x[p] - cx) * uy
                if not NEAR <= abs(along) <= FAR or abs(aside) > AT_TOWER:
                    continue
                side = 1 if along > 0.0 else 0
                for d in range(max(b - step, 0), min(b + step + 1, h)):
                    for c in range(max(a - step, 0), min(a + step + 1, w)):
                        for t in range(start[d * w + c], start[d * w + c + 1]):
                            o = order[t]
                            if not wire[o]:
                                continue
                            dx, dy, dz = x[o] - x[p], y[o] - y[p], z[p] - z[o]
                            out = (dx * ux + dy * uy) * (1.0 if side else -1.0)
                            steep, askew = abs(dz) > 0.3 * out + 0.1, abs(dy * ux - dx * uy) > 0.3 * out
                            if 0.5 * PIECE <= out <= PIECE and not steep and not askew:
                                total[side] += int(np.rint(dz / out * _PARTS))
                                count[side] += 1
    if count.sum() < PAIRS:
        return 0.0, turn
    if min(count[0], count[1]) < PAIRS:  # the last one of a line
        side = 0 if count[0] > count[1] else 1
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
def _mark(x, y, z, height, wire, order, start, h, w, left, bottom, axes, out):
    """Say which points are of the supports at axes."""
    for n in range(len(axes)):
        j, i, tall, high = int(axes[n, 0]), int(axes[n, 1]), axes[n, 2] > 0, axes[n, 3]
        size = min(max(axes[n, 8] / WIDE, 1.0), WIDEST)
        over = max(OVER, ABOVE * high) if tall else OVER
        cx, cy = (left + i + 0.5) * CELL + axes[n, 5], (bottom + j + 0.5) * CELL + axes[n, 6]
        ux, uy = np.cos(axes[n, 7]), np.sin(axes[n, 7])
        reach = int(AT_TOWER * size + BESIDE) + 1
        widest, low = 0.0, high
        for part in range(2):
            for b in range(max(j - reach, 0), min(j + reach + 1, h)):
                for a in range(max(i - reach, 0), min(i + reach + 1, w)):
                    for q in range(start[b * w + a], start[b * w + a + 1]):
                        p = order[q]
                        dx, dy = x[p] - cx, y[p] - cy
                        along, aside = abs(dx * ux + dy * uy), abs(dy * ux - dx * uy)
                        if wire[p]:
                            out[p] |= part == 1 and not tall and dx * dx + dy * dy <= OWN * OWN
                            if part == 0 and along <= 4.0 and aside <= AT_TOWER * size:
                                widest, low = max(widest, aside), min(low, height[p])
                            continue
                        if part == 0 or height[p] > high + over:
                            continue
                        far = np.sqrt(dx * dx + dy * dy)
                        if tall:
                            body = (TOP + SPREAD * max(high - height[p], 0.0)) * size
                            arm = (
                                height[p] >= low - 1.5 and along <= ALONG * size and aside <= widest + BESIDE
                            )
                            out[p] |= far <= body or arm
                        else:
                            arm = height[p] >= low - 1.0 and along <= STEM and aside <= POLE_ARM
                            out[p] |= far <= STEM or arm
