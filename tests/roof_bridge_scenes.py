"""Viaducts close to roofs of their height and under crowns: what lies beside them is no deck."""

from __future__ import annotations

import numpy as np
from bridge_scenes import BUILDING, GROUND, OTHER, Scene, Slab, _cars, _deck, _road
from long_bridge_scenes import _piers, _trees


def between_gables(seed=0, half=6.0, reach=90.0, height=7.5, turn=0.35):
    """Rows of houses with gabled roofs, their ridges or eaves as high as the deck, and flat halls, 1 to 6 m beside it."""
    rng = np.random.default_rng(seed)

    def top(s):
        return height + 0.01 * s

    def terrain(s, t):
        bank = _road(t, top(s), 0.0, half + 1.0, 0.7)
        front = np.clip(bank - 0.8 * np.clip(reach - np.abs(s), 0, None), 0, None)
        return np.where(np.abs(s) > reach, bank, front), np.full(len(s), GROUND)

    slabs: list[Slab] = []
    _deck(slabs, -reach, reach, -half, half, top, 1.5, 1.0)
    _cars(slabs, rng, -reach - 20, reach + 20, (-2.5, 2.5), top, 24.0)
    for sign in (-1, 1):
        for s in np.arange(-72, 60, 21.0):
            away = half + rng.uniform(1.0, 6.0)
            deep, long = rng.uniform(9, 13), rng.uniform(13, 19)
            one, other = sorted((sign * away, sign * (away + deep)))
            if rng.random() < 0.4:  # a hall
                level = height + 0.01 * s + rng.uniform(-0.3, 0.4)
                slabs.append(Slab(s, s + long, one, other, lambda a, h=level: h + 0 * a, level, BUILDING))
                continue
            # Its ridge runs across the axis: a slab's height follows the axis.
            ridge, pitch = height + 0.01 * s + rng.choice([0.0, 0.2, 2.0, 3.0]), rng.uniform(0.5, 0.9)
            middle = s + long / 2

            def roof(a, ridge=ridge, pitch=pitch, middle=middle):
                return ridge - pitch * np.abs(a - middle)

            slabs.append(Slab(s, s + long, one, other, roof, height, BUILDING))
    return Scene(
        terrain, slabs, _trees(rng, (-80, 80), (half + 1, half + 5), 12, (8, 12)), turn, 270.0, 110.0
    )


def under_crowns(seed=0, half=4.0, reach=70.0, height=6.0, bend=160.0, turn=0.8):
    """A street in a curve on arches, under crowns of an avenue that reach over it, past a school."""
    rng = np.random.default_rng(seed)

    def top(s):
        return height + 0.0 * s

    def terrain(s, t):
        bank = _road(t, top(s), 0.0, half + 1.5, 0.6)
        front = np.clip(bank - 0.7 * np.clip(reach - np.abs(s), 0, None), 0, None)
        hill = 0.03 * np.clip(t, 0, None)
        return np.where(np.abs(s) > reach, np.maximum(bank, hill), np.maximum(front, hill)), np.full(
            len(s), GROUND
        )

    slabs: list[Slab] = []
    _deck(slabs, -reach, reach, -half, half, top, 1.2, 1.1)
    _piers(slabs, top, reach, half, 15.0, 0.0)
    _cars(slabs, rng, -reach, reach, (1.8,), top, 20.0)
    for s, long, side, level in (
        (-52.0, 30.0, 2.5, height + 0.3), (-18.0, 22.0, 4.0, height - 0.4), (8.0, 40.0, 1.5, height + 0.05),
    ):  # fmt: skip
        slabs.append(
            Slab(s, s + long, half + side, half + side + 16, lambda a, h=level: h + 0 * a, level, BUILDING)
        )
        slabs.append(
            Slab(
                s + 4,
                s + 12,
                half + side + 6,
                half + side + 12,
                lambda a, h=level: h + 2.5 + 0 * a,
                2.5,
                OTHER,
            )
        )
    for s in np.arange(-55, 60, 28.0):
        slabs.append(
            Slab(s, s + 12, -half - 14, -half - 3.5, lambda a: height + 0.2 + 0 * a, height, BUILDING)
        )
    trees = [
        (
            s + rng.uniform(-2, 2),
            side * (half + rng.uniform(1.0, 2.5)),
            rng.uniform(2.5, 4.0),
            rng.uniform(8, 13),
        )
        for s in np.arange(-100, 100, 9.0)
        for side in (-1, 1)
        if rng.random() < 0.7
    ]
    return Scene(terrain, slabs, trees, turn, 240.0, 130.0, bend)


ROOF_SCENES = {"between gables": between_gables, "under crowns": under_crowns}
