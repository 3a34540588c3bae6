"""A map of objects: buildings, crowns and tops, spans and decks; what is to be checked in another color."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from ..objects.measure import CHECK
from ..objects.outlines import vector
from .objectlayers import Layer

_Color = tuple[int, int, int]
#: Fill and edge of each layer, in the order they are drawn.
_INKS: dict[str, tuple[_Color, _Color]] = {
    "decks": ((150, 196, 204), (60, 120, 130)),
    "crowns": ((186, 219, 160), (84, 148, 72)),
    "buildings": ((226, 138, 120), (140, 40, 30)),
    "spans": ((150, 110, 0), (150, 110, 0)),
    "trees": ((24, 92, 40), (24, 92, 40)),
}
_CHECK: tuple[_Color, _Color] = ((250, 205, 90), (170, 110, 0))


#: Pixels across the map.
_WIDTH = 900


def object_map(layers: Mapping[str, Layer]) -> npt.NDArray[np.uint8]:
    """A map of layers, by :func:`~pdal_stages.reports.objectlayers.object_layers`; north is up.

    Parameters
    ----------
    layers : mapping of str to Layer

    Returns
    -------
    (height, width, 3) uint8
    """
    shapely = vector("shapely")
    shapes = [shape for layer in layers.values() for shape in layer.shapes]
    if not shapes:
        return np.full((_WIDTH, _WIDTH, 3), 255, np.uint8)
    bounds = shapely.bounds(shapes)
    low, high = bounds[:, :2].min(axis=0), bounds[:, 2:].max(axis=0)
    extent = np.maximum(high - low, 1e-9)
    fine = 2 * _WIDTH / extent[0]  # drawn twice as large: no jagged edges
    size = 2 * _WIDTH, max(2, 2 * min(round(fine * extent[1] / 2), 4 * _WIDTH))
    image = Image.new("RGB", size, (255, 255, 255))
    draw = ImageDraw.Draw(image)

    def placed(ring: Any) -> list[tuple[float, float]]:
        xy = shapely.get_coordinates(ring)
        return [(x, y) for x, y in np.column_stack([xy[:, 0] - low[0], high[1] - xy[:, 1]]) * fine]

    for name, inks in _INKS.items():
        layer = layers.get(name)
        if layer is None:
            continue
        for shape, verdict in zip(layer.shapes, layer.columns["verdict"], strict=True):
            fill, edge = _CHECK if verdict == CHECK else inks
            if layer.kind == "Point":
                (x, y) = placed(shape)[0]
                draw.ellipse((x - 3, y - 3, x + 3, y + 3), fill=fill)
            elif layer.kind == "LineString Z":
                draw.line(placed(shape), fill=edge, width=3)
            else:
                for part in shapely.get_parts(shape):
                    draw.polygon(placed(part.exterior), fill=fill)
                    for hole in part.interiors:
                        draw.polygon(placed(hole), fill=(255, 255, 255))
                    for ring in (part.exterior, *part.interiors):
                        draw.line(placed(ring), fill=edge, width=3)
    return np.asarray(image.resize((size[0] // 2, size[1] // 2), Image.Resampling.LANCZOS))
