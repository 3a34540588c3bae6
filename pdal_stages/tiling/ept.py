"""Parts of an EPT source, fetched through PDAL into a LAS file on the source's own grid of coordinates."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..pipeline import pdal as pdal_env
from .cloudindex import CloudIndex, index_las
from .grid import TileGrid
from .sources import InputSource, las_extent, read_ept


def format_of(described: Mapping[str, Any]) -> int:
    """The LAS point format that has the colors of an EPT source."""
    names = {dimension["name"] for dimension in described["schema"]}
    return 8 if "Infrared" in names else 7 if "Red" in names else 6


def fetch(
    source: InputSource, grid: TileGrid, tile: tuple[int, int], halo_units: float, target: str
) -> CloudIndex | None:
    """Read a tile and its halo into a LAS file; its index, None where it is empty.

    Scales and offsets are the source's, so coordinates stay what they are; other
    dimensions become extra dimensions.
    """
    described = read_ept(source.path)
    writer: dict[str, Any] = {
        "type": "writers.las",
        "filename": target,
        "minor_version": 4,
        "dataformat_id": format_of(described),
        "extra_dims": "all",
    }
    for dimension in described["schema"]:
        if dimension["name"] in ("X", "Y", "Z"):
            axis = dimension["name"].lower()
            writer[f"scale_{axis}"] = dimension.get("scale", 0.001)
            writer[f"offset_{axis}"] = dimension.get("offset", 0.0)
    run = pdal_env.execute([source.within(grid.box(tile, halo_units)), writer], arrays=False)
    return index_las(target, grid) if run.count and las_extent(target).count else None
