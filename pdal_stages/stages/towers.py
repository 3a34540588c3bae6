"""``filters.towers``: class of towers and poles, which hold wires."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..base.asprs import TOWER, WIRES
from ..base.dimensions import HEIGHT
from ..base.messages import Count
from ..structures.towers import RULES, find_towers
from .base import ClassStage, StageContext
from .options import Selection, code_option, keep_option
from .points import Points, class_counts


class Towers(ClassStage):
    """Find what holds the wires that were found (:mod:`..structures.towers`)."""

    type = "filters.towers"
    summary = "Classify towers and poles, by the wires that they hold"
    towers = Count("points of towers (towers)")
    code: int = code_option(TOWER, "Class code of towers")
    keep: Selection = keep_option()

    def reads(self) -> list[str]:
        """Return the dimensions that the points must have."""
        return ["Classification", HEIGHT.name]

    def halo_m(self) -> float:
        """Return how far around a tile points change its results, in meters."""
        return RULES.reach_m

    def written_classes(self) -> set[int]:
        """Return the class codes that may be written."""
        return {self.code}

    def run(self, points: Points, context: StageContext) -> dict[str, NDArray]:
        """Give points of towers their class."""
        before = points.class_codes
        usable, wire = ~points.ignored(self.ignore), np.isin(before, WIRES)
        tower = points.inside & usable & ~points.chosen(self.keep)
        if wire.any():
            height = np.asarray(points.dimension(HEIGHT.name), np.float64)
            tower &= find_towers(points.xyz, height, usable, wire)
        else:
            tower[:] = False
        codes = before.copy()
        codes[tower] = self.code
        points.tally(self.towers, tower)
        points.report.figures["left"] = class_counts(before[tower & (before != self.code)])
        return {"Classification": points.with_codes(codes)}
