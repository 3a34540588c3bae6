"""What a run of a stage knows besides its points and options: the tile, the pipeline around it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class StageContext:
    """Facts that hold for one run of a stage; the default is a run of its own on a whole cloud."""

    #: Whether an earlier stage of the pipeline created a dimension that this one creates too: the
    #: values that points have are results then, not an input's leftovers.
    created_before: bool = False
    #: What to report where a class code above 31 does not fit the pipeline's writer, and the cure;
    #: None where all fit.
    code_limit: tuple[str, str] | None = None
    #: In a tile: the dimension that holds how many meters a point lies outside the tile; negative
    #: inside. Else empty.
    outside: str = ""
    #: In a tile: how many meters outside it the results of this stage are still used, by later
    #: stages.
    used_m: float = 0.0
    #: In a tile: what the first round computed for a stage that reaches far (:mod:`.first_round`).
    blocks: Any = None

    def used(self, arrays: Mapping[str, NDArray]) -> NDArray[np.bool_] | None:
        """Return which points (n,) have results that are used; None outside tiles: all."""
        meters = arrays.get(self.outside)
        if meters is None:
            return None
        return meters <= self.used_m if self.used_m > 0 else meters < 0


#: Outside tiles and pipelines.
WHOLE_CLOUD = StageContext()
