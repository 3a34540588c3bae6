"""The ends of the pipelines behind the short commands: files by name, folder or pattern, their readers and writers."""

from __future__ import annotations

import glob
import os
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from ..base.errors import StageError, optional_import, suggest
from . import pdal as pdal_env
from .overrides import Override, apply_overrides

#: What the description of an EPT source is called.
EPT = "ept.json"

#: Tile indexes, by suffix.
_INDEXES = (".gpkg", ".sqlite", ".shp", ".geojson")


def input_files(names: Sequence[str]) -> list[str]:
    """The inputs that files, folders, patterns, tile indexes and EPT sources stand for: each once, sorted within each name.

    Raises
    ------
    StageError
        Where a name is empty, stands for nothing or cannot be looked at, or a folder or a tile index holds no input.
    """
    found: list[str] = []
    for name in names:
        try:
            found += _meant(name)
        except OSError as error:
            raise StageError("the input cannot be read", where=name, found=error.strerror) from None
    by_place: dict[str, str] = {}
    for name in found:
        by_place.setdefault(name if "://" in name else os.path.realpath(name), name)
    return list(by_place.values())


def _meant(name: str) -> list[str]:
    """The inputs that one name stands for."""
    if not name:  # which for a path is the current folder
        cure = "Name a file, or '.' for the current folder; is a variable not set?"
        raise StageError("the name of an input is empty", cure=cure)
    path = Path(name)
    if "://" in name:
        return [name]
    if path.is_dir():
        return _inside(path)
    if path.suffix.lower() in _INDEXES:
        return locations(name)
    if path.exists() or name.startswith("/vsi"):
        return [name]
    if matches := sorted(glob.glob(name, recursive=True)):
        return matches
    beside = os.listdir(path.parent) if path.parent.is_dir() else []
    cure = f"{suggest(path.name, beside)}Check the path"
    raise StageError("there is no such file or folder", where=name, cure=cure)


def _inside(folder: Path) -> list[str]:
    """The LAS and LAZ files of a folder, or the EPT source that it is."""
    if (folder / EPT).is_file():
        return [str(folder / EPT)]
    inside = sorted(str(path) for path in folder.iterdir() if is_las(str(path)))
    if not inside:
        deeper = next(folder.rglob("*.la[sz]"), None)
        cure = f"There are some further down: '{folder}/**/*{deeper.suffix}'" if deeper else None
        raise StageError("the folder holds no LAS or LAZ files", found=str(folder), cure=cure)
    return inside


def locations(path: str, column: str = "location") -> list[str]:
    """The files a tile index names, made by ``pdal tindex create``; relative ones count from its folder, then from here.

    Raises
    ------
    StageError
        If it cannot be read, or has no such column.
    """
    pyogrio = optional_import("pyogrio", "vector", "tile indexes")
    try:
        with warnings.catch_warnings():  # GDAL's, of files that it reads nevertheless
            warnings.simplefilter("ignore")
            names = [*pyogrio.raw.read(path, columns=[column], read_geometry=False)[3], None][0]
        if names is None:
            raise ValueError(f"it has no column '{column}'")
        if odd := [name for name in names if not (isinstance(name, str) and name) or "\0" in name]:
            raise ValueError(f"{odd[0]!r} is not a file's name")
    except (OSError, ValueError, RuntimeError) as error:
        raise StageError(
            "the tile index cannot be read",
            where=path,
            found=str(error),
            cure=f"It needs a column '{column}' with file names (option tindex_name)",
        ) from None
    if not len(names):
        raise StageError("the tile index names no file", where=path)
    there = {name: Path(path).absolute().parent / name for name in names}
    return [str(file if file.exists() else Path(name).absolute()) for name, file in there.items()]


def is_ept(name: str) -> bool:
    """Whether an input is an EPT source."""
    return name.startswith("ept://") or Path(name).name == EPT


def is_las(name: str) -> bool:
    """Whether an input is a LAS, LAZ or COPC file, as its name says."""
    return Path(name).suffix.lower() in (".las", ".laz") and "://" not in name


def is_folder(target: str) -> bool:
    """Whether an output is a folder: one that is there, or a name that ends with a slash, or has neither suffix nor '#'."""
    path = Path(target)
    named = "#" not in path.name and not path.suffix and not path.exists()
    return path.is_dir() or target.endswith(("/", os.sep)) or named


def _output_name(source: str) -> str:
    """The input's name; what this PDAL cannot write as COPC becomes plain LAZ."""
    name = Path(source).name
    return name[: -len(".copc.laz")] + ".laz" if _is_copc(name) and not pdal_env.writes_copc() else name


def _is_copc(name: str) -> bool:
    return name.lower().endswith(".copc.laz")


def in_folders(sources: Sequence[str], names: Sequence[str]) -> list[str]:
    """What outputs are called in a folder; where two names are one, with the inputs' folders below the one they share."""
    if len(set(names)) == len(names) or any("://" in source for source in sources):
        return list(names)
    folders = [os.path.dirname(os.path.abspath(source)) for source in sources]
    shared = os.path.commonpath(folders)
    inside = (os.path.relpath(folder, shared) for folder in folders)
    return [os.path.normpath(os.path.join(folder, name)) for folder, name in zip(inside, names, strict=True)]


def outputs_of(sources: Sequence[str], target: str) -> list[str]:
    """An output for each input: in a folder under the input's name (see :func:`in_folders`), or with that name for ``#``.

    Raises
    ------
    StageError
        Where several inputs would be written to one file.
    """
    path = Path(target)
    if is_folder(target):
        outputs = [str(path / n) for n in in_folders(sources, [_output_name(source) for source in sources])]
    elif "#" in path.name:
        outputs = [str(path.with_name(path.name.replace("#", Path(source).stem))) for source in sources]
    elif len(sources) > 1:
        raise StageError(
            "several inputs would be written to one file",
            found=f"{len(sources)} inputs, {target}",
            cure="Name a folder (with a slash at its end), or put '#' where the input's name should be, e.g. "
            "classified_#.laz. To merge them into one file, use a pipeline",
        )
    else:
        return [target]
    first: dict[str, str] = {}
    for source, output in zip(sources, outputs, strict=True):
        if (other := first.setdefault(output, source)) is not source:
            raise StageError(
                "two inputs have one name and would be written to one file",
                found=f"{other} and {source}: {output}",
                cure="Name a folder (with a slash at its end), in which each lies in the folder of its input; or rename one",
            )
    return outputs


def reader_of(source: str, tag: str) -> dict[str, Any]:
    """A reader; of LAS 1.0-1.3 it takes the extra dimensions too, which PDAL leaves out unless told."""
    stage: dict[str, Any] = {"filename": str(source), "tag": tag}
    if is_ept(source):
        stage["type"] = "readers.ept"
    elif Path(source).suffix.lower() in (".las", ".laz") and not _is_copc(source):
        stage |= {"type": "readers.las", "use_eb_vlr": True}
    return stage


def writer_of(target: str) -> dict[str, Any]:
    """A writer that keeps the input's header, where it is a LAS file."""
    stage: dict[str, Any] = {"filename": target, "tag": "output"}
    if Path(target).suffix.lower() in (".las", ".laz"):
        kind = "writers.copc" if _is_copc(target) and pdal_env.writes_copc() else "writers.las"
        stage |= {"type": kind, "forward": "all"}
    return stage


def overridden(stage: dict[str, Any], overrides: Iterable[Override]) -> dict[str, Any]:
    """A stage with the overrides of its type."""
    return apply_overrides([stage], [o for o in overrides if not o.by_tag and o.selector == stage["type"]])[0]
