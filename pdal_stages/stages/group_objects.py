"""``filters.objects``: number the buildings, trees, spans and decks that points belong to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ..base.dimensions import OBJECT_ID, RELIABILITY, Dimension
from ..base.errors import StageError
from ..base.json_types import JsonObject
from ..objects.cells import (
    CLASSES,
    MIN_POINTS_PER_CELL,
    Cells,
    Kind,
    kind_of_code,
    refuse_unclassified,
)
from ..objects.detect import find_objects
from ..objects.raster_view import MARGIN
from ..objects.results import Objects, ObjectSettings
from .base import Stage, StageContext
from .options import Selection, ignore_option, option
from .points import Points

#: Option -> kind of object whose class codes it lists.
_CODES = {
    "ground": Kind.GROUND,
    "buildings": Kind.BUILDING,
    "trees": Kind.TREE,
    "wires": Kind.SPAN,
    "decks": Kind.DECK,
}


def _codes(name: str, what: str) -> Any:
    return option("codes", CLASSES[_CODES[name]], f"Class codes of {what}", may_be_empty=True)


class ObjectOptions:
    """Options that the stages of objects share: those of the search, and which classes are what."""

    optional_dimensions: ClassVar[tuple[str, ...]] = (RELIABILITY.name,)
    ground: list[int] = _codes("ground", "the ground, and of water")
    buildings: list[int] = _codes("buildings", "buildings, roofs and facades")
    trees: list[int] = _codes("trees", "vegetation that trees are looked for in")
    wires: list[int] = _codes("wires", "wires")
    decks: list[int] = _codes("decks", "bridge decks")
    ignore: Selection = ignore_option("Points that belong to no object")

    options: JsonObject

    @cached_property
    def settings(self) -> ObjectSettings:
        """Return the settings of the search."""
        names = [field.name for field in fields(ObjectSettings)]
        return ObjectSettings(**{name: self.options[name] for name in names})

    @cached_property
    def classes(self) -> dict[Kind, tuple[int, ...]]:
        """Return the class codes of each kind."""
        return {kind: tuple(int(c) for c in self.options[name]) for name, kind in _CODES.items()}

    def check(self) -> None:
        """Refuse options that contradict each other."""
        kind_of_code(self.classes)

    def cells(self, points: Points, context: StageContext) -> Cells:
        """Return cells with the points that may belong to objects, or are ground.

        Raises
        ------
        StageError
            Where no point has a class of any kind, or none is ground. In tiles that is a warning,
            as other tiles may have some.
        """
        cells = self.records(points)
        try:
            refuse_unclassified(cells, points.class_codes[points.usable(self.ignore)])
        except StageError as error:
            if not context.outside:
                raise
            points.report.warn(str(error))
        if thin := cells.sparse_kind():
            points.report.warn(
                f"cells of {cells.size:g} m hold fewer than {MIN_POINTS_PER_CELL:g} points of "
                f"{thin[0]} on average, so objects may fall apart: set cell to {2 * cells.size:g} "
                "or more"
            )
        return cells

    def records(self, points: Points) -> Cells:
        """Return cells with a part of a cloud's points, whatever classes it has."""
        usable = points.usable(self.ignore)
        x, y, z = points.axes
        codes, reliability = points.class_codes, points.reliability
        if not usable.all():
            x, y, z, codes = x[usable], y[usable], z[usable], codes[usable]
            reliability = None if reliability is None else reliability[usable]
        return Cells.from_points(
            x, y, z, codes, self.settings.cell, reliability=reliability, classes=self.classes
        )


class GroupObjects(ObjectOptions, Stage, settings=ObjectSettings):
    """Number the objects that points belong to."""

    type = "filters.objects"
    summary = "Group classified points into buildings, trees, spans of wires and bridge decks"
    source = (
        "crowns after Kwak, Lee, Lee, Biging, Gong 2007 (Journal of Forest Research 12, 425-434) "
        "and Chen, Baldocchi, Gong, Kelly 2006 (Photogrammetric Engineering and Remote Sensing "
        "72, 923-932)"
    )
    where_help = "Points outside form no object, and keep what they have"
    open_ended = True  # a building may be larger than the surroundings of a tile

    def reads(self) -> list[str]:
        """Return the dimensions that the points must have."""
        return ["Classification"]

    def written_dimensions(self) -> Sequence[Dimension]:
        """Return the dimensions that are written."""
        return (OBJECT_ID,)

    def halo_m(self) -> float:
        """Return how far around a tile points change its results, in meters."""
        return MARGIN + 4 * self.settings.cell

    def reach_of(self, points: Points, context: StageContext, box: Sequence[float]) -> float:
        """Return how far around a tile the points lie that decide its results, in meters."""
        wanted = context.used(points.arrays)
        if wanted is None or not wanted.any():
            return 0.0
        size, (west, south, east, north) = self.settings.cell, box
        objects = self._find(points, context)
        ids = np.unique(self._ids(objects, points)[wanted])
        away = 0.0
        for kind in (Kind.BUILDING, Kind.SPAN, Kind.DECK):
            table = objects.tables[kind]
            for number in np.flatnonzero(np.isin(table.ids, ids)).tolist():
                row, column, _ = table.cells[number]
                away = max(away, west - column.min() * size, (column.max() + 1) * size - east)
                away = max(away, south - row.min() * size, (row.max() + 1) * size - north)
        return float(away) + self.halo_m()

    def _find(self, points: Points, context: StageContext) -> Objects:
        """Return the objects of the points."""
        return find_objects(self.cells(points, context), self.settings, progress=False)

    def _ids(self, objects: Objects, points: Points) -> NDArray[np.int64]:
        """Return the number of each point's object (n,); 0 for points of none."""
        kinds = kind_of_code(self.classes)[points.class_codes]
        kinds[~points.inside | points.chosen(self.ignore)] = -1
        x, y, z = points.xyz.T
        return objects.ids_at(x, y, z, kinds)

    def run(self, points: Points, context: StageContext) -> dict[str, NDArray]:
        """Find objects and number their points."""
        objects = self._find(points, context)
        ids = self._ids(objects, points).astype(np.uint64)
        points.report.figures |= {
            kind: counts for kind, counts in objects.summary().items() if counts["objects"]
        }
        if points.mask is not None:
            ids = np.where(points.mask, ids, points.arrays["ObjectID"])
        return {"ObjectID": ids}
