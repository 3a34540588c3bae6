"""``filters.wires``: class of wires, long thin lines that hang in the air, and of the towers and poles that hold them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..base.las import TOWER, WIRE
from ..terrain import towers
from ..terrain.towers import find_towers
from ..terrain.wires import REACH, find_wires
from .base import ClassStage
from .options import ignore_option, keep_option, option
from .points import Points, class_counts
from .selection import Selection


class Wires(ClassStage):
    type = "filters.wires"
    summary = "Give wires their class, long thin lines that hang in the air, and the towers that hold them"
    where_help = "Points outside keep their class but still serve as neighbors."
    code: int = option("integer", WIRE, "Class code of wires", minimum=0, maximum=255)
    towers: bool = option(
        "boolean", False, "Also give towers and poles their class, where wires end and meet"
    )
    tower_code: int = option("integer", TOWER, "Class code of towers and poles", minimum=0, maximum=255)
    ignore: Selection = ignore_option("Points that are as good as not there, and keep their class")
    keep: Selection = keep_option()
    details = """
Finds wires by their shape, whatever their class was: points more than 4 m above the ground on a straight line of 24 m
that is filled and around which the air is empty, or of some lines side by side; lines that hang together over 30 m and
hide nothing: an eave, a cornice or a balcony has no ground below, or none on one side. What goes on along the line is of
it, up to 6 m into a tree or a tower.

With `towers`, what stands upright and narrow where wires are highest, rising towards it from both sides (or from one, at a
line's end), gets its class from 0.7 m above the ground on: lattice towers with their arms, and poles. Lamps, trees and masts
that hold no wires keep theirs. Tiles are read wider for it.

Put it after the classifier. Nothing depends on the order of points, and the grid is anchored to absolute coordinates: a
tile with its halo gets the wires of the whole cloud. The counts are in the metadata as `wires` and `towers`, the classes
that they leave as `left`.
"""
    before = (
        {"type": "filters.hag_morphological", "ground": True, "openings": [5, 17]},
        {"type": "filters.modelclassifier", "model": "standard"},
    )
    example = {"type": "filters.wires"}

    def reads(self) -> list[str]:
        return ["Classification", "HeightAboveGround"]

    def halo_m(self) -> float:
        return REACH + (towers.REACH if self.towers else 0.0)

    def largest_class(self) -> int:
        return max(self.code, self.tower_code) if self.towers else self.code

    def run(self, points: Points) -> dict[str, NDArray]:
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
            figures["towers"] = points.counted(tower & free)
        codes[wire & free] = self.code
        figures["wires"] = points.counted(wire & free)
        figures["left"] = class_counts(before[codes != before])
        figures["classes"] = class_counts(codes[points.inside])
        return {"Classification": points.with_codes(codes)}
