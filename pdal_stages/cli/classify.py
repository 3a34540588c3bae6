"""The command ``classify``: its flags, the request they become, and its two ways to run."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from ..base.errors import StageError
from ..base.files import Output
from ..base.messages import count_of, one_line, print_messages
from . import signals
from .parser import INPUTS, Parser, add_stage_options, stage_options
from .tiled_runs import (
    add_tile_options,
    end_run,
    print_classes,
    print_output,
    print_plan,
    print_run,
    run_files,
    tiling_options,
)

if TYPE_CHECKING:
    from ..pipeline.classify_request import ClassifyRequest
    from ..pipeline.json_source import Override
    from ..stages.write_objects import WriteObjects
    from ..tiling.classify import ClassifyTask
    from ..tiling.jobs import TiledRun

#: Options of ``filters.modelclassifier`` that ``classify`` has flags for.
_CLASSIFIER_OPTIONS = ("vegetation_heights", "keep_sure")
#: A command with more words is not repeated where it is to be run again.
_MOST_WORDS = 20


def add_commands(parser: Parser) -> None:
    """Add ``classify``."""
    help = "Classify point clouds: ground, vegetation, buildings and more"
    rare = ("ground", "dimensions", "bridges", "metadata", "scheduler", "per")
    add = parser.command("classify", _classify, help, overrides=True, progress=True, rare=rare)
    add("inputs", nargs="+", metavar="input", help=INPUTS)
    add("output", help="A file, a folder, or a name with # for the input's")
    add("--model", default="standard", help="A model file or a shipped model (default: standard)")
    ground = "given: points of class 2 are the ground, and stay so (default: found)"
    add("--ground", choices=("found", "given"), default="found", help=ground)
    dimensions = (
        "Extra dimensions to write besides the input's own, e.g. Reliability,Margin,Probability_6, "
        "or all, or none; default HeightAboveGround,Reliability, rounded to 1/32 (3 cm) and 1/64 "
        "(1.6 %%), which keeps files small"
    )
    add("--dimensions", metavar="LIST", help=dimensions)
    for flag, default, help in (
        ("--noise", True, "Mark noise, classes 7 and 18 (default: on)"),
        ("--bridges", False, "Find bridge decks, class 17"),
        ("--wires", False, "Find wires, class 14; without it they become building"),
    ):
        add(flag, action=argparse.BooleanOptionalAction, default=default, help=help)
    polygons = (
        "Class for ground inside polygons, e.g. lakes.gpkg=9; for other classes: "
        "bridges.gpkg=17:2,6; may be repeated"
    )
    add("--polygons", action="append", default=[], metavar="FILE=CODE", help=polygons)
    add("--objects", metavar="FILE", help="Also write buildings, trees and more to a vector file")
    add_stage_options(add, "filters.modelclassifier", *_CLASSIFIER_OPTIONS)
    add("--where", help="Classify only points that meet this condition")
    add("--metadata", metavar="FILE", help="Write the metadata of the run to a JSON file")
    add_tile_options(parser.commands["classify"], survey=True)


def _request(options: argparse.Namespace, overrides: Sequence[Override]) -> ClassifyRequest:
    """Return how points are to be classified."""
    from ..pipeline.classify_request import WRITTEN, ClassifyRequest

    listed = WRITTEN
    if options.dimensions is not None:
        listed = tuple(name.strip() for name in options.dimensions.split(",") if name.strip())
    return ClassifyRequest(
        options.model,
        tuple(overrides),
        options.where,
        listed,
        stage_options(options, *_CLASSIFIER_OPTIONS),
        noise=options.noise,
        bridges=options.bridges,
        wires=options.wires,
        polygons=tuple(options.polygons),
        given_ground=options.ground == "given",
    )


def _classify(options: argparse.Namespace) -> int:
    """Run the command in one piece or in tiles; return the exit code."""
    from ..tiling.classify import ClassifyTask

    files, overrides = run_files(options), list(options.overrides)
    objects: WriteObjects | None = None
    if options.objects:
        from ..tiling.objects_from_files import OPTIONS_OF, objects_stage, refuse_tiles

        of_objects = [o for o in overrides if not o.by_tag and o.selector in OPTIONS_OF]
        overrides = [override for override in overrides if override not in of_objects]
    wants_objects = options.objects and not options.dry_run  # the folder may not be there yet
    task = ClassifyTask(
        tuple(options.inputs),
        options.output,
        _request(options, overrides),
        tiling_options(options),
        (*files, Output(options.objects, "objects")) if wants_objects else tuple(files),
    )
    print_messages(*task.request.cost)
    if wants_objects:
        with task.folders():
            objects = objects_stage(options.objects, of_objects)
            refuse_tiles(task)
    names = {code: one_line(name) for code, name in task.request.loaded.classes}
    if task.in_one_piece:
        run, interrupted = _classify_whole(task, options), False
    else:
        run, interrupted = signals.run_until_interrupted(
            lambda: task.run_tiles(
                dry_run=options.dry_run, finished=partial(print_output, names=names)
            )
        )
        print_plan(run) if options.dry_run else print_run(run)
    if not options.dry_run:
        print_classes(run.summary["classes"], run.summary["left_alone"], names)
        if objects is not None and not interrupted and not run.failures:
            _write_objects(task, objects, run, files)
    return end_run(files, run, _repeated_command(options) if interrupted else "")


def _classify_whole(task: ClassifyTask, options: argparse.Namespace) -> TiledRun:
    """Classify one file in one piece, and print the result."""
    signals.end_at_ctrl_c(options.is_program)
    if options.is_program and not options.polygons:
        # laspy imports them for nothing, half of its time.
        absent: Any = dict.fromkeys({"requests", "pyproj"} - sys.modules.keys())
        sys.modules.update(absent)
    run = task.run_whole(dry_run=options.dry_run)
    if options.dry_run:
        print("1 input, in one piece")
    else:
        print_messages(*run.messages)
        print(f"{count_of(run.summary['points'], 'point')} written to {task.outputs[0]}")
    return run


def _write_objects(
    task: ClassifyTask, objects: WriteObjects, run: TiledRun, files: Sequence[Output]
) -> None:
    """Write the objects of the outputs; where that fails, what is known of the run is written."""
    from ..tiling.objects_from_files import objects_of_files

    try:
        workers = max(1, task.options.local_workers)
        run.objects = objects_of_files(task.outputs, objects, workers)
    except StageError:
        end_run(files, run, "")
        raise


def _repeated_command(options: argparse.Namespace) -> str:
    """Return the command that continues an interrupted run."""
    words = [word for word in options.arguments if word != "--resume"]
    command = shlex.join(["pdal-stages", *words])
    return f"{command if len(words) <= _MOST_WORDS else 'the same command with'} --resume"
