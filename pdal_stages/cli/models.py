"""Commands about models: train, score and describe them."""

from __future__ import annotations

import argparse
import contextlib
import json
from pathlib import Path

from ..base.messages import Topic, print_messages
from .parser import INPUTS, Parser, add_stage_options, stage_options
from .tiled_runs import sigterm_like_ctrl_c

#: Options of ``writers.classifiermodel`` that ``train`` has flags for.
_TRAINING_OPTIONS = (
    "recipe", "base", "passes", "classes", "neighborhoods", "feature_set", "count", "trees",
)  # fmt: skip


def add_commands(parser: Parser) -> None:
    """Add ``models``, ``train``, ``accuracy`` and ``model``."""
    parser.command("models", _models, "List the models that come with the package")

    rare = ("neighborhoods", "feature_set", "count", "trees", "passes")
    what = "Train a model on labeled point clouds"
    add = parser.command("train", _train, what, overrides=True, progress=True, rare=rare)
    add("inputs", nargs="+", metavar="input", help=INPUTS)
    add("--model", required=True, help="Model file to write")
    add_stage_options(add, "writers.classifiermodel", *_TRAINING_OPTIONS)
    surveys = "Files of one survey, north=north/*.laz; any other file counts as a survey by itself"
    add("--surveys", nargs="*", metavar="NAME=PATTERN", help=surveys)

    what = "Compare classes with a reference"
    add = parser.command("accuracy", _accuracy, what, overrides=True, progress=True)
    add("inputs", nargs="+", metavar="input", help=INPUTS)
    reference = "True classes: the same points in their order"
    add("--reference", action="append", metavar="FILE", help=reference)
    dimension = "Dimension to score (Classification)"
    add("--dimension", default="Classification", metavar="NAME", help=dimension)
    add("--reference-dimension", metavar="NAME", help="Dimension with the true classes")
    add("--json", metavar="FILE", help="Write the figures to a JSON file")
    add("--html", metavar="FILE", help="Write a report to a web page")

    add = parser.command("model", _model, "Describe a model file")
    add("file", help="A model file or a shipped model")
    add("--showjson", action="store_true", help="Print all of it as JSON")


def _models(options: argparse.Namespace) -> None:
    from ..base.asprs import class_name
    from ..classifier.model import load_model
    from ..classifier.model_file import shipped

    for name, path in shipped().items():
        model = load_model(path)
        classes = ", ".join(f"{code} {class_name(code)}" for code, _ in model.classes)
        print(f"{name:12s} {classes}; {path}")


def _train(options: argparse.Namespace) -> None:
    from ..classifier.model import load_model
    from ..pipeline.inputs_outputs import input_files
    from ..tiling.train_survey import TrainTask, surveys_of

    files = input_files(options.inputs)
    surveys = {} if options.surveys is None else surveys_of(files, options.surveys)
    task = TrainTask(
        files,
        options.model,
        options.overrides,
        stage_options(options, *_TRAINING_OPTIONS),
        surveys,
        named=options.inputs,
    )
    with sigterm_like_ctrl_c():
        messages = task.run()
    # A model that was written into a pipe or device is not described.
    text = str(load_model(options.model)) if Path(options.model).is_file() else ""
    print_messages(*(m for m in messages if not text or m.topic is not Topic.SCORE))
    if text:
        print(text)


def _accuracy(options: argparse.Namespace) -> None:
    from ..pipeline.accuracy_files import compare_files

    other = "Classification" if options.reference else "Reference"
    dimensions = options.dimension, options.reference_dimension or other
    outputs = {k: v for k in ("json", "html") if (v := getattr(options, k))}
    files = options.inputs, options.reference or ()
    print_messages(*compare_files(*files, *dimensions, options.overrides, **outputs))


def _model(options: argparse.Namespace) -> None:
    from ..base.errors import OptionError
    from ..classifier.calibration import read_calibration
    from ..classifier.model import load_model
    from ..classifier.model_file import find

    model = load_model(options.file)
    with contextlib.suppress(OptionError):  # it was never scored
        model.info["sureness"] = read_calibration(model.info, find(options.file)).to_dict()
    if options.showjson:
        print(json.dumps(model.manifest(), indent=2))
    else:
        print(model)
