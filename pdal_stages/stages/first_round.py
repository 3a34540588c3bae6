"""Protocol of stages that look too far for the surroundings of a tile: a first round serves them.

The points of each tile are reduced to what matters far away (:meth:`FarReaching.reduce_points`),
blocks of a grid are computed from that (:meth:`FarReaching.compute_block`), and a tile joins the
parts of the blocks that it needs (:meth:`FarReaching.join_blocks`).
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
    """Squares of a grid that are computed once before the tiles; lengths in meters."""

    side: float
    reach: float  #: how far around a block points matter
    margin: float  #: how far beyond the points that are read a tile needs blocks
    spill: float  #: how far beyond all points blocks hold something
    cell: float = 1.0  #: side of the cells that they are rasters of


def inside_block(block: tuple[int, int]) -> str:
    """Return the name of the array of the points inside a block (column, row)."""
    return f"inside/{block[0]}/{block[1]}"


class FarReaching(Stage):
    """A stage whose far reach tiles replace by blocks."""

    @abstractmethod
    def blocks(self) -> Blocks | None:
        """Return the blocks that the stage needs; None where it looks no farther than its halo."""

    @abstractmethod
    def reduce_points(self, points: Points) -> dict[str, NDArray[np.float64]]:
        """Return what blocks need of points.

        That is an array (n, 4) ``around``, for blocks that the points do not lie in, and (n, 3)
        for each block that they lie in (:func:`inside_block`).
        """

    @abstractmethod
    def compute_block(
        self,
        far_points: NDArray[np.float64],
        inside: Iterable[NDArray[np.float64]],
        block: tuple[int, int],
    ) -> dict[str, NDArray]:
        """Compute a block (column, row) from the reduced points around and in it."""

    @abstractmethod
    def arrays_in(self, box: Sequence[float]) -> set[str]:
        """Return names of arrays that a box (min x, min y, max x, max y, meters) needs."""

    @abstractmethod
    def join_blocks(self, blocks: Iterable[Mapping[str, NDArray]]) -> Any:
        """Join these arrays of the blocks that a box touches to :attr:`StageContext.blocks`."""


def first_round_of(stage: Stage | None) -> Blocks | None:
    """Return the blocks that a stage needs before the tiles; None where it does without."""
    return stage.blocks() if isinstance(stage, FarReaching) else None
