"""Commands for what is delivered: rasters of a survey, and the page by which it is accepted."""

from __future__ import annotations

import argparse
from dataclasses import fields

from .parser import Parser
from .tiled_runs import add_survey_options, sigterm_like_ctrl_c, tiling_options

_INPUTS = "Classified files, folders or patterns"
_LARGE = "Several inputs and large files are cut into tiles"


def add_commands(parser: Parser) -> None:
    """Add ``surfaces`` and ``report``."""
    what = "Write terrain, surface and canopy as rasters (GeoTIFF)"
    add = parser.command("surfaces", _surfaces, what, progress=True)
    add("inputs", nargs="+", metavar="input", help=_INPUTS)
    add("folder", help="Folder for terrain.tif, surface.tif and canopy.tif")
    size = "Side of a cell in the cloud's unit (1)"
    add("--resolution", type=float, default=1.0, metavar="SIZE", help=size)
    fill = "Interpolate cells without points between others over this distance (10)"
    add("--fill", type=float, default=10.0, metavar="METERS", help=fill)
    radius = "Largest circle of a triangle of the terrain (100)"
    add("--max-radius", type=float, default=100.0, metavar="METERS", help=radius)
    add_survey_options(parser.commands["surfaces"], _LARGE)

    what = "Write the page by which a survey is accepted: density, voids, strips, control points"
    add = parser.command("report", _report, what, progress=True)
    add("inputs", nargs="+", metavar="input", help=_INPUTS)
    add("page", help="HTML page to write")
    add("--json", default="", metavar="FILE", help="Write the same figures to a JSON file")
    add("--density", type=float, default=0.0, metavar="N", help="Points per m2 that were ordered")
    void = "Area in m2 of a cell that should hold a point (4)"
    add("--void", type=float, default=4.0, metavar="M2", help=void)
    control = "CSV file of control points: x, y, z in the cloud's units, and a name"
    add("--control", default="", metavar="FILE", help=control)
    add_survey_options(parser.commands["report"], _LARGE)


def _surfaces(options: argparse.Namespace) -> None:
    """Write terrain, surface and canopy."""
    from ..surfaces.cells import SurfaceOptions
    from ..surfaces.make_surfaces import write_surfaces

    values = {field.name: getattr(options, field.name) for field in fields(SurfaceOptions)}
    tiling = tiling_options(options)
    with sigterm_like_ctrl_c():
        result = write_surfaces(
            options.inputs, options.folder, SurfaceOptions(**values), tiling, options.progress
        )
    cells = result["width"] * result["height"]
    for name, path in result["files"].items():
        share = 100 * result["known"][name] / cells
        print(f"{path}: {result['width']:,} x {result['height']:,} cells, {share:.1f} % known")


def _report(options: argparse.Namespace) -> None:
    """Write the report of a survey."""
    from ..surfaces.survey_report import lines, write_report

    values = {name: getattr(options, name) for name in ("density", "void", "control", "progress")}
    tiling = tiling_options(options)
    with sigterm_like_ctrl_c():
        result = write_report(options.inputs, options.page, options.json, tiling=tiling, **values)
    print("\n".join(lines(result)))
    print(f"written to {', '.join(name for name in (options.page, options.json) if name)}")
