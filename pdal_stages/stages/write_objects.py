"""``writers.objects``: buildings, trees, spans and decks with their attributes as a vector file."""

from __future__ import annotations

from numpy.typing import NDArray

from ..base.files import Output
from ..base.vector import with_vector
from ..objects.detect import find_objects
from ..objects.results import ObjectSettings
from .base import Stage, StageContext
from .group_objects import ObjectOptions
from .options import option
from .points import Points

#: How outlines are drawn.
STRAIGHT = "straight"
CELLS = "cells"


class WriteObjects(ObjectOptions, Stage, settings=ObjectSettings):
    """Write objects as polygons, points and lines."""

    type = "writers.objects"
    summary = "Write buildings, trees, spans of wires and bridge decks to a vector file"
    instead_of_tiles = "Write the points first, then: pdal-stages objects FILES town.gpkg"
    where_help = "Points outside form no object"
    needs_points = "find objects in"
    filename: str = option(
        "filename",
        None,
        "File to write: .gpkg with all layers, or .geojson, .fgb, .shp, one for each layer, named "
        "after it",
        required=True,
    )
    outlines: str = option(
        "string",
        STRAIGHT,
        "Outlines of buildings and decks: straight, along walls, or along the grid's cells",
        choices=(STRAIGHT, CELLS),
    )

    def check(self) -> None:
        """Refuse options that contradict each other."""
        from ..reports.object_layers import LAYERS
        from ..reports.vector_files import check_target

        super().check()
        with_vector(check_target, self.filename, LAYERS)

    def outputs(self) -> list[Output]:
        """Return the files that are written."""
        from ..reports.object_layers import LAYERS
        from ..reports.vector_files import target_files

        return [Output(str(file), "objects") for file in target_files(self.filename, LAYERS)]

    def reads(self) -> list[str]:
        """Return the dimensions that the points must have."""
        return ["Classification"]

    def run(self, points: Points, context: StageContext) -> dict[str, NDArray]:
        """Find objects and write them."""
        from ..reports.object_layers import write_objects

        objects = find_objects(self.cells(points, context), self.settings)
        how = self.outlines == STRAIGHT, points.units, points.wkt
        points.report.figures |= with_vector(write_objects, self.filename, objects, *how)
        return {}
