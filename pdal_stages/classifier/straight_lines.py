"""Straight lines: what a model calls a wire is one only where others lie along a line with it.

A wire is long; what looks like one in a crown, at a roof's edge or in a sliver of a survey is not.
Of the points for which a class of lines wins, those keep it for which it is almost sure or that lie
on a line of such points, long or without gaps; the others get the class that is next likely. Few
points are candidates, so this costs little, and nothing where there are none.

A candidate and another one far from it make a tube; those within the tube are a line as far as the
gaps between them are small. Candidates are looked at in one canonical order, so that results have
the same bits in any tile that holds what lies within :data:`REACH`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ..base.grid import cell_keys, cell_numbers, compact_keys, key_offset, places_among
from ..base.jit import device, njit
from ..base.messages import Report
from .interface import Block, PredictRequest


class StraightLineRules(NamedTuple):
    """Sizes of lines in meters; a NamedTuple, as kernels read it.

    Chosen by surveys left out (docs/trials.md). Whoever changes one changes what models of older
    releases do: see CONTRIBUTING.md.
    """

    length: float = 28.0  #: least extent of a line
    radius: float = 32.0  #: candidates up to this far away, in plan, are looked at
    gap: float = 16.0  #: largest gap in it: thin wires give few echoes
    short: float = 8.0  #: least extent of a line without such gaps, as between crowns
    short_gap: float = 2.0  #: largest gap in it
    width: float = 0.4  #: radius of the tube: a wire sags, and its echoes scatter by 0.1 m
    far: float = 5.0  #: candidates farther away than this tell directions
    cube: float = 0.5  #: of each cube of this side one candidate is part of lines
    directions: int = 64  #: directions tried at each point, spread over its candidates
    sure: float = 0.95  #: probability from which on a point needs no line: a survey ends somewhere


RULES = StraightLineRules()
#: How far away, in meters, a candidate changes whether another one lies on a line.
REACH = RULES.radius + RULES.cube


def keep_to_lines(
    predict: Callable[[PredictRequest], Iterator[Block]],
    request: PredictRequest,
    lines: npt.NDArray[np.bool_],
) -> Iterator[Block]:
    """Yield the blocks of a request, in which what lies on no line belongs to no class of lines.

    Parameters
    ----------
    predict : callable
        Yields the blocks of a request as the passes of a model make them. It is called once more
        where candidates have neighbors that are not wanted.
    request : PredictRequest
    lines : (classes,) bool
        Which classes are lines.
    """
    held = []
    for block in predict(request):
        candidate = lines[block.probabilities.argmax(axis=1)]
        if candidate.any():
            held.append(block.take(candidate))
            block = block.take(~candidate)
        yield block
    if not held:
        return
    rows = [block.rows for block in held]
    around = _rows_around(request, np.concatenate(rows))
    if len(around):
        beside = replace(request, rows=around, progress=None, report=Report())
        for block in predict(beside):
            rows.append(block.rows[lines[block.probabilities.argmax(axis=1)]])
    candidates = request.xyz[np.concatenate(rows)]
    for block in held:
        unsure = block.probabilities[:, lines].max(axis=1) < RULES.sure
        off_line = np.flatnonzero(unsure & ~lie_on_lines(request.xyz[block.rows], candidates))
        p = np.where(lines, 0.0, block.probabilities[off_line])
        block.probabilities[off_line] = p / p.sum(axis=1, keepdims=True)
        yield block


def _rows_around(request: PredictRequest, rows: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return the rows, ascending, that are not wanted and may be within :data:`REACH` of these."""
    if request.rows is None:
        return np.zeros(0, np.int64)
    keys, offsets = compact_keys(request.xyz[:, :2], REACH)
    near = np.unique(np.add.outer(np.add.outer(np.unique(keys[rows]), offsets), (-1, 0, 1)))
    is_near = places_among(near, keys)[1]
    is_near[request.rows] = False
    return np.flatnonzero(is_near)


def lie_on_lines(
    points: npt.NDArray[np.float64], candidates: npt.NDArray[np.float64]
) -> npt.NDArray[np.bool_]:
    """Return which points (n, 3) lie on a line of the candidates (m, 3), in meters."""
    out = np.zeros(len(points), np.bool_)
    if not len(points):
        return out
    cube = np.stack([cell_numbers(axis, RULES.cube) for axis in candidates.T])
    order = np.lexsort((*candidates.T, *cube))
    first = (np.diff(cube[:, order], axis=1, prepend=cube[:, order[:1]] - 1) != 0).any(axis=0)
    parts = candidates[order[first]]
    keys, home = (
        cell_keys(*(cell_numbers(each[:, axis], RULES.radius) for axis in (0, 1)))
        for each in (parts, points)
    )
    order = np.lexsort((*parts.T, keys))
    steps = np.array([key_offset(-1, row) for row in (-1, 0, 1)])
    begin, end = (np.searchsorted(keys[order], home[:, None] + steps + more) for more in (0, 3))
    _mark(points, parts[order], begin, end, RULES, out)
    return out


@njit
def _mark(points, parts, begin, end, rules, out):
    """Mark the points (n, 3) on lines of the parts (m, 3), of which those near lie in three runs.

    `begin` and `end` (n, 3) are where these runs begin and end.
    """
    for k in range(len(points)):
        near = np.empty((3, (end[k] - begin[k]).sum()))
        n = 0
        for run in range(3):
            for other in range(begin[k, run], end[k, run]):
                x, y = parts[other, 0] - points[k, 0], parts[other, 1] - points[k, 1]
                if x * x + y * y <= rules.radius**2:
                    near[0, n], near[1, n], near[2, n] = x, y, parts[other, 2] - points[k, 2]
                    n += 1
        out[k] = _is_long(near[:, :n], rules)


@device(_nrt=True)
def _is_long(near, rules):
    """Tell whether the point amid others (3, n), relative to it, lies on a line of them."""
    n = near.shape[1]
    along = np.empty(n)
    for toward in range(0, n, max(1, n // rules.directions)):
        away = np.sqrt(near[0, toward] ** 2 + near[1, toward] ** 2)
        if away < rules.far:
            continue
        u, v, rise = near[0, toward] / away, near[1, toward] / away, near[2, toward] / away
        count = 0
        for k in range(n):
            t = near[0, k] * u + near[1, k] * v
            aside, above = near[1, k] * u - near[0, k] * v, near[2, k] - t * rise
            if aside * aside + above * above <= rules.width**2:
                along[count] = t
                count += 1
        places = np.sort(along[:count])
        if _extent(places, rules.gap) >= rules.length:
            return True
        if _extent(places, rules.short_gap) >= rules.short:
            return True
    return False


@device
def _extent(along, gap):
    """Return how far places (n,), ascending, reach from 0 to both sides without a larger gap."""
    low, high = 0.0, 0.0
    for k in range(len(along) - 1, -1, -1):
        if along[k] < low and low - along[k] <= gap:
            low = along[k]
    for k in range(len(along)):
        if along[k] > high and along[k] - high <= gap:
            high = along[k]
    return high - low
