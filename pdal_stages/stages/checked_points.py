"""Select training samples where a person corrected the classes of a base model.

Corrected points lie where the base was unsure; a forest trained on these alone does not learn what
the rest looks like. So samples are drawn from the checked points and from others of which the base
is sure: of each class about as many as were checked of the most frequent class. A hash of the
coordinates decides which, so that the parts of a cloud need only be counted beforehand.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.errors import StageError
from ..base.hashing import hash_rows
from ..base.messages import Report
from ..classifier.input_dimensions import CHECKED
from .points import class_counts

#: Reliability from which on a base is sure of a point: 19 of 20 such points are right.
SURE = 0.95


class CheckedPoints(NamedTuple):
    """Points of a part of a cloud that samples may be drawn from."""

    wanted: NDArray[np.bool_]  #: (n,) those that a person checked
    sure: NDArray[np.bool_]  #: (n,) others of which the base is sure
    codes: NDArray  #: (n,) class codes

    def counts(self, checked: int) -> dict[str, Any]:
        """Return the numbers of points by class, as JSON; `checked` counts those outside, too."""
        wanted, sure = (class_counts(self.codes[mask]) for mask in (self.wanted, self.sure))
        return {"points": len(self.codes), "checked": checked, "wanted": wanted, "sure": sure}


class CheckedChoice:
    """Selection of samples from a cloud whose parts were counted.

    Parameters
    ----------
    known : collection of int or None
        Class codes of the base; None without a base.
    seed : int
        Seed of the hash.
    parts : iterable of mapping
        Results of :meth:`CheckedPoints.counts`.

    Raises
    ------
    StageError
        If all checked points lie outside `where`.
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
        # Share to take of each class's points of which the base is sure, and how many that gives.
        self._shares = {code: min(1.0, most / n) for code in both if (n := sure[str(code)])}
        self._beside = sum(min(most, sure[str(code)]) for code in self._shares)

    def __bool__(self) -> bool:
        """Return whether any point was checked."""
        return self._checked > 0

    def mask(self, part: CheckedPoints, xyz: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which points (n,) of a part samples are drawn from."""
        out = part.wanted.copy()
        for code, share in self._shares.items():
            rows = np.flatnonzero(part.sure & (part.codes == code))
            out[rows[hash_rows(xyz[rows].T, self._seed) / 2.0**64 < share]] = True
        return out

    def report_to(self, report: Report) -> None:
        """Report which points samples are drawn from."""
        report.figures["checked"] = self._wanted
        text = f"{self._wanted:,} of {self._points:,} points were checked by a person ({CHECKED}): "
        text += "samples are drawn from these"
        if self._known is not None:
            report.figures["anchors"] = self._beside
        if self._beside:
            text += f", and from about {self._beside:,} others of which the base is sure: it is "
            text += "kept where nobody looked"
        elif self._known is not None:
            text += " alone; nothing keeps the base where nobody looked, as no other point has a "
            text += f"Reliability of {SURE:g} or more"
        else:
            text += " alone, the others are neighbors"
        report.notes.append(text)
