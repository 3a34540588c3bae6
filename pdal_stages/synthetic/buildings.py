"""Houses, halls, churches, cars and street furniture, made of cut boxes."""

from __future__ import annotations

import math

import numpy as np

from .plan import Plan
from .scene import Parts

BUILDING, UNCLASSIFIED, POLE = 6, 1, 15


def beside(x: float, y: float, angle: float, a: float, b: float) -> tuple[float, float]:
    """The place `a` along and `b` to the left of (x, y), looking in direction `angle`."""
    c, s = math.cos(angle), math.sin(angle)
    return x + a * c - b * s, y + a * s + b * c


def _footing(plan: Plan, x, y, angle, half_l, half_w) -> tuple[float, float]:
    """Lowest and mean ground height of a footprint."""
    places = [(0, 0)] + [(p * half_l, q * half_w) for p in (-1, 0, 1) for q in (-1, 1)]
    z = [plan.height(*beside(x, y, angle, a, b)) for a, b in places]
    return min(z), sum(z) / len(z)


def house(
    parts: Parts,
    plan: Plan,
    rng: np.random.Generator,
    x,
    y,
    angle,
    half_l,
    half_w,
    eave,
    roof,
    pitch=0.8,
    *,
    wall="plaster",
    cover="tile",
    overhang=0.4,
    dormers=0,
    chimneys=1,
    clutter=0,
) -> float:
    """One building; returns its highest z.

    Parameters
    ----------
    half_l, half_w : float
        Half length (the ridge runs along it) and half width.
    eave : float
        Height of the eaves above the mean ground of the footprint.
    roof : str
        'flat', 'gable', 'hip', 'halfhip', 'mansard', 'shed' or 'pyramid'.
    pitch : float
        Rise over run of the roof.
    """
    low, mean = _footing(plan, x, y, angle, half_l, half_w)
    z0, ze = low - 0.8, mean + eave
    if roof == "flat":
        parts.prism(x, y, angle, half_l, half_w, z0, ze, BUILDING, cover, wall)
        rim = rng.uniform(0.25, 0.8)
        if rng.random() < 0.7:
            for side in (-1, 1):
                at = beside(x, y, angle, 0, side * (half_w - 0.15))
                parts.prism(*at, angle, half_l, 0.15, ze, ze + rim, BUILDING, cover, wall)
                at = beside(x, y, angle, side * (half_l - 0.15), 0)
                parts.prism(*at, angle, 0.15, half_w, ze, ze + rim, BUILDING, cover, wall)
        for _ in range(clutter):
            a, b = rng.uniform(-0.75, 0.75) * half_l, rng.uniform(-0.65, 0.65) * half_w
            la, lb, up = rng.uniform(0.5, 2.2), rng.uniform(0.5, 1.4), rng.uniform(0.7, 2.6)
            at = beside(x, y, angle, a, b)
            parts.prism(*at, angle, la, lb, ze, ze + up, BUILDING, "metal", "metal")
        return ze + rim
    if roof == "shed":
        cuts = [(0.0, pitch, 1.0, ze + pitch * half_w)]
        top = ze + 2 * pitch * half_w
    elif roof == "mansard":
        steep, knee = 2.2, 0.25 * half_w
        zk = ze + steep * knee
        cuts = [(0.0, s * steep, 1.0, ze + steep * half_w) for s in (-1, 1)]
        cuts += [(0.0, s * 0.3, 1.0, zk + 0.3 * (half_w - knee)) for s in (-1, 1)]
        top = zk + 0.3 * (half_w - knee)
        pitch = steep
        overhang = min(overhang, 0.2)
    else:
        cuts = [(0.0, s * pitch, 1.0, ze + pitch * half_w) for s in (-1, 1)]
        top = ze + pitch * half_w
        if roof in ("hip", "pyramid"):
            steep = pitch if roof == "hip" else pitch * half_w / half_l
            cuts += [(s * steep, 0.0, 1.0, ze + steep * half_l) for s in (-1, 1)]
        elif roof == "halfhip":
            start = ze + 0.55 * pitch * half_w
            cuts += [(s * 1.3 * pitch, 0.0, 1.0, start + 1.3 * pitch * half_l) for s in (-1, 1)]
    hip = roof in ("hip", "pyramid")
    gable_out = overhang if hip else min(overhang, 0.25)
    parts.prism(x, y, angle, half_l, half_w, z0, top, BUILDING, cover, wall, cuts=cuts)
    under = ze - overhang * pitch - 0.18
    parts.prism(
        x,
        y,
        angle,
        half_l + gable_out,
        half_w + overhang,
        under,
        top,
        BUILDING,
        cover,
        wall,
        cuts=cuts,
    )
    for n in range(dormers if not hip and roof != "shed" else 0):
        a = half_l * ((n + 0.5) / dormers * 1.7 - 0.85) + rng.uniform(-0.3, 0.3)
        for side in (-1, 1):
            inner, outer = 0.3 * half_w, rng.uniform(0.7, 0.85) * half_w
            zt = top - pitch * inner + 0.1
            at = beside(x, y, angle, a, side * 0.5 * (inner + outer))
            parts.prism(*at, angle, 0.8, 0.5 * (outer - inner), ze, zt, BUILDING, cover, wall)
    for _ in range(chimneys):
        a, b = rng.uniform(-0.7, 0.7) * half_l * (0.3 if hip else 1.0), rng.uniform(-0.35, 0.35) * half_w
        at = beside(x, y, angle, a, b)
        parts.prism(*at, angle, 0.35, 0.3, ze, top + rng.uniform(0.3, 0.9), BUILDING, "brick", "brick")
    return top


def church(parts: Parts, plan: Plan, rng: np.random.Generator, x, y, angle) -> None:
    """Nave, choir and a tower with a spire."""
    house(parts, plan, rng, x, y, angle, 12, 5.5, 10, "gable", 1.1, wall="stone", cover="slate", chimneys=0)
    at = beside(x, y, angle, 14.5, 0)
    house(parts, plan, rng, *at, angle, 3.5, 3.5, 8, "pyramid", 1.0, wall="stone", cover="slate", chimneys=0)
    at = beside(x, y, angle, -14.5, 0)
    house(
        parts,
        plan,
        rng,
        *at,
        angle,
        3,
        3,
        rng.uniform(19, 24),
        "pyramid",
        rng.uniform(2.2, 3.4),
        wall="stone",
        cover="slate",
        chimneys=0,
        overhang=0.2,
    )
    for side in (-1, 1):
        at = beside(x, y, angle, 1.0, side * 7.0)
        house(parts, plan, rng, *at, angle, 9, 1.6, 5, "flat", wall="stone", cover="slate")


def car(parts: Parts, plan: Plan, rng: np.random.Generator, x, y, angle) -> None:
    """A parked car or van."""
    z = plan.height(x, y)
    if rng.random() < 0.12:
        parts.prism(x, y, angle, 2.7, 1.0, z + 0.2, z + rng.uniform(1.9, 2.6), UNCLASSIFIED, "paint", "paint")
        return
    half_l = rng.uniform(1.85, 2.35)
    belt = z + rng.uniform(0.85, 1.0)
    parts.prism(x, y, angle, half_l, 0.88, z + 0.18, belt, UNCLASSIFIED, "paint", "paint")
    top = z + rng.uniform(1.4, 1.7)
    cuts = [(1.0, 0, 0.9, 0.62 * half_l + 0.9 * belt), (-1.0, 0, 0.6, 0.8 * half_l + 0.6 * belt)]
    parts.prism(x, y, angle, half_l, 0.78, belt, top, UNCLASSIFIED, "paint", "glass", cuts=cuts)


def box(parts: Parts, plan: Plan, x, y, angle, half_l, half_w, height, material="metal") -> None:
    """Street furniture: a kiosk, a container, a bin, a bench."""
    low, mean = _footing(plan, x, y, angle, half_l, half_w)
    parts.prism(x, y, angle, half_l, half_w, low - 0.3, mean + height, UNCLASSIFIED, material, material)


def fence(parts: Parts, plan: Plan, x, y, angle, length, height, *, material="brick", half=0.1) -> None:
    """A garden wall or close fence, stepping with the ground."""
    count = max(1, math.ceil(length / 4.0))
    step = length / count
    for n in range(count):
        at = beside(x, y, angle, (n + 0.5) * step, 0)
        z = plan.height(*at)
        parts.prism(*at, angle, step / 2, half, z - 0.4, z + height, UNCLASSIFIED, material, material)


def lamp(parts: Parts, plan: Plan, x, y, angle, height=7.5) -> None:
    """A lamp post with an arm."""
    z = plan.height(x, y)
    parts.rod((x, y, z), (x, y, z + height), 0.09, POLE, "steel")
    ax, ay = beside(x, y, angle, 1.4, 0)
    parts.rod((x, y, z + height), (ax, ay, z + height + 0.2), 0.1, POLE, "steel")


def pylon(parts: Parts, x, y, z, angle, arms, height) -> None:
    """A lattice tower: four legs, rings and cross-arms (``arms``: height, half length)."""
    foot, head = 1.7, 0.35

    def corner(p, q, share):
        half = foot + (head - foot) * share
        return (*beside(x, y, angle, p * half, q * half), z + share * height)

    ring = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    for n in range(4):
        p, q = ring[n], ring[(n + 1) % 4]
        parts.rod(corner(*p, 0.0), corner(*p, 1.0), 0.11, POLE, "steel")
        for level in range(6):
            a, b = level / 6, (level + 1) / 6
            parts.rod(corner(*p, a), corner(*q, b), 0.06, POLE, "steel")
            parts.rod(corner(*p, b), corner(*q, b), 0.06, POLE, "steel")
    for up, half in arms:
        for lift in (0.0, 0.7):
            left = (*beside(x, y, angle, 0, half), z + up)
            right = (*beside(x, y, angle, 0, -half), z + up)
            middle = (x, y, z + up + lift)
            parts.rod(left, middle, 0.1, POLE, "steel")
            parts.rod(middle, right, 0.1, POLE, "steel")
