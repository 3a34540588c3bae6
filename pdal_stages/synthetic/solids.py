"""The things a pulse can hit: convex solids and ellipsoids, solid or leafy, and the grid that finds them.

A leafy thing has an extinction in 1/m: the beam passes a random way into it, or through it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from .townplan import BANK, CANAL, FIRST_U, FIRST_V, MATERIAL, PITCH_U, PITCH_V, Plan, ground

UNCLASSIFIED, BUILDING, WIRE, POLE, BRIDGE = 1, 6, 14, 15, 17
VEGETATION = 255  # its class follows from the height above ground: 3, 4 or 5

# Columns of a thing after its bounding box (lowest u, v, z, highest u, v, z).
FIRST, COUNT, CLASS, TOP, SIDE, LEAFY = range(6, 12)
CELL = 3.0  # meters
STEP = 1.5  # between two looks along a beam; a thing is listed half of it around its box
MARGIN = 6.2  # meters from a street's axis to the land that may be built on
MARGINS = {BANK: 14.0, CANAL: 15.5}  # from the other lines


class Scene(NamedTuple):
    """Things of one part of the town, with the grid cells that list them."""

    things: np.ndarray  # (n, 12): box, first plane, planes (0: ellipsoid), class, materials, extinction
    planes: np.ndarray  # (m, 4): outward normal and offset; inside is n.p <= offset
    start: np.ndarray  # (nu * nv + 1,): first entry of each cell in ``member``
    member: np.ndarray
    top: np.ndarray  # (nu, nv): highest z in each cell
    corner: np.ndarray  # u, v of the grid's low corner; highest z of all


class Site:
    """The things of one block and of the streets on its low sides.

    Places are (a, b) in meters along u and v from the low corner of the land that may be built on; that land is
    `w` by `d` meters, and the line below it lies at b = `axis`. Heights are absolute.
    """

    def __init__(self, plan: Plan, i: int, j: int) -> None:
        self.plan, self.i, self.j = plan, i, j
        self.rng = np.random.default_rng([plan.seed, i + 2**20, j + 2**20])
        self.draw, self.chance = self.rng.uniform, self.rng.random
        low, self.high = MARGINS.get(j % 4, MARGIN), MARGINS.get((j + 1) % 4, MARGIN)
        self.u0, self.v0 = FIRST_U + PITCH_U * i + MARGIN, FIRST_V + PITCH_V * j + low
        self.w, self.d, self.axis = PITCH_U - 2 * MARGIN, PITCH_V - low - self.high, -low
        self.things: list[tuple] = []  # rows of Scene's arrays
        self.planes: list[tuple] = []
        self.built: list[tuple] = []  # what it was, for :mod:`.truth`: its kind, then its measures

    def z(self, a: float, b: float) -> float:
        """Ground height."""
        return float(ground(self.u0 + a, self.v0 + b, self.plan)[0])

    def _add(self, middle, axes, cuts, code, top, side=None, leafy=0.0) -> None:
        """A block of unit vectors and half sizes, less what is beyond its cuts; without cuts (None) its ellipsoid."""
        u, v, w = middle[0] + self.u0, middle[1] + self.v0, middle[2]
        reach = [sum(abs(normal[k]) * half for normal, half in axes) for k in range(3)]
        planes = [((s * x, s * y, s * z), half) for (x, y, z), half in axes for s in (-1, 1)]
        planes = [] if cuts is None else planes + cuts
        label = len(self.planes), len(planes), code, MATERIAL[top], MATERIAL[side or top], leafy
        box = [p + s * r for s in (-1, 1) for p, r in zip((u, v, w), reach, strict=True)]
        self.things.append((*box, *label))
        self.planes += [(x, y, z, off + x * u + y * v + z * w) for (x, y, z), off in planes]

    def box(self, a, b, turn, half_l, half_w, z0, z1, code, top, side=None, *, cuts=(), leafy=0.0) -> None:
        """An upright box round (a, b), its length in direction `turn`.

        Each cut (p, q, height) leaves of it what lies at ``z <= height - p * x - q * y``, where x and y run along its
        length and width from its middle.
        """
        c, s, middle, planes = math.cos(turn), math.sin(turn), (a, b, 0.5 * (z0 + z1)), []
        for p, q, height in cuts:
            n = math.sqrt(p * p + q * q + 1.0)
            planes.append((((p * c - q * s) / n, (p * s + q * c) / n, 1.0 / n), (height - middle[2]) / n))
        axes = (((c, s, 0.0), half_l), ((-s, c, 0.0), half_w), ((0.0, 0.0, 1.0), 0.5 * (z1 - z0)))
        self._add(middle, axes, planes, code, top, side, leafy)

    def ball(self, a, b, z, ra, rb, rz, leafy) -> None:
        """An upright ellipsoid of leaves."""
        axes = (((1.0, 0.0, 0.0), ra), ((0.0, 1.0, 0.0), rb), ((0.0, 0.0, 1.0), rz))
        self._add((a, b, z), axes, None, VEGETATION, "leaf", None, leafy)

    def bar(self, start, end, radius, code, material) -> None:
        """A thin square bar between two places (a, b, z)."""
        length = math.dist(start, end)
        x, y, z = ((q - p) / length for p, q in zip(start, end, strict=True))
        flat = math.hypot(x, y)
        c, s = (x / flat, y / flat) if flat > 1e-6 else (1.0, 0.0)
        axes = (((x, y, z), length / 2), ((-s, c, 0.0), radius), ((-z * c, -z * s, flat), radius))
        self._add([(p + q) / 2 for p, q in zip(start, end, strict=True)], axes, [], code, material)


def build_scene(sites: list[tuple[np.ndarray, np.ndarray]], low: np.ndarray, high: np.ndarray) -> Scene:
    """Join the arrays of sites where they touch a rectangle of town coordinates, and list them by grid cell."""
    things, planes = (np.concatenate(arrays) for arrays in zip(*sites, strict=True))
    counts = [len(planes) for _, planes in sites]
    things[:, FIRST] += np.repeat(np.cumsum(counts) - counts, [len(things) for things, _ in sites])
    things = things[((things[:, :2] < high) & (things[:, 3:5] > low)).all(axis=1)]
    shape = np.ceil((high - low) / CELL).astype(np.int64)
    first = np.floor((things[:, :2] - STEP / 2 - low) / CELL).astype(np.int64).clip(0)
    last = np.minimum(np.floor((things[:, 3:5] + STEP / 2 - low) / CELL).astype(np.int64), shape - 1)
    wide = (last - first + 1).clip(0)
    count = wide.prod(axis=1)
    thing = np.repeat(np.arange(len(things)), count)
    nth = np.arange(len(thing)) - np.repeat(np.cumsum(count) - count, count)
    cell = (first[thing, 0] + nth // wide[thing, 1]) * shape[1] + first[thing, 1] + nth % wide[thing, 1]
    top, order = np.full(shape.prod(), -1e30), np.argsort(cell, kind="stable")
    np.maximum.at(top, cell, things[thing, 5])
    start = np.searchsorted(cell[order], np.arange(len(top) + 1))
    return Scene(things, planes, start, thing[order], top.reshape(shape), np.array([*low, top.max()]))
