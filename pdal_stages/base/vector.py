"""Vector data through shapely, pyogrio and pyproj (extra ``vector``): import, names, processes."""

from __future__ import annotations

import ctypes
import glob
import multiprocessing
import os
import re
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from .errors import StageError, optional_import


def vector(name: str) -> Any:
    """Import shapely, pyogrio or pyproj, or raise DependencyError with the way to install it."""
    return optional_import(name, "vector", "work with vector data")


def is_odd(path: str) -> bool:
    """Return whether pyogrio misreads a path.

    It takes the part before '!' for an archive, that after ';' for parameters, and reads UTF-8
    only.
    """
    return "://" not in path and bool(re.search("[!\ud800-\udfff]|;[^/]*$", os.path.abspath(path)))


@contextmanager
def reading(
    path: str,
    what: str = "the vector file cannot be read",
    cure: str = "Check it with ogrinfo -al; ogr2ogr -makevalid new.gpkg FILE often repairs it",
) -> Iterator[str]:
    """Yield a name by which pyogrio finds a file; errors of GDAL and GEOS become StageError."""
    with TemporaryDirectory() if is_odd(path) else nullcontext("") as links:
        try:
            yield _linked(Path(path).absolute(), Path(links)) if links else path
        except (StageError, MemoryError):
            raise
        except Exception as error:  # each package has its own
            raise StageError(
                what, where=path, found=f"{type(error).__name__}: {error}", cure=cure
            ) from error


def _linked(file: Path, folder: Path) -> str:
    """Return a link with a plain name to a file, beside links to files that belong to it."""
    plain = re.sub("[!;\ud800-\udfff]", "_", file.stem)
    for part in file.parent.glob(f"{glob.escape(file.stem)}.*"):
        (folder / (plain + part.name.removeprefix(file.stem))).symlink_to(part)
    return str(folder / (plain + file.suffix))


def with_vector(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function that uses the extra ``vector``, where necessary in a process of its own.

    On Linux the libraries that a program is linked to come first for everything it loads. Inside
    the program `pdal`, which is linked to GEOS and GDAL, a Python package with other versions of
    them would mix both and crash. Python itself is linked to neither.
    """
    linked = sys.platform.startswith("linux") and any(
        hasattr(ctypes.CDLL(None), name) for name in ("GEOSversion", "GDALVersionInfo")
    )
    if not linked:
        return function(*arguments)
    context = multiprocessing.get_context("spawn")
    context.set_executable(_interpreter())
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(function, *arguments).result()


def _interpreter() -> str:
    """Return the path of Python's own program, also inside a program that embeds Python."""
    names = (f"python3.{sys.version_info.minor}", "python3")
    inside = (
        os.path.join(prefix, "bin", name)
        for prefix in (sys.prefix, sys.base_prefix)
        for name in names
    )
    running = (
        [sys.executable] if os.path.basename(sys.executable or "").startswith("python") else []
    )
    return next((path for path in (*running, *inside) if os.access(path, os.X_OK)), "python3")
