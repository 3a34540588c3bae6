"""What a model file may say of an option of a stage before it: numbers in bounds and words of a list, never a path.

A stage that a model may carry declares so in its body, :attr:`Stage.in_models`, as the name of each option and one of
these rules. A rule is called with a value from a manifest, written by anybody, and gives it as it is used; what it does not
know raises :class:`ValueError` with what is allowed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from ..base.errors import StageError
from .selection import Selection
from .where import Expression

Rule = Callable[[Any], Any]
#: Most entries of a list, and characters of a text.
_MOST, _LONGEST = 32, 1000


def number(low: float, high: float) -> Rule:
    """A number from `low` to `high`; whole ones come as integers, text as the number it says."""

    def rule(value: Any) -> float:
        wrong = ValueError(f"a number from {low:g} to {high:g}")
        if isinstance(value, bool) or not isinstance(value, int | float | str) or len(str(value)) > 40:
            raise wrong
        try:
            found = float(value)
        except (ValueError, OverflowError):
            raise wrong from None
        if not (math.isfinite(found) and low <= found <= high):
            raise wrong
        return int(found) if found.is_integer() else found

    return rule


def whole(low: int, high: int) -> Rule:
    """A whole number from `low` to `high`."""

    def rule(value: Any) -> int:
        try:
            found = number(low, high)(value)
        except ValueError:
            found = math.nan
        if not isinstance(found, int):
            raise ValueError(f"a whole number from {low} to {high}")
        return found

    return rule


def numbers(low: float, high: float) -> Rule:
    """A list of such numbers, or text with commas."""

    def rule(value: Any) -> list[float]:
        try:
            return [number(low, high)(one) for one in _items(value)]
        except ValueError:
            raise ValueError(f"at most {_MOST} numbers from {low:g} to {high:g}") from None

    return rule


def flag(value: Any) -> bool:
    """True or false."""
    if isinstance(value, bool):
        return value
    if isinstance(value, str) and value.strip().lower() in ("true", "false"):
        return value.strip().lower() == "true"
    raise ValueError("true or false")


def words(*known: str) -> Rule:
    """A list of these words, or text with commas."""

    def rule(value: Any) -> list[str]:
        found = _items(value)
        if not found or not all(isinstance(one, str) and one in known for one in found):
            raise ValueError(f"of {', '.join(known)}")
        return found

    return rule


def selection(value: Any) -> list[str]:
    """Class codes, ranges of dimensions, or the word withheld, as our stages take them."""
    try:
        found = [str(one).strip() for one in _items(value)]
        Selection.parse(found, "")
    except (ValueError, StageError):
        raise ValueError("class codes of 0 to 255, or ranges such as Classification[7:7]") from None
    return found


def condition(value: Any) -> str:
    """A condition over dimensions, for a stage that evaluates it itself: all of ours."""
    try:
        if isinstance(value, str) and len(value) <= _LONGEST:
            Expression(value)
            return value
    except StageError:
        pass
    raise ValueError(f'a condition such as "Classification == 2" of at most {_LONGEST} characters')


def _items(value: Any) -> list[Any]:
    if isinstance(value, str):
        value = [one.strip() for one in value[: _LONGEST + 1].split(",") if one.strip()]
    elif isinstance(value, int | float) and not isinstance(value, bool):
        value = [value]
    if not isinstance(value, list) or len(value) > _MOST or any(len(str(one)) > _LONGEST for one in value):
        raise ValueError(f"a list of at most {_MOST}")
    return list(value)


#: Those of PDAL's that measure from points of class 2, and what must stand before them: PDAL 2.2 crashes where there are
#: none.
NEEDS_GROUND, MAKES_GROUND = ("filters.hag_nn", "filters.hag_delaunay"), "filters.smrf"
#: PDAL's stages that a model may carry. They read no file, move no point and leave none out; each writes `Classification`
#: or `HeightAboveGround` alone.
OF_PDAL: Mapping[str, Mapping[str, Rule]] = {
    "filters.smrf": {
        "cell": number(0.2, 100),
        "cut": number(0, 1000),
        "scalar": number(0, 100),
        "slope": number(0, 100),
        "threshold": number(0, 1000),
        "window": number(1, 1000),
        "ignore": words("Classification[7:7]", "Classification[18:18]"),
        "returns": words("first", "last", "intermediate", "only"),
    },
    "filters.hag_nn": {"count": whole(1, 1000), "max_distance": number(0, 1e6), "allow_extrapolation": flag},
    "filters.hag_delaunay": {"count": whole(1, 1000), "allow_extrapolation": flag},
}
