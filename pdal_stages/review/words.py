"""The words of explanations, from words.json: sentences to fill in, and the names of inputs."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from functools import cache
from importlib import resources
from operator import attrgetter
from string import Formatter
from typing import cast

from ..base.asprs import class_name
from ..base.dimensions import opening_width
from ..base.messages import one_line
from ..features.registry import BY_NAME, SHAPES
from .explanation import Explanation, GroundSteps, Noise, StepAfter, Verdict

#: What rows tell of.
Record = Explanation | Noise | GroundSteps | Verdict | StepAfter
#: A part of a condition: a field, and the value or limit that it is compared with, if any.
_CLAUSE = re.compile(r"(not )?([\w.]+)([=<>]?)(.*)")


@cache
def _words() -> dict[str, dict]:
    """Return the tables of sentences, ``rows``, and the words for ``inputs``."""
    return json.loads(resources.files(__package__).joinpath("words.json").read_text("utf-8"))


class _Fields(Formatter):
    """Fills templates with fields and properties of a record, in the units of the text."""

    def get_value(self, key: int | str, args: Sequence[object], kwargs: object) -> object:
        """Return a field of the record, the only argument."""
        return getattr(args[0], str(key))

    def format_field(self, value: object, format_spec: str) -> str:
        """Return a value in its unit."""
        if isinstance(value, (float, int)) and format_spec in ("relative", "size"):
            side = "below this point" if value <= 0 else "above this point"
            return f"{abs(value):.2f} m {side if format_spec == 'relative' else ''}".rstrip()
        if isinstance(value, int) and format_spec == "class":
            return f"{value} {class_name(value)}"
        if isinstance(value, dict) and format_spec == "windows":
            return ", ".join(f"{high:.2f} m ({width:g} m window)" for width, high in value.items())
        if format_spec == "line":
            return one_line(str(value))
        return "none" if value is None else super().format_field(value, format_spec)


def fill(table: str, record: Record, count: int | None = None) -> list[tuple[str, str]]:
    """Return name and text of the rows of a table that apply to a record.

    `count` are the most that are returned, the first ones.
    """
    fields, rows = _Fields(), _words()["rows"][table]
    chosen = [(name, text) for name, condition, text in rows if _applies(condition, record)]
    return [(fields.format(n, record), fields.format(text, record)) for n, text in chosen[:count]]


def _applies(condition: str, record: Record) -> bool:
    """Return whether all clauses of a condition hold."""
    for clause in condition.split(" and ") if condition else ():
        inverse, name, sign, limit = cast(re.Match[str], _CLAUSE.fullmatch(clause)).groups()
        value = attrgetter(name)(record)
        holds = str(value) == limit if sign == "=" else bool(value)
        if sign in ("<", ">"):
            holds = (value > float(limit)) == (sign == ">")
        if holds == bool(inverse):
            return False
    return True


def words_for(name: str) -> tuple[str, str]:
    """Return an input in words, and the unit of its values; of an unknown one its own name."""
    if (width := opening_width(name)) is not None:
        return f"height above what a window of {width:g} m leaves", "m"
    feature, _, where = name.partition("_")
    if feature in SHAPES:
        return SHAPES[feature], "share"
    known = _words()["inputs"].get(feature)
    if known is None:
        return (BY_NAME[feature].definition if feature in BY_NAME else name), ""
    words, unit = known
    for head, text in _words()["neighborhoods"].items():
        size = where.removeprefix(head).replace("_", ".")
        if where.startswith(head) and size.replace(".", "").isdecimal():
            return f"{words}, {text.format(size)}", unit
    return f"{words}, {where}" if where else words, unit


def show_value(name: str, value: float) -> str:
    """Return the value of an input with its unit."""
    value = 0.0 if abs(value) < 5e-4 else value
    return f"{value:.3g} {words_for(name)[1]}".rstrip()
