"""Evidence of lines: a wire is what lies on a line of points that may be wires, alone there.

A wire is long; what looks like one in a crown, at a roof's edge or in a sliver of a survey is not.
So a low probability makes a point a *candidate*, and the line decides. A line is a tube from one
candidate toward a likely one, a *guide*: candidates in the tube speak for it by their probability,
those in a ring around the tube against it, the less the likelier the candidate itself is: a likely
wire may hang beside others, an unlikely one is a twig beside a wire. What is no guide lies between
parts of its line: beyond the end of a wire stand what holds it and what hides the rest. A line is
looked at where its guides count at least as much as those of all lines that the candidate tried
before.

There are two steps: guides must lie on lines themselves, and then every candidate looks toward the
guides that do. Where no candidate is likely, next to nothing is computed.

Of the candidates in a cube of a grid that is anchored at zero the likeliest is looked at alone, and
they are looked at in the order of the cubes: results have the same bits in any order of points, and
in any tile that holds what lies within :data:`REACH`.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ..base.grid import (
    begins_run,
    cell_keys,
    cell_numbers,
    cells_around,
    compact_keys,
    key_offset,
    places_among,
)
from ..base.jit import device, njit
from ..base.key_order import order_by_key
from ..base.threads import map_blocks

Rows = npt.NDArray[np.int64]
#: Points of a block that a thread works on.
BLOCK = 4096


class LineEvidenceRules(NamedTuple):
    """Sizes of lines in meters; a NamedTuple, as kernels read it.

    Chosen by surveys left out (docs/trials.md). Whoever changes one changes what models of older
    releases do: see CONTRIBUTING.md.
    """

    candidate: float = 0.03  #: probability from which on a point may belong to a line
    likely: float = 0.35  #: probability from which on a candidate is a guide
    evidence: float = 5.0  #: of a line, at least: candidates in the tube, less those in the ring
    guides: float = 3.0  #: evidence of guides alone in the tube, at least
    side: float = 0.5  #: evidence in the tube on either side of what is no guide, at least
    length: float = 10.0  #: least extent of a line
    gap: float = 16.0  #: largest gap in it: thin wires give few echoes, ...
    usual_gaps: float = 12.0  #: ... and in median gaps of the line: echoes of wires lie evenly
    radius: float = 32.0  #: candidates up to this far away, in plan, are looked at
    width: float = 0.4  #: radius of the tube: a wire sags, and its echoes scatter by 0.1 m
    ring: float = 1.2  #: outer radius of the ring around it
    #: what a candidate in the ring counts, times how unlikely the point on the line is
    against: float = 0.75
    far: float = 5.0  #: guides farther away than this tell directions
    cube: float = 0.5  #: of each cube of this side the likeliest candidate counts
    looks: int = 1 << 17  #: guides looked at for a point at most: of many, lines to some are tried


RULES = LineEvidenceRules()
#: How far away, in meters and in plan, a candidate changes whether another one lies on a line: it
#: may decide whether a guide lies on one, and each of the two may stand for others of its cube.
REACH = 2.0 * (RULES.radius + math.sqrt(2.0) * RULES.cube)


class _Parts(NamedTuple):
    """Parts of lines: one candidate of each cube, cell by cell."""

    xyz: npt.NDArray[np.float64]  #: (m, 3)
    probability: npt.NDArray[np.float32]  #: (m,) of being part of a line
    begin: npt.NDArray[np.int64]  #: (c, 3) where the parts in three rows of 3 cells begin, and end
    end: npt.NDArray[np.int64]  #: for each cell (c,) that has points


def find_lines(
    xyz: npt.NDArray[np.float64],
    probability: npt.NDArray[np.float32],
    threads: int | None = 1,
) -> npt.NDArray[np.bool_]:
    """Return which candidates lie on a line.

    Parameters
    ----------
    xyz : (m, 3) float64
        The candidates, in meters and in any order.
    probability : (m,) float32
        The probability that each is part of a line, at least ``RULES.candidate``.
    threads : int, optional
        Threads that share the points; None for one on every core.
    """
    on_line = np.zeros(len(xyz), np.bool_)
    guides = np.flatnonzero(probability >= RULES.likely)
    if not len(guides):
        return on_line
    cells = cell_keys(*(cell_numbers(xyz[:, axis], RULES.radius) for axis in (0, 1)))
    near = cells_around(cells_around(cells[guides]))
    rows = np.flatnonzero(places_among(near, cells)[1])
    parts = rows[_likeliest(xyz[rows], probability[rows])]
    guides = parts[probability[parts] >= RULES.likely]
    look = partial(_look, xyz, probability, cells, parts, threads=threads)
    guides = guides[look(guides, guides)]
    if len(guides):
        points = np.flatnonzero(places_among(cells_around(cells[guides]), cells)[1])
        on_line[points] = look(guides, points)
    return on_line


def _likeliest(xyz: npt.NDArray[np.float64], probability: npt.NDArray[np.float32]) -> Rows:
    """Return the row of the likeliest point of each cube, cube by cube."""
    keys = compact_keys(xyz, RULES.cube)[0]
    order = order_by_key(keys)
    begin = np.flatnonzero(begins_run(keys[order]))
    rows = np.empty(len(begin), np.int64)
    _pick(xyz, probability, order, begin, rows)
    return rows


def _look(
    xyz: npt.NDArray[np.float64],
    probability: npt.NDArray[np.float32],
    cells: Rows,
    parts: Rows,
    guides: Rows,
    points: Rows,
    threads: int | None,
) -> npt.NDArray[np.bool_]:
    """Return which points (n,) lie on a line of the parts (m,) toward a guide (g,), all rows.

    `parts` and `guides` are in the order of their cubes, `cells` (all,) the cells of all points.
    """
    home, place = np.unique(cells[points], return_inverse=True)
    steps = np.array([key_offset(-1, row) for row in (-1, 0, 1)])
    every = []
    for rows in (parts, guides):
        rows = rows[order_by_key(cells[rows])]
        ends = (np.searchsorted(cells[rows], home[:, None] + steps + more) for more in (0, 3))
        every.append(_Parts(xyz[rows], probability[rows], *ends))
    out = np.zeros(len(points), np.bool_)

    def mark(first: int) -> None:
        block = slice(first, first + BLOCK)
        rows = points[block]
        _mark(xyz[rows], probability[rows], place[block], *every, RULES, out[block])

    for _ in map_blocks(mark, range(0, len(points), BLOCK), threads):
        pass
    return out


@njit
def _pick(xyz, probability, order, begin, rows):
    """Write the row (c,) of the likeliest point of each run of `order`, of equals the first by xyz.

    `begin` (c,) is where the runs begin in `order` (m,), rows of points.
    """
    for run in range(len(begin)):
        best = order[begin[run]]
        for at in range(begin[run] + 1, begin[run + 1] if run + 1 < len(begin) else len(order)):
            row = order[at]
            ahead = probability[row] - probability[best]
            for axis in range(3):
                if ahead == 0.0:
                    ahead = xyz[best, axis] - xyz[row, axis]
            if ahead > 0.0:
                best = row
        rows[run] = best


@njit
def _mark(points, probability, place, parts, guides, rules, out):
    """Mark the points (n, 3), in cells (n,), that lie on lines of the parts toward guides."""
    for k in range(len(points)):
        near, n = _near(points[k], place[k], guides, rules.radius)
        every, m = near, 0
        most = rules.guides
        against = rules.against * (1.0 - probability[k])
        side = 0.0 if probability[k] >= rules.likely else rules.side
        for toward in range(0, n, max(1, n * n // rules.looks)):
            away = np.sqrt(near[0, toward] ** 2 + near[1, toward] ** 2)
            if away < rules.far:
                continue
            line = near[0, toward] / away, near[1, toward] / away, near[2, toward] / away
            of_guides = _evidence_in_tube(near, n, line, rules.width)
            if of_guides < most:
                continue
            most = of_guides
            if m == 0:
                every, m = _near(points[k], place[k], parts, rules.radius)
            if _evidence_in_tube(every, m, line, rules.width) < 0.99 * rules.evidence:
                continue  # the whole tube is not enough: no need to look for gaps and at the ring
            if _evidence_of_line(every, m, line, against, side, rules) >= rules.evidence:
                out[k] = True
                break


@device(_nrt=True)
def _near(point, cell, parts, radius):
    """Return the parts near a point: where they lie, relative to it, and probability (4, n); n."""
    near = np.empty((4, (parts.end[cell] - parts.begin[cell]).sum()), np.float32)
    n = 0
    for run in range(3):
        for other in range(parts.begin[cell, run], parts.end[cell, run]):
            x, y = parts.xyz[other, 0] - point[0], parts.xyz[other, 1] - point[1]
            if x * x + y * y <= radius**2:
                near[0, n], near[1, n] = x, y
                near[2, n] = parts.xyz[other, 2] - point[2]
                near[3, n] = parts.probability[other]
                n += 1
    return near, n


@device(fastmath={"reassoc", "nsz"})
def _evidence_in_tube(near, n, line, width):
    """Return what n parts in the tube count, the more the nearer they are to its axis."""
    u, v, rise = line
    whole, scale, total = np.float32(1.0), np.float32(1.0 / width**2), np.float32(0.0)
    for k in range(n):
        along = near[0, k] * u + near[1, k] * v
        aside, above = near[1, k] * u - near[0, k] * v, near[2, k] - along * rise
        total += near[3, k] * max(np.float32(0.0), whole - scale * (aside * aside + above * above))
    return total


@device(_nrt=True)
def _evidence_of_line(near, n, line, against, side, rules):
    """Return what n parts count for a line through 0; 0 if it is short or too little on a side."""
    u, v, rise = line
    along, worth = np.empty(n), np.empty(n)
    inside, outside = 0, n  # the tube's parts come first, the ring's last
    for k in range(n):
        aside = near[1, k] * u - near[0, k] * v
        if abs(aside) > rules.ring:
            continue
        place = near[0, k] * u + near[1, k] * v
        beside = aside * aside + (near[2, k] - place * rise) ** 2
        if beside <= rules.width**2:
            along[inside] = place
            worth[inside] = near[3, k] * (1.0 - beside / rules.width**2)
            inside += 1
        elif beside <= rules.ring**2:
            outside -= 1
            along[outside], worth[outside] = place, -against * near[3, k]
    places = np.sort(along[:inside])
    low, high = _ends(places, min(rules.gap, rules.usual_gaps * _usual_gap(places)))
    if high - low < rules.length:
        return 0.0
    total, behind, ahead = 0.0, 0.0, 0.0
    for k in range(n):
        if (k < inside or k >= outside) and low <= along[k] <= high:
            total += worth[k]
            behind += worth[k] * (k < inside and along[k] < 0.0)
            ahead += worth[k] * (k < inside and along[k] > 0.0)
    return total if min(behind, ahead) >= side else 0.0


@device(_nrt=True)
def _usual_gap(along):
    """Return the median of the gaps between places (n,), ascending."""
    return np.sort(np.diff(along))[(len(along) - 2) // 2] if len(along) > 1 else 0.0


@device
def _ends(along, gap):
    """Return how far places (n,), ascending, reach from 0 to both sides without a larger gap."""
    low, high = 0.0, 0.0
    for k in range(len(along) - 1, -1, -1):
        if along[k] < low and low - along[k] <= gap:
            low = along[k]
    for k in range(len(along)):
        if along[k] > high and along[k] - high <= gap:
            high = along[k]
    return low, high
