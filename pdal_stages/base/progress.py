"""A line of progress on standard error.

Not tqdm: it would be a new dependency, and has neither the plain lines that logs and the QGIS
plugin need, nor silence until a job has taken two seconds.
"""

from __future__ import annotations

import os
import sys
import time
from contextlib import AbstractContextManager
from typing import Any, cast

from .messages import duration

#: Seconds between two drawings of a line on a terminal.
_TERMINAL_S = 0.2
#: Seconds between two lines in a log.
_LOG_S = 15.0
#: Seconds between two lines for a program that reads them.
_LINES_S = 1.0


class Progress(AbstractContextManager):
    """A line of progress: `label`, the number of `unit` of `total` (0: unknown), rate, time left.

    Silent until `delay` seconds have passed. On a terminal the line is redrawn; elsewhere (a log)
    a new line is written every 15 seconds. The environment variable ``PDAL_STAGES_PROGRESS=0``
    silences it, as ``enabled=False`` does; ``PDAL_STAGES_PROGRESS=lines`` writes a line every
    second, for a program that shows a bar of its own.
    """

    delay = 2.0

    def __init__(
        self, total: int, label: str, unit: str = "points", *, enabled: bool | None = None
    ) -> None:
        self.total, self.label, self.unit = int(total), label, unit
        # filters.python redirects sys.stdout, never stderr: stderr is always the user's.
        self.stream = cast(Any, sys.__stderr__)
        mode = os.environ.get("PDAL_STAGES_PROGRESS", "1")
        self.enabled = self.stream is not None and enabled is not False and mode != "0"
        self.count = 0
        self.started = time.monotonic()
        self._terminal = self.enabled and mode != "lines" and self.stream.isatty()
        self._every = _TERMINAL_S if self._terminal else _LOG_S
        if mode == "lines":
            self._every, self.delay = _LINES_S, 0.5
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
        elif self.total and 100 * self.count >= self.total:  # the rate before is mostly start-up
            text += f", {duration(max(self.total - self.count, 0) / rate)} left"
        self._write(f"\r{text}\x1b[K" if self._terminal else f"{text}\n")
        self._shown = True

    def _write(self, text: str) -> None:
        try:
            self.stream.write(text)
            self.stream.flush()
        except (OSError, ValueError):  # a closed or full stderr must not stop the work
            self.enabled = False

    def clear(self) -> None:
        """Clear the line so that something else can be printed; it is redrawn when due."""
        if self._terminal and self._shown and self.enabled:
            self._write("\r\x1b[K")

    def close(self) -> None:
        """Draw the last state, if anything was drawn at all."""
        if self._shown and self.enabled:
            self._draw(time.monotonic(), end=True)
            if self._terminal:
                self._write("\n")
        self.enabled = False

    def __exit__(self, *exc) -> None:
        """Draw the last state."""
        self.close()
