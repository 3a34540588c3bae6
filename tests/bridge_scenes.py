"""Bridges over roads, rivers and canals as a laser scanner sees them, with true classes.

Pulses of two strips come from the side, so that the ground shows some meters under a deck and a deck's flank shows too.
A scene is a terrain and slabs: upright blocks over a rectangle along an axis, their tops following a height of their own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

GROUND, LEAF, BUILDING, WATER, DECK, OTHER = 2, 5, 6, 9, 17, 1


@dataclass
class Slab:
    """What stands over `start` to `end` along the axis and `right` to `left` across it."""

    start: float
    end: float
    right: float
    left: float
    top: Callable
    depth: float
    code: int

    def inside(self, s, t, beyond=0.0):
        east, north = (s > self.start - beyond) & (s < self.end + beyond), t < self.left + beyond
        return east & north & (t > self.right - beyond)


@dataclass
class Scene:
    terrain: Callable  # (s, t) -> height, class; NaN: no return
    slabs: list[Slab]
    trees: list[tuple[float, float, float, float]] = field(
        default_factory=list
    )  # s, t, radius, height
    turn: float = 0.4
    length: float = 300.0
    width: float = 160.0
    bend: float = 0.0  # radius of the axis, which is straight where it is 0

    def along(self, p):
        """Places (n, 2) on the plane as places along and across the axis."""
        if not self.bend:
            return p[:, 0], p[:, 1]
        x, y = p[:, 0], self.bend - p[:, 1]
        return self.bend * np.arctan2(x, y), self.bend - np.hypot(x, y)


def scan(scene: Scene, density: float = 16.0, seed: int = 0, angle: float = 20.0):
    """Points (n, 3) and true classes of a scene."""
    rng = np.random.default_rng(seed)
    c, s = np.cos(scene.turn), np.sin(scene.turn)
    results, codes = [], []
    half_l, half_w = scene.length / 2, scene.width / 2
    for strip in (-1.0, 1.0):
        n = int(density / 2 * scene.length * scene.width)
        p = rng.uniform((-half_l, -half_w), (half_l, half_w), (n, 2))
        # Flown askew to the bridge, 500 m up, from 60 m to the one side and to the other.
        flight = np.array([np.cos(0.5), np.sin(0.5)])
        across = np.array([-flight[1], flight[0]])
        lean = np.clip(
            (p @ across + strip * 120.0) / 500.0,
            -np.tan(np.radians(angle)),
            np.tan(np.radians(angle)),
        )
        slope = lean[:, None] * across  # the beam lies so far out per meter further down

        def at(z, p=p, slope=slope):
            return p - slope * np.asarray(z)[:, None]

        z = np.full(n, -np.inf)
        code = np.zeros(n, int)
        ground = np.zeros(n)
        for _ in range(6):
            q = at(ground)
            height, kind = scene.terrain(*scene.along(q))
            ground = np.where(np.isnan(height), 0.0, height)
        z, code = np.where(np.isnan(height), -np.inf, ground), kind.copy()
        place = scene.along(p)
        for slab in scene.slabs:
            near = np.flatnonzero(slab.inside(*place, 30.0))  # leaning beams come from no farther
            if not len(near):
                continue
            lean = slope[near]

            def on(z, foot=p[near], lean=lean):
                return scene.along(foot - lean * np.asarray(z)[:, None])

            level = np.full(len(near), float(np.nanmedian(slab.top(place[0]))))
            for _ in range(4):
                level = slab.top(on(level)[0])
            faces = [
                level,
                *(level - part * slab.depth for part in rng.uniform(0, 1, 3)),
            ]  # its top, its flank
            for face in faces:
                hit = slab.inside(*on(face)) & (face > z[near])
                z[near[hit]], code[near[hit]] = face[hit], slab.code
        for a, b, radius, tall in scene.trees:
            foot = scene.terrain(np.array([a]), np.array([b]))[0][0]
            if np.isnan(foot):
                continue
            level = foot + tall * rng.uniform(0.35, 1.0, n)
            q = np.column_stack(scene.along(at(level)))
            reach = radius * np.sqrt(
                np.clip(1 - ((level - foot) / tall - 0.65) ** 2 / 0.1225, 0, 1)
            )
            hit = (np.hypot(q[:, 0] - a, q[:, 1] - b) < reach) & (rng.random(n) < 0.7) & (level > z)
            z[hit], code[hit] = level[hit], LEAF
        seen = np.isfinite(z)
        q = at(np.where(seen, z, 0.0))[seen]
        results.append(
            np.column_stack([q[:, 0] * c - q[:, 1] * s, q[:, 0] * s + q[:, 1] * c, z[seen]])
        )
        codes.append(code[seen])
    xyz, code = np.concatenate(results), np.concatenate(codes)
    xyz += rng.normal(0, 0.02, xyz.shape) + np.array([85_000.0, 447_000.0, 0.0])
    return np.round(xyz, 3), code.astype(np.uint8)


def _road(t, level, base, half, grade):
    """Across a bank: level on top, slopes of a grade down (or up) to the land."""
    rise = level - base
    away = np.clip(np.abs(t) - half, 0, None) * grade
    return base + np.sign(rise) * np.clip(np.abs(rise) - away, 0, None)


def _deck(scene_slabs, start, end, right, left, top, depth=1.2, parapet=1.0):
    scene_slabs.append(Slab(start, end, right, left, top, depth, DECK))
    if parapet:
        for low, high in ((right, right + 0.3), (left - 0.3, left)):
            scene_slabs.append(
                Slab(start, end, low, high, lambda s: top(s) + parapet, parapet, DECK)
            )


def _cars(slabs, rng, start, end, lanes, top, gap=18.0):
    for lane in lanes:
        for s in np.arange(start, end, gap):
            s = s + rng.uniform(-6, 6)
            long, tall = (14.0, 3.8) if rng.random() < 0.15 else (4.4, 1.5)
            slabs.append(
                Slab(
                    s, s + long, lane - 0.95, lane + 0.95, lambda a, h=tall: top(a) + h, tall, OTHER
                )
            )


def viaduct(seed=0, height=7.0, half=13.0, reach=110.0, gap=0.0, turn=0.4, length=340.0):
    """A motorway on embankments and over a valley with roads, halls and trees."""
    rng = np.random.default_rng(seed)

    def top(s):
        return height + 0.004 * s + 0.0 * s

    def terrain(s, t):
        on_bank = np.abs(s) > reach
        bank = _road(t, top(s), 0.0, half + 1.5, 0.55)
        front = np.clip(bank - 0.66 * np.clip(reach - np.abs(s), 0, None), 0, None)
        z = np.where(on_bank, bank, front) + 0.15 * np.sin(s / 9.0) * np.cos(t / 11.0) * ~on_bank
        return z, np.full(len(s), GROUND)

    slabs: list[Slab] = []
    parts = [(-half, half)] if gap == 0 else [(-half, -gap / 2), (gap / 2, half)]
    for right, left in parts:
        _deck(slabs, -reach, reach, right, left, top)
        lanes = np.arange(right + 2.5, left - 1.5, 3.6)
        _cars(slabs, rng, -reach - 40, reach + 40, lanes, top, 30.0)
    for s in np.arange(-reach + 25, reach - 10, 30.0):  # piers
        for t in (-half + 2, 0.0, half - 2):
            slabs.append(
                Slab(s - 0.6, s + 0.6, t - 0.6, t + 0.6, lambda a: top(a) - 1.2, height, OTHER)
            )
    for s, t in ((-60.0, 45.0), (30.0, -50.0)):  # halls
        slabs.append(Slab(s, s + 35, t - 12, t + 12, lambda a: 6.5 + 0 * a, 6.5, BUILDING))
    trees = [
        (s, side * (half + rng.uniform(2, 9)), rng.uniform(2, 4), rng.uniform(5, 13))
        for s in np.arange(-150, 150, 9.0)
        for side in (-1, 1)
        if rng.random() < 0.6
    ]
    return Scene(terrain, slabs, trees, turn, length, 150.0)


def river(seed=0, half=6.0, reach=75.0, clear=8.0, returns=0.02, turn=1.1, length=300.0):
    """A road over a river, its deck arched, with banks that slope to the water."""
    rng = np.random.default_rng(seed)

    def top(s):
        return clear + 2.0 * np.cos(np.clip(s / reach, -1.6, 1.6) * np.pi / 2) - 0.0

    def terrain(s, t):
        land = np.clip((np.abs(s) - (reach - 14)) * 0.5, 0.0, 5.0) - 1.5
        z = np.where(np.abs(s) > reach, _road(t, top(s), land, half + 1.0, 0.5), land)
        z = np.maximum(z, land)
        water = np.abs(s) < reach - 14
        z = np.where(water, np.where(rng.random(len(s)) < returns, -1.5, np.nan), z)
        return z, np.where(water, WATER, GROUND)

    slabs: list[Slab] = []
    _deck(slabs, -reach, reach, -half, half, top)
    _cars(slabs, rng, -reach, reach, (-2.0, 2.0), top, 25.0)
    for s in np.arange(-reach + 6, reach, 20.0):  # lamps
        slabs.append(Slab(s, s + 0.2, half - 0.5, half - 0.3, lambda a: top(a) + 8, 8.0, OTHER))
    trees = [
        (
            side * (reach + rng.uniform(5, 60)),
            rng.uniform(-60, 60),
            rng.uniform(2, 4),
            rng.uniform(6, 14),
        )
        for side in (-1, 1)
        for _ in range(30)
    ]
    trees = [tree for tree in trees if abs(tree[1]) > half + 12]
    return Scene(terrain, slabs, trees, turn, length, 140.0)


def overpass(seed=0, half=4.0, reach=24.0, turn=0.2):
    """A lane over a motorway in a cutting: the bridge is level with the land."""

    def top(s):
        return 0.0 * s

    def terrain(s, t):
        z = -np.clip((reach - np.abs(s)) * 0.7, 0, 6.0)
        return z + 0.03 * np.sin(t / 3.0), np.full(len(s), GROUND)

    slabs: list[Slab] = []
    _deck(slabs, -reach, reach, -half, half, top, 1.0, 1.1)
    return Scene(terrain, slabs, [], turn, 160.0, 120.0)


SCENES = {
    "viaduct": viaduct,
    "viaduct of two decks": lambda seed=0: viaduct(seed, gap=4.0),
    "river": river,
    "overpass": overpass,
}
