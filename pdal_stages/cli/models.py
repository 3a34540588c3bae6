"""Models: train them, judge and describe them."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from ..base.errors import StageError
from ..base.files import JSON, Output, check_outputs
from ..base.messages import print_messages
from . import INPUTS, OVERRIDES, Parser, takes_options, tiles

#: Options of ``writers.classifiermodel`` that ``train`` has flags for.
_OF_TRAINING = ("base", "passes", "classes", "neighborhoods", "feature_set", "count", "trees")


def add_commands(parser: Parser) -> None:
    """``models``, ``train``, ``adapt``, ``accuracy`` and ``model``."""
    parser.command("models", _models, "List the models that come with the package")

    takes = parser.command("train", _train, "Train a model on labeled clouds", overrides=True, logged=True)
    takes("inputs", nargs="+", metavar="input", help=f"Labeled: {INPUTS[0].lower()}{INPUTS[1:]}")
    takes("--model", required=True, help="The model file to write")
    takes_options(takes, "writers.classifiermodel", *_OF_TRAINING)
    surveys = "Files of one survey, e.g. north=north/*.laz; each other file is one of its own. They do not see each other"
    takes("--surveys", nargs="*", metavar="NAME=PATTERN", help=surveys)

    tiles.add_sizes(parser.commands["train"])
    parser.commands["train"].epilog = (
        "Of several files the score is by file. Of one file, --writers.classifiermodel.groups=PointSourceId makes it one by "
        "flight line (any dimension with a number for each group), and --writers.classifiermodel.survey=UserData says that "
        "points of another number there are of another survey. " + OVERRIDES
    )

    what = "Make a model for a survey without labels, of what another is sure of there"
    takes = parser.command("adapt", _adapt, what, logged=True)
    takes("inputs", nargs="+", metavar="input", help=f"One survey's: {INPUTS[0].lower()}{INPUTS[1:]}")
    takes("--model", required=True, help="The model file to write, for classify --model")
    takes("--teacher", default="standard", metavar="MODEL", help="The model that is asked; default standard")
    takes("--sure", type=float, default=0.7, metavar="SHARE", help="Least Reliability to be believed (0.7)")
    tiles.add_sizes(parser.commands["adapt"])

    what = "Compare two class dimensions, or two files"
    takes = parser.command("accuracy", _accuracy, what, overrides=True, logged=True)
    takes("inputs", nargs="+", metavar="input", help=f"Classified: {INPUTS[0].lower()}{INPUTS[1:]}")
    takes("--reference", action="append", metavar="FILE", help="True classes of the same points, in order")
    takes("--model", help="Score this model on labeled files: a model file, or a shipped model's name")
    takes("--dimension", default="Classification", help="Classes to judge")
    takes("--reference-dimension", help="Dimension with the true classes")
    takes("--objects", metavar="FILE", help="Compare objects: true buildings (polygons) or trees (points)")
    takes("--area", metavar="FILE", help="With --objects: polygons inside of which objects count")
    takes("--json", help="Write figures to this file")
    takes("--html", help="Write a report to this file")

    takes = parser.command("model", _model, "Describe a model file")
    takes("file")
    takes("--showjson", action="store_true", help="Everything, as JSON")


def _models(options: argparse.Namespace) -> None:
    from ..base.las import class_name
    from ..classifier.model import load_model
    from ..classifier.modelfile import shipped

    for name, path in shipped().items():
        model = load_model(path)
        classes = ", ".join(f"{code} {class_name(code)}" for code, _ in model.classes)
        print(f"{name:12s} {classes}; {path}")


def _train(options: argparse.Namespace) -> None:
    from ..classifier.model import load_model
    from ..pipeline.inputs_outputs import input_files
    from ..tiling.training import TrainTask, surveys_of

    extra = {name: value for name in _OF_TRAINING if (value := getattr(options, name)) is not None}
    files, surveys = input_files(options.inputs), {}
    if options.surveys is not None:
        surveys = surveys_of(files, options.surveys)
    task = TrainTask(files, options.model, options.overrides, extra, tiles.options_of(options), surveys)
    with tiles.interruptible():
        said = task.run()
    # Nothing is said of one written into a pipe or device
    text = str(load_model(options.model)) if Path(options.model).is_file() else ""
    score = text.partition("\n")[0]
    print_messages(*(line for line in said if not score or not line.endswith(score)))
    if text:
        print(text)


def _adapt(options: argparse.Namespace) -> None:
    from ..classifier.model import load_model
    from ..tiling.adapting import AdaptTask

    task = AdaptTask(options.inputs, options.model, options.teacher, options.sure, tiles.options_of(options))
    with tiles.interruptible():
        print_messages(*task.run())
    if Path(options.model).is_file():
        print(load_model(options.model))


def _accuracy(options: argparse.Namespace) -> None:
    from ..pipeline.accuracy_files import compare_files

    if options.objects:
        _compare_objects(options)
        return
    if options.area:
        raise StageError("--area needs --objects", found=options.area)
    if options.reference and options.model:
        raise StageError("--reference and --model exclude each other", found=options.model)
    other = "Classification" if options.reference or options.model else "Reference"
    outputs = {k: v for k in ("json", "html") if (v := getattr(options, k))}
    print_messages(
        *compare_files(
            options.inputs,
            options.reference or (),
            options.dimension,
            options.reference_dimension or other,
            options.overrides,
            options.model or "",
            **outputs,
        )
    )


def _compare_objects(options: argparse.Namespace) -> None:
    """``accuracy town.gpkg --objects reference.gpkg``."""
    from ..base.files import write_whole
    from ..objects.compare import compare_objects, remarks, table, to_json

    if len(options.inputs) != 1 or options.reference or options.overrides or options.html:
        raise StageError(
            "--objects compares one vector file with another, and takes --area and --json alone",
            found=options.html or ", ".join(options.inputs),
        )
    found, reference = options.inputs[0], options.objects
    outputs = [Output(options.json, "json", JSON)] if options.json else []
    check_outputs(outputs, [found, reference, *([options.area] if options.area else [])])
    figures, one, two = compare_objects(found, reference, options.area)
    print(table(figures), end="")
    print_messages(*remarks(one, two))
    if options.json:
        write_whole(options.json, (json.dumps(to_json(figures), indent=1) + "\n").encode(), "json")


def _model(options: argparse.Namespace) -> None:
    from ..classifier.model import load_model

    model = load_model(options.file)
    if options.showjson:
        print(json.dumps(model.describe(), indent=2, default=str))
    else:
        print(model)
