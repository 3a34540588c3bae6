"""Ground that openings took from ridges, dams and the edges of terraces becomes ground again.

A round of it first spreads ground to cells to which enough ground around hardly rises or falls,
then takes the cells that continue the provisional surface through the rest.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..base.grid import GridWindow
from ..base.jit import njit
from ..base.threads import map_blocks
from .cells import HOLE
from .filter_options import FilterOptions
from .surface import GroundRaster, planes_at, planes_of_blocks
from .surface import reach as planes_reach

#: How often ground is regained. Without it the mean error of the ISPRS samples is 1.0 points
#: higher, with one round 0.3 (docs/results/ablation.md).
ROUNDS = 3
#: How often, before each such round, a cell becomes ground if enough of the cells around it are
#: ground that hardly rises or falls to it: the broken edges of terraces, the shoulders of banks.
#: Without it the mean error of the ISPRS samples is 0.2 points higher, and of clips with holes too.
SPREADS = 2
#: Distance of these cells along either axis, in meters. With 1 m and 3 m the mean error of the
#: ISPRS samples is 0.13 and 0.06 points higher.
SPREAD_REACH = 2.0
#: They rise or fall at most this much per meter. With 0.15 and 0.3 that error is 0.05 and 0.19
#: points higher.
SPREAD_SLOPE = 0.2
#: Share of the measured cells around that must be such ground. With 0.2 and 0.3 that error is 0.02
#: points lower and 0.04 higher, that of the surveys 0.01 higher and lower.
SPREAD_SHARE = 0.25
#: Cells that a thread takes at a time.
_SPAN = 1 << 16


def reach(options: FilterOptions) -> int:
    """Return how far away ground changes what one round regains, in cells."""
    return planes_reach(options.near_levels) + SPREADS * _spread_cells(options)


def _spread_cells(options: FilterOptions) -> int:
    """Return the distance in cells to which ground spreads at a time."""
    return max(1, round(SPREAD_REACH / options.cell))


def regain(raster: GroundRaster, window: GridWindow, options: FilterOptions) -> NDArray[np.bool_]:
    """Return which cells (h, w) of a raster are ground after one more round.

    Cells outside the window stay as they are.
    """
    measured, ground = np.isfinite(raster.lowest), raster.ground.copy()
    for _ in range(SPREADS):
        cells = np.flatnonzero(measured & ~ground)
        ground.ravel()[cells[_spread(cells, raster.lowest, ground, options)]] = True
    seen = np.zeros(raster.shape, bool)
    seen[window.slices_in(raster.window)] = True
    seen &= measured & ~ground
    cells = np.flatnonzero(seen)
    left, bottom, width, _ = raster.window
    held = replace(raster, ground=ground)
    blocks, corner = planes_of_blocks(held, options.near_levels, seen, options.threads)
    height, across, along = planes_at(cells, width, left, bottom, blocks, corner).T
    x, y, z = raster.place.reshape(-1, 3)[cells].T
    gradient = np.sqrt(across * across + along * along) / options.cell
    off = z - height - x * across - y * along
    near = options.is_ground(measured.ravel()[cells], off, gradient)
    ground.ravel()[cells[near]] = True
    return ground


def _spread(
    cells: NDArray[np.int64],
    lowest: NDArray[np.float32],
    ground: NDArray[np.bool_],
    options: FilterOptions,
) -> NDArray[np.bool_]:
    """Return which cells (n,) become ground as they lie among ground; a thread takes some."""
    reach, rise = _spread_cells(options), SPREAD_SLOPE * options.cell

    def among(first: int) -> NDArray[np.bool_]:
        part = cells[first : first + _SPAN]
        return _among_ground(part, lowest, ground, reach, rise, SPREAD_SHARE)

    spans = range(0, max(len(cells), 1), _SPAN)
    return np.concatenate(list(map_blocks(among, spans, options.threads)))


@njit
def _among_ground(cells, lowest, ground, reach, rise, least):
    """Find the cells (n,), numbered row by row, with a share of ground around that leads to them.

    Ground up to `reach` cells away counts if it lies at most `rise` meters per cell higher or
    lower. Holes do not count.
    """
    h, w = lowest.shape
    out = np.zeros(len(cells), np.bool_)
    for k in range(len(cells)):
        j, i = cells[k] // w, cells[k] % w
        here = lowest[j, i]
        # The cell itself is counted below: so there is no branch to mispredict.
        measured = level = -np.int32(here != HOLE)
        level *= np.int32(ground[j, i])
        for b in range(max(j - reach, 0), min(j + reach + 1, h)):
            for a in range(max(i - reach, 0), min(i + reach + 1, w)):
                there = lowest[b, a]
                away = np.sqrt(float((b - j) ** 2 + (a - i) ** 2))
                leads = ground[b, a] & (abs(there - here) <= rise * away)
                measured += np.int32(there != HOLE)
                level += np.int32((there != HOLE) & leads)
        out[k] = measured > 0 and level >= least * measured
    return out
