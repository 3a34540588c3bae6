"""How kernels are compiled: without the GIL, cached where the user can write.

``njit`` here is numba's with the package's defaults, and numba itself is imported when a kernel is
first called, so that commands that need none, and errors, come at once. numba keys cached code by
its own source file only, so a changed *device function* in another module would leave stale code
behind: here each kernel has a cache folder of its own, named by a digest of the sources of the
kernel and of all that it calls. Compiled code is cached at first use rather than shipped, because
it is made for the processor it runs on. This file is digested, too: a changed default below, or
``FAST``, compiles everything again.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import shutil
import tempfile
import threading
import time
from collections.abc import Callable
from functools import cached_property, lru_cache, update_wrapper
from pathlib import Path
from typing import Any

from .errors import DependencyError
from .files import exposed_folder
from .messages import print_messages
from .progress import Progress

#: Flags that allow sums to be reordered and contracted, but keep NaN and infinity meaningful.
FAST = frozenset({"reassoc", "contract", "nsz", "arcp"})

#: Divisions as in NumPy, without an exception: a check for zero keeps a loop from being vectorized.
_DIVISION = {"error_model": "numpy"}

#: Kernels and device functions, and what each was made of.
_functions: dict[Any, Callable] = {}

_lock = threading.RLock()
_PACKAGE = Path(__file__).resolve().parents[1]


class Kernel:
    """A function that numba compiles when it is first called; make it with :func:`njit`."""

    def __init__(self, function: Callable, options: dict[str, Any]) -> None:
        update_wrapper(self, function)
        self._function, self._options = function, options
        self._dispatcher: Any = None
        _functions[self] = function

    def __call__(self, *arguments: Any) -> Any:
        """Run the compiled function; a device function runs as it is written."""
        if "no_cpython_wrapper" in self._options:
            return self._function(*arguments)
        dispatcher = self._dispatcher or self.dispatcher
        try:
            return dispatcher(*arguments)
        except (OSError, EOFError, pickle.UnpicklingError):  # no kernel raises these: the cache
            if not self._start_over(dispatcher):
                raise
        return self(*arguments)

    @property
    def dispatcher(self) -> Any:
        """The function as numba compiles it."""
        with _lock:
            if self._dispatcher is None:
                numba = _numba()
                folder = _cache.folder_of(self) if self._options["cache"] else None
                options = {**self._options, "cache": folder is not None}
                usual = numba.config.CACHE_DIR
                numba.config.CACHE_DIR = str(folder or usual)  # read when the cache is made
                try:
                    self._dispatcher = numba.njit(**options)(self._function)
                finally:
                    numba.config.CACHE_DIR = usual
            return self._dispatcher

    def _start_over(self, failed: Any) -> bool:
        """Compile again after an error of the cache; False where that was tried before."""
        with _lock:
            if self._dispatcher is failed:  # else another thread was here before
                if not _cache.clear():
                    return False
                for kernel in _functions:
                    kernel._dispatcher = None
            return True

    @property
    def _numba_type_(self) -> Any:
        """Type by which numba knows a kernel that another one calls."""
        return self.dispatcher._numba_type_


def njit(function: Callable | None = None, **options):
    """Declare a kernel: ``numba.njit`` with the package's defaults, as ``@njit`` or ``@njit(...)``.

    ``_nrt`` is numba's runtime, which allocates arrays and counts who holds them.
    """
    if function is None:
        return lambda f: njit(f, **options)
    defaults = {"nogil": True, "cache": True, "no_cfunc_wrapper": True, "_nrt": True}
    return Kernel(function, {**defaults, **_DIVISION, **options})


def device(function: Callable | None = None, **options):
    """Declare a function that kernels call: compiled into them, without an entry for Python.

    That entry would often take as long to compile as the function. Where Python calls it, it runs
    as it is written. It works without numba's runtime (``_nrt``): counting who holds the arrays
    that it is given took a tenth of a job. A function that makes or returns arrays needs
    ``_nrt=True``.
    """
    return njit(function, **{"cache": False, "no_cpython_wrapper": True, "_nrt": False, **options})


def _numba() -> Any:
    try:
        import numba
    except ValueError as error:  # an environment variable of numba has a bad value
        raise DependencyError(
            "numba cannot be started",
            found=str(error),
            cure="Look for environment variables that begin with NUMBA_",
        ) from None
    import numba.core.event

    _tell_compiling(numba.core.event)
    return numba


class _CodeCache:
    """The folders of compiled code, one for each kernel as its sources are now."""

    #: Seconds after which code that no process loaded is removed: that of older versions.
    KEPT_S = 90 * 86400

    def __init__(self) -> None:
        self.failures = 0

    @cached_property
    def root(self) -> Path | None:
        """The folder of all code; None where none is safe or can be written."""
        for root in self.roots():
            try:
                root.mkdir(parents=True, exist_ok=True)
                tempfile.TemporaryFile(dir=root).close()
            except OSError:
                continue
            if not root.is_relative_to(_PACKAGE) and (exposed := exposed_folder(str(root))):
                print_messages(
                    f"compiled code is not kept, as other users can write to {exposed}: every "
                    "start compiles again. Set NUMBA_CACHE_DIR to a folder of your own"
                )
                return None
            for folder in root.iterdir():
                with contextlib.suppress(OSError):
                    if time.time() - folder.stat().st_mtime > self.KEPT_S:
                        shutil.rmtree(folder)
            return root
        return None

    @staticmethod
    def roots() -> list[Path]:
        """Return the folders that code may be in: the first that can be written is used."""
        named = os.environ.get("NUMBA_CACHE_DIR")
        ours = os.path.expanduser("~/.cache/pdal-stages")
        folders = [named] if named else [str(_PACKAGE / "__pycache__"), ours]
        return [Path(os.path.realpath(folder)) / "kernels" for folder in folders]

    def folder_of(self, kernel: Kernel) -> Path | None:
        """Return the folder of a kernel's code."""
        if self.failures > 1 or self.root is None:
            return None
        folder = self.root / _digest("-".join(sorted(_sources(kernel))).encode())
        with contextlib.suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            os.utime(folder)
        return folder

    def clear(self) -> bool:
        """Remove all code, and at the second time do without; False at the third."""
        self.failures += 1
        if self.root:
            shutil.rmtree(self.root, ignore_errors=True)
        return self.failures < 3


_cache = _CodeCache()


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]


@lru_cache(maxsize=256)
def _file_digest(path: str) -> str:
    try:
        return _digest(Path(path).read_bytes())
    except OSError:
        return path


def _sources(kernel: Any) -> set[str]:
    """Return digests of a kernel's source and constants, and of those of all that it calls.

    Called when the kernel is first called, since functions that it calls may be defined below it.
    """
    digests, seen, todo = {_file_digest(__file__)}, {kernel}, [kernel]
    while todo:
        function = _functions[todo.pop()]
        digests.add(_file_digest(function.__code__.co_filename))
        for name in function.__code__.co_names:
            called = function.__globals__.get(name)
            if isinstance(called, (int, float, tuple)):  # compiled in, from whatever module
                digests.add(_digest(f"{name}={called!r}".encode()))
            try:
                if called in _functions and called not in seen:
                    seen.add(called)
                    todo.append(called)
            except TypeError:  # a global that cannot be hashed is no kernel
                continue
    return digests


@lru_cache(maxsize=1)
def _tell_compiling(event: Any) -> None:
    """Show how many functions were compiled, where that takes longer than two seconds."""
    bar = Progress(0, "compiling for this processor, once, a minute or two", "functions")
    methods = {"on_start": lambda *_: None, "on_end": lambda *_: bar.update()}
    event.register("numba:compile", type("Listener", (event.Listener,), methods)())


def count_cached_kernels() -> int:
    """Return how many kernels have compiled code, of whatever version, without importing numba."""
    return sum(1 for root in _CodeCache.roots() for _ in root.rglob("*.nbi"))
