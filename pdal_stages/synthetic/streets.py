"""What stands along streets, canals and railway banks: cars, lamps, poles and wires, bridges."""

from __future__ import annotations

import itertools
import math

import numpy as np

from . import plants
from .block import Block
from .buildings import POLE, beside, box, car, lamp, pylon
from .plan import BANK, BANK_CREST, BANK_FOOT, BANK_GAP, BANK_HEIGHT, CANAL, PITCH_U, STREET, WATER_HALF
from .scene import Parts

WIRE, BRIDGE = 14, 17
WIRE_RADIUS = 0.03  # what a sub-beam feels of a conductor
HIGH_LINE_AT = 18.0  # the high-voltage line keeps this far below the railway bank's axis
HIGH_ARMS = ((16.5, 4.2), (20.5, 3.2))


def _cable(parts: Parts, a, b, sag: float, pieces: int, only: range | None = None) -> None:
    """A conductor from a to b, hanging by `sag` metres in the middle (a parabola)."""
    a, b = np.asarray(a), np.asarray(b)
    share = np.linspace(0, 1, pieces + 1)
    points = a + share[:, None] * (b - a)
    points[:, 2] -= 4 * sag * share * (1 - share)
    for n in only if only is not None else range(pieces):
        parts.rod(tuple(points[n]), tuple(points[n + 1]), WIRE_RADIUS, WIRE, "cable")


def _poles(k: Block, stations: list[tuple[float, float]], next_station: tuple[float, float], across) -> None:
    """Wooden poles with three conductors, on to the next segment's first pole."""
    plan, tops = k.plan, []
    for n, (u, v) in enumerate([*stations, next_station]):
        x, y, angle = plan.place(u, v)
        z = plan.height(x, y)
        if n < len(stations):
            k.parts.rod((x, y, z), (x, y, z + 8.6), 0.13, POLE, "bark")
        tops.append((x, y, z + 8.4, angle + across))
    for a, b in itertools.pairwise(tops):
        for off in (-0.6, 0.0, 0.6):
            p = (*beside(a[0], a[1], a[3], 0, off), a[2])
            q = (*beside(b[0], b[1], b[3], 0, off), b[2])
            _cable(k.parts, p, q, 0.02 * math.dist(p, q), 6)


def fill_streets(k: Block) -> None:
    """The street on the block's low-u side and the line on its low-v side."""
    g, plan, rng, i, j = k.plan.ground, k.plan, k.rng, k.i, k.j
    u0, u1, v0, v1 = g.u_lines[i], g.u_lines[i + 1], g.v_lines[j], g.v_lines[j + 1]
    kind = int(g.v_kind[j])
    quiet = {STREET: 8.0, CANAL: 15.0, BANK: 14.0}
    begin, end = v0 + quiet[kind], v1 - quiet[int(g.v_kind[j + 1])]
    for side in (-1, 1):
        for v in np.arange(begin, end - 3, 6.0):
            if rng.random() < 0.45:
                x, y, angle = plan.place(u0 + side * 2.3, v + rng.uniform(0, 1))
                car(k.parts, plan, rng, x, y, angle + math.pi / 2)
    if (i + plan.first_u) % 2:
        step = (end - begin) / 2
        _poles(
            k,
            [(u0 + 4.9, begin + n * step) for n in range(2)] + [(u0 + 4.9, end)],
            (u0 + 4.9, v1 + quiet[int(g.v_kind[j + 1])]),
            math.pi / 2,
        )
    else:
        for v in np.arange(begin + 3, end, 22.0):
            x, y, angle = plan.place(u0 - 4.4, v)
            lamp(k.parts, plan, x, y, angle)
        for v in np.arange(begin, end, 9.0):
            if rng.random() < 0.55:
                k2 = plan.place(u0 + 4.6, v)
                plants.broadleaf(k.parts, plan, rng, k2[0], k2[1], rng.uniform(5, 9))
    for _ in range(3):  # bins, boxes, signs
        x, y, angle = plan.place(u0 + rng.choice([-4.6, 4.4]), rng.uniform(begin, end))
        box(k.parts, plan, x, y, angle, 0.4, 0.35, rng.uniform(0.8, 1.4), "steel")
    if kind == STREET:
        _street_v(k, u0, u1, v0)
    elif kind == CANAL:
        _canal(k, u0, u1, v0)
    else:
        _bank(k, u0, u1, v0)
    if int(g.v_kind[j + 1]) == BANK:
        _high_line(k)


def _street_v(k: Block, u0, u1, v0) -> None:
    plan, rng = k.plan, k.rng
    for side in (-1, 1):
        for u in np.arange(u0 + 8, u1 - 9, 6.0):
            if rng.random() < 0.4:
                x, y, angle = plan.place(u + rng.uniform(0, 1), v0 + side * 2.3)
                car(k.parts, plan, rng, x, y, angle)
    step = (u1 - u0 - 14) / 2
    _poles(k, [(u0 + 7 + n * step, v0 - 4.9) for n in range(3)], (u1 + 7, v0 - 4.9), 0.0)


def _canal(k: Block, u0, u1, v0) -> None:
    """Quays with trees, lamps and cars, barges, and the bridge of the street."""
    plan, rng, g = k.plan, k.rng, k.plan.ground
    for side in (-1, 1):
        for u in np.arange(u0 + 9, u1 - 9, 8.0):
            x, y, angle = plan.place(u, v0 + side * 7.4)
            if rng.random() < 0.5:
                plants.broadleaf(k.parts, plan, rng, x, y, rng.uniform(6, 10))
            elif rng.random() < 0.4:
                lamp(k.parts, plan, x, y, angle - side * math.pi / 2, 6.0)
        for u in np.arange(u0 + 9, u1 - 9, 6.0):
            if rng.random() < 0.4:
                x, y, angle = plan.place(u, v0 + side * 9.3)
                car(k.parts, plan, rng, x, y, angle)
    level = g.v_level[k.j]
    if rng.random() < 0.7:
        x, y, angle = plan.place(u0 + rng.uniform(18, 38), v0 + rng.choice([-4.4, 4.4]))
        k.parts.prism(x, y, angle, rng.uniform(5, 9), 1.6, level - 0.3, level + 0.9, 1, "metal", "metal")
        k.parts.prism(x, y, angle, 3.2, 1.2, level, level + 2.0, 1, "bark", "paint")
    if g.bridged[k.i, k.j]:
        x, y, angle = plan.place(u0, v0)
        ends = [plan.place(u0, v0 + s * (WATER_HALF + 1.2))[:2] for s in (-1, 1)]
        top = sum(plan.height(*p) for p in ends) / 2
        half = WATER_HALF + 0.35
        k.parts.prism(x, y, angle + math.pi / 2, half, 5.0, top - 0.7, top, BRIDGE, "asphalt", "concrete")
        for side in (-1, 1):
            at = beside(x, y, angle + math.pi / 2, 0, side * 4.85)
            k.parts.prism(*at, angle + math.pi / 2, half, 0.15, top, top + 1.0, BRIDGE, "stone", "stone")


def _bank(k: Block, u0, u1, v0) -> None:
    """The railway on its bank: bridge over the street, masts and contact wire."""
    plan, rng = k.plan, k.rng
    x, y, angle = plan.place(u0, v0)
    sides = [plan.place(u0 + s * (BANK_GAP + 0.6), v0)[:2] for s in (-1, 1)]
    crest = [plan.height(*p) for p in sides]
    top, slope = sum(crest) / 2, BANK_HEIGHT / (BANK_FOOT - BANK_CREST)
    k.parts.prism(x, y, angle, BANK_GAP + 0.45, BANK_CREST, top - 0.9, top, BRIDGE, "gravel", "concrete")
    for s, z in zip((-1, 1), crest, strict=True):  # abutments stand before the cut bank
        at = beside(x, y, angle, s * (BANK_GAP + 0.2), 0)
        cuts = [(0.0, q * slope, 1.0, z + slope * BANK_CREST) for q in (-1, 1)]
        k.parts.prism(
            *at,
            angle,
            0.25,
            BANK_FOOT,
            z - BANK_HEIGHT - 1,
            z + 0.02,
            BRIDGE,
            "concrete",
            "concrete",
            cuts=cuts,
        )
    stations = [(u0 + 9.0, v0), ((u0 + u1) / 2, v0), (u1 - 9.0, v0), (u1 + 9.0, v0)]
    tops = []
    for n, (u, v) in enumerate(stations):
        px, py, turn = plan.place(u, v)
        z = plan.height(px, py)
        mast = beside(px, py, turn, 0, 3.0)
        if n < 3:
            k.parts.rod((*mast, z), (*mast, z + 7.2), 0.13, POLE, "steel")
            k.parts.rod((*mast, z + 6.6), (px, py, z + 6.8), 0.07, POLE, "steel")
        tops.append((px, py, z))
    for a, b in itertools.pairwise(tops):
        for up, sag in ((5.4, 0.05), (6.8, 0.5)):
            _cable(k.parts, (a[0], a[1], a[2] + up), (b[0], b[1], b[2] + up), sag, 4)
    for s in (-1, 1):
        for u in np.arange(u0 + 9, u1 - 9, 5.0):
            if rng.random() < 0.5:
                px, py, _ = plan.place(u, v0 + s * rng.uniform(5, 11))
                plants.shrub(k.parts, plan, rng, px, py, rng.uniform(0.4, 2.4))


def _high_line(k: Block) -> None:
    """High-voltage line below the railway: a tower in every other block, this block's part of the spans."""
    plan, g = k.plan, k.plan.ground
    v = g.v_lines[k.j + 1] - HIGH_LINE_AT

    def tower(i):
        i = min(max(i, 0), g.u_lines.size - 2)
        x, y, angle = plan.place(g.u_lines[i] + PITCH_U / 2, v)
        return x, y, plan.height(x, y), angle

    def spans(i, only):
        a, b = tower(i), tower(i + 2)
        for up, half in HIGH_ARMS:
            for off in (-half, half) if up > HIGH_ARMS[0][0] else (-half, -0.5 * half, 0.5 * half, half):
                p = (*beside(a[0], a[1], a[3], 0, off), a[2] + up - 0.6)
                q = (*beside(b[0], b[1], b[3], 0, off), b[2] + up - 0.6)
                _cable(k.parts, p, q, 2.2, 12, only)

    if (k.i + plan.first_u) % 2 == 0:
        x, y, z, angle = tower(k.i)
        pylon(k.parts, x, y, z, angle, HIGH_ARMS, 23.0)
        spans(k.i, range(0, 3))
        spans(k.i - 2, range(9, 12))
    else:
        spans(k.i - 1, range(3, 9))
