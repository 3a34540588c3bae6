"""Maps of objects as pictures, north up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from ..objects.measure import CHECK
from ..objects.outlines import vector
from .objectlayers import Layer

#: Fill and edge of each layer, in the order they are drawn; of what is to be checked.
_INKS = {
    "decks": ("#96c4cc", "#3c7882"),
    "crowns": ("#badba0", "#549448"),
    "buildings": ("#e28a78", "#8c281e"),
    "spans": ("#966e00", "#966e00"),
    "trees": ("#185c28", "#185c28"),
}
_CHECK = ("#facd5a", "#aa6e00")
#: Pixels across the map.
_WIDTH = 900


def object_map(layers: Mapping[str, Layer]) -> npt.NDArray[np.uint8]:
    """A map (height, width, 3) of layers, by :func:`~pdal_stages.reports.objectlayers.object_layers`."""
    return draw_map(
        [
            (shape, *(_CHECK if verdict == CHECK else inks))
            for name, inks in _INKS.items()
            if name in layers
            for shape, verdict in zip(layers[name].shapes, layers[name].columns["verdict"], strict=True)
        ]
    )


def draw_map(drawn: Sequence[tuple[Any, str | None, str]]) -> npt.NDArray[np.uint8]:
    """A map (height, width, 3) of shapes (shapely), each with the colors of its fill, maybe none, and of its edge."""
    shapely = vector("shapely")
    if not drawn:
        return np.full((_WIDTH, _WIDTH, 3), 255, np.uint8)
    west, south, east, north = shapely.total_bounds([shape for shape, _, _ in drawn])
    fine = 2 * _WIDTH / max(east - west, 1e-9)  # drawn twice as large: no jagged edges
    size = 2 * _WIDTH, max(2, 2 * min(round(fine * (north - south) / 2), 4 * _WIDTH))
    image = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(image)

    def placed(ring: Any) -> list[tuple[float, float]]:
        return [tuple(at) for at in (shapely.get_coordinates(ring) - (west, north)) * (fine, -fine)]

    for shape, fill, edge in drawn:
        for part in shapely.get_parts(shape):
            if part.geom_type == "Point":
                x, y = placed(part)[0]
                draw.ellipse((x - 4, y - 4, x + 4, y + 4), fill=edge)
                continue
            rings = [part] if part.geom_type == "LineString" else [part.exterior, *part.interiors]
            if fill and part.geom_type == "Polygon":
                for number, ring in enumerate(rings):
                    draw.polygon(placed(ring), fill="white" if number else fill)
            for ring in rings:
                draw.line(placed(ring), fill=edge, width=3)
    return np.asarray(image.resize((size[0] // 2, size[1] // 2), Image.Resampling.LANCZOS))
