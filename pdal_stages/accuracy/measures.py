"""Accuracy of a classification against reference labels: confusion matrix and all measures of it.

Measures of [B16] section 4.3 and [W18] section 4.3: overall accuracy, Cohen's kappa, mean class
recall and precision, per-class recall, precision, F1, and mean F1; intersection over union beside
them.

Rules for what is not defined, so that no measure is ever NaN:

- Means are over the classes present in the reference.
- A class present in the reference that was never predicted has precision 0 and F1 0.
- A class named in `classes` that has no reference points has recall None; its precision, F1 and
  IoU are 0 where it was predicted, else None.
- Kappa is None where chance alone would agree on everything (one class, predicted throughout).
- A predicted class that is not a class of the reference (1 where points were rejected, say) is in
  `extra`: it has a column of its own and no measures, and its points count as errors.

A new measure is a property of :class:`Accuracy` (or a field of :class:`ClassMeasures`), its entry
of :meth:`Accuracy.to_dict` and of ``accuracy-1.json``, and a line of ``text``, where users read it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.asprs import class_name
from ..base.errors import StageError
from ..base.json_types import JsonObject
from .labels import (
    MAX_LABEL,
    ComparedClasses,
    Merge,
    as_codes,
    code_list,
    pair_counts,
    refuse_other_lengths,
    sum_tables,
)
from .text import table

#: Points graded at a time, which bounds the memory.
CHUNK = 1 << 20
#: Bins of a reliability between 0 and 1.
BINS = 10


@dataclass(frozen=True, eq=False)
class ReliabilityHistogram:
    """Histogram of reliabilities and of the points whose class is right, in ten bins.

    Histograms add, so those of tiles give the measures of the whole.
    """

    count: npt.NDArray[np.int64]  #: (10,) points of each bin
    right: npt.NDArray[np.int64]  #: (10,) points of each bin with the right class
    total: npt.NDArray[np.float64]  #: (10,) sum of the reliability of each bin

    @classmethod
    def from_values(cls, values: npt.ArrayLike, right: npt.ArrayLike) -> ReliabilityHistogram:
        """Return the histogram of reliabilities (n,) and of those whose class is right, (n,) bool.

        Raises
        ------
        StageError
            Where a reliability is not a number between 0 and 1.
        """
        v, is_right = np.asarray(values, dtype=np.float64), np.asarray(right, dtype=bool)
        bad = ~((v >= 0) & (v <= 1 + 1e-6))
        if bad.any():
            raise StageError(
                f"{int(bad.sum()):,} of {len(v):,} values of reliability are not between 0 and 1",
                found=float(v[bad][0]),
                cure="Give the classifier's probabilities, unscaled, for every compared point",
            )
        place = np.minimum((v * BINS).astype(np.int64), BINS - 1)
        return cls(
            np.bincount(place, minlength=BINS),
            np.bincount(place[is_right], minlength=BINS),
            np.bincount(place, weights=v, minlength=BINS).astype(np.float64),
        )

    def __add__(self, other: ReliabilityHistogram) -> ReliabilityHistogram:
        """Return the histogram of both sets of points together."""
        return ReliabilityHistogram(
            self.count + other.count, self.right + other.right, self.total + other.total
        )

    @property
    def points(self) -> int:
        """Number of points."""
        return int(self.count.sum())

    @property
    def mean(self) -> float | None:
        """Mean reliability of all points, None without points."""
        return float(self.total.sum() / self.points) if self.points else None

    def curve(self) -> list[JsonObject]:
        """Return the bins with points: the reliability curve (reliability against share right)."""
        return [
            {
                "lower": k / BINS,
                "upper": (k + 1) / BINS,
                "points": int(self.count[k]),
                "mean": float(self.total[k] / self.count[k]),
                "share_right": float(self.right[k] / self.count[k]),
            }
            for k in np.flatnonzero(self.count).tolist()
        ]

    def expected_calibration_error(self) -> float | None:
        """Return the mean distance of reliability and share right, over bins weighted by points.

        The result is None without points. Source: Naeini, Cooper, Hauskrecht 2015, AAAI (ECE).
        """
        bins = self.curve()
        error = sum(b["points"] * abs(b["mean"] - b["share_right"]) for b in bins)
        return float(error / self.points) if bins else None

    def to_dict(self) -> JsonObject | None:
        """Return measures as JSON types; None without points."""
        if not self.points:
            return None
        error = self.expected_calibration_error()
        return {"mean": self.mean, "expected_calibration_error": error, "curve": self.curve()}


@dataclass(frozen=True)
class ClassMeasures:
    """Measures of one class; shares are between 0 and 1, None where they are not defined."""

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
    """A confusion matrix and its measures.

    Make one with :meth:`from_labels` or :meth:`from_confusion`. Two of them add (tiles), and
    ``sum(tiles)`` works.
    """

    classes: tuple[int, ...]  #: codes of the rows: the classes of the reference, ascending
    extra: tuple[int, ...]  #: codes of further columns: predicted, but not in the reference
    matrix: npt.NDArray[np.int64]  #: (K, K + E) points; rows are the reference
    names: Mapping[int, str] = field(default_factory=dict)  #: of classes that ASPRS names otherwise
    left_out: Mapping[int, int] = field(default_factory=dict)  #: points by class before any merge
    reliability: ReliabilityHistogram | None = None  #: of the predicted classes
    merged: Mapping[int, int] = field(default_factory=dict)  #: classes taken as another one

    @classmethod
    def from_labels(
        cls,
        reference: npt.ArrayLike,
        predicted: npt.ArrayLike,
        *,
        reliability: npt.ArrayLike | None = None,
        allow_empty: bool = False,
        **rules: Any,
    ) -> Accuracy:
        """Compare two label arrays.

        Parameters
        ----------
        reference, predicted : (n,) arrays
            Class codes, whole numbers from 0 to 65535.
        reliability : (n,) array, optional
            Winning probability, 0 to 1.
        allow_empty : bool
            Whether no point to compare is allowed (a tile without reference points).
        **rules
            Fields of :class:`.labels.ComparedClasses`: classes, names, ignore, merge.

        Raises
        ------
        StageError
            Arrays of different lengths, labels that are not class codes, or nothing to compare.
        """
        true, labels = as_codes(reference, "reference"), as_codes(predicted, "prediction")
        rated = true[:0] if reliability is None else np.asarray(reliability).reshape(-1)
        others = {"prediction": labels} | ({} if reliability is None else {"reliability": rated})
        refuse_other_lengths(true, others)
        compared = ComparedClasses(**rules)
        merge = Merge.parse(compared.merge)
        codes, predicted_codes, counts = pair_counts(true, labels)
        rows, kept = compared.select(codes, merge)
        points = dict(zip(codes.tolist(), counts.sum(axis=1).tolist(), strict=True))
        left_out = {code: points[code] for code in codes[~kept].tolist()}
        if not allow_empty and not kept.any():
            raise StageError(
                "no point to compare" + ": every reference point is left out" * bool(left_out),
                found=", ".join(f"class {c}: {n:,} points" for c, n in [*points.items()][:12])
                or "0 points",
                cure="Name classes the reference has, or ignore fewer" if left_out else None,
            )
        occurs = counts[kept].any(axis=0)
        merged_rows = merge.target_of[codes[kept]]
        merged_columns = merge.target_of[predicted_codes[occurs]]
        columns, matrix = sum_tables(rows, (counts[kept][:, occurs], merged_rows, merged_columns))
        is_compared = np.isin(np.arange(len(merge.target_of)), codes[kept])
        histogram = ReliabilityHistogram.from_values([], [])
        for start in range(0, len(rated), CHUNK):
            part = slice(start, start + CHUNK)
            chosen = is_compared[true[part]]
            right = np.equal(*(merge.target_of[side[part][chosen]] for side in (true, labels)))
            histogram += ReliabilityHistogram.from_values(rated[part][chosen], right)
        named = compared.names or {}
        names = dict(zip(code_list(named, "names"), map(str, named.values()), strict=True))
        return cls(
            *(rows, columns[len(rows) :], matrix, {**merge.names, **names}, left_out),
            *(None if reliability is None else histogram, merge.changed),
        )

    @classmethod
    def from_confusion(cls, matrix: npt.ArrayLike, classes: Sequence[int]) -> Accuracy:
        """Take a confusion matrix of counts; rows are the reference, columns the prediction."""
        rows, counts = code_list(classes, "classes"), np.asarray(matrix, np.int64)
        columns, whole = sum_tables(sorted(rows), (counts, rows, rows))
        return cls(columns, (), whole)

    def __add__(self, other: Accuracy) -> Accuracy:
        """Return the accuracy of both sets of points together."""
        if not isinstance(other, Accuracy):
            return NotImplemented
        rows = tuple(sorted(set(self.classes) | set(other.classes)))
        tables = ((each.matrix, each.classes, each.columns) for each in (self, other))
        columns, matrix = sum_tables(rows, *tables)
        left = dict(sorted((Counter(self.left_out) + Counter(other.left_out)).items()))
        # An empty tile has no reliability; where another part lacks it, the sum lacks it, too.
        first, second = self.reliability, other.reliability
        if first is not None and second is not None:
            histogram: ReliabilityHistogram | None = first + second
        else:
            histogram = first if not other.points else second if not self.points else None
        names, merged = {**other.names, **self.names}, {**other.merged, **self.merged}
        return Accuracy(rows, columns[len(rows) :], matrix, names, left, histogram, merged)

    def __radd__(self, other: object) -> Accuracy:
        """Return itself added to 0, which sum() starts with."""
        return self if other == 0 else NotImplemented

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
        """Shares of the reference class (K, K + E), whose diagonal is recall; 0 in empty rows."""
        total = self.matrix.sum(axis=1, keepdims=True)
        return np.divide(self.matrix, total, out=np.zeros(self.matrix.shape), where=total > 0)

    def _refuse_empty(self) -> None:
        if self.points == 0:
            raise StageError("no point was compared, so there is no accuracy", found="0 points")

    @property
    def overall_accuracy(self) -> float:
        """Share of points whose class is right."""
        self._refuse_empty()
        return self.correct / self.points

    @property
    def kappa(self) -> float | None:
        """Cohen's kappa: agreement beyond chance; None where chance agrees on everything."""
        self._refuse_empty()
        n, k = self.points, len(self.classes)
        rows = [int(v) for v in self.matrix.sum(axis=1)]
        columns = [int(v) for v in self.matrix.sum(axis=0)[:k]]
        chance = sum(r * c for r, c in zip(rows, columns, strict=True))  # exact whole numbers
        return (self.correct * n - chance) / (n * n - chance) if chance != n * n else None

    #: Unweighted means over classes: MCR and MCP [B16], mean F1 [W18], intersection over union.
    mean_class_recall = property(lambda self: self._mean("recall"))
    mean_class_precision = property(lambda self: self._mean("precision"))
    mean_f1 = property(lambda self: self._mean("f1"))
    mean_iou = property(lambda self: self._mean("iou"))

    def _mean(self, name: str) -> float:
        self._refuse_empty()
        values = [getattr(f, name) for f in self.per_class if f.support]
        return float(sum(0.0 if v is None else v for v in values) / len(values))

    @cached_property
    def per_class(self) -> tuple[ClassMeasures, ...]:
        """Measures of every class of the reference."""
        measures = []
        for i, code in enumerate(self.classes):
            support, predicted = int(self.matrix[i].sum()), int(self.matrix[:, i].sum())
            hit, both = int(self.matrix[i, i]), support + predicted
            recall = hit / support if support else None
            precision = hit / predicted if predicted else (0.0 if support else None)
            shares = (2 * hit / both, hit / (both - hit)) if both else (None, None)
            counts = (support, predicted, hit)
            measures.append(
                ClassMeasures(code, self.name(code), *counts, recall, precision, *shares)
            )
        return tuple(measures)

    def _by_class(self, name: str) -> dict[int, Any]:
        return {f.code: getattr(f, name) for f in self.per_class}

    #: By class code: recall (completeness), precision (correctness), F1, IoU, reference points.
    recall = property(lambda self: self._by_class("recall"))
    precision = property(lambda self: self._by_class("precision"))
    f1 = property(lambda self: self._by_class("f1"))
    iou = property(lambda self: self._by_class("iou"))
    support = property(lambda self: self._by_class("support"))

    def confusions(self, most: int) -> list[tuple[int, int, int]]:
        """Return the `most` frequent errors: reference class, predicted class, points."""
        k = len(self.classes)
        wrong = self.matrix.copy()
        wrong[np.arange(k), np.arange(k)] = 0
        i, j = np.nonzero(wrong)
        order = np.argsort(-wrong[i, j], kind="stable")[:most]
        pairs = zip(i[order], j[order], strict=True)
        return [(self.classes[a], self.columns[b], int(wrong[a, b])) for a, b in pairs]

    def merge(self, codes: npt.NDArray) -> npt.NDArray:
        """Return codes (n,) with those that were merged as the code that they count as."""
        target_of = np.arange(MAX_LABEL + 1)
        target_of[list(self.merged)] = list(self.merged.values())
        return target_of[codes]

    def verdicts(
        self, reference: npt.NDArray, predicted: npt.NDArray
    ) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
        """Return which points were compared, and which are wrong, of codes (n,) before merging."""
        true = self.merge(reference)
        compared = np.isin(true, self.classes) & ~np.isin(reference, list(self.left_out))
        return compared, compared & (true != self.merge(predicted))

    def name(self, code: int) -> str:
        """Return the name of a class."""
        return self.names.get(code) or class_name(code)

    def to_dict(self) -> JsonObject:
        """Return everything as JSON types; ``accuracy-1.json`` describes it."""

        def described(codes: Iterable[int]) -> list[JsonObject]:
            return [{"code": c, "name": self.name(c)} for c in codes]

        return {
            "format": "pdal-stages accuracy",
            "version": 1,
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
            "reliability": self.reliability.to_dict() if self.reliability else None,
        }

    def table(self) -> str:
        """Return the measures as aligned text, in percent."""
        return table(self.to_dict(), self.name)
