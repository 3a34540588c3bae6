"""How kernels are compiled: without the GIL, cached where the user can write.

``njit`` here is numba's with the package's defaults, and numba itself is imported when a kernel is
first called, so that commands that need none, and errors, come at once. numba keys cached code by
its own source file only, so a changed *device function* in another module would leave stale code
behind: the key here is a digest of the sources of the kernel and of all that it calls. Compiled
code is cached at first use rather than shipped, because it is made for the processor it runs on.
This file is digested, too: a changed default below, or ``FAST``, compiles everything again.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import threading
from collections.abc import Callable
from functools import lru_cache, partial, update_wrapper
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
        return (self._dispatcher or self.dispatcher)(*arguments)

    @property
    def dispatcher(self) -> Any:
        """The function as numba compiles it."""
        with _lock:
            if self._dispatcher is None:
                numba = _numba()
                self._dispatcher = self._cached(numba) or numba.njit(
                    **{**self._options, "cache": False}
                )(self._function)
            return self._dispatcher

    def _cached(self, numba: Any) -> Any:
        """Return the function with a cache of its code; None if no folder is safe or writable."""
        try:
            dispatcher = numba.njit(**self._options)(self._function)
        except RuntimeError:  # no folder for the cache can be written
            return None
        file: Any = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
        if hasattr(file, "_source_stamp"):
            folder = os.path.realpath(file._cache_path)
            if not Path(folder).is_relative_to(_PACKAGE) and (exposed := exposed_folder(folder)):
                _tell_uncached(exposed)
                return None
            file._cache_path, file._index_path = folder, os.path.join(folder, file._index_name)
            file._source_stamp = "-".join(sorted(_sources(self)))
            file.load, file.save = (_careful(file, act) for act in (file.load, file.save))
            cache = dispatcher._cache
            cache.load_overload = partial(_load, cache, cache.load_overload)
        return dispatcher

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


def _load(cache: Any, usual: Callable, signature: Any, target: Any) -> Any:
    """Load a kernel without what only compiling needs, a sixth of a small job.

    numba imports all that it can compile before it loads a kernel. Tried with numba 0.58, 0.61,
    0.68.
    """
    from numba.core.runtime import rtsys

    codegen = target.codegen()
    try:
        rtsys.initialize(target)
        codegen.unserialize_library = partial(_library, codegen)
        return cache._load_overload(signature, target)
    except AttributeError:  # numba does not promise these methods: another version lacks one
        return usual(signature, target)
    finally:
        vars(codegen).pop("unserialize_library", None)


def _library(codegen: Any, state: tuple[str, str, tuple[bytes, bytes]]) -> Any:
    """Return the library of a kernel's compiled code.

    Its intermediate code, which is larger, is read only when a kernel that calls it is compiled.
    """
    from llvmlite.binding import parse_bitcode

    name, _, (code, intermediate) = state
    library = codegen.create_library(name)
    library.enable_object_caching()
    library._set_compiled_object(code)
    library._finalize_final_module()
    library._get_module_for_linking = lru_cache(partial(parse_bitcode, intermediate))
    # numba would read the intermediate code for the names of functions; the compiled code has them.
    library.get_pointer_to_function = codegen._engine.get_function_address
    return library


def _careful(file: Any, act: Callable) -> Callable:
    """Wrap loading or saving of code: after damage or on a full disk it is compiled again."""

    def attempt(*arguments: Any) -> Any:
        try:
            return act(*arguments)
        except Exception:
            with contextlib.suppress(OSError):
                file.flush()

    return attempt


@lru_cache(maxsize=1)
def _tell_uncached(folder: str) -> None:
    """Warn, once in a process, that kernels are compiled at each start, and why."""
    print_messages(
        f"compiled code is not kept, as other users can write to {folder}: every start compiles "
        "again. Set NUMBA_CACHE_DIR to a folder of your own"
    )


@lru_cache(maxsize=256)
def _file_digest(path: str) -> str:
    try:
        return hashlib.sha256(Path(path).read_bytes()).hexdigest()[:16]
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
                digests.add(hashlib.sha256(f"{name}={called!r}".encode()).hexdigest()[:16])
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
    named = os.environ.get("NUMBA_CACHE_DIR")
    folders = [Path(named)] if named else [_PACKAGE, Path.home() / ".cache" / "numba"]
    # os.walk passes over what may not be entered
    names = (name for folder in folders for _, _, files in os.walk(folder) for name in files)
    return sum(name.endswith(".nbi") for name in names)
