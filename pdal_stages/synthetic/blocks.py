"""What stands in each block of the town."""

from __future__ import annotations

import math
import threading
from collections import OrderedDict

import numpy as np

from . import plants
from .block import Block
from .buildings import BUILDING, beside, church, fence, house, lamp
from .plan import CHURCH, COURT, FIELD, HALL, PARK, ROW, VILLA, Plan
from .streets import fill_streets


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
                a + length / 2,
                b,
                0.0,
                length / 2,
                deep,
                eave,
                roof,
                pitch,
                wall=rng.choice(["brick", "plaster"]),
                cover=rng.choice(["tile", "slate"]),
                overhang=rng.uniform(0.2, 0.6),
                dormers=int(length // 6) if rng.random() < 0.6 else 0,
                chimneys=int(length // 6),
            )
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
                k.house(
                    a + 3.5,
                    middle + rng.uniform(-0.5, 0.5) * reach,
                    0,
                    1.5,
                    1.2,
                    2.1,
                    "shed",
                    0.25,
                    wall="brick",
                    cover="slate",
                    overhang=0.15,
                    chimneys=0,
                )
            for _ in range(int(rng.integers(1, 4))):
                k.plant(
                    plants.shrub,
                    a + rng.uniform(1, 6),
                    middle + rng.uniform(-1, 1) * reach,
                    rng.uniform(0.4, 1.8),
                )


def _court(k: Block) -> None:
    """A closed block around a courtyard, with a gateway, bays and a tree or two inside."""
    rng, w, d = k.rng, k.width, k.depth
    half = rng.uniform(4.6, 5.6)
    eave = rng.uniform(9, 15)
    roof = rng.choice(["gable", "mansard", "flat"])
    pitch = rng.uniform(0.55, 0.9)
    for turn, a, b, length in (
        (0.0, w / 2, half, w / 2),
        (0.0, w / 2, d - half, w / 2),
        (math.pi / 2, half, d / 2, d / 2 - 2 * half),
        (math.pi / 2, w - half, d / 2, d / 2 - 2 * half),
    ):
        if turn and rng.random() < 0.2:
            continue  # an open side
        own = eave + rng.uniform(-1.5, 1.5)
        look = {"wall": rng.choice(["plaster", "brick", "stone"]), "chimneys": int(length // 6)}
        if roof == "flat":
            k.house(
                a, b, turn, length, half, own, "flat", cover="flat_roof", clutter=int(length // 5), **look
            )
        else:
            k.house(
                a,
                b,
                turn,
                length,
                half,
                own,
                roof,
                pitch,
                cover=rng.choice(["tile", "slate"]),
                dormers=int(length // 4),
                overhang=rng.uniform(0.2, 0.5),
                **look,
            )
        # Bays and balconies on the street side.
        out = half + 0.45
        front = -1 if (b < d / 2 if not turn else a > w / 2) else 1
        for n in range(int(length // 4)):
            s = -length + 2 + n * 4.0 + rng.uniform(0, 2)
            x, y, angle = k.at(a, b)
            px, py = beside(x, y, angle + turn, s, front * out)
            z = k.plan.height(px, py)
            k.parts.prism(
                px,
                py,
                angle + turn,
                0.9,
                0.5,
                z + 3.2,
                z + own - rng.uniform(1, 4),
                BUILDING,
                "plaster",
                "plaster",
            )
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
            k.house(
                a,
                b,
                turn,
                hl,
                hw,
                eave,
                roof,
                rng.uniform(0.45, 1.1),
                overhang=rng.uniform(0.3, 0.9),
                dormers=int(rng.integers(0, 2)),
                **look,
            )
            if rng.random() < 0.4:  # an L
                x, y, angle = k.at(a, b)
                x, y = beside(x, y, angle + turn, hl - 2.6, hw)
                house(
                    k.parts,
                    k.plan,
                    rng,
                    x,
                    y,
                    angle + turn + math.pi / 2,
                    3.6,
                    2.5,
                    eave,
                    roof if roof in ("gable", "flat") else "hip",
                    0.7,
                    chimneys=0,
                    **look,
                )
            k.house(p * pw + 2.6, q * pd + 3.0, 0, 1.5, 2.7, 2.5, "flat", cover="flat_roof", wall="plaster")
            k.car(p * pw + 2.6, q * pd + 8.0, math.pi / 2)
            for _ in range(4):
                x, y = p * pw + rng.uniform(1, pw - 1), q * pd + rng.uniform(1, pd - 1)
                if abs(x - a) > 6.6 or abs(y - b) > 6.6:
                    k.plant(plants.tree, x, y, 4, 13)
            for _ in range(6):
                k.plant(
                    plants.shrub,
                    p * pw + rng.uniform(0.5, pw - 0.5),
                    q * pd + rng.uniform(0.5, pd - 0.5),
                    rng.uniform(0.3, 2.2),
                )
            k.line(plants.hedge, p * pw + 5, q * d, (p + 1) * pw - 0.5, q * d, rng.uniform(0.9, 1.9))
        if p:
            k.line(fence if rng.random() < 0.5 else plants.hedge, p * pw, 1, p * pw, d - 1, 1.5)


def _hall(k: Block) -> None:
    """Flat halls with plant on the roof, a parking place, lorries and containers."""
    rng, w, d = k.rng, k.width, k.depth
    hw, hl = 0.27 * d, 0.46 * w
    if rng.random() < 0.5:
        k.house(
            w / 2,
            d - hw - 1,
            0,
            hl,
            hw,
            rng.uniform(6, 11),
            "flat",
            cover="flat_roof",
            wall="metal",
            clutter=9,
        )
    else:  # a saw-tooth roof
        eave = rng.uniform(5.5, 8)
        for n in range(4):
            half = hl / 4
            k.house(
                w / 2 - hl + (2 * n + 1) * half,
                d - hw - 1,
                math.pi / 2,
                hw,
                half,
                eave,
                "shed",
                0.22,
                cover="metal",
                wall="metal",
                overhang=0.05,
                chimneys=0,
            )
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
        k.house(
            5 + n * 11.0,
            5.0,
            rng.uniform(-0.1, 0.1),
            2.0,
            1.6,
            2.2,
            rng.choice(["gable", "shed", "flat"]),
            0.5,
            wall="bark",
            cover="slate",
            overhang=0.3,
            chimneys=0,
        )
        for _ in range(6):
            k.plant(
                plants.shrub, 2 + n * 11.0 + rng.uniform(0, 9), rng.uniform(8, 14), rng.uniform(0.35, 1.5)
            )
    for _ in range(5):
        k.plant(plants.tree, rng.uniform(2, w - 2), rng.uniform(15, d - 9), 5, 18)


_FILL = {ROW: _row, COURT: _court, PARK: _park, VILLA: _villa, HALL: _hall, CHURCH: _church, FIELD: _field}


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
            fill_streets(k)
            made = k.parts.arrays(i * 65536 + j)
            self._made[i, j] = made
            while len(self._made) > self.keep:
                self._made.popitem(last=False)
            return made
