"""Calibration: how often a model was right at which reliability, on ground that it had not seen.

It tells from which reliability on points keep their class, so that a wanted share of the points
that keep it is right.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from ..base.checks import strict_json
from ..base.errors import ModelError, OptionError
from ..base.json_types import JsonObject
from ..base.messages import one_line
from .model_info import ModelInfo

#: Bins of reliability from 0 to 1; the last one holds 1. Model files hold so many counts, so
#: another number needs another version of their format (not tuned).
BINS = 64
#: End of the name of the file beside a model that holds its calibration.
SUFFIX = ".calibration.json"
#: A reliability that no point has: every point of the class is rejected.
UNREACHABLE = 2.0
#: Significant digits of the counts in a file.
_DIGITS = 4


class ClassLimit(NamedTuple):
    """From which reliability on points keep a class."""

    reliability: float  #: :data:`UNREACHABLE` where no reliability gives the accuracy wanted
    kept: float  #: share of the class's points that keep it
    #: share of these that are right; where none keeps it, the largest share there is
    accuracy: float


@dataclass(frozen=True)
class ReliabilityLimits:
    """Limits by class that keep a wanted share of points right, for `keep_sure`."""

    accuracy: float  #: share of points of each class that should be right
    classes: Mapping[int, ClassLimit]  #: by code
    kept: float  #: share of all points that keep their class

    def least_reliability(self) -> npt.NDArray[np.float32]:
        """Return by code the least reliability (256,) with which a point keeps its class."""
        least = np.zeros(256, np.float32)
        for code, limit in self.classes.items():
            least[code] = limit.reliability
        return least

    def describe_cost(self, names: Mapping[int, str]) -> list[str]:
        """Return lines of text: the expected share of points that lose their class."""
        lines = [
            f"to be right in {100 * self.accuracy:g} % of the points of each class, about "
            f"{100 * (1 - self.kept):.1f} % of all points are expected to become class 1 "
            "(unclassified):"
        ]
        for code, limit in self.classes.items():
            cost = f"{100 * limit.kept:.1f} % keep it, from reliability {limit.reliability:.2f} on"
            if not limit.kept:
                right = f"at most {100 * limit.accuracy:.1f} % of the most reliable were right"
                cost = f"no point keeps it, as {right}"
            lines.append(f"  {code} {names.get(code, '')}".rstrip() + f": {cost}")
        for code in sorted(names.keys() - self.classes.keys()):
            lines.append(f"  {code} {names[code]}: nothing is promised, all points keep it")
        return lines


@dataclass
class Calibration:
    """Weights of right and wrong points by the class a model gave them and its reliability."""

    right: dict[int, npt.NDArray[np.float64]] = field(default_factory=dict)  #: code -> (BINS,)
    wrong: dict[int, npt.NDArray[np.float64]] = field(default_factory=dict)  #: code -> (BINS,)
    about: str = ""  #: where the points were counted

    def add(
        self,
        predicted: npt.NDArray,
        true: npt.NDArray,
        reliability: npt.NDArray[np.floating],
        weight: npt.NDArray[np.floating] | None = None,
    ) -> None:
        """Count points: (n,) codes predicted, true codes, reliabilities, and weights."""
        place = np.floor(np.asarray(reliability, np.float64) * BINS)
        place = np.clip(place, 0, BINS - 1).astype(np.int64)
        is_right = predicted == true
        for code in np.unique(predicted).tolist():
            for table, chosen in ((self.right, is_right), (self.wrong, ~is_right)):
                rows = (predicted == code) & chosen
                counts = np.bincount(place[rows], None if weight is None else weight[rows], BINS)
                table[code] = table.get(code, np.zeros(BINS)) + counts

    def limits(self, accuracy: float) -> ReliabilityLimits:
        """Return the lowest limits that keep the share `accuracy` of each class right."""
        classes = {code: self._limit(code, accuracy) for code in sorted(self.right)}
        kept = sum(limit.kept * self.points([code]) for code, limit in classes.items())
        return ReliabilityLimits(accuracy, classes, kept / max(self.points(self.right), 1e-9))

    def _limit(self, code: int, accuracy: float) -> ClassLimit:
        """Return the lowest limit of a class that keeps the share `accuracy` right."""
        right, wrong = (table[code][::-1].cumsum()[::-1] for table in (self.right, self.wrong))
        points = right + wrong
        good = (points > 0) & (right >= accuracy * points)
        if good.any():
            first = int(np.flatnonzero(good)[0])
            kept, share_right = points[first] / points[0], right[first] / points[first]
            return ClassLimit(first / BINS, float(kept), float(share_right))
        most = float(np.max(right / np.maximum(points, 1e-12)))
        return ClassLimit(UNREACHABLE, 0.0, most)

    def points(self, codes: Iterable[int]) -> float:
        """Return the weight of the points that were given these classes."""
        known = [code for code in codes if code in self.right]
        return sum(float((self.right[code] + self.wrong[code]).sum()) for code in known)

    def accuracy(self, codes: Iterable[int]) -> float | None:
        """Return the share of points given these classes that are right; None without points."""
        known = [code for code in codes if code in self.right]
        points = self.points(known)
        return sum(float(self.right[code].sum()) for code in known) / points if points else None

    def to_dict(self) -> JsonObject:
        """Return plain values, for a manifest or a file."""

        def rounded(counts: npt.NDArray[np.float64]) -> list[float]:
            return [float(f"{value:.{_DIGITS}g}") for value in counts]

        classes = {
            str(code): {"right": rounded(self.right[code]), "wrong": rounded(self.wrong[code])}
            for code in sorted(self.right)
        }
        return {"about": self.about, "classes": classes}

    @classmethod
    def from_dict(cls, entry: JsonObject) -> Calibration:
        """Return the calibration that :meth:`to_dict` gave; ModelError for something else."""
        out = cls()
        try:
            out.about = one_line(str(entry["about"]))
            for code, counts in entry["classes"].items():
                for table, name in ((out.right, "right"), (out.wrong, "wrong")):
                    table[int(code)] = values = np.array(counts[name], np.float64)
                    finite = values.shape == (BINS,) and np.isfinite(values).all()
                    if not finite or (values < 0).any():
                        raise ValueError(name)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise ModelError(
                "the counts of right and wrong points by reliability are damaged", found=str(error)
            ) from None
        return out


def read_calibration(info: ModelInfo, path: str) -> Calibration:
    """Return a model's calibration from its manifest `info`, or from the file beside its `path`.

    Raises
    ------
    OptionError
        If there is neither.
    ModelError
        If it is damaged.
    """
    if info.get("sureness"):
        return Calibration.from_dict(info["sureness"])
    beside = Path(path).with_suffix(SUFFIX)
    if beside.is_file():
        try:
            return Calibration.from_dict(strict_json(beside.read_bytes()))
        except (OSError, ValueError, RecursionError) as error:
            raise ModelError("the calibration is damaged", where=str(beside), found=error) from None
    raise OptionError(
        "how often this model is right at which Reliability is not known: it was never scored on "
        "ground held out",
        found=path,
        cure="Train it with folds (the default), on a person's labels that lie in more than one "
        "place; or set a limit by hand: --filters.modelclassifier.reject_below=0.8",
    )


def calibrate_on_base(refined: JsonObject, base: ModelInfo, path: str) -> JsonObject:
    """Return the calibration of a model whose labels are a person's corrections of its base.

    Corrections lie where the base was worst. So the counts of the `refined` model are taken for new
    classes alone, scaled to the base's as its points of the base's classes are; for these the
    counts are the base's.

    Parameters
    ----------
    refined : mapping
        Calibration of the refined model as a manifest has it.
    base : mapping
        Manifest of the base.
    path : str
        File of the base.
    """
    try:
        known = read_calibration(base, path)
    except OptionError:
        return refined
    counts = Calibration.from_dict({"about": "", "classes": {}, **refined})
    points = known.points(known.right)
    scale = points / (counts.points(known.right) or points)
    for code in counts.right.keys() - known.right.keys():
        known.right[code] = scale * counts.right[code]
        known.wrong[code] = scale * counts.wrong[code]
    known.about = f"its base ({known.about}), as its own labels lie where that was looked at"
    return known.to_dict()
