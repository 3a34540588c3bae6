"""What PDAL's writers are told in tiles: a format that holds what all inputs hold, one grid of rasters, extra dimensions."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from ..base import las
from ..base.errors import StageError
from ..pipeline.filenames import LAS_WRITERS
from ..pipeline.inputs_outputs import is_ept, is_las
from ..pipeline.las_output import extra_dims_option
from .grid import Box
from .plan import MOVING
from .sources import ept_format, read_ept

_COLORS, _INFRARED = {2, 3, 7, 8}, {8}
#: Offsets are rounded to these, heights stay below this, in the unit of the coordinates.
_ROUND, _HIGHEST = 1000, 20_000.0
#: What options of ``writers.las`` begin with, and what of ``forward`` covers them.
_FORWARDED = {
    "minor": {"all", "header", "minor_version"},
    "dataformat": {"all", "header", "dataformat_id"},
    "scale": {"all", "scale"},
    "offset": {"all", "offset"},
}
#: Options that say already where a raster lies.
_PLACED = ("bounds", "origin_x", "origin_y", "width", "height")


class _Like(NamedTuple):
    """How an input holds its points."""

    point_format: int
    scales: tuple[float, ...]
    offsets: tuple[float, ...]
    box: Box


def _like(path: str) -> _Like | None:
    """How an input holds its points; None for what cannot be read, which is said when it is, and for no points."""
    try:
        if is_ept(path):
            described = read_ept(path)
            axes = {one["name"]: one for one in described["schema"]}
            scales, offsets = (
                tuple(float(axes.get(axis, {}).get(name, usual)) for axis in "XYZ")
                for name, usual in (("scale", 0.001), ("offset", 0.0))
            )
            x0, y0, _, x1, y1, _ = map(float, described["boundsConforming"])
            return _Like(ept_format(described), scales, offsets, (x0, y0, x1, y1))
        header = las.read_header(path) if is_las(path) else None
    except (OSError, StageError, ValueError, TypeError):
        return None
    if header is None or header.point_format in las.WAVES or not header.count:
        return None
    return _Like(header.point_format, header.scales, header.offsets, header.box)


def one_format(paths: Sequence[str]) -> dict[str, Any]:
    """Options of ``writers.las`` that hold what each of some inputs holds; none where these are alike LAS files.

    The finest scale along each axis, and of the formats from LAS 1.4 the first that has all colors there are: PDAL forwards
    only what all inputs of a tile share, and has scales of a centimeter and point format 3 for the rest.
    """
    inputs = [found for path in paths if (found := _like(path)) is not None]
    formats = {one.point_format for one in inputs}
    options: dict[str, Any] = {}
    if len(formats) > 1 or any(map(is_ept, paths)):
        colored = 8 if formats & _INFRARED else 7 if formats & _COLORS else 6
        options = {"minor_version": 4, "dataformat_id": colored}
    for axis, name in enumerate("xyz"):
        if len({(one.scales[axis], one.offsets[axis]) for one in inputs}) <= 1:
            continue
        scale = min(one.scales[axis] for one in inputs)
        low, high = -_HIGHEST, _HIGHEST
        if axis < 2:
            low, high = min(one.box[axis] for one in inputs), max(one.box[axis + 2] for one in inputs)
        middle = round((low + high) / 2 / _ROUND) * _ROUND
        fits = max(high - middle, middle - low) < (2**31 - 1) * scale
        options |= {f"scale_{name}": scale, f"offset_{name}": middle if fits else "auto"}
    return options


def with_one_format(tail: Sequence[dict[str, Any]], paths: Sequence[str]) -> list[dict[str, Any]]:
    """A tail whose writers of LAS hold what each input holds, as far as they are to forward it and not told otherwise."""
    told = []
    for stage in tail:
        words = stage.get("forward", "")
        forward = {str(one).strip() for one in (words if isinstance(words, list) else str(words).split(","))}
        taken = {kind for kind, covering in _FORWARDED.items() if forward & covering}
        if stage["type"] == "writers.las" and taken:
            wanted = one_format(paths)
            stage = {**{k: v for k, v in wanted.items() if k.partition("_")[0] in taken}, **stage}
        told.append(stage)
    return told


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
    for number, stage in enumerate(tail):
        side = _side(stage, tail[:number])
        if side is not None:
            left, bottom, right, top = (_cells(v, side) for v in box)
            if not half_open:
                right, top = math.floor(right) + 1, math.floor(top) + 1
            left, bottom = math.floor(left), math.floor(bottom)
            wide, high = max(1, math.ceil(right) - left), max(1, math.ceil(top) - bottom)
            place = {"origin_x": left * side, "origin_y": bottom * side, "width": wide, "height": high}
            stage = {**stage, **place}
        out.append(stage)
    return out


def remarks(tail: Sequence[dict[str, Any]], what: str) -> list[str]:
    """What the user should know of rasters made for each `what`, tile or file."""
    return [
        f"writers.gdal: each raster is made of the points of its {what} alone, so cells at its edge lack those beyond; for "
        "one raster without seams see docs/large-areas.md"
        for _ in [stage for stage in tail if stage["type"] == "writers.gdal"][:1]
    ]


def _side(stage: dict[str, Any], before: Iterable[dict[str, Any]]) -> float | None:
    """The side of the cells of a writer whose raster is to be placed."""
    placed = any(name in stage for name in _PLACED) or any(one["type"] in MOVING for one in before)
    if stage["type"] != "writers.gdal" or placed:
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
