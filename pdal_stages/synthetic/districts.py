"""What stands on the town's blocks, and on the streets on their low sides, as solids.

Houses, cars, masts, wires and plants are boxes, bars and ellipsoids, as rows of arrays. Their
sizes, meters, are plausible ones without a source.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from ..base.asprs import BRIDGE, BUILDING, TOWER, WIRE
from . import townplan as t

UNCLASSIFIED = 1
VEGETATION = 255  #: stands for 3, 4 or 5, which follows from the height above ground

#: From the axis of a street to the land that may be built on, meters.
MARGIN = 6.2
#: The same from the axes of a railway and a canal.
MARGINS = {t.RAILWAY: 14.0, t.CANAL: 15.5}


class Footprint(NamedTuple):
    """A rectangle seen from above: its middle, the direction of its length, half its sides."""

    a: float
    b: float
    turn: float  #: radians
    half_l: float
    half_w: float

    def place(self, along: float, left: float) -> tuple[float, float]:
        """Return the place `along` and `left` of the middle, looking in direction `turn`."""
        return beside(self.a, self.b, self.turn, along, left)


class Finish(NamedTuple):
    """Class and materials of a solid; a leafy one has an extinction in 1/m."""

    code: int
    top: str
    side: str
    extinction: float = 0.0


def beside(a: float, b: float, turn: float, along: float, left: float) -> tuple[float, float]:
    """Return the place `along` and `left` of (a, b), looking in direction `turn`."""
    c, s = math.cos(turn), math.sin(turn)
    return a + along * c - left * s, b + along * s + left * c


def leaves(extinction: float) -> Finish:
    """Return the finish of foliage."""
    return Finish(VEGETATION, "leaf", "leaf", extinction)


class Site:
    """The solids of one block and of the streets on its low sides.

    Places are (a, b) in meters along u and v from the low corner of the land that may be built on;
    that land is `w` by `d` meters, and the line below it lies at b = `axis`. Heights are absolute.
    """

    def __init__(self, plan: t.Plan, i: int, j: int) -> None:
        self.plan, self.i, self.j = plan, i, j
        self.rng = np.random.default_rng([plan.seed, i + 2**20, j + 2**20])
        self.draw, self.chance = self.rng.uniform, self.rng.random
        low, self.high = MARGINS.get(j % 4, MARGIN), MARGINS.get((j + 1) % 4, MARGIN)
        self.u0, self.v0 = t.FIRST_U + t.PITCH_U * i + MARGIN, t.FIRST_V + t.PITCH_V * j + low
        self.w, self.d, self.axis = t.PITCH_U - 2 * MARGIN, t.PITCH_V - low - self.high, -low
        self.solids: list[tuple] = []  # rows of ray_casting.Scene
        self.planes: list[tuple] = []
        self.built: list[tuple] = []  # kind and measures of each object, for true objects

    def z(self, a: float, b: float) -> float:
        """Return the height of the ground."""
        return float(t.ground(self.u0 + a, self.v0 + b, self.plan)[0])

    def _add(self, middle: Sequence[float], axes, cuts, finish: Finish) -> None:
        """Add a block of unit vectors and half sizes, without what lies beyond its cuts.

        Without cuts (None) its ellipsoid is added.
        """
        u, v, w = middle[0] + self.u0, middle[1] + self.v0, middle[2]
        reach = [sum(abs(normal[k]) * half for normal, half in axes) for k in range(3)]
        planes = [((s * x, s * y, s * z), half) for (x, y, z), half in axes for s in (-1, 1)]
        planes = [] if cuts is None else planes + cuts
        materials = t.MATERIAL[finish.top], t.MATERIAL[finish.side]
        box = [p + s * r for s in (-1, 1) for p, r in zip((u, v, w), reach, strict=True)]
        row = len(self.planes), len(planes), finish.code, *materials, finish.extinction
        self.solids.append((*box, *row))
        self.planes += [(x, y, z, off + x * u + y * v + z * w) for (x, y, z), off in planes]

    def box(self, base: Footprint, z0: float, z1: float, finish: Finish, cuts=()) -> None:
        """Add an upright box.

        Each cut (p, q, height) leaves of it what lies at ``z <= height - p * x - q * y``, where x
        and y run along its length and width from its middle.
        """
        c, s, middle = math.cos(base.turn), math.sin(base.turn), (base.a, base.b, 0.5 * (z0 + z1))
        planes = []
        for p, q, height in cuts:
            n = math.sqrt(p * p + q * q + 1.0)
            normal = (p * c - q * s) / n, (p * s + q * c) / n, 1.0 / n
            planes.append((normal, (height - middle[2]) / n))
        sides = ((c, s, 0.0), base.half_l), ((-s, c, 0.0), base.half_w)
        self._add(middle, (*sides, ((0.0, 0.0, 1.0), 0.5 * (z1 - z0))), planes, finish)

    def ball(self, middle: Sequence[float], radii: Sequence[float], extinction: float) -> None:
        """Add an upright ellipsoid of leaves."""
        axes = tuple(zip(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), radii, strict=True))
        self._add(middle, axes, None, leaves(extinction))

    def bar(self, start, end, radius: float, code: int, material: str) -> None:
        """Add a thin square bar between two places (a, b, z)."""
        length = math.dist(start, end)
        x, y, z = ((q - p) / length for p, q in zip(start, end, strict=True))
        flat = math.hypot(x, y)
        c, s = (x / flat, y / flat) if flat > 1e-6 else (1.0, 0.0)
        axes = (((x, y, z), length / 2), ((-s, c, 0.0), radius), ((-z * c, -z * s, flat), radius))
        middle = [(p + q) / 2 for p, q in zip(start, end, strict=True)]
        self._add(middle, axes, [], Finish(code, material, material))


ACROSS = math.pi / 2
METAL = Finish(UNCLASSIFIED, "metal", "metal")
GARDEN_WALL = Finish(UNCLASSIFIED, "brick", "brick")
DECK = Finish(BRIDGE, "asphalt", "stone")
MACHINE = Finish(BUILDING, "metal", "metal")
#: From the ground to the insulators of a wooden pole, meters.
POLE_HEIGHT = 8.4


def fill(plan: t.Plan, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the solids (n, 12) of block (i, j) and its streets, and their planes (m, 4)."""
    site = filled_site(plan, i, j)
    return np.array(site.solids), np.array(site.planes)


def filled_site(plan: t.Plan, i: int, j: int) -> Site:
    """Return block (i, j), and the streets on its low sides, with everything that stands there."""
    site = Site(plan, i, j)
    kind = t.block_at(t.FIRST_U + t.PITCH_U * (i + 0.5), t.FIRST_V + t.PITCH_V * (j + 0.5), plan)[2]
    _FILLERS[kind](site)
    _fill_street(site)
    {t.RAILWAY: _fill_railway, t.CANAL: _fill_canal}.get(j % 4, _fill_cross_street)(site)
    return site


def _plant(s: Site, trees: int, shrubs: int, low=0.0, high=0.0, land=None) -> None:
    """Plant trees and shrubs over the block, or over a part (a, b, width, depth) of it."""
    a, b, w, d = land or (0, 0, s.w, s.d)
    for _ in range(trees):
        tree(s, a + w * s.draw(0.02, 0.98), b + d * s.draw(0.02, 0.98), low, high)
    for _ in range(shrubs):
        shrub(s, a + w * s.draw(0, 1), b + d * s.draw(0, 1))


def _park_cars(s: Site, along: Iterable, across: Iterable, turn: float, share=0.45) -> None:
    """Park cars at a share of the places of a grid."""
    for a, b in itertools.product(along, across):
        if s.chance() < share:
            car(s, a + s.draw(-0.3, 0.3), b + s.draw(-0.3, 0.3), turn + s.draw(-0.04, 0.04))


def _fill_rows(s: Site) -> None:
    """Build two rows of terraced houses, with gardens between them."""
    for front in (0.4, s.d - 0.4):  # a row shares eaves and roof; gaps let the gardens be seen
        a, deep = s.draw(0.5, 2.0), s.draw(4.2, 5.0)
        eave, pitch = s.draw(4.8, 7.5), s.draw(0.65, 1.1)
        roof, b = s.rng.choice(["gable", "gable", "halfhip"]), deep + 2.2
        while a + 14 < s.w:
            half = min(s.draw(14, 24), s.w - a - 0.5) / 2
            base = Footprint(a + half, b if front < 1 else s.d - b, 0.0, half, deep)
            house(s, base, eave, roof, pitch)
            hedge(s, a, front, 0, half, s.draw(0.45, 1.3), 0.3)
            a += 2 * half + s.draw(2.5, 4.5)
    low, long = 12.5, s.d - 25.0
    for a in np.arange(1.0, s.w - 1, 7.0):
        hedge(s, a, low, ACROSS, long, s.draw(1.0, 1.9), wall=s.chance() < 0.5)
        if s.chance() < 0.3:
            shed = Footprint(a + 3.5, low + s.draw(0.2, 0.8) * long, 0, 1.5, 1.2)
            house(s, shed, 2.1, "shed", 0.25, plain=True)
        _plant(s, int(s.chance() < 0.4), 2, 4, 9, (a + 1, low, 5, long))


def _fill_court(s: Site) -> None:
    """Build a closed block around a courtyard with plants and cars."""
    half, eave, pitch = s.draw(4.6, 5.6), s.draw(9, 15), s.draw(0.55, 0.9)
    roof, inner = s.rng.choice(["gable", "hip", "flat"]), s.d / 2 - 2 * half
    sides = [Footprint(s.w / 2, b, 0.0, s.w / 2, half) for b in (half, s.d - half)]
    for a in (half, s.w - half):
        if s.chance() < 0.8:
            sides.append(Footprint(a, s.d / 2, ACROSS, inner, half))
    for base in sides:
        house(s, base, eave + s.draw(-1.5, 1.5), roof, pitch)
    _plant(s, 4, 4, 5, 11, (13, 13, s.w - 26, s.d - 26))
    _park_cars(s, s.w / 2 + np.arange(-4, 5, 2.7), [s.d / 2], ACROSS)


def _fill_villas(s: Site) -> None:
    """Build six detached houses of all roof shapes with garages, in gardens."""
    w, d = s.w / 3, s.d / 2
    for a, b in itertools.product((0, w, 2 * w), (0, d)):
        turn = s.rng.choice([0, ACROSS]) + s.draw(-0.06, 0.06)
        roof = s.rng.choice(["hip", "gable", "halfhip", "pyramid", "flat"])
        base = Footprint(a + w / 2, b + d / 2, turn, s.draw(4.4, 5.6), s.draw(3.4, 4.2))
        house(s, base, s.draw(2.8, 6.2), roof, s.draw(0.45, 1.1))
        house(s, Footprint(a + 2.6, b + 3.0, 0, 1.5, 2.7), 2.5, "flat", plain=True)
        car(s, a + 2.6, b + 8.0, ACROSS)
        _plant(s, 1, 3, 4, 13, (a + 1, b + d - 4, w - 2, 3))
        _plant(s, 1, 3, 4, 9, (a + 5, b, w - 5, 3))
        hedge(s, a + 5, b + 0.3, 0, w - 5.5, s.draw(0.9, 1.9))
        hedge(s, a, b + 1, ACROSS, d - 2, 1.5, wall=s.chance() < 0.5)


def _fill_hall(s: Site) -> None:
    """Build a hall of three parts, a parking lot with trees, containers."""
    for n, roof in enumerate(("flat", "shed", "flat")):
        base = Footprint((0.2 + 0.3 * n) * s.w, 0.78 * s.d, ACROSS, 0.19 * s.d, 0.15 * s.w)
        house(s, base, s.draw(4.5, 9), roof, 0.22, plain=roof == "shed")
    _park_cars(s, np.arange(2.0, 0.6 * s.w, 2.7), (0.12 * s.d, 0.32 * s.d), ACROSS, 0.65)
    for n in range(3):
        container = Footprint(0.75 * s.w + 4 * n, 0.3 * s.d, ACROSS, s.draw(3, 5), 1.25)
        put(s, container, s.draw(2.6, 3.6))
        tree(s, 4 + 9 * n, 0.22 * s.d, 5, 8, 0)


def _fill_park(s: Site) -> None:
    """Build a church among tall trees, hedges, allotments with huts, lamps."""
    a, b = s.w / 2, s.d * 0.6
    house(s, Footprint(a, b, 0, 9, 5), 9, "gable", 1.1, plain=True)
    house(s, Footprint(a + 11.5, b, 0, 3.5, 3.5), 7, "pyramid", 1.0, plain=True)
    tower = Footprint(a - 11.5, b, 0, 3, 3)
    house(s, tower, s.draw(17, 22), "pyramid", s.draw(2.2, 3.0), plain=True)
    for b in (0.8, s.d - 0.8):
        hedge(s, 1, b, 0, s.w - 2, s.draw(0.8, 2.4), s.draw(0.5, 1.2))
    for a in np.arange(5, s.w - 3, 11):
        roof = s.rng.choice(["gable", "shed", "flat"])
        house(s, Footprint(a, 5, s.draw(-0.1, 0.1), 2, 1.6), 2.2, roof, 0.5, plain=True)
        mast(s, a + 5, s.d / 3, 0, 4.5, 0.5)
    _plant(s, 6, 25, 5, 14, (2, 8, s.w - 4, 8))
    _plant(s, 12, 5, 8, 20, (2, s.d - 10, s.w - 4, 8))


_FILLERS = {
    t.ROWS: _fill_rows,
    t.COURT: _fill_court,
    t.VILLAS: _fill_villas,
    t.HALL: _fill_hall,
    t.PARK: _fill_park,
}


def _fill_street(s: Site) -> None:
    """Fill the street on the low-u side: cars, and poles with wires, or lamps, trees, boxes."""
    _park_cars(s, (-2.3 - MARGIN, 2.3 - MARGIN), np.arange(2, s.d - 2, 6.0), ACROSS)
    if s.i % 2:
        ends = [2, s.d / 2]
        if (s.j + 1) % 4 != t.RAILWAY:  # no wire crosses the railway
            ends.append(s.d + s.high + MARGINS.get((s.j + 1) % 4, MARGIN) + 2)
        _string_wires(s, [(-1.3, b) for b in ends], (1, 0))
    else:
        for b in np.arange(3, s.d, 14.0):
            mast(s, -4.4 - MARGIN, b, 0, 7.5, 1.4)
            tree(s, -1.6, b - 2, 5, 9, 0)
            box = Footprint(-4.6 - MARGIN, b + s.draw(1, 9), 0, 0.4, 0.35)
            put(s, box, s.draw(0.8, 1.4))


def _fill_cross_street(s: Site) -> None:
    """Fill the street on the low-v side: cars, poles and wires."""
    _park_cars(s, np.arange(2, s.w - 2, 6.0), (s.axis - 2.3, s.axis + 2.3), 0.0)
    _string_wires(s, [(a, s.axis - 4.9) for a in (1, s.w / 2, t.PITCH_U + 1)], (0, 1))


def _string_wires(s: Site, stations: list[tuple[float, float]], across: tuple[int, int]) -> None:
    """Put poles with three conductors between stations, the last of which is the next block's."""
    tops = [(a, b, s.z(a, b) + POLE_HEIGHT) for a, b in stations]
    for p, q in itertools.pairwise(tops):
        s.bar((*p[:2], p[2] - POLE_HEIGHT), (*p[:2], p[2] + 0.2), 0.13, TOWER, "bark")
        for off in (-0.6, 0.0, 0.6):
            start, end = ((a + off * across[0], b + off * across[1], z) for a, b, z in (p, q))
            cable(s, start, end, 0.02 * math.dist(p, q))


def _fill_canal(s: Site) -> None:
    """Fill the quays with trees, lamps and cars, and build the bridge of the street."""
    for side, a in itertools.product((-1, 1), np.arange(3, s.w - 3, 8.0)):
        tree(s, a, s.axis + side * 8.8, 6, 10, 0)
        mast(s, a + 4, s.axis + side * 8.8, side * ACROSS, 6.0, 1.4)
        _park_cars(s, [a], [s.axis + side * 10.3], 0.0)
    deck = Footprint(-MARGIN, s.axis, ACROSS, t.CANAL_HALF + 0.1, 5.0)
    s.box(deck, -0.8, -t.KERB, DECK)
    for side in (-4.85, 4.85):
        s.box(deck._replace(a=side - MARGIN, half_w=0.15), -0.8, 0.9, DECK)  # parapet
    s.built.append(("deck", deck))


def _fill_railway(s: Site) -> None:
    """Put a mast on the crest of the railway bank, and shrubs on its slopes."""
    mast(s, s.w / 2, s.axis + 3.0, -ACROSS, 7.2, 3.0)
    _plant(s, 0, 12, land=(0, s.axis - t.BANK_FOOT, t.PITCH_U, 2 * t.BANK_FOOT))


def house(s: Site, base: Footprint, eave, roof: str, pitch=0.8, *, plain=False) -> None:
    """Build a house, with dormers and chimneys (on a flat roof: a rim and machines) unless plain.

    The ridge runs along its length; `eave` is meters above the mean ground; `pitch` is rise over
    run; `roof` is 'flat', 'gable', 'hip', 'halfhip', 'shed' or 'pyramid'.
    """
    half_l, half_w = base.half_l, base.half_w
    signs = itertools.product((-1, 1), repeat=2)
    corners = [s.z(*base.place(p * half_l, q * half_w)) for p, q in signs]
    foot, eave = min(corners) - 0.8, sum(corners) / 4 + eave
    extras = 0 if plain else 1 + int(half_l // 4)
    wall, cover = s.rng.choice(["plaster", "brick", "stone"]), s.rng.choice(["tile", "slate"])
    finish = Finish(BUILDING, cover, wall)
    if roof == "flat":
        s.built.append(("house", base, 0.0, eave, eave, ()))
        s.box(base, foot, eave, Finish(BUILDING, "paving", wall))
        _flat_roof(s, base, eave, extras, finish)
        return
    rise, overhang = pitch * half_w, 0.0 if plain else s.draw(0.2, 0.5)
    top, cuts = eave + rise, [(0, side * pitch, eave + rise) for side in (1, -1)]
    if roof == "shed":
        cuts, top = cuts[:1], eave + 2 * rise
    elif roof != "gable":
        slope = {"hip": pitch, "pyramid": rise / half_l, "halfhip": 1.3 * pitch}[roof]
        start = eave + (0.55 * rise if roof == "halfhip" else 0.0)
        cuts += [(side * slope, 0, start + slope * half_l) for side in (1, -1)]
    s.built.append(("house", base, overhang, eave, top, cuts))
    s.box(base, foot, top, finish, cuts)
    eaves = base._replace(half_l=half_l + overhang / 2, half_w=half_w + overhang)
    s.box(eaves, eave - overhang * pitch - 0.18, top, finish, cuts)
    hipped = roof in ("hip", "pyramid")
    for n in range(extras):  # dormers on both sides, and a chimney
        along = half_l * ((n + 0.5) / extras * 1.7 - 0.85) * (0.3 if hipped else 1.0)
        for side in () if hipped else (-1, 1):
            half = s.draw(0.2, 0.26) * half_w
            dormer = _inside(base, along, side * 0.55 * half_w, 0.8, half)
            s.box(dormer, eave, top + 0.1 - 0.3 * rise, finish)
        chimney = _inside(base, along + 1.2, s.draw(-0.35, 0.35) * half_w, 0.35, 0.3)
        s.box(chimney, eave, top + s.draw(0.3, 0.9), Finish(BUILDING, "brick", wall))


def _flat_roof(s: Site, base: Footprint, eave: float, extras: int, finish: Finish) -> None:
    """Put a rim and machines on a flat roof."""
    half_l, half_w, rim = base.half_l, base.half_w, eave + s.draw(0.25, 0.8)
    for side in (-1, 1):
        s.box(_inside(base, 0, side * (half_w - 0.15), half_l, 0.15), eave, rim, finish)
        s.box(_inside(base, side * (half_l - 0.15), 0, 0.15, half_w), eave, rim, finish)
    for _ in range(extras):
        along, left = s.draw(-0.75, 0.75) * half_l, s.draw(-0.65, 0.65) * half_w
        up = s.draw(0.7, 2.6)
        machine = _inside(base, along, left, s.draw(0.5, 2.2), s.draw(0.5, 1.4))
        s.box(machine, eave, eave + up, MACHINE)


def _inside(base: Footprint, along, left, half_l, half_w) -> Footprint:
    """Return a footprint `along` and `left` of the middle of another one, in its direction."""
    return Footprint(*base.place(along, left), base.turn, half_l, half_w)


def put(s: Site, base: Footprint, height: float, above=-0.4) -> None:
    """Put a plain box on the ground: a container, a bin, a part of a car."""
    z = s.z(base.a, base.b)
    s.box(base, z + above, z + height, METAL)


def car(s: Site, a, b, turn) -> None:
    """Park a car or a van."""
    half = s.draw(1.85, 2.6)
    base = Footprint(a, b, turn, half, 0.9)
    put(s, base, 0.9 if half < 2.5 else 2.2, 0.18)
    put(s, _inside(base, -0.2, 0, 0.62 * half, 0.78), s.draw(1.4, 1.7), 0.9)


def hedge(s: Site, a, b, turn, length, height, half=0.4, *, wall=False) -> None:
    """Plant a clipped hedge from (a, b) in direction `turn`, or build a wall, in steps."""
    count = math.ceil(length / 2.5)
    finish = GARDEN_WALL if wall else leaves(s.draw(1.8, 3.0))
    for n in range(count):
        at = beside(a, b, turn, (n + 0.5) * length / count, 0)
        z, up = s.z(*at), height * s.draw(0.94, 1.06)
        base = Footprint(*at, turn, length / count / 2, 0.1 if wall else half)
        s.box(base, z - 0.3, z + up, finish)


def mast(s: Site, a, b, turn, height, arm) -> None:
    """Put up a lamp post or a railway mast: a pole with an arm."""
    z = s.z(a, b) + height
    s.bar((a, b, z - height), (a, b, z), 0.1, TOWER, "metal")
    s.bar((a, b, z - 0.3), (*beside(a, b, turn, arm, 0), z - 0.2), 0.1, TOWER, "metal")


def cable(s: Site, start, end, sag: float) -> None:
    """Hang a conductor between two places (a, b, z), `sag` meters lower in the middle."""
    places = [[p + n / 6 * (q - p) for p, q in zip(start, end, strict=True)] for n in range(7)]
    for n, place in enumerate(places):
        place[2] -= sag * n * (6 - n) / 9  # a parabola
    s.built.append(("cable", start, end))
    for p, q in itertools.pairwise(places):
        s.bar(p, q, 0.03, WIRE, "metal")


def tree(s: Site, a, b, low, high, conifers=0.25) -> None:
    """Plant a tree: a conifer by a share, else a crown of boughs, dense or thin."""
    height, z = s.draw(low, high), s.z(a, b)
    trunk = 0.06 + 0.011 * height
    s.bar((a, b, z - 0.1), (a, b, z + 0.55 * height), trunk, VEGETATION, "bark")
    if s.chance() < conifers:
        steep, top, foot = s.draw(4.5, 7.0), z + 1.1 * height, z + height * s.draw(0.04, 0.14)
        half, eighths = (top - foot) / steep, [n * math.pi / 4 for n in range(8)]
        s.built.append(("tree", a, b, 1.1 * height, half))
        sides = [(steep * math.cos(angle), steep * math.sin(angle), top) for angle in eighths]
        s.box(Footprint(a, b, 0.2, half, half), foot, top, leaves(s.draw(0.6, 1.0)), sides)
        return
    extinction = s.draw(0.5, 0.9) if s.chance() < 0.8 else s.draw(0.15, 0.3)
    radius, bole = height * s.draw(0.26, 0.4), height * s.draw(0.18, 0.3)
    half = 0.5 * (height - bole)
    s.built.append(("tree", a, b, height, radius))
    s.ball((a, b, z + bole + half), (0.7 * radius, 0.7 * radius, half), extinction)
    for n in range(5):
        angle = 2 * math.pi * (n + s.draw(-0.3, 0.3)) / 5
        at = beside(a, b, angle, radius * s.draw(0.4, 0.6), 0)
        r, rz = radius * s.draw(0.42, 0.62), half * s.draw(0.4, 0.6)
        bough = (*at, z + bole + rz + 2 * (half - rz) * s.draw(0.15, 0.85))
        s.ball(bough, (r, r * s.draw(0.8, 1.2), rz), extinction)


def shrub(s: Site, a, b) -> None:
    """Plant a bush that touches the ground."""
    height = s.draw(0.35, 2.4)
    r = height * s.draw(0.45, 0.85)
    radii = (r, r * s.draw(0.8, 1.25), 0.6 * height)
    s.ball((a, b, s.z(a, b) + 0.4 * height), radii, s.draw(1.2, 2.2))
