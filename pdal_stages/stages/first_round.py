"""What a stage declares that looks too far for the surroundings of a tile: rounds before the tiles
work for it in blocks.

Each tile's own points are reduced to what matters far away (:meth:`FarReaching.left_of`), blocks of
a grid are computed from that (:meth:`FarReaching.block_of`), and a tile takes what it needs of the
blocks (:meth:`FarReaching.made_of_blocks`).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .base import Stage
from .points import Points


class Blocks(NamedTuple):
    """Squares of a grid that are computed once, from points far around, before the tiles; lengths
    in meters.
    """

    side: float
    reach: float  #: how far around a block points matter
    around: float  #: how far beyond the points that are read a tile needs blocks
    spill: float  #: how far beyond all points blocks hold something
    cell: float = 1.0  #: side of the cells that they are rasters of


def inside_block(block: tuple[int, int]) -> str:
    """Return the name of the array of the points inside a block (column, row)."""
    return f"inside/{block[0]}/{block[1]}"


class FarReaching(Stage):
    """A stage whose far reach tiles replace by blocks."""

    @abstractmethod
    def blocks(self) -> Blocks | None:
        """Return the blocks that the stage needs; None where its options make it look no farther
        than its halo.
        """

    @abstractmethod
    def left_of(self, points: Points) -> dict[str, NDArray[np.float64]]:
        """Return what blocks need of points: (n, 4) ``around`` them, and (n, 3) inside each
        (:func:`inside_block`).
        """

    @abstractmethod
    def block_of(
        self,
        around: NDArray[np.float64],
        inside: Iterable[NDArray[np.float64]],
        block: tuple[int, int],
    ) -> dict[str, NDArray]:
        """Return what tiles need of a block (column, row), from what was left around it and, in
        parts, inside.
        """

    @abstractmethod
    def needed_of_blocks(self, box: Sequence[float]) -> set[str]:
        """Return names of the arrays of blocks that a box (min x, min y, max x, max y) in meters
        needs.
        """

    @abstractmethod
    def made_of_blocks(self, blocks: Iterable[Mapping[str, NDArray]]) -> Any:
        """Return :attr:`StageContext.blocks` made of these arrays of the blocks that a box
        touches.
        """
