"""Rasters as GeoTIFF files, through rasterio (extra ``raster``)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from .errors import StageError, optional_import
from .files import whole_files, write_whole
from .grid import GridWindow
from .json_types import JsonObject
from .units import Units
from .vector import with_vector
from .version import __version__

#: The value of cells without one in large rasters.
NODATA = -9999.0
#: Megabytes of blocks that GDAL holds.
_CACHE = 256
#: How rasters name units of height, by meters.
_UNIT_NAMES = {1.0: "metre", 0.3048: "foot", 1200.0 / 3937.0: "US survey foot"}
#: Blocks of 512 cells; those without values take no room. Larger files than 4 GB get another form.
_PLAIN = {
    "nodata": NODATA, "tiled": True, "blockxsize": 512, "blockysize": 512, "sparse_ok": True,
    "bigtiff": "IF_SAFER",
}  # fmt: skip
_CLOUD_OPTIMIZED = {
    "driver": "COG", "sparse_ok": True, "compress": "DEFLATE", "predictor": "YES", "blocksize": 512,
    "overview_resampling": "AVERAGE", "bigtiff": "IF_SAFER",
}  # fmt: skip


def rasterio() -> ModuleType:
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
    with _errors_named(), rasterio().MemoryFile() as memory:
        profile = _profile(values.shape, corner, cell, wkt)
        with memory.open(**profile, nodata=np.nan, compress="deflate", predictor=3) as file:
            file.write(values[::-1], 1)
        return bytes(memory.read())


def _profile(
    shape: tuple[int, ...], corner: tuple[float, float], cell: float, wkt: str
) -> JsonObject:
    """Return what rasterio needs to open a GeoTIFF file, as in :func:`write_geotiff`."""
    library, (height, width) = rasterio(), shape
    north = corner[1] + height * cell
    return {
        "driver": "GTiff", "dtype": "float32", "count": 1, "height": height, "width": width,
        "crs": library.crs.CRS.from_wkt(wkt) if wkt else None,
        "transform": library.transform.from_origin(corner[0], north, cell, cell),
    }  # fmt: skip


@contextmanager
def _errors_named(path: str | Path = "") -> Iterator[None]:
    """Turn rasterio's errors into StageError that names the file."""
    try:
        yield
    except rasterio().errors.RasterioError as error:
        seen = f"{path}: {error}" if path else str(error)
        raise StageError("the raster could not be written", found=seen) from error


def write_rasters(
    paths: Mapping[str, Path],
    parts: Callable[[str], Iterable[tuple[GridWindow, NDArray]]],
    window: GridWindow,
    resolution: float,
    wkt: str,
    units: Units,
    texts: Mapping[str, str],
) -> None:
    """Write large rasters as Cloud Optimized GeoTIFF files, all of them or none.

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
    wkt : str
        The spatial reference; empty where there is none.
    units : Units
    texts : mapping
        What each raster holds.
    """
    library, copier = rasterio(), optional_import("rasterio.shutil", "raster", "writing rasters")
    corner = window.left * resolution, window.bottom * resolution
    profile = _PLAIN | _profile(window.shape, corner, resolution, wkt)
    unit = units.vertical
    names = (name for meters, name in _UNIT_NAMES.items() if abs(meters - unit) < 1e-9)
    unit_name = next(names, f"{unit:g} m")
    whole = whole_files(*paths.values(), what="raster")
    with whole as partials, library.Env(GDAL_CACHEMAX=_CACHE):
        for name, partial in zip(paths, partials, strict=True):
            plain = partial.with_suffix(".plain.tif")
            with _errors_named(paths[name]):
                with library.open(plain, "w", **profile) as out:
                    out.units, out.descriptions = (unit_name,), (texts[name],)
                    out.update_tags(TIFFTAG_SOFTWARE=f"pdal_stages {__version__}")
                    for part, values in parts(name):
                        both = part.intersect(window)
                        if both.width and both.height:
                            left, below = both.left - window.left, both.bottom - window.bottom
                            top = window.height - below - both.height
                            place = library.windows.Window(left, top, both.width, both.height)
                            cells = values[both.slices_in(part)][::-1]
                            out.write(np.where(np.isnan(cells), NODATA, cells), 1, window=place)
                copier.copy(plain, partial, **_CLOUD_OPTIMIZED)
            plain.unlink()
