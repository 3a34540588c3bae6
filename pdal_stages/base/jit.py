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
import tempfile
import threading
from collections.abc import Callable
from functools import lru_cache, update_wrapper
from pathlib import Path
from typing import Any

from .cachedcode import load_lightly
from .errors import DependencyError
from .progress import Progress

#: Flags that allow sums to be reordered and contracted, but keep NaN and infinity meaningful.
FAST = frozenset({"reassoc", "contract", "nsz", "arcp"})

#: Divisions as in NumPy.
_ERRORS = {"error_model": "numpy"}

#: Kernels, device functions and intrinsics, and what each was made of.
_functions: dict[Any, Callable] = {}

#: Device functions that numba has not heard of yet, with their options.
_unregistered: list[tuple[Callable, dict[str, Any]]] = []
_lock = threading.RLock()


class Kernel:
    """A function that numba compiles when it is first called; make it with :func:`njit`."""

    def __init__(self, function: Callable, options: dict[str, Any]) -> None:
        update_wrapper(self, function)
        self._function, self._options = function, options
        self._dispatcher: Any = None
        _functions[self] = function

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
                    file._source_stamp = "-".join(sorted(_sources(self)))
                load_lightly(made)
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
    _functions[function] = function
    _unregistered.append((function, {**_ERRORS, **options}))
    return function


def intrinsic(function: Callable) -> Any:
    """numba's, for instructions that it has no equivalent of; the function gets numba's types first."""
    numba = _numba()
    typed = update_wrapper(lambda context, *given: function(numba.types, *given), function)
    made = numba.extending.intrinsic(typed)
    _functions[made] = function
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
    import numba.core.event

    Compiling.listen(numba.core.event)
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


def _sources(kernel: Any) -> set[str]:
    """Digests of the sources that the code of a kernel is made of: its own, and of all that it calls.

    Asked when the kernel is first called, since what it calls may stand below it.
    """
    digests, seen, todo = set(), {kernel}, [kernel]
    while todo:
        function = _functions[todo.pop()]
        digests.add(_file_digest(function.__code__.co_filename))
        for name in function.__code__.co_names:
            called = function.__globals__.get(name)
            try:
                if called in _functions and called not in seen:
                    seen.add(called)
                    todo.append(called)
            except TypeError:  # a global that cannot be hashed is no kernel
                continue
    return digests


class Compiling:
    """Says on stderr how many kernels were compiled so far, where that takes longer than two seconds."""

    #: Whether this process says it, whatever PDAL_STAGES_PROGRESS is.
    enabled: bool | None = None
    _bar: Progress | None = None
    _inside = threading.local()

    @classmethod
    def listen(cls, event: Any) -> None:
        """Hear of what numba compiles from now on."""
        if cls._bar is None:
            listener = type("Listener", (event.Listener,), {"on_start": cls._start, "on_end": cls._end})
            event.register("numba:compile", listener())
            cls._bar = Progress(0, "compiling for this processor, once", "kernels", enabled=cls.enabled)

    @staticmethod
    def _start(_: Any, event: Any) -> None:
        Compiling._inside.depth = getattr(Compiling._inside, "depth", 0) + 1

    @staticmethod
    def _end(_: Any, event: Any) -> None:  # of the kernel itself, not of the functions it calls
        Compiling._inside.depth = getattr(Compiling._inside, "depth", 1) - 1
        if Compiling._inside.depth == 0 and Compiling._bar is not None:
            Compiling._bar.update()


def kept_kernels() -> int:
    """How many kernels there is compiled code of, of whatever version, without asking numba."""
    named = os.environ.get("NUMBA_CACHE_DIR")
    folders = (
        [Path(named)] if named else [Path(__file__).resolve().parents[1], Path.home() / ".cache" / "numba"]
    )
    return sum(1 for folder in folders for _ in folder.rglob("*.nbi"))


@device
def any_of(flags):
    """Whether any is true; numba's own brings SciPy's linear algebra into every job."""
    found = False
    for flag in flags:
        found |= flag
    return found
