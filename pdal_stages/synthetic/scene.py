"""The things a pulse can hit: convex solids, crowns, cones and rods, and the grid that finds them.

A thing is solid, or porous with an extinction in 1/m (leaves, hedges, lattices): the beam then
passes a random way into it, or through it (Beer-Lambert, with clumps).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..base.jit import njit
from .materials import CODE

CONVEX, ELLIPSOID, CONE, ROD = range(4)
VEGETATION = 255  # its class follows from the height above ground: 3, 4 or 5
CELL = 3.0

#: One thing: bounding box, size parameters, planes, label.
THING = np.dtype(
    [
        ("box", np.float64, 6),  # x0 y0 z0 x1 y1 z1
        ("p", np.float64, 7),
        ("extinction", np.float64),
        ("first", np.int64),  # its planes: rows of Scene.planes
        ("count", np.int64),
        ("kind", np.int64),
        ("code", np.int64),  # ASPRS class or VEGETATION
        ("top", np.int64),  # material of upward faces
        ("side", np.int64),
        ("id", np.int64),
    ]
)


class Scene(NamedTuple):
    """Things of one part of the town, with the grid cells that list them (passed whole into numba)."""

    box: np.ndarray  # (n, 6): lowest x, y, z, highest x, y, z
    shape: np.ndarray  # (n, 8): size parameters; the last is the extinction (0: solid)
    label: np.ndarray  # (n, 7): first plane, planes, kind, class, material of top and side, id
    planes: np.ndarray  # (m, 4): outward normal and offset; inside is n.p <= offset
    start: np.ndarray  # (nx * ny + 1,) first entry of each cell in ``member``
    member: np.ndarray
    top: np.ndarray  # (nx * ny,) highest z in each cell
    grid: np.ndarray  # x0, y0, nx, ny, highest z of all


class Parts:
    """Collects things; every method adds one and is called with local metres."""

    def __init__(self) -> None:
        self._rows: list[tuple] = []
        self._planes: list[tuple[float, float, float, float]] = []

    def _add(self, box, p, extinction, kind, code, top, side, first=0, count=0) -> None:
        p = tuple(p) + (0.0,) * (7 - len(p))
        self._rows.append((box, p, extinction, first, count, kind, code, CODE[top], CODE[side or top], 0))

    def prism(
        self, x, y, angle, half_l, half_w, z0, z1, code, top, side=None, *, extinction=0.0, cuts=()
    ) -> None:
        """An upright box, cut by planes given in its own frame.

        Parameters
        ----------
        x, y, angle : float
            Centre and direction of its length.
        half_l, half_w : float
            Half length (along a) and half width (along b).
        z0, z1 : float
        cuts : sequence of (na, nb, nz, offset)
            Inside is ``na * a + nb * b + nz * z <= offset``, with z absolute.
        """
        c, s = math.cos(angle), math.sin(angle)
        first = len(self._planes)
        local = [
            (1.0, 0.0, 0.0, half_l),
            (-1.0, 0.0, 0.0, half_l),
            (0.0, 1.0, 0.0, half_w),
            (0.0, -1.0, 0.0, half_w),
            (0.0, 0.0, 1.0, z1),
            (0.0, 0.0, -1.0, -z0),
            *cuts,
        ]
        for na, nb, nz, offset in local:
            size = math.sqrt(na * na + nb * nb + nz * nz)
            nx, ny, nz = (na * c - nb * s) / size, (na * s + nb * c) / size, nz / size
            self._planes.append((nx, ny, nz, offset / size + nx * x + ny * y))
        ex, ey = abs(c) * half_l + abs(s) * half_w, abs(s) * half_l + abs(c) * half_w
        self._add(
            (x - ex, y - ey, z0, x + ex, y + ey, z1),
            (),
            extinction,
            CONVEX,
            code,
            top,
            side,
            first,
            len(local),
        )

    def ellipsoid(self, x, y, z, rx, ry, rz, code, material, extinction) -> None:
        """An upright ellipsoid."""
        box = (x - rx, y - ry, z - rz, x + rx, y + ry, z + rz)
        self._add(box, (x, y, z, rx, ry, rz), extinction, ELLIPSOID, code, material, None)

    def cone(self, x, y, z0, z1, radius, code, material, extinction) -> None:
        """An upright cone: base at z0, apex at z1."""
        box = (x - radius, y - radius, z0, x + radius, y + radius, z1)
        self._add(box, (x, y, z1, z0, radius), extinction, CONE, code, material, None)

    def rod(self, a, b, radius, code, material) -> None:
        """A thin solid rod from a to b, as seen by the beam (radius includes what a beam feels)."""
        box = (
            *(min(p, q) - radius for p, q in zip(a, b, strict=True)),
            *(max(p, q) + radius for p, q in zip(a, b, strict=True)),
        )
        self._add(box, (*a, *b, radius), 0.0, ROD, code, material, None)

    def arrays(self, key: int) -> tuple[np.ndarray, np.ndarray]:
        """The things and their planes; ids are unique to `key`, so that chance is their own."""
        things = np.array(self._rows, dtype=THING)
        things["id"] = np.arange(things.size) + (key << 20)
        return things, np.array(self._planes, dtype=np.float64).reshape(-1, 4)


@njit
def _fill(box, x0, y0, nx, ny, cell):
    counts = np.zeros(nx * ny + 1, dtype=np.int64)
    top = np.full(nx * ny, -1e30)
    for fill in range(2):
        if fill:
            for c in range(nx * ny):
                counts[c + 1] += counts[c]
            member = np.empty(counts[nx * ny], dtype=np.int64)
            at = counts[:-1].copy()
        for n in range(box.shape[0]):
            i0 = max(math.floor((box[n, 0] - x0) / cell), 0)
            i1 = min(math.floor((box[n, 3] - x0) / cell), nx - 1)
            j0 = max(math.floor((box[n, 1] - y0) / cell), 0)
            j1 = min(math.floor((box[n, 4] - y0) / cell), ny - 1)
            for i in range(i0, i1 + 1):
                for j in range(j0, j1 + 1):
                    c = i * ny + j
                    if fill:
                        member[at[c]] = n
                        at[c] += 1
                    else:
                        counts[c + 1] += 1
                        top[c] = max(top[c], box[n, 5])
    return counts, member, top


def build_scene(pieces: list[tuple[np.ndarray, np.ndarray]], x0, y0, x1, y1) -> Scene:
    """Join pieces (of :meth:`Parts.arrays`) that touch a rectangle, and list them by grid cell."""
    things_list, planes_list, offset = [], [], 0
    for things, planes in pieces:
        moved = things.copy()
        moved["first"] += offset
        offset += len(planes)
        things_list.append(moved)
        planes_list.append(planes)
    things = np.concatenate(things_list) if things_list else np.zeros(0, dtype=THING)
    planes = np.concatenate(planes_list) if planes_list else np.zeros((0, 4))
    box = things["box"]
    near = (box[:, 0] < x1) & (box[:, 3] > x0) & (box[:, 1] < y1) & (box[:, 4] > y0)
    things = things[near]
    nx, ny = max(1, math.ceil((x1 - x0) / CELL)), max(1, math.ceil((y1 - y0) / CELL))
    box = np.ascontiguousarray(things["box"])
    shape = np.column_stack([things["p"], things["extinction"]])
    label = np.column_stack(
        [things[name] for name in ("first", "count", "kind", "code", "top", "side", "id")]
    )
    start, member, top = _fill(box, x0, y0, nx, ny, CELL)
    highest = float(box[:, 5].max()) if len(box) else -1e30
    return Scene(
        box,
        np.ascontiguousarray(shape),
        np.ascontiguousarray(label.astype(np.int64)),
        planes,
        start,
        member,
        top,
        np.array([x0, y0, nx, ny, highest]),
    )
