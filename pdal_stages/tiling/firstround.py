"""A round before the tiles: every point is read once, and what a far-reaching stage needs of it is kept.

Filtered ground looks half a kilometer around a tile, but at points far away it needs the lowest ones of cells alone. So
each tile's own points are read first, with the halo that the stages before need (noise is marked before heights
are made), and the lowest are written into a file. Then a tile reads the points near it, and is given those of the files.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.errors import StageError
from ..base.files import whole_files
from .cloudindex import CloudIndex
from .extract import cut_all
from .grid import Box, TileGrid
from .headrun import RunContext, run_first
from .sources import InputSource
from .store import left_file
from .tileplan import FirstRound

#: Of what is read for a tile, so much is given from the files too, in meters: the same points, and so no harm.
_OVERLAP = 0.01


@dataclass(frozen=True)
class FirstRoundTask:
    """A tile of the first round."""

    context: RunContext
    first: FirstRound
    tile: tuple[int, int]
    sources: list[tuple[InputSource, CloudIndex | None]]  #: inputs that may hold points of it or its halo
    target: str  #: file for what is left of its points

    def run(self) -> dict[str, Any]:
        """Write what is left of the tile's own points."""
        context = self.context
        with TemporaryDirectory(prefix="first-", dir=context.scratch, ignore_cleanup_errors=True) as folder:
            cuts = cut_all(
                context.grid, self.tile, self.sources, self.first.halo_m / context.unit, folder, False
            )
            left = run_first(context, cuts, self.first) if cuts else np.empty((0, 3))
        with whole_files(self.target, what="result") as (partial,), open(partial, "wb") as file:
            np.save(file, left)
        return {"result_bytes": os.path.getsize(self.target)}


def left_around(
    folder: str, grid: TileGrid, tile: tuple[int, int], unit: float, read_m: float, far_m: float
) -> NDArray[np.float64]:
    """What is left of points up to `far_m` meters around a tile and not within the `read_m` that are read: (n, 3)."""
    box = grid.box(tile)
    found = [np.empty((0, 3))]
    for other in grid.covering(grid.box(tile, far_m / unit)):
        path = os.path.join(folder, left_file(grid.name(other)))
        if not os.path.exists(path):
            continue  # a tile without points
        try:
            points = np.load(path, allow_pickle=False).reshape(-1, 3)
        except (ValueError, EOFError) as error:
            os.unlink(path)
            raise StageError(
                "what the first round left of a tile cannot be read back, and was removed",
                found=f"{path}: {error}",
                cure="Run it again with --resume",
            ) from error
        away = _outside(points, box, unit)
        found.append(points[(away > read_m - _OVERLAP) & (away <= far_m)])
    return np.concatenate(found)


def _outside(points: NDArray[np.float64], box: Box, unit: float) -> NDArray[np.float64]:
    """How far points (n, 3), in meters, lie outside a box in the unit of the coordinates, along the farther axis."""
    x0, y0, x1, y1 = (side * unit for side in box)
    x, y = points[:, 0], points[:, 1]
    return np.maximum(np.maximum(x0 - x, x - x1), np.maximum(y0 - y, y - y1))
