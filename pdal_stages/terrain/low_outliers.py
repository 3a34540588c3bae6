"""Tell low outliers, as of multiple reflections, from ground that is deep.

A low place is an outlier if it lies below the plane through its surroundings, and if no ground as
deep is near, as a street is to a courtyard. The ground filter and noise both use it: a change of
results here raises `algorithm_version` of both stages.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.jit import FAST, device, njit
from ..base.threads import map_blocks
from .cells import HOLE
from .components import linked_cells
from .openings import highest_around


class LowRules(NamedTuple):
    """Thresholds of low outliers; a NamedTuple, as kernels read it.

    Columns are those of the raster: of 1 m for the ground filter, 1.5 m for noise. What the search
    for ground as deep and its support are worth is in docs/results/ablation.md; the values
    themselves are not tuned.
    """

    near: int = 9  #: columns to each side through which the plane is fitted
    min_columns: int = 12  #: columns that a plane needs
    first_lowest: int = 10  #: the first fit trusts heights above the lowest tenth
    first_highest: int = 2  #: the first fit trusts heights up to the median
    first_weight: float = 0.01  #: weight of other heights in the first fit
    fits: int = 8  #: fits of a plane, each with the weights of the one before
    above_weight: float = 0.1  #: factor of the weight of columns above the plane: plants, roofs
    level_weight: float = 1e-3  #: pulls a plane level where columns lie on a line; square columns
    far_m: float = 30.0  #: distance up to which ground as deep is searched: a block of houses
    min_company: int = 4  #: columns of ground as deep that show that a place is ground
    company_depth: float = 0.5  #: least depth of such ground below the plane, by that of the place
    level_m: float = 1.0  #: ground as deep is at most this much higher than the place
    max_rise: float = 0.05  #: ground as deep may be this much higher again per meter away
    support: int = 2  #: columns to each side in which ground as deep needs others of its level
    min_support: int = 2  #: columns there that differ by at most `level_m`: else it may be noise
    min_support_share: float = 0.2  #: this share of the columns there with points is needed besides
    min_land: float = 0.0  #: share of the columns around the plane with such support, at least
    link: int = 3  #: cells of a minimum grid that are at most this far from each other are linked
    max_step_m: float = 0.35  #: height of a step across which cells are linked: a curb
    max_grade: float = 0.15  #: that step grows by this much per meter
    max_island: int = 30  #: cells of a set of linked cells that may be outliers
    max_extent: int = 20  #: cells along either axis of such a set


RULES = LowRules()
#: Least depth in meters of low outliers of a minimum grid below the plane.
DEPTH_M = 1.0
#: How often what lies around a rank is halved before it is looked at; results do not depend on it.
_HALVINGS = 8
#: Rows that a thread takes at a time; results do not depend on it.
_BAND = 32


def reach(side: float) -> int:
    """Return how far away, in columns of a `side` in meters, points change what is an outlier."""
    return RULES.near + math.ceil(RULES.far_m / side) + RULES.support


@device
def _columns_around(low, j, i, radius, near):
    """Copy the columns with points around one: dx, dy and height to `near` (3, m); their number."""
    h, w = low.shape
    n = 0
    for b in range(max(-radius, -j), min(radius + 1, h - j)):
        half = int(np.sqrt(float(radius * radius - b * b)))
        for a in range(max(-half, -i), min(half + 1, w - i)):
            near[0, n], near[1, n], near[2, n] = a, b, low[j + b, i + a]
            n += low[j + b, i + a] < np.inf
    return n


@device
def _value_of_rank(values, high, rank):
    """Return the value (n,) of a rank; values lie from 0 to `high`.

    What lies around it is halved by counting, which needs no branches: it costs less than sorting.
    """
    low = -1.0
    while True:
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            count = 0
            for k in range(len(values)):
                count += values[k] <= middle
            if rank < count:
                high = middle
            else:
                low = middle
        first, last = np.inf, -np.inf
        for k in range(len(values)):
            if low < values[k] <= high:
                first, last = min(first, values[k]), max(last, values[k])
        if first == last:
            return first


@device(fastmath=set(FAST))
def _plane_of_sums(sums, level_weight):
    """Solve the normal equations of a plane by Cramer's rule: height, rise per column and row."""
    s0, s1, s2, s11, s12, s22, t0, t1, t2 = sums
    s11, s22 = s11 + level_weight * s0, s22 + level_weight * s0
    c0 = s11 * s22 - s12 * s12
    c1 = s12 * s2 - s1 * s22
    c2 = s1 * s12 - s11 * s2
    det = s0 * c0 + s1 * c1 + s2 * c2
    return (
        (t0 * c0 + t1 * c1 + t2 * c2) / det,
        (t0 * c1 + t1 * (s0 * s22 - s2 * s2) + t2 * (s1 * s2 - s0 * s12)) / det,
        (t0 * c2 + t1 * (s1 * s2 - s0 * s12) + t2 * (s0 * s11 - s1 * s1)) / det,
    )


@device(fastmath=set(FAST) | {"nnan"})
def _plane_under(low, j, i, rules, near):
    """Fit a plane under the columns around one: return its height there, and its rise per column.

    Iteratively reweighted least squares; the height is -inf where there are too few columns.
    `near` (3, m) is working memory.
    """
    n = _columns_around(low, j, i, rules.near, near)
    if n < rules.min_columns:
        return -np.inf, 0.0, 0.0
    u, v, zs = near[0, :n], near[1, :n], near[2, :n]
    lowest = highest = zs[0]
    for k in range(n):
        lowest, highest = min(lowest, zs[k]), max(highest, zs[k])
    for k in range(n):
        zs[k] -= lowest
    highest_trusted = _value_of_rank(zs, highest - lowest, n // rules.first_highest)
    lowest_trusted = _value_of_rank(zs, highest_trusted, n // rules.first_lowest)
    p0 = p1 = p2 = 0.0
    for fit in range(rules.fits):
        s0 = s1 = s2 = s11 = s12 = s22 = t0 = t1 = t2 = 0.0
        for k in range(n):
            x, y, z = u[k], v[k], zs[k]
            if fit == 0:
                g = 1.0 if lowest_trusted <= z <= highest_trusted else rules.first_weight
            else:
                off = z - p0 - p1 * x - p2 * y
                g = 1.0 / (1.0 + off * off)
                g = g * g if off < 0.0 else rules.above_weight * g
            gx, gy = g * x, g * y
            s0 += g
            s1 += gx
            s2 += gy
            s11 += gx * x
            s12 += gx * y
            s22 += gy * y
            t0 += g * z
            t1 += gx * z
            t2 += gy * z
        sums = s0, s1, s2, s11, s12, s22, t0, t1, t2
        p0, p1, p2 = _plane_of_sums(sums, rules.level_weight)
    return p0 + lowest, p1, p2


@njit
def _supported(base, rules):
    """Find the columns (h, w) with enough others of their level around."""
    h, w = base.shape
    out = np.empty((h, w), np.bool_)
    for j in range(h):
        for i in range(w):
            level, seen = 0, 0
            if base[j, i] < np.inf:
                for b in range(max(j - rules.support, 0), min(j + rules.support + 1, h)):
                    for a in range(max(i - rules.support, 0), min(i + rules.support + 1, w)):
                        seen += base[b, a] < np.inf
                        level += abs(base[b, a] - base[j, i]) <= rules.level_m
            out[j, i] = level > rules.min_support + rules.min_support_share * seen
    return out


@device
def _has_company(base, supported, side, j, i, z, plane, rules):
    """Tell whether enough other columns lie `company_depth` times as deep as z below the plane."""
    h, w = base.shape
    far, company = int(np.ceil(rules.far_m / side)), 0
    least = rules.company_depth * (plane[0] - z)
    for step in range(2 * far + 1):  # rows outward: most company is near
        b = j + (step + 1) // 2 * (1 - 2 * (step & 1))
        if b < 0 or b >= h:
            continue
        for a in range(max(i - far, 0), min(i + far + 1, w)):
            if not supported[b, a]:
                continue
            away = side * np.sqrt(float((b - j) ** 2 + (a - i) ** 2))
            below = plane[0] + plane[1] * (a - i) + plane[2] * (b - j) - base[b, a]
            most = z + min(least, rules.level_m + rules.max_rise * away)
            company += away <= rules.far_m and base[b, a] <= most and below >= least
        if company >= rules.min_company:
            return True
    return False


@device
def _has_land(base, supported, j, i, rules):
    """Tell whether the columns that a plane is fitted through are land: many have support."""
    h, w = base.shape
    seen, land = 0, 0
    for b in range(max(j - rules.near, 0), min(j + rules.near + 1, h)):
        for a in range(max(i - rules.near, 0), min(i + rules.near + 1, w)):
            if (b - j) ** 2 + (a - i) ** 2 <= rules.near**2:
                seen += base[b, a] < np.inf
                land += supported[b, a]
    return land >= rules.min_land * seen


@njit
def _judge_places(low, base, supported, side, depth, rules, first, levels):
    """Fill the rows (m, w) of `levels`, the first of which is the row `first`."""
    near = np.empty((3, (2 * rules.near + 1) ** 2))
    for j in range(first, first + len(levels.plane)):
        for i in range(low.shape[1]):
            if low[j, i] == np.inf:
                continue
            plane = _plane_under(base, j, i, rules, near)
            if plane[0] == -np.inf:
                continue
            levels.plane[j - first, i], lowest = plane[0], plane[0] - depth
            if (
                low[j, i] < lowest
                and _has_land(base, supported, j, i, rules)
                and not _has_company(base, supported, side, j, i, low[j, i], plane, rules)
            ):
                levels.limit[j - first, i] = lowest


class Levels(NamedTuple):
    """Heights (h, w) in meters that low places are compared with."""

    plane: NDArray[np.float64]  #: of the plane through the surroundings; inf where there is none
    limit: NDArray[np.float64]  #: below it low places are outliers; -inf where one may be ground


def find_levels(
    low: NDArray,
    base: NDArray,
    side: float,
    depth: float,
    rules: LowRules,
    threads: int | None = 1,
    needs_plane: NDArray[np.bool_] | None = None,
) -> Levels:
    """Return the heights (h, w) that low places are compared with.

    Parameters
    ----------
    low, base : (h, w)
        The lowest heights in meters of what may be an outlier, and of the rest; ``inf`` where there
        is none.
    side, depth : float
        Side of a column, and least depth of outliers below the ground, in meters.
    rules : LowRules
        Thresholds.
    threads : int, optional
        Each takes some rows.
    needs_plane : (h, w) bool, optional
        Columns that get a plane even if all around them lies lower.
    """
    levels = Levels(np.full(low.shape, np.inf), np.full(low.shape, -np.inf))
    # Where all around lies lower, no plane through it runs above.
    heights = np.where(np.isfinite(base), base, -HOLE).astype(np.float32)
    wanted = low < highest_around(heights, rules.near, 0)
    low = np.where(wanted if needs_plane is None else wanted | needs_plane, low, np.inf)
    supported = _supported(base, rules)

    def judge(first: int) -> None:
        rows = Levels(*(each[first : first + _BAND] for each in levels))
        _judge_places(low, base, supported, side, depth, rules, first, rows)

    list(map_blocks(judge, range(0, len(low), _BAND), threads))
    return levels


def find_low_outliers(
    raster: NDArray[np.float32], cell: float, threads: int | None = 1
) -> NDArray[np.bool_]:
    """Find the cells (h, w) of a minimum grid whose lowest point is a low outlier.

    Only small sets of cells that no small step links to others are judged. The raster is in meters,
    holes are ``inf``; `cell` is the side of a cell in meters.
    """
    rules = RULES
    number, size, side = linked_cells(
        raster, rules.link, lambda away: rules.max_step_m + rules.max_grade * cell * away
    )
    small = (size <= rules.max_island) & (side < rules.max_extent)
    island = np.append(small, False)[number]
    if not island.any():
        return island
    low, base = np.where(island, raster, HOLE), np.where(island, HOLE, raster)
    return find_levels(low, base, cell, DEPTH_M, rules, threads).limit > -np.inf


def outlier_reach(cell: float) -> int:
    """Return how far away cells of a minimum grid change what is a low outlier, in cells."""
    return reach(cell) + RULES.max_extent + RULES.link + 1
