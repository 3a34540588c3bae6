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
from importlib import metadata
from pathlib import Path
from typing import Any

from ..base.errors import DependencyError, StageError
from ..base.version import __version__
from ..stages import registry
from . import declarations, places

#: Beside the libraries: what was put there, by which version, for which PDAL.
RECORD = "pdal_stages_plugin.json"
_PACKAGE = "pdal-stages-plugin"
_FLAGS = ["-std=c++17", "-O1", "-fPIC", "-fvisibility=hidden", "-w"]


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
    found = places.pdal()
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
        built = compile_into(Path(work), found)
        uninstall(target)
        files = []
        for path in built:
            files.append(target / path.name)
            os.replace(path, files[-1])
        record = {
            "pdal_stages": __version__,
            "digest": declarations.digest(),
            "pdal": found.version,
            "python": sys.prefix,
            "files": [path.name for path in files],
        }
        written = Path(work) / RECORD
        written.write_text(json.dumps(record, indent=2) + "\n")
        os.replace(written, target / RECORD)
    return files


def compile_into(work: Path, pdal: places.Pdal) -> list[Path]:
    """The libraries, one for each stage, compiled in a folder."""
    source, cxx = places.sources(), places.compiler()
    declarations.write(work)
    flags = [*_FLAGS, f"-I{work}", f"-I{pdal.headers}"]
    _run([*cxx, *flags, "-c", str(source / "stage.cpp"), "-o", str(work / "stage.o")])
    link = ["-shared", f"-L{pdal.library}", "-lpdalcpp", f"-Wl,-rpath,{pdal.library}"]
    if sys.platform != "darwin":
        link += ["-Wl,-Bsymbolic", "-s"]
    built = []
    for type_name in registry.stages():
        built.append(work / library_name(type_name))
        define = f'-DPDAL_STAGES_TYPE="{type_name}"'
        entry = [define, str(source / "entry.cpp"), str(work / "stage.o")]
        _run([*cxx, *_FLAGS, *entry, *link, "-o", str(built[-1])])
    return built


def uninstall(folder: Path | None = None) -> list[Path]:
    """Take the plugin away; the files that were there."""
    target = folder or usual_folder()
    if record(target) is None and _by_pip() is not None:
        raise StageError("the plugin came as a package", found=_PACKAGE, cure=f"pip uninstall {_PACKAGE}")
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
    no_compiler: list[str] = []  # no fault where all is built
    pdal_version = ""
    try:
        good.append(f"compiler: {shutil.which(places.compiler()[0])}")
    except DependencyError as error:
        no_compiler.append(str(error))
    try:
        found = places.pdal()
        pdal_version = found.version
        good.append(f"PDAL {found.version}: {found.library}, headers {found.headers / 'pdal'}")
    except DependencyError as error:
        bad.append(str(error))
    try:
        good.append(f"filters.python: {places.plugin_folder()}")
        folder = folder or usual_folder()
    except DependencyError as error:
        bad.append(str(error))
    if folder is None:
        return good, no_compiler + bad
    cure = "pdal-stages plugin --install"
    if (kept := record(folder)) is None:
        version = _by_pip()
        if version == __version__:
            return [*good, f"plugin: the package {_PACKAGE} {version}"], bad
        if version is not None:
            bad.append(
                f"{_PACKAGE} is of another version (found {version}, pdal-stages {__version__}). Upgrade both"
            )
            return good, bad
        return good, [*no_compiler, *bad, f"the plugin is not in {folder}. {cure}"]
    missing = [name for kind in registry.stages() if not (folder / (name := library_name(kind))).is_file()]
    wrong = {
        f"libraries are missing in {folder} (found {', '.join(missing)})": bool(missing),
        f"the plugin in {folder} is of another version (found {kept.get('pdal_stages')}, package {__version__})": (
            kept.get("pdal_stages") != __version__
        ),
        f"the plugin in {folder} is out of date: options of stages have changed since": (
            kept.get("digest") != declarations.digest()
        ),
        f"the plugin in {folder} was built for another PDAL (found {kept.get('pdal')})": (
            bool(pdal_version) and kept.get("pdal") != pdal_version
        ),
    }
    bad += [f"{text}. {cure}" for text, is_so in wrong.items() if is_so]
    if bad:
        return good, no_compiler + bad
    return [*good, f"plugin: {len(kept['files'])} stages in {folder}"], []


def _by_pip() -> str | None:
    """The version of the plugin that pip or conda installed."""
    try:
        return metadata.version(_PACKAGE)
    except metadata.PackageNotFoundError:
        return None


def _run(command: Sequence[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        errors = [line for line in done.stderr.splitlines() if "error" in line] or done.stderr.splitlines()[
            -1:
        ]
        raise StageError(
            "the plugin does not compile",
            found=f"{' '.join(command[:1])}: {'; '.join(errors[:3])}",
            cure="Report it with PDAL's version; every other door works without the plugin: pdal-stages pipeline, "
            "pdal-stages expand",
        )
