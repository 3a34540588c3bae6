"""Parts of an EPT source, fetched through PDAL into a LAS file on the source's own grid of coordinates."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..pipeline import pdal as pdal_env
from .grid import Box
from .sources import InputSource, las_extent, read_ept


def format_of(described: Mapping[str, Any]) -> int:
    """The LAS point format that has the colors of an EPT source."""
    names = {dimension["name"] for dimension in described["schema"]}
    return 8 if "Infrared" in names else 7 if "Red" in names else 6


def fetch(source: InputSource, box: Box, target: str) -> bool:
    """Read the points in a box into a LAS file; whether there are any.

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
    run = pdal_env.execute([source.within(box), writer], arrays=False)
    return bool(run.count and las_extent(target).count)
