"""Bridges over rivers, valleys and railways with all that stands on and beside them, and what only looks like one in part.

As in :mod:`bridge_scenes`, whose scanner sees them; an axis may bend.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from bridge_scenes import (
    BUILDING,
    DECK,
    GROUND,
    LEAF,
    OTHER,
    WATER,
    Scene,
    Slab,
    _cars,
    _deck,
    _road,
)


def _piers(slabs, top, reach, half, step, foot):
    for s in np.arange(-reach + step, reach - 1, step):
        slabs.append(
            Slab(s - 0.8, s + 0.8, -half + 1, half - 1, lambda a: top(a) - 1.4, -foot + 12.0, OTHER)
        )


def _trees(rng, ends, sides, count, tall):
    return [
        (rng.uniform(*ends), side * rng.uniform(*sides), rng.uniform(2, 4.5), rng.uniform(*tall))
        for side in (-1, 1)
        for _ in range(count)
    ]


def deep_valley(seed=0, half=7.0, reach=130.0, deep=30.0, bend=260.0, turn=0.1):
    """Level with the land at both ends, over a wooded valley whose trees come up to the deck."""
    rng = np.random.default_rng(seed)

    def top(s):
        return 0.3 + 0.0 * s

    def terrain(s, t):
        z = -np.clip((reach - np.abs(s)) * 0.6, 0.0, deep) + 0.3 * np.sin(s / 13.0) * np.cos(
            t / 17.0
        )
        return np.where((np.abs(s) > reach) & (np.abs(t) < half + 2), top(s), z), np.full(
            len(s), GROUND
        )

    slabs: list[Slab] = []
    _deck(slabs, -reach, reach, -half, half, top, 2.5)
    _cars(slabs, rng, -reach - 30, reach + 30, (-half + 3, half - 3), top, 25.0)
    _piers(slabs, top, reach, half, 40.0, -deep)
    plants = _trees(rng, (-reach - 20, reach + 20), (half + 1, 60), 80, (8, 30))
    plants = [p for p in plants if abs(p[0]) < reach or abs(p[1]) > half + p[2] + 1]
    return Scene(terrain, slabs, plants, turn, 2 * reach + 140.0, 150.0, bend)


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


def upright(density=16.0, seed=0, reach=100.0, half=6.0, high=8.0, bank=16.0, wet=None, below=True):
    """A deck over a valley of such banks; points and true classes.

    With `wet` there is water between the banks, and it is its share that answers.
    """
    rng = np.random.default_rng(seed)
    long, wide = 2 * reach + 100.0, 120.0
    s, t = rng.uniform(
        (-long / 2, -wide / 2), (long / 2, wide / 2), (int(density * long * wide), 2)
    ).T
    over = np.clip(reach - np.abs(s), 0, None)
    ground = -np.minimum(over * high / bank, high)
    code = np.full(len(s), GROUND)
    deck = (np.abs(s) < reach) & (np.abs(t) < half)
    seen = ~deck | below
    if wet is not None:
        water = over > bank
        code[water] = WATER
        seen &= ~water | (rng.random(len(s)) < wet)
    ground = ground + 0.04 * np.sin(s / 7) * np.cos(t / 9)
    xyz = [np.column_stack([s, t, ground])[seen], np.column_stack([s, t, 0.0 * s])[deck]]
    codes = [code[seen], np.full(int(deck.sum()), DECK)]
    for _ in range(40):
        a, b, radius = (
            rng.uniform(-long / 2, long / 2),
            rng.uniform(half + 6, wide / 2 - 4),
            rng.uniform(3, 5),
        )
        if wet is not None and abs(a) < reach + 6:
            continue
        ball = rng.uniform(-1, 1, (int(radius**2 * density), 3))
        ball = radius * ball[(ball**2).sum(axis=1) < 1]
        side = rng.choice((-1.0, 1.0))
        foot = ground[np.argmin((s - a) ** 2 + (t - side * b) ** 2)]
        xyz.append(ball + np.array([a, side * b, foot + 2 * radius]))
        codes.append(np.full(len(ball), LEAF))
    points = np.concatenate(xyz)
    c, d = np.cos(0.3), np.sin(0.3)
    turned = np.column_stack(
        [points[:, 0] * c - points[:, 1] * d, points[:, 0] * d + points[:, 1] * c, points[:, 2]]
    )
    turned += rng.normal(0, 0.03, turned.shape) + np.array([85_000.0, 447_000.0, 0.0])
    return np.round(turned, 3), np.concatenate(codes).astype(np.uint8)


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
    return Scene(_flat, slabs, [], turn, 160.0, 110.0)


def roof_beside_roofs(seed=0, turn=0.6):
    """A hall that the cloud's rim cuts; at its other end a lower roof of a quarter of its width, between higher ones."""
    roofs = [
        (-80, 10, -14, 14, 4.5),
        (10, 30, -6, 0, 4.2),
        (10, 40, 0, 8, 9.0),
        (30, 40, -12, 8, 9.0),
    ]
    slabs = [Slab(*place, lambda s, z=z: z + 0 * s, z, BUILDING) for *place, z in roofs]
    return Scene(_flat, slabs, [], turn, 120.0, 90.0)


def levee(seed=0, turn=0.5):
    """A dike with a road between two waters, one of which does not answer, and a mole of 5 m into it."""

    def terrain(s, t):
        z = np.clip(4.0 - 0.45 * np.clip(np.abs(t) - 3, 0, None), -0.5, 4.0)
        wet = np.abs(t) > 13
        mole = (np.abs(s - 20) < 2.5) & (t > 0) & (t < 50)
        z = np.where(mole, 2.5, np.where(wet, np.where(t > 0, np.nan, -0.5), z))
        return z, np.where(wet & ~mole, WATER, GROUND)

    return Scene(terrain, [], [], turn, 240.0, 130.0)


def _flat(s, t):
    return 0.05 * np.sin(s / 17), np.full(len(s), GROUND)


def _profile(reach, rise, grade):
    return lambda s: np.clip(rise - grade * np.clip(np.abs(s) - reach, 0, None), 0, None)


def _massive(slabs, start, end, half, top, rise, step=0.35):
    """Layers, so that beams hit upright faces where they meet them."""
    for down in np.arange(0.0, rise, step):
        slabs.append(Slab(start, end, -half, half, lambda s, d=down: top(s) - d, step, GROUND))


def walled_ramps(seed=0, half=6.0, reach=60.0, rise=7.0, grade=0.05, turn=0.4):
    """A bridge of 120 m whose ramps rise between upright walls on both sides."""
    rng = np.random.default_rng(seed)
    top, far = _profile(reach, rise, grade), reach + rise / grade
    slabs: list[Slab] = []
    _deck(slabs, -reach, reach, -half, half, top, 1.6)
    for start, end in ((-far, -reach), (reach, far)):
        _massive(slabs, start, end, half, top, rise)
        for low, high in ((-half, -half + 0.3), (half - 0.3, half)):
            slabs.append(Slab(start, end, low, high, lambda s: top(s) + 1.0, 1.0, OTHER))
    _cars(slabs, rng, -reach - 90, reach + 90, (-2.5, 2.5), top, 22.0)
    _piers(slabs, top, reach, half, 25.0, 0.0)
    return Scene(_flat, slabs, [], turn, 2 * far + 90.0, 120.0)


MORE_SCENES = {
    "deep valley, bent": deep_valley,
    "skewed": skewed,
    "walled ramps": walled_ramps,
}
#: As simple simulators make them: points and classes.
UPRIGHT_SCENES = {
    "valley, ground below the deck": upright,
    "5 m above a river without returns": lambda density=16.0: upright(
        density, high=5.0, bank=10.0, wet=0.0, below=False
    ),
}
TRAPS = {
    "terraces": terraces,
    "parking on a roof, with a ramp": parking_roof,
    "roof beside roofs, at the rim": roof_beside_roofs,
    "dike and mole": levee,
}
