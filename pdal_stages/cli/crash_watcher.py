"""A small process beside the command that reports when the command dies without a message."""

from __future__ import annotations

import contextlib
import os
import shlex
import signal
import sys
from collections.abc import Callable, Sequence

from ..base.errors import StageError
from ..base.messages import one_line, print_messages

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
        received: list[
            int
        ] = []  # signals that a terminal or a batch system sends to both processes
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT):
            signal.signal(number, lambda number, _: received.append(number))
        if not os.read(watching_end, 1):
            print_messages(INTERRUPTED if received else str(_describe_death(arguments)))
            sys.stderr.flush()
    finally:
        os._exit(0)


def _describe_death(arguments: Sequence[str]) -> StageError:
    """Return the message on a process that died."""
    return StageError(
        "the process died in the midst of its work, and no output was completed after that",
        found=one_line(shlex.join(["pdal-stages", *arguments])),
        cure="Where memory ran out, the system killed it: work in tiles (classify --tile). Or PDAL "
        "crashed, as it does on "
        "damaged LAZ or COPC points: try the inputs one by one with 'pdal info --stats'",
    )
