"""Bridges that differ in kind from those of :mod:`long_bridge_scenes`, and what is no bridge but looks like one in part."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from bridge_scenes import BUILDING, DECK, GROUND, OTHER, WATER, Scene, Slab, _cars, _deck, _road
from long_bridge_scenes import WIRE, _piers, _trees, _valley


@dataclass
class Skewed(Slab):
    """A slab whose ends are cut askew: so many meters along per meter across."""

    skew: float = 0.0

    def inside(self, s, t, beyond=0.0):
        along = s - self.skew * t
        east = (along > self.start - beyond) & (along < self.end + beyond)
        return east & (t < self.left + beyond) & (t > self.right - beyond)


def skewed(seed=0, half=6.0, reach=35.0, skew=1.2, turn=0.5):
    """A road crosses a river at 40 degrees: its abutments are not square to it."""
    rng = np.random.default_rng(seed)

    def top(s):
        return 6.0 + 0.0 * s

    def terrain(s, t):
        away = np.abs(s - skew * t)
        bank = _road(t, 6.0 + 0 * s, 0.0, half + 1.0, 0.6)
        front = np.clip(bank - 0.6 * np.clip(reach - away, 0, None), -1.5, None)
        z = np.where(away > reach, bank, front)
        wet = away < reach - 14
        return np.where(wet, -1.5, z), np.where(wet, WATER, GROUND)

    slabs: list[Slab] = [Skewed(-reach, reach, -half, half, top, 1.3, DECK, skew)]
    for low, high in ((-half, -half + 0.3), (half - 0.3, half)):
        slabs.append(Skewed(-reach, reach, low, high, lambda s: top(s) + 1.0, 1.0, DECK, skew))
    _cars(slabs, rng, -reach - 40, reach + 40, (-3.0, 3.0), top, 22.0)
    return Scene(terrain, slabs, _trees(rng, (-90, 90), (22, 60), 25, (6, 15)), turn, 260.0, 140.0)


def ramp_in_a_curve(seed=0, half=4.5, reach=60.0, bend=110.0, turn=0.3):
    """A ramp of an interchange: climbs 5 % in a curve of 110 m, over a road, on banks at both ends."""
    rng = np.random.default_rng(seed)

    def top(s):
        return 7.0 + 0.05 * s

    def terrain(s, t):
        level = np.clip(top(s), 0.0, None)
        bank = _road(t, level, 0.0, half + 1.0, 0.6)
        front = np.clip(bank - 0.7 * np.clip(reach - np.abs(s), 0, None), 0, None)
        return np.where(np.abs(s) > reach, bank, front), np.full(len(s), GROUND)

    slabs: list[Slab] = []
    _deck(slabs, -reach, reach, -half, half, top, 1.4, 1.0)
    _cars(slabs, rng, -reach - 20, reach + 20, (-2.0,), top, 18.0)
    _piers(slabs, top, reach, half, 22.0, 0.0)
    return Scene(terrain, slabs, [], turn, 260.0, 200.0, bend)


def motorway(seed=0, half=17.0, reach=90.0, gap=4.0, turn=0.9):
    """Two decks of three lanes full of trucks, over a river that answers, with signs across and barriers."""
    rng = np.random.default_rng(seed)

    def top(s):
        return 9.0 + 0.0 * s

    def terrain(s, t):
        bank = _road(t, top(s), 0.0, half + 2.0, 0.5)
        front = np.clip(bank - 0.5 * np.clip(reach - np.abs(s), 0, None), -1.0, None)
        wet = np.abs(s) < reach - 24
        z = np.where(np.abs(s) > reach, bank, front)
        return np.where(wet, -1.0, z), np.where(wet, WATER, GROUND)

    slabs: list[Slab] = []
    for right, left in ((-half, -gap / 2), (gap / 2, half)):
        _deck(slabs, -reach, reach, right, left, top, 2.2, 1.0)
        for lane in np.arange(right + 2.5, left - 1.5, 3.7):
            for s in np.arange(-reach - 30, reach + 30, 24.0):
                s = s + rng.uniform(-5, 5)
                long, tall = (15.0, 3.9) if rng.random() < 0.5 else (4.5, 1.6)
                slabs.append(
                    Slab(s, s + long, lane - 1.2, lane + 1.2, lambda a, h=tall: top(a) + h, tall, OTHER)
                )
    for s in (-45.0, 50.0):  # signs across
        slabs.append(Slab(s, s + 0.8, -half, half, lambda a: top(a) + 7.5, 2.0, OTHER))
    return Scene(terrain, slabs, _trees(rng, (-150, 150), (24, 60), 30, (6, 16)), turn, 330.0, 140.0)


def over_a_rail_cutting(seed=0, half=5.0, reach=17.0, turn=0.7):
    """A street over two tracks in a cutting with steep walls, their wires and masts, between houses."""
    rng = np.random.default_rng(seed)

    def top(s):
        return 0.15 + 0.0 * s

    def terrain(s, t):
        z = -np.clip((reach - np.abs(s)) * 2.5, 0, 7.0)
        return z + 0.02 * np.sin(t), np.full(len(s), GROUND)

    slabs: list[Slab] = []
    _deck(slabs, -reach - 0.3, reach + 0.3, -half, half, top, 1.0, 1.1)
    _cars(slabs, rng, -reach, reach, (-2.0, 2.0), top, 14.0)
    for s in (-4.0, 4.0):
        slabs.append(Slab(s - 0.05, s + 0.05, -80, 80, lambda a: -1.5 + 0 * a, 0.1, WIRE))
    for t in (-40.0, 30.0):
        slabs.append(Slab(-8.0, 8.0, t, t + 0.3, lambda a: -0.5 + 0 * a, 0.4, OTHER))
    for side in (-1, 1):
        for t in (-55.0, -32.0, 14.0, 38.0):
            s = side * (reach + 16)
            slabs.append(Slab(s - 7, s + 7, t, t + 16, lambda a: 9.0 + 0 * a, 9.0, BUILDING))
    return Scene(terrain, slabs, _trees(rng, (-16, -13), (10, 60), 8, (5, 9)), turn, 170.0, 140.0)


def in_a_wood(seed=0, half=2.5, reach=14.0, turn=0.2):
    """A forest road over a brook in a ravine; crowns close over it here and there."""
    rng = np.random.default_rng(seed)

    def top(s):
        return 0.1 + 0.0 * s

    def terrain(s, t):
        z = _valley(s, reach, 7.0, 0.8) + 0.2 * np.sin(s / 5) * np.cos(t / 6)
        return np.where((np.abs(s) > reach) & (np.abs(t) < half + 1), top(s), z), np.full(len(s), GROUND)

    slabs: list[Slab] = []
    _deck(slabs, -reach, reach, -half, half, top, 0.8, 1.0)
    trees = _trees(rng, (-70, 70), (half + 2, 55), 130, (9, 20))
    return Scene(terrain, slabs, trees, turn, 150.0, 120.0)


def very_long(seed=0, half=8.0, reach=300.0, deep=35.0, turn=0.25):
    """600 m over a valley on piers, its ends seen."""
    rng = np.random.default_rng(seed)

    def top(s):
        return 0.2 + 0.01 * s

    def terrain(s, t):
        z = _valley(s, reach, deep, 0.5) + 0.01 * s + 0.3 * np.sin(s / 19.0) * np.cos(t / 23.0)
        return np.where((np.abs(s) > reach) & (np.abs(t) < half + 2), top(s), z), np.full(len(s), GROUND)

    slabs: list[Slab] = []
    _deck(slabs, -reach, reach, -half, half, top, 2.5)
    _cars(slabs, rng, -reach, reach, (-5.0, 5.0), top, 40.0)
    _piers(slabs, top, reach, half, 50.0, -deep)
    return Scene(terrain, slabs, _trees(rng, (-280, 280), (half + 2, 50), 60, (8, 28)), turn, 730.0, 130.0)


def beside_roofs(seed=0, half=7.0, reach=80.0, height=8.0, turn=0.6, side=3.0):
    """A viaduct between flat roofs as high as its deck, 3 m beside it, with crowns in the gap."""
    rng = np.random.default_rng(seed)

    def top(s):
        return height + 0.0 * s

    def terrain(s, t):
        bank = _road(t, top(s), 0.0, half + 1.0, 0.7)
        front = np.clip(bank - 0.8 * np.clip(reach - np.abs(s), 0, None), 0, None)
        return np.where(np.abs(s) > reach, bank, front), np.full(len(s), GROUND)

    slabs: list[Slab] = []
    _deck(slabs, -reach, reach, -half, half, top, 1.4, 1.0)
    for s in np.arange(-60, 46, 26.0):
        for sign in (-1, 1):
            one, other = sorted((sign * (half + side), sign * (half + side + 14)))
            slabs.append(Slab(s, s + 18, one, other, lambda a: height + 0.1 + 0 * a, height, BUILDING))
    gap = (half + 0.8, half + side)
    return Scene(terrain, slabs, _trees(rng, (-70, 70), gap, 25, (8, 11)), turn, 260.0, 110.0)


OTHER_SCENES = {
    "skewed": skewed,
    "ramp in a curve": ramp_in_a_curve,
    "motorway of two decks": motorway,
    "over a rail cutting": over_a_rail_cutting,
    "in a wood": in_a_wood,
    "600 m long": very_long,
    "beside flat roofs": beside_roofs,
}


# ---- no bridges -----------------------------------------------------------------------------------------


def terraces(seed=0, turn=0.4):
    """Vineyards: strips of 7 m between walls of 2.6 m, a path up to them."""

    def terrain(s, t):
        step = np.floor(s / 7.0)
        z = 2.6 * step + 0.05 * (s - 7 * step) + 0.02 * np.sin(t)
        path = np.abs(t - 20) < 2
        return np.where(path, 2.6 * s / 7.0, z), np.full(len(s), GROUND)

    return Scene(terrain, [], [], turn, 130.0, 120.0)


def parking_roof(seed=0, turn=0.8):
    """A parking deck on a hall's roof with a straight ramp of 4 m up to it and parapets."""
    rng = np.random.default_rng(seed)
    slabs = [Slab(0, 60, -25, 25, lambda s: 6.0 + 0 * s, 6.0, BUILDING)]
    for low, high in ((-25, -24.7), (24.7, 25)):
        slabs.append(Slab(0, 60, low, high, lambda s: 7.0 + 0 * s, 1.0, BUILDING))
    slabs.append(Slab(-50, 0.2, 2, 6, lambda s: np.clip(6.0 + 0.12 * s, 0, 6), 6.0, BUILDING))
    _cars(slabs, rng, 5, 50, (-18.0, -8.0, 12.0), lambda s: 6.0 + 0 * s, 7.0)
    flat = lambda s, t: (0.02 * np.sin(s / 7), np.full(len(s), GROUND))  # noqa: E731
    return Scene(flat, slabs, [], turn, 160.0, 110.0)


def loading_ramps(seed=0, turn=0.1):
    """Halls with platforms of 1.3 and 2.4 m before them, with ramps at both ends; all massive."""

    def terrain(s, t):
        z, code = 0.02 * np.sin(s / 7), np.full(len(s), GROUND)
        for first, tall in ((-30.0, 1.3), (15.0, 2.4)):
            ramp = (np.abs(s) < 60) & (t > first - 5) & (t <= first)
            hall = (np.abs(s) < 40) & (t > first) & (t < first + 18)
            z = np.where(ramp, np.clip((60 - np.abs(s)) * 0.12, 0, tall), np.where(hall, 9.0, z))
            code[ramp | hall] = BUILDING
        return z, code

    return Scene(terrain, [], [], turn, 160.0, 120.0)


def levee(seed=0, turn=0.5):
    """A dike with a road between two waters, one of which does not answer, and a mole of 5 m into it."""

    def terrain(s, t):
        z = np.clip(4.0 - 0.45 * np.clip(np.abs(t) - 3, 0, None), -0.5, 4.0)
        wet = np.abs(t) > 13
        mole = (np.abs(s - 20) < 2.5) & (t > 0) & (t < 50)
        z = np.where(mole, 2.5, np.where(wet, np.where(t > 0, np.nan, -0.5), z))
        return z, np.where(wet & ~mole, WATER, GROUND)

    return Scene(terrain, [], [], turn, 240.0, 130.0)


def platform(seed=0, turn=0.3):
    """A railway station: platforms of 0.8 m, roofs over them on poles, a stepped hill behind."""
    slabs = []
    for t in (-10.0, 8.0):
        slabs.append(Slab(-70, 70, t, t + 6, lambda s: 0.8 + 0 * s, 0.8, GROUND))
        slabs.append(Slab(-40, 40, t + 0.5, t + 5.5, lambda s: 5.0 + 0 * s, 0.4, BUILDING))

    def terrain(s, t):
        return np.where(t > 30, 4.0 + np.where(t > 42, 4.0, 0.0), 0.0), np.full(len(s), GROUND)

    return Scene(terrain, slabs, [], turn, 200.0, 110.0)


def row_of_roofs(seed=0, turn=0.9):
    """Flat roofs up a hillside, each level with the street above it."""
    slabs = []
    for n in range(4):
        base = 4.0 * n
        for s in np.arange(-50, 40, 24.0):
            t = -40 + 22 * n
            slabs.append(Slab(s, s + 16, t, t + 12, lambda a, h=base + 4.0: h + 0 * a, 4.0, BUILDING))

    def terrain(s, t):
        z = 4.0 * np.clip((t + 28) / 22 + 0.0, 0, 4)
        step = np.floor((t + 50) / 22)
        away = (t + 50) - 22 * step
        return 4.0 * np.clip(step - 0 * z, 0, 4) - 0.0 * away, np.full(len(s), GROUND)

    return Scene(terrain, slabs, [], turn, 150.0, 120.0)


TRAPS = {
    "terraces": terraces,
    "parking on a roof, with a ramp": parking_roof,
    "loading ramps": loading_ramps,
    "dike and mole": levee,
    "station": platform,
    "roofs up a hillside": row_of_roofs,
}
