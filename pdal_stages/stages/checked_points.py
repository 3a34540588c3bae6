"""Points that a person checked: samples are drawn from these, and from others that keep what a base
knows.

What is corrected lies where the base was unsure: from that alone a forest does not learn what the
rest looks like. So of each class about as many points stand beside as were checked of the most
frequent, among all of which the base is sure. A point's hash decides, so that the parts of a cloud
need only be counted first.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.errors import StageError
from ..base.hashing import hash_rows
from ..base.report import Report
from ..classifier.input_dimensions import CHECKED
from .points import class_counts

#: A base is sure of a point from this reliability on.
SURE = 0.95


class CheckedPoints(NamedTuple):
    """Points of a part that samples may be drawn from."""

    wanted: NDArray[np.bool_]  #: (n,) those that a person checked
    sure: NDArray[np.bool_]  #: (n,) others of which the base is sure
    codes: NDArray  #: (n,) class codes

    def counts(self, checked: int) -> dict[str, Any]:
        """Points, those that a person checked wherever they lie, and how many of each class there
        are, as JSON has it.
        """
        wanted, sure = (class_counts(self.codes[mask]) for mask in (self.wanted, self.sure))
        return {"points": len(self.codes), "checked": checked, "wanted": wanted, "sure": sure}


class CheckedChoice:
    """What samples are drawn from, of a cloud whose parts were counted; `known`: the classes of the
    base, if any.
    """

    def __init__(
        self, known: Collection[int] | None, seed: int, parts: Iterable[Mapping[str, Any]]
    ) -> None:
        self._known, self._seed = known, seed
        self._points = self._checked = 0
        wanted, sure = Counter[str](), Counter[str]()
        for part in parts:
            self._points += part["points"]
            self._checked += part["checked"]
            wanted.update(part["wanted"])
            sure.update(part["sure"])
        self._wanted = wanted.total()
        if self._checked and not self._wanted:
            raise StageError(
                "no checked point lies inside 'where'", found=f"{self._checked:,} checked points"
            )
        both = [code for code in known or () if wanted[str(code)]]
        most = max((wanted[str(code)] for code in both), default=0)
        #: Of each class the share of points of which the base is sure, and about how many these
        #: are.
        self._shares = {code: min(1.0, most / n) for code in both if (n := sure[str(code)])}
        self._beside = sum(min(most, sure[str(code)]) for code in self._shares)

    def __bool__(self) -> bool:
        """Whether any point was checked."""
        return self._checked > 0

    def mask(self, looked: CheckedPoints, xyz: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which points of a part samples are drawn from."""
        out = looked.wanted.copy()
        for code, share in self._shares.items():
            mine = np.flatnonzero(looked.sure & (looked.codes == code))
            out[mine[hash_rows(xyz[mine].T, self._seed) / 2.0**64 < share]] = True
        return out

    def report_to(self, report: Report) -> None:
        """Note and count in a report what samples are drawn from."""
        number = report.figures["checked"] = self._wanted
        said = f"{number:,} of {self._points:,} points were checked by a person ({CHECKED}): samples are drawn from these"
        if self._known is not None:
            report.figures["anchors"] = self._beside
        if self._beside:
            said += f", and from about {self._beside:,} others of which the base is sure: it is kept where nobody looked"
        else:
            said += " alone, the others are neighbors"
            if self._known is not None:
                said += (
                    "; nothing keeps the base where nobody looked, as no other point has a "
                    f"Reliability of {SURE:g} or more"
                )
        report.notes.append(said)
