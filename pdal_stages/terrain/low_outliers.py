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
    link: int = 3  #: cells of a minimum grid that are at most this far from each other are linked
    max_step_m: float = 0.35  #: height of a step across which cells are linked: a curb
    max_grade: float = 0.15  #: that step grows by this much per meter
    max_island: int = 30  #: cells of a set of linked cells that may be outliers
    max_extent: int = 20  #: cells along either axis of such a set


RULES = LowRules()


def reach(side: float) -> int:
    """Return how far away, in columns of a `side` in meters, points change what is an outlier."""
    return RULES.near + math.ceil(RULES.far_m / side) + RULES.support


@device(_nrt=True, fastmath=set(FAST))
def _plane_under(low, j, i, rules):
    """Fit a plane under the columns around one: return its height there, and its rise per column.

    Iteratively reweighted least squares; the height is -inf where there are too few columns.
    """
    h, w = low.shape
    u, v, zs = np.empty((3, (2 * rules.near + 1) ** 2))
    n, radius = 0, rules.near
    for b in range(max(-radius, -j), min(radius + 1, h - j)):
        for a in range(max(-radius, -i), min(radius + 1, w - i)):
            if low[j + b, i + a] < np.inf and a * a + b * b <= radius * radius:
                u[n], v[n], zs[n] = a, b, low[j + b, i + a]
                n += 1
    if n < rules.min_columns:
        return -np.inf, 0.0, 0.0
    lowest = zs[:n].min()
    zs = zs[:n] - lowest
    order = np.sort(zs)
    trusted = zs >= order[n // rules.first_lowest]
    trusted &= zs <= order[n // rules.first_highest]
    weight = np.where(trusted, 1.0, rules.first_weight)
    p0 = p1 = p2 = 0.0
    for _ in range(rules.fits):
        s0 = s1 = s2 = s11 = s12 = s22 = t0 = t1 = t2 = 0.0
        for k in range(n):
            g = weight[k]
            s0 += g
            s1 += g * u[k]
            s2 += g * v[k]
            s11 += g * u[k] * u[k]
            s12 += g * u[k] * v[k]
            s22 += g * v[k] * v[k]
            t0 += g * zs[k]
            t1 += g * u[k] * zs[k]
            t2 += g * v[k] * zs[k]
        s11, s22 = s11 + rules.level_weight * s0, s22 + rules.level_weight * s0
        # Cramer's rule.
        c0 = s11 * s22 - s12 * s12
        c1 = s12 * s2 - s1 * s22
        c2 = s1 * s12 - s11 * s2
        det = s0 * c0 + s1 * c1 + s2 * c2
        p0 = (t0 * c0 + t1 * c1 + t2 * c2) / det
        p1 = (t0 * c1 + t1 * (s0 * s22 - s2 * s2) + t2 * (s1 * s2 - s0 * s12)) / det
        p2 = (t0 * c2 + t1 * (s1 * s2 - s0 * s12) + t2 * (s0 * s11 - s1 * s1)) / det
        for k in range(n):
            off = zs[k] - p0 - p1 * u[k] - p2 * v[k]
            g = 1.0 / (1.0 + off * off)
            weight[k] = g * g if off < 0.0 else rules.above_weight * g
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
    for b in range(max(j - far, 0), min(j + far + 1, h)):
        for a in range(max(i - far, 0), min(i + far + 1, w)):
            if not supported[b, a]:
                continue
            away = side * np.sqrt(float((b - j) ** 2 + (a - i) ** 2))
            below = plane[0] + plane[1] * (a - i) + plane[2] * (b - j) - base[b, a]
            most = z + min(least, rules.level_m + rules.max_rise * away)
            company += away <= rules.far_m and base[b, a] <= most and below >= least
    return company >= rules.min_company


@njit
def _limits(low, base, supported, side, depth, limit, rules):
    """Fill `limit`: below it low places are outliers; -inf where one may be ground."""
    for j in range(low.shape[0]):
        for i in range(low.shape[1]):
            if low[j, i] == np.inf:
                continue
            plane = _plane_under(base, j, i, rules)
            lowest = plane[0] - depth
            if low[j, i] < lowest and not _has_company(
                base, supported, side, j, i, low[j, i], plane, rules
            ):
                limit[j, i] = lowest


def limits_below_ground(
    low: NDArray, base: NDArray, side: float, depth: float = 1.0
) -> NDArray[np.float64]:
    """Return the heights (h, w) below which low places are outliers, in meters; -inf where none is.

    Parameters
    ----------
    low, base : (h, w)
        The lowest heights in meters of what may be an outlier, and of the rest; ``inf`` where there
        is none.
    side, depth : float
        Side of a column, and least depth of outliers below the ground, in meters.
    """
    limit = np.full(low.shape, -np.inf)
    # Where all around lies lower, no plane through it runs above.
    heights = np.where(np.isfinite(base), base, -HOLE).astype(np.float32)
    low = np.where(low < highest_around(heights, RULES.near, 0), low, np.inf)
    _limits(low, base, _supported(base, RULES), side, depth, limit, RULES)
    return limit


def find_low_outliers(raster: NDArray[np.float32], cell: float) -> NDArray[np.bool_]:
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
    return limits_below_ground(low, base, cell) > -np.inf


def outlier_reach(cell: float) -> int:
    """Return how far away cells of a minimum grid change what is a low outlier, in cells."""
    return reach(cell) + RULES.max_extent + RULES.link + 1
