"""What the plugin is compiled with and where PDAL looks for it, on this machine."""

from __future__ import annotations

import ctypes
import importlib
import os
import re
import shutil
import sys
import sysconfig
from pathlib import Path
from typing import NamedTuple

from ..base.errors import DependencyError
from ..pipeline import pdal as pdal_env

#: Suffix of a shared library, by which PDAL knows its plugins.
SUFFIX = ".dylib" if sys.platform == "darwin" else ".so"
_PYTHON_FILTER = f"libpdal_plugin_filter_python{SUFFIX}"
#: A function of PDAL's library, in every version: its address tells which file the library is.
_OF_PDAL = "_ZN4pdal12StageFactoryC1Eb"
_OTHER_DOORS = "every other door works: pdal-stages pipeline, pdal-stages expand"


class Pdal(NamedTuple):
    """The PDAL that python-pdal uses."""

    library: Path  #: the folder of its library
    headers: Path  #: the folder that holds ``pdal/``
    version: str


def compiler() -> list[str]:
    """The C++ compiler, $CXX first."""
    named = os.environ.get("CXX", "").split()
    for words in [named] if named else [["c++"], ["g++"], ["clang++"]]:
        if shutil.which(words[0]):
            return words
    raise DependencyError(
        "there is no C++ compiler",
        found=f"CXX={' '.join(named)}" if named else "neither c++, g++ nor clang++ on PATH",
        cure="Debian, Ubuntu: apt-get install g++. Fedora: dnf install gcc-c++. macOS: xcode-select --install. conda: "
        f"conda install -c conda-forge cxx-compiler. Without one {_OTHER_DOORS}",
    )


def pdal() -> Pdal:
    """PDAL's library and headers; :class:`DependencyError` with the cure where they are missing or do not fit."""
    library, version = _library_folder(), pdal_env.dotted_version()
    for prefix in dict.fromkeys([*library.parents, Path(sys.prefix)]):
        headers = prefix / "include"
        if not (headers / "pdal" / "Filter.hpp").is_file():
            continue
        found = _headers_version(headers)
        if found not in (version, ""):
            raise DependencyError(
                "PDAL's headers are of another version than its library",
                found=f"{headers / 'pdal'}: {found}, {library}: {version}",
                cure="Install both from one place",
            )
        return Pdal(library, headers, version)
    raise DependencyError(
        "PDAL's headers are missing",
        found=f"no include/pdal beside {library}",
        cure="Debian, Ubuntu: apt-get install libpdal-dev. conda-forge: conda install -c conda-forge libpdal-core. "
        f"Without them {_OTHER_DOORS}",
    )


def plugin_folder() -> Path:
    """The folder of ``filters.python``, where PDAL will find our plugin too."""
    named = [Path(part) for part in os.environ.get("PDAL_DRIVER_PATH", "").split(os.pathsep) if part]
    usual = [Path(sysconfig.get_path(key)) / "pdal" for key in ("platlib", "purelib")]
    tried = list(dict.fromkeys([*named, *usual, Path(sys.prefix) / "lib"]))
    for folder in tried:
        if (folder / _PYTHON_FILTER).is_file():
            return folder
    raise DependencyError(
        "PDAL's plugin filters.python is missing, which runs our stages",
        found=f"{_PYTHON_FILTER} in none of {', '.join(map(str, tried))}",
        cure="It comes with pdal-plugins: conda install -c conda-forge pdal-plugins, or pip install pdal-plugins; where it "
        "is there already, set PDAL_DRIVER_PATH to the folder that holds it",
    )


class _Found(ctypes.Structure):
    """``Dl_info`` of dladdr(3)."""

    _fields_ = [
        (name, ctypes.c_char_p if "file" in name else ctypes.c_void_p)
        for name in ("file", "base", "name", "address")
    ]


def _library_folder() -> Path:
    """The folder of the library that python-pdal is linked to."""
    extension = importlib.import_module(f"{pdal_env.bindings().__name__}.libpdalpython").__file__ or ""
    try:
        address = ctypes.cast(getattr(ctypes.CDLL(extension), _OF_PDAL), ctypes.c_void_p)
        found = _Found()
        if ctypes.CDLL(None).dladdr(address, ctypes.byref(found)) and found.file:
            return Path(os.fsdecode(found.file)).resolve().parent
    except (OSError, AttributeError):
        pass
    raise DependencyError(
        "the library that python-pdal uses is not found",
        found=extension,
        cure=f"On this system the plugin cannot be built; {_OTHER_DOORS}",
    )


def _headers_version(headers: Path) -> str:
    """The version that PDAL's headers say, empty where they do not."""
    for name in ("pdal_features.hpp", "pdal_config.hpp"):
        path = headers / "pdal" / name
        text = path.read_text(errors="replace") if path.is_file() else ""
        numbers = dict(re.findall(r"#define\s+PDAL_VERSION_(MAJOR|MINOR|PATCH)\s+(\d+)", text))
        if len(numbers) == 3:
            return f"{numbers['MAJOR']}.{numbers['MINOR']}.{numbers['PATCH']}"
    return ""
