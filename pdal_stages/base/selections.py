"""Selections of points as PDAL writes them: class codes, and ranges of dimensions."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import OptionError

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)"
#: One range as PDAL writes it.
RANGE = re.compile(rf"([A-Za-z]\w*)\s*(!?)\s*([\[(])\s*({_NUMBER})?\s*:\s*({_NUMBER})?\s*([\])])")
_CURE = "Write 7,18 or, as PDAL has it, Classification[7:7]; withheld is short for Withheld[1:1]"


@dataclass(frozen=True)
class Span:
    """A range of a dimension.

    ``Name[low:high]``; ``(`` and ``)`` exclude the ends, ``Name![low:high]`` is what lies outside.
    """

    dimension: str
    low: float
    high: float
    with_low: bool
    with_high: bool
    outside: bool

    def contains(self, values: NDArray) -> NDArray[np.bool_]:
        """Return which values (n,) lie in the range."""
        inside = (values >= self.low) if self.with_low else (values > self.low)
        inside &= (values <= self.high) if self.with_high else (values < self.high)
        return ~inside if self.outside else inside


@dataclass(frozen=True)
class Selection:
    """Points of some classes, and points in ranges of other dimensions; any of them suffices.

    As PDAL writes them: ``Classification[7:7]`` is class 7, ``ReturnNumber[0:0]`` are the points
    without a return number.
    """

    codes: tuple[int, ...] = ()
    spans: tuple[Span, ...] = ()

    def __bool__(self) -> bool:
        """Return whether anything is selected."""
        return bool(self.codes or self.spans)

    @classmethod
    def parse(cls, items: Iterable[object], option: str) -> Selection:
        """Read class codes, ranges and the word ``withheld``; errors name the option."""
        codes: list[int] = []
        spans: list[Span] = []
        for item in filter(None, (str(item).strip() for item in items)):
            if item in map(str, range(256)):
                codes.append(int(item))
                continue
            match = RANGE.fullmatch("Withheld[1:1]" if item.lower() == "withheld" else item)
            if match is None:
                raise OptionError(
                    f"option '{option}' must list class codes of 0 to 255, or ranges",
                    found=repr(item),
                    cure=_CURE,
                )
            name, outside, opens, low, high, closes = match.groups()
            low, high = float(low or -math.inf), float(high or math.inf)
            span = Span(name, low, high, opens == "[", closes == "]", bool(outside))
            if name.lower() == "classification":
                codes += np.flatnonzero(span.contains(np.arange(256.0))).tolist()
            else:
                spans.append(span)
        return cls(tuple(dict.fromkeys(codes)), tuple(dict.fromkeys(spans)))


def split_selection(value: object) -> Any:
    """Split the text of a selection at commas: ``9,Z[1:2)`` are two; return others unchanged."""
    return value.split(",") if isinstance(value, str) else value
