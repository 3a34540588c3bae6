"""Pulses through a scene: sub-beams of one footprint, what each meets first, and the returns they make."""

from __future__ import annotations

import math

import numpy as np

from ..base.jit import device, njit
from .solids import CELL, CLASS, COUNT, FIRST, LEAFY, SIDE, STEP, TOP, VEGETATION
from .townplan import GRASS, LAWN, REFLECTANCE, SOIL, WATER, ground, patches

SUB_BEAMS = 5  # a pulse has at most as many returns
HALF_DIVERGENCE = 0.25e-3  # radians from the middle of a beam to its outer sub-beams
SEPARATION = 0.6  # meters; returns closer in range are one (half the length of a 4 ns pulse)


@device
def ground_range(ox, oy, oz, dx, dy, dz, t, plan):
    """Range to the ground along a steep beam, and the material, from a guess: gentle slopes let steps converge."""
    for _ in range(30):
        z, material = ground(ox + t * dx, oy + t * dy, plan)
        if abs(oz + t * dz - z) < 0.001:
            break
        t -= (oz + t * dz - z) / dz
    return t, material


@device
def _crossing(things, planes, n, ox, oy, oz, dx, dy, dz):
    """Ranges at which a beam enters and leaves thing n (enter >= leave: missed), and the face entered (-1: none)."""
    near, far, face = -1e30, 1e30, -1
    first, count = int(things[n, FIRST]), int(things[n, COUNT])
    for m in range(first, first + count):
        towards = planes[m, 0] * dx + planes[m, 1] * dy + planes[m, 2] * dz
        t = (planes[m, 3] - planes[m, 0] * ox - planes[m, 1] * oy - planes[m, 2] * oz) / towards
        if towards >= 0.0:
            far = min(far, t)
        elif t > near:
            near, face = t, m
        if near >= far:
            break
    if count == 0:  # the ellipsoid that fills its box
        a = b = c = 0.0
        for p, d, k in ((ox, dx, 0), (oy, dy, 1), (oz, dz, 2)):
            half = 0.5 * (things[n, k + 3] - things[n, k])
            q, e = (p - things[n, k]) / half - 1.0, d / half
            a, b, c = a + e * e, b + e * q, c + q * q
        root = math.sqrt(max(b * b - a * (c - 1.0), 0.0))
        near, far = (-b - root) / a, (-b + root) / a
    return near, far, face


@njit
def first_hit(scene, ox, oy, oz, dx, dy, dz, limit, tested, beam, rng):
    """The nearest thing a beam meets before range `limit`: range, thing (-1: none), face (-1: round).

    ``tested`` (n,) holds the last beam that tried each thing, so that none is tried twice.
    """
    best, index, hit_face = limit, -1, -1
    step = STEP / max(math.hypot(dx, dy), 1e-6)
    t = max((scene.corner[2] - oz) / dz, 0.0)
    while t - step < best:
        i = math.floor((ox + t * dx - scene.corner[0]) / CELL)
        j = math.floor((oy + t * dy - scene.corner[1]) / CELL)
        high, low = oz + (t - step) * dz, oz + (t + step) * dz
        t += step
        if not (0 <= i < scene.top.shape[0] and 0 <= j < scene.top.shape[1] and low <= scene.top[i, j]):
            continue
        cell = i * scene.top.shape[1] + j
        for m in range(scene.start[cell], scene.start[cell + 1]):
            n = scene.member[m]
            if tested[n] == beam or low > scene.things[n, 5] or high < scene.things[n, 2]:
                continue
            tested[n] = beam
            near, far, face = _crossing(scene.things, scene.planes, n, ox, oy, oz, dx, dy, dz)
            if near < min(far, best) and scene.things[n, LEAFY] > 0.0:  # a free way among leaves
                near -= math.log(1.0 - rng.random()) / scene.things[n, LEAFY]
            if near < min(far, best):
                best, index, hit_face = near, n, face
    return best, index, hit_face


@njit
def cast(origin, direction, scene, plan, rng):
    """Returns of pulses, in order of pulse and range.

    Sensor positions (n, 3) are town coordinates, unit directions (n, 3) point down steeply. Returns an (m, 7) array:
    range, u, v, z, class (or VEGETATION), echo (0 to 1), row of the pulse.
    """
    out, hit, count = np.empty((origin.shape[0] * SUB_BEAMS, 7)), np.empty((SUB_BEAMS, 7)), 0
    things, tested = scene.things, np.full(scene.things.shape[0], -1)
    order = np.empty(SUB_BEAMS, np.int64)
    for pulse in range(origin.shape[0]):
        ox, oy, oz = origin[pulse, 0], origin[pulse, 1], origin[pulse, 2]
        dx, dy, dz = direction[pulse, 0], direction[pulse, 1], direction[pulse, 2]
        limit, turn = -oz / dz, 2.0 * math.pi * rng.random()
        for s in range(SUB_BEAMS):
            r, way = HALF_DIVERGENCE * limit if s else 0.0, turn + 0.5 * math.pi * s
            x, y = ox + r * math.cos(way), oy + r * math.sin(way)
            limit, material = ground_range(x, y, oz, dx, dy, dz, limit, plan)
            t, n, face = first_hit(scene, x, y, oz, dx, dy, dz, limit, tested, pulse * SUB_BEAMS + s, rng)
            x, y, code, cosine = x + t * dx, y + t * dy, 2, -dz
            if n >= 0:
                normal = scene.planes[face]
                code, material = int(things[n, CLASS]), int(things[n, TOP if normal[2] > 0.3 else SIDE])
                cosine = abs(normal[0] * dx + normal[1] * dy + normal[2] * dz)
                if things[n, LEAFY] > 0.0:
                    cosine = 0.45 + 0.5 * rng.random()
            elif material == WATER:  # a mirror: little comes back, and less the farther from the vertical
                code = 9
                if rng.random() > 0.015 + 0.25 * math.exp(-120.0 * (1.0 + dz)):
                    t = math.inf
            elif material in (SOIL, LAWN):  # here and there the grass stands high
                wild = patches(1.5 * x, 1.5 * y) - (0.45 if material == SOIL else 0.72)
                tall = min(0.55, 2.2 * max(wild, 0.0)) * rng.random()
                if tall > 0.08:
                    t, code, material = t + tall / dz, VEGETATION, GRASS
            hit[s, 0], hit[s, 1], hit[s, 2], hit[s, 3] = t, x, y, oz + t * dz
            hit[s, 4], hit[s, 5], hit[s, 6] = code, cosine * REFLECTANCE[material] / SUB_BEAMS, pulse
        for s in range(SUB_BEAMS):  # by range; numpy's sort takes seconds to compile
            place = s
            while place > 0 and hit[order[place - 1], 0] > hit[s, 0]:
                order[place] = order[place - 1]
                place -= 1
            order[place] = s
        first = 0
        while first < SUB_BEAMS and hit[order[first], 0] < math.inf:  # what is close in range is one return
            last, echo = first, hit[order[first], 5]
            while last + 1 < SUB_BEAMS and hit[order[last + 1], 0] - hit[order[last], 0] < SEPARATION:
                last += 1
                echo += hit[order[last], 5]
            for k in range(7):
                out[count, k] = hit[order[(first + last) // 2], k]
            out[count, 5] = echo
            first, count = last + 1, count + 1
    return out[:count]
