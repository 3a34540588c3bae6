"""Ctrl-C while PDAL runs in this process: raised where it is caught, put off where PDAL would crash."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import CodeType, FrameType
from typing import TypeVar

_Function = TypeVar("_Function", bound=Callable)
_catching: set[CodeType] = set()
_fragile: set[CodeType] = set()


def catches(function: _Function) -> _Function:
    """Mark a function within which KeyboardInterrupt may be raised, even if PDAL called it."""
    _catching.add(function.__code__)
    return function


def fragile(function: _Function) -> _Function:
    """Mark a function that calls PDAL, whose plugins crash when KeyboardInterrupt comes up in Python code they run."""
    _fragile.add(function.__code__)
    return function


class Interrupts:
    """Whether the user asked to stop."""

    def __init__(self) -> None:
        self.asked = 0

    def check(self) -> None:
        """Raise what was put off."""
        if self.asked:
            raise KeyboardInterrupt

    def handle(self, number: int, frame: FrameType | None) -> None:
        """The handler of a signal."""
        self.asked += 1
        within_pdal = False
        while frame is not None:
            if frame.f_code in _catching:
                raise KeyboardInterrupt
            within_pdal |= frame.f_code in _fragile
            frame = frame.f_back
        if not within_pdal:
            raise KeyboardInterrupt


_current: list[Interrupts] = []


def check() -> None:
    """Raise what was put off, where it can be caught."""
    for found in _current:
        found.check()


@contextmanager
def gentle(*numbers: int) -> Iterator[Interrupts]:
    """Handle signals with :class:`Interrupts`, where Python handles them; SIGINT and SIGTERM unless others are given."""
    if threading.current_thread() is not threading.main_thread() or _current:
        yield _current[0] if _current else Interrupts()
        return
    found = Interrupts()
    before = {}
    for number in numbers or (signal.SIGINT, signal.SIGTERM):
        if not numbers or callable(signal.getsignal(number)):
            before[number] = signal.signal(number, found.handle)
    _current.append(found)
    try:
        yield found
    finally:
        _current.remove(found)
        for number, handler in before.items():
            signal.signal(number, handler)
