"""From probabilities to classes: the largest wins, unless it is too small."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ..base import checks
from ..base.report import Report

#: The class of a rejected point where its old class is not known: ASPRS "Unclassified".
UNCLASSIFIED = 1


@dataclass(frozen=True)
class PredictionOptions:
    """How a cloud is classified.

    Attributes
    ----------
    threads, memory_mb
        Cores to use, and memory for the blocks of features under way.
    probabilities, margin, variance : bool
        Whether to return them; the last only a network has.
    reject_below : float, optional
        Points less reliable than this are not given the winning class, and are counted.
    rejected_code : int, optional
        Class of rejected points, instead of their old one.
    limits : mapping of int to float, optional
        The same as `reject_below`, for points of each class; the larger one counts.
    """

    threads: int | None = None
    memory_mb: float = 512.0
    probabilities: bool = False
    margin: bool = False
    variance: bool = False
    reject_below: float | None = None
    rejected_code: int | None = None
    limits: Mapping[int, float] | None = None

    def __post_init__(self) -> None:
        checks.number("'memory_mb'", self.memory_mb, 1, unit="MB")
        if self.reject_below is not None:
            checks.number("'reject_below'", self.reject_below, 0, 1)
        if self.rejected_code is not None:
            checks.whole("'rejected_code'", self.rejected_code, 0, 255)


@dataclass(frozen=True, eq=False)
class Prediction:
    """Classes given to a cloud's points, in its order.

    Attributes
    ----------
    classification : (n,) uint8
        ASPRS codes.
    reliability : (n,) float32
        Probability of the winning class, 0 to 1; 0 for points that were not classified (outside `where`).
    margin : (n,) float32 or None
        Winning minus second probability; 0 outside `where`.
    probabilities : (n, classes) float32 or None
        In the order of ``Model.classes``; 0 outside `where`.
    variance : (n,) float32 or None
        Variance of a class's probability over a network's batches, mean over the classes; 0 outside `where`.
    classified, rejected : int
        Points looked at, and those of them whose reliability was below `reject_below`.
    report : Report
        Counts, notes and warnings for the metadata.
    """

    classification: npt.NDArray[np.uint8]
    reliability: npt.NDArray[np.float32]
    margin: npt.NDArray[np.float32] | None
    probabilities: npt.NDArray[np.float32] | None
    variance: npt.NDArray[np.float32] | None
    classified: int
    rejected: int
    report: Report


class Decided(NamedTuple):
    """What was decided of a block of points."""

    code: npt.NDArray[np.uint8]
    reliability: npt.NDArray[np.floating]
    margin: npt.NDArray[np.floating]
    probabilities: npt.NDArray[np.floating] | None

    def taken(self, place: npt.NDArray[np.int64]) -> Decided:
        """The rows of these places."""
        probabilities = None if self.probabilities is None else self.probabilities[place]
        return Decided(self.code[place], self.reliability[place], self.margin[place], probabilities)


def decide(p: npt.NDArray[np.floating], codes: npt.NDArray[np.uint8], options: PredictionOptions) -> Decided:
    """The winner of each row of probabilities (n, classes); of equal ones the class that comes first."""
    best = p.argmax(axis=1)
    win = np.take_along_axis(p, best[:, None], axis=1)[:, 0]
    lead = win
    if options.margin and p.shape[1] > 1:
        lead = win - np.partition(p, -2, axis=1)[:, -2]
    return Decided(codes[best], win, lead, p if options.probabilities else None)


class Outcome:
    """The arrays of a :class:`Prediction` while blocks are written into them; `current`: (n,) classes of the points now."""

    def __init__(
        self, n: int, classes: int, current: npt.NDArray[np.uint8] | None, options: PredictionOptions
    ) -> None:
        self._current, self._options = current, options
        self._least = np.full(256, options.reject_below or 0.0, np.float32)
        for code, limit in (options.limits or {}).items():
            self._least[code] = max(self._least[code], limit)
        self.rejected = 0
        self.classification = np.zeros(n, np.uint8) if current is None else current.copy()
        self.reliability = np.zeros(n, np.float32)
        self.margin = np.zeros(n, np.float32) if options.margin else None
        self.variance = np.zeros(n, np.float32) if options.variance else None
        self.probabilities = np.zeros((n, classes), np.float32) if options.probabilities else None

    def write(self, rows: Any, decided: Decided, variance: npt.NDArray[np.floating] | None = None) -> None:
        """Write what is known of a block: `rows` index the cloud."""
        if self.variance is not None and variance is not None:
            self.variance[rows] = variance
        self.reliability[rows] = decided.reliability
        if self.margin is not None:
            self.margin[rows] = decided.margin
        if self.probabilities is not None:
            self.probabilities[rows] = decided.probabilities
        low = (
            self.reliability[rows] < self._least[decided.code]
        )  # as stored, so that users can find the same points
        self.rejected += int(np.count_nonzero(low))
        if self._options.rejected_code is not None:
            instead: Any = np.uint8(self._options.rejected_code)
        else:
            instead = np.uint8(UNCLASSIFIED) if self._current is None else self._current[rows]
        self.classification[rows] = np.where(low, instead, decided.code)

    def prediction(self, asked: npt.NDArray[np.bool_], ignored: int, counted: Report) -> Prediction:
        """The result once all blocks are written.

        `asked` (n,) are the points that were to be classified; so many others were `ignored`.
        """
        n, count = len(asked), int(np.count_nonzero(asked))
        code, number = np.unique(self.classification[asked], return_counts=True)
        report = Report(
            {
                "points": n,
                "classified": count - self.rejected,
                "rejected": self.rejected,
                "outside_where": n - ignored - count,
                **({"ignored": ignored} if ignored else {}),
                "classes": {str(int(c)): int(m) for c, m in zip(code, number, strict=True)},
            }
        )
        report.merge(counted)
        return Prediction(
            self.classification, self.reliability, self.margin, self.probabilities, self.variance,
            count, self.rejected, report,
        )  # fmt: skip
