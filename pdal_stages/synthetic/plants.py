"""Trees, shrubs and hedges: porous bodies that let part of the beam through."""

from __future__ import annotations

import math

import numpy as np

from .buildings import beside
from .plan import Plan
from .scene import VEGETATION, Parts


def _trunk(parts: Parts, x, y, z, top, radius) -> None:
    parts.rod((x, y, z - 0.1), (x, y, top), radius, VEGETATION, "bark")


def broadleaf(parts: Parts, plan: Plan, rng: np.random.Generator, x, y, height, extinction=None) -> None:
    """A broad crown of several overlapping boughs."""
    z = plan.height(x, y)
    radius = height * rng.uniform(0.28, 0.4)
    bole = height * rng.uniform(0.18, 0.3)
    k = rng.uniform(0.5, 0.9) if extinction is None else extinction
    _trunk(parts, x, y, z, z + 0.6 * height, 0.08 + 0.012 * height)
    middle, half = 0.5 * (bole + height), 0.5 * (height - bole)
    parts.ellipsoid(x, y, z + middle, 0.7 * radius, 0.7 * radius, half, VEGETATION, "leaf", k)
    for n in range(int(rng.integers(4, 7))):
        a = 2 * math.pi * (n + rng.uniform(-0.3, 0.3)) / 5
        out = radius * rng.uniform(0.4, 0.6)
        r, rz = radius * rng.uniform(0.42, 0.62), half * rng.uniform(0.4, 0.6)
        up = z + bole + rz + (height - bole - 2 * rz) * rng.uniform(0.15, 0.85)
        parts.ellipsoid(
            x + out * math.cos(a),
            y + out * math.sin(a),
            up,
            r,
            r * rng.uniform(0.8, 1.2),
            rz,
            VEGETATION,
            "leaf",
            k,
        )


def conifer(parts: Parts, plan: Plan, rng: np.random.Generator, x, y, height) -> None:
    """A cone of needles."""
    z = plan.height(x, y)
    radius = height * rng.uniform(0.14, 0.22)
    _trunk(parts, x, y, z, z + 0.5 * height, 0.06 + 0.01 * height)
    parts.cone(
        x,
        y,
        z + height * rng.uniform(0.04, 0.14),
        z + height,
        radius,
        VEGETATION,
        "needle",
        rng.uniform(0.6, 1.0),
    )


def column(parts: Parts, plan: Plan, rng: np.random.Generator, x, y, height) -> None:
    """A poplar: narrow and tall."""
    z = plan.height(x, y)
    r = height * rng.uniform(0.09, 0.13)
    _trunk(parts, x, y, z, z + 0.7 * height, 0.15)
    parts.ellipsoid(x, y, z + 0.55 * height, r, r, 0.45 * height, VEGETATION, "leaf", rng.uniform(0.6, 0.9))


def sparse(parts: Parts, plan: Plan, rng: np.random.Generator, x, y, height) -> None:
    """A birch or a tree in poor leaf: most of the beam passes."""
    broadleaf(parts, plan, rng, x, y, height, extinction=rng.uniform(0.15, 0.3))


def shrub(parts: Parts, plan: Plan, rng: np.random.Generator, x, y, height) -> None:
    """A bush that touches the ground."""
    z = plan.height(x, y)
    r = height * rng.uniform(0.45, 0.85)
    parts.ellipsoid(
        x,
        y,
        z + 0.4 * height,
        r,
        r * rng.uniform(0.8, 1.25),
        0.6 * height,
        VEGETATION,
        "leaf",
        rng.uniform(1.2, 2.2),
    )


def tree(parts: Parts, plan: Plan, rng: np.random.Generator, x, y, low=6.0, high=16.0) -> None:
    """A tree of a kind drawn at random."""
    height, kind = rng.uniform(low, high), rng.random()
    if kind < 0.5:
        broadleaf(parts, plan, rng, x, y, height)
    elif kind < 0.75:
        conifer(parts, plan, rng, x, y, height * 1.1)
    elif kind < 0.9:
        sparse(parts, plan, rng, x, y, height)
    else:
        column(parts, plan, rng, x, y, height * 1.3)


def hedge(parts: Parts, plan: Plan, rng: np.random.Generator, x, y, angle, length, height, half=0.4) -> None:
    """A clipped hedge from (x, y) in direction `angle`, stepping with the ground."""
    count = max(1, math.ceil(length / 2.5))
    step = length / count
    k = rng.uniform(1.8, 3.0)
    for n in range(count):
        at = beside(x, y, angle, (n + 0.5) * step, 0)
        z = plan.height(*at)
        top = z + height * rng.uniform(0.92, 1.08)
        parts.prism(*at, angle, step / 2, half, z - 0.3, top, VEGETATION, "leaf", "leaf", extinction=k)
