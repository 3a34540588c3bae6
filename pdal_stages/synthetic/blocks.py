"""What stands in the generated town: its ground, and the solids of each block, as plain boxes.

Town coordinates (u, v) are meters along two families of streets. Everything is a function of the
seed and the place, so any part of a town is made on its own, and always the same. Sizes, in
meters, are plausible ones without a source.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.asprs import BUILDING, WIRE

UNCLASSIFIED = 1
VEGETATION = 255  #: stands for 3, 4 or 5, which follows from the height above ground
#: From the axis of a street to the next.
PITCH = 60.0
#: From the axis of a street to the land that may be built on.
MARGIN = 6.0
#: Half the width of a road.
ROAD_HALF = 3.5
#: Side of the land of a block that may be built on.
LAND = PITCH - 2 * MARGIN
#: From the ground to the wires of a pole.
POLE_HEIGHT = 8.4
#: No solid reaches higher above, or lies lower below, the middle of the heights.
HIGHEST = 40.0
#: Length and height of the waves that the ground is made of.
WAVES = ((1100.0, 5.0), (640.0, 3.0), (330.0, 2.2), (170.0, 2.0), (90.0, 0.4), (38.0, 0.1))

# Reflectances at 1064 nm: not measured, and from no source.
ASPHALT = 0.14
LAWN = 0.48
LEAF = 0.5
ROOF = 0.33
FLAT_ROOF = 0.28
METAL = 0.45


class Solid(NamedTuple):
    """A box, upright and along the streets, below the planes of its roof; a ball; a wire.

    Of a roof plane across axis n no point is higher than ``peak[n] - pitch[n] * d`` at a distance
    d from the middle; a pitch of 0 is no plane.
    """

    shape: str  #: box, ball (the ellipsoid in the box), or wire (along u, from `low` to `high`)
    middle: tuple[float, float]  #: (u, v)
    half: tuple[float, float]  #: half the length along u and v
    low: float  #: height, absolute
    high: float
    code: int
    reflectance: float
    extinction: float = 0.0  #: of leaves, 1/m; 0: nothing passes
    pitch: tuple[float, float] = (0.0, 0.0)
    peak: tuple[float, float] = (0.0, 0.0)


def ground(uv: NDArray, seed: int) -> NDArray[np.float64]:
    """Return the height of the bare ground at places (n, 2)."""
    rng, z = np.random.default_rng([seed, 0x7031]), np.zeros(len(uv))
    for length, height in WAVES:
        angle, phase = rng.uniform(0, 2 * math.pi, 2)
        k = 2 * math.pi / (length * rng.uniform(0.85, 1.15))
        z += height * np.sin(k * (uv @ (math.cos(angle), math.sin(angle))) + phase)
    return z


def cover(uv: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the reflectance of the ground, and how high grass stands at most, at places (n, 2)."""
    u, v = uv.T
    axis = np.minimum(abs(u - PITCH * np.round(u / PITCH)), abs(v - PITCH * np.round(v / PITCH)))
    wild = np.sin(u / 3.1 + 1.7 * np.sin(v / 7.3)) + np.sin(v / 3.7 + 1.3 * np.sin(u / 5.9))
    grass = np.where(axis > MARGIN, np.clip(0.6 * (wild - 0.6), 0.0, 0.5), 0.0)
    return np.where(axis < ROAD_HALF, ASPHALT, LAWN), grass


class TownBlock:
    """The solids of block (i, j), and of the streets on its low sides.

    Places (a, b) are meters from the low corner of the land that may be built on.
    """

    def __init__(self, seed: int, i: int, j: int) -> None:
        self.seed, self.i, self.j = seed, i, j
        self.corner = PITCH * i + MARGIN, PITCH * j + MARGIN
        self.rng = np.random.default_rng([seed, i + 2**20, j + 2**20])
        self.draw, self.solids = self.rng.uniform, list[Solid]()
        kinds = self._fill_rows, self._fill_villas, self._fill_halls, self._fill_park
        kinds[(i + 2 * j + seed) % len(kinds)]()
        self._fill_streets()

    def z(self, a: float, b: float) -> float:
        """Return the height of the ground."""
        u, v = self.corner[0] + a, self.corner[1] + b
        return float(ground(np.array([[u, v]]), self.seed)[0])

    def _add(self, shape: str, place, half, low: float, high: float, *rest, **roof) -> None:
        middle = self.corner[0] + place[0], self.corner[1] + place[1]
        self.solids.append(Solid(shape, middle, half, low, high, *rest, **roof))

    def house(self, place, half, eave: float, roof: str, pitch: float = 0.8) -> None:
        """Build a house with a chimney; `roof` is flat, gable (the ridge along u) or hip."""
        (a, b), (half_u, half_v), z = place, half, self.z(*place)
        if roof == "flat":
            self._add("box", place, half, z - 1.5, z + eave, BUILDING, FLAT_ROOF)
            beside, low = (a + self.draw(-0.5, 0.5) * half_u, b), z + eave
            self._add("box", beside, (1.5, 1.0), low, low + 1.5, BUILDING, METAL)
            return
        top = z + eave + pitch * half_v
        pitches, peaks = (pitch if roof == "hip" else 0.0, pitch), (z + eave + pitch * half_u, top)
        self._add("box", place, half, z - 1.5, top, BUILDING, ROOF, pitch=pitches, peak=peaks)
        beside, high = (a + self.draw(-0.3, 0.3) * half_u, b + 0.3 * half_v), self.draw(0.3, 0.9)
        self._add("box", beside, (0.35, 0.3), z + eave, top + high, BUILDING, ROOF)

    def tree(self, place, low: float, high: float) -> None:
        """Plant a tree: a trunk, and a crown of five boughs, dense or thin."""
        (a, b), z, height = place, self.z(*place), self.draw(low, high)
        radius, bole = height * self.draw(0.26, 0.4), height * self.draw(0.18, 0.3)
        extinction = self.draw(0.5, 0.9) if self.draw() < 0.8 else self.draw(0.15, 0.3)
        trunk = 0.06 + 0.011 * height
        self._add("box", place, (trunk, trunk), z, z + height / 2, VEGETATION, LEAF)
        half = 0.5 * (height - bole)
        self._ball(place, (0.7 * radius, 0.7 * radius), z + bole, z + height, extinction)
        for n in range(5):
            angle, away = 2 * math.pi * (n + self.draw(-0.3, 0.3)) / 5, radius * self.draw(0.4, 0.6)
            r, rz = radius * self.draw(0.42, 0.62), half * self.draw(0.4, 0.6)
            middle = z + bole + rz + 2 * (half - rz) * self.draw(0.15, 0.85)
            bough = a + away * math.cos(angle), b + away * math.sin(angle)
            self._ball(bough, (r, r), middle - rz, middle + rz, extinction)

    def _ball(self, place, half, low: float, high: float, extinction: float) -> None:
        self._add("ball", place, half, low, high, VEGETATION, LEAF, extinction)

    def plant(self, trees: int, shrubs: int, low: float, high: float, land) -> None:
        """Plant trees and shrubs over a part (a, b, width, depth) of the block."""
        a, b, width, depth = land
        for n in range(trees + shrubs):
            place = a + width * self.draw(), b + depth * self.draw()
            if n < trees:
                self.tree(place, low, high)
                continue
            z, height = self.z(*place), self.draw(0.35, 2.4)
            radius = height * self.draw(0.45, 0.85)
            top = z + height
            self._ball(place, (radius, radius), z - 0.2 * height, top, self.draw(1.2, 2.2))

    def car(self, place, half=(0.9, 2.1)) -> None:
        """Park a car."""
        z = self.z(*place)
        self._add("box", place, half, z + 0.2, z + self.draw(1.4, 1.8), UNCLASSIFIED, METAL)

    def _fill_rows(self) -> None:
        """Build two rows of terraced houses, with gardens between them."""
        for b in (6.5, LAND - 6.5):
            eave, pitch, a = self.draw(4.8, 7.5), self.draw(0.65, 1.1), self.draw(0.5, 2.0)
            while a + 14 < LAND:
                half = min(self.draw(14, 24), LAND - a) / 2
                self.house((a + half, b), (half, 4.6), eave, "gable", pitch)
                a += 2 * half + self.draw(2.5, 4.5)
        for a in np.arange(4.0, LAND, 8.0):
            self.plant(int(self.draw() < 0.5), 2, 4, 9, (a + 1, 13, 6, LAND - 26))

    def _fill_villas(self) -> None:
        """Build four detached houses with garages, in gardens."""
        side = LAND / 2
        for a in (0.0, side):
            for b in (0.0, side):
                half = self.draw(5.0, 7.0), self.draw(3.6, 4.8)
                roof = self.rng.choice(["hip", "gable", "flat"])
                self.house((a + side / 2, b + 10), half, self.draw(2.8, 6.2), roof)
                self.house((a + 3, b + 5), (1.5, 2.7), 2.5, "flat")
                self.plant(2, 6, 4, 12, (a + 2, b + 17, side - 4, 5))

    def _fill_halls(self) -> None:
        """Build halls and a parking lot with trees."""
        for a in (0.25 * LAND, 0.72 * LAND):
            half = self.draw(0.18, 0.22) * LAND, self.draw(0.2, 0.26) * LAND
            self.house((a, 0.7 * LAND), half, self.draw(4.5, 9), "flat")
        for a in np.arange(2.0, LAND - 2, 2.8):
            for b in (4.0, 12.0):
                if self.draw() < 0.6:
                    self.car((a, b))
        self.plant(4, 6, 5, 8, (2, 15.5, LAND - 4, 3))

    def _fill_park(self) -> None:
        """Plant tall trees around a large house, and let shrubs grow."""
        self.house((LAND / 2, 0.6 * LAND), (9.0, 5.0), self.draw(7, 10), "gable", 1.1)
        self.plant(8, 25, 5, 14, (2, 2, LAND - 4, 14))
        self.plant(10, 6, 8, 20, (2, LAND - 9, LAND - 4, 8))

    def _fill_streets(self) -> None:
        """Park cars along two streets; one has trees, the other poles with three wires."""
        for n in np.arange(2.0, LAND - 2, 6.0):
            if self.draw() < 0.45:
                self.car((2.3 * self.rng.choice([-1, 1]) - MARGIN, n))
            if self.draw() < 0.45:
                self.car((n, 2.3 * self.rng.choice([-1, 1]) - MARGIN), (2.1, 0.9))
        for b in (6.0, 22.0, 38.0):
            self.tree((-1.2, b), 5, 9)
        for a in (0.0, PITCH / 2):
            foot, top = self.z(a, -1.2), self.z(a, -1.2) + POLE_HEIGHT
            self._add("box", (a, -1.2), (0.13, 0.13), foot, top + 0.2, UNCLASSIFIED, LEAF)
            end = self.z(a + PITCH / 2, -1.2) + POLE_HEIGHT
            for off in (-0.6, 0.0, 0.6):
                middle, half = (a + PITCH / 4, off - 1.2), (PITCH / 4, 0.0)
                self._add("wire", middle, half, top, end, WIRE, METAL)
