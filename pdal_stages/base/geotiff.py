"""Rasters as GeoTIFF files, through rasterio (extra ``raster``)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import StageError, optional_import
from .files import write_whole
from .vector import with_vector


def rasterio() -> Any:
    """Import rasterio, or raise DependencyError with the way to install it."""
    return optional_import("rasterio", "raster", "writing rasters")


def write_geotiff(
    path: Path, values: NDArray[np.float32], corner: tuple[float, float], cell: float, wkt: str
) -> None:
    """Write a raster as a GeoTIFF file, whole or not at all; its folder is made.

    Parameters
    ----------
    path : path
    values : (h, w) float32
        The southernmost row first; NaN where nothing is.
    corner : tuple of float
        x and y of the south-western corner.
    cell : float
        Side of a cell, in the unit of the corner.
    wkt : str
        The spatial reference; empty where there is none.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, with_vector(_encode, values, corner, cell, wkt), "raster")


def _encode(
    values: NDArray[np.float32], corner: tuple[float, float], cell: float, wkt: str
) -> bytes:
    """Return the bytes of a GeoTIFF file, as in :func:`write_geotiff`."""
    library, (height, width) = rasterio(), values.shape
    try:
        profile = {
            "driver": "GTiff", "dtype": "float32", "count": 1, "nodata": np.nan,
            "height": height, "width": width, "compress": "deflate", "predictor": 3,
            "crs": library.crs.CRS.from_wkt(wkt) if wkt else None,
            "transform": library.transform.from_origin(
                corner[0], corner[1] + height * cell, cell, cell
            ),
        }  # fmt: skip
        with library.MemoryFile() as memory:
            with memory.open(**profile) as file:
                file.write(values[::-1], 1)
            return bytes(memory.read())
    except library.errors.RasterioError as error:
        raise StageError("a raster cannot be made into a GeoTIFF file", found=str(error)) from error
