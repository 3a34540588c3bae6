"""Files of a job: inputs by name, folder or pattern, names of outputs, and the files of stages.

Each stage has a type (:func:`.pdal.with_types`).
"""

from __future__ import annotations

import glob
import os
import warnings
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from ..base.errors import PipelineError, StageError, optional_import, suggest
from ..base.files import LAS, Output
from ..base.json_types import StageJson
from ..base.las import named_copc, named_las, refuse_pipe

#: File name of the description of an EPT source.
EPT = "ept.json"
#: Tile indexes, by suffix.
_INDEXES = (".gpkg", ".sqlite", ".shp", ".geojson")
#: Writers of LAS and COPC.
LAS_WRITERS = ("writers.las", "writers.copc")
#: Readers of LAS files.
LAS_READERS = ("readers.las", "readers.copc")
#: Options of PDAL's stages that never name a file.
_NO_FILES = ("type", "tag", "inputs", "user_data", "pdalargs")


# ---- inputs --------------------------------------------------------------------------------------


def input_files(names: Sequence[str]) -> list[str]:
    """Return the inputs behind files, folders, patterns, tile indexes and EPT sources.

    Each comes once, in the order of the names; those behind one name are sorted.
    """
    by_place: dict[str, str] = {}
    for name in names:
        try:
            for path in _expand_name(name):
                by_place.setdefault(path if "://" in path else os.path.realpath(path), path)
        except OSError as error:
            raise StageError("the input cannot be read", where=name, found=error) from None
    return list(by_place.values())


def _expand_name(name: str) -> list[str]:
    """Return the inputs behind one name."""
    path = Path(name)
    if not name:  # which as a path is the current folder
        cure = "Name a file, or '.' for the current folder; is a shell variable unset?"
        raise StageError("the name of an input is empty", cure=cure)
    if "://" in name:
        return [name]
    if path.is_dir():
        if (path / EPT).is_file():
            return [str(path / EPT)]
        if inside := sorted(str(file) for file in path.iterdir() if is_las(str(file))):
            return inside
        cure = f"For files in subfolders name a pattern: '{name}/**/*.laz'"
        raise StageError("the folder holds no LAS or LAZ files", found=name, cure=cure)
    if path.suffix.lower() in _INDEXES:
        return locations(name)
    if path.exists() or name.startswith("/vsi"):
        return [name]
    if matches := sorted(glob.glob(name, recursive=True)):
        return matches
    beside = os.listdir(path.parent) if path.parent.is_dir() else []
    cure = f"{suggest(path.name, beside)}Check the path"
    raise StageError("there is no such file or folder", where=name, cure=cure)


def locations(path: str, column: str = "location") -> list[str]:
    """Return the files that a tile index of ``pdal tindex create`` names.

    Relative names are looked for in the index's folder, then in the current one.
    """
    from ..base.vector import reading

    refuse_pipe(path)
    pyogrio = optional_import("pyogrio", "vector", "tile indexes")
    cure = f"It needs a column '{column}' with file names (pipelines: tindex_name)"
    with reading(path, "the tile index cannot be read", cure) as plain, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # GDAL's, of files that it reads nevertheless
        names = [*pyogrio.raw.read(plain, columns=[column], read_geometry=False)[3], None][0]
        if names is None:
            raise ValueError(f"it has no column '{column}'")
        if odd := [name for name in names if not (isinstance(name, str) and name) or "\0" in name]:
            raise ValueError(f"{odd[0]!r} is not a file's name")
    if not len(names):
        raise StageError("the tile index names no file", where=path)
    there = {name: Path(path).absolute().parent / name for name in names}
    return [str(file if file.exists() else Path(name).absolute()) for name, file in there.items()]


def ept_address(name: str) -> str:
    """Return the path or address of the description of an EPT source."""
    name = name.removeprefix("ept://")
    name = name if name.endswith(EPT) else f"{name.rstrip('/')}/{EPT}"
    return name if "://" in name else os.path.abspath(name)


def is_las(name: str) -> bool:
    """Return whether an input is a local LAS, LAZ or COPC file, as its name says."""
    return named_las(name) and "://" not in name


# ---- outputs -------------------------------------------------------------------------------------


def is_folder(target: str) -> bool:
    """Return whether an output is a folder: an existing one, or a name that looks like one.

    Such a name ends with a slash, or has neither a suffix nor '#'. What begins with a digit, as in
    ``out_v1.2``, is no suffix of a file.
    """
    path = Path(target)
    has_suffix = path.suffix and not path.suffix[1:2].isdigit()
    named = "#" not in path.name and not has_suffix and not path.exists()
    return path.is_dir() or target.endswith(("/", os.sep)) or named


def outputs_of(sources: Sequence[str], target: str, copc: bool = False) -> list[str]:
    """Return an output for each input, with its name in place of ``#``.

    The file name ``#`` alone takes the input's suffix, too. With `copc`, COPC inputs become COPC
    outputs, else plain LAZ.
    """
    path = Path(target)
    names = [Path(source).name for source in sources]
    stems = [n[: -len(".copc.laz")] if named_copc(n) else Path(n).stem for n in names]
    if not copc:  # town.copc.laz, which QGIS makes beside town.laz, needs a name of its own
        plain = {stem for n, stem in zip(names, stems, strict=True) if not named_copc(n)}
        pairs = zip(names, stems, strict=True)
        stems = [f"{stem}_copc" if named_copc(n) and stem in plain else stem for n, stem in pairs]
    if path.name == "#":
        pairs = zip(names, stems, strict=True)
        names = [f"{stem}.laz" if named_copc(n) and not copc else n for n, stem in pairs]
        outputs = [str(path.parent / name) for name in names]
    else:
        outputs = named_outputs(target, stems)
    first: dict[str, str] = {}
    for source, output in zip(sources, outputs, strict=True):
        if (other := first.setdefault(output, source)) is not source:
            raise PipelineError(
                "two inputs have the same name and would be written to one file",
                found=f"{other} and {source}: {output}",
                cure="Give each folder of inputs a folder of outputs; or rename one",
            )
    return outputs


def named_outputs(target: str, names: Sequence[str]) -> list[str]:
    """Return a file's name with each name in place of ``#``; PipelineError without ``#``."""
    path = Path(target)
    if "#" not in path.name and len(names) > 1:
        raise PipelineError(
            "several inputs or tiles would be written to one file",
            found=f"{len(names)} to {target}",
            cure="Name a folder (with a slash at its end), or put '#' where the name of the input "
            "or tile should be, e.g. classified_#.laz. To merge inputs into one file, use a "
            "pipeline without --tile",
        )
    return [str(path.with_name(path.name.replace("#", name))) for name in names]


# ---- files of PDAL's stages ----------------------------------------------------------------------


def readers_files(stages: Sequence[StageJson], *, las: bool = False) -> list[str]:
    """Return the local files that PDAL's readers read; only LAS and LAZ files with `las`.

    Patterns are replaced by the files that match.
    """
    files: list[str] = []
    for stage in stages:
        name, is_las = stage.get("filename"), stage["type"] in LAS_READERS
        if not is_reader(stage) or not isinstance(name, str) or "://" in name:
            continue
        if is_las or not las:
            names = sorted(glob.glob(name)) if not os.path.exists(name) else [name]
            there = os.path.exists if is_las else os.path.isfile  # other readers may read a pipe
            files += [path for path in names if there(path) and not os.path.isdir(path)]
    return files


def named_files(stages: Sequence[StageJson]) -> list[str]:
    """Return existing files named in any option of PDAL's stages: polygons, rasters, scripts."""
    files: list[str] = []
    for stage in stages:
        aside = (*_NO_FILES, *(("filename",) if is_writer(stage) else ()))
        texts = _texts({name: value for name, value in stage.items() if name not in aside})
        files += [text for text in texts if "\0" not in text and os.path.isfile(text)]
    return files


def _texts(value: object) -> Iterator[str]:
    """Yield all texts in an option's value."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for inner in value.values() if isinstance(value, dict) else value:
            yield from _texts(inner)


def is_reader(stage: StageJson) -> bool:
    """Return whether a stage is a reader."""
    return stage["type"].startswith("readers.")


def is_writer(stage: StageJson) -> bool:
    """Return whether a stage writes a local file."""
    name, kind = stage.get("filename"), stage["type"]
    if not kind.startswith("writers.") or not isinstance(name, str) or "://" in name:
        return False
    return kind != "writers.text" or name.upper() != "STDOUT"  # which PDAL prints


def writes_las(stage: StageJson) -> bool:
    """Return whether a stage writes LAS."""
    return stage["type"] in LAS_WRITERS


def writers_outputs(stages: list[StageJson]) -> list[Output]:
    """Return the files that PDAL's writers write."""
    writers = filter(is_writer, stages)
    return [Output(s["filename"], "output", LAS if writes_las(s) else "") for s in writers]


def with_outputs(stages: list[StageJson], names: Iterable[object]) -> list[StageJson]:
    """Return the stages with other names for the files that writers write."""
    waiting = iter(names)
    return [{**s, "filename": str(next(waiting))} if is_writer(s) else s for s in stages]
