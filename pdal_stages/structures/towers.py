"""Detect towers: what stands upright where spans of wires end.

An axis is a cell around which points stand in a body from near the ground up to the wires near it.
It is a tower where the wires show it: towards it they rise from both sides, as a wire is highest at
its ends, or from one side at the end of a line. Sums are whole numbers and reaches are bounded, so
neither the order of points nor the tile matters.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.grid import GridWindow, cell_keys, cell_numbers, key_offset
from ..base.jit import device, njit
from ..terrain.pieces import patches

#: Side of the cells, meters.
CELL_M = 1.0


class TowerRules(NamedTuple):
    """Thresholds of the tower detector, a named tuple because compiled kernels read it.

    They were set on a power line of 14 points/m2 (AHN4), the one survey with towers; what some are
    worth there is in docs/results/ablation.md.
    """

    foot_m: float = 0.7  #: points lower above the ground are not marked
    body_from_m: float = 2.0  #: points of a body are higher: bushes stand at its feet
    min_wire_m: float = 14.0  #: height of the wires: lower ones hang on poles
    max_wire_m: float = 256.0  #: height of the wires: higher ones are noise
    wire_near: int = 10  #: cells from the axis to the nearest wires: half a cross-arm
    half_body: int = 4  #: cells from the axis to points of its body
    lower_ratio: float = 0.5  #: a body has points below this part of the height of its wires
    upper_ratio: float = 0.75  #: a body has points above this part of that height, or little below:
    upper_slack_m: float = 1.0  #: they may be this much lower
    top_slack_m: float = 1.0  #: and they are less than this above the wires
    wires_from_m: float = 2.0  #: the rise of wires is measured from this far from the axis
    wires_to_m: float = 15.0  #: the rise of wires is measured up to this far from the axis
    piece_m: float = 4.0  #: longest piece of a wire between two of its points
    max_piece_slope: float = 0.3  #: rise over run of a piece
    max_piece_step_m: float = 0.1  #: that rise may be this much more: noise
    #: of a piece, meters across the direction of the wires per meter along it
    max_askew: float = 0.3
    min_rise: float = 0.015  #: rise over run of the wires towards the axis, both sides together
    min_apart: int = 15  #: cells between towers, along either axis
    top_radius_m: float = 3.0  #: a body's radius at the height of the wires
    widening: float = 0.12  #: a body's radius grows by this much per meter below
    arm_m: float = 10.0  #: bodies are wider in proportion where arms are longer
    arm_wires_m: float = 4.0  #: wires at most this far along the line show how long arms are
    max_arm_m: float = 20.0  #: from the axis to the outermost wire: towers of 380 kV
    arm_below_m: float = 1.5  #: arms are marked from this far below the lowest wire
    arm_beside_m: float = 1.5  #: arms are marked to this far beyond the outermost wire
    arm_along_m: float = 2.5  #: arms are marked to this far from the axis along the wires
    peak_m: float = 8.0  #: points up to this far above the wires are marked: peaks with earth wires
    #: more of `reach_m`: the middle of a body lies beside its cell; not tuned
    reach_margin_m: float = 4.0

    @property
    def reach_m(self) -> float:
        """Distance in meters up to which wires and points decide whether a point is of a tower."""
        wires = self.wires_to_m + self.piece_m + self.reach_margin_m
        return self.max_arm_m + self.arm_beside_m + self.min_apart * CELL_M + wires


RULES = TowerRules()
#: Parts of a meter in which places, and of 1 in which slopes, are summed up, as whole numbers.
FINE_PARTS = 1 << 16
#: Parts of a square meter in which products of lengths are summed up.
SQUARE_PARTS = 1024


class Cloud(NamedTuple):
    """Points in the order of the cells of a raster."""

    x: NDArray[np.float64]  #: (n,) meters from the raster's corner, as `y`
    y: NDArray[np.float64]
    z: NDArray[np.float64]
    height: NDArray[np.float64]  #: above the ground
    wire: NDArray[np.bool_]  #: whether it is a wire's
    row: NDArray[np.int64]
    column: NDArray[np.int64]
    start: NDArray[np.int64]  #: (h * w + 1,) the first point of each cell
    h: int
    w: int


class Axis(NamedTuple):
    """The axis of a tower."""

    row: int
    column: int
    high: float  #: height of the wires there above the ground, meters
    x: float  #: middle of the body, meters east of the middle of the cell
    y: float
    turn: float  #: direction of the wires as an angle


def find_towers(
    xyz: NDArray[np.float64],
    height: NDArray[np.float64],
    wire: NDArray[np.bool_],
    use: NDArray[np.bool_],
    rules: TowerRules = RULES,
) -> NDArray[np.bool_]:
    """Return which points (n,) are of towers.

    Coordinates (n, 3) and heights above ground (n,) are in meters, finite; `wire` (n,) tells the
    points of wires; points that are not in `use` (n,) are ignored.
    """
    is_tower = np.zeros(len(xyz), bool)
    wires = np.flatnonzero(wire & use)
    if not len(wires):
        return is_tower
    column, row = cell_numbers(xyz[:, 0], CELL_M), cell_numbers(xyz[:, 1], CELL_M)
    candidates = use & (wire | (height > rules.foot_m)) & _are_near(column, row, wires, rules)
    near = np.flatnonzero(candidates)
    reach = int(rules.reach_m / CELL_M)
    for points, inner in patches(column[near], row[near], reach, reach):
        at = near[points]
        window = GridWindow.enclosing(column[at], row[at])
        left, bottom, w, h = window
        cell = window.flat_index(column[at], row[at])
        order = np.argsort(cell, kind="stable")
        start = np.searchsorted(cell[order], np.arange(h * w + 1))
        rows = at[order]
        x, y, z = (xyz[rows] - [left * CELL_M, bottom * CELL_M, 0.0]).T.copy()
        cloud = Cloud(x, y, z, height[rows], wire[rows], *np.divmod(cell[order], w), start, h, w)
        marked = np.zeros(len(at), bool)
        for axis in _select_axes(_find_axes(cloud, rules), rules):
            _mark(cloud, axis, rules, marked)
        is_inner = np.zeros(len(at), bool)
        is_inner[inner] = True
        is_tower[rows[is_inner[order]]] = marked[is_inner[order]]
    return is_tower


def _are_near(
    column: NDArray[np.int64], row: NDArray[np.int64], wires: NDArray[np.int64], rules: TowerRules
) -> NDArray[np.bool_]:
    """Return which points (n,) lie in blocks with wires, or in those around."""
    side = int(rules.max_arm_m + rules.arm_beside_m) + rules.half_body
    key = cell_keys(column // side, row // side)
    steps = np.array([key_offset(a, b) for b in (-1, 0, 1) for a in (-1, 0, 1)])
    return np.isin(key, np.unique(key[wires])[:, None] + steps)


@device(_nrt=True)
def _list_near(cloud, row, column, reach):
    """Return the numbers of the points in the cells up to `reach` away."""
    low, high = max(column - reach, 0), min(column + reach, cloud.w - 1) + 1
    rows, count = range(max(row - reach, 0), min(row + reach + 1, cloud.h)), 0
    for b in rows:
        count += cloud.start[b * cloud.w + high] - cloud.start[b * cloud.w + low]
    points = np.empty(count, np.int64)
    for b in rows:
        for p in range(cloud.start[b * cloud.w + low], cloud.start[b * cloud.w + high]):
            count -= 1
            points[count] = p
    return points


@njit
def _find_axes(cloud, rules):
    """Return cells that may be the axis of a tower, (m, 6) as in :class:`Axis`."""
    top, there = np.full((cloud.h, cloud.w), -1.0), np.zeros((cloud.h, cloud.w), np.bool_)
    for p in range(len(cloud.x)):
        j, i = cloud.row[p], cloud.column[p]
        if cloud.wire[p]:
            top[j, i] = max(top[j, i], cloud.height[p])
        else:
            there[j, i] = True
    axes, n, reach = np.empty((64, 6)), 0, rules.wire_near
    for j in range(cloud.h):
        for i in range(cloud.w):
            if not there[j, i]:
                continue
            high = top[max(j - reach, 0) : j + reach + 1, max(i - reach, 0) : i + reach + 1].max()
            if not rules.min_wire_m <= high < rules.max_wire_m:
                continue
            stands, x, y = _find_body(cloud, j, i, high, rules)
            if not stands:
                continue
            rise, turn = _rise(cloud, Axis(j, i, high, x, y, 0.0), rules)
            if rise >= rules.min_rise:
                if n == len(axes):
                    axes = np.concatenate((axes, axes))
                for k, value in enumerate((float(j), float(i), high, x, y, turn)):
                    axes[n, k] = value
                n += 1
    return axes[:n].copy()


@device(_nrt=True)
def _find_body(cloud, j, i, high, rules):
    """Return whether points around a cell stand from near the ground up to wires `high` above it.

    And the middle (x, y) of the upper half of them.
    """
    lower, upper, sums = False, False, np.zeros(3, np.int64)
    for p in _list_near(cloud, j, i, rules.half_body):
        height = cloud.height[p]
        if cloud.wire[p] or height < rules.body_from_m:
            continue
        lower |= int(height) < rules.lower_ratio * high
        reaches_up = int(height) >= rules.upper_ratio * high - rules.upper_slack_m
        upper |= reaches_up and height < high + rules.top_slack_m
        if 0.5 * high <= height <= high:
            sums[0] += 1
            sums[1] += int(np.rint((cloud.x[p] - (i + 0.5) * CELL_M) * FINE_PARTS))
            sums[2] += int(np.rint((cloud.y[p] - (j + 0.5) * CELL_M) * FINE_PARTS))
    if not (lower and upper and sums[0] > 0):
        return False, 0.0, 0.0
    return True, sums[1] / (sums[0] * FINE_PARTS), sums[2] / (sums[0] * FINE_PARTS)


@device(_nrt=True)
def _rise(cloud, axis, rules):
    """Return how wires rise towards an axis, from both sides together, and their direction there.

    The direction is an angle. Every two points of wires near each other, and neither steep nor
    askew, count as a piece of a wire. Where one side has no pieces the other counts twice.
    """
    pairs, n = np.empty((256, 5)), 0
    xx = xy = yy = 0
    x, y = (axis.column + 0.5) * CELL_M, (axis.row + 0.5) * CELL_M
    for p in _list_near(cloud, axis.row, axis.column, int(rules.wires_to_m / CELL_M) + 1):
        away_x, away_y = cloud.x[p] - x - axis.x, cloud.y[p] - y - axis.y
        if not cloud.wire[p] or away_x * away_x + away_y * away_y > rules.wires_to_m**2:
            continue
        for o in _list_near(cloud, cloud.row[p], cloud.column[p], int(rules.piece_m / CELL_M) + 1):
            dx, dy, dz = cloud.x[o] - cloud.x[p], cloud.y[o] - cloud.y[p], cloud.z[o] - cloud.z[p]
            run = np.sqrt(dx * dx + dy * dy)
            most = rules.max_piece_slope * run + rules.max_piece_step_m
            if not cloud.wire[o] or run > rules.piece_m or abs(dz) > most:
                continue
            xx += int(np.rint(dx * dx * SQUARE_PARTS))
            xy += int(np.rint(dx * dy * SQUARE_PARTS))
            yy += int(np.rint(dy * dy * SQUARE_PARTS))
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
        run, askew = dx * ux + dy * uy, abs(dy * ux - dx * uy)
        side = int(along > 0.0)
        run = run if side else -run
        near = abs(along) >= rules.wires_from_m and abs(aside) <= rules.wire_near
        if near and run >= max(0.5 * rules.piece_m, askew / rules.max_askew):
            total[side] -= int(np.rint(pairs[k, 4] / run * FINE_PARTS))
            count[side] += 1
    if count.min() == 0:  # the last one of a line
        return 2.0 * total.sum() / max(count.sum(), 1) / FINE_PARTS, turn
    return (total[0] / count[0] + total[1] / count[1]) / FINE_PARTS, turn


def _select_axes(axes: NDArray[np.float64], rules: TowerRules) -> list[Axis]:
    """Keep of axes near each other the one nearest to its middle; then the first by row, column."""
    from scipy.spatial import cKDTree

    row, column, _, x, y, _ = axes.T
    axes = axes[np.lexsort((column, row, x * x + y * y))]
    near = cKDTree(axes[:, :2]).query_pairs(rules.min_apart, p=np.inf, output_type="ndarray")
    kept = np.delete(axes, near.max(axis=1), axis=0)
    return [Axis(int(row), int(column), *place) for row, column, *place in kept.tolist()]


@njit
def _mark(cloud, axis, rules, marked):
    """Mark the points of the tower at an axis."""
    ux, uy = np.cos(axis.turn), np.sin(axis.turn)
    x, y = (axis.column + 0.5) * CELL_M, (axis.row + 0.5) * CELL_M
    widest, low = 0.0, axis.high
    reach = int(rules.max_arm_m + rules.arm_beside_m) + 1
    near = _list_near(cloud, axis.row, axis.column, reach)
    for known in range(2):  # wires come first: they show how far arms reach
        for p in near:
            # Subtracted in this order, rounding does not depend on the raster's corner.
            dx, dy = cloud.x[p] - x - axis.x, cloud.y[p] - y - axis.y
            height = cloud.height[p]
            along, aside = abs(dx * ux + dy * uy), abs(dy * ux - dx * uy)
            if cloud.wire[p] and not known:
                if along <= rules.arm_wires_m and aside <= rules.max_arm_m:
                    widest, low = max(widest, aside), min(low, height)
            elif known and height <= axis.high + rules.peak_m:
                body = rules.top_radius_m + rules.widening * max(axis.high - height, 0.0)
                marked[p] |= np.sqrt(dx * dx + dy * dy) <= body * max(widest / rules.arm_m, 1.0)
                on_arm = height >= low - rules.arm_below_m and along <= rules.arm_along_m
                on_arm &= aside <= widest + rules.arm_beside_m and not cloud.wire[p]
                marked[p] |= on_arm
