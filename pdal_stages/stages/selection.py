"""Points chosen by class codes and ranges of dimensions, as PDAL's filters write them: ``Classification[7:7]``."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.asprs import NOISE
from ..base.errors import OptionError

#: Noise, and points that their supplier withheld: neither neighbors nor overwritten, unless told.
UNWANTED = (*NOISE, "withheld")
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)"
#: One range as PDAL writes it.
RANGE = re.compile(rf"([A-Za-z]\w*)\s*(!?)\s*([\[(])\s*({_NUMBER})?\s*:\s*({_NUMBER})?\s*([\])])")
_CURE = "Write 7,18 or, as PDAL has it, Classification[7:7]; withheld is short for Withheld[1:1]"


@dataclass(frozen=True)
class Span:
    """A range of a dimension: ``Name[low:high]``, ``(`` and ``)`` leave the ends out, ``!`` turns it round."""

    dimension: str
    low: float
    high: float
    with_low: bool
    with_high: bool
    outside: bool

    def holds(self, values: NDArray) -> NDArray[np.bool_]:
        """Which values lie in it."""
        inside = (values >= self.low) if self.with_low else (values > self.low)
        inside &= (values <= self.high) if self.with_high else (values < self.high)
        return ~inside if self.outside else inside


@dataclass(frozen=True)
class Selection:
    """Points of some classes, and points in ranges of other dimensions; any of them suffices."""

    codes: tuple[int, ...] = ()
    spans: tuple[Span, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.codes or self.spans)

    @classmethod
    def parse(cls, items: Iterable[Any], option: str) -> Selection:
        """From class codes, ranges and the word ``withheld``; errors name the option."""
        codes: list[int] = []
        spans: list[Span] = []
        for item in (str(item).strip() for item in items):
            if not item:
                continue
            found = RANGE.fullmatch("Withheld[1:1]" if item.lower() == "withheld" else item)
            if item in map(str, range(256)):
                codes.append(int(item))
            elif found is None:
                raise OptionError(
                    f"option '{option}' must list class codes of 0 to 255, or ranges",
                    found=repr(item),
                    cure=_CURE,
                )
            else:
                name, out, opens, low, high, closes = found.groups()
                span = Span(
                    name,
                    float(low) if low else -math.inf,
                    float(high) if high else math.inf,
                    opens == "[",
                    closes == "]",
                    bool(out),
                )
                if name.lower() == "classification":
                    codes += np.flatnonzero(span.holds(np.arange(256.0))).tolist()
                else:
                    spans.append(span)
        return cls(tuple(dict.fromkeys(codes)), tuple(dict.fromkeys(spans)))
