"""The bare ground of the town, its materials, and the plan of its streets and blocks.

Town coordinates (u, v) are meters from the middle of the town along its two families of streets.
Lines of constant v are, in turn, a street, a railway bank, a street and a canal. Everything is a
function of the seed and the place, so any part of a town of any size is made on its own, and
always the same.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..base.jit import device, njit

# Meters.
PITCH_U = 58.0  #: from the axis of a street along v to the next
PITCH_V = 68.0  #: from the axis of a line along u to the next
FIRST_U = 4.0  #: axis of street 0
FIRST_V = 26.0  #: axis of line 0
ROAD_HALF = 3.4  #: half the width of a road
KERB = 0.12  #: height of pavements above the road
WATER_HALF = 6.5  #: half the width of the canal's water
CANAL_HALF = 8.0  #: half the width of the canal with its sloping walls
#: Of the water below the quays, which all lie at height 0. At most the width of a wall,
#: CANAL_HALF - WATER_HALF: rays find ground whose slope is at most one.
CANAL_DEPTH = 1.5
QUAY_ROAD = 11.0  #: from the canal's axis to the axis of the roads beside it
BANK_CREST = 3.5  #: half the width of the railway bank's top
BANK_FOOT = 12.0  #: half the width of its foot
BANK_HEIGHT = 5.0

# Kinds of lines along u: line j is of kind j % 4; kinds 0 and 2 are streets.
RAILWAY = 1  #: on a bank
CANAL = 3
# Kinds of blocks.
ROWS = 0  #: terraced houses
COURT = 1  #: a closed block around a courtyard
VILLAS = 2
HALL = 3
PARK = 4
KINDS = 5  #: number of kinds

#: Materials and their reflectance, as if at 1064 nm: not measured, and from no source.
REFLECTANCES = {
    "asphalt": 0.14, "paving": 0.28, "lawn": 0.48, "soil": 0.3, "stone": 0.32, "water": 0.04,
    "grass": 0.52, "tile": 0.33, "slate": 0.16, "metal": 0.5, "plaster": 0.55, "brick": 0.36,
    "leaf": 0.5, "bark": 0.3,
}  # fmt: skip
MATERIAL = {name: code for code, name in enumerate(REFLECTANCES)}
REFLECTANCE = np.array([*REFLECTANCES.values()])
ASPHALT = MATERIAL["asphalt"]
PAVING = MATERIAL["paving"]
LAWN = MATERIAL["lawn"]
SOIL = MATERIAL["soil"]
STONE = MATERIAL["stone"]
WATER = MATERIAL["water"]
GRASS = MATERIAL["grass"]


class Plan(NamedTuple):
    """Properties of one town."""

    seed: int
    waves: np.ndarray  #: (n, 4) height in meters, wave numbers along u and v in 1/m, phase
    shift: int  #: of the pattern of blocks
    turn: np.ndarray  #: (2, 2) from meters east and north of the middle to town coordinates


def plan_town(seed: int) -> Plan:
    """Return the plan of a seed."""
    rng = np.random.default_rng([seed, 0x7031])
    angle, waves = math.radians(rng.uniform(5.0, 13.0)) * rng.choice([-1, 1]), []
    for length, height in ((1100, 5.0), (640, 3.0), (330, 2.2), (170, 2.0), (90, 0.4), (38, 0.1)):
        angle_uv, k = rng.uniform(0, 2 * math.pi), 2 * math.pi / (length * rng.uniform(0.85, 1.15))
        phase = rng.uniform(0, 2 * math.pi)
        waves.append((height, k * math.cos(angle_uv), k * math.sin(angle_uv), phase))
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    return Plan(seed, np.array(waves), int(rng.integers(5)), turn)


@device
def block_at(u, v, plan):
    """Return indices (i, j) and kind of the block at a place; kinds alternate, so all are near."""
    i, j = math.floor((u - FIRST_U) / PITCH_U), math.floor((v - FIRST_V) / PITCH_V)
    return i, j, (i + 2 * j + plan.shift) % KINDS


@device
def _from_line(value, first, every):
    """Return the distance to the nearest of the lines ``first + n * every``."""
    return abs(value - first - every * math.floor((value - first) / every + 0.5))


@device
def smooth_noise(u, v):
    """Return a number in [0, 1] that changes smoothly within some ten meters."""
    a, b = u / 3.1 + 1.7 * math.sin(v / 7.3), v / 3.7 + 1.3 * math.sin(u / 5.9)
    return 0.5 + 0.25 * (math.sin(a) + math.sin(b))


@njit
def ground(u, v, plan):
    """Return height of the bare ground (or water) and its material; slopes are at most one."""
    z = 0.0
    for n in range(plan.waves.shape[0]):
        height, along_u, along_v, phase = plan.waves[n]
        z += height * math.sin(along_u * u + along_v * v + phase)
    canal = _from_line(v, FIRST_V + CANAL * PITCH_V, 4 * PITCH_V)
    t = min(max((canal - 15.0) / 95.0, 0.0), 1.0)
    z *= t * t * (3.0 - 2.0 * t)  # wide valleys, level near the quays
    if canal < CANAL_HALF:  # sloping stone, and water
        z = -CANAL_DEPTH * min((CANAL_HALF - canal) / (CANAL_HALF - WATER_HALF), 1.0)
        return z, (WATER if canal < WATER_HALF else STONE)
    bank = _from_line(v, FIRST_V + RAILWAY * PITCH_V, 4 * PITCH_V)
    if bank < BANK_FOOT:
        z += BANK_HEIGHT * min((BANK_FOOT - bank) / (BANK_FOOT - BANK_CREST), 1.0)
        return z, (STONE if bank < BANK_CREST else LAWN)
    edge = min(_from_line(u, FIRST_U, PITCH_U), _from_line(v, FIRST_V, 2 * PITCH_V)) - ROAD_HALF
    edge = min(edge, abs(canal - QUAY_ROAD) - 2.6)
    z -= KERB * (1.0 - min(max(edge / 0.15, 0.0), 1.0))
    kind = block_at(u, v, plan)[2]
    if edge < 0.0 or (kind == HALL and canal > QUAY_ROAD):
        return z, ASPHALT
    if edge < 2.1 or canal < QUAY_ROAD or (kind == COURT and smooth_noise(u, v) > 0.45):
        return z, PAVING
    return z, (SOIL if kind == PARK else LAWN)


@njit
def heights(uv, plan):
    """Return ground heights (n,) float64 at places (n, 2)."""
    z = np.empty(uv.shape[0])
    for n in range(z.size):
        z[n] = ground(uv[n, 0], uv[n, 1], plan)[0]
    return z
