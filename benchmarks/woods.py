"""Closed woods on slopes, where few points reach the ground: what noise.py and terrain.py are tried
on."""

from __future__ import annotations

import numpy as np


def closed_wood(
    slope: float, density: float, seen: float, seed: int, side: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A square of woods and meadows, `side` m wide, on a slope that faces any way: coordinates,
    which points are ground, and which lie in the woods, of whose points about a share `seen` is
    ground, more in some cells of 6 m than in others."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, side, (2, int(side * side * density)))
    turn = np.array([np.cos(0.5 * seed), np.sin(0.5 * seed)])
    up, across = turn[0] * x + turn[1] * y, turn[0] * y - turn[1] * x
    z = slope * up + 2 * np.sin(up / 19 + seed) * np.cos(across / 23) + rng.normal(0, 0.04, len(x))
    wood = np.sin(x / 37 + seed) * np.cos(y / 31 + 2 * seed) > -0.3
    cells = (int(side / 6) + 1,) * 2
    gaps, crowns = rng.beta(1.2, 1.2, cells), rng.uniform(12, 26, cells)
    at = (y / 6).astype(int), (x / 6).astype(int)
    hit = wood & (rng.random(len(x)) > 2 * seen * gaps[at])
    share = np.where(rng.random(len(x)) < 0.85, rng.beta(5, 1.3, len(x)), rng.random(len(x)))
    return np.column_stack([x, y, z + np.where(hit, crowns[at] * share, 0)]), ~hit, wood
