"""The command ``classify``: its flags, the request they become, and its two ways to run."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

from ..base.messages import count_of, one_line, print_messages
from .parser import INPUTS, Parser, add_stage_options, stage_options
from .tiled_runs import (
    add_tile_options,
    end_at_ctrl_c,
    end_run,
    print_classes,
    print_output,
    print_plan,
    print_run,
    run_files,
    run_until_interrupted,
    tiling_options,
)

if TYPE_CHECKING:
    from ..pipeline.classify_request import ClassifyRequest
    from ..tiling.classify import ClassifyTask
    from ..tiling.jobs import TiledRun

#: Options of ``filters.modelclassifier`` that ``classify`` has flags for.
_CLASSIFIER_OPTIONS = ("vegetation_heights", "keep_sure")


def add_commands(parser: Parser) -> None:
    """Add ``classify``."""
    help = "Classify point clouds: ground, vegetation, buildings and more"
    rare = ("ground", "towers", "dimensions", "metadata", "scheduler", "per")
    add = parser.command("classify", _classify, help, overrides=True, progress=True, rare=rare)
    add("inputs", nargs="+", metavar="input", help=INPUTS)
    add("output", help="A file, a folder, or a name with # for the input's")
    add_request_options(add)
    add("--metadata", metavar="FILE", help="Write the metadata of the run to a JSON file")
    add_tile_options(parser.commands["classify"], survey=True)


def add_request_options(add: Callable) -> None:
    """Add the options that tell how points are classified."""
    add("--model", default="standard", help="A model file or a shipped model (default: standard)")
    ground = (
        "given: points of the classes 2, 9 and 11 (ground, water, road) are the ground, and keep "
        "their class (default: found)"
    )
    add("--ground", choices=("found", "given"), default="found", help=ground)
    dimensions = (
        "Extra dimensions to write besides the input's own, e.g. Reliability,Margin,Probability_6, "
        "or all, or none; default HeightAboveGround,Reliability, rounded to 1/32 (3 cm) and 1/64 "
        "(1.6 %%), which keeps files small"
    )
    add("--dimensions", metavar="LIST", help=dimensions)
    for flag, default, help in (
        ("--noise", True, "Mark noise, classes 7 and 18 (default: on)"),
        ("--towers", True, "Find towers and poles that hold wires, class 15 (default: on)"),
        ("--bridges", False, "Find bridge decks, class 17"),
    ):
        add(flag, action=argparse.BooleanOptionalAction, default=default, help=help)
    polygons = (
        "Class for ground inside polygons, e.g. lakes.gpkg=9; for other classes: "
        "bridges.gpkg=17:2,6; may be repeated"
    )
    add("--polygons", action="append", default=[], metavar="FILE=CODE", help=polygons)
    add_stage_options(add, "filters.modelclassifier", *_CLASSIFIER_OPTIONS)
    add("--where", help="Classify only points that meet this condition")


def request_of(options: argparse.Namespace) -> ClassifyRequest:
    """Return how points are to be classified."""
    from ..pipeline.classify_request import WRITTEN, ClassifyRequest

    listed = WRITTEN
    if options.dimensions is not None:
        listed = tuple(name.strip() for name in options.dimensions.split(",") if name.strip())
    return ClassifyRequest(
        options.model,
        tuple(options.overrides),
        options.where,
        listed,
        stage_options(options, *_CLASSIFIER_OPTIONS),
        noise=options.noise,
        towers=options.towers,
        bridges=options.bridges,
        polygons=tuple(options.polygons),
        given_ground=options.ground == "given",
    )


def _classify(options: argparse.Namespace) -> int:
    """Run the command in one piece or in tiles; return the exit code."""
    from ..tiling.classify import ClassifyTask

    files = run_files(options)
    task = ClassifyTask(
        tuple(options.inputs),
        options.output,
        request_of(options),
        tiling_options(options),
        tuple(files),
    )
    print_messages(*task.request.cost)
    names = {code: one_line(name) for code, name in task.request.loaded.classes}
    if task.in_one_piece:
        run, interrupted = _classify_whole(task, options), False
    else:
        run, interrupted = run_until_interrupted(
            lambda: task.run_tiles(
                dry_run=options.dry_run, finished=partial(print_output, names=names)
            )
        )
        print_plan(run) if options.dry_run else print_run(run)
    if not options.dry_run:
        print_classes(run.summary["classes"], run.summary["point_counts"], names)
    return end_run(files, run, "the same command with --resume" if interrupted else "")


def _classify_whole(task: ClassifyTask, options: argparse.Namespace) -> TiledRun:
    """Classify one file in one piece, and print the result."""
    end_at_ctrl_c(options.is_program)
    run = task.run_whole(dry_run=options.dry_run)
    if options.dry_run:
        print("1 input, in one piece")
    else:
        print_messages(*run.messages)
        print(f"{count_of(run.summary['points'], 'point')} written to {one_line(task.outputs[0])}")
    return run
