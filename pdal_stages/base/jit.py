"""How kernels are compiled: without the GIL, cached where the user can write, never in the way.

``njit`` here is numba's with the package's defaults, and numba itself is imported when a kernel is first called, so that
commands that need none, and errors, come at once. Three repairs of numba's cache:

* numba keys cached code by its own source file only, so a changed *device function* in another module
  leaves stale code behind. The key here is a digest of the source of the kernel and of every kernel it
  calls; being content, not time of change, it also survives copying an installation.
* where neither the package's folder nor the user's cache folder is writable numba refuses to compile
  at all; here a private folder under the system's temporary folder is tried, then no cache.
* divisions follow NumPy (``error_model="numpy"``): a Python-style check for zero in a loop keeps it
  from being vectorized.

Compiled code is cached at first use rather than shipped, because it is made for the processor it
runs on (AVX-512 or not): that is where the speed comes from. ``pdal_stages.features.warmup()`` fills the
cache ahead of time, e.g. at installation.
"""

from __future__ import annotations

import hashlib
import os
import stat
import sys
import tempfile
import threading
from collections.abc import Callable
from functools import lru_cache, update_wrapper
from pathlib import Path
from typing import Any

from .errors import DependencyError

#: Flags that allow sums to be reordered and contracted, but keep NaN and infinity meaningful.
FAST = frozenset({"reassoc", "contract", "nsz", "arcp"})

#: Divisions as in NumPy.
_ERRORS = {"error_model": "numpy"}

_stamps: dict[Any, frozenset[str]] = {}

#: Device functions that numba has not heard of yet, with their options.
_unregistered: list[tuple[Callable, dict[str, Any]]] = []
_lock = threading.RLock()


class Kernel:
    """A function that numba compiles when it is first called; make it with :func:`njit`."""

    def __init__(self, function: Callable, options: dict[str, Any]) -> None:
        update_wrapper(self, function)
        self._function, self._options = function, options
        self._dispatcher: Any = None
        _stamp(self, function)

    def __call__(self, *arguments: Any) -> Any:
        return (self._dispatcher or self.dispatcher)(*arguments)

    @property
    def dispatcher(self) -> Any:
        """What numba makes of it."""
        with _lock:
            if self._dispatcher is None:
                _register_devices()
                made = _dispatcher(self._function, self._options)
                file: Any = getattr(getattr(made, "_cache", None), "_cache_file", None)
                if hasattr(file, "_source_stamp"):
                    file._source_stamp = "-".join(sorted(_stamps[self]))
                self._dispatcher = made
            return self._dispatcher

    @property
    def _numba_type_(self) -> Any:
        """By which numba knows what a kernel calls."""
        return self.dispatcher._numba_type_


def njit(function: Callable | None = None, **options):
    """``numba.njit`` with the package's defaults; see the module's text. Use as ``@njit`` or ``@njit(...)``."""
    if function is None:
        return lambda f: njit(f, **options)
    return Kernel(function, {"nogil": True, "cache": True, "no_cfunc_wrapper": True, **_ERRORS, **options})


def device(function: Callable | None = None, **options):
    """For a function that kernels call: compiled into them, without an entry of its own for Python.

    That entry would take as long to compile as many a function. Where Python calls it, it runs as it is written.
    """
    if function is None:
        return lambda f: device(f, **options)
    _stamp(function, function)
    _unregistered.append((function, {**_ERRORS, **options}))
    return function


def intrinsic(function: Callable) -> Any:
    """numba's, for instructions that it has no equivalent of; the function gets numba's types first."""
    numba = _numba()
    typed = update_wrapper(lambda context, *given: function(numba.types, *given), function)
    made = numba.extending.intrinsic(typed)
    _stamp(made, function)
    return made


def _register_devices() -> None:
    while _unregistered:
        function, options = _unregistered.pop()
        _numba().extending.register_jitable(**options)(function)


def _numba() -> Any:
    try:
        import numba.extending
    except ValueError as error:  # of an environment variable of its own
        raise DependencyError(
            "numba cannot be started",
            found=str(error),
            cure="Look for environment variables that begin with NUMBA_",
        ) from None
    return numba


def _dispatcher(function: Callable, options: dict[str, Any]) -> Any:
    numba = _numba()
    try:
        return numba.njit(**options)(function)
    except RuntimeError:  # "cannot cache function ...: no locator available"
        return _elsewhere(numba, function, options)


def _elsewhere(numba: Any, function: Callable, options: dict[str, Any]) -> Any:
    folder = private_cache_folder()
    if folder is not None:
        settings = numba.core.config
        before, settings.CACHE_DIR = settings.CACHE_DIR, folder
        try:
            return numba.njit(**options)(function)
        except RuntimeError:
            pass
        finally:
            settings.CACHE_DIR = before
    return numba.njit(**{**options, "cache": False})(function)


@lru_cache(maxsize=1)
def private_cache_folder() -> str | None:
    """A folder only this user can write, under the system's temporary folder, or ``None``.

    Cached code is executed, so a folder that anybody else owns or may write is refused.
    """
    user = os.getuid() if hasattr(os, "getuid") else "user"
    folder = Path(tempfile.gettempdir()) / f"pdal-stages-cache-{user}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
        if not stat.S_ISDIR(status.st_mode):
            return None
        if hasattr(os, "getuid") and (status.st_uid != os.getuid() or status.st_mode & 0o022):
            return None
        with tempfile.TemporaryFile(dir=folder):
            return str(folder)
    except OSError:
        return None


@lru_cache(maxsize=256)
def _file_digest(path: str) -> str:
    try:
        return hashlib.sha256(Path(path).read_bytes()).hexdigest()[:16]
    except OSError:
        return path


def _stamp(kernel: Any, function: Callable) -> None:
    """Note the sources that the code of a kernel (or device function) is made of: its own, and of all it names."""
    parts = {_file_digest(function.__code__.co_filename)}
    for name in function.__code__.co_names:
        called = function.__globals__.get(name)
        try:
            parts |= _stamps.get(called, frozenset())
        except TypeError:  # a global that cannot be hashed is no kernel
            continue
    _stamps[kernel] = frozenset(parts)


class CompilationNote:
    """Say on stderr, once in a process, that kernels are being compiled, where that takes long.

    After `delay` seconds the note is written if numba is compiling at that moment, else it is looked again
    every second: work that merely takes long is no reason to claim compilation.
    """

    _said = False

    def __init__(self, delay: float = 3.0) -> None:
        self._delay = delay
        self._end = threading.Event()

    def _watch(self) -> None:
        wait = self._delay
        while not self._end.wait(wait):
            wait = 1.0
            if _is_compiling():
                self._say()
                return

    @classmethod
    def _say(cls) -> None:
        stream = sys.__stderr__
        if stream is None or cls._said:
            return
        cls._said = True
        try:
            stream.write("pdal_stages: compiling for this processor, once (less than a minute)...\n")
            stream.flush()
        except (OSError, ValueError):  # a closed stderr must not stop the work
            pass

    @classmethod
    def leave_out(cls) -> None:
        """Write no such note in this process."""
        cls._said = True

    def __enter__(self) -> CompilationNote:
        threading.Thread(target=self._watch, daemon=True).start()
        return self

    def __exit__(self, *exc) -> None:
        self._end.set()


def _is_compiling() -> bool:
    """Whether another thread holds numba's compiler lock."""
    from numba.core.compiler_lock import global_compiler_lock

    lock = getattr(global_compiler_lock, "_lock", None)
    if lock is None:
        return True
    if lock.acquire(blocking=False):
        lock.release()
        return False
    return True
