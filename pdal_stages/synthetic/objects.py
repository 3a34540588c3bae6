"""Houses, cars, street furniture, wires and plants, made of the solids of a site."""

from __future__ import annotations

import itertools
import math

from .solids import BUILDING, POLE, UNCLASSIFIED, VEGETATION, WIRE, Site


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
    foot, eave, extras = min(corners) - 0.8, sum(corners) / 4 + eave, 0 if plain else 1 + int(half_l // 4)
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
    rise, overhang, hipped = pitch * half_w, 0.0 if plain else s.draw(0.2, 0.5), roof in ("hip", "pyramid")
    top, cuts = eave + rise, [(0, side * pitch, eave + rise) for side in (1, -1)]
    if roof == "shed":
        cuts, top = cuts[:1], eave + 2 * rise
    elif roof != "gable":
        slope = {"hip": pitch, "pyramid": rise / half_l, "halfhip": 1.3 * pitch}[roof]
        start = eave + (0.55 * rise if roof == "halfhip" else 0.0)
        cuts += [(side * slope, 0, start + slope * half_l) for side in (1, -1)]
    s.built.append(("house", a, b, turn, half_l, half_w, overhang / 2, overhang, eave, top, cuts))
    put(0, 0, half_l, half_w, foot, top, cuts=cuts)
    put(0, 0, half_l + overhang / 2, half_w + overhang, eave - overhang * pitch - 0.18, top, cuts=cuts)
    for n in range(extras):  # dormers on both sides, and a chimney
        along = half_l * ((n + 0.5) / extras * 1.7 - 0.85) * (0.3 if hipped else 1.0)
        for side in () if hipped else (-1, 1):
            put(along, side * 0.55 * half_w, 0.8, s.draw(0.2, 0.26) * half_w, eave, top + 0.1 - 0.3 * rise)
        put(along + 1.2, s.draw(-0.35, 0.35) * half_w, 0.35, 0.3, eave, top + s.draw(0.3, 0.9), "brick")


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
    code, what, leafy = (UNCLASSIFIED, "brick", 0.0) if wall else (VEGETATION, "leaf", s.draw(1.8, 3.0))
    for n in range(count):
        at = beside(a, b, turn, (n + 0.5) * length / count, 0)
        z, up = s.z(*at), height * s.draw(0.94, 1.06)
        s.box(*at, turn, length / count / 2, 0.1 if wall else half, z - 0.3, z + up, code, what, leafy=leafy)


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
        s.box(a, b, 0.2, half, half, foot, top, VEGETATION, "leaf", cuts=sides, leafy=s.draw(0.6, 1.0))
        return
    leafy = s.draw(0.5, 0.9) if s.chance() < 0.8 else s.draw(0.15, 0.3)
    radius, bole = height * s.draw(0.26, 0.4), height * s.draw(0.18, 0.3)
    half = 0.5 * (height - bole)
    s.built.append(("tree", a, b, height, radius))
    s.ball(a, b, z + bole + half, 0.7 * radius, 0.7 * radius, half, leafy)
    for n in range(5):
        at = beside(a, b, 2 * math.pi * (n + s.draw(-0.3, 0.3)) / 5, radius * s.draw(0.4, 0.6), 0)
        r, rz = radius * s.draw(0.42, 0.62), half * s.draw(0.4, 0.6)
        s.ball(*at, z + bole + rz + 2 * (half - rz) * s.draw(0.15, 0.85), r, r * s.draw(0.8, 1.2), rz, leafy)


def shrub(s: Site, a, b) -> None:
    """A bush that touches the ground."""
    height = s.draw(0.35, 2.4)
    r = height * s.draw(0.45, 0.85)
    s.ball(a, b, s.z(a, b) + 0.4 * height, r, r * s.draw(0.8, 1.25), 0.6 * height, s.draw(1.2, 2.2))
