"""Corridors of power lines with true classes: spans between towers or poles over land, trees and houses.

Points lie at random, as dense as asked for; wires catch what hits a footprint's width.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

GROUND, LEAF, BUILDING, WATER, WIRE, TOWER, OTHER = 2, 5, 6, 9, 14, 15, 1


@dataclass
class Line:
    """Supports along an axis `across` meters from the middle, and the wires they hold: (aside, height above their feet)."""

    across: float
    stations: tuple[float, ...]
    wires: tuple[tuple[float, float], ...]
    sag: float  # per squared meter of span: 8 sag / span^2 is the curvature
    kind: str  # lattice, wide, pole
    tall: float


HIGH = (
    (-7.0, 22.0),
    (7.0, 22.0),
    (-9.0, 28.0),
    (9.0, 28.0),
    (-6.0, 34.0),
    (6.0, 34.0),
    (0.0, 40.0),
)
MEDIUM = ((-1.2, 10.2), (0.0, 10.6), (1.2, 10.2))
HIGHEST = ((-15.0, 38.0), (0.0, 38.0), (15.0, 38.0))
DOUBLE = ((-4.0, 15.0), (4.0, 15.0), (-4.5, 18.5), (4.5, 18.5), (-3.5, 22.0), (3.5, 22.0))


def _lattice(rng, foot, turn, tall, wires, density):
    """Points of four leaning legs, their bracing, and arms to the wires."""
    base, waist = 0.10 * tall, 0.7

    def half(u):
        return np.where(u < 0.55, base + (waist - base) * u / 0.55, waist)

    n = int(tall * density * 2.2)
    u = rng.uniform(0.02, 1, n)
    side = rng.integers(0, 4, n)
    along = rng.choice([-1.0, 1.0], n) * np.where(rng.random(n) < 0.5, 1.0, rng.uniform(-1, 1, n))
    a, b = along * half(u), np.where(side % 2, 1.0, -1.0) * half(u)
    a, b = np.where(side < 2, a, b), np.where(side < 2, b, a)
    parts = [np.column_stack([a, b, u * tall])]
    for level in {round(z, 1) for _, z in wires}:
        reach = max(abs(t) for t, z in wires if round(z, 1) == level)
        if reach > 0.5:
            m = int(2 * reach * density * 0.9)
            t = rng.uniform(-reach, reach, m)
            parts.append(
                np.column_stack(
                    [rng.uniform(-0.5, 0.5, m), t, level + 1.5 + rng.uniform(-0.4, 0.6, m)]
                )
            )
    return _placed(np.vstack(parts), foot, turn)


def _wide(rng, foot, turn, tall, wires, density):
    """Points of legs that stand 0.36 of its height apart, a beam above the wires, and the insulators these hang from."""
    n = int(tall * density * 3.0)
    u = rng.uniform(0.02, 1, n)
    half = np.where(u < 0.7, 0.18 * tall + (2.5 - 0.18 * tall) * u / 0.7, 2.5)
    side = rng.integers(0, 4, n)
    along = rng.choice([-1.0, 1.0], n) * np.where(rng.random(n) < 0.7, 1.0, rng.uniform(-1, 1, n))
    a, b = along * half, np.where(side % 2, 1.0, -1.0) * half
    a, b = np.where(side < 2, a, b), np.where(side < 2, b, a)
    parts = [np.column_stack([a, b, u * tall])]
    reach, level = max(abs(t) for t, _ in wires), max(z for _, z in wires)
    m = int(2 * reach * density * 0.9)
    t = rng.uniform(-reach - 1, reach + 1, m)
    parts.append(
        np.column_stack([rng.uniform(-1, 1, m), t, level + 7.0 + rng.uniform(-0.5, 1.0, m)])
    )
    for aside, _ in wires:
        u = rng.uniform(0.1, 1, int(density))
        parts.append(
            np.column_stack(
                [np.zeros(len(u)), aside + rng.choice([-3, 3], len(u)) * u, level + 7 * u]
            )
        )
    return _placed(np.vstack(parts), foot, turn)


def _pole(rng, foot, turn, tall, wires, density):
    n = max(int(tall * density * 0.22), 2)
    stem = np.column_stack([rng.normal(0, 0.08, (2, n)).T, rng.uniform(0.3, tall, n)])
    reach = max(abs(t) for t, _ in wires)
    m = int(2 * reach * density * 0.25)
    arm = np.column_stack(
        [rng.normal(0, 0.08, m), rng.uniform(-reach, reach, m), np.full(m, tall - 0.4)]
    )
    return _placed(np.vstack([stem, arm]), foot, turn)


def _placed(q, foot, turn):
    c, s = np.cos(turn), np.sin(turn)
    return np.column_stack(
        [q[:, 0] * c - q[:, 1] * s, q[:, 0] * s + q[:, 1] * c, q[:, 2]]
    ) + np.asarray(foot)


_SUPPORTS = {"lattice": _lattice, "wide": _wide, "pole": _pole}


def _crown(rng, foot, radius, tall, density):
    n = int(np.pi * radius**2 * density * 1.3)
    p = rng.normal(0, 1, (n, 3))
    p *= (rng.random(n) ** 0.4 / np.linalg.norm(p, axis=1))[:, None]
    crown = p * (radius, radius, 0.36 * tall) + (0, 0, 0.64 * tall)
    stem = np.column_stack(
        [rng.normal(0, 0.15, (2, n // 20 + 1)).T, rng.uniform(0, 0.4 * tall, n // 20 + 1)]
    )
    return np.vstack([crown, stem]) + np.asarray(foot)


def corridor(
    lines,
    density=8.0,
    seed=0,
    length=500.0,
    width=160.0,
    slope=0.0,
    trees=60,
    tall=(5.0, 18.0),
    clear=6.0,
    houses=6,
    turn=0.3,
    offset=0.0,
):
    """Points (n, 3) and classes of lines along a strip; trees keep `clear` meters from the wires in plan."""
    rng = np.random.default_rng(seed)

    def land(s, t):
        return slope * s + 2.0 * np.sin(s / 60.0) * np.cos(t / 45.0) * (slope != 0)

    n = int(length * width * density)
    s, t = rng.uniform(-length / 2, length / 2, n), rng.uniform(-width / 2, width / 2, n)
    z, code = land(s, t), np.full(n, GROUND)
    for _ in range(houses):
        a, b = (
            rng.uniform(-length / 2, length / 2),
            rng.choice([-1, 1]) * rng.uniform(0.22, 0.42) * width,
        )
        half, deep, eave = rng.uniform(5, 16), rng.uniform(4, 7), rng.uniform(3, 8)
        inside = (np.abs(s - a) < half) & (np.abs(t - b) < deep)
        z = np.where(
            inside,
            land(a, b) + eave + (0.7 * (deep - np.abs(t - b)) if rng.random() < 0.7 else 0.0),
            z,
        )
        code[inside] = BUILDING
    parts, codes = [np.column_stack([s, t, z])], [code]

    def add(points, kind):
        parts.append(points)
        codes.append(np.full(len(points), kind))

    for line in lines:
        feet = [(a, line.across, float(land(a, line.across))) for a in line.stations]
        for (a, b, foot), (c, d, other) in itertools.pairwise(feet):
            span = c - a
            for aside, up in line.wires:
                m = int(span * density * rng.uniform(0.35, 0.6))
                u = np.sort(rng.uniform(0, 1, m))
                height = foot + (other - foot) * u + up - 4.0 * line.sag * span**2 * u * (1 - u)
                add(
                    np.column_stack(
                        [a + span * u, b + aside + (d - b) * u + rng.normal(0, 0.04, m), height]
                    ),
                    WIRE,
                )
        for foot in feet:
            if abs(foot[0]) <= length / 2:
                add(_SUPPORTS[line.kind](rng, foot, 0.0, line.tall, line.wires, density), TOWER)
    spans = [(line.across + t, z) for line in lines for t, z in line.wires]
    for _ in range(trees):
        a, b, high = (
            rng.uniform(-length / 2, length / 2),
            rng.uniform(-width / 2, width / 2),
            rng.uniform(*tall),
        )
        radius = rng.uniform(1.2, 4.0)
        away = min((abs(b - q) for q, _ in spans), default=99.0)
        if away < clear + radius:
            low = min((z for q, z in spans if abs(b - q) < clear + radius + 4), default=99.0)
            high = min(high, 0.45 * low)
        add(_crown(rng, (a, b, float(land(a, b))), radius, high, density), LEAF)
    for k in range(4):  # lamps and a mast without wires, beside the line
        a, b = rng.uniform(-length / 2, length / 2), 0.3 * width * (-1) ** k
        high = (8.0, 8.0, 30.0, 12.0)[k]
        add(_pole(rng, (a, b, float(land(a, b))), 0.0, high, ((0.0, 0.0),), density), OTHER)
    xyz, code = np.vstack(parts), np.concatenate(codes)
    keep = (np.abs(xyz[:, 0]) <= length / 2) & (np.abs(xyz[:, 1]) <= width / 2)
    xyz, code = xyz[keep], code[keep]
    xyz[:, 2] += rng.normal(0, 0.03, len(xyz))
    c, r = np.cos(turn), np.sin(turn)
    xyz = np.column_stack(
        [xyz[:, 0] * c - xyz[:, 1] * r, xyz[:, 0] * r + xyz[:, 1] * c, xyz[:, 2] + 100.0]
    )
    return np.round(xyz + np.array([85_000.0 + offset, 447_000.0, 0.0]), 3), code.astype(np.uint8)


def _every(step, length=700.0, start=0.0):
    return tuple(np.arange(-length / 2 + start, length / 2 + step, step))


CORRIDORS = {
    "highest voltage": lambda d=8.0, seed=6: corridor(
        [Line(0.0, _every(300.0, 900.0), HIGHEST, 1.0e-4, "wide", 48.0)],
        d,
        seed,
        clear=10.0,
        turn=0.5,
    ),
    "high voltage, uphill": lambda d=8.0, seed=1: corridor(
        [Line(5.0, _every(240.0, 720.0, 30.0), DOUBLE, 1.2e-4, "lattice", 25.0)],
        d,
        seed,
        slope=0.2,
        turn=1.1,
    ),
    "medium voltage in woods": lambda d=8.0, seed=2: corridor(
        [Line(0.0, _every(80.0), MEDIUM, 2.0e-4, "pole", 10.8)],
        d,
        seed,
        trees=400,
        tall=(8, 22),
        clear=4.0,
        turn=0.8,
    ),
    "two lines beside each other": lambda d=8.0, seed=5: corridor(
        [
            Line(-25.0, _every(260.0, 780.0, 60.0), HIGH, 1.1e-4, "lattice", 42.0),
            Line(25.0, _every(200.0, 800.0, 20.0), DOUBLE, 1.2e-4, "lattice", 25.0),
        ],
        d,
        seed,
        turn=1.6,
    ),
}
