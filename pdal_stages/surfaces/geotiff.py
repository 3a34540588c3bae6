"""Rasters of tiles as Cloud Optimized GeoTIFF files, through rasterio."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..base.errors import StageError, optional_import
from ..base.files import whole_files
from ..base.geotiff import rasterio
from ..base.grid import GridWindow
from ..base.version import __version__
from ..pipeline.spatial_reference import Reference

#: The value of cells without one.
NODATA = -9999.0
#: Megabytes of blocks that GDAL holds.
_CACHE = 256
#: How rasters name units of height, by meters.
_UNIT_NAMES = {1.0: "metre", 0.3048: "foot", 1200.0 / 3937.0: "US survey foot"}
#: Blocks of 512 cells; those without values take no room. Larger files than 4 GB get another form.
_PLAIN = {
    "driver": "GTiff", "dtype": "float32", "count": 1, "nodata": NODATA, "bigtiff": "IF_SAFER",
    "tiled": True, "blockxsize": 512, "blockysize": 512, "sparse_ok": True,
}  # fmt: skip
_CLOUD_OPTIMIZED = {
    "driver": "COG", "sparse_ok": True, "compress": "DEFLATE", "predictor": "YES", "blocksize": 512,
    "overview_resampling": "AVERAGE", "bigtiff": "IF_SAFER",
}  # fmt: skip


def write_rasters(
    paths: Mapping[str, Path],
    parts: Callable[[str], Iterable[tuple[GridWindow, NDArray]]],
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
    library, copier = rasterio(), optional_import("rasterio.shutil", "raster", "writing rasters")
    north = window.bottom + window.height
    corner = window.left * resolution, north * resolution
    profile = {
        **_PLAIN, "width": window.width, "height": window.height,
        "crs": library.crs.CRS.from_wkt(reference.wkt) if reference.wkt else None,
        "transform": library.transform.from_origin(*corner, resolution, resolution),
    }  # fmt: skip
    unit = reference.units.vertical
    names = (name for meters, name in _UNIT_NAMES.items() if abs(meters - unit) < 1e-9)
    unit_name = next(names, f"{unit:g} m")
    whole = whole_files(*paths.values(), what="raster")
    with whole as partials, library.Env(GDAL_CACHEMAX=_CACHE):
        for name, partial in zip(paths, partials, strict=True):
            plain = partial.with_suffix(".plain.tif")
            try:
                with library.open(plain, "w", **profile) as out:
                    out.units, out.descriptions = (unit_name,), (texts[name],)
                    out.update_tags(TIFFTAG_SOFTWARE=f"pdal_stages {__version__}")
                    for part, values in parts(name):
                        both = part.intersect(window)
                        if both.width and both.height:
                            left, top = both.left - window.left, north - both.bottom - both.height
                            place = library.windows.Window(left, top, both.width, both.height)
                            cells = values[both.slices_in(part)][::-1]
                            out.write(np.where(np.isnan(cells), NODATA, cells), 1, window=place)
                copier.copy(plain, partial, **_CLOUD_OPTIMIZED)
            except library.errors.RasterioError as error:
                what = "the raster could not be written"
                raise StageError(what, found=f"{paths[name]}: {error}") from error
            plain.unlink()
