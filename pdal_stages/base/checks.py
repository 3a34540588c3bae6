"""Checks of values with one wording: what was expected and what was found.

Of single values and of JSON; options (:mod:`.options`) are checked by these.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

import numpy as np

from .errors import OptionError, suggest
from .json_types import JsonObject

_Value = TypeVar("_Value")


def whole(
    what: str, value: object, low: float | None = None, high: float | None = None, *, unit: str = ""
) -> int:
    """Return a whole number within bounds, both included; 2.0 is one, too.

    Parameters
    ----------
    what : str
        The name of the value in messages, e.g. ``'count'`` with its quotes.

    Raises
    ------
    OptionError
        Naming the bounds and what was found.
    """
    x = finite(value)
    if x is None or x != int(x) or not _in_bounds(x, low, high):
        raise OptionError(
            f"{what} must be a whole number{bounds(low, high, unit=unit)}", found=_shown(value)
        )
    return int(x)


def number(
    what: str,
    value: object,
    low: float | None = None,
    high: float | None = None,
    *,
    above: bool = False,
    unit: str = "",
) -> float:
    """Return a finite number in bounds, the lower one excluded with `above`; see :func:`whole`."""
    x = finite(value)
    if x is None or not _in_bounds(x, low, high) or (above and x == low):
        raise OptionError(
            f"{what} must be a number{bounds(low, high, above, unit)}", found=_shown(value)
        )
    return float(x)


def flag(what: str, value: object) -> bool:
    """Return a truth value; see :func:`whole`."""
    if not isinstance(value, bool | np.bool_):
        raise OptionError(f"{what} must be true or false", found=_shown(value))
    return bool(value)


def one_of(what: str, value: _Value, choices: Iterable[object]) -> _Value:
    """Return a value that is one of the choices; see :func:`whole`."""
    known = list(choices)
    if not any(type(value) is type(choice) and value == choice for choice in known):
        raise OptionError(
            f"{what} must be {'one of ' * (len(known) > 1)}{', '.join(map(repr, known))}"
            + ", or left out" * (len(known) == 1),
            found=_shown(value),
            cure=suggest(str(value), map(str, known)) or None,
        )
    return value


def names(what: str, value: object) -> tuple[str, ...]:
    """Return names without duplicates, from a list or comma-separated text; see :func:`whole`."""
    if isinstance(value, str):
        value = [part.strip() for part in value.split(",") if part.strip()]
    items = list(value) if isinstance(value, Iterable) else None
    if items is None or not all(isinstance(name, str) for name in items):
        raise OptionError(f"{what} must be a list of names", found=_shown(value))
    return tuple(dict.fromkeys(items))


def bounds(low: float | None, high: float | None, above: bool = False, unit: str = "") -> str:
    """Return bounds in words, to follow "a number"."""
    unit = f" {unit}" if unit else ""
    if low is None:
        return "" if high is None else f" of at most {_plain(high)}{unit}"
    if high is None:
        return f" above {_plain(low)}{unit}" if above else f" of {_plain(low)}{unit} or more"
    if above:
        return f" above {_plain(low)} and at most {_plain(high)}{unit}"
    return f" from {_plain(low)} to {_plain(high)}{unit}"


def finite(value: object) -> int | float | None:
    """Return a number that is finite as a double; None for anything else, booleans too."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        return None
    try:
        is_finite = math.isfinite(value)
    except OverflowError:
        return None
    plain = value.item() if isinstance(value, np.generic) else value
    return plain if is_finite else None


def _in_bounds(value: float, low: float | None, high: float | None) -> bool:
    return (low is None or value >= low) and (high is None or value <= high)


def _plain(bound: float) -> str:
    return str(bound) if isinstance(bound, int) else f"{bound:g}"


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


#: No option, pipeline or manifest has lists and objects as deep inside each other; deeper ones
#: would exceed Python's recursion somewhere.
MOST_NESTED = 100


def strict_json(text: str | bytes) -> Any:
    """Parse a JSON text without NaN, numbers beyond a double (1e999) and duplicate keys.

    Raises
    ------
    ValueError
        If it is not JSON, a number is not finite, an object has a key twice, or values are nested
        too deeply.
    RecursionError
        If it is nested much too deeply.
    """
    value = json.loads(
        text,
        parse_constant=refuse_constant,
        parse_float=_finite,
        parse_int=lambda word: _finite(word, int),
        object_pairs_hook=_unique,
    )
    refuse_nested(value)
    return value


def refuse_nested(value: object) -> None:
    """Refuse lists and objects inside each other, more than `MOST_NESTED` deep, by ValueError."""
    level = [value]
    for _ in range(MOST_NESTED + 1):
        lists = [each for each in level if isinstance(each, list | tuple)]
        objects = [each.values() for each in level if isinstance(each, Mapping)]
        level = [inner for each in (*lists, *objects) for inner in each]
        if not level:
            return
    raise ValueError(f"it is nested more than {MOST_NESTED} deep")


def refuse_constant(word: str) -> None:
    """Refuse NaN and Infinity, which are not JSON."""
    raise ValueError(f"{word} is not a JSON number")


def _finite(word: str, kind: type[float] = float) -> float:
    if not math.isfinite(float(word)):
        raise ValueError(f"{word[:40]} is too large for a number")
    return kind(word)


def _unique(pairs: list[tuple[str, object]]) -> JsonObject:
    out = dict(pairs)
    if len(out) != len(pairs):
        raise ValueError("duplicate key in one object")
    return out
