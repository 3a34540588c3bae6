"""Rasters of tiles as Cloud Optimized GeoTIFF files, through rasterio."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.errors import StageError, optional_import
from ..base.files import whole_files
from ..base.grid import GridWindow
from ..base.version import __version__
from ..pipeline.spatial_reference import Reference

#: The value of cells without one.
NODATA = -9999.0
#: Side of a block of a file, in cells.
_BLOCK = 512
#: Megabytes of blocks that GDAL holds.
_CACHE = 256
#: How rasters name units of height, by meters.
_UNIT_NAMES = {1.0: "metre", 0.3048: "foot", 1200.0 / 3937.0: "US survey foot"}


def raster(name: str = "rasterio") -> Any:
    """Import rasterio or a module of it, or raise DependencyError with the way to install it."""
    return optional_import(name, "raster", "write rasters")


def write_rasters(
    paths: Mapping[str, Path],
    parts: Any,
    window: GridWindow,
    resolution: float,
    reference: Reference,
    texts: Mapping[str, str],
) -> None:
    """Write rasters, all of them or none.

    Parameters
    ----------
    paths : mapping
        Files by the name of the raster.
    parts : callable
        Returns for a name its parts: windows, and (rows, columns) float32 from the south, with NaN.
    window : GridWindow
        The cells of the files.
    resolution : float
        Side of a cell, in the unit of the coordinates.
    reference : Reference
    texts : mapping
        What each raster holds.
    """
    rasterio, shutil = raster(), raster("rasterio.shutil")
    profile = {
        "driver": "GTiff",
        "dtype": "float32",
        "count": 1,
        "width": window.width,
        "height": window.height,
        "nodata": NODATA,
        "crs": rasterio.crs.CRS.from_wkt(reference.wkt) if reference.wkt else None,
        "transform": rasterio.transform.from_origin(
            window.left * resolution,
            (window.bottom + window.height) * resolution,
            resolution,
            resolution,
        ),
        "tiled": True,
        "blockxsize": _BLOCK,
        "blockysize": _BLOCK,
        "sparse_ok": True,
        "bigtiff": "IF_SAFER",
    }
    how = {
        "driver": "COG",
        "compress": "DEFLATE",
        "predictor": "YES",
        "blocksize": _BLOCK,
        "overview_resampling": "AVERAGE",
        "bigtiff": "IF_SAFER",
    }
    with (
        whole_files(*paths.values(), what="raster") as partials,
        rasterio.Env(GDAL_CACHEMAX=_CACHE),
    ):
        for name, partial in zip(paths, partials, strict=True):
            plain = partial.with_suffix(".plain.tif")
            try:
                with rasterio.open(plain, "w", **profile) as out:
                    out.units = (_unit_name(reference.units.vertical),)
                    out.descriptions = (texts[name],)
                    out.update_tags(TIFFTAG_SOFTWARE=f"pdal_stages {__version__}")
                    for place, values in _clipped(parts(name), window):
                        out.write(np.where(np.isnan(values), NODATA, values), 1, window=place)
                shutil.copy(plain, partial, **how)
            except rasterio.errors.RasterioError as error:
                what = "the raster could not be written"
                raise StageError(what, found=f"{paths[name]}: {error}") from error
            plain.unlink()


def _clipped(
    parts: Iterator[tuple[GridWindow, NDArray]], window: GridWindow
) -> Iterator[tuple[Any, NDArray]]:
    """Yield the parts of a raster in a window, from the north, with their place in the file."""
    make_window = raster("rasterio.windows").Window
    for part, values in parts:
        both = part.intersect(window)
        if both.width and both.height:
            top = window.bottom + window.height - both.bottom - both.height
            place = make_window(both.left - window.left, top, both.width, both.height)
            yield place, values[both.slices_in(part)][::-1]


def _unit_name(meters: float) -> str:
    """Return the name of a unit of height."""
    near = (name for value, name in _UNIT_NAMES.items() if abs(value - meters) < 1e-9)
    return next(near, f"{meters:g} m")
