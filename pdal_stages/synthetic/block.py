"""One block of the town while it is being filled: its extent, its own chance, short forms to place things."""

from __future__ import annotations

import math

import numpy as np

from . import plants
from .buildings import box, car, house
from .plan import BANK, CANAL, STREET, Plan
from .scene import Parts


class Block:
    """One block: places inside it are given in metres from its inner low corner, along u and v."""

    def __init__(self, plan: Plan, i: int, j: int) -> None:
        self.plan, self.i, self.j = plan, i, j
        g = plan.ground
        self.rng = np.random.default_rng([plan.seed, 0xB10C, i - 2 * plan.first_u, j - 2 * plan.first_v])
        self.parts = Parts()
        low = {STREET: 6.2, CANAL: 15.0, BANK: 14.0}
        high = {STREET: 6.2, CANAL: 15.0, BANK: 25.0}
        self.u0, self.v0 = g.u_lines[i] + 6.2, g.v_lines[j] + low[int(g.v_kind[j])]
        self.width = g.u_lines[i + 1] - 6.2 - self.u0
        self.depth = g.v_lines[j + 1] - high[int(g.v_kind[j + 1])] - self.v0

    def at(self, a: float, b: float) -> tuple[float, float, float]:
        """Local x, y and direction of u, of a place in the block."""
        return self.plan.place(self.u0 + a, self.v0 + b)

    # Short forms: things at (a, b), turned by `turn` against the block.
    def house(self, a, b, turn, *args, **options):
        x, y, angle = self.at(a, b)
        return house(self.parts, self.plan, self.rng, x, y, angle + turn, *args, **options)

    def plant(self, what, a, b, *args):
        x, y, _ = self.at(a, b)
        what(self.parts, self.plan, self.rng, x, y, *args)

    def line(self, what, a0, b0, a1, b1, *args, **options):
        x0, y0, _ = self.at(a0, b0)
        x1, y1, _ = self.at(a1, b1)
        angle, length = math.atan2(y1 - y0, x1 - x0), math.hypot(x1 - x0, y1 - y0)
        if what is plants.hedge:
            what(self.parts, self.plan, self.rng, x0, y0, angle, length, *args, **options)
        else:
            what(self.parts, self.plan, x0, y0, angle, length, *args, **options)

    def car(self, a, b, turn=0.0):
        x, y, angle = self.at(a, b)
        car(self.parts, self.plan, self.rng, x, y, angle + turn)

    def box(self, a, b, turn, *args, **options):
        x, y, angle = self.at(a, b)
        box(self.parts, self.plan, x, y, angle + turn, *args, **options)
