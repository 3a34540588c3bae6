"""Where one can walk: levels that are part of smooth surfaces, the way from one to the next, and where it ends.

All is of a raster of levels (:func:`.cells.levels`) in cells of a meter. The way ends at a drop (something lies much lower
right ahead, or across emptiness such as water), at nothing (the rim of the cloud) or at whatever else is there.
"""

from __future__ import annotations

import numpy as np

from ..base.jit import device, njit

#: One walks from a cell to another across a step of so many meters, or so much more per meter of distance.
STEP, GRADE = 0.35, 0.25
#: Cells within which the next one to step on is looked for, past cars and parapets; edges are so many cells wide.
AHEAD, EDGE = 5, 3
#: A drop has more than so many meters, and so much per meter of distance.
DROP, WALL = 2.0, 1.25
#: Across emptiness: what lies so many meters lower within `SIGHT` cells, 30 degrees to either side; where nothing is
#: within them, what lies so many lower, and so much per meter of distance, within `FAR` cells, 60 degrees to either side.
BELOW, SIGHT, FAR_BELOW, FAR_SLOPE, FAR = 1.2, 16, 3.0, 0.1, 80
#: Nothing but leaves and lamps so far above the way is emptiness as well.
ABOVE = 1.5
#: Cells of a plane, how many there must be, and their scatter in meters; and the same of a narrow one.
_WIDE, _NARROW = (2, 7, 0.12), (1, 6, 0.06)
#: Rise over run of what one drives on, and of a roof.
LEVEL, STEEP = 0.25, 1.5
#: Kinds of levels: leaves and the like, a plane, one that is level enough to be walked on.
ROUGH, SMOOTH, SOLID = 0, 1, 2
#: How a way ends: not at all, at a drop, at one across emptiness, at nothing, at something else.
ON, DOWN, ACROSS, NOTHING, WALLED = 0, 1, 2, 3, 4
#: Eight directions, and the length of a step, in tenths of cells.
RIGHT, UP = np.array([1, 1, 0, -1, -1, -1, 0, 1]), np.array([0, 1, 1, 1, 0, -1, -1, -1])
STRAIGHT, DIAGONAL = 10, 14
#: No way.
ENDLESS = 30_000


@device
def distance(a, b):
    """Of two cells, in meters."""
    return np.sqrt(float(a * a + b * b))


@device
def walkable(rise, far):
    return abs(rise) <= STEP + GRADE * far


@device
def _fit(z, start, h, w, j, i, n, steep, around, least):
    """Rise over run and mean square distance of the plane through the levels around that are near; -1: too few."""
    count = 0
    sx = sy = sz = sxx = sxy = syy = sxz = syz = szz = 0.0
    for b in range(max(j - around, 0), min(j + around + 1, h)):
        for a in range(max(i - around, 0), min(i + around + 1, w)):
            most = STEP + steep * distance(a - i, b - j)
            found = False
            t = 0.0
            for m in range(start[b * w + a], start[b * w + a + 1]):
                if abs(z[m] - z[n]) <= most:
                    found, t, most = True, z[m] - z[n], abs(z[m] - z[n])
            if found:
                x, y = float(a - i), float(b - j)
                count += 1
                sx += x
                sy += y
                sz += t
                sxx += x * x
                sxy += x * y
                syy += y * y
                sxz += x * t
                syz += y * t
                szz += t * t
    if count < least:
        return -1.0, 0.0
    sx, sy, sz = sx / count, sy / count, sz / count
    sxx, sxy, syy = sxx / count - sx * sx, sxy / count - sx * sy, syy / count - sy * sy
    sxz, syz, szz = sxz / count - sx * sz, syz / count - sy * sz, szz / count - sz * sz
    det = sxx * syy - sxy * sxy
    if det < 0.05:  # on a line
        return -1.0, 0.0
    gx, gy = (sxz * syy - syz * sxy) / det, (syz * sxx - sxz * sxy) / det
    return np.sqrt(gx * gx + gy * gy), szz - gx * sxz - gy * syz


@device
def _closed(z, start, h, w, j, i, n):
    """Whether a level has others beside it in at least half of the cells around that hold anything: wires have not."""
    held = near = 0
    for b in range(max(j - 1, 0), min(j + 2, h)):
        for a in range(max(i - 1, 0), min(i + 2, w)):
            k = b * w + a
            held += start[k] < start[k + 1]
            for m in range(start[k], start[k + 1]):
                if walkable(z[m] - z[n], distance(a - i, b - j)):
                    near += 1
                    break
    return 2 * near >= held


@njit
def surfaces(z, start, h, w):
    """The kind of each level (n,)."""
    kind = np.empty(len(z), np.int8)
    for j in range(h):
        for i in range(w):
            for n in range(start[j * w + i], start[j * w + i + 1]):
                kind[n] = ROUGH
                if not _closed(z, start, h, w, j, i, n):
                    continue
                for steep, (around, least, rough) in (
                    (LEVEL, _WIDE),
                    (LEVEL, _NARROW),
                    (STEEP, _WIDE),
                ):
                    slope, scatter = _fit(z, start, h, w, j, i, n, steep, around, least)
                    aslant = 1.0 + slope * slope if steep > LEVEL else 1.0
                    if 0.0 <= slope <= steep and scatter <= rough * rough * aslant:
                        kind[n] = SMOOTH if steep > LEVEL else SOLID
                        break
    return kind


@njit
def ways(z, start, h, w, kind, most):
    """How far one walks to a drop, or to nothing, from each level in each of eight directions (n, 8), and which of them it
    is (n, 8); and how the way ends at once (n, 8).

    In tenths of cells, ENDLESS where there is neither or it is more than `most` away; ON where the way goes on.
    """
    way, end = np.full((len(z), 8), ENDLESS, np.int16), np.zeros((len(z), 8), np.int8)
    last = np.full((len(z), 8), WALLED, np.int8)
    for d in range(8):
        di, dj = RIGHT[d], UP[d]
        straight = di == 0 or dj == 0
        length = STRAIGHT if straight else DIAGONAL
        ahead = AHEAD if straight else AHEAD * STRAIGHT // DIAGONAL + 1
        edge = EDGE if straight else EDGE - 1
        step = distance(di, dj)
        for jj in range(h):
            j = h - 1 - jj if dj > 0 else jj
            for ii in range(w):
                i = w - 1 - ii if di > 0 else ii
                for n in range(start[j * w + i], start[j * w + i + 1]):
                    if kind[n] != SOLID:
                        continue
                    found, lower = -1, False
                    for s in range(1, ahead + 1):
                        y, x = j + s * dj, i + s * di
                        if y < 0 or x < 0 or y >= h or x >= w:
                            break
                        far = s * step
                        nearest = STEP + GRADE * far
                        for m in range(start[y * w + x], start[y * w + x + 1]):
                            if kind[m] == SOLID and abs(z[m] - z[n]) <= nearest:
                                found, nearest = m, abs(z[m] - z[n])
                            if z[m] < z[n] - max(DROP, WALL * far):
                                lower = True
                        if found >= 0:
                            if way[found, d] + s * length <= most:
                                way[n, d] = way[found, d] + s * length
                                last[n, d] = last[found, d]
                            break
                    if found >= 0:
                        continue
                    end[n, d] = WALLED
                    if lower:
                        end[n, d] = DOWN
                    elif _bare(z, start, h, w, kind, j, i, di, dj, edge, ahead, z[n] + ABOVE):
                        end[n, d] = _sight(z, start, h, w, kind, j, i, di, dj, z[n])
                    if end[n, d] != WALLED:
                        way[n, d], last[n, d] = 0, end[n, d]
    return way, last, end


@device
def _bare(z, start, h, w, kind, j, i, di, dj, edge, ahead, level):
    """Whether the cells ahead, and those beside them, hold nothing but leaves above a level."""
    for s in range(edge + 1, ahead + 2):
        for side in range(-1, 2):
            y, x = j + s * dj + side * di, i + s * di - side * dj
            if 0 <= y < h and 0 <= x < w:
                for m in range(start[y * w + x], start[y * w + x + 1]):
                    if z[m] < level or kind[m] != ROUGH:
                        return False
    return True


@device
def _sight(z, start, h, w, kind, j, i, di, dj, level):
    """What is seen across emptiness: ACROSS, NOTHING or WALLED."""
    length = di * di + dj * dj
    nothing = True
    for far in range(2):
        if far and not nothing:
            return WALLED
        reach = FAR if far else SIGHT
        for b in range(-min(reach, j), min(reach, h - 1 - j) + 1):
            for a in range(-min(reach, i), min(reach, w - 1 - i) + 1):
                dot, squared = a * di + b * dj, a * a + b * b
                if dot <= 0 or squared > reach * reach or 4 * dot * dot < squared * length:
                    continue
                m = start[(j + b) * w + i + a]
                if m == start[(j + b) * w + i + a + 1]:
                    continue
                if far:
                    if z[m] < level - max(FAR_BELOW, FAR_SLOPE * np.sqrt(float(squared))):
                        return ACROSS
                    continue
                if z[m] < level - BELOW and squared > 4 and 4 * dot * dot >= 3 * squared * length:
                    return ACROSS
                # The edge itself, leaves and lamps are no other side.
                ahead = 2 * dot * dot >= squared * length and dot * dot > AHEAD * AHEAD * length
                if ahead and (z[m] < level + ABOVE or kind[m] != ROUGH):
                    nothing = False
    return NOTHING if nothing else WALLED
