"""Options of the ground filter, and the rule that tells its ground points."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..base import checks
from ..base.errors import OptionError
from ..base.grid import GridWindow

#: Side in meters of the coarsest blocks of the provisional surface, which tells ground points. The
#: mean error of the ISPRS samples is 0.17 points higher with 8 m (docs/results/ablation.md).
NEAR = 16.0
#: Side of those of the surface that heights are measured from: it spans holes under large roofs.
#: Not tuned.
FAR = 32.0
#: Largest radius of the filter's window, and largest width of a requested opening, in cells: beyond
#: it memory and halo of a tile become too large.
_MOST_CELLS = 300

#: Receives what a step made: its name, and a raster (h, w) of the cells of a window.
Keep = Callable[[str, GridWindow, NDArray[np.float32]], None]


@dataclass(frozen=True)
class FilterOptions:
    """Options of :func:`.heights.filtered_ground`, in meters; OptionError for wrong ones."""

    cell: float = 1.0  #: side of the grid's cells
    slope: float = 0.1  #: a window of radius r removes what it lowers by more than this times r
    #: Radius of the largest window, half the width of the largest object that is removed.
    window: float = 18.0
    #: A point is ground within `threshold` plus `scalar` times the terrain's slope of the surface.
    threshold: float = 0.4
    scalar: float = 1.25
    openings: Sequence[float] = ()  #: widths of the openings above which heights are wanted, too
    slope_too: bool = False  #: whether the terrain's slope is wanted
    keep: Keep | None = None  #: receives what each step made of each piece of the cloud

    def __post_init__(self) -> None:
        """Refuse wrong sizes."""
        for name, value in (
            ("cell", self.cell),
            ("window", self.window),
            *(("openings", size) for size in self.openings),
        ):
            checks.number(f"'{name}'", value, 0, above=True)
            if name != "cell" and value > _MOST_CELLS * self.cell:
                raise OptionError(
                    f"'{name}' must not be more than {_MOST_CELLS} cells",
                    found=f"{value:g} m in cells of {self.cell:g} m",
                    cure="Use larger cells or a smaller window",
                )
        for name in ("slope", "threshold", "scalar"):
            checks.number(f"'{name}'", getattr(self, name), 0)

    @property
    def radius(self) -> int:
        """Radius of the largest window, in cells."""
        return max(1, round(self.window / self.cell))

    @property
    def requested_radii(self) -> list[int]:
        """Radii of the requested openings, in cells; the middle cell is counted."""
        return [max(1, round((size / self.cell - 1) / 2)) for size in self.openings]

    @property
    def near_levels(self) -> int:
        """Levels of the provisional surface."""
        return self._levels(NEAR)

    @property
    def far_levels(self) -> int:
        """Levels of the surface that heights are measured from."""
        return self._levels(FAR)

    def _levels(self, block: float) -> int:
        """Return how often cells are joined, 2 x 2, until they are blocks of about that side."""
        return max(1, round(math.log2(block / self.cell)))

    def is_ground(
        self,
        use: NDArray[np.bool_],
        height: NDArray[np.float64],
        gradient: NDArray[np.float64],
    ) -> NDArray[np.bool_]:
        """Return which points to `use` are ground by their height and slope; NaN is not."""
        return use & (np.abs(height) <= self.threshold + self.scalar * gradient)
