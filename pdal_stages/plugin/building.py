"""The plugin compiled for the PDAL at hand, put where PDAL looks, checked, and taken away again."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..base.errors import DependencyError, StageError
from ..base.version import __version__
from ..stages import registry
from . import declarations, places

#: Beside the libraries: what was put there, by which version, for which PDAL.
RECORD = "pdal_stages_plugin.json"
SOURCE = Path(__file__).with_name("stage.cpp")


def library_name(type_name: str) -> str:
    """The file that PDAL looks for: ``filters.hag_minima`` is in ``libpdal_plugin_filter_hag_minima.so``."""
    family, _, name = type_name.partition(".")
    return f"libpdal_plugin_{family.removesuffix('s')}_{name}{places.SUFFIX}"


def usual_folder() -> Path:
    """Where PDAL looks and the plugin is already; otherwise the folder of ``filters.python``."""
    named = [Path(part) for part in os.environ.get("PDAL_DRIVER_PATH", "").split(os.pathsep) if part]
    return next((path for path in named if record(path) is not None), None) or places.plugin_folder()


def install(folder: Path | None = None) -> list[Path]:
    """Compile the plugin and put it into a folder, by default beside ``filters.python``; the files.

    A `folder` that is not there yet is made.

    Raises
    ------
    DependencyError
        If the compiler, PDAL's headers or ``filters.python`` is missing.
    StageError
        If it does not compile, or the folder cannot be written.
    """
    target = folder or usual_folder()
    found, cxx = places.pdal(), places.compiler()
    if folder is not None:
        with contextlib.suppress(OSError):  # told below
            folder.mkdir(parents=True, exist_ok=True)
    if not target.is_dir() or not os.access(target, os.W_OK):
        raise StageError(
            "the folder of PDAL's plugins cannot be written",
            found=target,
            cure="Run this as its owner, or give --folder a folder of your own and add it to PDAL_DRIVER_PATH",
        )
    # In the same folder, so that a file is renamed into place; PDAL looks only at names of its own.
    with tempfile.TemporaryDirectory(prefix=".pdal_stages_", dir=target) as work:
        library = Path(work, "library")
        Path(work, "declarations.hpp").write_text(declarations.header())
        link = ["-shared", f"-L{found.library}", "-lpdalcpp", f"-Wl,-rpath,{found.library}"]
        link += [] if sys.platform == "darwin" else ["-Wl,-Bsymbolic", "-s"]
        flags = ["-std=c++17", "-O1", "-fPIC", "-fvisibility=hidden", "-w", f"-I{work}", f"-I{found.headers}"]
        _run([*cxx, *flags, str(SOURCE), *link, "-o", str(library)])
        uninstall(target)
        files = [target / library_name(kind) for kind in registry.stages()]
        record = {
            "pdal_stages": __version__,
            "digest": _digest(),
            "pdal": found.version,
            "python": sys.prefix,
            "files": [path.name for path in files],
        }
        Path(work, RECORD).write_text(json.dumps(record, indent=2) + "\n")
        for path in files:
            os.replace(shutil.copy(library, Path(work, path.name)), path)
        os.replace(Path(work, RECORD), target / RECORD)
    return files


def _digest() -> str:
    """Changes with any stage, option, default or help."""
    return " ".join(map(declarations.digest, registry.stages().values()))


def uninstall(folder: Path | None = None) -> list[Path]:
    """Take the plugin away; the files that were there."""
    target = folder or usual_folder()
    names = [*(record(target) or {}).get("files", []), *map(library_name, registry.stages()), RECORD]
    files = [target / Path(name).name for name in dict.fromkeys(names)]  # never outside the folder
    gone = [path for path in files if path.is_file()]
    for path in gone:
        try:
            path.unlink()
        except OSError as error:
            raise StageError("a file cannot be removed", found=f"{path}: {error.strerror}") from None
    return gone


def record(folder: Path) -> dict[str, Any] | None:
    """What was put into a folder; None where nothing was."""
    try:
        found = json.loads((folder / RECORD).read_text())
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def check(folder: Path | None = None) -> tuple[list[str], list[str]]:
    """What is there, and what is missing or wrong, each with its cure."""
    good: list[str] = []
    bad: list[str] = []
    version = ""
    try:
        found = places.pdal()
        version = found.version
        good.append(f"PDAL {version}: {found.library}, headers {found.headers / 'pdal'}")
    except DependencyError as error:
        bad.append(str(error))
    try:
        good.append(f"filters.python: {places.plugin_folder()}")
        folder = folder or usual_folder()
    except DependencyError as error:
        bad.append(str(error))
    kept = record(folder) if folder else None
    if folder and kept is not None:
        lacking = [n for kind in registry.stages() if not (folder / (n := library_name(kind))).is_file()]
        place = f"the plugin in {folder}"
        wrong = {
            f"libraries are missing in {folder} (found {', '.join(lacking)})": bool(lacking),
            f"{place} is of another version (found {kept.get('pdal_stages')}, package {__version__})": (
                kept.get("pdal_stages") != __version__
            ),
            f"{place} is out of date: options of stages have changed since": kept.get("digest") != _digest(),
            f"{place} was built for another PDAL (found {kept.get('pdal')})": version
            not in ("", kept.get("pdal")),
        }
        bad += [f"{text}. pdal-stages plugin --install" for text, is_so in wrong.items() if is_so]
        if not bad:
            good.append(f"plugin: {len(kept['files'])} stages in {folder}")
    elif folder:
        bad.append(f"the plugin is not in {folder}. pdal-stages plugin --install")
    try:
        good.insert(0, f"compiler: {shutil.which(places.compiler()[0])}")
    except DependencyError as error:
        bad = [str(error), *bad] if bad else []  # no fault where all is built
    return good, bad


def _run(command: Sequence[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        lines = done.stderr.splitlines()
        raise StageError(
            "the plugin does not compile",
            found=f"{command[0]}: {'; '.join([line for line in lines if 'error' in line][:3] or lines[-1:])}",
            cure="Report it with PDAL's version; every other door works without the plugin: pdal-stages pipeline, "
            "pdal-stages expand",
        )
