"""The log file of a run: what was asked for, what was said, how it ended."""

from __future__ import annotations

import contextlib
import shlex
import time
from collections.abc import Sequence
from typing import Any

from .errors import StageError
from .kinds import kind_of
from .version import __version__


class RunLog:
    """A stream that writes to another and, each line with its time, to the end of a log file.

    Parameters
    ----------
    path : str
    stream : text stream
        Where what is said goes as well.
    arguments : sequence of str
        The command's, for the first line.

    Raises
    ------
    StageError
        The file cannot be written, or is one of another kind.
    """

    def __init__(self, path: str, stream: Any, arguments: Sequence[str]) -> None:
        self.stream = stream
        if kind := kind_of(path):
            raise StageError(f"the log would be added to {kind}", where="--log", found=path)
        try:
            self._file: Any = open(path, "a", encoding="utf-8", errors="backslashreplace")  # noqa: SIM115
        except OSError as error:
            raise StageError(
                "the log cannot be written", where="--log", found=f"{path}: {error.strerror}"
            ) from None
        self._started = time.monotonic()
        self._line = ""
        self._add(f"pdal-stages {__version__}: {shlex.join(arguments)}")

    def write(self, text: str) -> int:
        self.stream.write(text)
        *lines, self._line = (self._line + text).split("\n")
        for line in lines:
            self._add(line)
        return len(text)

    def end(self, code: int) -> None:
        """Write the exit code and the time that was needed, and close the file."""
        self._add(f"exit code {code} after {time.monotonic() - self._started:.1f} s")
        if self._file is not None:
            self._file.close()

    def _add(self, line: str) -> None:
        if self._file is None:
            return
        try:
            self._file.write(f"{time.strftime('%Y-%m-%d %H:%M:%S')} {line.strip()}\n")
            self._file.flush()
        except OSError as error:  # the run goes on without its log
            with contextlib.suppress(OSError):
                self._file.close()
            self._file = None
            self.stream.write(f"pdal-stages: the log cannot be written any more: {error.strerror}\n")

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)
