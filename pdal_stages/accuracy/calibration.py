"""How well a per-point confidence separates right from wrong: reliability curve, error against margin.

A :class:`Grading` is a histogram of a confidence in [0, 1] with the share of right points in each
bin. Histograms add, so tiles graded one by one give the figures of the whole.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base.errors import StageError

#: Histogram bins between 0 and 1; deciles and areas are exact to one of them.
BINS = 1000


@dataclass(frozen=True, eq=False)
class Grading:
    """A histogram of a confidence, with the points whose class is right: 1000 bins of width 0.001."""

    count: npt.NDArray[np.int64]  #: (1000,) points of each bin
    right: npt.NDArray[np.int64]  #: (1000,) those with the right class
    total: npt.NDArray[np.float64]  #: (1000,) the sum of their confidence

    @classmethod
    def empty(cls) -> Grading:
        return cls(np.zeros(BINS, np.int64), np.zeros(BINS, np.int64), np.zeros(BINS))

    @classmethod
    def from_values(
        cls, values: npt.ArrayLike, right: npt.ArrayLike, name: str = "reliability"
    ) -> Grading:
        """Grade (n,) confidences by whether the class is right, (n,) bool.

        StageError, which calls them `name`, where one is not a number between 0 and 1.
        """
        v = np.asarray(values, dtype=np.float64)
        ok = np.asarray(right, dtype=bool)
        bad = ~((v >= 0) & (v <= 1 + 1e-6))
        if bad.any():
            raise StageError(
                f"{int(bad.sum()):,} of {len(v):,} values of {name} are not between 0 and 1",
                found=float(v[bad][0]),
                cure="Give the probabilities a classifier writes, unscaled, for every compared point",
            )
        place = np.minimum((v * BINS).astype(np.int64), BINS - 1)
        return cls(
            np.bincount(place, minlength=BINS),
            np.bincount(place[ok], minlength=BINS),
            np.bincount(place, weights=v, minlength=BINS).astype(np.float64),
        )

    def __add__(self, other: Grading) -> Grading:
        return Grading(self.count + other.count, self.right + other.right, self.total + other.total)

    @property
    def points(self) -> int:
        return int(self.count.sum())

    @property
    def mean(self) -> float | None:
        """Mean confidence of all points."""
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
        """Ten equally wide bins: the reliability curve (mean confidence against share right)."""
        edges = np.linspace(0, BINS, 11).round().astype(int)
        return [self._group(int(a), int(b)) for a, b in pairwise(edges)]

    def deciles(self) -> list[dict[str, Any]]:
        """Ten equally filled groups, from the least to the most confident points.

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
        """Mean distance between confidence and share right over the curve's bins, weighted by points.

        Source: Naeini, Cooper, Hauskrecht 2015, AAAI (ECE).
        """
        n = self.points
        if n == 0:
            return None
        filled = [b for b in self.curve() if b["points"]]
        return float(sum(b["points"] * abs(b["mean"] - b["share_right"]) for b in filled) / n)

    def separation(self) -> float | None:
        """Area under the ROC curve: the chance that a right point is more confident than a wrong one.

        0.5 means no information, 1 that every error is marked; None where all points are right or all are wrong.
        """
        wrong = (self.count - self.right).astype(np.float64)
        right = self.right.astype(np.float64)
        if wrong.sum() == 0 or right.sum() == 0:
            return None
        below = np.concatenate([[0.0], np.cumsum(wrong)[:-1]])
        return float((right * (below + 0.5 * wrong)).sum() / (right.sum() * wrong.sum()))

    def to_dict(self, kind: str) -> dict[str, Any] | None:
        """As JSON types, with the "curve" or the "deciles"; None without points."""
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
