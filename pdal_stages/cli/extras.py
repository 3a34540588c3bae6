"""Commands that are extras: objects, review, reasons and corrections of files, and the demo."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict

from ..base.files import JSON, Output, check_outputs, write_json
from ..base.messages import one_line
from ..base.version import __version__
from .classify import add_request_options, request_of
from .parser import Parser, add_stage_options, stage_options

#: Options of ``writers.objects`` that ``objects`` has flags for.
_OBJECT_OPTIONS = ("outlines", "cell")
_INPUTS = "Classified files, folders or patterns"
_VECTOR_FILE = "Vector file to write: .gpkg, .geojson, .fgb or .shp"
_WORKERS = "Files to read at the same time (default: 1)"


def add_commands(parser: Parser) -> None:
    """Add ``objects``, ``review``, ``explain``, ``corrections`` and ``demo``."""
    what = "Write buildings, trees, wires and bridge decks to a vector file"
    add = parser.command("objects", _objects, what, overrides=True, progress=True)
    add("inputs", nargs="+", metavar="input", help=_INPUTS)
    add("output", help=_VECTOR_FILE)
    add_stage_options(add, "writers.objects", *_OBJECT_OPTIONS)
    add("--workers", type=int, default=1, metavar="N", help=_WORKERS)
    add("--metadata", metavar="FILE", help="Write counts, verdicts and settings to a JSON file")

    what = "List the places that a person should check, worst first"
    add = parser.command("review", _review, what, progress=True)
    add("inputs", nargs="+", metavar="input", help=_INPUTS)
    add("output", help=_VECTOR_FILE)
    add("--json", metavar="FILE", help="Write figures to a JSON file")
    add("--share", type=float, default=0.95, help="Share of expected errors to cover (0.95)")
    cell = "Side of the cells (default: by density)"
    add("--cell", type=float, default=0.0, metavar="METERS", help=cell)
    add("--workers", type=int, default=1, metavar="N", help=_WORKERS)
    reasons = "Name what speaks against the class of the worst N patches only (all; 0: of none)"
    add("--reasons", type=int, metavar="N", help=reasons)
    model = "Model for files without Reliability, and for --reasons (standard)"
    add("--model", default="standard", help=model)

    what = "Tell why points have their class: ground filter, inputs of the model, what came after"
    rare = ("ground", "dimensions")
    add = parser.command("explain", _explain, what, overrides=True, rare=rare)
    add("cloud", help="LAS or LAZ file, folder or pattern, classified or not")
    add("place", nargs="*", type=float, metavar="X Y [Z]", help="The nearest point is explained")
    points = "CSV file of x, y and, where known, z; or vector file of points"
    add("--points", metavar="FILE", default="", help=points)
    add("--crs", default="", help="Reference system of X and Y (default: the cloud's)")
    add("--json", metavar="FILE", default="", help="Write JSON, too; - prints it instead of text")
    against = "Class that the one found is compared with (default: the file's, or the next likely)"
    add("--against", type=int, metavar="CODE", help=against)
    add_request_options(add)

    what = "Mark points that a person corrected or confirmed, to train on"
    add = parser.command("corrections", _corrections, what)
    after = "The same points after a person's corrections, in any order; of files those corrected"
    add("before", help="LAS or LAZ file, folder or pattern, as classified")
    add("after", nargs="?", help=after)
    add(
        "--out",
        required=True,
        metavar="FILE",
        help="File or folder to write: new classes, and Checked",
    )
    area = "Polygons in which all points were checked; with a column 'done', those with 1"
    add("--area", action="append", default=[], metavar="FILE", help=area)
    radius = "Radius checked around changes (1)"
    add("--around", type=float, default=1.0, metavar="METERS", help=radius)

    what = "Make a town, train on one half, classify the other"
    add = parser.command("demo", _demo, what, progress=True)
    folder = "Folder for the results (pdal-stages-demo)"
    add("folder", nargs="?", default="pdal-stages-demo", help=folder)
    add("--size", type=float, default=200.0, help="Side of the town in meters (200)")
    add("--density", type=float, default=7.0, help="Points per square meter (7)")
    add("--seed", type=int, default=1, help="Another number gives another town (1)")


def _objects(options: argparse.Namespace) -> None:
    """Write the objects of classified files."""
    from ..tiling.objects_from_files import objects_of_files, objects_stage

    values = stage_options(options, *_OBJECT_OPTIONS)
    stage = objects_stage(options.output, options.overrides, **values)
    objects_of_files(options.inputs, stage, options.workers, options.metadata)


def _review(options: argparse.Namespace) -> None:
    """List the places to check."""
    from ..review.review_files import lines, write_review

    wanted = ("share", "cell", "model", "workers", "reasons")
    settings = {name: getattr(options, name) for name in wanted}
    review = write_review(options.inputs, options.output, options.json or "", **settings)
    print("\n".join(lines(review.to_dict())))
    names = [name for name in (options.output, options.json) if name]
    print(one_line(f"written to {', '.join(names)}"))


def _explain(options: argparse.Namespace) -> None:
    """Explain points."""
    from ..review.explain import explain_points
    from ..review.explanation_text import lines
    from ..review.places import read_places

    places = read_places(options.cloud, options.place, options.points, options.crs)
    output = [Output(options.json, "json", JSON)] if options.json not in ("", "-") else []
    check_outputs(output, [options.cloud, *filter(None, [options.points])])
    explained = explain_points(
        [options.cloud], places, request_of(options), against=options.against
    )
    if options.json != "-":
        print("\n\n".join("\n".join(lines(each)) for each in explained))
    if options.json:
        values = {"version": __version__, "points": [asdict(each) for each in explained]}
        text = json.dumps(values, indent=1)
        print(text) if options.json == "-" else write_json(options.json, values, "json")


def _corrections(options: argparse.Namespace) -> None:
    """Mark corrected points."""
    from ..review.corrections import write_corrections

    files = options.before, options.out, options.after or ""
    print("\n".join(map(one_line, write_corrections(*files, options.area, options.around))))
    train = f"pdal-stages train --base MODEL {options.out} --model NEW"
    print(one_line(f"written to {options.out}; next: {train}"))


def _demo(options: argparse.Namespace) -> None:
    """Run the demo."""
    from ..synthetic.demo import run_demo

    run_demo(options.folder, size=options.size, density=options.density, seed=options.seed)
