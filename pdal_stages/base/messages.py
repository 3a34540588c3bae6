"""What a command says: text that is safe for terminals, and the log file of a run."""

from __future__ import annotations

import contextlib
import re
import shlex
import sys
import threading
import time
from collections.abc import Iterable, Sequence
from typing import Any

from .errors import StageError
from .version import __version__

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

    def writelines(self, lines: Iterable[str]) -> None:
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


class RunLog:
    """A file to whose end go lines, each with its time.

    Parameters
    ----------
    path : str
    arguments : sequence of str
        The command's, for the first line.
    stderr : text stream
        Hears when the log cannot be written any more.

    Raises
    ------
    StageError
        The file cannot be written.
    """

    def __init__(self, path: str, arguments: Sequence[str], stderr: Any) -> None:
        self._stderr, self._one = stderr, threading.Lock()
        try:
            self._file: Any = open(path, "a", encoding="utf-8", errors="backslashreplace")  # noqa: SIM115
        except OSError as error:
            found = f"{path}: {error.strerror}"
            raise StageError("the log cannot be written", where="--log", found=found) from None
        self._started = time.monotonic()
        self.add(f"pdal-stages {__version__}: {shlex.join(arguments)}")

    def end(self, code: int) -> None:
        """Write the exit code and the time that was needed, and close the file."""
        self.add(f"exit code {code} after {time.monotonic() - self._started:.1f} s")
        if self._file is not None:
            self._file.close()

    def add(self, line: str) -> None:
        """Write a line, from any thread."""
        with self._one:
            if self._file is None:
                return
            try:
                self._file.write(f"{time.strftime('%Y-%m-%d %H:%M:%S')} {one_line(line.strip())}\n")
                self._file.flush()
            except OSError as error:  # the run goes on without its log
                with contextlib.suppress(OSError):
                    self._file.close()
                self._file = None
                self._stderr.write(f"pdal-stages: the log cannot be written any more: {error.strerror}\n")


class LoggedStream(PlainStream):
    """The same, whose lines go to a log as well."""

    def __init__(self, stream: Any, log: RunLog) -> None:
        super().__init__(stream)
        self.log = log
        self._begun = threading.local()  # a line may come in parts; those of threads are not mixed

    def write(self, text: str) -> int:
        super().write(text)
        *lines, self._begun.line = (getattr(self._begun, "line", "") + text).split("\n")
        for line in lines:
            self.log.add(line)
        return len(text)
