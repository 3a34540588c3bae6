"""Ray casting: the grid that finds solids, and the returns of pulses of five sub-beams each.

A beam travels a random distance into a leafy solid (Beer and Lambert), or through it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..base.jit import device, njit
from .districts import VEGETATION
from .townplan import GRASS, LAWN, REFLECTANCE, SOIL, WATER, Plan, ground, smooth_noise

# Columns of a solid after its bounding box (lowest u, v, z, highest u, v, z).
FIRST = 6  #: its first plane
COUNT = 7  #: its number of planes; 0 for an ellipsoid
CLASS = 8
TOP = 9  #: material
SIDE = 10  #: material
EXTINCTION = 11  #: 1/m
#: Side of a cell, meters.
CELL = 3.0
#: Distance between two looks along a beam, meters; a solid is listed half of it around its box.
STEP = 1.5
#: Sub-beams of a pulse, which has at most as many returns.
SUB_BEAMS = 5
#: Angle from the middle of a pulse to its outer sub-beams, radians.
HALF_DIVERGENCE = 0.25e-3
#: Returns closer in range are one, meters: half the length of a pulse of 4 ns.
SEPARATION = 0.6
# The echo of surfaces; not measured.
#: A face whose normal points up by more is made of a solid's top material, others of its side's.
TOP_NORMAL = 0.3
#: Lowest cosine of the angle at which a beam meets a leaf, and how far others are above it.
LEAF_COSINE = 0.45
LEAF_COSINES = 0.5
#: Share of beams that water returns from everywhere, and more of them from straight above.
WATER_SHARE = 0.015
MIRROR_SHARE = 0.25
#: The latter falls to 1/e where 1 - the cosine of the beam's angle is 1 over this: 7 degrees.
MIRROR_NARROWNESS = 120.0
# High grass on soil and lawns: it stands where smooth noise exceeds a limit.
GRASS_FREQUENCY = 1.5  #: of that noise / that of the paving of courts
SOIL_LIMIT = 0.45
LAWN_LIMIT = 0.72
GRASS_RISE = 2.2  #: its height for each unit above the limit, meters
MAX_GRASS = 0.55  #: its largest height, meters
MIN_GRASS = 0.08  #: lower grass is ground, meters


class Scene(NamedTuple):
    """Solids of a part of the town, and the grid cells that list them."""

    solids: np.ndarray  #: (n, 12) see the columns above
    planes: np.ndarray  #: (m, 4) outward normal and offset; inside is n.p <= offset
    start: np.ndarray  #: (nu * nv + 1,) first entry of each cell in ``member``
    member: np.ndarray  #: indices of solids
    top: np.ndarray  #: (nu, nv) highest z in each cell
    corner: np.ndarray  #: u and v of the grid's low corner; highest z of all


def build_scene(
    sites: list[tuple[np.ndarray, np.ndarray]], low: np.ndarray, high: np.ndarray
) -> Scene:
    """Join solids and planes of sites that touch a rectangle, and list the solids by cell."""
    solids, planes = (np.concatenate(arrays) for arrays in zip(*sites, strict=True))
    counts = [len(planes) for _, planes in sites]
    solids[:, FIRST] += np.repeat(np.cumsum(counts) - counts, [len(solids) for solids, _ in sites])
    solids = solids[((solids[:, :2] < high) & (solids[:, 3:5] > low)).all(axis=1)]
    shape = np.ceil((high - low) / CELL).astype(np.int64)
    first = np.floor((solids[:, :2] - STEP / 2 - low) / CELL).astype(np.int64).clip(0)
    last = np.floor((solids[:, 3:5] + STEP / 2 - low) / CELL).astype(np.int64)
    wide = (np.minimum(last, shape - 1) - first + 1).clip(0)
    count = wide.prod(axis=1)
    solid = np.repeat(np.arange(len(solids)), count)
    nth = np.arange(len(solid)) - np.repeat(np.cumsum(count) - count, count)
    i, j = first[solid, 0] + nth // wide[solid, 1], first[solid, 1] + nth % wide[solid, 1]
    cell = i * shape[1] + j
    top, order = np.full(shape.prod(), -1e30), np.argsort(cell, kind="stable")
    np.maximum.at(top, cell, solids[solid, 5])
    start = np.searchsorted(cell[order], np.arange(len(top) + 1))
    corner = np.array([*low, top.max()])
    return Scene(solids, planes, start, solid[order], top.reshape(shape), corner)


@device
def _ground_range(ray, t, plan):
    """Return the range to the ground along a steep ray, from a guess `t`, and the material."""
    ox, oy, oz, dx, dy, dz = ray
    for _ in range(30):  # slopes are gentle, so steps converge
        z, material = ground(ox + t * dx, oy + t * dy, plan)
        if abs(oz + t * dz - z) < 0.001:
            break
        t -= (oz + t * dz - z) / dz
    return t, material


@device
def _crossing(solids, planes, n, ray):
    """Return the ranges at which a ray enters and leaves a solid, and the face it enters (or -1).

    It misses the solid where it enters at or after the range at which it leaves.
    """
    ox, oy, oz, dx, dy, dz = ray
    near, far, face = -1e30, 1e30, -1
    first, count = int(solids[n, FIRST]), int(solids[n, COUNT])
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
            half = 0.5 * (solids[n, k + 3] - solids[n, k])
            q, e = (p - solids[n, k]) / half - 1.0, d / half
            a, b, c = a + e * e, b + e * q, c + q * q
        root = math.sqrt(max(b * b - a * (c - 1.0), 0.0))
        near, far = (-b - root) / a, (-b + root) / a
    return near, far, face


@njit
def first_hit(scene, ray, limit, tested, beam, rng):
    """Find the nearest solid that a ray meets before the range `limit`.

    Parameters
    ----------
    scene : Scene
    ray : tuple of 6 floats
        Origin and unit direction.
    limit : float
    tested : (n,) int64
        The last beam that tried each solid, so that none is tried twice.
    beam : int
        Number of this beam.
    rng : numpy Generator

    Returns
    -------
    range, solid (-1: none), face (-1: of an ellipsoid)
    """
    ox, oy, oz, dx, dy, dz = ray
    best, index, hit_face = limit, -1, -1
    step = STEP / max(math.hypot(dx, dy), 1e-6)
    t = max((scene.corner[2] - oz) / dz, 0.0)
    while t - step < best:
        i = math.floor((ox + t * dx - scene.corner[0]) / CELL)
        j = math.floor((oy + t * dy - scene.corner[1]) / CELL)
        high, low = oz + (t - step) * dz, oz + (t + step) * dz
        t += step
        inside = 0 <= i < scene.top.shape[0] and 0 <= j < scene.top.shape[1]
        if not (inside and low <= scene.top[i, j]):
            continue
        cell = i * scene.top.shape[1] + j
        for m in range(scene.start[cell], scene.start[cell + 1]):
            n = scene.member[m]
            if tested[n] == beam or low > scene.solids[n, 5] or high < scene.solids[n, 2]:
                continue
            tested[n] = beam
            near, far, face = _crossing(scene.solids, scene.planes, n, ray)
            if near < min(far, best) and scene.solids[n, EXTINCTION] > 0.0:
                near -= math.log(1.0 - rng.random()) / scene.solids[n, EXTINCTION]
            if near < min(far, best):
                best, index, hit_face = near, n, face
    return best, index, hit_face


@device
def _sub_beam(scene, plan, ray, guess, tested, beam, rng):
    """Return range (inf for none), u, v, z, class and echo of a sub-beam, and its ground range."""
    ox, oy, oz, dx, dy, dz = ray
    limit, material = _ground_range(ray, guess, plan)
    t, n, face = first_hit(scene, ray, limit, tested, beam, rng)
    x, y, code, cosine = ox + t * dx, oy + t * dy, 2, -dz
    if n >= 0:
        normal, solid = scene.planes[face], scene.solids[n]
        code, material = int(solid[CLASS]), int(solid[TOP if normal[2] > TOP_NORMAL else SIDE])
        cosine = abs(normal[0] * dx + normal[1] * dy + normal[2] * dz)
        if solid[EXTINCTION] > 0.0:
            cosine = LEAF_COSINE + LEAF_COSINES * rng.random()
    elif material == WATER:  # a mirror: little returns, and less the farther from the vertical
        code = 9
        if rng.random() > WATER_SHARE + MIRROR_SHARE * math.exp(-MIRROR_NARROWNESS * (1.0 + dz)):
            t = math.inf
    elif material in (SOIL, LAWN):  # high grass here and there
        wild = smooth_noise(GRASS_FREQUENCY * x, GRASS_FREQUENCY * y)
        wild -= SOIL_LIMIT if material == SOIL else LAWN_LIMIT
        tall = min(MAX_GRASS, GRASS_RISE * max(wild, 0.0)) * rng.random()
        if tall > MIN_GRASS:
            t, code, material = t + tall / dz, VEGETATION, GRASS
    return t, x, y, oz + t * dz, code, cosine * REFLECTANCE[material] / SUB_BEAMS, limit


@device
def _sort_by_range(hit, order):
    """Sort sub-beams by range, by insertion: numpy's sort takes seconds to compile."""
    for s in range(SUB_BEAMS):
        place = s
        while place > 0 and hit[order[place - 1], 0] > hit[s, 0]:
            order[place] = order[place - 1]
            place -= 1
        order[place] = s


@njit
def cast(origin, direction, scene, plan: Plan, rng):
    """Return the returns of pulses, in order of pulse and range.

    Parameters
    ----------
    origin : (n, 3) float64
        Positions of the sensor, town coordinates.
    direction : (n, 3) float64
        Unit vectors that point down steeply.
    scene : Scene
    plan : Plan
    rng : numpy Generator

    Returns
    -------
    (m, 7) float64
        Range, u, v, z, class (or VEGETATION), echo (0 to 1), row of the pulse.
    """
    out, hit, count = np.empty((origin.shape[0] * SUB_BEAMS, 7)), np.empty((SUB_BEAMS, 7)), 0
    tested, order = np.full(scene.solids.shape[0], -1), np.empty(SUB_BEAMS, np.int64)
    for pulse in range(origin.shape[0]):
        ox, oy, oz = origin[pulse, 0], origin[pulse, 1], origin[pulse, 2]
        dx, dy, dz = direction[pulse, 0], direction[pulse, 1], direction[pulse, 2]
        limit, turn = -oz / dz, 2.0 * math.pi * rng.random()
        for s in range(SUB_BEAMS):
            r, angle = HALF_DIVERGENCE * limit if s else 0.0, turn + 0.5 * math.pi * s
            ray = (ox + r * math.cos(angle), oy + r * math.sin(angle), oz, dx, dy, dz)
            beam = pulse * SUB_BEAMS + s
            t, x, y, z, code, echo, limit = _sub_beam(scene, plan, ray, limit, tested, beam, rng)
            hit[s, 0], hit[s, 1], hit[s, 2], hit[s, 3] = t, x, y, z
            hit[s, 4], hit[s, 5], hit[s, 6] = code, echo, pulse
        _sort_by_range(hit, order)
        first = 0
        while first < SUB_BEAMS and hit[order[first], 0] < math.inf:
            last, echo = first, hit[order[first], 5]
            while (
                last + 1 < SUB_BEAMS and hit[order[last + 1], 0] - hit[order[last], 0] < SEPARATION
            ):
                last += 1
                echo += hit[order[last], 5]
            for k in range(7):
                out[count, k] = hit[order[(first + last) // 2], k]
            out[count, 5] = echo
            first, count = last + 1, count + 1
    return out[:count]
