"""Compile the plugin for the installed PDAL, install it where PDAL looks, check, uninstall."""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from ..base.errors import DependencyError, StageError
from ..pipeline import pdal as pdal_env
from ..stages.registry import stage_types
from . import declarations

SOURCE = Path(__file__).with_name("stage.cpp")
#: Suffix of a shared library, by which PDAL knows its plugins.
SUFFIX = ".dylib" if sys.platform == "darwin" else ".so"
_PYTHON_FILTER = f"libpdal_plugin_filter_python{SUFFIX}"
#: Symbol that PDAL's library has in every version; its address leads to the library's file.
_OF_PDAL = "_ZN4pdal12StageFactoryC1Eb"
_STILL_WORK = "pdal-stages pipeline and pdal-stages expand still work"


def libraries() -> list[str]:
    """Return the files that PDAL looks for, such as ``libpdal_plugin_filter_hag_minima.so``."""
    parts = (name.partition(".") for name in stage_types())
    return [
        f"libpdal_plugin_{family.removesuffix('s')}_{name}{SUFFIX}" for family, _, name in parts
    ]


def usual_folder() -> Path:
    """Return the folder in PDAL's path with the plugin, else that of ``filters.python``."""
    there = (path for path in _driver_path() if any((path / n).is_file() for n in libraries()))
    return next(there, None) or plugin_folder()


def _driver_path() -> list[Path]:
    """Return the folders that PDAL_DRIVER_PATH names."""
    return [Path(part) for part in os.environ.get("PDAL_DRIVER_PATH", "").split(os.pathsep) if part]


def install(folder: Path | None = None) -> list[Path]:
    """Compile the plugin into a folder, by default that of ``filters.python``; return the files.

    A missing `folder` is created.
    """
    target = folder or usual_folder()
    installed, cxx = pdal(), compiler()
    if folder is not None:
        with contextlib.suppress(OSError):  # reported below
            folder.mkdir(parents=True, exist_ok=True)
    if not target.is_dir() or not os.access(target, os.W_OK):
        raise StageError(
            "the folder of PDAL's plugins cannot be written to",
            found=target,
            cure="Run this as its owner, or give --folder a folder of your own and add it to "
            "PDAL_DRIVER_PATH",
        )
    # In the same folder, so that a file is renamed into place; PDAL looks only at names of its own.
    with tempfile.TemporaryDirectory(prefix=".pdal_stages_", dir=target) as work:
        library = Path(work, "library")
        Path(work, "declarations.hpp").write_text(declarations.header())
        # The stages are copies of one library, loaded beside one another: hidden and symbolic, each
        # binds to symbols of its own. It computes nothing, so -O1 compiles sooner and loses
        # nothing; -w is for warnings of PDAL's headers, -s leaves symbols for debuggers out.
        link = ["-shared", f"-L{installed.library}", "-lpdalcpp", f"-Wl,-rpath,{installed.library}"]
        link += [] if sys.platform == "darwin" else ["-Wl,-Bsymbolic", "-s"]
        flags = ["-std=c++17", "-O1", "-fPIC", "-fvisibility=hidden", "-w"]
        flags += [f"-I{work}", f"-I{installed.headers}"]
        _run([*cxx, *flags, str(SOURCE), *link, "-o", str(library)])
        files = [target / name for name in libraries()]
        for path in files:
            os.replace(shutil.copy(library, Path(work, path.name)), path)
    return files


def uninstall(folder: Path | None = None) -> list[Path]:
    """Remove the plugin; return the removed files."""
    target = folder or usual_folder()
    gone = [target / name for name in libraries() if (target / name).is_file()]
    for path in gone:
        path.unlink()
    return gone


def check(folder: Path | None = None) -> tuple[list[str], list[str]]:
    """Return a line on the plugin that is installed, or lines on what is missing with its cure.

    An outdated plugin is reported when it runs.
    """
    missing = []
    for look in (compiler, pdal, plugin_folder):
        try:
            look()
        except DependencyError as error:
            missing.append(str(error))
    with contextlib.suppress(DependencyError):
        folder = folder or usual_folder()
        lacking = [name for name in libraries() if not (folder / name).is_file()]
        if not lacking:
            return [f"plugin: {len(libraries())} stages in {folder}"], []
        what = f"the plugin is not in {folder} (missing {', '.join(lacking[:3])})"
        missing.append(f"{what}. pdal-stages plugin --install")
    return [], missing


class Pdal(NamedTuple):
    """The PDAL that python-pdal uses."""

    library: Path  #: the folder of its library
    headers: Path  #: the folder that holds ``pdal/``


def compiler() -> list[str]:
    """Return the command of the C++ compiler, $CXX first."""
    named = os.environ.get("CXX", "").split()
    for words in [named] if named else [["c++"], ["g++"], ["clang++"]]:
        if shutil.which(words[0]):
            return words
    raise DependencyError(
        "there is no C++ compiler",
        found=f"CXX={' '.join(named)}" if named else "neither c++, g++ nor clang++ on PATH",
        cure="Debian, Ubuntu: apt-get install g++. Fedora: dnf install gcc-c++. macOS: "
        "xcode-select --install. conda: conda install -c conda-forge cxx-compiler. Without one, "
        f"{_STILL_WORK}",
    )


def pdal() -> Pdal:
    """Return PDAL's library and headers; DependencyError where they are missing."""
    library = _library_folder()
    for prefix in dict.fromkeys([*library.parents, Path(sys.prefix)]):
        if (prefix / "include" / "pdal" / "Filter.hpp").is_file():
            return Pdal(library, prefix / "include")
    raise DependencyError(
        "PDAL's headers are missing",
        found=f"no include/pdal beside {library}",
        cure="Debian, Ubuntu: apt-get install libpdal-dev. conda-forge: conda install -c "
        f"conda-forge libpdal-core. Without them, {_STILL_WORK}",
    )


def plugin_folder() -> Path:
    """Return the folder of ``filters.python``, where PDAL finds our plugin, too."""
    usual = [Path(sysconfig.get_path(key)) / "pdal" for key in ("platlib", "purelib")]
    tried = list(dict.fromkeys([*_driver_path(), *usual, Path(sys.prefix) / "lib"]))
    for folder in tried:
        if (folder / _PYTHON_FILTER).is_file():
            return folder
    raise DependencyError(
        "PDAL's plugin filters.python is missing, which runs our stages",
        found=f"{_PYTHON_FILTER} in none of {', '.join(map(str, tried))}",
        cure="It comes with pdal-plugins: conda install -c conda-forge pdal-plugins, or pip "
        "install pdal-plugins; where it is there already, set PDAL_DRIVER_PATH to the folder that "
        "holds it",
    )


class _LibraryOfAddress(ctypes.Structure):
    """``Dl_info`` of dladdr(3)."""

    _fields_ = [
        (name, ctypes.c_char_p if "file" in name else ctypes.c_void_p)
        for name in ("file", "base", "name", "address")
    ]


def _library_folder() -> Path:
    """Return the folder of the library that python-pdal is linked to."""
    extension = (
        importlib.import_module(f"{pdal_env.bindings().__name__}.libpdalpython").__file__ or ""
    )
    try:
        address = ctypes.cast(getattr(ctypes.CDLL(extension), _OF_PDAL), ctypes.c_void_p)
        about = _LibraryOfAddress()
        if ctypes.CDLL(None).dladdr(address, ctypes.byref(about)) and about.file:
            return Path(os.fsdecode(about.file)).resolve().parent
    except (OSError, AttributeError):
        pass
    raise DependencyError(
        "the library that python-pdal uses is not found",
        found=extension,
        cure=f"On this system the plugin cannot be built; {_STILL_WORK}",
    )


def _run(command: Sequence[str]) -> None:
    """Run the compiler; StageError with its first errors where it fails."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        lines = done.stderr.splitlines()
        raise StageError(
            "the plugin does not compile",
            found=f"{command[0]}: "
            f"{'; '.join([line for line in lines if 'error' in line][:3] or lines[-1:])}",
            cure=f"Report it with PDAL's version; without the plugin, {_STILL_WORK}",
        )
