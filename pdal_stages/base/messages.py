"""Texts for the user: safe for terminals, with counts and durations in words."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable
from typing import Any

#: Control characters, and those that change the direction of text, but for tabs and line breaks.
_CONTROLS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069]")


def plain(text: str) -> str:
    """Return a text with its control characters escaped, except line breaks and tabs."""
    return _CONTROLS.sub(lambda match: ascii(match.group())[1:-1], text)


def one_line(text: str) -> str:
    """Return a text on one line, escaped, so that a file name cannot look like separate lines."""
    return plain(text).replace("\n", "\\n")


def print_messages(*lines: str) -> None:
    """Print messages for the user on standard error."""
    for line in lines:
        print(f"pdal-stages: {line}", file=sys.stderr)


def count_of(count: int, word: str) -> str:
    """Return a number of things in words: ``1 tile``, ``1,200 tiles``."""
    return f"{count:,} {word}{'s' * (count != 1)}"


def duration(seconds: float) -> str:
    """Return a time in seconds, from two minutes on in minutes, later in hours: ``3 h 20 min``."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60:02d} min"


class PlainStream:
    """A text stream that passes text through :func:`plain` and delegates everything else."""

    def __init__(self, stream: Any) -> None:
        self.stream = stream

    def write(self, text: str) -> int:
        """Write the escaped text; return the number of characters before escaping."""
        self.stream.write(plain(text))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        """Write lines one by one."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the stream underneath."""
        return getattr(self.stream, name)
