"""Long bridges as they stand over rivers, valleys, railways and towns, with all that stands on and beside them.

As in :mod:`bridge_scenes`, whose scanner sees them; an axis may bend.
"""

from __future__ import annotations

import numpy as np
from bridge_scenes import BUILDING, DECK, GROUND, LEAF, OTHER, WATER, Scene, Slab, _cars, _deck, _road

WIRE = 14


def _valley(s, reach, deep, grade=0.5):
    """A terrain level with the deck's ends, and so deep between them."""
    return -np.clip((reach - np.abs(s)) * grade, 0.0, deep)


def _masts(slabs, top, reach, sides, step, tall, code=OTHER):
    for s in np.arange(-reach + step / 2, reach, step):
        for t in sides:
            slabs.append(Slab(s, s + 0.3, t - 0.15, t + 0.15, lambda a: top(a) + tall, tall, code))


def _piers(slabs, top, reach, half, step, foot):
    for s in np.arange(-reach + step, reach - 1, step):
        slabs.append(Slab(s - 0.8, s + 0.8, -half + 1, half - 1, lambda a: top(a) - 1.4, -foot + 12.0, OTHER))


def _trees(rng, ends, sides, count, tall):
    return [
        (rng.uniform(*ends), side * rng.uniform(*sides), rng.uniform(2, 4.5), rng.uniform(*tall))
        for side in (-1, 1)
        for _ in range(count)
    ]


def deep_valley(seed=0, half=7.0, reach=130.0, deep=30.0, bend=0.0, grade=0.0, turn=0.4, trees=80):
    """Level with the land at both ends, over a wooded valley whose trees come up to the deck."""
    rng = np.random.default_rng(seed)

    def top(s):
        return 0.3 + grade * s

    def terrain(s, t):
        z = _valley(s, reach, deep, 0.6) + grade * s + 0.3 * np.sin(s / 13.0) * np.cos(t / 17.0)
        return np.where((np.abs(s) > reach) & (np.abs(t) < half + 2), top(s), z), np.full(len(s), GROUND)

    slabs: list[Slab] = []
    _deck(slabs, -reach, reach, -half, half, top, 2.5)
    _cars(slabs, rng, -reach - 30, reach + 30, (-half + 3, half - 3), top, 25.0)
    _piers(slabs, top, reach, half, 40.0, -deep)
    plants = _trees(rng, (-reach - 20, reach + 20), (half + 1, 60), trees, (8, 30))
    plants = [p for p in plants if abs(p[0]) < reach or abs(p[1]) > half + p[2] + 1]
    return Scene(terrain, slabs, plants, turn, 2 * reach + 140.0, 150.0, bend)


def wide_river(seed=0, half=10.0, reach=180.0, clear=9.0, turn=0.9, water=np.nan, arch=4.0):
    """A long arched deck over water without returns, between flood plains with trees."""
    rng = np.random.default_rng(seed)

    def top(s):
        return clear + arch * np.cos(np.clip(s / reach, -1.6, 1.6) * np.pi / 2)

    def terrain(s, t):
        land = np.clip((np.abs(s) - (reach - 40)) * 0.3, 0.0, 3.0) - 2.0
        z = np.where(np.abs(s) > reach, np.maximum(_road(t, top(s), land, half + 1.0, 0.5), land), land)
        wet = np.abs(s) < reach - 40
        return np.where(wet, water, z), np.where(wet, WATER, GROUND)

    slabs: list[Slab] = []
    _deck(slabs, -reach, reach, -half, half, top, 1.8)
    _cars(slabs, rng, -reach, reach, np.arange(-half + 2.5, half - 2, 3.5), top, 30.0)
    _masts(slabs, top, reach, (-half + 0.5, half - 0.5), 35.0, 10.0)
    plants = _trees(rng, (reach + 5, reach + 70), (half + 8, 65), 25, (6, 18))
    plants += [(-s, t, r, h) for s, t, r, h in plants]
    return Scene(terrain, slabs, plants, turn, 2 * reach + 150.0, 150.0)


def truss(seed=0, half=5.0, reach=60.0, clear=7.0, tall=7.0, turn=0.3):
    """Girders of bars on both sides, joined above the road, over a river that hardly answers."""
    scene = wide_river(seed, half, reach, clear, turn, np.nan, 0.0)

    def top(s):
        return clear + 0.0 * s

    def girder(s):
        return clear + tall + 0.0 * s

    slabs = scene.slabs[: -len([s for s in scene.slabs if s.depth == 10.0]) or None]
    for t in (-half, half):
        slabs.append(Slab(-reach, reach, t - 0.3, t + 0.3, girder, 0.5, OTHER))
    for number, s in enumerate(np.arange(-reach, reach, 6.0)):
        slabs.append(Slab(s, s + 0.3, -half, half, girder, 0.4, OTHER))
        for t in (-half, half):
            slabs.append(Slab(s, s + 0.4, t - 0.2, t + 0.2, girder, tall, OTHER))
            for part in np.arange(0.0, 6.0, 1.5):  # a diagonal
                up = tall * (part / 6.0 if number % 2 else 1 - part / 6.0)
                slabs.append(
                    Slab(s + part, s + part + 1.5, t - 0.15, t + 0.15, lambda a, u=up: top(a) + u, 0.6, OTHER)
                )
    return Scene(scene.terrain, slabs, scene.trees, turn, scene.length, scene.width)


def hung(seed=0, half=12.0, reach=170.0, clear=12.0, turn=1.2):
    """Hung from two pylons by cables, over a river."""
    scene = wide_river(seed, half, reach, clear, turn, -2.0, 1.0)

    def top(s):
        return clear + 1.0 * np.cos(np.clip(s / reach, -1.6, 1.6) * np.pi / 2)

    for s in (-70.0, 70.0):
        for t in (-half - 1.0, half + 1.0):
            scene.slabs.append(Slab(s - 1.5, s + 1.5, t - 1.5, t + 1.5, lambda a: 55.0 + 0 * a, 57.0, OTHER))
        for t in (-half + 0.3, half - 0.3):
            for side in (-1, 1):
                for hold in (20.0, 40.0, 60.0):
                    for part in np.arange(0.0, hold, 2.0):
                        a = s + side * part
                        up = 40.0 * (1 - part / hold) + 1.0
                        scene.slabs.append(
                            Slab(a - 1.0, a + 1.0, t - 0.08, t + 0.08, lambda q, u=up: top(q) + u, 0.5, OTHER)
                        )
    return scene


def railway(seed=0, half=5.5, reach=100.0, height=9.0, turn=0.7):
    """Two tracks with masts and wires on a viaduct across a town."""
    rng = np.random.default_rng(seed)

    def top(s):
        return height + 0.01 * s

    def terrain(s, t):
        bank = _road(t, top(s), 0.0, half + 1.0, 0.6)
        front = np.clip(bank - 0.66 * np.clip(reach - np.abs(s), 0, None), 0, None)
        return np.where(np.abs(s) > reach, bank, front), np.full(len(s), GROUND)

    slabs: list[Slab] = []
    _deck(slabs, -reach, reach, -half, half, top, 1.5, 1.2)
    for t in (-2.7, -1.3, 1.3, 2.7):  # rails
        slabs.append(Slab(-reach, reach, t - 0.08, t + 0.08, lambda s: top(s) + 0.2, 0.2, DECK))
    slabs.append(Slab(-30.0, 60.0, 1.0, 4.0, lambda s: top(s) + 4.0, 3.8, OTHER))  # a train
    _masts(slabs, top, reach, (-half + 0.4, half - 0.4), 50.0, 7.5)
    for t in (-2.0, 2.0):
        for up in (5.5, 6.7):
            slabs.append(
                Slab(-reach - 30, reach + 30, t - 0.03, t + 0.03, lambda s, u=up: top(s) + u, 0.05, WIRE)
            )
    for s in np.arange(-80, 81, 40.0):
        for side in (-1, 1):
            t = side * rng.uniform(14, 18)
            slabs.append(
                Slab(
                    s,
                    s + 25,
                    min(t, t + side * 12),
                    max(t, t + side * 12),
                    lambda a: 10.0 + 0 * a,
                    10.0,
                    BUILDING,
                )
            )
    _piers(slabs, top, reach, half, 25.0, 0.0)
    return Scene(terrain, slabs, _trees(rng, (-100, 100), (9, 13), 12, (4, 9)), turn, 330.0, 120.0)


def walled(seed=0, half=14.0, reach=120.0, height=10.0, turn=0.2):
    """A motorway with noise walls of 3.5 m along both edges, and a barrier between its halves."""
    rng = np.random.default_rng(seed)

    def top(s):
        return height + 0.0 * s

    def terrain(s, t):
        bank = _road(t, top(s), 0.0, half + 1.5, 0.55)
        front = np.clip(bank - 0.66 * np.clip(reach - np.abs(s), 0, None), 0, None)
        return np.where(np.abs(s) > reach, bank, front), np.full(len(s), GROUND)

    slabs: list[Slab] = []
    _deck(slabs, -reach, reach, -half, half, top, 2.0, 0.0)
    for t in (-half + 0.2, half - 0.2):
        slabs.append(Slab(-reach - 40, reach + 40, t - 0.15, t + 0.15, lambda s: top(s) + 3.5, 3.5, OTHER))
    slabs.append(Slab(-reach, reach, -0.3, 0.3, lambda s: top(s) + 0.9, 0.9, OTHER))
    _cars(slabs, rng, -reach, reach, (-11.0, -7.0, -3.0, 3.0, 7.0, 11.0), top, 20.0)
    _piers(slabs, top, reach, half, 35.0, 0.0)
    trees = _trees(rng, (-110, 110), (half + 2, half + 14), 40, (6, 17))
    return Scene(terrain, slabs, trees, turn, 360.0, 130.0)


def crossing(seed=0, turn=0.5):
    """A bridge over a bridge over a road."""
    rng = np.random.default_rng(seed)

    def high(s):
        return 14.0 + 0.0 * s

    def terrain(s, t):
        upper = _road(t, high(s), 0.0, 9.0, 0.55)
        upper = np.where(np.abs(s) > 90, upper, np.clip(upper - 0.66 * (90 - np.abs(s)), 0, None))
        lower = _road(s, 6.5 + 0 * t, 0.0, 7.0, 0.55)
        lower = np.where(np.abs(t) > 45, lower, np.clip(lower - 0.66 * (45 - np.abs(t)), 0, None))
        return np.maximum(upper, lower), np.full(len(s), GROUND)

    slabs: list[Slab] = []
    slabs.append(Slab(-5.5, 5.5, -45.0, 45.0, lambda s: 6.5 + 0 * s, 1.2, DECK))
    _deck(slabs, -90.0, 90.0, -8.0, 8.0, high, 1.6)
    _cars(slabs, rng, -90, 90, (-4.0, 4.0), high, 30.0)
    return Scene(terrain, slabs, [], turn, 300.0, 200.0)


def low_river(seed=0, half=5.0, reach=50.0, turn=0.8):
    """Three meters above a river that answers, with trees on both banks up to the parapets."""
    rng = np.random.default_rng(seed)

    def top(s):
        return 3.2 + 0.6 * np.cos(np.clip(s / reach, -1, 1) * np.pi / 2)

    def terrain(s, t):
        bank = np.clip((np.abs(s) - reach + 8) * 0.4, 0.0, 3.2)
        return np.where(np.abs(s) < reach - 8, 0.0, bank), np.where(np.abs(s) < reach - 8, WATER, GROUND)

    slabs: list[Slab] = []
    _deck(slabs, -reach, reach, -half, half, top, 1.0)
    trees = _trees(rng, (reach - 3, reach + 40), (half + 3, 50), 30, (6, 16))
    trees += [(-s, t, r, h) for s, t, r, h in trees]
    return Scene(terrain, slabs, trees, turn, 220.0, 120.0)


def causeway(seed=0, half=6.0, reach=90.0, turn=0.35):
    """Between steep abutments of masonry, level with a street between houses at both ends."""

    def top(s):
        return 0.0 * s

    def terrain(s, t):
        wet = np.abs(s) < reach
        z = np.where(wet, -6.0, 0.0)
        return z, np.where(wet, WATER, GROUND)

    slabs: list[Slab] = []
    _deck(slabs, -reach - 0.2, reach + 0.2, -half, half, top, 1.2, 1.0)
    _piers(slabs, top, reach, half, 30.0, 6.0)
    for side in (-1, 1):
        for t in np.arange(-60, 56, 18.0):
            if abs(t + 7) > 16:
                s = side * (reach + 22)
                slabs.append(Slab(s - 7, s + 7, t, t + 15, lambda a: 12.0 + 0 * a, 12.0, BUILDING))
    return Scene(terrain, slabs, [], turn, 280.0, 130.0)


def long_footbridge(seed=0, half=1.75, reach=70.0, turn=0.6):
    """Four meters wide over a river, with ramps."""
    return wide_river(seed, half, reach, 6.0, turn, np.nan, 1.5)


LONG_SCENES = {
    "deep valley": deep_valley,
    "deep valley, bent": lambda seed=0: deep_valley(seed, bend=260.0, turn=0.1),
    "deep valley, climbing": lambda seed=0: deep_valley(seed, grade=0.06, turn=1.0),
    "deep valley, 40 m wide": lambda seed=0: deep_valley(seed, half=20.0, turn=0.7),
    "wide river": wide_river,
    "wide river, climbing to 16 m": lambda seed=0: wide_river(seed, arch=8.0, half=6.0, turn=0.2),
    "truss": truss,
    "hung from cables": hung,
    "railway": railway,
    "noise walls": walled,
    "crossing": crossing,
    "low river": low_river,
    "steep abutments": causeway,
    "long footbridge": long_footbridge,
}
__all__ = ["LEAF", "LONG_SCENES"]
