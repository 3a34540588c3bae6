"""The things a pulse can hit, the grid that finds them, and what a pulse's sub-beams meet first.

Things are convex solids and ellipsoids. A leafy one has an extinction in 1/m: the beam passes a random way into it, or
through it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..base.jit import device, njit
from .townplan import (
    BANK,
    CANAL,
    FIRST_U,
    FIRST_V,
    GRASS,
    LAWN,
    MATERIAL,
    PITCH_U,
    PITCH_V,
    REFLECTANCE,
    SOIL,
    WATER,
    Plan,
    ground,
    patches,
)  # fmt: skip

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

    things: (
        np.ndarray
    )  # (n, 12): box, first plane, planes (0: ellipsoid), class, materials, extinction
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
        self.built: list[
            tuple
        ] = []  # what it was, for who asks what is true: its kind, then its measures

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

    def box(
        self, a, b, turn, half_l, half_w, z0, z1, code, top, side=None, *, cuts=(), leafy=0.0
    ) -> None:
        """An upright box round (a, b), its length in direction `turn`.

        Each cut (p, q, height) leaves of it what lies at ``z <= height - p * x - q * y``, where x and y run along its
        length and width from its middle.
        """
        c, s, middle, planes = math.cos(turn), math.sin(turn), (a, b, 0.5 * (z0 + z1)), []
        for p, q, height in cuts:
            n = math.sqrt(p * p + q * q + 1.0)
            planes.append(
                (((p * c - q * s) / n, (p * s + q * c) / n, 1.0 / n), (height - middle[2]) / n)
            )
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


def build_scene(
    sites: list[tuple[np.ndarray, np.ndarray]], low: np.ndarray, high: np.ndarray
) -> Scene:
    """Join the arrays of sites where they touch a rectangle of town coordinates, and list them by grid cell."""
    things, planes = (np.concatenate(arrays) for arrays in zip(*sites, strict=True))
    counts = [len(planes) for _, planes in sites]
    things[:, FIRST] += np.repeat(np.cumsum(counts) - counts, [len(things) for things, _ in sites])
    things = things[((things[:, :2] < high) & (things[:, 3:5] > low)).all(axis=1)]
    shape = np.ceil((high - low) / CELL).astype(np.int64)
    first = np.floor((things[:, :2] - STEP / 2 - low) / CELL).astype(np.int64).clip(0)
    last = np.minimum(
        np.floor((things[:, 3:5] + STEP / 2 - low) / CELL).astype(np.int64), shape - 1
    )
    wide = (last - first + 1).clip(0)
    count = wide.prod(axis=1)
    thing = np.repeat(np.arange(len(things)), count)
    nth = np.arange(len(thing)) - np.repeat(np.cumsum(count) - count, count)
    cell = (
        (first[thing, 0] + nth // wide[thing, 1]) * shape[1]
        + first[thing, 1]
        + nth % wide[thing, 1]
    )
    top, order = np.full(shape.prod(), -1e30), np.argsort(cell, kind="stable")
    np.maximum.at(top, cell, things[thing, 5])
    start = np.searchsorted(cell[order], np.arange(len(top) + 1))
    return Scene(
        things, planes, start, thing[order], top.reshape(shape), np.array([*low, top.max()])
    )


SUB_BEAMS = 5  # a pulse has at most as many returns
HALF_DIVERGENCE = 0.25e-3  # radians from the middle of a beam to its outer sub-beams
SEPARATION = 0.6  # meters; returns closer in range are one (half the length of a 4 ns pulse)


@device
def ground_range(ox, oy, oz, dx, dy, dz, t, plan):
    """Range to the ground along a steep beam, and the material, from a guess: gentle slopes let steps converge."""
    for _ in range(30):
        z, material = ground(ox + t * dx, oy + t * dy, plan)
        if abs(oz + t * dz - z) < 0.001:
            break
        t -= (oz + t * dz - z) / dz
    return t, material


@device
def _crossing(things, planes, n, ox, oy, oz, dx, dy, dz):
    """Ranges at which a beam enters and leaves thing n (enter >= leave: missed), and the face entered (-1: none)."""
    near, far, face = -1e30, 1e30, -1
    first, count = int(things[n, FIRST]), int(things[n, COUNT])
    for m in range(first, first + count):
        towards = planes[m, 0] * dx + planes[m, 1] * dy + planes[m, 2] * dz
        t = (planes[m, 3] - planes[m, 0] * ox - planes[m, 1] * oy - planes[m, 2] * oz) / towards
        if towards >= 0.0:
            far = min(far, t)
        elif t > near:
            near, face = t, m
        if near >= far:
            break
    if count == 0:  # the ellipsoid that fills its box
        a = b = c = 0.0
        for p, d, k in ((ox, dx, 0), (oy, dy, 1), (oz, dz, 2)):
            half = 0.5 * (things[n, k + 3] - things[n, k])
            q, e = (p - things[n, k]) / half - 1.0, d / half
            a, b, c = a + e * e, b + e * q, c + q * q
        root = math.sqrt(max(b * b - a * (c - 1.0), 0.0))
        near, far = (-b - root) / a, (-b + root) / a
    return near, far, face


@njit
def first_hit(scene, ox, oy, oz, dx, dy, dz, limit, tested, beam, rng):
    """The nearest thing a beam meets before range `limit`: range, thing (-1: none), face (-1: round).

    ``tested`` (n,) holds the last beam that tried each thing, so that none is tried twice.
    """
    best, index, hit_face = limit, -1, -1
    step = STEP / max(math.hypot(dx, dy), 1e-6)
    t = max((scene.corner[2] - oz) / dz, 0.0)
    while t - step < best:
        i = math.floor((ox + t * dx - scene.corner[0]) / CELL)
        j = math.floor((oy + t * dy - scene.corner[1]) / CELL)
        high, low = oz + (t - step) * dz, oz + (t + step) * dz
        t += step
        if not (
            0 <= i < scene.top.shape[0] and 0 <= j < scene.top.shape[1] and low <= scene.top[i, j]
        ):
            continue
        cell = i * scene.top.shape[1] + j
        for m in range(scene.start[cell], scene.start[cell + 1]):
            n = scene.member[m]
            if tested[n] == beam or low > scene.things[n, 5] or high < scene.things[n, 2]:
                continue
            tested[n] = beam
            near, far, face = _crossing(scene.things, scene.planes, n, ox, oy, oz, dx, dy, dz)
            if near < min(far, best) and scene.things[n, LEAFY] > 0.0:  # a free way among leaves
                near -= math.log(1.0 - rng.random()) / scene.things[n, LEAFY]
            if near < min(far, best):
                best, index, hit_face = near, n, face
    return best, index, hit_face


@njit
def cast(origin, direction, scene, plan, rng):
    """Returns of pulses, in order of pulse and range.

    Sensor positions (n, 3) are town coordinates, unit directions (n, 3) point down steeply. Returns an (m, 7) array:
    range, u, v, z, class (or VEGETATION), echo (0 to 1), row of the pulse.
    """
    out, hit, count = np.empty((origin.shape[0] * SUB_BEAMS, 7)), np.empty((SUB_BEAMS, 7)), 0
    things, tested = scene.things, np.full(scene.things.shape[0], -1)
    order = np.empty(SUB_BEAMS, np.int64)
    for pulse in range(origin.shape[0]):
        ox, oy, oz = origin[pulse, 0], origin[pulse, 1], origin[pulse, 2]
        dx, dy, dz = direction[pulse, 0], direction[pulse, 1], direction[pulse, 2]
        limit, turn = -oz / dz, 2.0 * math.pi * rng.random()
        for s in range(SUB_BEAMS):
            r, way = HALF_DIVERGENCE * limit if s else 0.0, turn + 0.5 * math.pi * s
            x, y = ox + r * math.cos(way), oy + r * math.sin(way)
            limit, material = ground_range(x, y, oz, dx, dy, dz, limit, plan)
            t, n, face = first_hit(
                scene, x, y, oz, dx, dy, dz, limit, tested, pulse * SUB_BEAMS + s, rng
            )
            x, y, code, cosine = x + t * dx, y + t * dy, 2, -dz
            if n >= 0:
                normal = scene.planes[face]
                code, material = (
                    int(things[n, CLASS]),
                    int(things[n, TOP if normal[2] > 0.3 else SIDE]),
                )
                cosine = abs(normal[0] * dx + normal[1] * dy + normal[2] * dz)
                if things[n, LEAFY] > 0.0:
                    cosine = 0.45 + 0.5 * rng.random()
            elif (
                material == WATER
            ):  # a mirror: little comes back, and less the farther from the vertical
                code = 9
                if rng.random() > 0.015 + 0.25 * math.exp(-120.0 * (1.0 + dz)):
                    t = math.inf
            elif material in (SOIL, LAWN):  # here and there the grass stands high
                wild = patches(1.5 * x, 1.5 * y) - (0.45 if material == SOIL else 0.72)
                tall = min(0.55, 2.2 * max(wild, 0.0)) * rng.random()
                if tall > 0.08:
                    t, code, material = t + tall / dz, VEGETATION, GRASS
            hit[s, 0], hit[s, 1], hit[s, 2], hit[s, 3] = t, x, y, oz + t * dz
            hit[s, 4], hit[s, 5], hit[s, 6] = (
                code,
                cosine * REFLECTANCE[material] / SUB_BEAMS,
                pulse,
            )
        for s in range(SUB_BEAMS):  # by range; numpy's sort takes seconds to compile
            place = s
            while place > 0 and hit[order[place - 1], 0] > hit[s, 0]:
                order[place] = order[place - 1]
                place -= 1
            order[place] = s
        first = 0
        while (
            first < SUB_BEAMS and hit[order[first], 0] < math.inf
        ):  # what is close in range is one return
            last, echo = first, hit[order[first], 5]
            while (
                last + 1 < SUB_BEAMS and hit[order[last + 1], 0] - hit[order[last], 0] < SEPARATION
            ):
                last += 1
                echo += hit[order[last], 5]
            for k in range(7):
                out[count, k] = hit[order[(first + last) // 2], k]
            out[count, 5] = echo
            first, count = last + 1, count + 1
    return out[:count]
