"""``filters.bridges``: class of bridge decks, which leave ground and buildings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..base.asprs import BRIDGE, TOWER, WIRE
from ..base.messages import Count
from ..structures.decks import RULES, find_decks
from .base import ClassStage, StageContext
from .options import Selection, code_option, keep_option
from .points import Points, class_counts

#: Class codes that are kept: leaves, wires and towers beside a deck are as high as the deck.
_BESIDE = (3, 4, 5, WIRE, TOWER)


class Bridges(ClassStage):
    """Find bridge decks among the points above the ground (:mod:`..structures.decks`)."""

    type = "filters.bridges"
    summary = "Classify bridge decks, which are then no longer ground or building"
    source = (
        "after Sithole, Vosselman 2006, ISPRS Journal of Photogrammetry and Remote Sensing 61(1), "
        "33-46"
    )
    decks = Count("bridge decks (bridges)")
    code: int = code_option(BRIDGE, "Class code of bridge decks")
    keep: Selection = keep_option()
    reads_around = frozenset({"Ground"})

    def reads(self) -> list[str]:
        """Return the dimensions that the points must have."""
        return ["Classification", "Ground"]

    def halo_m(self) -> float:
        """Return how far around a tile points change its results, in meters."""
        return RULES.reach_m

    def written_classes(self) -> set[int]:
        """Return the class codes that may be written."""
        return {self.code}

    def run(self, points: Points, context: StageContext) -> dict[str, NDArray]:
        """Give points of bridge decks their class."""
        ignored, ground = points.ignored(self.ignore), points.dimension("Ground") != 0
        before = points.class_codes
        free = points.inside & ~ignored & ~points.chosen(self.keep)
        deck = find_decks(*points.axes, ~ignored, ground) & free & ~np.isin(before, _BESIDE)
        codes = before.copy()
        codes[deck] = self.code
        figures = points.report.figures
        points.tally(self.decks, deck)
        figures["left"] = class_counts(before[deck & (before != self.code)])
        figures["classes"] = class_counts(codes[free])
        return {"Classification": points.with_codes(codes)}
