"""From probabilities to classes: the largest wins, unless it is too small."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..base import checks
from ..base.report import Report

#: The class of a rejected point where its old class is not known: ASPRS "Unclassified".
UNCLASSIFIED = 1


@dataclass(frozen=True)
class PredictionOptions:
    """How a cloud is classified."""

    threads: int | None = None
    memory_mb: float = 256.0  #: for the blocks of features under way
    probabilities: bool = False  #: whether to return them
    margin: bool = False
    variance: bool = False  #: only a network has it
    reject_below: float | None = None  #: points less reliable do not get the winning class, and are counted
    rejected_code: int | None = None  #: class of rejected points, instead of their old one
    #: as `reject_below`, for points of each class; the larger one counts
    limits: Mapping[int, float] | None = None

    def __post_init__(self) -> None:
        checks.number("'memory_mb'", self.memory_mb, 1, unit="MB")
        if self.reject_below is not None:
            checks.number("'reject_below'", self.reject_below, 0, 1)
        if self.rejected_code is not None:
            checks.whole("'rejected_code'", self.rejected_code, 0, 255)


@dataclass(frozen=True, eq=False)
class Prediction:
    """Classes given to a cloud's points, in its order; numbers are 0 for points that were not classified."""

    classification: npt.NDArray[np.uint8]  #: (n,) ASPRS codes
    reliability: npt.NDArray[np.float32]  #: (n,) probability of the winning class
    margin: npt.NDArray[np.float32] | None  #: (n,) winning minus second probability
    probabilities: npt.NDArray[np.float32] | None  #: (n, classes) in the order of ``Model.classes``
    #: (n,) variance of a class's probability over a network's batches, mean over the classes
    variance: npt.NDArray[np.float32] | None
    classified: int  #: points looked at
    unsure: npt.NDArray[np.int64]  #: (m,) those of them that were not reliable enough, and so rejected
    report: Report  #: counts, notes and warnings for the metadata

    @property
    def rejected(self) -> int:
        return len(self.unsure)


def decide(
    p: npt.NDArray[np.floating], codes: npt.NDArray[np.uint8], options: PredictionOptions
) -> dict[str, npt.NDArray[Any]]:
    """The winner of each row of probabilities (n, classes), of equal ones the first class, and what is asked for."""
    best = p.argmax(axis=1)
    win = np.take_along_axis(p, best[:, None], axis=1)[:, 0]
    out = {"classification": codes[best], "reliability": win}
    if options.margin:
        out["margin"] = win - np.partition(p, -2, axis=1)[:, -2] if p.shape[1] > 1 else win
    return {**out, "probabilities": p} if options.probabilities else out


def empty(
    n: int, classes: int, current: npt.NDArray[np.uint8] | None, options: PredictionOptions
) -> dict[str, npt.NDArray[Any]]:
    """The arrays of a :class:`Prediction` before anything is decided; `current`: (n,) classes of the points now."""
    out: dict[str, npt.NDArray[Any]] = {
        "classification": np.zeros(n, np.uint8) if current is None else current.copy(),
        "reliability": np.zeros(n, np.float32),
    }
    asked = {"margin": options.margin, "variance": options.variance}
    out.update({name: np.zeros(n, np.float32) for name, wanted in asked.items() if wanted})
    if options.probabilities:
        out["probabilities"] = np.zeros((n, classes), np.float32)
    return out


def judged(
    out: dict[str, npt.NDArray[Any]],
    asked: npt.NDArray[np.bool_],
    ignored: int,
    current: npt.NDArray[np.uint8] | None,
    options: PredictionOptions,
    report: Report,
) -> Prediction:
    """The result: of the points that were `asked` for (n,) the unsure ones are rejected; so many others were `ignored`."""
    code = out["classification"]
    least = np.full(256, options.reject_below or 0.0, np.float32)
    for one, limit in (options.limits or {}).items():
        least[one] = max(least[one], limit)
    low = np.zeros(0, np.int64)
    if least.any():
        low = np.flatnonzero(asked & (out["reliability"] < least[code]))
        if options.rejected_code is not None:
            code[low] = options.rejected_code
        else:
            code[low] = UNCLASSIFIED if current is None else current[low]
    count, codes = int(np.count_nonzero(asked)), np.bincount(code[asked], minlength=256)
    whole = Report(
        {
            "points": len(asked),
            "classified": count - len(low),
            "rejected": len(low),
            "outside_where": len(asked) - ignored - count,
            **({"ignored": ignored} if ignored else {}),
            "classes": {str(one): int(codes[one]) for one in np.flatnonzero(codes).tolist()},
        }
    )
    whole.merge(report)
    more = {name: out.get(name) for name in ("margin", "probabilities", "variance")}
    return Prediction(code, out["reliability"], **more, classified=count, unsure=low, report=whole)
