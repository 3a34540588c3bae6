"""Options set on the command line: ``--stage.TAG.option=value`` and
``--filters.name.option=value``, as in PDAL.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from ..base.errors import OptionError, suggest

_FLAG = re.compile(
    r"^--(?:stage\.(?P<tag>[^.=]+)|(?P<type>(?:readers|filters|writers)\.\w+))\.(?P<option>\w+)$"
)


@dataclass(frozen=True)
class Override:
    """An option set from outside: for stages with a tag, or of a type."""

    selector: str
    by_tag: bool
    option: str
    value: str

    @property
    def flag(self) -> str:
        return f"--{'stage.' if self.by_tag else ''}{self.selector}.{self.option}={self.value}"


def parse_overrides(arguments: Iterable[str]) -> tuple[list[Override], list[str]]:
    """Overrides among command-line arguments, and the other arguments.

    The value follows after ``=`` or as the next argument.
    """
    found: list[Override] = []
    rest: list[str] = []
    waiting = list(arguments)
    while waiting:
        word = waiting.pop(0)
        flag, equals, value = word.partition("=")
        match = _FLAG.match(flag)
        if match is None:
            rest.append(word)
            continue
        if not equals:
            if not waiting or waiting[0].startswith("--"):
                raise OptionError(f"'{flag}' has no value", cure=f"Write {flag}=VALUE")
            value = waiting.pop(0)
        found.append(
            Override(
                match["tag"] or match["type"], match["tag"] is not None, match["option"], value
            )
        )
    return found, rest


def apply_overrides(stages: list[Any], overrides: Iterable[Override]) -> list[Any]:
    """The stages with overrides applied; one that fits no stage is an error."""
    out = [dict(s) if isinstance(s, dict) else s for s in stages]
    for override in overrides:
        key = "tag" if override.by_tag else "type"
        hits = [s for s in out if isinstance(s, dict) and str(s.get(key, "")) == override.selector]
        if not hits:
            known = sorted({str(s[key]) for s in out if isinstance(s, dict) and key in s})
            there = (
                f"The pipeline's {key}s: {', '.join(known)}" if known else f"No stage has a {key}"
            )
            raise OptionError(
                f"no stage of the pipeline has the {key} '{override.selector}'",
                found=override.flag,
                cure=suggest(override.selector, known) + there,
            )
        for stage in hits:
            stage[override.option] = override.value
    return out
