"""Detect towers: what stands upright where spans of wires end.

An axis is a cell around which points fill the height up to the wires near it, in a body that is
clear of anything else below its arms. It is a tower where the wires say so: towards it they rise
from both sides, as a wire is highest at its ends. Sums are whole numbers and reaches are bounded,
so neither the order of points nor the tile matters.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.grid import GridWindow, cell_keys, cell_numbers
from ..base.jit import device, njit
from ..terrain.pieces import patches

#: Side of the cells, meters.
CELL_M = 1.0


class TowerRules(NamedTuple):
    """Thresholds of the tower detector, which kernels take as they are; set on a power line of 14
    points/m2 (AHN4)."""

    foot_m: float = 0.7  #: points lower above the ground are of none
    from_m: float = 2.0  #: the height is looked at from there: bushes are at feet
    min_wire_m: float = 14.0  #: height of the wires: lower ones hang on poles
    max_wire_m: float = 256.0  #: height of the wires: higher is noise
    wire_near: int = 10  #: cells from the axis to the wires: half a cross-arm
    min_half: int = 4  #: half the width of a body, cells
    max_half: int = 10  #: half the width of a body, cells: towers of 380 kV
    clear_rings: int = 3  #: rings of cells around a body that are as good as clear
    max_clear_ratio: float = 0.05  #: points in these per point of the body
    max_aside_ratio: float = 0.5  #: share of what widens a body that lies more to one side: trees
    ring_from: int = 6  #: around a slim body, where no ring is clear, the rings from this one
    ring_to: int = 8  #: to this one
    max_crowd_ratio: float = 0.5  #: hold so many points per point of the body
    trunk_from: float = 0.2  #: of the wires' height: bushes are below
    trunk_to: float = 0.5  #: of the wires' height: arms are above
    min_filled: float = 0.6  #: share of the meters up to the wires that hold points
    wires_from_m: float = 2.0  #: wires are looked at from so far from the axis
    wires_to_m: float = 15.0  #: to so far
    piece_m: float = 4.0  #: longest piece of a wire between two of its points
    min_rise: float = 0.015  #: rise over run of the wires towards the axis, both sides together
    min_pairs: int = 4  #: pieces of wires at a side
    apart: int = 15  #: cells between towers
    wide_half: float = 4.0  #: bodies of more cells have arms longer in proportion
    max_scale: float = 2.0  #: up to so much
    top_m: float = 1.5  #: half the width of what is marked at the top
    spread: float = 0.12  #: and so much more per meter below
    arm_below_m: float = 1.5  #: arms are marked from so much below the lowest wire
    arm_beside_m: float = 1.5  #: to so far beyond the outermost wire
    arm_along_m: float = 2.5  #: and to so far along the wires
    over_m: float = 4.0  #: marked above the wires: earth wires' peaks
    over_ratio: float = 0.3  #: of the wires' height, where that is more: long insulators

    @property
    def reach_m(self) -> float:
        """How far away wires and points can change whether a point is of a tower."""
        wires = self.wires_to_m + self.piece_m + 4.0
        return self.wire_near * self.max_scale + self.arm_beside_m + self.apart + wires


RULES = TowerRules()
_PARTS = 1 << 16


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
    rules: TowerRules = RULES,
) -> NDArray[np.bool_]:
    """Return which points (n,) are of towers.

    Coordinates (n, 3) and heights above ground in meters, finite; `wire` tells the points of wires;
    points that are not to `use` are not seen.
    """
    out = np.zeros(len(xyz), bool)
    wires = np.flatnonzero(wire & use)
    if not len(wires):
        return out
    column, row = cell_numbers(xyz[:, 0], CELL_M), cell_numbers(xyz[:, 1], CELL_M)
    near = np.flatnonzero(use & (wire | (height > rules.foot_m)) & _near(column, row, wires, rules))
    for points, own in patches(column[near], row[near], int(rules.reach_m), int(rules.reach_m)):
        at = near[points]
        window = GridWindow.enclosing(column[at], row[at])
        left, bottom, w, h = window
        cell = window.flat_index(column[at], row[at])
        order = np.argsort(cell, kind="stable")
        start = np.searchsorted(cell[order], np.arange(h * w + 1))
        some = at[order]
        x, y, z = (xyz[some] - [left * CELL_M, bottom * CELL_M, 0.0]).T.copy()
        cloud = Cloud(x, y, z, height[some], wire[some], *np.divmod(cell[order], w), start, h, w)
        found = np.zeros(len(at), bool)
        for axis in _best(_axes(cloud, rules), rules):
            _mark(cloud, axis, rules, found)
        mine = np.zeros(len(at), bool)
        mine[own] = True
        out[some[mine[order]]] = found[mine[order]]
    return out


def _near(
    column: NDArray[np.int64], row: NDArray[np.int64], wires: NDArray[np.int64], rules
) -> NDArray[np.bool_]:
    """Find the points in blocks at wires, and in those around."""
    arms = int(rules.wire_near * rules.max_scale + rules.arm_beside_m)
    side = arms + rules.max_half + rules.clear_rings
    key = cell_keys(column // side, row // side)
    steps = np.array([(b << 32) + a for b in (-1, 0, 1) for a in (-1, 0, 1)])
    return np.isin(key, np.unique(key[wires])[:, None] + steps)


@device(_nrt=True)
def _around(cloud, j, i, reach):
    """Return the numbers of the points in the cells up to `reach` away."""
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
def _axes(cloud, rules):
    """Find cells that may be the axis of a tower (m, 8): row, column, how high its wires hang,
    score, its middle, the direction of its wires as an angle, and half its width in cells.
    """
    top, there = np.full((cloud.h, cloud.w), -1.0), np.zeros((cloud.h, cloud.w), np.bool_)
    for p in range(len(cloud.x)):
        j, i = cloud.row[p], cloud.column[p]
        if cloud.wire[p]:
            top[j, i] = max(top[j, i], cloud.height[p])
        else:
            there[j, i] = True
    out, n, reach = np.empty((64, 8)), 0, rules.wire_near
    for j in range(cloud.h):
        for i in range(cloud.w):
            if not there[j, i]:
                continue
            high = top[max(j - reach, 0) : j + reach + 1, max(i - reach, 0) : i + reach + 1].max()
            if not rules.min_wire_m <= high < rules.max_wire_m:
                continue
            half = _half_width(cloud, j, i, high, rules)
            score, x, y = _upright(cloud, j, i, half, high, rules) if half else (0.0, 0.0, 0.0)
            if score <= 0:
                continue
            rise, turn = _rise(cloud, j, i, x, y, rules)
            if rise >= rules.min_rise:
                if n == len(out):
                    out = np.concatenate((out, out))
                axis = (float(j), float(i), high, score, x, y, turn, float(half))
                for k, value in enumerate(axis):
                    out[n, k] = value
                n += 1
    return out[:n].copy()


@device(_nrt=True)
def _half_width(cloud, j, i, high, rules):
    """Return how many cells a body reaches from its axis, below the arms; 0 where it stands among
    other things."""
    rings = np.zeros((rules.max_half + rules.clear_rings + 1, 3), np.int64)
    for p in _around(cloud, j, i, len(rings) - 1):
        if (
            not cloud.wire[p]
            and rules.trunk_from * high <= cloud.height[p] <= rules.trunk_to * high
        ):
            a, b = cloud.column[p] - i, cloud.row[p] - j
            ring = rings[max(abs(a), abs(b))]
            ring[0] += 1
            ring[1] += a
            ring[2] += b
    inside = slim = around = way = across = along = 0
    for k in range(rules.max_half + 1):
        inside += rings[k, 0]
        if k <= rules.min_half:
            slim = inside
        else:
            way += k * rings[k, 0]
            across += rings[k, 1]
            along += rings[k, 2]
        around += rings[k, 0] if rules.ring_from <= k <= rules.ring_to else 0
        beyond = rings[k + 1 : k + rules.clear_rings + 1, 0].sum()
        aside = abs(across) + abs(along) > rules.max_aside_ratio * way  # a tree
        clear = inside > 0 and beyond <= rules.max_clear_ratio * inside
        if k >= rules.min_half and clear and not aside:
            return k
    return rules.min_half if slim > 0 and around <= rules.max_crowd_ratio * slim else 0


@device(_nrt=True)
def _upright(cloud, j, i, half, high, rules):
    """Score how well the points around a cell fill a body up to the wires, 0 where they do not; and
    its middle (x, y)."""
    first, last = int(rules.from_m), int(high)
    filled, sums = np.zeros(last + 2, np.bool_), np.zeros(3, np.int64)
    for p in _around(cloud, j, i, half):
        height = cloud.height[p]
        if cloud.wire[p]:
            continue
        if rules.from_m <= height < high + 1.0:
            filled[int(height)] = True
        if 0.5 * high <= height <= high:
            sums[0] += 1
            sums[1] += int(np.rint((cloud.x[p] - (i + 0.5) * CELL_M) * _PARTS))
            sums[2] += int(np.rint((cloud.y[p] - (j + 0.5) * CELL_M) * _PARTS))
    count = lower = upper = 0
    for s in range(first, last + 1):
        if filled[s]:
            count += 1
            lower += 2 * s < high
            upper += 4 * s >= 3 * high - 4
    share = count / (last - first + 1)
    if sums[0] == 0 or lower == 0 or upper == 0 or share < rules.min_filled:
        return 0.0, 0.0, 0.0
    x, y = sums[1] / (sums[0] * _PARTS), sums[2] / (sums[0] * _PARTS)
    # The better, the wider, and the nearer to its middle.
    return half * 1000.0 - min(x * x + y * y, 100.0), x, y


@device(_nrt=True)
def _rise(cloud, j, i, x, y, rules):
    """Return how wires rise towards an axis, from both sides together, and their direction there as
    an angle.

    Of pairs of points, as of pieces of one wire: wires may lie far apart.
    """
    pairs, n = np.empty((256, 5)), 0
    xx = xy = yy = 0
    for p in _around(cloud, j, i, int(rules.wires_to_m / CELL_M) + 1):
        away_x, away_y = cloud.x[p] - (i + 0.5) * CELL_M - x, cloud.y[p] - (j + 0.5) * CELL_M - y
        if not cloud.wire[p] or away_x * away_x + away_y * away_y > rules.wires_to_m**2:
            continue
        for o in _around(cloud, cloud.row[p], cloud.column[p], int(rules.piece_m / CELL_M) + 1):
            dx, dy, dz = cloud.x[o] - cloud.x[p], cloud.y[o] - cloud.y[p], cloud.z[o] - cloud.z[p]
            out = np.sqrt(dx * dx + dy * dy)
            if not cloud.wire[o] or out > rules.piece_m or abs(dz) > 0.3 * out + 0.1:
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
        near = abs(along) >= rules.wires_from_m and abs(aside) <= rules.wire_near
        if near and out >= max(0.5 * rules.piece_m, askew / 0.3):
            total[side] -= int(np.rint(pairs[k, 4] / out * _PARTS))
            count[side] += 1
    if count.sum() < rules.min_pairs:
        return 0.0, turn
    if count.min() < rules.min_pairs:  # the last one of a line
        side = int(count[1] > count[0])
        return 2.0 * total[side] / count[side] / _PARTS, turn
    return (total[0] / count[0] + total[1] / count[1]) / _PARTS, turn


def _best(axes: NDArray[np.float64], rules: TowerRules) -> NDArray[np.float64]:
    """Keep the best of axes near each other; of equal ones the first by row and column."""
    from scipy.spatial import cKDTree

    axes = axes[np.lexsort((axes[:, 1], axes[:, 0], -axes[:, 3]))]
    near = cKDTree(axes[:, :2]).query_pairs(rules.apart, p=np.inf, output_type="ndarray")
    return np.delete(axes, near.max(axis=1), axis=0)


@njit
def _mark(cloud, axis, rules, out):
    """Mark the points of the tower at an axis, see `_axes`."""
    j, i, high, _, x, y, turn, half = axis
    size = min(max(half / rules.wide_half, 1.0), rules.max_scale)
    over = max(rules.over_m, rules.over_ratio * high)
    ux, uy = np.cos(turn), np.sin(turn)
    widest, low, arms = 0.0, high, rules.wire_near * size
    near = _around(cloud, int(j), int(i), int(arms + rules.arm_beside_m) + 1)
    for known in range(2):  # how far arms reach is known after the wires
        for p in near:
            # In this order, whatever the raster's corner is.
            dx, dy = cloud.x[p] - (i + 0.5) * CELL_M - x, cloud.y[p] - (j + 0.5) * CELL_M - y
            height = cloud.height[p]
            along, aside = abs(dx * ux + dy * uy), abs(dy * ux - dx * uy)
            if cloud.wire[p] and not known:
                if along <= 4.0 and aside <= arms:
                    widest, low = max(widest, aside), min(low, height)
            elif known and height <= high + over:
                body = (rules.top_m + rules.spread * max(high - height, 0.0)) * size
                out[p] |= np.sqrt(dx * dx + dy * dy) <= body
                on_arm = height >= low - rules.arm_below_m and along <= rules.arm_along_m * size
                out[p] |= on_arm and aside <= widest + rules.arm_beside_m and not cloud.wire[p]
