"""The town's plan: a bent, rotated grid of streets, one canal and one railway bank in four, and its ground.

Town coordinates (u, v) run along the two families of streets; local coordinates (x, y) are metres
east and north of the town's south-west corner. Everything is a function of the seed and the place,
so any part of a town of any size is made on its own, and always the same.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..base.jit import njit
from .random import value_noise

PITCH_U, PITCH_V = 58.0, 68.0
STREET, CANAL, BANK = 0, 1, 2
ROW, COURT, PARK, VILLA, HALL, CHURCH, FIELD = range(7)
KINDS = 7

ROAD_HALF = 3.4  # carriageway; the kerb stands at its edge
KERB = 0.12
WATER_HALF = 6.5
WALL = 0.2  # plan width of a quay wall
QUAY_ROAD = 10.5  # the quay street's axis, from the canal's
BANK_HEIGHT, BANK_CREST, BANK_FOOT = 5.0, 3.5, 12.0
BANK_GAP = 5.5  # half width of the gap where a street passes through the railway bank
HILL_RADIUS = 62.0

# Surfaces, as ``ground`` reports them.
ROAD, WALKWAY, LAWN, WATER, QUAY, GRAVEL, PAVED, CROP, YARD = range(9)


class Ground(NamedTuple):
    """What the ground kernel needs, as arrays (passed whole into numba)."""

    frame: np.ndarray  # centre x, y, cos, sin, warp u (amplitude, wavenumber, phase), warp v, z0
    waves: np.ndarray  # (n, 4): amplitude, kx, ky, phase
    u_lines: np.ndarray
    v_lines: np.ndarray
    v_kind: np.ndarray
    v_level: np.ndarray  # water level of canals
    bridged: np.ndarray  # (nu, nv): whether street i crosses line j
    block: np.ndarray  # (nu, nv): kind of block
    hill: np.ndarray  # (nu, nv): height of the hill at the block's centre, 0 for none
    pond: np.ndarray  # (nu, nv, 4): u, v, radius (0 for none), level
    key: np.uint64


@njit
def to_uv(x, y, frame):
    """Local metres to town coordinates."""
    dx, dy = x - frame[0], y - frame[1]
    u0 = frame[2] * dx + frame[3] * dy
    v0 = -frame[3] * dx + frame[2] * dy
    u = u0 + frame[4] * math.sin(frame[5] * v0 + frame[6])
    v = v0 + frame[7] * math.sin(frame[8] * u0 + frame[9])
    return u, v


@njit
def to_xy(u, v, frame):
    """Town coordinates to local metres (the bend is gentle: a fixed point in a few steps)."""
    u0, v0 = u, v
    for _ in range(12):
        u0 = u - frame[4] * math.sin(frame[5] * v0 + frame[6])
        v0 = v - frame[7] * math.sin(frame[8] * u0 + frame[9])
    return frame[0] + frame[2] * u0 - frame[3] * v0, frame[1] + frame[3] * u0 + frame[2] * v0


@njit
def find_line(value, lines, pitch):
    """Index i with lines[i] <= value < lines[i + 1], kept inside the table."""
    i = math.floor((value - lines[0]) / pitch)
    i = min(max(i, 0), lines.size - 2)
    while i > 0 and value < lines[i]:
        i -= 1
    while i < lines.size - 2 and value >= lines[i + 1]:
        i += 1
    return i


@njit
def _ramp(value, low, high):
    t = min(max((value - low) / (high - low), 0.0), 1.0)
    return t * t * (3.0 - 2.0 * t)


@njit
def relief(x, y, u, v, i, j, g):
    """The land before anybody built on it: waves of several lengths and hills."""
    z = g.frame[10]
    for n in range(g.waves.shape[0]):
        z += g.waves[n, 0] * math.sin(g.waves[n, 1] * x + g.waves[n, 2] * y + g.waves[n, 3])
    for a in range(max(i - 1, 0), min(i + 2, g.u_lines.size - 1)):
        for b in range(max(j - 1, 0), min(j + 2, g.v_lines.size - 1)):
            if g.hill[a, b] != 0.0:
                du = u - 0.5 * (g.u_lines[a] + g.u_lines[a + 1])
                dv = v - 0.5 * (g.v_lines[b] + g.v_lines[b + 1])
                q = 1.0 - (du * du + dv * dv) / (HILL_RADIUS * HILL_RADIUS)
                if q > 0.0:
                    z += g.hill[a, b] * q * q
    return z


@njit
def ground(x, y, g):
    """Height of the bare ground (water: its surface) and the surface there.

    Parameters
    ----------
    x, y : float
        Local metres.
    g : Ground

    Returns
    -------
    z : float
    surface : int
    """
    u, v = to_uv(x, y, g.frame)
    i = find_line(u, g.u_lines, PITCH_U)
    j = find_line(v, g.v_lines, PITCH_V)
    z = relief(x, y, u, v, i, j, g)

    du_low, du_high = abs(u - g.u_lines[i]), abs(g.u_lines[i + 1] - u)
    du = min(du_low, du_high)
    street = i if du_low <= du_high else i + 1
    dv_low, dv_high = abs(v - g.v_lines[j]), abs(g.v_lines[j + 1] - v)
    dv = min(dv_low, dv_high)
    line = j if dv_low <= dv_high else j + 1
    kind = g.v_kind[line]

    # A canal lies in its own valley, with level banks.
    for n in (j, j + 1):
        if g.v_kind[n] == CANAL:
            w = 1.0 - _ramp(abs(v - g.v_lines[n]), 14.0, 54.0)
            z += w * (g.v_level[n] + 1.5 - z)

    pond_u, pond_v, radius, level = g.pond[i, j, 0], g.pond[i, j, 1], g.pond[i, j, 2], g.pond[i, j, 3]
    if radius > 0.0:
        r = math.sqrt((u - pond_u) ** 2 + 1.6 * (v - pond_v) ** 2)
        r += 1.2 * math.sin(3.0 * math.atan2(v - pond_v, u - pond_u) + pond_u)
        if r < radius:
            return level, WATER
        w = 1.0 - _ramp(r, radius, radius + 7.0)
        z += w * (level + 0.35 * min((r - radius) / 1.5, 1.0) - z)

    bank = 0.0
    if kind == BANK:
        bank = 1.0 - min(max((dv - BANK_CREST) / (BANK_FOOT - BANK_CREST), 0.0), 1.0)
        bank *= min(max((du - BANK_GAP) / 0.4, 0.0), 1.0)
        z += BANK_HEIGHT * bank

    edge_u = du - ROAD_HALF
    edge_v = 99.0
    if kind == STREET:
        edge_v = dv - ROAD_HALF
    elif kind == CANAL:
        edge_v = abs(dv - QUAY_ROAD) - 2.6
        if dv < QUAY_ROAD and (dv < WATER_HALF + 0.6 or g.bridged[street, line] == 0):
            edge_u = 99.0  # a street without a bridge ends at the quay
    elif bank > 0.0:
        edge_u = 99.0
    edge = min(edge_u, edge_v)
    z -= KERB * (1.0 - min(max(edge / 0.08, 0.0), 1.0))

    if kind == CANAL:
        if dv < WATER_HALF:
            return g.v_level[line], WATER
        if dv < WATER_HALF + WALL:
            return g.v_level[line] + (z - g.v_level[line]) * (dv - WATER_HALF) / WALL, QUAY
        if dv < QUAY_ROAD:
            return z, (ROAD if edge < 0.0 else PAVED)
    if kind == BANK and dv < BANK_FOOT and bank > 0.0:
        if du < BANK_GAP + 0.4:
            return z, QUAY
        return z, (GRAVEL if dv < BANK_CREST else LAWN)
    if edge < 0.0:
        return z, ROAD
    if edge < 2.1:
        return z, WALKWAY
    what = g.block[i, j]
    if what == CHURCH:
        return z, PAVED
    if what == HALL:
        return z, YARD
    if what == FIELD:
        return z, CROP
    if what == COURT:
        return z, (PAVED if value_noise(x / 9.0, y / 9.0, g.key) > 0.45 else LAWN)
    return z, LAWN


@njit
def ground_many(x, y, g):
    """Ground heights at many places: (n,) float64."""
    z = np.empty(x.size)
    for n in range(x.size):
        z[n] = ground(x[n], y[n], g)[0]
    return z


class Plan:
    """Streets, blocks and ground of one town.

    Parameters
    ----------
    size : float
        Side of the town's square in metres.
    seed : int
    elevation : float
        Mean height of the ground.
    """

    def __init__(self, size: float, seed: int, elevation: float = 60.0) -> None:
        self.size, self.seed = float(size), int(seed)
        rng = np.random.default_rng([seed, 0x7031])
        turn = math.radians(rng.uniform(5.0, 13.0)) * (1 if seed % 2 else -1)
        frame = np.array(
            [
                size / 2,
                size / 2,
                math.cos(turn),
                math.sin(turn),
                rng.uniform(4, 6),
                2 * math.pi / rng.uniform(320, 420),
                rng.uniform(0, 2 * math.pi),
                rng.uniform(3, 5),
                2 * math.pi / rng.uniform(300, 400),
                rng.uniform(0, 2 * math.pi),
                elevation,
            ]
        )
        # The bend must not move the middle of a small town away from its canal.
        frame[6] = 0.0 if rng.random() < 0.5 else math.pi
        frame[9] = 0.0 if rng.random() < 0.5 else math.pi
        waves = []
        for length, height in ((1100, 5.0), (640, 3.0), (330, 2.2), (170, 1.0), (90, 0.35), (38, 0.08)):
            for _ in range(2):
                a = rng.uniform(0, 2 * math.pi)
                k = 2 * math.pi / (length * rng.uniform(0.85, 1.15))
                waves.append((0.7 * height, k * math.cos(a), k * math.sin(a), rng.uniform(0, 2 * math.pi)))
        reach = size * 0.75 + 260.0
        self.first_u, self.first_v = -math.ceil(reach / PITCH_U), -math.ceil(reach / PITCH_V)
        nu, nv = 2 - 2 * self.first_u, 2 - 2 * self.first_v
        index_u, index_v = np.arange(nu) + self.first_u, np.arange(nv) + self.first_v
        jitter = np.random.default_rng([seed, 0x7032])
        u_lines = PITCH_U * index_u + 4.0 + jitter.uniform(-3, 3, nu)
        v_lines = PITCH_V * index_v + 26.0 + jitter.uniform(-2, 2, nv)
        v_kind = np.array([STREET, BANK, STREET, CANAL], dtype=np.int64)[index_v % 4]
        phase = int(rng.integers(KINDS))
        # Near the middle every kind in turn, so that small towns have all; farther out mostly by chance.
        block = (index_u[:, None] + 3 * index_v[None, :] + phase) % KINDS
        chance = np.random.default_rng([seed, 0x7036])
        other = chance.choice(KINDS, (nu, nv), p=[0.22, 0.16, 0.14, 0.22, 0.11, 0.03, 0.12])
        far = (np.abs(index_u + 0.5)[:, None] > 3) | (np.abs(index_v + 0.5)[None, :] > 3)
        block = np.where(far & (chance.random((nu, nv)) < 0.8), other, block)
        self.ground = Ground(
            frame,
            np.array(waves),
            u_lines,
            v_lines,
            v_kind,
            np.zeros(nv),
            np.zeros((nu, nv), dtype=np.uint8),
            block.astype(np.int64),
            np.zeros((nu, nv)),
            np.zeros((nu, nv, 4)),
            np.uint64(seed * 7919 + 17),
        )
        g = self.ground
        hills = np.random.default_rng([seed, 0x7033])
        wide = (index_u[:, None] % 4 == 3) & (index_v[None, :] % 4 == 0)
        g.hill[wide] = hills.uniform(6.5, 9.5, int(wide.sum()))
        bridges = np.random.default_rng([seed, 0x7034]).random((nu, nv)) < 0.6
        bridges[(index_u % 3 == 0), :] = True
        g.bridged[bridges & (v_kind == CANAL)[None, :]] = 1
        g.bridged[:, v_kind == BANK] = 1
        for j in np.flatnonzero(
            v_kind == CANAL
        ).tolist():  # the level of the land along it, middle part first
            along = np.linspace(-min(size, 600.0) / 2, min(size, 600.0) / 2, 41)
            xy = np.array([to_xy(a, v_lines[j], frame) for a in along])
            g.v_level[j] = np.percentile(self._bare(xy[:, 0], xy[:, 1]), 30) - 2.0
        ponds = np.random.default_rng([seed, 0x7035])
        for i in range(nu - 1):
            for j in range(nv - 1):
                radius, du, dv = ponds.uniform(6.0, 9.0), *ponds.uniform(-4, 4, 2)
                if block[i, j] != PARK:
                    continue
                u = 0.5 * (u_lines[i] + u_lines[i + 1]) + du
                v = 0.5 * (v_lines[j] + v_lines[j + 1]) + dv
                x, y = to_xy(u, v, frame)
                g.pond[i, j] = u, v, radius, self.height(x, y) - 0.9
        # The ponds above were placed one after another: the ground of each depends on none of the others.

    def _bare(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        g = self.ground
        z = np.full(x.shape, g.frame[10])
        for height, kx, ky, phase in g.waves:
            z += height * np.sin(kx * x + ky * y + phase)
        return z

    def height(self, x: float, y: float) -> float:
        """Ground height at one place, local metres."""
        return float(ground(x, y, self.ground)[0])

    def heights(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Ground heights at many places, local metres."""
        return ground_many(
            np.ascontiguousarray(x, dtype=np.float64), np.ascontiguousarray(y, dtype=np.float64), self.ground
        )

    def place(self, u: float, v: float) -> tuple[float, float, float]:
        """Local x, y of town coordinates, and the direction of growing u there (radians)."""
        frame = self.ground.frame
        x, y = to_xy(u, v, frame)
        x2, y2 = to_xy(u + 0.5, v, frame)
        return x, y, math.atan2(y2 - y, x2 - x)

    def blocks_in(self, x0: float, y0: float, x1: float, y1: float, margin: float) -> list[tuple[int, int]]:
        """Indices (i, j) of the blocks that may touch a rectangle of local metres."""
        g = self.ground
        corners = [to_uv(x, y, g.frame) for x in np.linspace(x0, x1, 5) for y in np.linspace(y0, y1, 5)]
        u, v = np.array(corners).T
        i0 = find_line(u.min() - margin, g.u_lines, PITCH_U)
        i1 = find_line(u.max() + margin, g.u_lines, PITCH_U)
        j0 = find_line(v.min() - margin, g.v_lines, PITCH_V)
        j1 = find_line(v.max() + margin, g.v_lines, PITCH_V)
        return [(i, j) for i in range(i0, i1 + 1) for j in range(j0, j1 + 1)]
