"""The command ``pdal-stages``: thin, with PDAL's own flag habits."""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import os
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from .base import kinds
from .base.errors import OptionError, StageError, suggest
from .base.lean import import_lean
from .base.outputs import Output, check_outputs
from .base.plain import PlainStream, print_messages
from .base.runlog import LoggedStream, RunLog
from .base.version import __version__
from .pipeline.overrides import parse_overrides

if TYPE_CHECKING:
    from .pipeline.read import PipelineSource

_OVERRIDES = (
    "Options of stages are set as in PDAL: --stage.TAG.option=VALUE for stages with a tag, "
    "--filters.name.option=VALUE for all stages of a type."
)

_INPUTS = "Files that PDAL reads, folders, patterns, tile indexes, EPT sources"
#: Lines of PDAL's log that are shown without -v.
_LOG_LINES = 10
_VERBOSE = ("-v", "--verbose")
_LEVELS = {0: logging.ERROR, 1: logging.WARNING, 2: logging.INFO}
#: Commands that work long enough for a log and progress.
_LOGGED = ("pipeline", "classify", "objects", "review", "train", "accuracy", "demo")
#: Commands that run no code but ours: no stage of a user's, no notebook.
_OWN_CODE = ("classify", "objects")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code (0 fine, 1 an error, 2 wrong usage, 130 interrupted)."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments or os.environ.get("PDAL_STAGES_DEBUG", "") not in ("", "0")
    arguments = _levels([a for a in arguments if a != "--debug"])
    _print_anything()
    streams = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = map(PlainStream, streams)  # type: ignore[assignment]
    log: RunLog | None = None
    shown = os.environ.get("PDAL_STAGES_PROGRESS")
    code = 1
    try:
        overrides, rest = parse_overrides(arguments)
        options, unknown = _parser().parse_known_args(rest)
        command = vars(options).pop("parser")  # it cannot travel to workers
        if unknown and not _taken(options, unknown):
            _refuse_words(command, unknown)
        if overrides and not getattr(options, "takes_overrides", False):
            raise StageError(f"'{options.command}' takes no stage options", found=overrides[0].flag)
        options.overrides, options.arguments = overrides, arguments
        options.is_program = argv is None
        if options.is_program and options.command in _OWN_CODE:
            import_lean()
        if getattr(options, "progress", None) is not None:
            os.environ["PDAL_STAGES_PROGRESS"] = "1" if options.progress else "0"
        if getattr(options, "log", None):
            check_outputs([Output(options.log, "log", "")], [])
            log = RunLog(options.log, arguments, sys.stderr)
            sys.stdout, sys.stderr = LoggedStream(sys.stdout, log), LoggedStream(sys.stderr, log)  # type: ignore[assignment]
        code = int(options.run(options) or 0)
        sys.stdout.flush()  # a full disk or a closed pipe shows here, not at exit
        return code
    except BrokenPipeError:  # e.g. into head
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return 0
    except KeyboardInterrupt:
        code = 130
        print_messages("interrupted; nothing half-written was left")
        return code
    except Exception as error:
        code = 1
        if debug:
            raise
        print_messages(str(error if isinstance(error, StageError) else _unforeseen(error)))
        return code
    finally:
        if log is not None:
            log.end(code)
        sys.stdout, sys.stderr = streams
        if shown is not None:
            os.environ["PDAL_STAGES_PROGRESS"] = shown
        else:
            os.environ.pop("PDAL_STAGES_PROGRESS", None)


def _levels(arguments: list[str]) -> list[str]:
    """PDAL's ``-v 4``, and ``-v`` alone, in one form."""
    out: list[str] = []
    for number, word in enumerate(arguments):
        if word in _VERBOSE:
            level = arguments[number + 1] if arguments[number + 1 : number + 2] else ""
            out.append(f"--verbose={level if level.isdigit() else 2}")
        elif not (word.isdigit() and number and arguments[number - 1] in _VERBOSE):
            out.append(word)
    return out


def _print_anything() -> None:
    """A locale that lacks a character shows its code, rather than ending the run."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(AttributeError, ValueError):  # a notebook's stream cannot
            stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]


def _unforeseen(error: Exception) -> StageError:
    """An unforeseen error, as a message of one paragraph."""
    if isinstance(error, MemoryError):
        return StageError("memory ran out", cure="Work in tiles (--tile), or lower 'memory'")
    if isinstance(error, OSError):
        name = f"{error.filename}: " if error.filename is not None else ""
        return StageError("the system refused", found=f"{name}{error.strerror or error}")
    if isinstance(error, ImportError):
        return StageError(
            "a Python package cannot be imported",
            found=f"{sys.executable}: {str(error).strip().splitlines()[0] if str(error).strip() else error!r}",
            cure="Install pdal-stages with its packages into one environment, e.g. with conda; packages built for "
            "another NumPy or Python must be installed again",
        )
    return StageError(
        f"internal error: {type(error).__name__}: {error}", cure="Run with --debug and report what it prints"
    )


def _taken(options: argparse.Namespace, words: list[str]) -> bool:
    """Whether words left over are names of inputs, and of the output, behind a flag, where argparse does not look."""
    inputs = getattr(options, "inputs", None)
    if not isinstance(inputs, list) or any(word.startswith("-") for word in words):
        return False
    if hasattr(options, "output"):
        *inputs[len(inputs) :], options.output = [options.output, *words]
    else:
        inputs += words
    return True


def _refuse_words(command: argparse.ArgumentParser, unknown: list[str]) -> None:
    """Leave with the command's usage and the flag that may have been meant."""
    flags = re.findall(r"(?<!\S)--[\w-]+(?![\w.-])", command.format_help())
    near = suggest(unknown[0].partition("=")[0], flags)
    command.error(f"unrecognized arguments: {' '.join(unknown)}. {near}".rstrip(". "))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="pdal-stages",
        description="PDAL pipelines with stages that classify airborne laser scans.",
        epilog=_OVERRIDES + " --debug shows tracebacks.",
    )
    parser.add_argument("--version", action="version", version=f"pdal-stages {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add(name: str, run: Callable, help: str, overrides: bool = False) -> Callable:
        command = commands.add_parser(
            name, help=help, description=help + ".", epilog=_OVERRIDES if overrides else None
        )
        command.set_defaults(run=run, takes_overrides=overrides, parser=command)
        if name in _LOGGED:
            command.add_argument(
                "--log", metavar="FILE", help="Add all that the run and its workers print to a log file"
            )
            command.add_argument(
                "--progress", action=argparse.BooleanOptionalAction, default=None, help="Show progress"
            )
        return command.add_argument

    takes = add("pipeline", _pipeline, "Run a pipeline that may contain our stages", overrides=True)
    _pipeline_input(takes)
    takes("--metadata", metavar="FILE", help="Write the metadata of the run to a JSON file")
    takes("--validate", action="store_true", help="Check the pipeline without reading points, then stop")
    takes(
        "--nostream",
        action="store_true",
        help="Accepted for compatibility with PDAL; our stages never stream",
    )
    takes(
        "-v",
        "--verbose",
        type=int,
        default=1,
        metavar="LEVEL",
        help="Print more of PDAL's log: 1 warnings (default), 2 what it does (-v alone), 3 and more everything",
    )
    from .tiling.command import add_arguments

    add_arguments(commands.choices["pipeline"])

    takes = add(
        "expand", _expand, "Print the plain PDAL JSON, which stock 'pdal pipeline' runs", overrides=True
    )
    _pipeline_input(takes)
    takes("-o", "--output", metavar="FILE", help="Write it to a file instead")

    takes = add("validate", _validate, "Check a pipeline without reading points", overrides=True)
    _pipeline_input(takes)

    takes = add("drivers", _drivers, "List stages: ours, then PDAL's")
    takes("--ours", action="store_true", help="Only ours")
    takes("--showjson", action="store_true", help="As JSON, like pdal --drivers --showjson")

    takes = add("options", _options, "List the options of a stage")
    takes("stage", help="e.g. filters.hag_minima; for PDAL's stages pdal --options is asked")
    takes("--showjson", action="store_true", help="As JSON Schema")

    takes = add("commands", _commands, "List commands with their arguments")
    takes(
        "--showjson",
        action="store_true",
        help="With stages, models and classes, as JSON: dialogs are made of it",
    )

    add("doctor", _doctor, "Tell what is there on this machine, and the cure for what is not")
    add("plugin", _plugin, "Build our stages into PDAL itself, so that all that runs PDAL has them")
    from .plugin.command import add_arguments as add_plugin_arguments

    add_plugin_arguments(commands.choices["plugin"])

    takes = add("classify", _classify, "Classify a cloud with a model file", overrides=True)
    takes("inputs", nargs="+", metavar="input", help=_INPUTS)
    takes(
        "output",
        help="A file; of several inputs a folder, which is made, or a name with # where the input's goes. Other dimensions "
        "and the header are kept",
    )
    takes(
        "--model",
        default="standard",
        help="A model file, or a shipped model's name (pdal-stages models); default standard",
    )
    takes(
        "--dimensions",
        metavar="LIST",
        help="Extra dimensions to write beside the input's own: e.g. Reliability,Margin,Probability_6, all, or none; "
        "default HeightAboveGround,Reliability, rounded to 1/32 (3 cm) and 1/64 (1.6 %%), which keeps files small",
    )
    takes(
        "--noise",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="Mark low and high noise first (filters.detachednoise)",
    )
    takes(
        "--polygons",
        action="append",
        default=[],
        metavar="FILE=CODE",
        help="Class of ground inside the polygons of an OGR file, e.g. lakes.gpkg=9; of other classes too: "
        "bridges.gpkg=17:2,6; may be repeated (filters.polygons)",
    )
    takes(
        "--objects",
        metavar="FILE",
        help="Then write buildings, trees, spans and decks of all outputs to this vector file (.gpkg, ...), as "
        "pdal-stages objects does; its options too: --writers.objects.tree_height=5",
    )
    takes(
        "--bridges",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="Find bridge decks (17), which leave ground and buildings (filters.bridges), with models whose heights "
        "filters.hag_morphological makes",
    )
    takes(
        "--wires",
        action=argparse.BooleanOptionalAction,
        default=False,
        help="Find wires (14), whatever they were called (filters.wires); tiles are read with 85 m more around them",
    )
    takes(
        "--towers",
        action=argparse.BooleanOptionalAction,
        default=False,
        help="Find wires, and towers and poles (15) where they meet; tiles are read with 135 m more around them",
    )
    takes(
        "--consistency",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="Mend classes that contradict their surroundings at the end (filters.consistency)",
    )
    takes(
        "--vegetation-heights",
        default="",
        metavar="LOW,MEDIUM",
        help="Vegetation below these heights in meters, e.g. 0.5,2, is low (3) and medium (4), the rest high (5)",
    )
    takes(
        "--keep-sure",
        type=float,
        metavar="SHARE",
        help="Leave points unclassified (1) where the model is not sure enough for this share of each class to be right, "
        "e.g. 0.98, as measured on ground it had not seen",
    )
    takes("--where", help="Classify only the points for which this holds; the others serve as neighbors")
    takes("--metadata", metavar="FILE", help="Write the metadata of the run to a JSON file")
    add_arguments(commands.choices["classify"], survey=True)

    add(
        "objects",
        _objects,
        "Write buildings, trees, spans of wires and bridge decks of classified files to a vector file",
        overrides=True,
    )
    from .tiling.objects import add_arguments as add_objects_arguments

    add_objects_arguments(commands.choices["objects"])

    takes = add("review", _review, "List where a person should look in classified files, worst first")
    takes("inputs", nargs="+", metavar="input", help="Classified files PDAL can read, folders, patterns")
    takes("output", help="Vector file to write: .gpkg, .geojson, .fgb or .shp")
    takes(
        "--html", metavar="FILE", help="A page with pictures; default: beside the vector file, under its name"
    )
    takes("--json", metavar="FILE", help="Write figures to a JSON file")
    takes("--pictures", type=int, default=40, metavar="N", help="Patches that the page shows (40)")
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
    takes(
        "after",
        nargs="?",
        help="The same points, in any order, as the person left them; or points with true classes: a CSV file or a vector "
        "layer with x, y, z and class",
    )
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
    takes(
        "--within",
        type=float,
        default=0.5,
        metavar="METERS",
        help="A point of a table is about the nearest one of the file within this distance (0.5)",
    )

    add("models", _models, "List the models that come with the package")

    takes = add("train", _train, "Train a model on labeled clouds", overrides=True)
    takes("inputs", nargs="+", metavar="input", help=f"Labeled: {_INPUTS[0].lower()}{_INPUTS[1:]}")
    takes("--model", required=True, help="The model file to write")
    takes(
        "--base", metavar="MODEL", help="A model to build on: standard, or a file; then few labels are enough"
    )
    takes(
        "--classes",
        metavar="MAP",
        help="Codes (2,5,6), or a JSON mapping of labels to classes with their names, e.g. "
        '\'{"2": "2 Ground", "3,4,5": "5 Vegetation", "6": "6 Building"}\'',
    )
    takes("--neighborhoods", help="Preset or tokens, e.g. s5,k10,k50")
    takes("--feature-set", help="Groups or single features, e.g. covariance,geometric")
    takes("--count", type=int, help="Samples of each class")
    takes("--trees", help="Number of trees; of several the best is found")

    takes(
        "--leave-one-survey-out",
        action="store_true",
        help="Score each survey by a model trained without it; each file is a survey, unless --surveys groups them",
    )
    takes(
        "--surveys",
        nargs="+",
        metavar="NAME=PATTERN",
        help="Files of one survey, e.g. north=north/*.laz; surveys do not see each other, weigh alike, and may have "
        "different reference systems",
    )

    commands.choices["train"].epilog = (
        "Of several files the score is by file. Of one file, --writers.classifiermodel.groups=PointSourceId makes it one by "
        "flight line (any dimension with a number for each group), and --writers.classifiermodel.survey=UserData says that "
        "points of another number there are of another survey. " + _OVERRIDES
    )

    takes = add("accuracy", _accuracy, "Compare two class dimensions, or two files", overrides=True)
    takes("inputs", nargs="+", metavar="input", help=f"Classified: {_INPUTS[0].lower()}{_INPUTS[1:]}")
    takes(
        "--reference",
        action="append",
        metavar="FILE",
        help="The same points, in the same order, with true classes: a file, a folder or a pattern, paired by name; "
        "may be repeated",
    )
    takes("--model", help="Score this model on labeled files: a model file, or a shipped model's name")
    takes("--dimension", default="Classification", help="Classes to judge")
    takes("--reference-dimension", help="Dimension with the true classes")
    takes(
        "--objects",
        metavar="FILE",
        help="Compare objects instead: the input is a vector file of pdal-stages objects, this one has true buildings "
        "(polygons) or trees (points; 'height')",
    )
    takes("--area", metavar="FILE", help="With --objects: polygons inside of which objects count")
    takes("--json", help="Write figures to this file")
    takes("--html", help="Write a report to this file")

    takes = add("model", _model, "Describe a model file")
    takes("file")
    takes("--showjson", action="store_true", help="Everything, as JSON")
    takes("--html", help="Write a page with its scores, training curve and importances to this file")

    takes = add("demo", _demo, "Generate a town, train on one half, classify the other")
    takes("folder", nargs="?", default="pdal-stages-demo", help="Where results go")
    takes("--size", type=float, default=200.0, help="Side of the town in meters")
    takes("--density", type=float, default=7.0, help="Points per square meter")
    takes("--seed", type=int, default=1)

    takes = add(
        "warmup", _warmup, "Compile the kernels for this machine once, so that later runs start without delay"
    )
    takes("--all", action="store_true", help="Those of kopt, ropt, copt and shape distributions too")
    return parser


def _pipeline_input(takes: Callable) -> None:
    takes("file", nargs="?", help="Pipeline JSON file")
    takes("-i", "--input", dest="file_option", metavar="FILE", help="The same, as PDAL's --input")
    takes("-s", "--stdin", action="store_true", help="Read the pipeline from standard input")


def _source(options: argparse.Namespace) -> Path | PipelineSource:
    """A file's path, or what was read from standard input."""
    if options.stdin:
        from .pipeline.read import decode, parse_pipeline

        raw = getattr(sys.stdin, "buffer", None)
        text = decode(raw.read(), "standard input") if raw is not None else sys.stdin.read()
        return parse_pipeline(text or " ", "standard input")
    name = options.file or options.file_option
    if not name:
        raise StageError("no pipeline file was given", cure=f"Usage: pdal-stages {options.command} job.json")
    return Path(name)


def _build(options: argparse.Namespace):
    from .pipeline.run import Pipeline

    return Pipeline(_source(options), options.overrides)


def _pipeline(options: argparse.Namespace) -> int | None:
    from .tiling.command import run_command, wants_tiles

    if wants_tiles(options):
        return run_command(options, _source(options))
    if options.validate:
        return _validate(options)
    _run(options, _build(options))
    return None


def _run(options: argparse.Namespace, pipeline) -> int:
    """Run a pipeline and print its messages; the number of points."""
    count, messages = _ran(options, pipeline)
    print_messages(*messages)
    return count


def _ran(options: argparse.Namespace, pipeline) -> tuple[int, list[str]]:
    """Run a pipeline: the number of points, and messages."""
    from .base.files import write_whole
    from .tiling.command import end_at_once

    metadata, verbose = getattr(options, "metadata", None), getattr(options, "verbose", 1)
    more = [Output(options.log, "log")] if getattr(options, "log", None) else []
    pipeline.check_outputs(*more, *([Output(metadata, "metadata", kinds.JSON)] if metadata else []))
    before = list(pipeline.lowered.warnings)
    print_messages(*before)
    end_at_once(options)
    count = pipeline.execute(arrays=False, loglevel=_LEVELS.get(verbose, logging.DEBUG))
    # Warnings, and what PDAL calls an error although it goes on: a reader that sets what it cannot read to 0, say.
    lines = pipeline.log_lines
    messages = [f"PDAL says: {line}" for line in (lines if verbose > 1 else lines[:_LOG_LINES])]
    if len(lines) > _LOG_LINES and verbose <= 1:
        messages.append(f"PDAL says {len(lines) - _LOG_LINES:,} more lines; -v shows them")
    if metadata:
        write_whole(metadata, (json.dumps(pipeline.metadata, indent=2, default=str) + "\n").encode())
    return count, messages + [line for line in pipeline.messages if line not in before]


def _expand(options: argparse.Namespace) -> None:
    from .base.files import write_whole

    pipeline = _build(options)
    text = pipeline.json + "\n"
    if options.output:
        check_outputs([Output(options.output, "output", kinds.JSON)], pipeline.inputs())
        write_whole(options.output, text.encode())
    else:
        sys.stdout.write(text)


def _validate(options: argparse.Namespace) -> int:
    """Print PDAL's verdict or ours as JSON, on standard output; an error goes to standard error too."""
    try:
        pipeline = _build(options)
        print(pipeline.validate())
        print_messages(*pipeline.lowered.warnings)
    except StageError as error:
        verdict = {"valid": False, "error_detail": str(error), "streamable": False}
        print(json.dumps(verdict, indent=2))
        print_messages(str(error))
        return 1
    return 0


def _drivers(options: argparse.Namespace) -> None:
    from .pipeline import describe

    print(describe.drivers(ours_only=options.ours, as_json=options.showjson), end="")


def _commands(options: argparse.Namespace) -> None:
    from .plugin.forms import forms

    commands = _commands_of(_parser())
    if options.showjson:
        print(forms(commands), end="")
        return
    for name, parser in commands.items():
        print(f"{name:12s} {parser.description}")


def _commands_of(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    return next(dict(one.choices) for one in parser._actions if isinstance(one, argparse._SubParsersAction))


def _doctor(options: argparse.Namespace) -> int:
    from .plugin.doctor import examine

    missing = 0
    for finding in examine():
        print(finding, flush=True)
        missing += bool(finding.cure and finding.needed)
    return int(missing > 0)


def _plugin(options: argparse.Namespace) -> int:
    from .plugin.command import run

    return run(options)


def _options(options: argparse.Namespace) -> None:
    from .pipeline import describe

    print(describe.stage_options(options.stage, as_json=options.showjson), end="")


def _classify(options: argparse.Namespace) -> int:
    from .pipeline.classifying import WRITTEN, ClassifyRequest
    from .tiling.classify import ClassifyTask
    from .tiling.command import classify, options_of

    own, others = [], list(options.overrides)
    if options.objects:
        from .tiling.objects import OPTIONS_OF

        own = [one for one in others if not one.by_tag and one.selector in OPTIONS_OF]
        others = [one for one in others if one not in own]
    listed = options.dimensions
    named = WRITTEN if listed is None else tuple(name.strip() for name in listed.split(",") if name.strip())
    request = ClassifyRequest(
        options.model,
        tuple(others),
        options.where,
        named,
        noise=options.noise,
        bridges=options.bridges,
        wires=options.wires or options.towers,
        towers=options.towers,
        consistency=options.consistency,
        polygons=tuple(options.polygons),
        vegetation_heights=options.vegetation_heights,
        keep_sure=options.keep_sure,
    )
    print_messages(*request.cost)
    files = {"metadata": options.metadata or "", "log": options.log or ""}
    task = ClassifyTask(tuple(options.inputs), options.output, request, options_of(options), **files)
    if not options.objects:
        return classify(task, options)
    from .tiling.objects import objects_of_outputs, refuse_tiles, writer

    stage = writer(options.objects, own)
    refuse_tiles(task, options.objects)
    return classify(task, options, lambda: objects_of_outputs(task, stage))


def _objects(options: argparse.Namespace) -> int:
    from .tiling.objects import run_command

    return run_command(options)


def _review(options: argparse.Namespace) -> None:
    from .pipeline.reviewing import request_of, write_review
    from .reports.reviewpage import lines

    request = request_of(
        options.inputs,
        options.output,
        html=options.html,
        json=options.json or "",
        share=options.share,
        pictures=options.pictures,
        model=options.model,
        cell=options.cell,
        workers=options.workers,
    )
    print("\n".join(lines(write_review(request).to_dict())))
    print(f"written to {', '.join(name for name in (request.output, request.html, request.json) if name)}")


def _corrections(options: argparse.Namespace) -> None:
    from .pipeline.correcting import request_of, write_corrections

    request = request_of(
        options.before, options.after, options.out, options.area, options.around, options.within
    )
    print("\n".join(write_corrections(request).lines()))
    print(f"written to {request.output}; next: pdal-stages train --base MODEL {request.output} --model NEW")


def _models(options: argparse.Namespace) -> None:
    from .base.asprs import class_name
    from .models import shipped
    from .stages.loading import load_model

    for name, path in shipped().items():
        model = load_model(path)
        classes = ", ".join(f"{code} {class_name(code)}" for code, _ in model.classes)
        print(f"{name:12s} {classes}; {path}")


def _train(options: argparse.Namespace) -> None:
    from .pipeline.ends import input_files
    from .pipeline.run import Pipeline
    from .pipeline.trainjob import train_pipeline
    from .stages.loading import load_model

    named = ("classes", "neighborhoods", "feature_set", "count", "trees", "base")
    extra = {name: value for name in named if (value := getattr(options, name)) is not None}
    if options.leave_one_survey_out or options.surveys:
        from .pipeline.surveyjob import surveys_of, train_surveys

        surveys = surveys_of(input_files(options.inputs), options.surveys or ())
        extra |= {"leave_one_survey_out": True} if options.leave_one_survey_out else {}
        print_messages(*train_surveys(surveys, options.model, options.overrides, **extra))
    else:
        stages = train_pipeline(input_files(options.inputs), options.model, options.overrides, **extra)
        _run(options, Pipeline(stages, options.overrides))
    if Path(options.model).is_file():  # not written into a pipe or device
        print(load_model(options.model))


def _accuracy(options: argparse.Namespace) -> None:
    from .pipeline.comparing import accuracy_pipeline, compare_files
    from .pipeline.ends import input_files
    from .pipeline.run import Pipeline

    reference_dimension = options.reference_dimension or (
        "Classification" if options.reference else "Reference"
    )
    outputs = {k: v for k in ("json", "html") if (v := getattr(options, k))}
    if options.objects:
        _compare_objects(options)
        return
    if options.area:
        raise StageError("--area needs --objects", found=options.area)
    several = len(input_files(options.inputs)) > 1
    if options.reference or options.model or several:
        if options.reference and options.model:
            raise StageError("--reference and --model exclude each other", found=options.model)
        if options.model:
            reference_dimension = options.reference_dimension or "Classification"
        print_messages(
            *compare_files(
                options.inputs,
                options.reference or (),
                options.dimension,
                reference_dimension,
                options.overrides,
                options.model or "",
                **outputs,
            )
        )
        return
    stages = accuracy_pipeline(options.inputs, options.dimension, reference_dimension, **outputs)
    _run(options, Pipeline(stages, options.overrides))


def _compare_objects(options: argparse.Namespace) -> None:
    """``accuracy town.gpkg --objects reference.gpkg``."""
    from .base.files import write_whole
    from .reports import objectaccuracy

    if len(options.inputs) != 1 or options.reference or options.overrides:
        raise StageError(
            "--objects compares one vector file with another, and takes --area, --json and --html alone",
            found=", ".join(options.inputs),
        )
    found, reference = options.inputs[0], options.objects
    pages = {"json": kinds.JSON, "html": kinds.HTML}
    outputs = [Output(path, k, kind) for k, kind in pages.items() if (path := getattr(options, k))]
    check_outputs(outputs, [found, reference, *([options.area] if options.area else [])])
    figures, one, two = objectaccuracy.compare_objects(found, reference, options.area)
    print(objectaccuracy.table(figures), end="")
    if options.json:
        text = json.dumps(objectaccuracy.to_json(figures), indent=1) + "\n"
        write_whole(options.json, text.encode(), "json")
    if options.html:
        write_whole(
            options.html, objectaccuracy.page(figures, one, two, "Accuracy of objects").encode(), "html"
        )


def _model(options: argparse.Namespace) -> None:
    from .stages.loading import load_model

    model = load_model(options.file)
    if options.html:
        from .reports.modelpage import write_model_report

        check_outputs([Output(options.html, "html", kinds.HTML)], [options.file])
        write_model_report(options.html, model, Path(options.file).name)
    if options.showjson:
        print(json.dumps(model.describe(), indent=2, default=str))
    else:
        print(model)


def _demo(options: argparse.Namespace) -> None:
    from .synthetic.demo import run_demo

    try:
        run_demo(options.folder, size=options.size, density=options.density, seed=options.seed)
    except OptionError as error:
        error.what = re.sub(r"^'(\w+)'", r"'--\1'", error.what)
        raise


def _warmup(options: argparse.Namespace) -> None:
    from .base.threads import available_threads
    from .classifier.warmup import compile_part, features_part, other_part, warmup
    from .objects.warmup import objects_part
    from .pipeline.processes import each_file
    from .synthetic.demo import compile_kernels

    parts = [(part,) for part in (features_part, other_part, objects_part, compile_kernels)]
    for _, answer in each_file(compile_part, parts, min(2, available_threads())):
        if answer.reason:
            raise StageError("the kernels cannot be compiled", found=answer.reason)
    warmup()  # shows that all are there and work together
    if options.all:
        from .features import warmup as every_neighborhood

        every_neighborhood()


if __name__ == "__main__":
    from pdal_stages import cli  # workers know its functions by this name

    sys.exit(cli.main())
