"""Dataclass fields with a description and bounds, which are checked when an object is created."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field, fields
from typing import Any

from . import checks


def setting(default: Any, kind: str, help: str, *bounds: float | None, **rule: Any) -> Any:
    """Declare a field with a description of one sentence and, for a number, its `bounds`.

    `kind` and `rule` (``exclusive``, ``unit``, ``choices``) are those of an option of a stage; or
    `rule` has a ``check``, a function of a name and the value that returns what the field holds.
    With MISSING as `default` it is required.
    """
    if bounds:
        rule |= {"minimum": bounds[0], "maximum": bounds[1]}
    return field(default=default, metadata={"kind": kind, "help": help, **rule})


class Settings:
    """Base of dataclasses with settings."""

    def __post_init__(self) -> None:
        """Check all settings but those that keep a default of None; OptionError for a bad value."""
        for each in fields(self):  # type: ignore[arg-type]
            value = getattr(self, each.name)
            if each.metadata and not (value is None and each.default is None):
                object.__setattr__(self, each.name, _check(f"'{each.name}'", value, each.metadata))


def _check(what: str, value: Any, rule: Mapping[str, Any]) -> Any:
    if "check" in rule:
        return rule["check"](what, value)
    if "choices" in rule:
        return checks.one_of(what, value, rule["choices"])
    if rule["kind"] == "boolean":
        return checks.flag(what, value)
    if "minimum" not in rule:
        return value
    if rule["kind"] == "integer":
        return checks.whole(what, value, rule["minimum"], rule["maximum"])
    above, unit = rule.get("exclusive", False), rule.get("unit", "")
    return checks.number(what, value, rule["minimum"], rule["maximum"], above=above, unit=unit)
