"""Options that several stages have; how options are declared is in :mod:`..base.options`."""

from __future__ import annotations

from typing import Any

from ..base.asprs import NOISE, OVERLAP
from ..base.options import Option, option, option_of
from ..base.selections import Selection

__all__ = [
    "UNWANTED", "Option", "Selection", "code_option", "ignore_option", "keep_option", "option",
    "option_of",
]  # fmt: skip

#: Noise, and points that their supplier withheld: by default neither neighbors nor overwritten.
UNWANTED = (*NOISE, "withheld")


def code_option(default: int | None, help: str) -> Any:
    """Declare an option for a class code."""
    return option("integer", default, help, 0, 255)


def ignore_option(
    points: str = "Points that are left out, even as neighbors, and keep their class",
) -> Any:
    """Declare the option `ignore`, by default noise and withheld points; `points` is its help."""
    words = ": class codes, ranges such as Classification[7:7], or the word withheld"
    return option("selection", UNWANTED, points + words, may_be_empty=True)


def keep_option(points: str = "Points that are neighbors but keep their class") -> Any:
    """Declare the option `keep`, by default overlap; `points` is its help."""
    return option("selection", (OVERLAP,), points, may_be_empty=True)
