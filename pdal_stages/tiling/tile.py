"""One tile: cut it out with its surroundings, run the head, keep the tile's own results."""

from __future__ import annotations

from dataclasses import dataclass
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ..base.errors import NoTerrainError
from .grid import inside
from .ground import from_before
from .head import HeadRun, RunContext, run_head
from .outputs import PieceResults, class_counts, save_results, write_tile
from .pieces import CloudIndex, cut_all
from .sources import InputSource
from .store import written

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
        context = self.context
        with TemporaryDirectory(prefix="tile-", dir=context.scratch, ignore_cleanup_errors=True) as folder:
            results, record = self._settled(folder)
            if self.outputs is not None:
                box = context.grid.box(self.tile)
                return record | write_tile(results, context.plan, self.outputs, box, context.scratch)
            save_results(self.result, results)
        return record | {"outputs": written([self.result])}

    def _settled(self, folder: str) -> tuple[list[PieceResults], dict[str, Any]]:
        """Run the head with surroundings that suffice; results, and the record.

        It has the ``points`` of the tile, those ``read`` with its halo, the ``halo_m`` used, and whether that did not
        suffice (``short``).
        """
        context, grid, least_m = self.context, self.context.grid, self.context.plan.halo_m
        side, halo_m, short = grid.size * context.unit, least_m, False
        head: HeadRun | None = None
        for attempt in range(_WIDENINGS + 1):
            cores = self.outputs is not None
            cuts = cut_all(grid, self.tile, self.sources, halo_m / context.unit, folder, cores)
            read = sum(len(piece.index) for piece in cuts)
            own = sum(len(piece.own) for piece in cuts)
            if not own:
                head = HeadRun([PieceResults(piece, np.empty(0, np.int64), {}) for piece in cuts], 0.0)
                break
            everything = inside(context.bounds, grid.box(self.tile, halo_m / context.unit))
            before = from_before(context, self.before, self.tile, halo_m, cuts) if self.before else None
            try:
                head = run_head(context, self.tile, cuts, everything, before)
                need = head.need
            except NoTerrainError:
                if everything:
                    raise
                head, need = None, side + 2 * least_m  # look farther away
            if everything or need <= halo_m:
                break
            short = True
            estimate = read * ((side + 2 * need) / (side + 2 * halo_m)) ** 2
            if attempt == _WIDENINGS or estimate > context.most_points or need > self.complete:
                break
            halo_m, short = need + 1e-6, False
        if head is None:
            raise NoTerrainError(
                "no terrain: no point near the tile may form one", found=f"within {halo_m:.0f} m"
            )
        return head.results, {
            "points": own,
            "read": read,
            "halo_m": halo_m,
            "short": short,
            "widened": halo_m > least_m,
            "dropped": own - sum(len(result.rows) for result in head.results),
            "classes": class_counts(result.values for result in head.results),
            "messages": head.messages,
            "left_alone": head.left_alone,
        }
