"""``filters.accuracy``: compare a class dimension with a reference, report figures [B16 4.3, W18 4.3]."""

from __future__ import annotations

import json
import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..accuracy.measures import Accuracy
from ..base.errors import StageError
from ..base.files import check_writable, write_whole
from .base import Stage
from .options import Option
from .points import Points

#: Options that the report lists.
_SHOWN = ("dimension", "reference", "classes", "ignore", "merge", "where")


class AccuracyStage(Stage):
    type = "filters.accuracy"
    summary = "Compare a class dimension with a reference dimension; report as table, JSON and HTML"
    source = "[B16] section 4.3, [W18] section 4.3"
    where_help = "Only points inside are compared."
    options = (
        Option("dimension", "string", "Classification", "The classes to judge"),
        Option("reference", "string", "Reference", "The true classes, e.g. kept with filters.ferry"),
        Option("classes", "list", (), "Reference codes to compare; default: every one found"),
        Option(
            "ignore",
            "list",
            (0, 1),
            "Reference codes left out (and counted); where 'classes' is given, only those left out by it",
            may_be_empty=True,
        ),
        Option("merge", "mapping", None, 'Classes taken as one on both sides: {"5": [3, 4]}'),
        Option("json", "filename", None, "Write the figures to this JSON file"),
        Option("html", "filename", None, "Write a report with maps to this HTML file"),
        Option("title", "string", "Classification accuracy", "Heading of the report"),
        Option("model", "filename", None, "Model file whose importances the report shows"),
        Option("print", "boolean", True, "Print the table on standard error"),
    )
    details = """
Prints the table of overall accuracy, kappa, mean class recall and precision, mean F1 and the figures of each class
on standard error; `json` and `html` write them to files. Keep the labels before classifying with
`{"type": "filters.ferry", "dimensions": "Classification=>Reference"}`. Dimensions `Reliability` and `Margin`, where
present, add a reliability curve and the error by margin.
"""
    before = (
        {"type": "filters.ferry", "dimensions": "Classification=>Reference"},
        {"type": "filters.hag_minima"},
        {"type": "filters.modelclassifier", "model": "town.model"},
    )
    after = ()
    example = {
        "type": "filters.accuracy",
        "reference": "Reference",
        "json": "accuracy.json",
        "html": "accuracy.html",
    }

    @classmethod
    def check(cls, options: dict[str, Any]) -> None:
        from ..accuracy.labels import code_list, merging

        for name in ("classes", "ignore"):
            code_list([_number(c) for c in options[name]], name)
        merging(options["merge"])
        for name in ("json", "html"):
            if options[name]:
                check_writable(options[name], name)
        if options["model"]:
            from ..classifier import load_model

            load_model(options["model"])

    @classmethod
    def reads(cls, options: dict[str, Any]) -> list[str]:
        return [options["dimension"], options["reference"]]

    @classmethod
    def run(cls, points: Points, options: dict[str, Any]) -> dict[str, NDArray]:
        if points.count == 0:
            raise StageError(
                "there are no points to compare",
                cure="Check the reader's file and the filters before this stage",
            )
        classes = [_number(c) for c in options["classes"]]
        ignore = [] if classes else [_number(c) for c in options["ignore"]]
        inside = slice(None) if points.mask is None else points.mask
        reference = points.codes_of(options["reference"])[inside]
        predicted = points.codes_of(options["dimension"])[inside]
        graded = {
            name.lower(): np.asarray(points.arrays[name])[inside]
            for name in ("Reliability", "Margin")
            if name in points.arrays
        }
        accuracy = Accuracy.from_labels(
            reference,
            predicted,
            classes=classes or None,
            ignore=ignore,
            merge=options["merge"],
            reliability=graded.get("reliability"),
            margin=graded.get("margin"),
        )
        figures = accuracy.to_dict()
        if options["print"]:
            print(accuracy.table(), file=sys.__stderr__ or sys.stderr)
        if options["json"]:
            write_whole(options["json"], (json.dumps(figures, indent=1) + "\n").encode())
        if options["html"]:
            _report(points, inside, reference, predicted, accuracy, options)
        points.report.update(
            {
                "compared": accuracy.points,
                "left_out": accuracy.left_out_points,
                "overall_accuracy": accuracy.overall_accuracy,
                "kappa": accuracy.kappa,
                "mean_class_recall": accuracy.mean_class_recall,
                "mean_class_precision": accuracy.mean_class_precision,
                "mean_f1": accuracy.mean_f1,
            }
        )
        return {}


def _report(points, inside, reference, predicted, accuracy: Accuracy, options: dict[str, Any]) -> None:
    from ..reports.accuracypage import write_accuracy_report

    importances = None
    settings: dict[str, Any] = {k: v for k, v in options.items() if k in _SHOWN}
    if options["model"]:
        from ..classifier import load_model

        model = load_model(options["model"])
        importances = model.importances("column")
        settings["model"] = options["model"]
    write_accuracy_report(
        options["html"],
        accuracy,
        xyz=points.xyz[inside],
        reference=reference,
        predicted=predicted,
        title=options["title"],
        importances=importances,
        settings=settings,
    )


def _number(value: Any) -> Any:
    text = str(value).strip()
    return int(text) if text.lstrip("-").isdigit() else value
