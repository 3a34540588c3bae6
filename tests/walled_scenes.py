"""Roads on banks between upright walls: the ramps before a bridge, and one that leads to no bridge; their walls are seen."""

from __future__ import annotations

import numpy as np
from bridge_scenes import GROUND, OTHER, Scene, Slab, _cars, _deck
from long_bridge_scenes import _piers


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


def walled_road(seed=0, turn=0.6):
    """A road that rises to 6 m between upright walls, and falls again."""
    top = _profile(20.0, 6.0, 0.06)
    slabs: list[Slab] = []
    _massive(slabs, -120, 120, 4.5, top, 6.0)
    return Scene(_flat, slabs, [], turn, 300.0, 110.0)
