"""``filters.wires``: class of wires."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..base.asprs import WIRE
from ..structures.wires import RULES, find_wires
from .base import ClassStage, StageContext
from .options import Selection, code_option, keep_option
from .points import Points, class_counts


class Wires(ClassStage):
    """Find wires."""

    type = "filters.wires"
    summary = "Classify wires, long thin lines in the air"
    counts = {"wires": "wires (wires)"}
    code: int = code_option(WIRE, "Class code of wires")
    keep: Selection = keep_option()
    reads_around = frozenset({"HeightAboveGround"})

    def reads(self) -> list[str]:
        """Return the dimensions that the points must have."""
        return ["Classification", "HeightAboveGround"]

    def halo_m(self) -> float:
        """Return how far around a tile points change its results, in meters."""
        return RULES.reach_m

    def written_classes(self) -> set[int]:
        """Return the class codes that may be written."""
        return {self.code}

    def run(self, points: Points, context: StageContext) -> dict[str, NDArray]:
        """Give points of wires their class."""
        ignored = points.ignored(self.ignore)
        height = np.asarray(points.dimension("HeightAboveGround"), np.float64)
        free = points.inside & ~ignored & ~points.chosen(self.keep)
        before = points.class_codes
        codes = before.copy()
        figures = points.report.figures
        wire = find_wires(points.xyz, height, ~ignored)
        codes[wire & free] = self.code
        points.tally("wires", wire & free)
        figures["left"] = class_counts(before[codes != before])
        figures["classes"] = class_counts(codes[points.inside])
        return {"Classification": points.with_codes(codes)}
