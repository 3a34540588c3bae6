"""Text for terminals: names and texts from files may hold control characters, or turn its lines round."""

from __future__ import annotations

import re
import sys
from typing import Any

_COMMANDS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069]")


def plain(text: str) -> str:
    """Text with such characters written as their codes; only line breaks and tabs stay."""
    return _COMMANDS.sub(lambda match: ascii(match.group())[1:-1], text)


def one_line(text: str) -> str:
    """The same with line breaks as codes too, so that a name cannot pass for lines of its own."""
    return plain(text).replace("\n", "\\n")


def print_messages(*lines: str) -> None:
    """Print messages for the user on standard error, as the command does."""
    for line in lines:
        print(f"pdal-stages: {line}", file=sys.stderr)


class PlainStream:
    """A text stream whose text is :func:`plain`; all else is the stream's."""

    def __init__(self, stream: Any) -> None:
        self.stream = stream

    def write(self, text: str) -> int:
        self.stream.write(plain(text))
        return len(text)

    def writelines(self, lines: Any) -> None:
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)
