"""``filters.polygons``: the class of points inside the polygons of a map."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..base.messages import Count, Message, Topic
from ..base.vector import Overlay, inside_of, with_vector
from .base import ClassStage, StageContext
from .options import Selection, ignore_option, keep_option, option
from .points import Points, class_counts


class Polygons(ClassStage):
    """Change the class of points inside polygons of a map."""

    type = "filters.polygons"
    summary = (
        "Set the class of points inside the polygons of any OGR file, such as water inside lakes"
    )
    where_help = "Points outside keep their class"
    inside = Count("points inside polygons (polygons)")
    polygons: list = option(
        "list",
        None,
        "Files and classes, FILE=CODE: lakes.gpkg=9 makes ground (2) inside water, "
        "bridges.gpkg=17:2,6 ground and buildings bridge decks, FILE=CODE:all everything inside; "
        "a layer is named as in lakes.gpkg|layername=canals=9",
        required=True,
    )
    ignore: Selection = ignore_option("Points that keep their class")
    keep: Selection = keep_option("Further points that keep their class")

    def check(self) -> None:
        """Refuse options that contradict each other."""
        self.overlays = Overlay.parse_all([*map(str, self.polygons)])
        for overlay in self.overlays:
            with_vector(overlay.find_layer)

    def inputs(self) -> list[str]:
        """Return the files that are read."""
        return [overlay.file for overlay in self.overlays if "://" not in overlay.file]

    def written_classes(self) -> set[int]:
        """Return the class codes that may be written."""
        return {overlay.code for overlay in self.overlays}

    def run(self, points: Points, context: StageContext) -> dict[str, NDArray]:
        """Give points inside polygons their class."""
        change = points.changeable(self.ignore, self.keep)
        x, y = (np.asarray(points.arrays[name], np.float64) for name in "XY")
        box = float(x.min()), float(y.min()), float(x.max()), float(y.max())
        codes = points.class_codes.copy()
        counts, notes = {}, []
        changed = np.zeros(points.count, bool)
        for overlay in self.overlays:
            may = np.flatnonzero(change & np.isin(codes, overlay.over) if overlay.over else change)
            inside, polygons, note = with_vector(
                inside_of, overlay, points.wkt, x[may], y[may], box
            )
            rows = may[inside]
            codes[rows] = overlay.code
            changed[rows] = True
            name = f"{overlay.file}|layername={overlay.layer}" if overlay.layer else overlay.file
            counts[f"{name}={overlay.code}"] = {"polygons": polygons, "points": len(rows)}
            notes += [note] if note else []
            if not polygons:
                text = "no polygon lies where the points are (check the reference systems of both)"
                points.report.warn(f"{text}: {name}", Topic.NOTHING_MATCHES)
        points.report.figures["polygons"] = counts
        points.tally(self.inside, changed)
        points.report.figures["classes"] = class_counts(codes[change])
        points.report.notes += map(Message, notes)
        return {"Classification": points.with_codes(codes)}
