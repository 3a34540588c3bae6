"""``writers.objects``: buildings, trees, spans and decks as polygons, points and lines with what was measured of them."""

from __future__ import annotations

from numpy.typing import NDArray

from ..base.files import Output
from ..objects.find import find_objects
from ..objects.outlines import with_vector
from .base import Stage
from .objects import ObjectOptions
from .options import option
from .points import Points

#: How outlines are drawn.
STRAIGHT, CELLS = "straight", "cells"


class ObjectsWriter(ObjectOptions, Stage):
    type = "writers.objects"
    summary = "Write buildings, trees, spans of wires and bridge decks to a vector file"
    instead_of_tiles = "Write the points first, then: pdal-stages objects FILES town.gpkg"
    where_help = "Points outside form no object."
    needs_points = "find objects in"
    filename: str = option(
        "filename",
        None,
        "File to write: .gpkg with all layers, or .geojson, .fgb, .shp, one for each layer, named after it",
        required=True,
    )
    outlines: str = option(
        "string",
        STRAIGHT,
        "Outlines of buildings and decks: straight, along walls, or along cells",
        choices=(STRAIGHT, CELLS),
    )
    details = """
The objects are those of `filters.objects`, with the same ids and options. Layers and their columns (measures in meters,
whatever the unit of the coordinates; names fit into shapefiles):

- `buildings`: polygons. `area`; `h_eave`, `h_ridge` above the ground; `ground`, its elevation; `slope` of the roof in
  degrees, its number of `planes` and the share of it in planes, `planar`.
- `trees`: points at the tops; `crowns`: their polygons. `height`, crown's `area` and `diam`eter, `dbh`: the stem's
  likely diameter at breast height, cm; `ground`.
- `spans`: lines along wires. `length`, `h_low` (the lowest point above the ground), `z_high`, `sag`.
- `decks`: polygons of bridges. `area`, `z`, `clear`ance above what is below, `ground`.

All have `object_id`, `points`, `reliab` (the points' mean `Reliability`, where they have one), `verdict` (sure, check) and
the `reason` of a check. Straight outlines follow the main direction of what stands wall to wall; neighbors that touch share
their edge; where no straight outline is like the cells, theirs is taken. A GeoPackage carries styles for QGIS, which
tell what is to be checked; beside other files lies a `.qml`. Needs the extra `vector` (pyogrio, shapely).
"""
    before = ({"type": "filters.modelclassifier", "model": "town.model"},)
    after = ()
    example = {"type": "writers.objects", "filename": "town.gpkg"}

    #: Whether whoever reads the files may take larger cells than `cell` where points are few.
    widens = False

    def check(self) -> None:
        from ..reports.objectlayers import check_target

        super().check()
        with_vector(check_target, self.filename)

    def outputs(self) -> list[Output]:
        from ..reports.objectlayers import target_files

        return [Output(str(file), "objects") for file in target_files(self.filename)]

    def reads(self) -> list[str]:
        return ["Classification"]

    def run(self, points: Points) -> dict[str, NDArray]:
        from ..reports.objectlayers import write_objects

        found, refused = find_objects(self.cells(points), self.settings).without(self.refuse)
        if self.refuse:
            points.report.figures["refused"] = refused
        straight = self.outlines == STRAIGHT
        figures = with_vector(write_objects, self.filename, found, straight, points.units, points.wkt)
        points.report.figures |= figures
        return {}
