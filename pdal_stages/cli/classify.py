"""The command ``classify``: its flags, the record they are parsed into, and its two ways to run."""

from __future__ import annotations

import argparse
import shlex
import sys
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from ..base.errors import StageError
from ..base.files import Output
from ..base.messages import count_of, one_line, print_messages
from . import signals
from .parser import INPUTS, Parser, add_stage_options, stage_options
from .tile_options import RunFiles, add_tile_options, tiling_options
from .tile_results import end_run, print_classes, print_output, print_plan, print_run

if TYPE_CHECKING:
    from ..pipeline.classify_request import ClassifyRequest
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
    add(
        "--dimensions",
        metavar="LIST",
        help="Extra dimensions to write besides the input's own, e.g. "
        "Reliability,Margin,Probability_6, or all, or none; "
        "default HeightAboveGround,Reliability, rounded to 1/32 (3 cm) and 1/64 (1.6 %%), which "
        "keeps files small",
    )
    for flag, default, help in (
        ("--noise", True, "Mark noise, classes 7 and 18 (default: on)"),
        ("--bridges", False, "Find bridge decks, class 17"),
        ("--wires", False, "Find wires, class 14; without it they become building"),
        ("--towers", False, "Find wires, and their towers, class 15"),
    ):
        add(flag, action=argparse.BooleanOptionalAction, default=default, help=help)
    add(
        "--polygons",
        action="append",
        default=[],
        metavar="FILE=CODE",
        help="Class for ground inside polygons, e.g. lakes.gpkg=9; for other classes: "
        "bridges.gpkg=17:2,6; may be repeated",
    )
    add("--objects", metavar="FILE", help="Also write buildings, trees and more to a vector file")
    add_stage_options(add, "filters.modelclassifier", *_CLASSIFIER_OPTIONS)
    add("--where", help="Classify only points that meet this condition")
    add("--metadata", metavar="FILE", help="Write the metadata of the run to a JSON file")
    add_tile_options(parser.commands["classify"], survey=True)


@dataclass(frozen=True)
class ClassifyCommand:
    """A command line of ``classify``."""

    task: ClassifyTask  #: what to classify, and how
    files: RunFiles  #: what to write about the run
    objects: WriteObjects | None  #: writes the objects of the outputs, where they were requested
    dry_run: bool
    is_program: bool  #: whether this process runs for the command alone
    again: str  #: the command that continues the run if it is interrupted

    @classmethod
    def parse(cls, options: argparse.Namespace) -> ClassifyCommand:
        """Return what the flags ask for; OptionError where they cannot go together."""
        from ..tiling.classify import ClassifyTask
        from ..tiling.objects_from_files import OPTIONS_OF, refuse_tiles, writer

        files, overrides = RunFiles.parse(options), list(options.overrides)
        object_options = [
            override
            for override in overrides
            if options.objects and not override.by_tag and override.selector in OPTIONS_OF
        ]
        overrides = [override for override in overrides if override not in object_options]
        wants_objects = options.objects and not options.dry_run  # the folder may not be there yet
        extra_files = [
            *files.outputs,
            *([Output(options.objects, "objects")] * bool(wants_objects)),
        ]
        task = ClassifyTask(
            tuple(options.inputs),
            options.output,
            _request(options, tuple(overrides)),
            tiling_options(options),
            tuple(extra_files),
        )
        print_messages(*task.request.cost)
        objects = None
        if wants_objects:
            with task.folders():
                objects = writer(options.objects, object_options)
                refuse_tiles(task)
        words = [word for word in options.arguments if word != "--resume"]
        same = shlex.join(["pdal-stages", *words])
        again = (same if len(words) <= _MOST_WORDS else "the same command with") + " --resume"
        return cls(task, files, objects, options.dry_run, options.is_program, again)

    def write_objects(self) -> dict[str, Any]:
        """Find and write the objects of the outputs; return their files, and counts by kind."""
        from ..tiling.objects_from_files import objects_of_files

        assert self.objects is not None
        workers = max(1, self.task.options.local_workers)
        return objects_of_files(self.task.outputs, self.objects, workers)


def _request(options: argparse.Namespace, overrides: tuple) -> ClassifyRequest:
    """Return how points are to be classified."""
    from ..pipeline.classify_request import WRITTEN, ClassifyRequest

    listed = WRITTEN
    if options.dimensions is not None:
        listed = tuple(name.strip() for name in options.dimensions.split(",") if name.strip())
    return ClassifyRequest(
        options.model,
        overrides,
        options.where,
        listed,
        stage_options(options, *_CLASSIFIER_OPTIONS),
        noise=options.noise,
        bridges=options.bridges,
        wires=options.wires or options.towers,
        towers=options.towers,
        polygons=tuple(options.polygons),
        given_ground=options.ground == "given",
    )


def _classify(options: argparse.Namespace) -> int:
    """Run the command in one piece or in tiles; return the exit code."""
    command = ClassifyCommand.parse(options)
    names = {code: one_line(name) for code, name in command.task.request.loaded.classes}
    if not command.task.in_one_piece:
        return _classify_tiles(command, names)
    signals.end_at_ctrl_c(command.is_program)
    if command.is_program and not command.task.request.polygons:
        # laspy imports them for nothing, half of its time.
        absent: Any = dict.fromkeys({"requests", "pyproj"} - sys.modules.keys())
        sys.modules.update(absent)
    run = command.task.run_whole(dry_run=command.dry_run)
    if command.dry_run:
        print("1 input, in one piece")
    else:
        print_messages(*run.messages)
        points = count_of(run.summary["points"], "point")
        print(f"{points} written to {command.task.outputs[0]}")
        print_classes(run.summary["classes"], run.summary["left_alone"], names)
        _add_objects(command, run)
    return end_run(command.files, run, "")


def _add_objects(command: ClassifyCommand, run: TiledRun) -> None:
    """Write the objects that the command asks for; what is known of the run, if that fails."""
    if command.objects is None:
        return
    try:
        run.objects = command.write_objects()
    except StageError:
        end_run(command.files, run, "")
        raise


def _classify_tiles(command: ClassifyCommand, names: dict[int, str]) -> int:
    """Run the command in tiles; `names` are the model's classes by code. Return the exit code."""
    print_finished = partial(print_output, names=names)
    run, interrupted = signals.run_until_interrupted(
        lambda: command.task.run_tiles(dry_run=command.dry_run, finished=print_finished)
    )
    if command.dry_run:
        print_plan(run)
    else:
        print_run(run)
        print_classes(run.summary["classes"], run.summary["left_alone"], names)
        if not interrupted and not run.failures:
            _add_objects(command, run)
    return end_run(command.files, run, command.again if interrupted else "")
