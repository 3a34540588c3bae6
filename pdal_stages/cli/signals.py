"""Ctrl-C and SIGTERM while a command works."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..tiling.jobs import TiledRun


@contextmanager
def sigterm_like_ctrl_c() -> Iterator[None]:
    """Make SIGTERM, which service managers and batch systems send, clean up like Ctrl-C."""
    before = None
    with suppress(ValueError):  # not in the main thread
        before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        if before is not None:
            signal.signal(signal.SIGTERM, before)


def run_until_interrupted(start: Callable[[], TiledRun]) -> tuple[TiledRun, bool]:
    """Call `start`; return its run, or what was done of it, and whether it was interrupted."""
    from ..tiling.jobs import InterruptedRun

    with sigterm_like_ctrl_c():
        try:
            return start(), False
        except InterruptedRun as interrupted:
            return interrupted.run, True


def end_at_ctrl_c(is_program: bool) -> None:
    """Let Ctrl-C end the program while PDAL works, when Python cannot handle signals.

    The next run cleans up.
    """
    if is_program and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_DFL)
