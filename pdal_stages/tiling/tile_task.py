"""One tile: cut it out with its surroundings, run the head, keep the tile's own results."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import partial
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ..base.errors import NoTerrainError
from .cut import Piece, cut_all
from .file_task import write_tile
from .firstround import Before
from .grid import inside
from .headrun import FromBefore, HeadRun, RunContext, run_head
from .index import CloudIndex
from .results import PieceResults, class_counts, save
from .sources import InputSource

#: How often a tile is read again with a wider halo.
_WIDENINGS = 3


@dataclass(frozen=True)
class TileTask:
    """A tile to be worked on."""

    context: RunContext
    tile: tuple[int, int]
    #: Inputs that may hold points of it or its halo; EPT sources have no index.
    sources: list[tuple[InputSource, CloudIndex | None]]
    complete: float  #: meters around the tile up to which these are all the inputs there are
    result: str  #: file for the results, where outputs are put together from tiles
    outputs: list[str] | None  #: otherwise: what each of the writers writes
    before: str  #: the folder of what the rounds before made; empty where there were none

    def run(self) -> dict[str, Any]:
        """Run the head; write its results, or the outputs. The record says which."""
        with TemporaryDirectory(
            prefix="tile-", dir=self.context.scratch, ignore_cleanup_errors=True
        ) as folder:
            results, record = _settle(self, folder)
            if self.outputs is not None:
                return record | write_tile(
                    results,
                    self.context.plan,
                    self.outputs,
                    self.context.grid.box(self.tile),
                    self.context.scratch,
                )
            save(self.result, results, self.context.scratch)
        return record | {"result_bytes": os.path.getsize(self.result)}


def _settle(task: TileTask, folder: str) -> tuple[list[PieceResults], dict[str, Any]]:
    """Run the head with surroundings that suffice; results, and the record.

    It has the ``points`` of the tile, those ``read`` with its halo, the ``halo_m`` used, and whether that did not
    suffice (``short``).
    """
    context, tile, least_m = task.context, task.tile, task.context.plan.halo_m
    side, halo_m, short = context.grid.size * context.unit, least_m, False
    head: HeadRun | None = None
    for attempt in range(_WIDENINGS + 1):
        cuts = cut_all(
            context.grid,
            tile,
            task.sources,
            halo_m / context.unit,
            folder,
            task.outputs is not None,
        )
        read = sum(len(piece.index) for piece in cuts)
        own = sum(len(piece.own) for piece in cuts)
        if not own:
            break
        everything = inside(context.bounds, context.grid.box(tile, halo_m / context.unit))
        try:
            narrowing = head is None or head.narrowing  # which was in vain with less around
            head = run_head(context, tile, cuts, everything, _before(task, cuts, halo_m), narrowing)
            need = head.need
        except NoTerrainError:
            if everything:
                raise
            head, need = None, side + 2 * least_m  # look farther away
        if everything or need <= halo_m:
            break
        short = True
        estimate = read * ((side + 2 * need) / (side + 2 * halo_m)) ** 2
        if attempt == _WIDENINGS or estimate > context.most_points or need > task.complete:
            if head is None:
                raise NoTerrainError(
                    "no terrain: no point near the tile may form one", found=f"within {halo_m:.0f} m"
                )
            break
        halo_m, short = need + 1e-6, False
    if head is None:
        empty = np.empty(0, np.int64)
        head = HeadRun([PieceResults(piece, empty, {}) for piece in cuts], 0.0)
    record = {
        "points": own,
        "read": read,
        "halo_m": halo_m,
        "short": short,
        "widened": halo_m > least_m,
        "dropped": own - sum(len(result.rows) for result in head.results),
        "classes": class_counts(head.results),
        "messages": head.messages,
        "left_alone": head.left_alone,
    }
    return head.results, record


def _before(task: TileTask, cuts: list[Piece], halo_m: float) -> FromBefore | None:
    """What the rounds before made for a tile that is read with so many meters of surroundings."""
    first = task.context.plan.first
    if first is None or not task.before:
        return None
    before = Before(task.before, task.context, first)
    blocks = partial(before.from_blocks, task.tile, halo_m)
    return FromBefore(blocks, [before.changed(piece) for piece in cuts])
