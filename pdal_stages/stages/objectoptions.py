"""Options that the stages of objects share: those of the search, and which classes are what."""

from __future__ import annotations

from dataclasses import fields
from functools import cached_property
from typing import Any

from ..base.errors import OptionError, suggest
from ..objects import Cells, ObjectSettings
from ..objects.cells import CLASSES, ENOUGH, Kind, kind_of_code, refuse_unclassified
from ..objects.measure import REASONS
from .options import ignore_option, option
from .points import Points
from .selection import Selection

_SETTINGS = {one.name: one for one in fields(ObjectSettings)}
_CODES = {
    "ground": Kind.GROUND,
    "buildings": Kind.BUILDING,
    "trees": Kind.TREE,
    "wires": Kind.SPAN,
    "decks": Kind.DECK,
    "towers": Kind.TOWER,
}


def _codes(name: str, what: str) -> Any:
    return option("codes", CLASSES[_CODES[name]], f"Class codes of {what}", may_be_empty=True)


class ObjectOptions:
    """Mixed into stages."""

    ground: list[int] = _codes("ground", "the ground, and of water")
    buildings: list[int] = _codes("buildings", "buildings, roofs and facades")
    trees: list[int] = _codes("trees", "vegetation that trees are looked for in")
    wires: list[int] = _codes("wires", "wires")
    decks: list[int] = _codes("decks", "bridge decks")
    towers: list[int] = _codes("towers", "towers and poles, where spans of wires end")
    refuse: list[str] = option(
        "list",
        (),
        "Objects with one of these reasons to be checked are none (filters.objects: their points change their class), and "
        f"counted: {', '.join(REASONS)}",
        may_be_empty=True,
    )
    ignore: Selection = ignore_option("Points of no object")

    options: dict[str, Any]

    @cached_property
    def settings(self) -> ObjectSettings:
        """How objects are told apart."""
        return ObjectSettings(**{name: self.options[name] for name in _SETTINGS})

    @cached_property
    def classes(self) -> dict[Kind, tuple[int, ...]]:
        """Class codes of each kind."""
        return {kind: tuple(int(c) for c in self.options[name]) for name, kind in _CODES.items()}

    def check(self) -> None:
        kind_of_code(self.classes)
        for name in self.options["refuse"]:
            if name not in REASONS:
                raise OptionError(
                    "option 'refuse' names no reason",
                    found=repr(name),
                    cure=f"{suggest(str(name), REASONS)}Reasons: {', '.join(REASONS)}",
                )

    def cells(self, points: Points) -> Cells:
        """Records of the points that may be of objects, or are ground.

        Raises
        ------
        StageError
            Where no point has a class of any kind, or none is ground.
        """
        cells = self.records(points)
        refuse_unclassified(cells, points.class_codes[points.usable(self.ignore)])
        if thin := cells.thin():
            points.report.warnings.append(
                f"cells of {cells.size:g} m hold fewer than {ENOUGH:g} points of {thin[0]} on average, so objects may fall "
                f"apart: set cell to {2 * cells.size:g} or more"
            )
        return cells

    def records(self, points: Points) -> Cells:
        """The same of a part of the points, whatever classes it has."""
        usable = points.usable(self.ignore)
        x, y, z = points.axes
        codes, told = points.class_codes, points.arrays.get("Reliability")
        if not usable.all():
            x, y, z, codes = x[usable], y[usable], z[usable], codes[usable]
            told = None if told is None else told[usable]
        return Cells.of(x, y, z, codes, self.settings.cell, reliability=told, classes=self.classes)


for _name, _one in _SETTINGS.items():
    _rule = _one.metadata
    _made = option(
        "number", _one.default, _rule["what"], minimum=_rule["low"], maximum=_rule["high"], unit=_rule["unit"]
    )
    _made.__set_name__(ObjectOptions, _name)
    setattr(ObjectOptions, _name, _made)
