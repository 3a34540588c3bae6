"""What PDAL's writers are told in tiles: a format that holds what all inputs hold, one grid of rasters, extra dimensions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ..base import las
from ..base.errors import StageError
from ..pipeline.filenames import LAS_WRITERS
from ..pipeline.inputs_outputs import is_ept, is_las
from ..pipeline.las_output import extra_dims_option
from .grid import Box
from .plan import MOVING
from .sources import ept_format, read_ept

_COLORS, _INFRARED = {2, 3, 7, 8}, {8}
#: Options that say already where a raster lies.
_PLACED = ("bounds", "origin_x", "origin_y", "width", "height")


def one_format(paths: Sequence[str]) -> dict[str, Any]:
    """Options of ``writers.las`` that hold what each of some inputs holds; none where these are alike LAS files.

    The finest scale along each axis, and of the formats from LAS 1.4 the first that has all colors there are: PDAL forwards
    only what all inputs of a tile share, and has scales of a centimeter and point format 3 for the rest. What cannot be
    read is said when it is.
    """
    formats: set[int] = set()
    places: set[tuple[float, ...]] = set()
    for path in paths:
        try:
            if is_ept(path):
                described = read_ept(path)
                axes = {one["name"]: one for one in described["schema"]}
                formats.add(ept_format(described))
                found = [axes.get(axis, {}).get(name) for name in ("scale", "offset") for axis in "XYZ"]
                places.add(tuple(float(v or (0.001, 0.0)[n > 2]) for n, v in enumerate(found)))
            elif is_las(path) and (header := las.read_header(path)) and header.count:
                formats.add(header.point_format)
                places.add((*header.scales, *header.offsets))
        except (OSError, StageError, ValueError, TypeError):
            continue
    options: dict[str, Any] = {}
    if len(formats) > 1 or any(map(is_ept, paths)):
        colored = 8 if formats & _INFRARED else 7 if formats & _COLORS else 6
        options = {"minor_version": 4, "dataformat_id": colored}
    for axis, name in enumerate("xyz"):
        if len({(place[axis], place[3 + axis]) for place in places}) > 1:
            options |= {f"scale_{name}": min(place[axis] for place in places), f"offset_{name}": "auto"}
    return options


def with_dimensions(
    tail: list[dict[str, Any]], beside: Mapping[str, str] | None, paths: list[str]
) -> list[dict[str, Any]]:
    """A tail whose LAS writers are told which extra dimensions to write: the inputs' own, and those `beside` them."""
    listed = "" if beside is None else extra_dims_option(paths, beside)
    return [
        {"extra_dims": listed, **stage} if listed and stage["type"] in LAS_WRITERS else stage
        for stage in tail
    ]


# ---- rasters -------------------------------------------------------------------------------------------------


def on_one_grid(tail: Sequence[dict[str, Any]], box: Box, half_open: bool) -> list[dict[str, Any]]:
    """Stages whose rasters of a tile, or of a file, have cells that begin at multiples of their side.

    PDAL begins each where its first points happen to lie. `box`: where points lie, in the unit of the coordinates; the
    raster holds it. `half_open`: none lies on its far sides. A raster without points is empty then, where PDAL would fail.
    """
    out = []
    moved = False
    for stage in tail:
        moved |= stage["type"] in MOVING
        placed = moved or stage["type"] != "writers.gdal" or any(name in stage for name in _PLACED)
        try:
            side = 0.0 if placed else float(stage["resolution"])
        except (KeyError, TypeError, ValueError):
            side = 0.0  # which PDAL says
        if 0.0 < side < math.inf:
            left, bottom, right, top = (_cells(v, side) for v in box)
            if not half_open:
                right, top = math.floor(right) + 1, math.floor(top) + 1
            left, bottom = math.floor(left), math.floor(bottom)
            wide, high = max(1, math.ceil(right) - left), max(1, math.ceil(top) - bottom)
            place = {"origin_x": left * side, "origin_y": bottom * side, "width": wide, "height": high}
            stage = {**stage, **place}
        out.append(stage)
    return out


def _cells(coordinate: float, side: float) -> float:
    """A coordinate in cells; 500 m are 2,500 cells of 0.2 m, whatever the division says."""
    cells = coordinate / side
    return round(cells) if math.isclose(cells, round(cells), rel_tol=1e-12, abs_tol=1e-9) else cells
