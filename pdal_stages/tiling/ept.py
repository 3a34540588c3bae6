"""Parts of an EPT source, fetched through PDAL into a LAS file on the source's own grid of coordinates."""

from __future__ import annotations

from typing import Any

from ..pipeline import pdal as pdal_env
from .cloudindex import index_las
from .grid import Grid
from .sources import las_header, read_ept


def fetch(source: dict[str, Any], grid: Grid, tile: tuple[int, int], margin: float, target: str):
    """Read a tile and its surroundings into a LAS file; its path and index (None where it is empty).

    Scales and offsets are the source's, so coordinates stay what they are; other
    dimensions become extra dimensions.
    """
    described = read_ept(source["path"])
    x0, y0, x1, y1 = grid.box(tile, margin)
    writer: dict[str, Any] = {
        "type": "writers.las",
        "filename": target,
        "minor_version": 4,
        "dataformat_id": 7 if any(d["name"] == "Red" for d in described["schema"]) else 6,
        "extra_dims": "all",
    }
    for dimension in described["schema"]:
        if dimension["name"] in ("X", "Y", "Z"):
            axis = dimension["name"].lower()
            writer[f"scale_{axis}"] = dimension.get("scale", 0.001)
            writer[f"offset_{axis}"] = dimension.get("offset", 0.0)
    reader = {
        **source["reader"],
        "type": "readers.ept",
        "filename": source["path"],
        "bounds": f"([{x0!r}, {x1!r}], [{y0!r}, {y1!r}])",
    }
    run = pdal_env.execute([reader, writer], arrays=False)
    if not run.count or not las_header(target).count:
        return target, None
    return target, index_las(target, grid.size)
