"""Planes under what is round a column: the level below which nothing should lie, and whether other ground lies as deep."""

from __future__ import annotations

import math

import numpy as np

from ..base.jit import device, njit

#: Columns within which a plane is fitted through the ground, and if there are too few, within which then.
NEAR, WIDER = 6, 13
#: Columns a plane needs.
ENOUGH = 12
#: How far away other ground is looked for, in meters; so many columns of it show that a deep place is ground.
FAR, COMPANY = 30.0, 4
#: A column of ground has so many others of its level, in meters, in the 5 x 5 round it, and such a share of those.
SUPPORT, SUPPORT_SHARE, LEVEL = 2, 0.2, 1.0


@device
def envelope(base, j, i, radius, u, v, zs, weight):
    """Plane (height at the column, per column across, along; scatter below it) under what is round a column."""
    h, w = base.shape
    n = 0
    for b in range(max(j - radius, 0), min(j + radius + 1, h)):
        for a in range(max(i - radius, 0), min(i + radius + 1, w)):
            if (b - j) ** 2 + (a - i) ** 2 <= radius * radius and (b != j or a != i) and base[b, a] < np.inf:
                u[n], v[n], zs[n] = a - i, b - j, base[b, a]
                n += 1
    if n < ENOUGH:
        return n, 0.0, 0.0, 0.0, 0.0
    for k in range(n):  # in `weight` for now: an insertion sort
        q = k
        while q > 0 and weight[q - 1] > zs[k]:
            weight[q] = weight[q - 1]
            q -= 1
        weight[q] = zs[k]
    lowest, least, most = weight[0], weight[n // 10], weight[n // 2]
    for k in range(n):
        weight[k] = 1.0 if least <= zs[k] <= most else 0.01
    p0, p1, p2, scatter = 0.0, 0.0, 0.0, 0.0
    for _turn in range(8):
        s0 = s1 = s2 = s11 = s12 = s22 = t0 = t1 = t2 = 0.0
        for k in range(n):
            g = weight[k]
            z = zs[k] - lowest
            s0 += g
            s1 += g * u[k]
            s2 += g * v[k]
            s11 += g * u[k] * u[k]
            s12 += g * u[k] * v[k]
            s22 += g * v[k] * v[k]
            t0 += g * z
            t1 += g * u[k] * z
            t2 += g * v[k] * z
        ridge = 1e-3 * s0
        s11 += ridge
        s22 += ridge
        # Cramer's rule.
        c0 = s11 * s22 - s12 * s12
        c1 = s12 * s2 - s1 * s22
        c2 = s1 * s12 - s11 * s2
        det = s0 * c0 + s1 * c1 + s2 * c2
        p0 = (t0 * c0 + t1 * c1 + t2 * c2) / det
        p1 = (t0 * c1 + t1 * (s0 * s22 - s2 * s2) + t2 * (s1 * s2 - s0 * s12)) / det
        p2 = (t0 * c2 + t1 * (s1 * s2 - s0 * s12) + t2 * (s0 * s11 - s1 * s1)) / det
        below, number = 0.0, 0.0
        for k in range(n):
            off = zs[k] - lowest - p0 - p1 * u[k] - p2 * v[k]
            weight[k] = 1.0 / (1.0 + off * off)
            if off < 0.0:
                weight[k] *= weight[k]
                below += weight[k] * off * off
                number += weight[k]
            else:
                weight[k] *= 0.1
        scatter = np.sqrt(below / number) if number > 0.0 else 0.0
    return n, p0 + lowest, p1, p2, scatter


@njit
def supported_columns(base, out):
    """Columns with enough others of their level around."""
    h, w = base.shape
    for j in range(h):
        for i in range(w):
            if base[j, i] == np.inf:
                continue
            level, seen = 0, 0
            for b in range(max(j - 2, 0), min(j + 3, h)):
                for a in range(max(i - 2, 0), min(i + 3, w)):
                    seen += base[b, a] < np.inf
                    level += abs(base[b, a] - base[j, i]) <= LEVEL
            out[j, i] = level > SUPPORT + SUPPORT_SHARE * seen


def reach_of_company(side: float) -> int:
    """How far away other ground is looked for, in columns."""
    return math.ceil(FAR / side)


@device
def has_company(base, supported, side, far, room, curve, j, i, z, height, across, along):
    """Whether other columns within `far` are as deep as z, or by `room` a meter higher, and far enough below the plane.

    That is half as far, and `curve` per meter of distance.
    """
    h, w = base.shape
    company = 0
    half = 0.5 * (height - z)
    for b in range(max(j - far, 0), min(j + far + 1, h)):
        for a in range(max(i - far, 0), min(i + far + 1, w)):
            if supported[b, a]:
                away = side * np.sqrt(float((b - j) ** 2 + (a - i) ** 2))
                below = height + across * (a - i) + along * (b - j) - base[b, a]
                if (
                    away <= FAR
                    and base[b, a] <= z + min(half, LEVEL + room * away)
                    and below >= max(half, curve * away)
                ):
                    company += 1
                    if company == COMPANY:
                        return True
    return False


@device
def plane_under(base, j, i, u, v, zs, weight):
    """:func:`envelope` of what is near, or where that is too little, of what is around."""
    found = envelope(base, j, i, NEAR, u, v, zs, weight)
    return found if found[0] >= ENOUGH else envelope(base, j, i, WIDER, u, v, zs, weight)
