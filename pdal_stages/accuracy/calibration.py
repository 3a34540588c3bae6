"""Calibration of a confidence: reliability curve, errors by margin, separation of right and wrong.

A :class:`ConfidenceHistogram` is a histogram of a confidence in [0, 1] with the number of right
points in each bin. Histograms add, so those of tiles give the measures of the whole.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import StageError

#: Histogram bins between 0 and 1; deciles and areas are exact to one of them.
BINS = 1000


@dataclass(frozen=True, eq=False)
class ConfidenceHistogram:
    """Histogram of a confidence and of the points whose class is right, in bins of 0.001."""

    count: npt.NDArray[np.int64]  #: (1000,) points of each bin
    right: npt.NDArray[np.int64]  #: (1000,) points of each bin with the right class
    total: npt.NDArray[np.float64]  #: (1000,) sum of the confidence of each bin

    @classmethod
    def empty(cls) -> ConfidenceHistogram:
        """Return a histogram of no points."""
        return cls(np.zeros(BINS, np.int64), np.zeros(BINS, np.int64), np.zeros(BINS))

    @classmethod
    def from_values(
        cls, values: npt.ArrayLike, right: npt.ArrayLike, name: str = "reliability"
    ) -> ConfidenceHistogram:
        """Return the histogram of confidences (n,) and of those whose class is right, (n,) bool.

        Raises
        ------
        StageError
            Where a confidence, called `name`, is not a number between 0 and 1.
        """
        v, is_right = np.asarray(values, dtype=np.float64), np.asarray(right, dtype=bool)
        bad = ~((v >= 0) & (v <= 1 + 1e-6))
        if bad.any():
            raise StageError(
                f"{int(bad.sum()):,} of {len(v):,} values of {name} are not between 0 and 1",
                found=float(v[bad][0]),
                cure="Give the classifier's probabilities, unscaled, for every compared point",
            )
        place = np.minimum((v * BINS).astype(np.int64), BINS - 1)
        return cls(
            np.bincount(place, minlength=BINS),
            np.bincount(place[is_right], minlength=BINS),
            np.bincount(place, weights=v, minlength=BINS).astype(np.float64),
        )

    def __add__(self, other: ConfidenceHistogram) -> ConfidenceHistogram:
        """Return the histogram of both sets of points together."""
        sums = (getattr(self, f.name) + getattr(other, f.name) for f in fields(self))
        return ConfidenceHistogram(*sums)

    @property
    def points(self) -> int:
        """Number of points."""
        return int(self.count.sum())

    @property
    def mean(self) -> float | None:
        """Mean confidence of all points, None without points."""
        return float(self.total.sum() / self.points) if self.points else None

    def _group(self, start: int, stop: int) -> dict[str, Any]:
        n = int(self.count[start:stop].sum())
        right = int(self.right[start:stop].sum())
        return {
            "lower": start / BINS,
            "upper": stop / BINS,
            "points": n,
            "right": right,
            "mean": float(self.total[start:stop].sum() / n) if n else None,
            "share_right": right / n if n else None,
            "share_wrong": (n - right) / n if n else None,
        }

    def curve(self) -> list[dict[str, Any]]:
        """Return ten equally wide bins: the reliability curve (confidence against share right)."""
        edges = np.linspace(0, BINS, 11).round().astype(int)
        return [self._group(int(a), int(b)) for a, b in pairwise(edges)]

    def deciles(self) -> list[dict[str, Any]]:
        """Return ten equally filled groups, from the least to the most confident points.

        A histogram bin is never split, so many points of one value make fewer, unequal groups.
        """
        n = self.points
        if n == 0:
            return []
        filled = np.cumsum(self.count)
        cuts = [int(np.searchsorted(filled, n * q / 10, side="left")) + 1 for q in range(1, 10)]
        edges = sorted({0, *cuts, BINS})
        return [g for g in (self._group(a, b) for a, b in pairwise(edges)) if g["points"]]

    def expected_calibration_error(self) -> float | None:
        """Return the mean distance of confidence and share right, over bins weighted by points.

        Source: Naeini, Cooper, Hauskrecht 2015, AAAI (ECE).
        """
        n = self.points
        if n == 0:
            return None
        filled = [b for b in self.curve() if b["points"]]
        return float(sum(b["points"] * abs(b["mean"] - b["share_right"]) for b in filled) / n)

    def separation(self) -> float | None:
        """Return the area under the ROC curve.

        It is the chance that a right point has a higher confidence than a wrong one.

        0.5 means no information, 1 that every error has a lower confidence than any right point;
        None where all points are right or all are wrong.
        """
        wrong = (self.count - self.right).astype(np.float64)
        right = self.right.astype(np.float64)
        if wrong.sum() == 0 or right.sum() == 0:
            return None
        below = np.concatenate([[0.0], np.cumsum(wrong)[:-1]])
        return float((right * (below + 0.5 * wrong)).sum() / (right.sum() * wrong.sum()))

    def to_dict(self, kind: str) -> dict[str, Any] | None:
        """Return measures as JSON types, with the "curve" or the "deciles"; None without points."""
        if not self.points:
            return None
        out: dict[str, Any] = {"mean": self.mean, "separation": self.separation()}
        if kind == "deciles":
            return {**out, "deciles": self.deciles()}
        return {
            **out,
            "expected_calibration_error": self.expected_calibration_error(),
            "curve": self.curve(),
        }
