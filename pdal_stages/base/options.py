"""Options: one declaration gives JSON Schema, command line, help, the docs table and the errors.

A stage declares them in its class body (:func:`option`), a function that is called without PDAL in
a dataclass (:class:`Settings`), whose fields are options of its stage as well.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from typing import Any

from . import checks
from .errors import OptionError, suggest
from .json_types import JsonObject
from .messages import shorten
from .selections import Selection, split_selection

_LISTED = ["array", "string"], "a list, or text separated by commas"
#: Kind of option -> its JSON type (PDAL takes numbers as text too), and what errors call it.
_KINDS: dict[str, tuple[str | list[str], str]] = {
    "number": (["number", "string"], "a number"),
    "integer": (["integer", "string"], "a whole number"),
    "string": ("string", "text"),
    "boolean": (["boolean", "string"], "true or false"),
    "filename": ("string", "a file name"),
    "folder": ("string", "a folder"),
    "model": ("string", "a model file, or the name of a shipped model"),
    "expression": ("string", 'a condition such as "Classification == 2"'),
    "list": _LISTED,
    "codes": _LISTED,
    "selection": _LISTED,
    "numbers": _LISTED,
    "classes": (["object", "array", "string"], "a list of class codes, or a mapping of labels"),
    "mapping": (["object", "string"], 'a mapping such as {"2": "Ground"}'),
}


@dataclass(frozen=True)
class Option:
    """An option of a stage, made by :func:`option`; read from a stage, its parsed value."""

    #: A key of ``_KINDS``. ``list`` is a JSON list or comma-separated text; ``codes`` a list of
    #: class codes, or of ranges as PDAL writes them, ``Classification[7:7]``; ``selection`` the
    #: same, of other dimensions too.
    kind: str
    #: The value where the option is absent; None means "decided by the stage".
    default: Any
    #: One sentence that ends without a full stop.
    help: str
    #: Bounds of a number; `exclusive` leaves the lower one out.
    minimum: float | None = None
    maximum: float | None = None
    exclusive: bool = False
    choices: tuple = ()
    #: Shown beside the default.
    unit: str = ""
    required: bool = False
    #: Whether an empty list means "none".
    may_be_empty: bool = False
    #: As the user types it; by default the attribute's name.
    name: str = ""

    def __set_name__(self, owner: type, name: str) -> None:
        """Take the attribute's name where the option has none of its own."""
        if not self.name:
            object.__setattr__(self, "name", name)

    def __get__(self, stage: Any, owner: type) -> Any:
        """Return the parsed value of a stage's option."""
        return self if stage is None else stage.options[self.name]

    @property
    def typed_default(self) -> str:
        """Return the default as a user would type it; empty where the stage decides."""
        if self.default in (None, ""):
            return ""
        values = self.default if isinstance(self.default, tuple) else (self.default,)
        return ",".join(str(v).lower() if isinstance(v, bool) else str(v) for v in values)

    @property
    def shown_default(self) -> str:
        """Return the default as a user would type it, with its unit."""
        return f"{self.typed_default} {self.unit}".strip() if self.typed_default else ""

    def schema(self) -> JsonObject:
        """Return the option's JSON Schema."""
        out: JsonObject = {"description": self.help, "type": _KINDS[self.kind][0]}
        if self.minimum is not None:
            out["exclusiveMinimum" if self.exclusive else "minimum"] = self.minimum
        if self.maximum is not None:
            out["maximum"] = self.maximum
        if self.choices:
            out["enum"] = list(self.choices)
        if self.default is not None:
            out["default"] = self.default
        return out

    def decode(self, value: object) -> object:
        """Return the object or list of a JSON text, where the option takes an object.

        Stock PDAL and the command line give options as text. Other values return as they are.
        """
        takes_object = "object" in _KINDS[self.kind][0]
        if not (takes_object and isinstance(value, str) and value.lstrip().startswith(("{", "["))):
            return value
        try:
            return checks.strict_json(value)
        except (ValueError, RecursionError):
            raise self._wrong(value) from None

    def parse(self, value: object) -> Any:
        """Parse a value from JSON or the command line; OptionError where it does not fit."""
        parsed = getattr(self, f"_parse_{self.kind}", self._parse_string)(value)
        if self.choices:
            checks.one_of(f"option '{self.name}'", parsed, self.choices)
        return parsed

    def _wrong(self, value: object) -> OptionError:
        what = f"option '{self.name}' must be {_KINDS[self.kind][1]}"
        return OptionError(what, found=shorten(json.dumps(value, default=str)))

    def check(self, what: str, value: object) -> Any:
        """Return a value that fits, of a number, a truth value or choices; others as they are."""
        low, high = self.minimum, self.maximum
        if self.choices:
            return checks.one_of(what, value, self.choices)
        if self.kind == "boolean":
            return checks.flag(what, value)
        if self.kind == "integer":
            return checks.whole(what, value, low, high, unit=self.unit)
        if self.kind == "number":
            return checks.number(what, value, low, high, above=self.exclusive, unit=self.unit)
        return value

    def _parse_number(self, value: object) -> float:
        with suppress(ValueError):
            value = float(value) if isinstance(value, str) else value
        kind = "integer" if self.kind == "integer" else "number"
        return replace(self, kind=kind, choices=()).check(f"option '{self.name}'", value)

    _parse_integer = _parse_number

    def _parse_boolean(self, value: object) -> bool:
        word = str(value).strip().lower()
        if not isinstance(value, bool | str) or word not in ("true", "false"):
            raise self._wrong(value)
        return word == "true"

    def _parse_string(self, value: object) -> str:
        if not isinstance(value, str):
            raise self._wrong(value)
        if self.kind in ("filename", "folder", "model", "expression") and not value.strip():
            raise OptionError(
                f"option '{self.name}' is empty",
                cure=f"Give {_KINDS[self.kind][1]}, or leave it out",
            )
        return value

    def _parse_classes(self, value: object) -> str | list | dict:
        """Leave the reading to :class:`..classifier.class_map.ClassMap`."""
        if not isinstance(value, str | list | dict):
            raise self._wrong(value)
        return value

    def _parse_list(self, value: object) -> list:
        if isinstance(value, str):
            value = split_list(value)
        elif checks.finite(value) is not None:
            value = [value]
        if not isinstance(value, list | tuple) or not all(
            isinstance(v, str | int | float) and not isinstance(v, bool) for v in value
        ):
            raise self._wrong(value)
        if not value and self.default and not self.may_be_empty:
            raise OptionError(
                f"option '{self.name}' is an empty list",
                cure="Name at least one, or leave the option out for the default "
                f"({', '.join(map(str, self.default))})",
            )
        return list(value)

    def _parse_numbers(self, value: object) -> list[float]:
        return [self._parse_number(item) for item in self._parse_list(value)]

    def _parse_codes(self, value: object) -> list[int]:
        chosen = self._parse_selection(value)
        if chosen.spans:
            raise OptionError(
                f"option '{self.name}' must list class codes of 0 to 255",
                found=chosen.spans[0].dimension,
            )
        return list(chosen.codes)

    def _parse_selection(self, value: object) -> Selection:
        return Selection.parse(self._parse_list(split_selection(value)), self.name)

    def _parse_mapping(self, value: object) -> dict:
        if not isinstance(value, dict):
            raise self._wrong(value)
        return value


def option(
    kind: str,
    default: object,
    help: str,
    minimum: float | None = None,
    maximum: float | None = None,
    **more: Any,
) -> Any:
    """Declare an option in a stage's class body, a number with its lower and upper bound.

    ``cell: float = option("number", 20.0, "Side of the cells", 0.1, 100, unit="m")``: the
    annotation is the type of the parsed value, all else is as for :class:`Option`.
    """
    return Option(kind, default, help, minimum, maximum, **more)


#: A function of the name and the value of a setting; it returns what the field holds.
Check = Callable[[str, object], object]


def setting(
    default: object,
    kind: str,
    help: str,
    minimum: float | None = None,
    maximum: float | None = None,
    *,
    check: Check | None = None,
    **more: Any,
) -> Any:
    """Declare a field of :class:`Settings`: an :class:`Option` that is a keyword argument, too.

    `more` are further fields of the option. A `check` replaces that by kind and choices.
    """
    option = Option(kind, default, help, minimum, maximum, **more)
    return field(default=default, metadata={"option": option, "check": check or option.check})


def option_of(settings: type, name: str, **other: Any) -> Any:
    """Return the option that a dataclass of settings declares; `other` are fields that differ."""
    (declared,) = (field for field in fields(settings) if field.name == name)
    return replace(declared.metadata["option"], **{"name": name, **other})


class Settings:
    """Base of dataclasses with settings: options that are keyword arguments of a function."""

    def __post_init__(self) -> None:
        """Check all settings but those that keep a default of None; OptionError for a bad value."""
        for each in fields(self):  # type: ignore[arg-type]
            value = getattr(self, each.name)
            if each.metadata and not (value is None and each.default is None):
                checked = each.metadata["check"](f"'{each.name}'", value)
                object.__setattr__(self, each.name, checked)


def split_list(text: str) -> list[str]:
    """Split at commas outside parentheses: ``c1,kopt(10,50)`` is two tokens."""
    return [part.strip() for part in re.split(r",(?![^(]*\))", text) if part.strip()]


def decode_options(declared: Iterable[Option], raw: Mapping[str, object]) -> dict[str, object]:
    """Return raw options with the objects that are given as text decoded."""
    known = {option.name: option for option in declared}
    return {name: known[name].decode(raw[name]) if name in known else raw[name] for name in raw}


def parse_options(declared: Iterable[Option], raw: Mapping[str, object]) -> JsonObject:
    """Return the value of every declared option; OptionError where a raw one does not fit."""
    known = {option.name: option for option in declared}
    for name in raw:
        if name not in known:
            raise OptionError(
                f"there is no option '{name}'",
                found=json.dumps(raw[name], default=str)[:80],
                cure=f"{suggest(name, known)}Options: {', '.join(sorted(known))}",
            )
    values: JsonObject = {}
    for name, option in known.items():
        if name in raw:
            try:
                checks.refuse_nested(raw[name])
            except ValueError as error:
                raise OptionError(f"option '{name}' cannot be read", found=error) from None
            values[name] = option.parse(raw[name])
        elif option.required:
            raise OptionError(f"option '{name}' is required", cure=option.help)
        elif option.kind == "selection" and option.default is not None:
            values[name] = option.parse(option.default)
        else:
            default = option.default
            values[name] = list(default) if isinstance(default, tuple) else default
    return values
