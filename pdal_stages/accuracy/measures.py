"""Accuracy of a classification against reference labels: confusion matrix and all measures of it.

Measures of [B16] section 4.3 and [W18] section 4.3: overall accuracy, Cohen's kappa, mean class recall
and precision, per-class recall, precision, F1, and mean F1; intersection over union beside them.

Rules for what is not defined, so that no figure is ever NaN:

- Means are over the classes present in the reference.
- A class present in the reference that was never predicted has precision 0 and F1 0.
- A class with no reference points (named in `classes`, or predicted only) has recall None; its
  precision, where it was predicted, is 0.
- Kappa is None where chance alone would agree on everything (one class, predicted throughout).
- A predicted class that is not a class of the reference (1 where points were rejected, say) gets a column
  of its own, and its points count as errors.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.asprs import UNINFORMATIVE, class_name
from ..base.errors import StageError
from .calibration import Grading
from .labels import (
    CHUNK,
    Merge,
    as_codes,
    class_names,
    code_list,
    pair_counts,
    regroup,
    same_length,
)
from .text import table

FORMAT = "pdal-stages accuracy"
VERSION = 1


@dataclass(frozen=True)
class ClassFigures:
    """The figures of one class; shares are between 0 and 1, None where they are not defined."""

    code: int
    name: str
    support: int  #: reference points
    predicted: int  #: points given this class
    correct: int
    recall: float | None
    precision: float | None
    f1: float | None
    iou: float | None


@dataclass(frozen=True, eq=False)
class Accuracy:
    """A confusion matrix and the measures drawn from it.

    Make one with :meth:`from_labels` or :meth:`from_confusion`. Two of them add (tiles), and
    ``sum(tiles)`` works.
    """

    classes: tuple[int, ...]  #: codes of the matrix's rows: the classes of the reference, ascending
    #: of the columns after those: classes that were predicted but are not in the reference
    extra: tuple[int, ...]
    matrix: npt.NDArray[
        np.int64
    ]  #: (K, K + E) points; rows are the reference, columns the prediction
    names: Mapping[int, str] = field(default_factory=dict)
    #: reference points that were not compared, by their reference class before any merge
    left_out: Mapping[int, int] = field(default_factory=dict)
    reliability: Grading | None = None  #: how well it separates right from wrong
    margin: Grading | None = None
    #: classes that were taken as another one on both sides
    merged: Mapping[int, int] = field(default_factory=dict)

    @classmethod
    def from_labels(
        cls,
        reference: npt.ArrayLike,
        predicted: npt.ArrayLike,
        classes: Iterable[int] | None = None,
        names: Mapping[int, str] | None = None,
        ignore: Iterable[int] | None = None,
        reliability: npt.ArrayLike | None = None,
        margin: npt.ArrayLike | None = None,
        merge: Mapping[Any, Any] | None = None,
        allow_empty: bool = False,
    ) -> Accuracy:
        """Compare two label arrays.

        Parameters
        ----------
        reference, predicted : (n,) arrays
            Class codes, whole numbers from 0 to 65535.
        classes : iterable of int, optional
            Classes of the reference to compare, after merging; points of any other class are left out and counted.
            By default every class found.
        names : mapping, optional
            Code to name, where it is not ASPRS's own.
        ignore : iterable of int, optional
            Reference codes, before merging, whose points are left out and counted. By default those that training
            leaves out as well: 0 and 1 (unclassified), 7 and 18 (noise) and 12 (overlap); none where `classes` is
            given.
        reliability, margin : (n,) arrays, optional
            Winning probability, and winning minus second, both from 0 to 1.
        merge : mapping, optional
            Classes to take as one, on both sides: ``{5: [3, 4]}``.
        allow_empty : bool
            Whether no point to compare is allowed (a tile without reference points, to be added to others).

        Raises
        ------
        StageError
            Arrays of different lengths, labels that are not class codes, or nothing left to compare.
        """
        ref, pred = as_codes(reference, "reference"), as_codes(predicted, "prediction")
        given = {"reliability": reliability, "margin": margin}
        confidences = {key: np.asarray(v).reshape(-1) for key, v in given.items() if v is not None}
        same_length(ref, {"prediction": pred, **confidences})

        merged = Merge.parse(merge)
        found, found_predicted, counts = pair_counts(ref, pred)
        if ignore is None:
            ignore = UNINFORMATIVE if classes is None else ()
        kept = ~np.isin(found, code_list(ignore, "ignore"))
        if classes is None:
            rows = tuple(np.unique(merged.target_of[found[kept]]).tolist())
        else:
            rows = tuple(sorted(set(code_list(classes, "classes"))))
            kept &= np.isin(merged.target_of[found], rows)
        points = dict(zip(found.tolist(), counts.sum(axis=1).tolist(), strict=True))
        left = {code: points[code] for code in found[~kept].tolist()}
        if not allow_empty and not kept.any():
            listed = ", ".join(f"{code}: {n:,}" for code, n in list(points.items())[:12])
            raise StageError(
                "no point to compare: every reference point is left out"
                if left
                else "no point to compare",
                found=f"reference classes {listed}{', ...' * (len(points) > 12)}"
                if points
                else "0 points",
                cure="Name classes the reference has, or ignore fewer" if left else None,
            )
        counts = counts[kept]
        given_to = counts.any(axis=0)
        of_rows, of_columns = (
            merged.target_of[found[kept]],
            merged.target_of[found_predicted[given_to]],
        )
        columns, matrix = regroup(rows, (counts[:, given_to], of_rows, of_columns))

        compared = np.isin(np.arange(len(merged.target_of)), found[kept])
        graded = {key: Grading.empty() for key in confidences}
        for start in range(0, len(ref) if graded else 0, CHUNK):
            part = slice(start, start + CHUNK)
            chosen = compared[ref[part]]
            right = merged.target_of[ref[part][chosen]] == merged.target_of[pred[part][chosen]]
            for key, values in confidences.items():
                graded[key] += Grading.from_values(values[part][chosen], right, key)
        return cls(
            rows,
            columns[len(rows) :],
            matrix,
            class_names((*columns, *left), {**merged.names, **(names or {})}),
            left,
            graded.get("reliability"),
            graded.get("margin"),
            merged.changed,
        )

    @classmethod
    def from_confusion(cls, matrix: npt.ArrayLike, classes: Sequence[int]) -> Accuracy:
        """Take a confusion matrix as it is: whole numbers, rows are the reference, columns the prediction."""
        rows, counts = code_list(classes, "classes"), np.asarray(matrix)
        if counts.shape != (len(rows), len(rows)) or len(set(rows)) != len(rows) or not rows:
            raise StageError(
                "the confusion matrix does not fit its classes",
                found=f"shape {counts.shape} for classes {rows}",
                cure="Give one row and one column per class",
            )
        whole = counts.astype(np.int64)
        if (whole != counts).any() or (whole < 0).any():
            raise StageError("a confusion matrix holds counts: whole numbers of 0 or more")
        columns, whole = regroup(sorted(rows), (whole, rows, rows))
        return cls(columns, (), whole, class_names(columns, None))

    def __add__(self, other: Accuracy) -> Accuracy:
        if not isinstance(other, Accuracy):
            return NotImplemented
        rows = tuple(sorted(set(self.classes) | set(other.classes)))
        tables = ((one.matrix, one.classes, one.columns) for one in (self, other))
        columns, matrix = regroup(rows, *tables)
        left = {
            c: self.left_out.get(c, 0) + other.left_out.get(c, 0)
            for c in sorted(set(self.left_out) | set(other.left_out))
        }
        # A code that others were merged into may be both: its own points left out, theirs compared.
        if clash := sorted(set(left) & set(rows) - set(self.merged.values())):
            raise StageError(
                "two accuracies do not add: one compares a class that the other leaves out",
                found=f"class {clash[0]}",
                cure="Compare both with the same 'classes' and 'ignore'",
            )
        if self.merged != other.merged and self.points and other.points:
            raise StageError(
                "two accuracies do not add: they merge different classes",
                found=f"{dict(self.merged)} and {dict(other.merged)}",
                cure="Compare both with the same 'merge'",
            )
        # An empty tile has nothing to grade; anything else that lacks one would make it a curve of some points.
        graded: dict[str, Grading | None] = {}
        for key in ("reliability", "margin"):
            parts = [
                getattr(one, key)
                for one in (self, other)
                if one.points or getattr(one, key) is not None
            ]
            graded[key] = None if None in parts or not parts else sum(parts[1:], parts[0])
        return Accuracy(
            rows,
            columns[len(rows) :],
            matrix,
            {**other.names, **self.names},
            left,
            graded["reliability"],
            graded["margin"],
            {**other.merged, **self.merged},
        )

    def __radd__(self, other: object) -> Accuracy:
        return self if other == 0 else NotImplemented  # sum() starts with 0

    def __repr__(self) -> str:
        what = f"overall_accuracy={self.overall_accuracy:.4f}" if self.points else "empty"
        return f"<Accuracy of {self.points:,} points, classes {list(self.classes)}: {what}>"

    @property
    def columns(self) -> tuple[int, ...]:
        """Codes of the matrix's columns."""
        return self.classes + self.extra

    @cached_property
    def points(self) -> int:
        """Points compared."""
        return int(self.matrix.sum())

    @cached_property
    def correct(self) -> int:
        """Points whose class is right."""
        return int(np.trace(self.matrix))

    @property
    def left_out_points(self) -> int:
        """Points with a reference class that is not compared."""
        return sum(self.left_out.values())

    @cached_property
    def extra_points(self) -> int:
        """Points given a class the reference does not have."""
        return int(self.matrix[:, len(self.classes) :].sum())

    @cached_property
    def by_reference(self) -> npt.NDArray[np.float64]:
        """Each row as shares of the reference class: its diagonal is recall. Empty rows are 0."""
        total = self.matrix.sum(axis=1, keepdims=True)
        return np.divide(self.matrix, total, out=np.zeros(self.matrix.shape), where=total > 0)

    def _checked(self) -> None:
        if self.points == 0:
            raise StageError("no point was compared, so there is no accuracy", found="0 points")

    @property
    def overall_accuracy(self) -> float:
        """Share of points whose class is right."""
        self._checked()
        return self.correct / self.points

    @property
    def kappa(self) -> float | None:
        """Cohen's kappa: agreement beyond chance; None where chance agrees on everything."""
        self._checked()
        n, k = self.points, len(self.classes)
        rows = [int(v) for v in self.matrix.sum(axis=1)]
        columns = [int(v) for v in self.matrix.sum(axis=0)[:k]]
        chance = sum(r * c for r, c in zip(rows, columns, strict=True))  # exact whole numbers
        return (self.correct * n - chance) / (n * n - chance) if chance != n * n else None

    #: MCR and MCP [B16], mean F1 [W18], mean intersection over union: unweighted means of the classes'.
    mean_class_recall = property(lambda self: self._mean("recall"))
    mean_class_precision = property(lambda self: self._mean("precision"))
    mean_f1 = property(lambda self: self._mean("f1"))
    mean_iou = property(lambda self: self._mean("iou"))

    def _mean(self, name: str) -> float:
        self._checked()
        values = [getattr(f, name) for f in self.per_class if f.support]
        return float(sum(0.0 if v is None else v for v in values) / len(values))

    @cached_property
    def per_class(self) -> tuple[ClassFigures, ...]:
        """The figures of every class of the reference."""
        figures = []
        for i, code in enumerate(self.classes):
            support, given = int(self.matrix[i].sum()), int(self.matrix[:, i].sum())
            hit = int(self.matrix[i, i])
            figures.append(
                ClassFigures(
                    code=code,
                    name=self.name(code),
                    support=support,
                    predicted=given,
                    correct=hit,
                    recall=hit / support if support else None,
                    precision=hit / given if given else (0.0 if support else None),
                    f1=2 * hit / (support + given) if support + given else None,
                    iou=hit / (support + given - hit) if support + given else None,
                )
            )
        return tuple(figures)

    def _by_class(self, name: str) -> dict[int, Any]:
        return {f.code: getattr(f, name) for f in self.per_class}

    #: Class code to recall (completeness), precision (correctness), F1, intersection over union, reference points.
    recall = property(lambda self: self._by_class("recall"))
    precision = property(lambda self: self._by_class("precision"))
    f1 = property(lambda self: self._by_class("f1"))
    iou = property(lambda self: self._by_class("iou"))
    support = property(lambda self: self._by_class("support"))

    def confusions(self, most: int) -> list[tuple[int, int, int]]:
        """The errors, largest first: reference class, predicted class, points; for the page's template."""
        k = len(self.classes)
        wrong = self.matrix.copy()
        wrong[np.arange(k), np.arange(k)] = 0
        i, j = np.nonzero(wrong)
        order = np.argsort(-wrong[i, j], kind="stable")[:most]
        pairs = zip(i[order], j[order], strict=True)
        return [(self.classes[a], self.columns[b], int(wrong[a, b])) for a, b in pairs]

    def name(self, code: int) -> str:
        """A class's name."""
        return self.names.get(code) or class_name(code)

    def to_dict(self) -> dict[str, Any]:
        """Everything as JSON types; ``accuracy-1.json`` describes it."""

        def described(codes: Iterable[int]) -> list[dict[str, Any]]:
            return [{"code": c, "name": self.name(c)} for c in codes]

        return {
            "format": FORMAT,
            "version": VERSION,
            "points": self.points,
            "correct": self.correct,
            "left_out": {
                "points": self.left_out_points,
                "by_class": {str(c): n for c, n in self.left_out.items()},
            },
            "merged": {str(c): t for c, t in sorted(self.merged.items())},
            "predicted_outside_reference": {
                "points": self.extra_points,
                "classes": described(self.extra),
            },
            "overall_accuracy": self.overall_accuracy,
            "kappa": self.kappa,
            "mean_class_recall": self.mean_class_recall,
            "mean_class_precision": self.mean_class_precision,
            "mean_f1": self.mean_f1,
            "mean_iou": self.mean_iou,
            "classes": [dict(vars(f)) for f in self.per_class],
            "confusion": {
                "rows": described(self.classes),
                "columns": described(self.columns),
                "counts": self.matrix.tolist(),
                "by_reference": self.by_reference.tolist(),
            },
            "reliability": self.reliability.to_dict("curve") if self.reliability else None,
            "margin": self.margin.to_dict("deciles") if self.margin else None,
        }

    def table(self) -> str:
        """The figures as aligned text, in percent."""
        return table(self.to_dict(), self.name)
