"""``filters.consistency``: named rules that mend classes which contradict their surroundings."""

from __future__ import annotations

from numpy.typing import NDArray

from ..objects.consistency import RULES, consistent, reach
from .base import ClassStage
from .options import ignore_option, keep_option, option, vegetation_heights_option
from .points import Points, class_counts
from .selection import Selection


class Consistency(ClassStage):
    type = "filters.consistency"
    summary = "Mend classes that contradict their surroundings, by named rules that count what they change"
    where_help = "Points outside keep their class but still serve as neighbors"
    forgets = True
    ground: bool = option(
        "boolean",
        True,
        "Building points below 0.3 m that the ground filter calls ground, with nothing tall within 2 m, become ground",
    )
    islands: bool = option(
        "boolean",
        True,
        "Ground points more than 2 m above the terrain take their neighbors' class, building or vegetation",
    )
    lone: bool = option(
        "boolean",
        True,
        "A single building or vegetation point among ten or more of the other takes their class",
    )
    vegetation_heights: tuple[float, float] | None = vegetation_heights_option(
        "points that become vegetation are low (3) below the first, medium (4) below the second and high (5) above; "
        "without heights they take the class of most vegetation around, or high"
    )
    ignore: Selection = ignore_option(
        "Points that are left out, even as neighbors, and keep their class"
    )
    keep: Selection = keep_option()

    @property
    def _rules(self) -> list[str]:
        return [rule for rule in RULES if self.options[rule]]

    def halo_m(self) -> float:
        return reach(self._rules)

    def largest_class(self) -> int:
        return 6

    def run(self, points: Points) -> dict[str, NDArray]:
        ignored, kept = points.ignored(self.ignore), points.chosen(self.keep)
        change = points.inside & ~ignored & ~kept
        names = {"height": "HeightAboveGround", "ground": "Ground"}
        known = {
            word: points.dimension(name) if name in points.arrays else None
            for word, name in names.items()
        }
        if any(values is None for values in known.values()) and (self.ground or self.islands):
            points.report.warnings.append(
                "there is no HeightAboveGround or no Ground: the rules ground and islands did nothing"
            )
        before = points.class_codes
        if self.vegetation_heights:
            points.dimension("HeightAboveGround")  # refused where there is none
        points.keep_only(["Classification", "HeightAboveGround", "Ground"])
        codes, changed = consistent(
            points.take_xyz(),
            before,
            **known,
            mask=~ignored,
            change=change,
            rules=self._rules,
            vegetation_heights=self.vegetation_heights,
        )
        points.report.figures |= changed
        points.report.figures["changed"] = points.counted(codes != before)
        points.report.figures["classes"] = class_counts(codes[change])
        return {"Classification": points.with_codes(codes)}
