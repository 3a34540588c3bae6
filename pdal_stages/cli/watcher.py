"""A small process beside the command that says so when the command dies without a word of its own."""

from __future__ import annotations

import contextlib
import os
import shlex
import signal
import sys
from collections.abc import Callable, Sequence

from ..base.errors import StageError
from ..base.messages import one_line, print_messages


def watched(arguments: Sequence[str]) -> Callable[[], None]:
    """Watch this process from now on, until what is returned is called.

    A crash inside PDAL and the system's killing of a process without memory end Python at once. The watcher holds one
    end of a pipe, which closes when this process ends, however it ends. Where processes cannot be forked nothing watches.
    """
    if not hasattr(os, "fork"):
        return lambda: None
    watcher_end, own_end = os.pipe()
    try:
        forked = os.fork()
    except OSError:  # no more processes are allowed
        forked = os.getpid()
        os.close(own_end)
    if forked:
        os.close(watcher_end)
        return lambda: _end(own_end)
    try:
        os.close(own_end)
        asked: list[int] = []  # signals that a terminal or a batch system sends to both processes
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):
            signal.signal(number, lambda number, _: asked.append(number))
        if not os.read(watcher_end, 1):
            print_messages(
                "interrupted; nothing half-written was left" if asked else str(_death(arguments))
            )
            sys.stderr.flush()
    finally:
        os._exit(0)


def _end(own_end: int) -> None:
    with contextlib.suppress(OSError):
        os.write(own_end, b".")


def _death(arguments: Sequence[str]) -> StageError:
    return StageError(
        "the process died in the midst of its work, and no output was completed after that",
        found=one_line(shlex.join(["pdal-stages", *arguments])),
        cure="Where memory ran out, the system killed it: work in tiles (classify --tile). Or PDAL crashed, as it does on "
        "damaged LAZ or COPC points: try the inputs one by one with 'pdal info --stats'",
    )
