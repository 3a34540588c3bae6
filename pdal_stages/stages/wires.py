"""``filters.wires``: class of wires and of the towers that carry them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..base.asprs import TOWER, WIRE
from ..structures import towers
from ..structures.towers import find_towers
from ..structures.wires import RULES, find_wires
from .base import ClassStage, StageContext
from .options import Selection, code_option, keep_option, option
from .points import Points, class_counts


class Wires(ClassStage):
    """Find wires and, on request, the towers that carry them."""

    type = "filters.wires"
    summary = "Classify wires, long thin lines in the air, and the towers that carry them"
    counts = {"wires": "wires (wires)", "towers": "towers (wires)"}
    code: int = code_option(WIRE, "Class code of wires")
    towers: bool = option(
        "boolean", False, "Also give towers their class, where wires end and meet"
    )
    tower_code: int = code_option(TOWER, "Class code of towers")
    keep: Selection = keep_option()
    reads_around = frozenset({"HeightAboveGround"})

    def reads(self) -> list[str]:
        """Return the dimensions that the points must have."""
        return ["Classification", "HeightAboveGround"]

    def halo_m(self) -> float:
        """Return how far around a tile points change its results, in meters."""
        return RULES.reach_m + (towers.RULES.reach_m if self.towers else 0.0)

    def written_classes(self) -> set[int]:
        """Return the class codes that may be written."""
        return {self.code, self.tower_code} if self.towers else {self.code}

    def run(self, points: Points, context: StageContext) -> dict[str, NDArray]:
        """Give points of wires and towers their class."""
        ignored = points.ignored(self.ignore)
        height = np.asarray(points.dimension("HeightAboveGround"), np.float64)
        free = points.inside & ~ignored & ~points.chosen(self.keep)
        before = points.class_codes
        codes = before.copy()
        figures = points.report.figures
        wire = find_wires(points.xyz, height, ~ignored)
        if self.towers:
            tower = find_towers(points.xyz, height, wire, ~ignored)
            wire &= ~tower
            codes[tower & free] = self.tower_code
            points.tally("towers", tower & free)
        codes[wire & free] = self.code
        points.tally("wires", wire & free)
        figures["left"] = class_counts(before[codes != before])
        figures["classes"] = class_counts(codes[points.inside])
        return {"Classification": points.with_codes(codes)}
