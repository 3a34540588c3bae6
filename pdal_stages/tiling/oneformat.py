"""What outputs of tiles are written like, where inputs differ: PDAL forwards only what all of a tile's inputs share, and has
scales of a centimeter and point format 3 for the rest, which would cut millimeters off and drop fields."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from ..base import las
from ..base.errors import StageError
from ..pipeline.inputs_outputs import is_ept, is_las
from .ept import format_of
from .grid import Box
from .sources import read_ept

_COLORS, _INFRARED = {2, 3, 7, 8}, {8}
#: Of coordinates that a file holds as whole numbers of 32 bits.
_MOST_STEPS = 2**31 - 1
#: Offsets are rounded to these, in the unit of the coordinates.
_ROUND = 1000
#: Heights stay below this, in the unit of the coordinates.
_HIGHEST = 20_000


class _Like(NamedTuple):
    """How an input holds its points."""

    point_format: int
    scales: tuple[float, ...]
    offsets: tuple[float, ...]
    box: Box | None  #: None without points
    ept: bool = False


def one_format(paths: Iterable[str]) -> dict[str, Any]:
    """Options of ``writers.las`` that hold what each of some inputs holds; none where these are alike LAS files, or neither
    LAS files nor EPT sources.

    The finest scale along each axis, and of the formats from LAS 1.4 the first that has all colors there are.
    """
    inputs = [found for path in paths if (found := _like(path)) is not None]
    formats = {one.point_format for one in inputs}
    options: dict[str, Any] = {}
    if len(formats) > 1 or any(one.ept for one in inputs):
        colored = 8 if formats & _INFRARED else 7 if formats & _COLORS else 6
        options = {"minor_version": 4, "dataformat_id": colored}
    boxes = [one.box for one in inputs if one.box is not None]
    for axis, name in enumerate("xyz"):
        scales = {one.scales[axis] for one in inputs}
        offsets = {one.offsets[axis] for one in inputs}
        if len(scales) <= 1 and len(offsets) <= 1:
            continue
        scale = min(scales)
        ends = (-float(_HIGHEST), float(_HIGHEST))
        if axis < 2:
            ends = min(box[axis] for box in boxes), max(box[axis + 2] for box in boxes)
        middle = round((ends[0] + ends[1]) / 2 / _ROUND) * _ROUND
        fits = max(ends[1] - middle, middle - ends[0]) < _MOST_STEPS * scale
        options |= {f"scale_{name}": scale, f"offset_{name}": middle if fits else "auto"}
    return options


def _like(path: str) -> _Like | None:
    """How an input holds its points; None for what cannot be read, which is said when it is."""
    try:
        if is_ept(path):
            described = read_ept(path)
            axes = {one["name"]: one for one in described["schema"] if one["name"] in ("X", "Y", "Z")}
            scales = tuple(float(axes.get(name, {}).get("scale", 0.001)) for name in "XYZ")
            offsets = tuple(float(axes.get(name, {}).get("offset", 0.0)) for name in "XYZ")
            x0, y0, _, x1, y1, _ = map(float, described["boundsConforming"])
            return _Like(format_of(described), scales, offsets, (x0, y0, x1, y1), True)
        header = las.read_header(path) if is_las(path) else None
    except (OSError, StageError, ValueError, TypeError):
        return None
    if header is None or header.point_format in las.WAVES:
        return None
    return _Like(header.point_format, header.scales, header.offsets, header.box if header.count else None)


def following(tail: Sequence[dict[str, Any]], paths: Iterable[str]) -> list[dict[str, Any]]:
    """A pipeline's tail whose outputs have points of several inputs: its writers of LAS hold what each of them holds, as far
    as they are to forward it and no option says otherwise."""
    wanted: dict[str, Any] | None = None
    told = []
    for stage in tail:
        words = stage.get("forward", "")
        forward = {str(one).strip() for one in (words if isinstance(words, list) else str(words).split(","))}
        taken = {kind for kind, covering in _FORWARDED.items() if forward & covering}
        if stage["type"] == "writers.las" and taken:
            wanted = one_format(paths) if wanted is None else wanted
            stage = {**{k: v for k, v in wanted.items() if k.partition("_")[0] in taken}, **stage}
        told.append(stage)
    return told


#: What options of ``writers.las`` begin with, and what of ``forward`` covers them.
_FORWARDED = {
    "minor": {"all", "header", "minor_version"},
    "dataformat": {"all", "header", "dataformat_id"},
    "scale": {"all", "scale"},
    "offset": {"all", "offset"},
}
