"""Solids that stand on a block of the town: boxes, bars and ellipsoids as rows of arrays."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .townplan import BANK, CANAL, FIRST_U, FIRST_V, MATERIAL, PITCH_U, PITCH_V, Plan, ground

UNCLASSIFIED = 1
BUILDING = 6
WIRE = 14
POLE = 15
BRIDGE = 17
VEGETATION = 255  #: stands for 3, 4 or 5, which follows from the height above ground

#: From the axis of a street to the land that may be built on, meters.
MARGIN = 6.2
#: The same from other lines.
MARGINS = {BANK: 14.0, CANAL: 15.5}


class Footprint(NamedTuple):
    """A rectangle seen from above: its middle, the direction of its length, half its sides."""

    a: float
    b: float
    turn: float  #: radians
    half_l: float
    half_w: float

    def place(self, along: float, left: float) -> tuple[float, float]:
        """Return the place `along` and `left` of the middle, looking in direction `turn`."""
        return beside(self.a, self.b, self.turn, along, left)


class Finish(NamedTuple):
    """Class and materials of a solid; a leafy one has an extinction in 1/m."""

    code: int
    top: str
    side: str
    extinction: float = 0.0


def beside(a: float, b: float, turn: float, along: float, left: float) -> tuple[float, float]:
    """Return the place `along` and `left` of (a, b), looking in direction `turn`."""
    c, s = math.cos(turn), math.sin(turn)
    return a + along * c - left * s, b + along * s + left * c


def leaves(extinction: float) -> Finish:
    """Return the finish of foliage."""
    return Finish(VEGETATION, "leaf", "leaf", extinction)


class Site:
    """The solids of one block and of the streets on its low sides.

    Places are (a, b) in meters along u and v from the low corner of the land that may be built on;
    that land is `w` by `d` meters, and the line below it lies at b = `axis`. Heights are absolute.
    """

    def __init__(self, plan: Plan, i: int, j: int) -> None:
        self.plan, self.i, self.j = plan, i, j
        self.rng = np.random.default_rng([plan.seed, i + 2**20, j + 2**20])
        self.draw, self.chance = self.rng.uniform, self.rng.random
        low, self.high = MARGINS.get(j % 4, MARGIN), MARGINS.get((j + 1) % 4, MARGIN)
        self.u0, self.v0 = FIRST_U + PITCH_U * i + MARGIN, FIRST_V + PITCH_V * j + low
        self.w, self.d, self.axis = PITCH_U - 2 * MARGIN, PITCH_V - low - self.high, -low
        self.solids: list[tuple] = []  # rows of ray_casting.Scene
        self.planes: list[tuple] = []
        self.built: list[tuple] = []  # kind and measures of each object, for true objects

    def z(self, a: float, b: float) -> float:
        """Return the height of the ground."""
        return float(ground(self.u0 + a, self.v0 + b, self.plan)[0])

    def _add(self, middle: Sequence[float], axes, cuts, finish: Finish) -> None:
        """Add a block of unit vectors and half sizes, without what lies beyond its cuts.

        Without cuts (None) its ellipsoid is added.
        """
        u, v, w = middle[0] + self.u0, middle[1] + self.v0, middle[2]
        reach = [sum(abs(normal[k]) * half for normal, half in axes) for k in range(3)]
        planes = [((s * x, s * y, s * z), half) for (x, y, z), half in axes for s in (-1, 1)]
        planes = [] if cuts is None else planes + cuts
        materials = MATERIAL[finish.top], MATERIAL[finish.side]
        box = [p + s * r for s in (-1, 1) for p, r in zip((u, v, w), reach, strict=True)]
        row = len(self.planes), len(planes), finish.code, *materials, finish.extinction
        self.solids.append((*box, *row))
        self.planes += [(x, y, z, off + x * u + y * v + z * w) for (x, y, z), off in planes]

    def box(self, base: Footprint, z0: float, z1: float, finish: Finish, cuts=()) -> None:
        """Add an upright box.

        Each cut (p, q, height) leaves of it what lies at ``z <= height - p * x - q * y``, where x
        and y run along its length and width from its middle.
        """
        c, s, middle = math.cos(base.turn), math.sin(base.turn), (base.a, base.b, 0.5 * (z0 + z1))
        planes = []
        for p, q, height in cuts:
            n = math.sqrt(p * p + q * q + 1.0)
            normal = (p * c - q * s) / n, (p * s + q * c) / n, 1.0 / n
            planes.append((normal, (height - middle[2]) / n))
        sides = ((c, s, 0.0), base.half_l), ((-s, c, 0.0), base.half_w)
        self._add(middle, (*sides, ((0.0, 0.0, 1.0), 0.5 * (z1 - z0))), planes, finish)

    def ball(self, middle: Sequence[float], radii: Sequence[float], extinction: float) -> None:
        """Add an upright ellipsoid of leaves."""
        axes = tuple(zip(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), radii, strict=True))
        self._add(middle, axes, None, leaves(extinction))

    def bar(self, start, end, radius: float, code: int, material: str) -> None:
        """Add a thin square bar between two places (a, b, z)."""
        length = math.dist(start, end)
        x, y, z = ((q - p) / length for p, q in zip(start, end, strict=True))
        flat = math.hypot(x, y)
        c, s = (x / flat, y / flat) if flat > 1e-6 else (1.0, 0.0)
        axes = (((x, y, z), length / 2), ((-s, c, 0.0), radius), ((-z * c, -z * s, flat), radius))
        middle = [(p + q) / 2 for p, q in zip(start, end, strict=True)]
        self._add(middle, axes, [], Finish(code, material, material))
