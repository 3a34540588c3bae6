"""Ctrl-C while PDAL runs in this process.

PDAL's plugins crash when KeyboardInterrupt comes up in Python code that PDAL called. So it is raised only inside
functions that :func:`catches` marks, which hand it on as an error; otherwise it waits for :func:`check`.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import CodeType, FrameType
from typing import TypeVar

_Function = TypeVar("_Function", bound=Callable)
_catching: set[CodeType] = set()
_calling_pdal: set[CodeType] = set()
_handling = False
_asked = False


def catches(function: _Function) -> _Function:
    """Mark a function inside which KeyboardInterrupt may be raised, even if PDAL called it."""
    _catching.add(function.__code__)
    return function


def calls_pdal(function: _Function) -> _Function:
    """Mark a function that calls PDAL."""
    _calling_pdal.add(function.__code__)
    return function


def check() -> None:
    """Raise KeyboardInterrupt if the user asked to stop."""
    if _asked:
        raise KeyboardInterrupt


def _handle(number: int, frame: FrameType | None) -> None:
    global _asked
    _asked = True
    inside_pdal = False
    while frame is not None:
        if frame.f_code in _catching:
            raise KeyboardInterrupt
        inside_pdal |= frame.f_code in _calling_pdal
        frame = frame.f_back
    if not inside_pdal:
        raise KeyboardInterrupt


@contextmanager
def gentle(*numbers: int) -> Iterator[None]:
    """Handle signals so, where Python handles them; SIGINT and SIGTERM unless others are given."""
    global _asked, _handling
    if _handling or threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {}
    for number in numbers or (signal.SIGINT, signal.SIGTERM):
        if not numbers or callable(signal.getsignal(number)):
            before[number] = signal.signal(number, _handle)
    _handling, _asked = True, False
    try:
        yield
    finally:
        _handling = _asked = False
        for number, handler in before.items():
            signal.signal(number, handler)
