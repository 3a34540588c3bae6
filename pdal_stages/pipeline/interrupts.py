"""Ctrl-C while PDAL runs.

PDAL's plugins crash when KeyboardInterrupt comes up in Python code that PDAL called. So it is
raised only inside functions that are marked as interruptible, which hand it on as an error;
otherwise it waits for :func:`check_interrupt`.
"""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import CodeType, FrameType
from typing import TypeVar

_Function = TypeVar("_Function", bound=Callable)
_interruptible: set[CodeType] = set()
_runs_pdal: set[CodeType] = set()
_handling = False
_interrupted = False


def interruptible(function: _Function) -> _Function:
    """Mark a function inside which KeyboardInterrupt may be raised, even if PDAL called it."""
    _interruptible.add(function.__code__)
    return function


def runs_pdal(function: _Function) -> _Function:
    """Mark a function inside which PDAL runs."""
    _runs_pdal.add(function.__code__)
    return function


def check_interrupt() -> None:
    """Raise KeyboardInterrupt if the user pressed Ctrl-C."""
    if _interrupted:
        raise KeyboardInterrupt


def _handle(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt, unless PDAL runs and no interruptible function does."""
    global _interrupted
    _interrupted = True
    inside_pdal = False
    while frame is not None:
        if frame.f_code in _interruptible:
            raise KeyboardInterrupt
        inside_pdal |= frame.f_code in _runs_pdal
        frame = frame.f_back
    if not inside_pdal:
        raise KeyboardInterrupt


@contextlib.contextmanager
def deferred_interrupts() -> Iterator[None]:
    """Handle Ctrl-C this way, and SIGTERM where Python handles it."""
    global _interrupted, _handling
    if _handling or threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [n for n in (signal.SIGINT, signal.SIGTERM) if callable(signal.getsignal(n))]
    before = {number: signal.signal(number, _handle) for number in numbers}
    _handling, _interrupted = True, False
    try:
        yield
    finally:
        _handling = _interrupted = False
        for number, handler in before.items():
            signal.signal(number, handler)
