"""The log of a run: a file of timestamped lines, and a stream whose lines also go to it."""

from __future__ import annotations

import contextlib
import logging
import shlex
import sys
import threading
import time
from collections.abc import Sequence
from typing import Any

from .errors import StageError
from .messages import PlainStream, one_line
from .version import __version__


class RunLog(logging.FileHandler):
    """A log file to which timestamped lines are appended.

    Parameters
    ----------
    path : str
    arguments : sequence of str
        The command's, for the first line.
    stderr : text stream
        Where a failure to write the log is reported.

    Raises
    ------
    StageError
        The file cannot be written.
    """

    def __init__(self, path: str, arguments: Sequence[str], stderr: Any) -> None:
        try:
            super().__init__(path, encoding="utf-8", errors="backslashreplace")
        except OSError as error:
            what = f"{path}: {error.strerror}"
            raise StageError("the log cannot be written", where="--log", found=what) from None
        self.setFormatter(logging.Formatter("%(asctime)s %(message)s", "%Y-%m-%d %H:%M:%S"))
        self._stderr, self._failed, self._started = stderr, False, time.monotonic()
        self.add(f"pdal-stages {__version__}: {shlex.join(arguments)}")

    def end(self, code: int) -> None:
        """Write the exit code and the time that was needed, and close the file."""
        self.add(f"exit code {code} after {time.monotonic() - self._started:.1f} s")
        with contextlib.suppress(OSError):
            self.close()

    def add(self, line: str) -> None:
        """Write a line, from any thread."""
        if not self._failed:
            self.handle(logging.makeLogRecord({"msg": one_line(line.strip())}))

    def handleError(self, record: logging.LogRecord) -> None:
        """Report a failure to write once; the run goes on without its log."""
        self._failed = True
        self._stderr.write(
            f"pdal-stages: the log cannot be written any more: {sys.exc_info()[1]}\n"
        )


class LoggedStream(PlainStream):
    """A plain stream whose lines also go to a log."""

    def __init__(self, stream: Any, log: RunLog) -> None:
        super().__init__(stream)
        self.log = log
        self._begun = threading.local()  # a line may come in parts; those of threads are not mixed

    def write(self, text: str) -> int:
        """Write the escaped text to the stream and its complete lines to the log."""
        *lines, self._begun.line = (getattr(self._begun, "line", "") + text).split("\n")
        for line in lines:  # first, so that the log has all that was shown, even after Ctrl-C
            self.log.add(line)
        return super().write(text)
