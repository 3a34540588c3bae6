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
from ..base.options import Settings, setting

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
class FilterOptions(Settings):
    """Options of :func:`.heights.filtered_ground`, in meters; OptionError for wrong ones."""

    cell: float = setting(1.0, "number", "Side of the grid's cells", 0.05, 1000, unit="m")
    slope: float = setting(
        0.1,
        "number",
        "Rise over run: a window removes what it lowers by more than this times its radius; raise "
        "it for rugged terrain without buildings",
        *(0, 100),
    )
    window: float = setting(
        18.0,
        "number",
        "Radius of the largest window: half the width of the largest object that is removed; wider "
        "roofs, up to 220 m, are removed where most of their outline is a step",
        *(0, 10_000),
        exclusive=True,
        unit="m",
    )
    threshold: float = setting(
        0.4, "number", "Maximum distance of ground points from the surface", 0, 1000, unit="m"
    )
    scalar: float = setting(
        1.25, "number", "Added to the threshold per unit of the terrain's slope", 0, 1000
    )
    openings: Sequence[float] = setting(
        (),
        "numbers",
        "Also write heights above morphological openings of the minimum grid with windows of "
        "these widths in meters, e.g. 5,9,17,33,65: HeightAboveOpening_5, ...",
        may_be_empty=True,
    )
    slope_too: bool = False  #: whether the terrain's slope is wanted
    #: whether heights above the provisional surface, and what is still ground, are wanted
    judged: bool = False
    keep: Keep | None = None  #: receives what each step made of each piece of the cloud
    threads: int | None = None  #: None or 0: every available core

    def __post_init__(self) -> None:
        """Refuse wrong sizes."""
        super().__post_init__()
        for name, value in (("window", self.window), *(("openings", w) for w in self.openings)):
            checks.number(f"'{name}'", value, 0, above=True)
            if value > _MOST_CELLS * self.cell:
                raise OptionError(
                    f"'{name}' must not be more than {_MOST_CELLS} cells",
                    found=f"{value:g} m in cells of {self.cell:g} m",
                    cure="Use larger cells or a smaller window",
                )

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
        return use & (np.abs(height) <= self.tolerance(gradient))

    def tolerance(self, gradient: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far from the provisional surface points are ground, in meters."""
        return self.threshold + self.scalar * gradient
