"""What stands in each block of the town, and along its streets: houses, cars, street furniture, wires and plants."""

from __future__ import annotations

import itertools
import math

import numpy as np

from . import townplan as t
from .solids import BRIDGE, BUILDING, MARGIN, MARGINS, POLE, UNCLASSIFIED, VEGETATION, WIRE, Site

ACROSS = math.pi / 2


def fill(plan: t.Plan, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
    """The things (n, 12) of block (i, j) and of the streets on its low sides, and their planes (m, 4)."""
    site = filled(plan, i, j)
    return np.array(site.things), np.array(site.planes)


def filled(plan: t.Plan, i: int, j: int) -> Site:
    """The site of block (i, j) and of the streets on its low sides, with all that stands there."""
    site = Site(plan, i, j)
    kind = t.block_at(t.FIRST_U + t.PITCH_U * (i + 0.5), t.FIRST_V + t.PITCH_V * (j + 0.5), plan)[2]
    (_row, _court, _villa, _hall, _park)[kind](site)
    _street(site)
    {t.BANK: _bank, t.CANAL: _canal}.get(j % 4, _cross_street)(site)
    return site


def _greenery(s: Site, trees: int, shrubs: int, low=0.0, high=0.0, land=None) -> None:
    """Trees and shrubs strewn over the block, or over a part (a, b, width, depth) of it."""
    a, b, w, d = land or (0, 0, s.w, s.d)
    for _ in range(trees):
        tree(s, a + w * s.draw(0.02, 0.98), b + d * s.draw(0.02, 0.98), low, high)
    for _ in range(shrubs):
        shrub(s, a + w * s.draw(0, 1), b + d * s.draw(0, 1))


def _cars(s: Site, along, across, turn: float, share=0.45) -> None:
    for a, b in itertools.product(along, across):
        if s.chance() < share:
            car(s, a + s.draw(-0.3, 0.3), b + s.draw(-0.3, 0.3), turn + s.draw(-0.04, 0.04))


def _row(s: Site) -> None:
    """Two rows of terraced houses, gardens with hedges, walls, sheds and trees between them."""
    for front in (0.4, s.d - 0.4):  # a row shares eaves and roof; gaps let the gardens be seen
        a, deep, eave, pitch = (
            s.draw(0.5, 2.0),
            s.draw(4.2, 5.0),
            s.draw(4.8, 7.5),
            s.draw(0.65, 1.1),
        )
        roof, b = s.rng.choice(["gable", "gable", "halfhip"]), deep + 2.2
        while a + 14 < s.w:
            half = min(s.draw(14, 24), s.w - a - 0.5) / 2
            house(s, a + half, b if front < 1 else s.d - b, 0.0, half, deep, eave, roof, pitch)
            hedge(s, a, front, 0, half, s.draw(0.45, 1.3), 0.3)
            a += 2 * half + s.draw(2.5, 4.5)
    low, long = 12.5, s.d - 25.0
    for a in np.arange(1.0, s.w - 1, 7.0):
        hedge(s, a, low, ACROSS, long, s.draw(1.0, 1.9), wall=s.chance() < 0.5)
        if s.chance() < 0.3:
            house(
                s,
                a + 3.5,
                low + s.draw(0.2, 0.8) * long,
                0,
                1.5,
                1.2,
                2.1,
                "shed",
                0.25,
                plain=True,
            )
        _greenery(s, int(s.chance() < 0.4), 2, 4, 9, (a + 1, low, 5, long))


def _court(s: Site) -> None:
    """A closed block round a courtyard with green and cars."""
    half, eave, pitch = s.draw(4.6, 5.6), s.draw(9, 15), s.draw(0.55, 0.9)
    roof, inner = s.rng.choice(["gable", "hip", "flat"]), s.d / 2 - 2 * half
    sides = [(0.0, s.w / 2, b, s.w / 2) for b in (half, s.d - half)]
    sides += [(ACROSS, a, s.d / 2, inner) for a in (half, s.w - half) if s.chance() < 0.8]
    for turn, a, b, length in sides:
        house(s, a, b, turn, length, half, eave + s.draw(-1.5, 1.5), roof, pitch)
    _greenery(s, 4, 4, 5, 11, (13, 13, s.w - 26, s.d - 26))
    _cars(s, s.w / 2 + np.arange(-4, 5, 2.7), [s.d / 2], ACROSS)


def _villa(s: Site) -> None:
    """Six detached houses of all roof shapes with garages, in green gardens."""
    w, d = s.w / 3, s.d / 2
    for a, b in itertools.product((0, w, 2 * w), (0, d)):
        turn = s.rng.choice([0, ACROSS]) + s.draw(-0.06, 0.06)
        roof = s.rng.choice(["hip", "gable", "halfhip", "pyramid", "flat"])
        half_l, half_w, eave, pitch = (
            s.draw(4.4, 5.6),
            s.draw(3.4, 4.2),
            s.draw(2.8, 6.2),
            s.draw(0.45, 1.1),
        )
        house(s, a + w / 2, b + d / 2, turn, half_l, half_w, eave, roof, pitch)
        house(s, a + 2.6, b + 3.0, 0, 1.5, 2.7, 2.5, "flat", plain=True)
        car(s, a + 2.6, b + 8.0, ACROSS)
        _greenery(s, 1, 3, 4, 13, (a + 1, b + d - 4, w - 2, 3))
        _greenery(s, 1, 3, 4, 9, (a + 5, b, w - 5, 3))
        hedge(s, a + 5, b + 0.3, 0, w - 5.5, s.draw(0.9, 1.9))
        hedge(s, a, b + 1, ACROSS, d - 2, 1.5, wall=s.chance() < 0.5)


def _hall(s: Site) -> None:
    """A hall of three parts, flat and pitched, a parking place with trees, containers."""
    for n, roof in enumerate(("flat", "shed", "flat")):
        at, eave = ((0.2 + 0.3 * n) * s.w, 0.78 * s.d), s.draw(4.5, 9)
        house(s, *at, ACROSS, 0.19 * s.d, 0.15 * s.w, eave, roof, 0.22, plain=roof == "shed")
    _cars(s, np.arange(2.0, 0.6 * s.w, 2.7), (0.12 * s.d, 0.32 * s.d), ACROSS, 0.65)
    for n in range(3):
        thing(s, 0.75 * s.w + 4 * n, 0.3 * s.d, ACROSS, s.draw(3, 5), 1.25, s.draw(2.6, 3.6))
        tree(s, 4 + 9 * n, 0.22 * s.d, 5, 8, 0)


def _park(s: Site) -> None:
    """A church in a park: tall trees, hedgerows, allotments with huts, lamps."""
    a, b = s.w / 2, s.d * 0.6
    house(s, a, b, 0, 9, 5, 9, "gable", 1.1, plain=True)
    house(s, a + 11.5, b, 0, 3.5, 3.5, 7, "pyramid", 1.0, plain=True)
    house(s, a - 11.5, b, 0, 3, 3, s.draw(17, 22), "pyramid", s.draw(2.2, 3.0), plain=True)
    for b in (0.8, s.d - 0.8):
        hedge(s, 1, b, 0, s.w - 2, s.draw(0.8, 2.4), s.draw(0.5, 1.2))
    for a in np.arange(5, s.w - 3, 11):
        roof = s.rng.choice(["gable", "shed", "flat"])
        house(s, a, 5, s.draw(-0.1, 0.1), 2, 1.6, 2.2, roof, 0.5, plain=True)
        mast(s, a + 5, s.d / 3, 0, 4.5, 0.5)
    _greenery(s, 6, 25, 5, 14, (2, 8, s.w - 4, 8))
    _greenery(s, 12, 5, 8, 20, (2, s.d - 10, s.w - 4, 8))


def _street(s: Site) -> None:
    """Along the street on the block's low-u side: cars, poles and wires or lamps and trees, boxes."""
    _cars(s, (-2.3 - MARGIN, 2.3 - MARGIN), np.arange(2, s.d - 2, 6.0), ACROSS)
    if s.i % 2:
        ends = [2, s.d / 2]
        if (s.j + 1) % 4 != t.BANK:  # no wire crosses the railway
            ends.append(s.d + s.high + MARGINS.get((s.j + 1) % 4, MARGIN) + 2)
        _poles(s, [(-1.3, b) for b in ends], (1, 0))
    else:
        for b in np.arange(3, s.d, 14.0):
            mast(s, -4.4 - MARGIN, b, 0, 7.5, 1.4)
            tree(s, -1.6, b - 2, 5, 9, 0)
            thing(s, -4.6 - MARGIN, b + s.draw(1, 9), 0, 0.4, 0.35, s.draw(0.8, 1.4))


def _cross_street(s: Site) -> None:
    """Along the street on the low-v side: cars, poles and wires."""
    _cars(s, np.arange(2, s.w - 2, 6.0), (s.axis - 2.3, s.axis + 2.3), 0.0)
    _poles(s, [(a, s.axis - 4.9) for a in (1, s.w / 2, t.PITCH_U + 1)], (0, 1))


def _poles(s: Site, stations: list[tuple[float, float]], across: tuple[float, float]) -> None:
    """Wooden poles with three conductors; the last station is the next block's pole."""
    for p, q in itertools.pairwise((a, b, s.z(a, b) + 8.4) for a, b in stations):
        s.bar((*p[:2], p[2] - 8.4), (*p[:2], p[2] + 0.2), 0.13, POLE, "bark")
        for off in (-0.6, 0.0, 0.6):
            start, end = ((a + off * across[0], b + off * across[1], z) for a, b, z in (p, q))
            cable(s, start, end, 0.02 * math.dist(p, q))


def _canal(s: Site) -> None:
    """Quays with trees, lamps and cars, and the bridge of the street."""
    for side, a in itertools.product((-1, 1), np.arange(3, s.w - 3, 8.0)):
        tree(s, a, s.axis + side * 8.8, 6, 10, 0)
        mast(s, a + 4, s.axis + side * 8.8, side * ACROSS, 6.0, 1.4)
        _cars(s, [a], [s.axis + side * 10.3], 0.0)
    for a, half_w, z1 in (
        (0, 5.0, -t.KERB),
        (-4.85, 0.15, 0.9),
        (4.85, 0.15, 0.9),
    ):  # deck and parapets
        s.box(
            a - MARGIN,
            s.axis,
            ACROSS,
            t.CANAL_HALF + 0.1,
            half_w,
            -0.8,
            z1,
            BRIDGE,
            "asphalt",
            "stone",
        )
    s.built.append(("deck", -MARGIN, s.axis, ACROSS, t.CANAL_HALF + 0.1, 5.0))


def _bank(s: Site) -> None:
    """Masts on the crest of the railway bank, shrubs on its slopes."""
    mast(s, s.w / 2, s.axis + 3.0, -ACROSS, 7.2, 3.0)
    _greenery(s, 0, 12, land=(0, s.axis - t.BANK_FOOT, t.PITCH_U, 2 * t.BANK_FOOT))


def beside(a: float, b: float, turn: float, along: float, left: float) -> tuple[float, float]:
    """The place `along` and `left` of (a, b), looking in direction `turn`."""
    c, s = math.cos(turn), math.sin(turn)
    return a + along * c - left * s, b + along * s + left * c


def house(s: Site, a, b, turn, half_l, half_w, eave, roof, pitch=0.8, *, plain=False) -> None:
    """One building, with dormers and chimneys (on a flat roof: a rim and machines) unless it is plain.

    The ridge runs along its length; `eave` is meters above the mean ground; `pitch` is rise over run; `roof` is 'flat',
    'gable', 'hip', 'halfhip', 'shed' or 'pyramid'.
    """
    corners = [s.z(*beside(a, b, turn, p * half_l, q * half_w)) for p in (-1, 1) for q in (-1, 1)]
    foot, eave, extras = (
        min(corners) - 0.8,
        sum(corners) / 4 + eave,
        0 if plain else 1 + int(half_l // 4),
    )
    wall, cover = s.rng.choice(["plaster", "brick", "stone"]), s.rng.choice(["tile", "slate"])

    def put(along, left, half_p, half_q, z0, z1, top=cover, side=wall, cuts=()):
        at = beside(a, b, turn, along, left)
        s.box(*at, turn, half_p, half_q, z0, z1, BUILDING, top, side, cuts=cuts)

    if roof == "flat":
        s.built.append(("house", a, b, turn, half_l, half_w, 0.0, 0.0, eave, eave, ()))
        put(0, 0, half_l, half_w, foot, eave, "paving")
        rim = eave + s.draw(0.25, 0.8)
        for side in (-1, 1):
            put(0, side * (half_w - 0.15), half_l, 0.15, eave, rim)
            put(side * (half_l - 0.15), 0, 0.15, half_w, eave, rim)
        for _ in range(extras):
            at, up = (s.draw(-0.75, 0.75) * half_l, s.draw(-0.65, 0.65) * half_w), s.draw(0.7, 2.6)
            put(*at, s.draw(0.5, 2.2), s.draw(0.5, 1.4), eave, eave + up, "metal", "metal")
        return
    rise, overhang, hipped = (
        pitch * half_w,
        0.0 if plain else s.draw(0.2, 0.5),
        roof in ("hip", "pyramid"),
    )
    top, cuts = eave + rise, [(0, side * pitch, eave + rise) for side in (1, -1)]
    if roof == "shed":
        cuts, top = cuts[:1], eave + 2 * rise
    elif roof != "gable":
        slope = {"hip": pitch, "pyramid": rise / half_l, "halfhip": 1.3 * pitch}[roof]
        start = eave + (0.55 * rise if roof == "halfhip" else 0.0)
        cuts += [(side * slope, 0, start + slope * half_l) for side in (1, -1)]
    s.built.append(("house", a, b, turn, half_l, half_w, overhang / 2, overhang, eave, top, cuts))
    put(0, 0, half_l, half_w, foot, top, cuts=cuts)
    put(
        0,
        0,
        half_l + overhang / 2,
        half_w + overhang,
        eave - overhang * pitch - 0.18,
        top,
        cuts=cuts,
    )
    for n in range(extras):  # dormers on both sides, and a chimney
        along = half_l * ((n + 0.5) / extras * 1.7 - 0.85) * (0.3 if hipped else 1.0)
        for side in () if hipped else (-1, 1):
            put(
                along,
                side * 0.55 * half_w,
                0.8,
                s.draw(0.2, 0.26) * half_w,
                eave,
                top + 0.1 - 0.3 * rise,
            )
        put(
            along + 1.2,
            s.draw(-0.35, 0.35) * half_w,
            0.35,
            0.3,
            eave,
            top + s.draw(0.3, 0.9),
            "brick",
        )


def thing(s: Site, a, b, turn, half_l, half_w, height, above=-0.4) -> None:
    """A plain box on the ground: a kiosk, a container, a bin, a bench, a part of a car."""
    z = s.z(a, b)
    s.box(a, b, turn, half_l, half_w, z + above, z + height, UNCLASSIFIED, "metal")


def car(s: Site, a, b, turn) -> None:
    """A parked car, or a van."""
    half = s.draw(1.85, 2.6)
    thing(s, a, b, turn, half, 0.9, 0.9 if half < 2.5 else 2.2, 0.18)
    thing(s, *beside(a, b, turn, -0.2, 0), turn, 0.62 * half, 0.78, s.draw(1.4, 1.7), 0.9)


def hedge(s: Site, a, b, turn, length, height, half=0.4, *, wall=False) -> None:
    """A clipped hedge from (a, b) in direction `turn`, or a garden wall, stepping with the ground."""
    count = math.ceil(length / 2.5)
    code, what, leafy = (
        (UNCLASSIFIED, "brick", 0.0) if wall else (VEGETATION, "leaf", s.draw(1.8, 3.0))
    )
    for n in range(count):
        at = beside(a, b, turn, (n + 0.5) * length / count, 0)
        z, up = s.z(*at), height * s.draw(0.94, 1.06)
        s.box(
            *at,
            turn,
            length / count / 2,
            0.1 if wall else half,
            z - 0.3,
            z + up,
            code,
            what,
            leafy=leafy,
        )


def mast(s: Site, a, b, turn, height, arm) -> None:
    """A lamp post or a railway mast: a pole with an arm."""
    z = s.z(a, b) + height
    s.bar((a, b, z - height), (a, b, z), 0.1, POLE, "metal")
    s.bar((a, b, z - 0.3), (*beside(a, b, turn, arm, 0), z - 0.2), 0.1, POLE, "metal")


def cable(s: Site, start, end, sag: float) -> None:
    """A conductor between two places (a, b, z) that hangs by `sag` meters in the middle (a parabola)."""
    places = [[p + n / 6 * (q - p) for p, q in zip(start, end, strict=True)] for n in range(7)]
    for n, place in enumerate(places):
        place[2] -= sag * n * (6 - n) / 9
    s.built.append(("cable", start, end))
    for p, q in itertools.pairwise(places):
        s.bar(p, q, 0.03, WIRE, "metal")


def tree(s: Site, a, b, low, high, conifers=0.25) -> None:
    """A tree of some height: with the share `conifers` a spire, else a crown of boughs, dense or thin."""
    height, z = s.draw(low, high), s.z(a, b)
    s.bar((a, b, z - 0.1), (a, b, z + 0.55 * height), 0.06 + 0.011 * height, VEGETATION, "bark")
    if s.chance() < conifers:
        steep, top, foot = s.draw(4.5, 7.0), z + 1.1 * height, z + height * s.draw(0.04, 0.14)
        half, eighths = (top - foot) / steep, [n * math.pi / 4 for n in range(8)]
        s.built.append(("tree", a, b, 1.1 * height, half))
        sides = [(steep * math.cos(way), steep * math.sin(way), top) for way in eighths]
        s.box(
            a, b, 0.2, half, half, foot, top, VEGETATION, "leaf", cuts=sides, leafy=s.draw(0.6, 1.0)
        )
        return
    leafy = s.draw(0.5, 0.9) if s.chance() < 0.8 else s.draw(0.15, 0.3)
    radius, bole = height * s.draw(0.26, 0.4), height * s.draw(0.18, 0.3)
    half = 0.5 * (height - bole)
    s.built.append(("tree", a, b, height, radius))
    s.ball(a, b, z + bole + half, 0.7 * radius, 0.7 * radius, half, leafy)
    for n in range(5):
        at = beside(a, b, 2 * math.pi * (n + s.draw(-0.3, 0.3)) / 5, radius * s.draw(0.4, 0.6), 0)
        r, rz = radius * s.draw(0.42, 0.62), half * s.draw(0.4, 0.6)
        s.ball(
            *at,
            z + bole + rz + 2 * (half - rz) * s.draw(0.15, 0.85),
            r,
            r * s.draw(0.8, 1.2),
            rz,
            leafy,
        )


def shrub(s: Site, a, b) -> None:
    """A bush that touches the ground."""
    height = s.draw(0.35, 2.4)
    r = height * s.draw(0.45, 0.85)
    s.ball(a, b, s.z(a, b) + 0.4 * height, r, r * s.draw(0.8, 1.25), 0.6 * height, s.draw(1.2, 2.2))
