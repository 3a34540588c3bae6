"""Ctrl-C and SIGTERM while a command works, and a process beside it that reports its death."""

from __future__ import annotations

import contextlib
import os
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

from ..base.errors import StageError
from ..base.messages import one_line, print_messages

if TYPE_CHECKING:
    from ..tiling.jobs import TiledRun

#: The message after Ctrl-C.
INTERRUPTED = "interrupted; no partial output was left"


def watch_for_crash(arguments: Sequence[str]) -> Callable[[], None]:
    """Watch this process from now on; return the function that ends the watch.

    A crash inside PDAL, and the system's killing of a process without memory, end Python at once.
    The watching process holds one end of a pipe, which closes when this process ends, however it
    ends. Where processes cannot be forked nothing watches. `arguments` are the command's, for the
    message.
    """
    if not hasattr(os, "fork"):
        return lambda: None
    watching_end, watched_end = os.pipe()
    try:
        forked = os.fork()
    except OSError:  # no more processes are allowed
        forked = os.getpid()
        os.close(watched_end)
    if forked:
        os.close(watching_end)

        def end_watching() -> None:
            with contextlib.suppress(OSError):
                os.write(watched_end, b".")

        return end_watching
    try:
        os.close(watched_end)
        received: list[int] = []  # signals that a terminal or batch system sends to both processes
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):
            signal.signal(number, lambda number, _: received.append(number))
        if not os.read(watching_end, 1):
            death = StageError(
                "the process died in the midst of its work, and no output was completed after that",
                found=one_line(shlex.join(["pdal-stages", *arguments])),
                cure="Where memory ran out, the system killed it: work in tiles (classify --tile). "
                "Or PDAL crashed, as it does on damaged LAZ or COPC points: try the inputs one by "
                "one with 'pdal info --stats'",
            )
            print_messages(INTERRUPTED if received else str(death))
            sys.stderr.flush()
    finally:
        os._exit(0)


@contextlib.contextmanager
def sigterm_like_ctrl_c() -> Iterator[None]:
    """Make SIGTERM, which service managers and batch systems send, clean up like Ctrl-C."""
    before = None
    with contextlib.suppress(ValueError):  # not in the main thread
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
