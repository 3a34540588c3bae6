"""Pulses through a scene: sub-beams of one footprint, what each meets first, and the returns they make."""

from __future__ import annotations

import math

import numpy as np

from ..base.jit import njit
from . import plan as _plan
from .materials import CODE
from .plan import ground
from .random import gauss, lattice, mix, unit, value_noise
from .scene import CELL, CONE, CONVEX, ELLIPSOID, VEGETATION

SUB_BEAMS = 5
MAX_RETURNS = 5
#: Returns closer in range than this are one (half the length of a 4 ns pulse).
SEPARATION = 0.6
LOW_VEGETATION, MEDIUM_VEGETATION = 0.5, 2.0

_WATER, _QUAY, _CROP, _LAWN = _plan.WATER, _plan.QUAY, _plan.CROP, _plan.LAWN
_STONE, _GRASS, _AIR = CODE["stone"], CODE["grass"], CODE["air"]
_SURFACE = np.array(
    [CODE[n] for n in ("asphalt", "paving", "lawn", "water", "stone", "gravel", "paving", "soil", "asphalt")],
    dtype=np.int64,
)


@njit
def _ground_range(ox, oy, oz, dx, dy, dz, guess, g):
    """Range to the ground along a steep downward ray: fixed point, else march and halve."""
    t = guess
    for _ in range(14):
        z, surface = ground(ox + t * dx, oy + t * dy, g)
        h = oz + t * dz - z
        if abs(h) < 0.002:
            return t, surface
        t -= h / dz
    t -= 8.0
    for _ in range(160):
        z, surface = ground(ox + t * dx, oy + t * dy, g)
        if oz + t * dz <= z:
            break
        t += 0.1
    low, high = t - 0.1, t
    for _ in range(8):
        t = 0.5 * (low + high)
        z, surface = ground(ox + t * dx, oy + t * dy, g)
        if oz + t * dz <= z:
            high = t
        else:
            low = t
    return high, surface


@njit
def _interval(p, label, planes, ox, oy, oz, dx, dy, dz):
    """Ranges at which a ray enters and leaves a thing (enter > leave: missed), and the entry's normal."""
    near, far = -1e30, 1e30
    nx, ny, nz = -dx, -dy, -dz
    kind = label[2]
    if kind == CONVEX:
        for n in range(label[0], label[0] + label[1]):
            a, b, c = planes[n, 0], planes[n, 1], planes[n, 2]
            towards = a * dx + b * dy + c * dz
            gap = planes[n, 3] - (a * ox + b * oy + c * oz)
            if towards < 0.0:
                t = gap / towards
                if t > near:
                    near, nx, ny, nz = t, a, b, c
            elif towards > 0.0:
                far = min(far, gap / towards)
            elif gap < 0.0:
                return 1.0, 0.0, nx, ny, nz
            if near >= far:
                return 1.0, 0.0, nx, ny, nz
        return near, far, nx, ny, nz
    if kind == ELLIPSOID:
        qx, qy, qz = (ox - p[0]) / p[3], (oy - p[1]) / p[4], (oz - p[2]) / p[5]
        ex, ey, ez = dx / p[3], dy / p[4], dz / p[5]
        a = ex * ex + ey * ey + ez * ez
        b = ex * qx + ey * qy + ez * qz
        root = b * b - a * (qx * qx + qy * qy + qz * qz - 1.0)
        if root <= 0.0:
            return 1.0, 0.0, nx, ny, nz
        root = math.sqrt(root)
        return (-b - root) / a, (-b + root) / a, nx, ny, nz
    if kind == CONE:
        k = p[4] / (p[2] - p[3])
        k *= k
        qx, qy, qz = ox - p[0], oy - p[1], oz - p[2]
        a = dx * dx + dy * dy - k * dz * dz
        b = dx * qx + dy * qy - k * dz * qz
        root = b * b - a * (qx * qx + qy * qy - k * qz * qz)
        if root <= 0.0 or abs(a) < 1e-12:
            return 1.0, 0.0, nx, ny, nz
        root = math.sqrt(root)
        near, far = (p[2] - oz) / dz, (p[3] - oz) / dz  # below the apex, above the base
        r1, r2 = min((-b - root) / a, (-b + root) / a), max((-b - root) / a, (-b + root) / a)
        if a > 0.0:
            near, far = max(near, r1), min(far, r2)
        else:  # steeper than the cone's side: inside the lower half from r2 on
            near = max(near, r2)
        return near, far, nx, ny, nz
    # ROD: nearest approach of the ray and the segment.
    sx, sy, sz = p[3] - p[0], p[4] - p[1], p[5] - p[2]
    wx, wy, wz = ox - p[0], oy - p[1], oz - p[2]
    b = dx * sx + dy * sy + dz * sz
    c = sx * sx + sy * sy + sz * sz
    d, e = dx * wx + dy * wy + dz * wz, sx * wx + sy * wy + sz * wz
    det = c - b * b
    along = min(max((e - b * d) / det, 0.0), 1.0) if det > 1e-12 else 0.0
    t = along * b - d
    gx, gy, gz = wx + t * dx - along * sx, wy + t * dy - along * sy, wz + t * dz - along * sz
    away = gx * gx + gy * gy + gz * gz
    if away > p[6] * p[6]:
        return 1.0, 0.0, nx, ny, nz
    return t - 0.5 * p[6], t + 0.5 * p[6], nx, ny, nz


@njit
def _depth(p, label, near, far, ox, oy, oz, dx, dy, dz, key):
    """Range at which a beam is caught inside a porous thing, or -1: free paths among clumps."""
    key = mix(key ^ np.uint64(label[6]))
    place = np.uint64(label[6])
    most = 1.7 * p[7]
    t = near
    for _ in range(64):
        key = mix(key)
        t -= math.log(1.0 - unit(key)) / most
        if t >= far:
            return -1.0
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        thick = 0.25 + 1.45 * lattice(math.floor(x / 0.55), math.floor(y / 0.55), math.floor(z / 0.55), place)
        if label[2] == ELLIPSOID:  # leaves hang on the outside
            q = ((x - p[0]) / p[3]) ** 2 + ((y - p[1]) / p[4]) ** 2 + ((z - p[2]) / p[5]) ** 2
            thick *= 0.35 + 0.65 * q
        key = mix(key)
        if unit(key) * 1.7 < thick:
            return t
    return -1.0


@njit
def _first_thing(scene, ox, oy, oz, dx, dy, dz, limit, key):
    """Nearest thing met before range `limit`: range, index (-1: none), cosine of incidence, upward part."""
    best, index, cosine, up = limit, -1, 1.0, 1.0
    x0, y0, nx, ny = scene.grid[0], scene.grid[1], int(scene.grid[2]), int(scene.grid[3])
    t = (scene.grid[4] - oz) / dz
    if t >= limit:
        return best, index, cosine, up
    t = max(t, 0.0)
    x, y = (ox + t * dx - x0) / CELL, (oy + t * dy - y0) / CELL
    i, j = math.floor(x), math.floor(y)
    step_i, step_j = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
    every_i = CELL / abs(dx) if abs(dx) > 1e-12 else 1e30
    every_j = CELL / abs(dy) if abs(dy) > 1e-12 else 1e30
    next_i = t + ((i + 1 - x) if dx > 0 else (x - i)) * every_i if every_i < 1e29 else 1e30
    next_j = t + ((j + 1 - y) if dy > 0 else (y - j)) * every_j if every_j < 1e29 else 1e30
    while t < best:
        leave = min(next_i, next_j)
        if 0 <= i < nx and 0 <= j < ny:
            c = i * ny + j
            if oz + min(leave, best) * dz <= scene.top[c]:
                for m in range(scene.start[c], scene.start[c + 1]):
                    n = scene.member[m]
                    shape, label = scene.shape[n], scene.label[n]
                    # Above or below it all along this cell: no need to look closer.
                    if oz + t * dz < scene.box[n, 2] or oz + leave * dz > scene.box[n, 5]:
                        continue
                    near, far, a, b, c3 = _interval(shape, label, scene.planes, ox, oy, oz, dx, dy, dz)
                    if near >= far or near >= best:
                        continue
                    if shape[7] > 0.0:
                        near = _depth(shape, label, near, min(far, best), ox, oy, oz, dx, dy, dz, key)
                        if near < 0.0 or near >= best:
                            continue
                    best, index = near, n
                    cosine, up = abs(a * dx + b * dy + c3 * dz), c3
        if next_i < next_j:
            t, i, next_i = next_i, i + step_i, next_i + every_i
        else:
            t, j, next_j = next_j, j + step_j, next_j + every_j
    return best, index, cosine, up


@njit
def cast(origin, direction, pulse_id, scene, g, reflectance, setting, seed, xyz, byte, height, pulse):
    """Returns of a block of pulses.

    Parameters
    ----------
    origin, direction : (n, 3) float64
        Sensor positions (local metres) and unit directions, pointing down.
    pulse_id : (n,) uint64
        Numbers unique to each pulse: with `seed` they fix all chance.
    scene, g : Scene, Ground
    reflectance : (m,) float64
        By material.
    setting : (8,) float64
        Half divergence in radians, range noise in metres, share of pulses with an outlier,
        town size, nominal range, pointing noise in metres, nominal height of the ground, unused.
    xyz, byte, height, pulse : output arrays of n * 5 rows
        Points; class, return number, number of returns, material, intensity / 256, intensity % 256;
        height above true ground; row of the pulse.

    Returns
    -------
    count, lost : int
        Points written, and pulses that came back empty or only partly inside the town.
    """
    half_angle, noise, outliers, size = setting[0], setting[1], setting[2], setting[3]
    base = mix(np.uint64(seed))
    count, lost = 0, 0
    ranges = np.empty(SUB_BEAMS)
    codes = np.empty(SUB_BEAMS, dtype=np.int64)
    mats = np.empty(SUB_BEAMS, dtype=np.int64)
    echo = np.empty(SUB_BEAMS)
    votes = np.zeros(256, dtype=np.int64)
    for n in range(origin.shape[0]):
        ox, oy, oz = origin[n, 0], origin[n, 1], origin[n, 2]
        dx, dy, dz = direction[n, 0], direction[n, 1], direction[n, 2]
        key = mix(base ^ pulse_id[n])
        guess = (setting[6] - oz) / dz
        # Two directions across the beam.
        flat = math.sqrt(dx * dx + dz * dz)
        ax, az = dz / flat, -dx / flat
        bx, by, bz = dy * az, dz * ax - dx * az, -dy * ax
        turn = 2.0 * math.pi * unit(key)
        met = 0
        for s in range(SUB_BEAMS):
            key = mix(key)
            px, py, pz = ox, oy, oz
            if s:
                r = 0.7 * half_angle * guess
                e = r * math.cos(turn + 0.5 * math.pi * s)
                f = r * math.sin(turn + 0.5 * math.pi * s)
                px, py, pz = ox + e * ax + f * bx, oy + f * by, oz + e * az + f * bz
            t, surface = _ground_range(px, py, pz, dx, dy, dz, guess, g)
            if s == 0:
                guess = t
            best, index, cosine, up = _first_thing(scene, px, py, pz, dx, dy, dz, t, key)
            if index >= 0:
                code = scene.label[index, 3]
                mat = scene.label[index, 4] if up > 0.3 else scene.label[index, 5]
                if scene.shape[index, 7] > 0.0:
                    cosine = 0.45 + 0.5 * unit(mix(key))
            else:
                code, mat, cosine = 2, _SURFACE[surface], -dz
                if surface == _WATER:
                    # A mirror: little comes back, and less the farther from the vertical.
                    code = 9
                    if unit(mix(key)) > 0.015 + 0.25 * math.exp(-((1.0 + dz) * 120.0)):
                        continue
                elif surface == _QUAY:
                    code, mat = 1, _STONE
                elif surface in (_CROP, _LAWN):
                    x, y = px + t * dx, py + t * dy
                    wild = value_noise(x / 6.0 + 50.0, y / 6.0, g.key) - (0.40 if surface == _CROP else 0.62)
                    tall = min(0.55, 2.2 * wild) * unit(mix(key)) if wild > 0.0 else 0.0
                    if tall > 0.08:
                        t += tall / dz
                        code, mat = VEGETATION, _GRASS
                best = t
            # Insertion by range.
            m = met
            while m > 0 and ranges[m - 1] > best:
                ranges[m], codes[m], mats[m], echo[m] = ranges[m - 1], codes[m - 1], mats[m - 1], echo[m - 1]
                m -= 1
            ranges[m], codes[m], mats[m] = best, code, mat
            echo[m] = reflectance[mat] * max(cosine, 0.05)
            met += 1
        key = mix(key)
        low = -1.0
        if outliers > 0.0 and unit(key) < outliers:
            low = unit(mix(key))
            if low >= 0.7 and met > 0:  # a bird catches the first part of the beam
                ranges[0] -= 40.0 + 60.0 * unit(mix(key ^ np.uint64(1)))
                codes[0], mats[0], echo[0] = 18, _AIR, 0.1
            elif met == SUB_BEAMS:
                met -= 1
        first = count
        inside = True
        m = 0
        while m < met or (low >= 0.0 and low < 0.7 and m == met and met > 0):
            if m == met:  # a path by way of a second mirror: below the ground
                t = max(ranges[met - 1], guess) + 1.5 + 8.0 * unit(mix(key ^ np.uint64(2)))
                code, mat, power, m = 7, _AIR, 0.04, met + 1
            else:
                last = m
                while last + 1 < met and ranges[last + 1] - ranges[last] < SEPARATION:
                    last += 1
                code = codes[m]
                for q in range(m, last + 1):
                    votes[codes[q]] += 1
                for q in range(m, last + 1):
                    if votes[codes[q]] > votes[code]:
                        code = codes[q]
                t, power, share, mat = 0.0, 0.0, 0, 0
                for q in range(m, last + 1):
                    votes[codes[q]] = 0
                    power += echo[q] / SUB_BEAMS
                    if codes[q] == code:
                        t += ranges[q]
                        mat = mats[q]
                        share += 1
                t /= share
                m = last + 1
            key = mix(key)
            t += noise * gauss(key)
            key = mix(key)
            x = ox + t * dx + setting[5] * gauss(key)
            key = mix(key)
            y = oy + t * dy + setting[5] * gauss(key)
            x, y = math.floor(x * 1000.0 + 0.5) / 1000.0, math.floor(y * 1000.0 + 0.5) / 1000.0
            z = math.floor((oz + t * dz) * 1000.0 + 0.5) / 1000.0
            if not (0.0 <= x < size and 0.0 <= y < size):
                inside = False
                break
            above = z - ground(x, y, g)[0]
            if code == VEGETATION:
                code = 3 if above < LOW_VEGETATION else (4 if above < MEDIUM_VEGETATION else 5)
            key = mix(key)
            power *= (setting[4] / t) ** 2 * math.exp(0.12 * gauss(key))
            strength = int(min(max(power * 4000.0, 1.0), 65535.0))
            xyz[count, 0], xyz[count, 1], xyz[count, 2] = x, y, z
            byte[count, 0], byte[count, 1], byte[count, 3] = code, count - first + 1, mat
            byte[count, 4], byte[count, 5] = strength // 256, strength % 256
            height[count] = above
            pulse[count] = n
            count += 1
        if not inside:
            count = first
        if count == first:
            lost += 1
        for q in range(first, count):
            byte[q, 2] = count - first
    return count, lost
