"""Rasters of tiles on one grid: PDAL's ``writers.gdal`` begins each where its first points happen to lie."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from .grid import Box

#: Options that say already where a raster lies.
_PLACED = ("bounds", "origin_x", "origin_y", "width", "height")
#: Filters that move points away from where tiles lie.
_MOVING = ("filters.reprojection", "filters.transformation", "filters.projpipeline")


def on_one_grid(tail: Sequence[dict[str, Any]], box: Box, half_open: bool) -> list[dict[str, Any]]:
    """Stages whose rasters of a tile, or of a file, have cells that begin at multiples of their side.

    `box`: where the points lie, in the unit of the coordinates; the raster holds it. `half_open`: none lies on its far
    sides. A raster without points is empty then, where PDAL would fail.
    """
    out = []
    for number, stage in enumerate(tail):
        side = _side(stage, tail[:number])
        if side is not None:
            x0, y0, x1, y1 = box
            left, bottom = math.floor(_cells(x0, side)), math.floor(_cells(y0, side))
            right, top = (
                math.ceil(_cells(v, side)) if half_open else math.floor(_cells(v, side)) + 1 for v in (x1, y1)
            )
            stage = {
                **stage,
                "origin_x": left * side,
                "origin_y": bottom * side,
                "width": max(1, right - left),
                "height": max(1, top - bottom),
            }
        out.append(stage)
    return out


def remarks(tail: Sequence[dict[str, Any]], tile: float | None) -> list[str]:
    """What the user should know of rasters made tile by tile, `tile` units wide, or file by file (None)."""
    out = []
    for number, stage in enumerate(tail):
        if stage["type"] != "writers.gdal":
            continue
        side = _side(stage, tail[:number])
        if side is None:
            if not any(name in stage for name in _PLACED):
                out.append(
                    "writers.gdal: points are moved before, so rasters of tiles have grids of their own"
                )
            continue
        what = "tile" if tile is not None else "file"
        out.append(
            f"writers.gdal: each raster is made of the points of its {what} alone, so cells at its edge lack those beyond; "
            "for one raster without seams see docs/large-areas.md"
        )
        if tile is not None and _cells(tile, side) % 1:
            out.append(
                f"writers.gdal: tiles of {tile:g} are not whole cells of {side:g}, so rasters overlap by a cell; "
                f"take tiles of {max(1, round(tile / side)) * side:g}"
            )
    return list(dict.fromkeys(out))


def _side(stage: dict[str, Any], before: Sequence[dict[str, Any]]) -> float | None:
    """The side of the cells of a writer whose raster is to be placed."""
    if stage["type"] != "writers.gdal" or any(name in stage for name in _PLACED):
        return None
    if any(earlier["type"] in _MOVING for earlier in before):
        return None
    try:
        side = float(stage["resolution"])
    except (KeyError, TypeError, ValueError):
        return None  # which PDAL says
    return side if math.isfinite(side) and side > 0 else None


def _cells(coordinate: float, side: float) -> float:
    """A coordinate in cells; 500 m are 2,500 cells of 0.2 m, whatever the division says."""
    cells = coordinate / side
    return round(cells) if math.isclose(cells, round(cells), rel_tol=1e-12, abs_tol=1e-9) else cells
