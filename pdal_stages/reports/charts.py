"""A chart with axes: where its marks lie; the template ``pieces.html`` draws it as SVG."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

#: A position on an axis, and the text there.
Tick = tuple[float, str]


@dataclass(frozen=True)
class Chart:
    """A chart."""

    heading: str  #: above it
    alt: str  #: what it shows, in words
    x_label: str  #: the axes' titles
    y_label: str
    caption: str = ""  #: below it
    x: tuple[float, float] = (0.0, 1.0)  #: the axes' ranges
    y: tuple[float, float] = (0.0, 1.0)
    x_ticks: Sequence[Tick] = ()
    y_ticks: Sequence[Tick] = ()
    #: left, right, top, kind ("faint" or "bad"), and a title that shows on hovering
    bars: Sequence[tuple[float, float, float, str, str]] = ()
    #: points, and a kind: "line" or "ideal" (dashed)
    lines: Sequence[tuple[Sequence[tuple[float, float]], str]] = ()
    dots: Sequence[tuple[float, float, str]] = ()  #: x, y, title
    values: Sequence[tuple[float, float, str]] = ()  #: x, y, and text centered above that place

    #: Size of the drawing, and what is left for the axes' texts.
    WIDE: ClassVar = 520
    HIGH: ClassVar = 320
    LEFT: ClassVar = 62
    BELOW: ClassVar = 52
    EDGE: ClassVar = 14

    def across(self, x: float) -> float:
        """Pixels from the left of a place on the x axis."""
        low, high = self.x
        return round(self.LEFT + (x - low) / (high - low) * (self.WIDE - self.LEFT - self.EDGE), 1)

    def down(self, y: float) -> float:
        """Pixels from the top of a place on the y axis."""
        low, high = self.y
        return round(
            self.HIGH - self.BELOW - (y - low) / (high - low) * (self.HIGH - self.EDGE - self.BELOW), 1
        )


def percent_axis(most: float) -> tuple[float, list[Tick]]:
    """The end of an axis from 0 that holds a share, and two to six round ticks in percent."""
    for step in (0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2):
        if most <= 5 * step:
            break
    count = max(1, math.ceil(most / step - 1e-9))
    return count * step, [(i * step, f"{100 * i * step:g}") for i in range(count + 1)]
