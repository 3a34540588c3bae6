"""The bare ground of the town, its surfaces, and the plan drawn on it.

Town coordinates (u, v) are meters from the middle of the town along its two families of streets. Lines of constant v
are, in turn, a street, a railway bank, a street and a canal. All is a function of the seed and the place, so any
part of a town of any size is made on its own, and always the same.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..base.jit import device, njit

PITCH_U, PITCH_V = 58.0, 68.0  # from one street's axis to the next
FIRST_U, FIRST_V = 4.0, 26.0  # axes of line 0
BANK, CANAL = 1, 3  # what line j along u is: j % 4; the others are streets
ROW, COURT, VILLA, HALL, PARK = range(5)  # kinds of blocks
ROAD_HALF, KERB = 3.4, 0.12
WATER_HALF, CANAL_HALF, CANAL_DEPTH, QUAY_ROAD = 6.5, 8.0, 1.5, 11.0  # all quays lie at height 0
BANK_CREST, BANK_FOOT, BANK_HEIGHT = 3.5, 12.0, 5.0

_NAMES = "asphalt paving lawn soil stone water grass tile slate metal plaster brick leaf bark"
MATERIAL = {name: code for code, name in enumerate(_NAMES.split())}
#: Of the materials, at 1064 nm.
REFLECTANCE = np.array(
    [0.14, 0.28, 0.48, 0.3, 0.32, 0.04, 0.52, 0.33, 0.16, 0.5, 0.55, 0.36, 0.5, 0.3]
)
ASPHALT, PAVING, LAWN, SOIL, STONE, WATER, GRASS = range(7)


class Plan(NamedTuple):
    """What differs from town to town."""

    seed: int
    waves: np.ndarray  # (n, 4): height in meters, wave numbers along u and v in 1/m, phase
    shift: int  # of the pattern of blocks
    turn: (
        np.ndarray
    )  # (2, 2): meters east and north from the middle, times this, are town coordinates


def plan_town(seed: int) -> Plan:
    """The plan of a seed."""
    rng = np.random.default_rng([seed, 0x7031])
    angle, waves = math.radians(rng.uniform(5.0, 13.0)) * rng.choice([-1, 1]), []
    for length, height in ((1100, 5.0), (640, 3.0), (330, 2.2), (170, 2.0), (90, 0.4), (38, 0.1)):
        way, k = rng.uniform(0, 2 * math.pi), 2 * math.pi / (length * rng.uniform(0.85, 1.15))
        waves.append((height, k * math.cos(way), k * math.sin(way), rng.uniform(0, 2 * math.pi)))
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    return Plan(seed, np.array(waves), int(rng.integers(5)), turn)


@device
def block_at(u, v, plan):
    """Indices (i, j) of the block at a place, and its kind: every kind in turn, so that small towns hold all."""
    i, j = math.floor((u - FIRST_U) / PITCH_U), math.floor((v - FIRST_V) / PITCH_V)
    return i, j, (i + 2 * j + plan.shift) % 5


@device
def _from_line(value, first, every):
    """Distance to the nearest of the lines ``first + n * every``."""
    return abs(value - first - every * math.floor((value - first) / every + 0.5))


@device
def patches(u, v):
    """Smooth patches some ten meters wide: a number in [0, 1]."""
    a, b = u / 3.1 + 1.7 * math.sin(v / 7.3), v / 3.7 + 1.3 * math.sin(u / 5.9)
    return 0.5 + 0.25 * (math.sin(a) + math.sin(b))


@njit
def ground(u, v, plan):
    """Height of the bare ground (of water: its surface) and the material there; slopes are never above one."""
    z = 0.0
    for n in range(plan.waves.shape[0]):
        z += plan.waves[n, 0] * math.sin(
            plan.waves[n, 1] * u + plan.waves[n, 2] * v + plan.waves[n, 3]
        )
    canal = _from_line(v, FIRST_V + CANAL * PITCH_V, 4 * PITCH_V)
    t = min(max((canal - 15.0) / 95.0, 0.0), 1.0)
    z *= t * t * (3.0 - 2.0 * t)  # wide valleys, level near the quays
    if canal < CANAL_HALF:  # sloping stone, and water
        z = -CANAL_DEPTH * min((CANAL_HALF - canal) / (CANAL_HALF - WATER_HALF), 1.0)
        return z, (WATER if canal < WATER_HALF else STONE)
    bank = _from_line(v, FIRST_V + BANK * PITCH_V, 4 * PITCH_V)
    if bank < BANK_FOOT:
        z += BANK_HEIGHT * min((BANK_FOOT - bank) / (BANK_FOOT - BANK_CREST), 1.0)
        return z, (STONE if bank < BANK_CREST else LAWN)
    edge = min(_from_line(u, FIRST_U, PITCH_U), _from_line(v, FIRST_V, 2 * PITCH_V)) - ROAD_HALF
    edge = min(edge, abs(canal - QUAY_ROAD) - 2.6)
    z -= KERB * (1.0 - min(max(edge / 0.15, 0.0), 1.0))
    kind = block_at(u, v, plan)[2]
    if edge < 0.0 or (kind == HALL and canal > QUAY_ROAD):
        return z, ASPHALT
    if edge < 2.1 or canal < QUAY_ROAD or (kind == COURT and patches(u, v) > 0.45):
        return z, PAVING
    return z, (SOIL if kind == PARK else LAWN)


@njit
def heights(uv, plan):
    """Ground heights at many places (n, 2): (n,) float64."""
    z = np.empty(uv.shape[0])
    for n in range(z.size):
        z[n] = ground(uv[n, 0], uv[n, 1], plan)[0]
    return z
