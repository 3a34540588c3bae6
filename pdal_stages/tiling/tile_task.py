"""One tile: cut it out with its surroundings, run the head, keep the tile's own results."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ..base.errors import NoTerrainError
from .cloudindex import CloudIndex
from .ept import fetch
from .extract import Member, Piece, cut, likeness
from .file_task import write_tile
from .grid import inside, touching
from .headrun import HeadRun, RunContext, run_head
from .results import PieceResults, class_counts, save
from .sources import InputSource

#: How often a tile is read again with wider surroundings.
_WIDENINGS = 3


@dataclass(frozen=True)
class TileTask:
    """A tile to be worked on."""

    context: RunContext
    tile: tuple[int, int]
    #: Inputs that may hold points of it or its surroundings; EPT sources have no index.
    sources: list[tuple[InputSource, CloudIndex | None]]
    complete: float  #: metres around the tile up to which these are all the inputs there are
    result: str  #: file for the results, where outputs are put together from tiles
    outputs: list[str] | None  #: otherwise: what each of the writers writes

    def run(self) -> dict[str, Any]:
        """Run the head; write its results, or the outputs. The report says which."""
        with TemporaryDirectory(
            prefix="tile-", dir=self.context.scratch, ignore_cleanup_errors=True
        ) as folder:
            results, report = _settle(self, folder)
            if self.outputs is not None:
                return report | write_tile(results, self.context.plan, self.outputs)
            save(self.result, results)
        return report | {"result_bytes": os.path.getsize(self.result)}


def _settle(task: TileTask, folder: str) -> tuple[list[PieceResults], dict[str, Any]]:
    """Run the head with surroundings that suffice; results, and the report.

    It has the ``points`` of the tile, those ``read`` with surroundings, the ``halo_m`` used, and whether that did not
    suffice (``short``).
    """
    context, tile, least_m = task.context, task.tile, task.context.plan.halo_m
    side, halo_m, short = context.grid.size * context.unit, least_m, False
    head: HeadRun | None = None
    for attempt in range(_WIDENINGS + 1):
        cuts = _cut_all(task, halo_m / context.unit, folder)
        read = sum(len(piece.index) for piece in cuts)
        own = sum(len(piece.own) for piece in cuts)
        if not own:
            break
        everything = inside(context.bounds, context.grid.box(tile, halo_m / context.unit))
        try:
            head = run_head(context, tile, cuts, everything)
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
    report = {
        "points": own,
        "read": read,
        "halo_m": halo_m,
        "short": short,
        "widened": halo_m > least_m,
        "dropped": own - sum(len(result.rows) for result in head.results),
        "classes": class_counts(head.results),
        "notes": head.notes,
    }
    return head.results, report


def _cut_all(task: TileTask, halo: float, folder: str) -> list[Piece]:
    """The tile's points and their surroundings, out of every input; inputs that are alike are read as one."""
    grid = task.context.grid
    box = grid.box(task.tile, halo)
    alike: dict[tuple[bytes, str], list[Member]] = {}
    for number, (source, index) in enumerate(task.sources):
        path = source.path
        if source.kind == "ept":
            path = os.path.join(folder, f"fetched{number}.las")
            index = fetch(source, grid, task.tile, halo, path)
        if index is None or not touching(index.boxes, box):
            continue
        reader = json.dumps(source.reader, sort_keys=True)
        alike.setdefault((likeness(path), reader), []).append(Member(source, path, index))
    pieces = []
    for number, members in enumerate(alike.values()):
        core = "" if task.outputs is None else os.path.join(folder, f"core{number}.las")
        pieces.append(cut(members, grid, task.tile, halo, os.path.join(folder, f"piece{number}.las"), core))
    return [piece for piece in pieces if piece is not None]
