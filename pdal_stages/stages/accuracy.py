"""``filters.accuracy``: compare a class dimension with a reference, report figures [B16 4.3, W18 4.3]."""

from __future__ import annotations

import json
import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..accuracy.labels import code_list, merging
from ..accuracy.measures import Accuracy
from ..base import kinds
from ..base.errors import StageError
from ..base.files import check_writable, write_whole
from ..base.outputs import Output
from .base import Stage
from .modelclassifier import loaded_model
from .options import option
from .points import Points

#: Options that the report lists.
_SHOWN = ("dimension", "reference", "classes", "ignore", "merge", "where")


class AccuracyStage(Stage):
    type = "filters.accuracy"
    summary = "Compare a class dimension with a reference dimension; report as table, JSON and HTML"
    source = "[B16] section 4.3, [W18] section 4.3"
    instead_of_tiles = (
        "Write the files first, then compare them: pdal-stages accuracy FILE --reference-dimension Reference"
    )
    where_help = "Only points inside are compared."
    dimension: str = option("string", "Classification", "The classes to judge")
    reference: str = option("string", "Reference", "The true classes, e.g. kept with filters.ferry")
    classes: list = option("list", (), "Reference codes to compare; default: every one found")
    ignore: list = option(
        "list",
        (0, 1),
        "Reference codes left out (and counted); where 'classes' is given, only those left out by it",
        may_be_empty=True,
    )
    merge: dict | None = option("mapping", None, 'Classes taken as one on both sides: {"5": [3, 4]}')
    json: str | None = option("filename", None, "Write the figures to this JSON file")
    html: str | None = option("filename", None, "Write a report with maps to this HTML file")
    title: str = option("string", "Classification accuracy", "Heading of the report")
    model_file: str | None = option(
        "filename", None, "Model file whose importances the report shows", name="model"
    )
    print_table: bool = option("boolean", True, "Print the table on standard error", name="print")
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

    def check(self) -> None:
        for name in ("classes", "ignore"):
            code_list(_codes(self.options[name]), name)
        merging(self.merge)
        for output in self.outputs():
            check_writable(output.path, output.what, output.kind)
        if self.model_file:
            loaded_model(self.model_file)

    def outputs(self) -> list[Output]:
        found = [(self.json, "json", kinds.JSON), (self.html, "html", kinds.HTML)]
        return [Output(path, what, kind) for path, what, kind in found if path]

    def reads(self) -> list[str]:
        return [self.dimension, self.reference]

    def run(self, points: Points) -> dict[str, NDArray]:
        if points.count == 0:
            raise StageError(
                "there are no points to compare",
                cure="Check the reader's file and the filters before this stage",
            )
        inside = slice(None) if points.mask is None else points.mask
        reference = points.codes_of(self.reference)[inside]
        predicted = points.codes_of(self.dimension)[inside]
        graded = {
            name.lower(): np.asarray(points.arrays[name])[inside]
            for name in ("Reliability", "Margin")
            if name in points.arrays
        }
        accuracy = Accuracy.from_labels(
            reference,
            predicted,
            classes=_codes(self.classes) or None,
            ignore=[] if self.classes else _codes(self.ignore),
            merge=self.merge,
            reliability=graded.get("reliability"),
            margin=graded.get("margin"),
        )
        if self.print_table:
            print(accuracy.table(), file=sys.__stderr__ or sys.stderr)
        if self.json:
            write_whole(self.json, (json.dumps(accuracy.to_dict(), indent=1) + "\n").encode())
        if self.html:
            self._write_page(self.html, accuracy, points.xyz[inside], reference, predicted)
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

    def _write_page(
        self, path: str, accuracy: Accuracy, xyz: NDArray, reference: NDArray, predicted: NDArray
    ) -> None:
        from ..reports.accuracypage import write_accuracy_report

        settings: dict[str, Any] = {k: v for k, v in self.options.items() if k in _SHOWN}
        importances = None
        if self.model_file:
            importances = loaded_model(self.model_file).importances("column")
            settings["model"] = self.model_file
        write_accuracy_report(
            path,
            accuracy,
            xyz=xyz,
            reference=reference,
            predicted=predicted,
            title=self.title,
            importances=importances,
            settings=settings,
        )


def _codes(given: list) -> list:
    """Numbers for text that holds whole numbers; what else there is, is refused where codes are checked."""
    return [int(text) if (text := str(v).strip()).lstrip("-").isdigit() else v for v in given]
