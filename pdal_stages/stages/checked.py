"""Points that a person checked: samples are drawn from these, and from others that keep what a base knows.

What is corrected lies where the base was unsure: from that alone a forest does not learn what the rest looks like. So of
each class as many points stand beside as were checked of the most frequent, those of the least hashes among all of which
the base is sure. That is decided by all points at once, or by counts and hashes of the parts of a cloud: the same.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..base.errors import StageError
from ..base.hashing import coordinate_hash
from ..base.report import Report
from ..classifier.dimensions import CHECKED

#: A base is sure of a point from this reliability on.
SURE = 0.95


class Looked(NamedTuple):
    """Points of a part."""

    checked: int  #: how many a person looked at, wherever they lie
    wanted: NDArray[np.bool_]  #: (n,) of these, those that samples may be drawn from
    sure: NDArray[
        np.bool_
    ]  #: (n,) of all others that samples may be drawn from, those of which the base is sure
    codes: NDArray  #: (n,) class codes

    @classmethod
    def at(
        cls,
        checked: NDArray[np.bool_],
        inside: NDArray[np.bool_],
        reliability: NDArray | None,
        codes: NDArray,
    ) -> Looked:
        """Points of which some were `checked` and those `inside` may be drawn from."""
        sure = np.zeros(len(codes), np.bool_) if reliability is None else reliability >= SURE
        return cls(int(np.count_nonzero(checked)), checked & inside, sure & inside & ~checked, codes)

    def told(self) -> dict[str, int]:
        """How many points of each class may be drawn from, as JSON has it."""
        found, number = np.unique(self.codes[self.wanted], return_counts=True)
        return {str(code): n for code, n in zip(found.tolist(), number.tolist(), strict=True)}


class CheckedChoice:
    """What samples are drawn from, of a cloud whose parts are counted first; `known`: the classes of the base, if any."""

    def __init__(self, known: Collection[int] | None, seed: int) -> None:
        self._known, self._seed = known, seed
        self._points = self._checked = 0
        self._told: Counter[int] = Counter()
        self._least: dict[int, NDArray[np.uint64]] = {}  # hashes of the points that stand beside

    def count(self, points: int, checked: int, told: Mapping[str, int]) -> None:
        """Of a part: its points, those that were checked, and of these those of each class that may be drawn from."""
        self._points += points
        self._checked += checked
        self._told.update({int(code): n for code, n in told.items()})

    def __bool__(self) -> bool:
        """Whether any point was checked."""
        return self._checked > 0

    def hashes(self, xyz: NDArray[np.float64]) -> NDArray[np.uint64]:
        """Of points, by which they are chosen."""
        return coordinate_hash(xyz, self._seed)

    def settle(self, sure: Iterable[tuple[NDArray, NDArray[np.uint64]]]) -> None:
        """Choose among the points of which the base is sure; their class codes and hashes, part by part."""
        if not self._told:
            raise StageError(
                "no checked point lies inside 'where'", found=f"{self._checked:,} checked points"
            )
        most = max((n for code, n in self._told.items() if code in (self._known or ())), default=0)
        for codes, hashes in sure if most else ():
            for code in self._told.keys() & set(self._known or ()):
                least = np.append(self._least.get(code, np.zeros(0, np.uint64)), hashes[codes == code])
                self._least[code] = np.partition(least, most - 1)[:most] if len(least) > most else least

    def mask(self, looked: Looked, xyz: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which points of a part samples are drawn from."""
        out = looked.wanted.copy()
        for code, least in self._least.items():
            mine = np.flatnonzero(looked.sure & (looked.codes == code))
            if len(mine) and len(least):
                out[mine[self.hashes(xyz[mine]) <= least.max()]] = True
        return out

    def say(self, report: Report) -> None:
        """What is to be known of it."""
        number, beside = sum(self._told.values()), sum(map(len, self._least.values()))
        report.figures["checked"] = number
        said = f"{number:,} of {self._points:,} points were checked by a person ({CHECKED}): samples are drawn from these"
        if self._known is not None:
            report.figures["anchors"] = beside
        if beside:
            said += f", and from {beside:,} others of which the base is sure, so that it is kept where nobody looked"
        else:
            said += " alone, the others are neighbors"
            if self._known is not None:
                said += (
                    "; nothing keeps the base where nobody looked, as no other point has a Reliability of "
                    f"{SURE:g} or more"
                )
        report.notes.append(said)
