"""Whether a worker process still does something: it beats, or it computes."""

from __future__ import annotations

import subprocess
import threading
import time
from collections.abc import Callable

#: Seconds between a worker's beats, and between looks at it.
BEAT, LOOK = 2.0, 5.0
#: Seconds without a sign of life until that is told, and until the worker is ended.
TELL_AFTER, END_AFTER = 60.0, 300.0
#: Seconds that a worker may take to load its libraries, whatever it does meanwhile.
START_WITHIN = 600.0


class LifeSigns:
    """What is known of one worker.

    A worker beats (:func:`beat`) as long as Python runs in it. PDAL holds Python still while it runs, for many minutes with
    a large cloud, so processor time that the worker uses is a sign of life as well. Silence is counted in looks, not by the
    clock: while this process itself was suspended, nobody looked.
    """

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self._beats = self._seen = 0
        self._spent = -1.0
        self.silent = 0.0  #: seconds without a sign of life
        self.waited = 0.0  #: seconds looked at it

    def beat(self) -> None:
        """The worker said something."""
        self._beats += 1

    def look(self) -> None:
        """See whether anything happened since the last look."""
        spent = processor_time(self.pid)
        alive = self._beats != self._seen or (spent is not None and spent != self._spent)
        self._seen, self._spent = self._beats, -1.0 if spent is None else spent
        self.silent = 0.0 if alive else self.silent + LOOK
        self.waited += LOOK

    def begin(self) -> None:
        """A new task: count anew."""
        self.silent = self.waited = 0.0


def beat(say: Callable[[], None]) -> None:
    """Say something every few seconds, from a thread of its own."""

    def beats() -> None:
        while True:
            time.sleep(BEAT)
            say()

    threading.Thread(target=beats, daemon=True).start()


def processor_time(pid: int) -> float | None:
    """What a process has used, in the system's unit; None where the system does not say."""
    try:
        with open(f"/proc/{pid}/stat", encoding="ascii", errors="replace") as file:
            fields = file.read().rpartition(")")[2].split()
        return float(int(fields[11]) + int(fields[12]))
    except (OSError, ValueError, IndexError):
        pass
    try:  # other Unix systems
        done = subprocess.run(
            ["ps", "-o", "time=", "-p", str(pid)], capture_output=True, text=True, timeout=10
        )
        parts = done.stdout.strip().replace("-", ":").split(":")
        return float(sum(float(part) * 60**place for place, part in enumerate(reversed(parts))))
    except (OSError, ValueError, subprocess.SubprocessError):
        return None
