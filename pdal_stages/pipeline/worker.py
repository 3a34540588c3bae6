"""What a worker process does: tasks in through the pipe it was started with, answers out through the other."""

from __future__ import annotations

import os
import pickle
import queue
import sys
import threading
from typing import Any, BinaryIO

from ..base.plain import PlainStream
from ..base.shortage import is_short, shortage
from .lifesigns import beat
from .processes import BEATING, READY
from .work import perform


def serve() -> None:
    """Do tasks until the parent closes the pipe, or ends."""
    tasks, answers = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(2, 1)  # what libraries print is not an answer
    sys.stdout, sys.stderr = PlainStream(sys.stdout), PlainStream(sys.stderr)
    waiting: queue.SimpleQueue[Any] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(tasks, waiting), daemon=True).start()
    try:
        _load_libraries()
    except (ImportError, OSError, MemoryError) as error:
        if is_short(error):
            _say(answers, shortage(f"in a worker process, {type(error).__name__}: {error}"))
        raise
    _say(answers, READY)
    beat(lambda: _say(answers, BEATING))
    while True:
        _say(answers, perform(waiting.get()))


def _load_libraries() -> None:
    """What tasks need, before the first: a worker that finds no room for it says so, and is not sent any."""
    import numba
    import scipy.linalg
    import scipy.spatial

    del numba, scipy


def _listen(tasks: BinaryIO, waiting: queue.SimpleQueue) -> None:
    """Take tasks; at the end of the pipe nobody waits any more for what is being done."""
    try:
        while True:
            waiting.put(pickle.load(tasks))
    finally:
        os._exit(0)


_one_at_a_time = threading.Lock()


def _say(answers: BinaryIO, what: Any) -> None:
    answer = pickle.dumps(what)
    try:
        with _one_at_a_time:
            answers.write(answer)
            answers.flush()
    except OSError:
        os._exit(0)
