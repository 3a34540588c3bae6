"""Bridges over roads, rivers and canals as a laser scanner sees them, with true classes.

Pulses of two strips come from the side, so that the ground shows some meters under a deck and a deck's flank shows too.
A scene is a terrain and slabs: upright blocks over a rectangle along an axis, their tops following a height of their own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

GROUND, WATER, DECK, OTHER = 2, 9, 17, 1


@dataclass
class Slab:
    """What stands over `start` to `end` along the axis and `right` to `left` across it."""

    start: float
    end: float
    right: float
    left: float
    top: Callable  # place along the axis -> height
    depth: float
    code: int

    def inside(self, place):
        s, t = place.T
        return (s > self.start) & (s < self.end) & (t > self.right) & (t < self.left)


@dataclass
class Scene:
    terrain: Callable  # (s, t) -> height, class; NaN: no return
    slabs: list[Slab]
    turn: float = 0.4
    length: float = 300.0
    width: float = 150.0


def scan(scene: Scene, density: float = 16.0, seed: int = 0):
    """Points (n, 3) and true classes of a scene, flown askew to its axis, 500 m up, from both sides."""
    rng = np.random.default_rng(seed)
    half = np.array([scene.length, scene.width]) / 2
    across = np.array([-np.sin(0.5), np.cos(0.5)])
    parts, codes = [], []
    for strip in (-1.0, 1.0):
        p = rng.uniform(-half, half, (int(density * 2 * half.prod()), 2))
        # The beam lies so far out per meter further down, up to 20 degrees.
        lean = np.clip((p @ across + strip * 120.0) / 500.0, -0.36, 0.36)[:, None] * across
        z = np.zeros(len(p))
        for _ in range(6):
            height, code = scene.terrain(*(p - lean * z[:, None]).T)
            z = np.where(np.isnan(height), 0.0, height)
        z, code = np.where(np.isnan(height), -np.inf, z), code.copy()
        for slab in scene.slabs:
            top = slab.top(p[:, 0])
            for _ in range(4):
                top = slab.top((p - lean * top[:, None])[:, 0])
            for depth in (0.0, *rng.uniform(0, slab.depth, 3)):  # its top, its flank
                face = top - depth
                hit = slab.inside(p - lean * face[:, None]) & (face > z)
                z[hit], code[hit] = face[hit], slab.code
        seen = np.isfinite(z)
        parts.append(np.column_stack([p - lean * np.where(seen, z, 0.0)[:, None], z])[seen])
        codes.append(code[seen])
    xyz = np.concatenate(parts)
    c, s = np.cos(scene.turn), np.sin(scene.turn)
    xyz[:, :2] = xyz[:, :2] @ np.array([[c, s], [-s, c]])
    xyz += rng.normal(0, 0.02, xyz.shape) + np.array([85_000.0, 447_000.0, 0.0])
    return np.round(xyz, 3), np.concatenate(codes).astype(np.uint8)


def _bank(t, level, base, half, grade):
    """Across a bank: level on top, slopes of a grade down to the land."""
    away = np.clip(np.abs(t) - half, 0, None) * grade
    return base + np.clip(level - base - away, 0, None)


def _deck(start, end, right, left, top, depth=1.2, parapet=1.0):
    """Return a deck and its two parapets."""
    rails = [(right, right + 0.3), (left - 0.3, left)]
    rail = [Slab(start, end, *sides, lambda s: top(s) + parapet, parapet, DECK) for sides in rails]
    return [Slab(start, end, right, left, top, depth, DECK), *rail]


def viaduct(gap=0.0, height=7.0, half=13.0, reach=110.0):
    """A motorway on embankments and over a valley with roads, on one deck or on two, with cars."""

    def top(s):
        return height + 0.004 * s

    def terrain(s, t):
        away = np.clip(reach - np.abs(s), 0, None)
        bank = np.clip(_bank(t, top(s), 0.0, half + 1.5, 0.55) - 0.66 * away, 0, None)
        return bank + 0.15 * np.sin(s / 9.0) * np.cos(t / 11.0) * (away > 0), np.full(
            len(s), GROUND
        )

    sides = [(-half, half)] if gap == 0 else [(-half, -gap / 2), (gap / 2, half)]
    slabs = [slab for right, left in sides for slab in _deck(-reach, reach, right, left, top)]
    for s in range(-140, 140, 15):
        lane = (-10.0, -5.0, 5.0, 10.0)[s % 4]
        slabs.append(Slab(s, s + 5, lane - 1, lane + 1, lambda a: top(a) + 1.6, 1.6, OTHER))
    return Scene(terrain, slabs, 0.4, 340.0)


def river(half=6.0, reach=75.0, clear=8.0):
    """A road over a river, its deck arched, with banks that slope to the water."""
    rng = np.random.default_rng(0)

    def top(s):
        return clear + 2.0 * np.cos(np.clip(s / reach, -1.6, 1.6) * np.pi / 2)

    def terrain(s, t):
        land = np.clip((np.abs(s) - (reach - 14)) * 0.5, 0.0, 5.0) - 1.5
        z = np.where(np.abs(s) > reach, _bank(t, top(s), land, half + 1.0, 0.5), land)
        water = np.abs(s) < reach - 14
        z = np.where(water, np.where(rng.random(len(s)) < 0.02, -1.5, np.nan), z)
        return z, np.where(water, WATER, GROUND)

    return Scene(terrain, _deck(-reach, reach, -half, half, top), 1.1)


def overpass(half=4.0, reach=24.0):
    """A lane over a motorway in a cutting: the bridge is level with the land."""

    def terrain(s, t):
        z = -np.clip((reach - np.abs(s)) * 0.7, 0, 6.0)
        return z + 0.03 * np.sin(t / 3.0), np.full(len(s), GROUND)

    slabs = _deck(-reach, reach, -half, half, lambda s: 0.0 * s, 1.0, 1.1)
    return Scene(terrain, slabs, 0.2, 160.0, 120.0)


SCENES = {
    "viaduct": viaduct,
    "viaduct of two decks": lambda: viaduct(gap=4.0),
    "river": river,
    "overpass": overpass,
}
