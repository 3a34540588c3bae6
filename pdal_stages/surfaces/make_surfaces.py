"""Write terrain, surface and canopy of classified files, of any size."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

from numpy.typing import NDArray

from ..base.errors import StageError, optional_import
from ..base.files import Output, check_outputs, create_folder
from ..base.geotiff import rasterio, write_rasters
from ..base.grid import GridWindow
from ..base.json_types import JsonObject
from ..base.messages import print_messages
from ..pipeline.inputs_outputs import input_files
from ..tiling.options import TilingOptions
from ..tiling.tile_records import RecordRun, RecordSurvey, Tile, record_run
from .cells import CellDensity, SurfaceOptions, TileFigures, reduce_points
from .rasters import RASTERS, RasterFigures, TileCells, compute_tile

#: Share of cells with a height below which a message says so: 0.1 % are a line 100 m wide that
#: crosses 70 km.
_NEARLY_EMPTY = 1e-3


def write_surfaces(
    inputs: Sequence[str],
    folder: str,
    options: SurfaceOptions | None = None,
    tiling: TilingOptions | None = None,
    progress: bool | None = None,
) -> JsonObject:
    """Write ``terrain.tif``, ``surface.tif`` and ``canopy.tif`` of classified files.

    Parameters
    ----------
    inputs : sequence of str
        LAS, LAZ or COPC files, folders or patterns.
    folder : str
        Folder of the rasters, which is created where it is missing.
    options : SurfaceOptions, optional
    tiling : TilingOptions, optional
        As of ``classify``.
    progress : bool, optional
        Whether to show progress on stderr.

    Returns
    -------
    dict
        ``files``, ``width`` and ``height`` in cells, and ``known``: cells with a height by raster.

    Raises
    ------
    StageError
        Where no point is ground, references differ, or a file cannot be read or written.
    """
    rasterio()  # before any work
    optional_import("startinpy", "raster", "a terrain model")
    files = input_files(inputs)
    place = Path(folder)
    paths = {name: place / f"{name}.tif" for name in RASTERS}
    options = options or SurfaceOptions()
    measure = partial(CellDensity.with_cells, options)
    survey = RecordSurvey("surfaces", files, place, tiling, measure)
    create_folder(place, "the rasters")
    check_outputs([Output(str(path), "raster") for path in paths.values()], files)
    with record_run(survey, progress) as run:
        return _run(run, paths, options)


def _run(run: RecordRun, paths: dict[str, Path], options: SurfaceOptions) -> JsonObject:
    """Compute all tiles, and write the rasters."""
    survey = run.survey
    reduce = partial(reduce_points, options=options, unit=survey.unit)
    reduced = run.reduce("cells", asdict(options), reduce, TileFigures)
    if not any(job.figures.ground for job in reduced):
        raise StageError(
            "no point is ground (classes 2, 9, 11), so there is no terrain",
            found=", ".join(survey.paths[:3]),
            cure="Classify the files first: pdal-stages classify raw.laz classified.laz",
        )
    window = GridWindow.union(GridWindow(*job.figures.window) for job in reduced)
    size = options.resolution
    x0, y0, wide, tall = (number * size for number in window)
    cells = TileCells(options, survey.grid, survey.unit, window, {})
    centers = x0 + size / 2, y0 + size / 2, x0 + wide - size / 2, y0 + tall - size / 2

    def compute(tile: Tile, files: dict[Tile, str], target: str) -> Callable[[], RasterFigures]:
        return partial(compute_tile, replace(cells, files=files), tile, target)

    tiles = survey.grid.covering(centers)
    jobs = run.compute("rasters", reduced, tiles, cells.reach + size, compute, RasterFigures)

    def parts(name: str) -> Iterator[tuple[GridWindow, NDArray]]:
        for job in jobs:
            (arrays,) = run.arrays([job], name, "window")
            yield GridWindow(*arrays["window"].tolist()), arrays[name]

    counts = [job.figures.to_json() for job in jobs]
    known = {name: sum(count[name] for count in counts) for name in RASTERS}
    if (share := known["surface"] / (window.width * window.height)) < _NEARLY_EMPTY:
        held = [job for job in reduced if job.figures.window[2]]
        fullest = max(held, key=lambda job: job.points)
        far = max(held, key=lambda job: math.dist(job.tile, fullest.tile))
        file = survey.near(far.tile, 0.0)[0].path
        x, y = (number * size for number in far.figures.window[:2])
        print_messages(
            f"{100 * share:.2g} % of {window.width:,} x {window.height:,} cells have a height: "
            f"points far from the others, as near {x:.0f} {y:.0f} of {file}, make the rasters this "
            "wide; if these are errors, mark them as noise (7)"
        )
    wkt, units = survey.reference.wkt, survey.reference.units
    write_rasters(paths, parts, window, size, wkt, units, RASTERS)
    shown = {name: str(path) for name, path in paths.items()}
    return {"files": shown, "width": window.width, "height": window.height, "known": known}
