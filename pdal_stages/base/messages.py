"""Output for the user: messages that are safe for terminals, progress, reports of stages, and the log of a run."""

from __future__ import annotations

import contextlib
import logging
import os
import re
import shlex
import sys
import threading
import time
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Any, cast

from .errors import StageError
from .version import __version__

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


class Progress(AbstractContextManager):
    """A line of progress: `label`, the number of `unit` of `total` (0: unknown), rate, time left.

    Silent until `delay` seconds have passed. On a terminal the line is redrawn; elsewhere (a log) a new line is written
    every 15 seconds. The environment variable ``PDAL_STAGES_PROGRESS=0`` silences it, as ``enabled=False`` does;
    ``PDAL_STAGES_PROGRESS=lines`` writes a line every second, for a program that shows a bar of its own.
    """

    delay = 2.0

    def __init__(
        self, total: int, label: str, unit: str = "points", *, enabled: bool | None = None
    ) -> None:
        self.total, self.label, self.unit = int(total), label, unit
        # filters.python redirects sys.stdout, never stderr: stderr is always the user's.
        self.stream = cast(Any, sys.__stderr__)
        wanted = os.environ.get("PDAL_STAGES_PROGRESS", "1")
        self.enabled = self.stream is not None and enabled is not False and wanted != "0"
        self.count = 0
        self.started = time.monotonic()
        self._terminal = self.enabled and wanted != "lines" and self.stream.isatty()
        self._every = 0.2 if self._terminal else 15.0
        if wanted == "lines":
            self._every, self.delay = 1.0, 0.5
        self._next = self.started + self.delay
        self._shown = False

    def update(self, amount: int = 1) -> None:
        """Add finished work, and draw the line when it is due."""
        self.count += int(amount)
        now = time.monotonic()
        if self.enabled and now >= self._next:
            self._next = now + self._every
            self._draw(now)

    def _draw(self, now: float, end: bool = False) -> None:
        seconds = max(now - self.started, 1e-9)
        rate = self.count / seconds
        text = f"{self.label}: {self.count:,}"
        if self.total:
            text += f" of {self.total:,} {self.unit} ({100.0 * self.count / self.total:.0f} %)"
        else:
            text += f" {self.unit if self.count != 1 else self.unit.removesuffix('s')}"
        text += f", {rate:,.0f} {self.unit}/s" if rate >= 10 else f", {rate:.2g} {self.unit}/s"
        if end:
            text += f", {seconds:.1f} s"
        elif (
            self.total and 100 * self.count >= self.total
        ):  # before, it is mostly what starting took
            text += f", {duration(max(self.total - self.count, 0) / rate)} left"
        try:
            self.stream.write(f"\r{text}\x1b[K" if self._terminal else f"{text}\n")
            self.stream.flush()
        except (OSError, ValueError):  # a closed or full stderr must not stop the work
            self.enabled = False
        self._shown = True

    def clear(self) -> None:
        """Clear the line so that something else can be printed; it is redrawn when due."""
        if self._terminal and self._shown and self.enabled:
            self.stream.write("\r\x1b[K")
            self.stream.flush()

    def close(self) -> None:
        """Draw the last state, if anything was drawn at all."""
        if self._shown and self.enabled:
            self._draw(time.monotonic(), end=True)
            if self._terminal:
                self.stream.write("\n")
        self.enabled = False

    def __exit__(self, *exc) -> None:
        self.close()


@dataclass
class Report:
    """What a stage, a prediction or the feature engine reports besides its results."""

    #: counts and other JSON-able values by name, e.g. ``points`` or ``classes``
    figures: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)  #: what the user should know; nothing is wrong
    warnings: list[str] = field(default_factory=list)  #: what is likely wrong, and the cure
    #: By neighborhood, the points whose nearest neighbors lay farther away than the halo: in a tile of that halo their
    #: values may differ from those of the whole cloud.
    beyond_halo: dict[str, int] = field(default_factory=dict)
    reach: float = 0.0  #: how far away the farthest of these lay, in meters; not in the metadata
    #: the points of each class code after a stage that gives classes, whichever it looked at; not in the metadata
    codes: dict[str, int] | None = None

    def merge(self, other: Report) -> None:
        """Merge another report into this one. Existing figures are kept; dicts are merged by key."""
        _merge(self.figures, other.figures)
        _merge(self.beyond_halo, other.beyond_halo)
        self.reach = max(self.reach, other.reach)
        for mine, theirs in ((self.notes, other.notes), (self.warnings, other.warnings)):
            mine += [text for text in theirs if text not in mine]

    @property
    def messages(self) -> list[str]:
        """Warnings, then notes."""
        return [*self.warnings, *self.notes]

    def to_dict(self) -> dict[str, Any]:
        """The report as metadata: figures, and ``beyond_halo``, ``warning`` and ``note`` where there are any."""
        texts = {"warning": self.warnings, "note": self.notes}
        return (
            self.figures
            | ({"beyond_halo": self.beyond_halo} if self.beyond_halo else {})
            | {name: ". ".join(lines) for name, lines in texts.items() if lines}
        )


def _merge(mine: dict[str, Any], theirs: dict[str, Any]) -> None:
    for name, value in theirs.items():
        if isinstance(value, dict) and isinstance(mine.get(name), dict):
            mine[name] = {**value, **mine[name]}
        else:
            mine.setdefault(name, dict(value) if isinstance(value, dict) else value)


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
            found = f"{path}: {error.strerror}"
            raise StageError("the log cannot be written", where="--log", found=found) from None
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
        """Report it once; the run goes on without its log."""
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
        *lines, self._begun.line = (getattr(self._begun, "line", "") + text).split("\n")
        for line in lines:  # first, so that the log has all that was shown, even after Ctrl-C
            self.log.add(line)
        return super().write(text)
