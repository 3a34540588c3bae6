"""Ctrl-C while PDAL runs in this process: raised where it is caught, put off where PDAL would crash."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from ..pipeline import pdal as pdal_env
from ..pipeline import runtime

#: PDAL cannot take an exception such as KeyboardInterrupt from a Python filter; our stages catch it.
_CAUGHT = runtime.run_on_view.__code__
_EXECUTE = pdal_env.execute.__code__


class Interrupts:
    """Whether the user asked to stop."""

    def __init__(self) -> None:
        self.asked = 0

    def check(self) -> None:
        """Raise what was put off."""
        if self.asked:
            raise KeyboardInterrupt

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.asked += 1
        within_pdal = False
        while frame is not None:
            if frame.f_code is _CAUGHT:
                raise KeyboardInterrupt
            within_pdal |= frame.f_code is _EXECUTE
            frame = frame.f_back
        if not within_pdal or self.asked > 1:
            raise KeyboardInterrupt


@contextmanager
def gentle() -> Iterator[Interrupts]:
    """Handle Ctrl-C and SIGTERM with :class:`Interrupts`."""
    found = Interrupts()
    if threading.current_thread() is not threading.main_thread():
        yield found
        return
    before = {number: signal.signal(number, found._handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield found
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
