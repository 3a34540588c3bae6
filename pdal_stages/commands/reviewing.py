"""Where a person should look, and what he corrected."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..base.plain import print_messages
from .adder import Adder


def add_commands(add: Adder) -> None:
    """``review`` and ``corrections``."""
    takes = add("review", _review, "List where a person should look in classified files, worst first")
    takes("inputs", nargs="+", metavar="input", help="Classified files PDAL can read, folders, patterns")
    takes("output", help="Vector file to write: .gpkg, .geojson, .fgb or .shp")
    takes("--html", metavar="FILE", help="A page; default: beside the vector file, under its name")
    takes("--json", metavar="FILE", help="Write figures to a JSON file")
    takes(
        "--share",
        type=float,
        default=0.95,
        metavar="SHARE",
        help="Write patches until they hold this share of the errors that are expected (0.95)",
    )
    takes(
        "--cell",
        type=float,
        default=0.0,
        metavar="METERS",
        help="Side of the cells that are judged; default: by the density, 1 m at least",
    )
    takes("--workers", type=int, default=1, metavar="N", help="Files read at the same time (1)")
    takes(
        "--model",
        default="standard",
        help="What tells how reliable classes are where the files have no Reliability; default standard",
    )

    takes = add(
        "corrections",
        _corrections,
        "Mark what a person has corrected, or looked at and found right, for train",
    )
    takes("before", help="The file as it was classified (LAS or LAZ)")
    takes("after", nargs="?", help="The same points, in any order, as the person left them")
    takes(
        "--out",
        required=True,
        metavar="FILE",
        help="The points of the first with the classes of the second, and Checked",
    )
    takes(
        "--area",
        action="append",
        default=[],
        metavar="FILE",
        help="Polygons inside of which all was looked at: what was not changed there is right. Of the patches of review, "
        "those whose 'done' is 1; may be repeated",
    )
    takes(
        "--around",
        type=float,
        default=1.0,
        metavar="METERS",
        help="So far around a changed point all was looked at (1)",
    )


def _review(options: argparse.Namespace) -> None:
    from ..pipeline.inputs_outputs import overlooked
    from ..pipeline.reviewing import ReviewRequest, write_review
    from ..reports.reviewpage import lines

    html = str(Path(options.output).with_suffix(".html")) if options.html is None else options.html
    request = ReviewRequest(
        tuple(options.inputs),
        options.output,
        html,
        options.json or "",
        options.share,
        options.cell,
        options.model,
        options.workers,
    )
    print_messages(*overlooked(options.inputs))
    print("\n".join(lines(write_review(request).to_dict())))
    print(f"written to {', '.join(name for name in (request.output, request.html, request.json) if name)}")


def _corrections(options: argparse.Namespace) -> None:
    from ..pipeline.correcting import CorrectionRequest, write_corrections

    areas = tuple(options.area)
    request = CorrectionRequest(options.before, options.out, options.after or "", areas, options.around)
    print("\n".join(write_corrections(request).lines()))
    print(f"written to {request.output}; next: pdal-stages train --base MODEL {request.output} --model NEW")
