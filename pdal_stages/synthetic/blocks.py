"""What stands in each block of the town and along its streets, canals and railway banks."""

from __future__ import annotations

import math
import threading
from collections import OrderedDict

import numpy as np

from . import plants
from .buildings import BUILDING, POLE, beside, box, car, church, fence, house, lamp, pylon
from .plan import (
    BANK, BANK_CREST, BANK_FOOT, BANK_GAP, BANK_HEIGHT, CANAL, CHURCH, COURT, FIELD, HALL, PARK, PITCH_U,
    ROW, STREET, VILLA, WATER_HALF, Plan,
)  # fmt: skip
from .scene import Parts

WIRE, BRIDGE = 14, 17
WIRE_RADIUS = 0.05  # what a sub-beam feels of a conductor
HIGH_LINE_AT = 18.0  # the high-voltage line keeps this far below the railway bank's axis
HIGH_ARMS = ((16.5, 4.2), (20.5, 3.2))


class Block:
    """One block: places inside it are given in metres from its inner low corner, along u and v."""

    def __init__(self, plan: Plan, i: int, j: int) -> None:
        self.plan, self.i, self.j = plan, i, j
        g = plan.ground
        self.rng = np.random.default_rng([plan.seed, 0xB10C, i - 2 * plan.first_u, j - 2 * plan.first_v])
        self.parts = Parts()
        low = {STREET: 6.2, CANAL: 15.0, BANK: 14.0}
        high = {STREET: 6.2, CANAL: 15.0, BANK: 25.0}
        self.u0, self.v0 = g.u_lines[i] + 6.2, g.v_lines[j] + low[int(g.v_kind[j])]
        self.width = g.u_lines[i + 1] - 6.2 - self.u0
        self.depth = g.v_lines[j + 1] - high[int(g.v_kind[j + 1])] - self.v0

    def at(self, a: float, b: float) -> tuple[float, float, float]:
        """Local x, y and direction of u, of a place in the block."""
        return self.plan.place(self.u0 + a, self.v0 + b)

    # Short forms: things at (a, b), turned by `turn` against the block.
    def house(self, a, b, turn, *args, **options):
        x, y, angle = self.at(a, b)
        return house(self.parts, self.plan, self.rng, x, y, angle + turn, *args, **options)

    def plant(self, what, a, b, *args):
        x, y, _ = self.at(a, b)
        what(self.parts, self.plan, self.rng, x, y, *args)

    def line(self, what, a0, b0, a1, b1, *args, **options):
        x0, y0, _ = self.at(a0, b0)
        x1, y1, _ = self.at(a1, b1)
        angle, length = math.atan2(y1 - y0, x1 - x0), math.hypot(x1 - x0, y1 - y0)
        if what is plants.hedge:
            what(self.parts, self.plan, self.rng, x0, y0, angle, length, *args, **options)
        else:
            what(self.parts, self.plan, x0, y0, angle, length, *args, **options)

    def car(self, a, b, turn=0.0):
        x, y, angle = self.at(a, b)
        car(self.parts, self.plan, self.rng, x, y, angle + turn)

    def box(self, a, b, turn, *args, **options):
        x, y, angle = self.at(a, b)
        box(self.parts, self.plan, x, y, angle + turn, *args, **options)


def _row(k: Block) -> None:
    """Two rows of terraced houses, gardens with hedges, sheds and trees between them."""
    rng, w, d = k.rng, k.width, k.depth
    for side in (0, 1):
        # One row shares eaves and roof; the gaps between rows let the gardens be seen.
        a = rng.uniform(0.5, 2.0)
        deep = rng.uniform(4.2, 5.0)
        eave, pitch = rng.uniform(4.8, 7.5), rng.uniform(0.65, 1.1)
        roof = rng.choice(["gable", "gable", "mansard", "halfhip"])
        b = deep + 2.2 if side == 0 else d - deep - 2.2
        while a + 14 < w:
            length = min(rng.uniform(14, 24), w - a - 0.5)
            k.house(
                a + length / 2, b, 0.0, length / 2, deep, eave, roof, pitch,
                wall=rng.choice(["brick", "plaster"]), cover=rng.choice(["tile", "slate"]),
                overhang=rng.uniform(0.2, 0.6), dormers=int(length // 6) if rng.random() < 0.6 else 0,
                chimneys=int(length // 6),
            )  # fmt: skip
            a += length + rng.uniform(2.5, 4.5)
        front = 0.4 if side == 0 else d - 0.4
        for a in np.arange(0.5, w - 6, 7.0):
            if rng.random() < 0.6:
                k.line(plants.hedge, a, front, a + 5, front, rng.uniform(0.45, 1.3), half=0.3)
    middle, reach = d / 2, d / 2 - 2 * 5.0 - 2.5
    if reach > 1.0:
        for a in np.arange(1.0, w - 1, 7.0):
            if rng.random() < 0.5:
                k.line(plants.hedge, a, middle - reach, a, middle + reach, rng.uniform(1.0, 2.0))
            else:
                k.line(fence, a, middle - reach, a, middle + reach, rng.uniform(1.2, 1.8))
            here = rng.random()
            if here < 0.4:
                k.plant(plants.tree, a + 3.5, middle + rng.uniform(-1, 1) * reach, 4, 9)
            elif here < 0.7:
                k.house(a + 3.5, middle + rng.uniform(-0.5, 0.5) * reach, 0, 1.5, 1.2, 2.1, "shed", 0.25,
                        wall="brick", cover="slate", overhang=0.15, chimneys=0)  # fmt: skip
            for _ in range(int(rng.integers(1, 4))):
                k.plant(plants.shrub, a + rng.uniform(1, 6), middle + rng.uniform(-1, 1) * reach,
                        rng.uniform(0.4, 1.8))  # fmt: skip


def _court(k: Block) -> None:
    """A closed block around a courtyard, with a gateway, bays and a tree or two inside."""
    rng, w, d = k.rng, k.width, k.depth
    half = rng.uniform(4.6, 5.6)
    eave = rng.uniform(9, 15)
    roof = rng.choice(["gable", "mansard", "flat"])
    pitch = rng.uniform(0.55, 0.9)
    for turn, a, b, length in (
        (0.0, w / 2, half, w / 2), (0.0, w / 2, d - half, w / 2),
        (math.pi / 2, half, d / 2, d / 2 - 2 * half), (math.pi / 2, w - half, d / 2, d / 2 - 2 * half),
    ):  # fmt: skip
        if turn and rng.random() < 0.2:
            continue  # an open side
        own = eave + rng.uniform(-1.5, 1.5)
        look = {"wall": rng.choice(["plaster", "brick", "stone"]), "chimneys": int(length // 6)}
        if roof == "flat":
            k.house(a, b, turn, length, half, own, "flat", cover="flat_roof", clutter=int(length // 5), **look)
        else:
            k.house(a, b, turn, length, half, own, roof, pitch, cover=rng.choice(["tile", "slate"]),
                    dormers=int(length // 4), overhang=rng.uniform(0.2, 0.5), **look)  # fmt: skip
        # Bays and balconies on the street side.
        out = half + 0.45
        front = -1 if (b < d / 2 if not turn else a > w / 2) else 1
        for n in range(int(length // 4)):
            s = -length + 2 + n * 4.0 + rng.uniform(0, 2)
            x, y, angle = k.at(a, b)
            px, py = beside(x, y, angle + turn, s, front * out)
            z = k.plan.height(px, py)
            k.parts.prism(px, py, angle + turn, 0.9, 0.5, z + 3.2, z + own - rng.uniform(1, 4), BUILDING,
                          "plaster", "plaster")  # fmt: skip
    for _ in range(int(rng.integers(2, 5))):
        k.plant(plants.tree, rng.uniform(13, w - 13), rng.uniform(13, d - 13), 5, 11)
        k.plant(plants.shrub, rng.uniform(12, w - 12), rng.uniform(12, d - 12), rng.uniform(0.5, 1.8))
    for n in range(int(rng.integers(0, 4))):
        k.car(w / 2 - 4 + 2.7 * n, d / 2, math.pi / 2)
    if d > 30:
        k.house(w / 2, d - 2 * half - 3.4, 0, 3.5, 2.5, 2.6, "flat", cover="flat_roof", wall="brick")


def _park(k: Block) -> None:
    """Trees alone and in groves, shrubs, benches, lamps; the plan digs a pond in the middle."""
    rng, w, d = k.rng, k.width, k.depth
    pond = k.plan.ground.pond[k.i, k.j]

    def dry(a, b, off):
        return math.hypot(k.u0 + a - pond[0], k.v0 + b - pond[1]) > pond[2] + off

    for _ in range(int(w * d / 75)):
        a, b = rng.uniform(1, w - 1), rng.uniform(1, d - 1)
        if dry(a, b, 2.5):
            k.plant(plants.tree, a, b, 7, 20)
    for _ in range(int(w * d / 45)):
        a, b = rng.uniform(0, w), rng.uniform(0, d)
        if dry(a, b, 1.5):
            k.plant(plants.shrub, a, b, rng.uniform(0.35, 2.6))
    for _ in range(5):
        a, b = rng.uniform(3, w - 3), rng.uniform(3, d - 3)
        if dry(a, b, 2):
            k.box(a, b, rng.uniform(0, 3), 0.9, 0.3, 0.75, "bark")
    for b in (3.0, d - 3.0):
        x, y, angle = k.at(w / 2, b)
        lamp(k.parts, k.plan, x, y, angle, 4.5)
    k.line(plants.hedge, 0, 0.2, 0.6 * w, 0.2, rng.uniform(0.8, 1.6))


def _villa(k: Block) -> None:
    """Detached houses of all roof shapes in green gardens."""
    rng, w, d = k.rng, k.width, k.depth
    columns, rows = 3, 2
    pw, pd = w / columns, d / rows
    for p in range(columns):
        for q in range(rows):
            a, b = (p + 0.5) * pw, (q + 0.5) * pd
            hl, hw = rng.uniform(4.4, 5.6), rng.uniform(3.4, 4.2)
            eave = rng.uniform(2.8, 6.2)
            turn = rng.choice([0, math.pi / 2]) + rng.uniform(-0.06, 0.06)
            roof = rng.choice(["hip", "gable", "halfhip", "pyramid", "flat", "gable"])
            look = {"wall": rng.choice(["plaster", "brick"]), "cover": rng.choice(["tile", "slate"])}
            if roof == "flat":
                look["cover"] = "flat_roof"
            k.house(a, b, turn, hl, hw, eave, roof, rng.uniform(0.45, 1.1), overhang=rng.uniform(0.3, 0.9),
                    dormers=int(rng.integers(0, 2)), **look)  # fmt: skip
            if rng.random() < 0.4:  # an L
                x, y, angle = k.at(a, b)
                x, y = beside(x, y, angle + turn, hl - 2.6, hw)
                house(k.parts, k.plan, rng, x, y, angle + turn + math.pi / 2, 3.6, 2.5, eave,
                      roof if roof in ("gable", "flat") else "hip", 0.7, chimneys=0, **look)  # fmt: skip
            k.house(p * pw + 2.6, q * pd + 3.0, 0, 1.5, 2.7, 2.5, "flat", cover="flat_roof", wall="plaster")
            k.car(p * pw + 2.6, q * pd + 8.0, math.pi / 2)
            for _ in range(4):
                x, y = p * pw + rng.uniform(1, pw - 1), q * pd + rng.uniform(1, pd - 1)
                if abs(x - a) > 6.6 or abs(y - b) > 6.6:
                    k.plant(plants.tree, x, y, 4, 13)
            for _ in range(6):
                k.plant(plants.shrub, p * pw + rng.uniform(0.5, pw - 0.5), q * pd + rng.uniform(0.5, pd - 0.5),
                        rng.uniform(0.3, 2.2))  # fmt: skip
            k.line(plants.hedge, p * pw + 5, q * d, (p + 1) * pw - 0.5, q * d, rng.uniform(0.9, 1.9))
        if p:
            k.line(fence if rng.random() < 0.5 else plants.hedge, p * pw, 1, p * pw, d - 1, 1.5)


def _hall(k: Block) -> None:
    """Flat halls with plant on the roof, a parking place, lorries and containers."""
    rng, w, d = k.rng, k.width, k.depth
    hw, hl = 0.27 * d, 0.46 * w
    if rng.random() < 0.5:
        k.house(w / 2, d - hw - 1, 0, hl, hw, rng.uniform(6, 11), "flat", cover="flat_roof", wall="metal", clutter=9)
    else:  # a saw-tooth roof
        eave = rng.uniform(5.5, 8)
        for n in range(4):
            half = hl / 4
            k.house(w / 2 - hl + (2 * n + 1) * half, d - hw - 1, math.pi / 2, hw, half, eave, "shed", 0.22,
                    cover="metal", wall="metal", overhang=0.05, chimneys=0)  # fmt: skip
    k.house(0.8 * w, 0.1 * d + 4, 0, 0.15 * w, 4, rng.uniform(3.2, 9), "flat", cover="flat_roof", clutter=3)
    for row in (0.12 * d, 0.32 * d):
        for a in np.arange(2.0, 0.55 * w, 2.7):
            if rng.random() < 0.65:
                k.car(a, row, math.pi / 2 + rng.uniform(-0.04, 0.04))
    for n in range(2):
        k.box(0.7 * w + 4 * n, 0.38 * d, math.pi / 2, rng.uniform(3.5, 5.5), 1.25, 3.4, "metal")
    for n in range(3):
        k.box(3.0 + 6.5 * n, 0.42 * d, 0, 3.0, 1.2, 2.6 * (1 + (n == 1)), "metal")
    for a in np.arange(3, 0.6 * w, 9):
        k.plant(plants.broadleaf, a, 0.22 * d, rng.uniform(5, 8))
    k.line(fence, 0, d - 0.2, w, d - 0.2, 1.9, material="steel", half=0.04)


def _church(k: Block) -> None:
    """A church on its square, plane trees in rows, market stalls."""
    rng, w, d = k.rng, k.width, k.depth
    x, y, angle = k.at(w / 2, d * 0.62)
    church(k.parts, k.plan, rng, x, y, angle)
    for a in np.arange(2.5, w - 1, 6.5):
        k.plant(plants.broadleaf, a, 2.0, rng.uniform(8, 12))
        if rng.random() < 0.8:
            k.plant(plants.broadleaf, a, d - 1.5, rng.uniform(7, 11))
    for n in range(5):
        k.box(5 + 7 * n, 8.5, 0, 1.6, 1.1, rng.uniform(2.2, 2.8), "plaster")
    for n in range(6):
        k.car(3.5 + 2.7 * n, d * 0.3 + 1.0, math.pi / 2)
    k.box(w - 6, d * 0.3, 0.3, 1.0, 1.0, 3.2, "stone")


def _field(k: Block) -> None:
    """A field or allotments with hedgerows, huts, a glasshouse, an orchard row."""
    rng, w, d = k.rng, k.width, k.depth
    for b in (0.8, d - 0.8):
        k.line(plants.hedge, 1, b, w - 1, b, rng.uniform(0.8, 2.4), half=rng.uniform(0.5, 1.2))
    for a in np.arange(4, w - 3, 5.5):
        k.plant(plants.broadleaf, a, d - 6, rng.uniform(3.5, 5.5))
    for n in range(4):
        k.house(5 + n * 11.0, 5.0, rng.uniform(-0.1, 0.1), 2.0, 1.6, 2.2, rng.choice(["gable", "shed", "flat"]), 0.5,
                wall="bark", cover="slate", overhang=0.3, chimneys=0)  # fmt: skip
        for _ in range(6):
            k.plant(plants.shrub, 2 + n * 11.0 + rng.uniform(0, 9), rng.uniform(8, 14), rng.uniform(0.35, 1.5))
    for _ in range(5):
        k.plant(plants.tree, rng.uniform(2, w - 2), rng.uniform(15, d - 9), 5, 18)


_FILL = {ROW: _row, COURT: _court, PARK: _park, VILLA: _villa, HALL: _hall, CHURCH: _church, FIELD: _field}


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
    for a, b in zip(tops, tops[1:], strict=False):
        for off in (-0.6, 0.0, 0.6):
            p = (*beside(a[0], a[1], a[3], 0, off), a[2])
            q = (*beside(b[0], b[1], b[3], 0, off), b[2])
            _cable(k.parts, p, q, 0.02 * math.dist(p, q), 6)


def _streets(k: Block) -> None:
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
        _poles(k, [(u0 + 4.9, begin + n * step) for n in range(2)] + [(u0 + 4.9, end)],
               (u0 * 0 + u0 + 4.9, v1 + quiet[int(g.v_kind[j + 1])]), math.pi / 2)  # fmt: skip
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
        k.parts.prism(*at, angle, 0.25, BANK_FOOT, z - BANK_HEIGHT - 1, z + 0.02, BRIDGE, "concrete", "concrete",
                      cuts=cuts)  # fmt: skip
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
    for a, b in zip(tops, tops[1:], strict=False):
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


class Blocks:
    """The blocks of a plan as arrays of things, made when first needed; the latest ones are kept."""

    def __init__(self, plan: Plan, keep: int = 1500) -> None:
        self.plan, self.keep = plan, keep
        self._made: OrderedDict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
        """Things and planes of block (i, j) and of its low-side streets."""
        with self._lock:
            if (i, j) in self._made:
                self._made.move_to_end((i, j))
                return self._made[i, j]
            k = Block(self.plan, i, j)
            if k.width > 20 and k.depth > 20:
                _FILL[int(self.plan.ground.block[i, j])](k)
            _streets(k)
            made = k.parts.arrays(i * 65536 + j)
            self._made[i, j] = made
            while len(self._made) > self.keep:
                self._made.popitem(last=False)
            return made
