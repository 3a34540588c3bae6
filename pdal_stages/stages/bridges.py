"""``filters.bridges``: class of bridge decks, which leave ground and buildings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..base.las import BRIDGE
from ..terrain.decks import PARTS, SURFACE
from .base import ClassStage
from .options import code_option, ignore_option, keep_option
from .points import Points, class_counts
from .selection import Selection

#: What parapets, flanks and cars are called where they are taken for something that stands on the ground.
_MISTAKEN = (2, 6)


class Bridges(ClassStage):
    type = "filters.bridges"
    summary = "Classify bridge decks, which are then no longer ground or building"
    where_help = "Points outside keep their class"
    code: int = code_option(BRIDGE, "Class code of bridge decks")
    ignore: Selection = ignore_option("Points that keep their class")
    keep: Selection = keep_option("Further points that keep their class")

    def reads(self) -> list[str]:
        return ["Classification", "Deck"]

    def largest_class(self) -> int:
        return self.code

    def run(self, points: Points) -> dict[str, NDArray]:
        free = points.changeable(self.ignore, self.keep)
        before, deck = points.class_codes, points.dimension("Deck")
        parts = free & (deck == PARTS) & np.isin(before, _MISTAKEN)
        found = parts | (free & (deck == SURFACE))
        codes = before.copy()
        codes[found] = self.code
        figures = points.report.figures
        figures["decks"], figures["parts"] = points.counted(found), points.counted(parts)
        left = found & (before != self.code)
        figures["left"] = class_counts(before[left])
        figures["classes"] = class_counts(codes[free])
        return {"Classification": points.with_codes(codes)}
