"""``filters.accuracy``: compare a class dimension with a reference [B16 4.3, W18 4.3]."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..accuracy.labels import Merge
from ..accuracy.measures import Accuracy
from ..accuracy.text import by_file, summary
from ..base.asprs import HIGH_VEGETATION, LOW_VEGETATION, MEDIUM_VEGETATION, UNINFORMATIVE
from ..base.dimensions import RELIABILITY
from ..base.errors import StageError
from ..base.files import HTML, JSON, Output, whole_files
from ..base.json_types import JsonObject, StageJson
from ..base.messages import Report, plain
from ..base.units import name_of_wkt
from ..classifier.model import loaded_model
from ..classifier.model_info import ClassInfo
from .apply_model import ApplyModel
from .base import Stage, StageContext, files_read
from .options import Selection, option
from .points import Points

#: Classes that count as HIGH_VEGETATION where vegetation is one class.
LOWER = (LOW_VEGETATION, MEDIUM_VEGETATION)


class Sides(NamedTuple):
    """Classes of points on both sides, reliabilities, and which of the given points these are."""

    reference: NDArray
    predicted: NDArray
    reliability: NDArray | None
    inside: NDArray


class AccuracyStage(Stage):
    """Compare classes with a reference; the figures go to tables, JSON and HTML."""

    type = "filters.accuracy"
    summary = "Compare a class dimension with a reference dimension; report as table, JSON and HTML"
    source = "[B16] section 4.3, [W18] section 4.3"
    instead_of_tiles = (
        "Write the files first, then compare them: "
        "pdal-stages accuracy FILE --reference-dimension Reference"
    )
    where_help = "Only points inside are compared"
    needs_points = "compare"
    optional_dimensions = (RELIABILITY.name,)
    dimension: str = option("string", "Classification", "The classes to judge")
    reference: str = option("string", "Reference", "The true classes, e.g. kept with filters.ferry")
    classes: list[int] = option(
        "codes",
        (),
        "Reference classes to compare, after merging; default: those of the model, or else every "
        "one found",
    )
    ignore: Selection | None = option(
        "selection",
        None,
        "Points left out and counted: reference codes (before merging), ranges of other "
        "dimensions, or the word withheld; default: withheld, and "
        f"{', '.join(map(str, UNINFORMATIVE))} where neither 'classes' nor a model says what "
        "counts",
        may_be_empty=True,
    )
    merge: dict | None = option(
        "mapping",
        None,
        'Classes taken as one on both sides, {"5": [3, 4]}; default: as the model was trained',
    )
    json: str | None = option("filename", None, "Write the figures to this JSON file")
    html: str | None = option("filename", None, "Write a report with maps to this HTML file")
    model_file: str | None = option(
        "model",
        None,
        "Model file whose classes are scored and whose importances the report shows; default: "
        "that of the filters.modelclassifier before",
        name="model",
    )
    files: list[str] = option(
        "list", (), "Files that the report names; default: those of the readers"
    )
    print_table: bool = option("boolean", True, "Print the table on standard output", name="print")

    @classmethod
    def from_pipeline(
        cls, raw_options: Mapping[str, object], before: Sequence[StageJson]
    ) -> JsonObject:
        """Return options that follow from the stages before."""
        taken: JsonObject = {"files": files_read(before)}
        models = [s["model"] for s in before if s.get("type") == ApplyModel.type and "model" in s]
        if models and raw_options.get("dimension", "Classification") == "Classification":
            taken["model"] = models[-1]
        return taken

    def check(self) -> None:
        """Refuse options that contradict each other."""
        Merge.parse(self.merge)
        if self.model_file:
            loaded_model(self.model_file)

    def outputs(self) -> list[Output]:
        """Return the files that are written."""
        files = [(self.json, "json", JSON), (self.html, "html", HTML)]
        return [Output(path, what, kind) for path, what, kind in files if path]

    def reads(self) -> list[str]:
        """Return the dimensions that the points must have."""
        return [self.dimension, self.reference]

    def run(self, points: Points, context: StageContext) -> dict[str, NDArray]:
        """Compare the classes of the points and write what is asked for."""
        self.compare([("", points)], points.report)
        return {}

    def compare(self, parts: Sequence[tuple[str, Points]], report: Report) -> None:
        """Compare the points of several files: a table of each, and one of all together."""
        sides = [self._sides(points) for _, points in parts]
        rule = self._rule(sides, report)
        rule["allow_empty"] = len(parts) > 1
        each = [
            Accuracy.from_labels(
                side.reference, side.predicted, **rule, reliability=side.reliability
            )
            for side in sides
        ]
        accuracy = each[0] if len(each) == 1 else sum(each[1:], each[0])
        if not accuracy.points:
            raise StageError("no point to compare: every reference point of all files is left out")
        if self.print_table:
            out = sys.__stdout__ or sys.stdout
            if len(each) > 1:
                print(plain(by_file([name for name, _ in parts], each)), file=out)
            print(plain(accuracy.table()), file=out)
        with whole_files(*(output.path for output in self.outputs())) as files:
            if self.json:
                written = accuracy.to_dict()
                if len(each) > 1:
                    named = zip(parts, each, strict=True)
                    written["files"] = [{"name": name, **summary(a)} for (name, _), a in named]
                if batches := self._batches(parts, sides, accuracy):
                    written["batches"] = batches
                files[0].write_bytes((json.dumps(written, indent=1) + "\n").encode())
            if self.html:
                self._write_page(files[-1], parts, sides, accuracy, rule)
        figures = summary(accuracy)
        report.figures |= {
            "compared": figures.pop("points"),
            "left_out": accuracy.left_out_points,
            **figures,
            "mean_class_recall": accuracy.mean_class_recall,
            "mean_class_precision": accuracy.mean_class_precision,
        }

    def _batches(
        self, parts: Sequence[tuple[str, Points]], sides: Sequence[Sides], accuracy: Accuracy
    ) -> list[StageJson]:
        """Return the accuracy within each batch of a network, at its center [WM19 Figure 3]."""
        out: list[StageJson] = []
        if not self.model_file:
            return out
        model = loaded_model(self.model_file)
        for (name, points), side in zip(parts, sides, strict=True):
            compared, right = np.zeros((2, len(points.xyz)), bool)
            compared[side.inside], wrong = accuracy.verdicts(side.reference, side.predicted)
            right[side.inside] = ~wrong
            right &= compared
            for center, rows in model.batches(points.xyz):
                if count := int(compared[rows].sum()):
                    x, y = (center / points.units.horizontal).tolist()
                    share = int(right[rows].sum()) / count
                    place = {"x": x, "y": y, "points": count, "overall_accuracy": share}
                    out.append({"name": name, **place} if name else place)
        return out

    def _sides(self, points: Points) -> Sides:
        """Return the classes of both sides, of the points that are compared."""
        chosen = Selection.parse(["withheld"], "ignore") if self.ignore is None else self.ignore
        inside = points.usable(replace(chosen, codes=()))  # codes are of the reference
        reliability = None if points.reliability is None else points.reliability[inside]
        reference, predicted = (
            points.codes_of(n)[inside] for n in (self.reference, self.dimension)
        )
        return Sides(reference, predicted, reliability, inside)

    def _rule(self, sides: Sequence[Sides], report: Report) -> JsonObject:
        """Return `classes`, `ignore`, `merge` and `names` of :meth:`Accuracy.from_labels`."""
        ignore = None if self.ignore is None else list(self.ignore.codes)
        rule: JsonObject = {"classes": self.classes or None, "ignore": ignore, "names": None}
        rule["merge"] = self.merge
        known: list[int] | None = None
        if self.model_file:
            trained = loaded_model(self.model_file).info["classes"]
            known = [c["code"] for c in trained]
            rule["names"] = {c["code"]: c["name"] for c in trained}
            if not self.classes:
                if self.merge is None and _one_code_system(trained):
                    rule["merge"] = {c["code"]: c["labels"] for c in trained}
                target = Merge.parse(rule["merge"]).target_of
                rule["classes"] = sorted({int(target[code]) for code in known})
                if self.ignore is None and rule["merge"] is not None:
                    # A class's code need not be one of its labels: 1 is the background, or
                    # unclassified.
                    labels = {label for c in trained for label in c["labels"]}
                    rule["ignore"] = [code for code in known if code not in labels]
        if self.merge is not None or self.classes:
            return rule
        # Vegetation is one class where only one was predicted.
        true = {code for side in sides for code in np.unique(side.reference).tolist()}
        predicted = {code for side in sides for code in np.unique(side.predicted).tolist()}
        target = Merge.parse(rule["merge"]).target_of
        parts = [code for code in LOWER if code in true and target[code] == code]
        if (
            parts
            and HIGH_VEGETATION in (predicted if known is None else known)
            and not {*LOWER} & {*(known or ()), *predicted}
            and target[HIGH_VEGETATION] == HIGH_VEGETATION
        ):
            rule["merge"] = {
                **(rule["merge"] or {}),
                HIGH_VEGETATION: sorted({HIGH_VEGETATION, *LOWER}),
            }
            report.note(
                "vegetation is one class, 5, in what is judged: of the reference "
                f"{' and '.join(map(str, parts))} count as "
                "5, too. To compare them as they are: --filters.accuracy.merge='{}'"
            )
        return rule

    def _write_page(
        self,
        path: Path,
        parts: Sequence[tuple[str, Points]],
        sides: Sequence[Sides],
        accuracy: Accuracy,
        rule: JsonObject,
    ) -> None:
        from ..reports.accuracy_page import Place, write_accuracy_report

        wkts = [points.wkt for _, points in parts]
        systems = ", ".join(dict.fromkeys(name_of_wkt(wkt) or "none given" for wkt in wkts))
        settings = {"files": self.files, "reference system": systems, "model": self.model_file}
        described = {name: self.options[name] for name in ("dimension", "reference", "where")}
        settings |= {name: value for name, value in described.items() if value}
        settings |= {k: rule[k] for k in ("classes", "ignore", "merge") if rule[k] is not None}
        model = loaded_model(self.model_file) if self.model_file else None
        importances = None
        if model is not None and model.info["passes"][-1]["importances"]:  # networks have none
            importances = model.importances()
        shown = [
            Place(name, points.xyz[side.inside], side.reference, side.predicted)
            for (name, points), side in zip(parts, sides, strict=True)
            if side.inside.any()
        ]
        write_accuracy_report(
            path,
            accuracy,
            places=shown,
            subtitle="; ".join(map(str, filter(None, [*self.files[:3], systems, self.model_file]))),
            importances=importances,
            settings=settings,
        )


def _one_code_system(trained: Sequence[ClassInfo]) -> bool:
    """Return whether labels and codes of a model mean the same.

    For instance they differ where label 5 became code 6, and label 8 code 5.
    """
    class_of = {label: c["code"] for c in trained for label in c["labels"]}
    return all(class_of.get(c["code"], c["code"]) == c["code"] for c in trained)
