"""As simple simulators make bridges: beams straight down, no flanks, no parapets, the ground below a deck seen or not."""

from __future__ import annotations

import numpy as np
from bridge_scenes import DECK, GROUND, LEAF, WATER


def upright(
    density=16.0, seed=0, reach=100.0, half=6.0, high=8.0, bank=16.0, raised=False, wet=None, below=True
):
    """A deck over a valley of such banks (0: upright ones), or `raised` on banks above a plain; points and true classes.

    With `wet` there is water between the banks, and it is its share that answers.
    """
    rng = np.random.default_rng(seed)
    long, wide = 2 * reach + 100.0, 120.0
    s, t = rng.uniform((-long / 2, -wide / 2), (long / 2, wide / 2), (int(density * long * wide), 2)).T
    over = np.clip(reach - np.abs(s), 0, None)
    rise = np.minimum(over * high / bank, high) if bank else high * (over > 0)
    ground = np.clip(high - rise - 0.6 * np.clip(np.abs(t) - half - 1, 0, None), 0, None) if raised else -rise
    top = np.full(len(s), high if raised else 0.0)
    code = np.full(len(s), GROUND)
    deck = (np.abs(s) < reach) & (np.abs(t) < half)
    seen = ~deck | below
    if wet is not None:
        water = over > bank
        code[water] = WATER
        seen &= ~water | (rng.random(len(s)) < wet)
    ground = ground + 0.04 * np.sin(s / 7) * np.cos(t / 9)
    xyz = [np.column_stack([s, t, ground])[seen], np.column_stack([s, t, top])[deck]]
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


UPRIGHT_SCENES = {
    "valley, ground below the deck": upright,
    "on banks, ground below the deck": lambda density=16.0: upright(density, raised=True),
    "river, ground below the deck": lambda density=16.0: upright(density, bank=10.0, wet=1.0),
    "upright banks, ground below the deck": lambda density=16.0: upright(density, bank=0.0),
    "600 m, ground below the deck": lambda density=16.0: upright(density, reach=300.0, bank=16.0),
    "5 m above a river without returns": lambda density=16.0: upright(
        density, high=5.0, bank=10.0, wet=0.0, below=False
    ),
}
