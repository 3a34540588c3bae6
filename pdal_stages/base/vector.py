"""Vector data through shapely, pyogrio and pyproj (extra ``vector``): import, file names, processes."""

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
    """shapely, pyogrio or pyproj; an error says how to get it."""
    return optional_import(name, "vector", "work with vector data")


def is_odd(path: str) -> bool:
    """Whether pyogrio takes a file for another: up to '!' it sees an archive, after ';' parameters, and only UTF-8."""
    return "://" not in path and bool(re.search("[!\ud800-\udfff]|;[^/]*$", os.path.abspath(path)))


@contextmanager
def reading(
    path: str,
    what: str = "the vector file cannot be read",
    cure: str = "See whether ogrinfo -al reads it; ogr2ogr -makevalid new.gpkg FILE often mends what can be mended",
) -> Iterator[str]:
    """A name by which pyogrio finds a file; what GDAL, GEOS and PROJ raise over it is made an error of ours."""
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
    """A link to a file, of a plain name, beside links to what belongs to it."""
    plain = re.sub("[!;\ud800-\udfff]", "_", file.stem)
    for one in file.parent.glob(f"{glob.escape(file.stem)}.*"):
        (folder / (plain + one.name.removeprefix(file.stem))).symlink_to(one)
    return str(folder / (plain + file.suffix))


def with_vector(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function that uses the extra ``vector``, in its own process inside a program that is linked to GEOS or GDAL.

    On Linux the libraries of the program itself come first for all that it loads. A Python package
    with a GEOS or GDAL of its own would mix both and crash. So it is in the program `pdal`; Python
    is linked to neither.
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
    """The program of the Python that this is, inside a program that embeds it."""
    names = (f"python3.{sys.version_info.minor}", "python3")
    inside = (
        os.path.join(prefix, "bin", name)
        for prefix in (sys.prefix, sys.base_prefix)
        for name in names
    )
    given = [sys.executable] if os.path.basename(sys.executable or "").startswith("python") else []
    return next((path for path in (*given, *inside) if os.access(path, os.X_OK)), "python3")
