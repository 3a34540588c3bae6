"""Commands after classification: objects, review and corrections."""

from __future__ import annotations

import argparse
import re

from . import Parser, takes_options

#: Options of ``writers.objects`` that ``objects`` has flags for.
_OF_OBJECTS = ("outlines", "cell")


def add_commands(parser: Parser) -> None:
    """``objects``, ``review`` and ``corrections``."""
    what = "Write buildings, trees, wires and bridge decks to a vector file"
    takes = parser.command("objects", _objects, what, overrides=True, logged=True)
    takes("inputs", nargs="+", metavar="input", help="Classified files, folders or patterns")
    takes("output", help="Vector file to write: .gpkg, .geojson, .fgb or .shp")
    takes_options(takes, "writers.objects", *_OF_OBJECTS)
    takes(
        "--workers",
        type=int,
        default=1,
        metavar="N",
        help="Files to read at the same time (default: 1)",
    )
    takes("--metadata", metavar="FILE", help="Write counts, verdicts and settings to a JSON file")

    what = "List the places that a person should check, worst first"
    takes = parser.command("review", _review, what, logged=True)
    takes("inputs", nargs="+", metavar="input", help="Classified files, folders or patterns")
    takes("output", help="Vector file to write: .gpkg, .geojson, .fgb or .shp")
    takes("--html", metavar="FILE", help="Web page to write (default: beside the vector file)")
    takes("--json", metavar="FILE", help="Write figures to a JSON file")
    takes(
        "--share",
        type=float,
        default=0.95,
        metavar="SHARE",
        help="Share of expected errors to cover (0.95)",
    )
    takes(
        "--cell",
        type=float,
        default=0.0,
        metavar="METERS",
        help="Side of the cells (default: by density)",
    )
    takes(
        "--workers",
        type=int,
        default=1,
        metavar="N",
        help="Files to read at the same time (default: 1)",
    )
    takes(
        "--model",
        default="standard",
        help="Model for files without Reliability (default: standard)",
    )

    what = "Mark points that a person corrected or confirmed, to train on"
    takes = parser.command("corrections", _corrections, what)
    takes("before", help="LAS or LAZ file as classified")
    takes("after", nargs="?", help="The same points after a person's corrections, in any order")
    takes("--out", required=True, metavar="FILE", help="File to write: new classes, and Checked")
    area = "Polygons in which all points were checked; of review's file, those with 'done' 1"
    takes("--area", action="append", default=[], metavar="FILE", help=area)
    takes(
        "--around",
        type=float,
        default=1.0,
        metavar="METERS",
        help="Radius checked around changes (1)",
    )


def _objects(options: argparse.Namespace) -> None:
    from ..tiling.objects_from_files import objects_of_files, writer

    given = {name: value for name in _OF_OBJECTS if (value := getattr(options, name)) is not None}
    stage = writer(options.output, options.overrides, **given)
    objects_of_files(options.inputs, stage, options.workers, options.metadata)


def _review(options: argparse.Namespace) -> None:
    from ..review.review_output import lines, write_review

    html = re.sub(r"\.\w+$", ".html", options.output) if options.html is None else options.html
    how = {name: getattr(options, name) for name in ("share", "cell", "model", "workers")}
    found = write_review(options.inputs, options.output, html, options.json or "", **how)
    print("\n".join(lines(found.to_dict())))
    print(f"written to {', '.join(name for name in (options.output, html, options.json) if name)}")


def _corrections(options: argparse.Namespace) -> None:
    from ..review.corrections import write_corrections

    told = write_corrections(
        options.before, options.out, options.after or "", options.area, options.around
    )
    print("\n".join(told))
    print(
        f"written to {options.out}; next: pdal-stages train --base MODEL {options.out} --model NEW"
    )
