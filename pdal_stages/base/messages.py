"""Output for the user: messages that are safe for terminals, progress, reports of stages, and the log of a run."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable
from typing import Any

_COMMANDS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069]")


def plain(text: str) -> str:
    """Text with control characters escaped, except line breaks and tabs."""
    return _COMMANDS.sub(lambda match: ascii(match.group())[1:-1], text)


def one_line(text: str) -> str:
    """The same with line breaks escaped as well, so that a file name cannot look like separate lines."""
    return plain(text).replace("\n", "\\n")


def print_messages(*lines: str) -> None:
    """Print messages for the user on standard error."""
    for line in lines:
        print(f"pdal-stages: {line}", file=sys.stderr)


def counted(count: int, word: str) -> str:
    """A number of things: ``1 tile``, ``1,200 tiles``."""
    return f"{count:,} {word}{'s' * (count != 1)}"


class PlainStream:
    """A text stream that passes text through :func:`plain`; everything else is delegated."""

    def __init__(self, stream: Any) -> None:
        self.stream = stream

    def write(self, text: str) -> int:
        self.stream.write(plain(text))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


def duration(seconds: float) -> str:
    """Seconds up to two minutes, then minutes, then hours: ``95 s``, ``12 min``, ``3 h 20 min``."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60:02d} min"
