"""Python processes of our own that perform calls, one at a time.

They are started as programs (``subprocess``), with calls and results pickled through their pipes. A
process of ``multiprocessing`` would import the user's script again, and cannot be killed by a
public name when it belongs to a pool.
"""

from __future__ import annotations

import os
import pickle
import queue
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, suppress
from typing import BinaryIO, TypeVar

from .messages import PlainStream

_Result = TypeVar("_Result")
#: The program of a process; its arguments are where modules are found, not the current folder.
_PROGRAM = "import sys; sys.path[:] = sys.argv[1:]; import pdal_stages.base.processes as own; "
_PROGRAM += "own.serve()"
#: Seconds that a killed process may take to end, unless the system waits for a disk.
_MAX_WAIT = 10.0


class ProcessEnded(Exception):
    """A process died before it returned a result."""

    def __init__(self) -> None:
        super().__init__("its worker process died: too little memory, or a crash in a library")


class PythonProcess(AbstractContextManager):
    """A process that performs calls; it ends with this one, however that ends.

    Ctrl-C does not reach it, as it has a session of its own.

    Parameters
    ----------
    environment : mapping of str to str
        Variables that differ from those of this process.
    """

    def __init__(self, environment: Mapping[str, str] | None = None) -> None:
        self._process = subprocess.Popen(
            [interpreter(), "-c", _PROGRAM, *sys.path],
            env={**os.environ, **(environment or {}), "PYTHONSAFEPATH": "1"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )

    @property
    def pid(self) -> int:
        """The number by which the system knows the process."""
        return self._process.pid

    def __exit__(self, *exc: object) -> None:
        """End the process."""
        self.kill()

    def kill(self) -> None:
        """End the process at once; a call that waits for it raises :class:`ProcessEnded`."""
        self._process.kill()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_MAX_WAIT)
        for pipe in (self._process.stdin, self._process.stdout):
            with suppress(OSError):  # a call that it has not read
                pipe.close()  # type: ignore[union-attr]

    def call(self, function: Callable[..., _Result], *arguments: object) -> _Result:
        """Call a function there that it can import; return its result or raise its error."""
        calls, results = self._process.stdin, self._process.stdout
        assert calls is not None and results is not None
        call = pickle.dumps((function, arguments))
        try:
            pickle.dump(call, calls)
            calls.flush()
            failed, result = pickle.load(results)
        except (OSError, EOFError, pickle.UnpicklingError):
            raise ProcessEnded from None
        if failed:
            raise result
        return result


def serve() -> None:
    """Perform the calls that come in, in a process of :class:`PythonProcess`."""
    calls, results = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(2, 1)  # what libraries print is no result
    sys.stdout, sys.stderr = PlainStream(sys.stdout), PlainStream(sys.stderr)
    waiting: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_receive, args=(calls, waiting), daemon=True).start()
    while True:
        results.write(_result_of(waiting.get()))
        results.flush()


def _receive(calls: BinaryIO, waiting: queue.SimpleQueue[bytes]) -> None:
    """Pass calls on; end this process when the one that started it has ended."""
    with suppress(EOFError, OSError, pickle.UnpicklingError):
        while True:
            waiting.put(pickle.load(calls))
    os._exit(1)


def _result_of(call: bytes) -> bytes:
    """Return whether a call failed, and its result or error, pickled."""
    try:
        function, arguments = pickle.loads(call)
        return pickle.dumps((False, function(*arguments)))
    except BaseException as error:
        try:
            return pickle.dumps((True, error))
        except Exception:  # an error that holds what cannot be pickled
            return pickle.dumps((True, RuntimeError(f"{type(error).__name__}: {error}")))


def interpreter() -> str:
    """Return the path of Python's own program, also inside a program that embeds Python."""
    if os.path.basename(sys.executable or "").startswith("python"):
        return sys.executable
    name = f"python3.{sys.version_info.minor}"
    inside = (os.path.join(prefix, "bin", name) for prefix in (sys.prefix, sys.base_prefix))
    return next((path for path in inside if os.access(path, os.X_OK)), "python3")
