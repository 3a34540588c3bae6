"""How often a model was right where it said how sure it was, on ground that it had not seen.

So it is known from which reliability on the points of a class are right as often as is wanted.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from ..base.checks import strict_json
from ..base.errors import ModelError, OptionError
from ..base.messages import one_line

#: Reliabilities are counted in so many bins from 0 to 1, the last of which holds 1.
BINS = 64
#: What the file beside a model's is called.
SUFFIX = ".sureness.json"


class Limit(NamedTuple):
    """For a class: from which reliability on points keep it, the share of its points that do, and how many of these are
    right."""

    reliability: float
    kept: float
    right: float


@dataclass
class Sureness:
    """Points by the class a model gave them and its reliability; weights are as the points lie."""

    right: dict[int, npt.NDArray[np.float64]] = field(
        default_factory=dict
    )  #: (BINS,) of each class
    wrong: dict[int, npt.NDArray[np.float64]] = field(default_factory=dict)
    about: str = ""  #: where they were counted

    def add(
        self,
        given: npt.NDArray[Any],
        true: npt.NDArray[Any],
        reliability: npt.NDArray[np.floating],
        weight: npt.NDArray[np.floating] | None = None,
    ) -> None:
        """Count points: (n,) classes given, true classes, reliabilities, and how much each counts."""
        place = np.clip(np.floor(np.asarray(reliability, np.float64) * BINS), 0, BINS - 1).astype(
            np.int64
        )
        for code in np.unique(given).tolist():
            for table, chosen in ((self.right, given == true), (self.wrong, given != true)):
                mine = (given == code) & chosen
                counted = np.bincount(place[mine], None if weight is None else weight[mine], BINS)
                table[code] = table.get(code, np.zeros(BINS)) + counted

    def limits(self, accuracy: float) -> dict[int, Limit]:
        """The lowest reliability of each class from which on the share of right points is `accuracy`; above 1 where it never
        is, and then the largest share there is."""
        out = {}
        for code in sorted(self.right):
            right, wrong = (table[code][::-1].cumsum()[::-1] for table in (self.right, self.wrong))
            all_ = right + wrong
            good = (all_ > 0) & (right >= accuracy * all_)
            if not good.any():
                out[code] = Limit(2.0, 0.0, float(np.max(right / np.maximum(all_, 1e-12))))
                continue
            first = int(np.flatnonzero(good)[0])
            out[code] = Limit(
                first / BINS, float(all_[first] / all_[0]), float(right[first] / all_[first])
            )
        return out

    def points(self, codes: Iterable[int]) -> float:
        """The points that were given these classes."""
        return sum(
            float((self.right[code] + self.wrong[code]).sum())
            for code in codes
            if code in self.right
        )

    def share_right(self, codes: Iterable[int]) -> float | None:
        """Return the share of points that were given these classes and are right; None where there is no such point."""
        known = [code for code in codes if code in self.right]
        points = self.points(known)
        return sum(float(self.right[code].sum()) for code in known) / points if points else None

    def kept(self, limits: Mapping[int, Limit]) -> float:
        """The share of all points that keep their class."""
        kept = sum(limit.kept * self.points([code]) for code, limit in limits.items())
        return kept / max(self.points(self.right), 1e-9)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for a manifest or a file."""
        tables = {"right": self.right, "wrong": self.wrong}
        classes = {
            str(code): {
                name: [float(f"{value:.4g}") for value in table[code]]
                for name, table in tables.items()
            }
            for code in sorted(self.right)
        }
        return {"about": self.about, "classes": classes}

    @classmethod
    def from_dict(cls, said: Mapping[str, Any]) -> Sureness:
        """What :meth:`to_dict` gave; ModelError for something else."""
        made = cls()
        try:
            made.about = one_line(str(said["about"]))
            for code, counted in said["classes"].items():
                for table, name in ((made.right, "right"), (made.wrong, "wrong")):
                    table[int(code)] = values = np.array(counted[name], np.float64)
                    if (
                        values.shape != (BINS,)
                        or not (values >= 0).all()
                        or not np.isfinite(values).all()
                    ):
                        raise ValueError(name)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise ModelError(
                "the counts of right and wrong points by reliability are damaged", found=str(error)
            ) from None
        return made


def sureness_of(info: Mapping[str, Any], path: str) -> Sureness:
    """What is known of a model: in its file, or in a file beside it.

    Raises
    ------
    OptionError
        If nothing is.
    """
    if info.get("sureness"):
        return Sureness.from_dict(info["sureness"])
    beside = Path(path).with_suffix(SUFFIX)
    if beside.is_file():
        try:
            return Sureness.from_dict(strict_json(beside.read_bytes()))
        except (OSError, ValueError, RecursionError) as error:
            raise ModelError(
                "the file beside the model is damaged", where=str(beside), found=error
            ) from None
    cure = "Train it with folds (the default), on labels that lie in more than one place"
    if info.get("teacher"):
        cure = "Its labels are another model's answers; take a model that was scored on a person's labels"
    raise OptionError(
        "how often this model is right at which Reliability is not known: it was never scored on ground held out",
        found=path,
        cure=f"{cure}; or set a limit by hand: --filters.modelclassifier.reject_below=0.8",
    )


def of_the_base(own: Mapping[str, Any], base: Mapping[str, Any], path: str) -> Mapping[str, Any]:
    """What a model on top of a base says of itself where its labels are a person's corrections.

    These lie where the base was worst, so its `own` counts are taken for new classes alone, where the base's are known,
    as many to one of the base's classes as among the labels.
    """
    try:
        known = sureness_of(base, path)
    except OptionError:
        return own
    mine = Sureness.from_dict({"about": "", "classes": {}, **own})
    ratio = known.points(known.right) / (mine.points(known.right) or known.points(known.right))
    for code in mine.right.keys() - known.right.keys():
        known.right[code], known.wrong[code] = ratio * mine.right[code], ratio * mine.wrong[code]
    known.about = f"its base ({known.about}), as its own labels lie where that was looked at"
    return known.to_dict()


def said(known: Sureness, names: Mapping[int, str], accuracy: float) -> list[str]:
    """What it costs, in lines; where no point of a class can be kept, what can be had instead."""
    limits = known.limits(accuracy)
    lost = 100 * (1 - known.kept(limits))
    lines = [
        f"to be right in {100 * accuracy:g} % of the points of each class, about {lost:.1f} % of all points are "
        "expected to become class 1 (unclassified):"
    ]
    for code, one in limits.items():
        name = f"{code} {names.get(code, '')}".strip()
        if one.reliability > 1.0:
            best = np.floor(100 * one.right) / 100
            share = 100 * known.limits(best)[code].kept
            lines.append(
                f"  {name}: no point keeps it, as at most {100 * one.right:.1f} % of the most reliable were right; "
                f"with {best:g}, {share:.1f} % would"
            )
        else:
            lines.append(
                f"  {name}: {100 * one.kept:.1f} % keep it, from reliability {one.reliability:.2f} on"
            )
    return lines
