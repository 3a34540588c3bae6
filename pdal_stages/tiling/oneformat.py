"""What outputs of tiles are written like, where inputs differ: PDAL forwards only what all of a tile's inputs share, and has
scales of a centimeter and point format 3 for the rest, which would cut millimeters off and drop fields."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from ..base import las

_COLORS, _INFRARED, _WAVES = {2, 3, 5, 7, 8, 10}, {8, 10}, {4, 5, 9, 10}
#: Of coordinates that a file holds as whole numbers of 32 bits.
_MOST_STEPS = 2**31 - 1
#: Offsets are rounded to these, in the unit of the coordinates.
_ROUND = 1000
#: Heights stay below this, in the unit of the coordinates.
_HIGHEST = 20_000


def one_format(paths: Iterable[str]) -> dict[str, Any]:
    """Options of ``writers.las`` that hold what each of some LAS files holds; none where these are alike, or are not LAS.

    The finest scale along each axis, and of the formats from LAS 1.4 the first that has all colors there are.
    """
    headers = []
    for path in paths:
        try:
            header = las.read_header(path) if Path(path).suffix.lower() in (".las", ".laz") else None
        except OSError:
            header = None  # said when it is read
        if header is not None:
            headers.append(header)
    formats = {header.point_format for header in headers}
    options: dict[str, Any] = {}
    if len(formats) > 1 and not formats & _WAVES:
        colored = 8 if formats & _INFRARED else 7 if formats & _COLORS else 6
        options = {"minor_version": 4, "dataformat_id": colored}
    boxes = [header.box for header in headers if header.count]
    for axis, name in enumerate("xyz"):
        scales = {header.scales[axis] for header in headers}
        offsets = {header.offsets[axis] for header in headers}
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
