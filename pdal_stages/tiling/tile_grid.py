"""Cut the plane into tiles: anchored at zero, half-open, the same for every run; and boxes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..base.errors import StageError

#: Most tiles of a run.
MOST_TILES = 1_000_000
#: Larger column and row numbers are not exact.
_FARTHEST = 2.0**52

Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class TileGrid:
    """Square tiles of one size.

    Tile (i, j) holds ``i*size <= x - origin < (i+1)*size``, and likewise y.
    """

    size: float  #: side of a tile, in the unit of the coordinates
    #: A line of the grid, along either axis. Zero, so that tiles are the same in every run, but for
    #: a cloud that one tile can hold.
    origin: float = 0.0

    def index(self, coordinate: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the column or row of every coordinate, as int64 of the same shape.

        The edges decide, not the quotient: a point on an edge belongs to the tile it begins,
        whatever the division rounds to, so each point has exactly one tile.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            where = np.floor((coordinate - self.origin) / self.size)
        if where.size and not np.abs(where).max() < _FARTHEST:  # not finite too
            raise StageError(
                "coordinates are too large for tiles of this size",
                found=f"{coordinate[np.abs(where).argmax()]:g}, tiles of {self.size:g}",
                cure="Take larger tiles, or repair the coordinates",
            )
        where -= coordinate < where * self.size + self.origin
        where += coordinate >= (where + 1.0) * self.size + self.origin
        return where.astype(np.int64)

    def box(self, tile: tuple[int, int], halo_units: float = 0.0) -> Box:
        """Return (min x, min y, max x, max y) of a tile, grown on each side by a halo."""
        x0, y0, x1, y1 = (n * self.size + self.origin for n in (*tile, tile[0] + 1, tile[1] + 1))
        return x0 - halo_units, y0 - halo_units, x1 + halo_units, y1 + halo_units

    def scaled(self, by: float) -> TileGrid:
        """Return a grid of the same origin whose tiles are larger by a factor."""
        return TileGrid(self.size * by, self.origin)

    def name(self, tile: tuple[int, int]) -> str:
        """Return the south-west corner as text, e.g. ``500000_5400500``."""
        return "_".join(f"{n * self.size + self.origin:.10g}" for n in tile)

    def covering(self, box: Box) -> list[tuple[int, int]]:
        """Return the tiles that a box touches, row by row; StageError for too many."""
        x0, y0, x1, y1 = (int(self.index(np.array([v]))[0]) for v in box)
        check_number((x1 - x0 + 1) * (y1 - y0 + 1), f"bounds {box}, tiles of {self.size:g}")
        return [(i, j) for j in range(y0, y1 + 1) for i in range(x0, x1 + 1)]


def check_number(tiles: int, place: str) -> None:
    """Refuse more tiles than a run may have."""
    if tiles > MOST_TILES:
        raise StageError(
            f"more than {MOST_TILES:,} tiles",
            found=place,
            cure="Take larger tiles, or repair the bounding box in the header",
        )


def touching(boxes: list[Box] | NDArray[np.float64], box: Box) -> list[int]:
    """Return the numbers of the boxes that share a point with a box, edges included."""
    b = np.asarray(boxes, np.float64).reshape(-1, 4)
    return np.flatnonzero(((b[:, :2] <= box[2:]) & (b[:, 2:] >= box[:2])).all(axis=1)).tolist()


def inside(a: Box, b: Box) -> bool:
    """Return whether box a lies in box b."""
    return a[0] >= b[0] and a[1] >= b[1] and a[2] <= b[2] and a[3] <= b[3]


def union(boxes: list[Box] | NDArray[np.float64]) -> Box:
    """Return the box around boxes."""
    if not len(boxes):
        return (math.inf, math.inf, -math.inf, -math.inf)
    low = np.asarray(boxes)[:, :2].min(axis=0)
    high = np.asarray(boxes)[:, 2:].max(axis=0)
    return (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
