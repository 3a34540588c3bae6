"""Inputs and outputs: files by name, folder or pattern, and their readers and writers."""

from __future__ import annotations

import glob
import os
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from ..base.errors import PipelineError, StageError, optional_import, suggest
from ..base.las import named_copc, named_las, refuse_pipe
from ..base.octree_check import check_copc, check_ept
from ..classifier.model_file import find
from ..stages.base import Stage
from . import pdal as pdal_env
from .overrides import Override, apply_overrides
from .stage_files import reader_files

#: File name of the description of an EPT source.
EPT = "ept.json"

#: Tile indexes, by suffix.
_INDEXES = (".gpkg", ".sqlite", ".shp", ".geojson")


def input_files(names: Sequence[str]) -> list[str]:
    """The inputs behind files, folders, patterns, tile indexes and EPT sources: each once, sorted
    by name within each.
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
    """The inputs behind one name."""
    if not name:  # which for a path is the current folder
        cure = "Name a file, or '.' for the current folder; is a shell variable unset?"
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
        cure = f"There are some in subfolders: '{folder}/**/*{deeper.suffix}'" if deeper else None
        raise StageError("the folder holds no LAS or LAZ files", found=str(folder), cure=cure)
    return inside


def locations(path: str, column: str = "location") -> list[str]:
    """The files a tile index names, made by ``pdal tindex create``; relative ones from its folder,
    then from here.
    """
    from ..base.vector import reading

    refuse_pipe(path)
    pyogrio = optional_import("pyogrio", "vector", "tile indexes")
    cure = f"It needs a column '{column}' with file names (option tindex_name)"
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


def is_ept(name: str) -> bool:
    """Whether an input is an EPT source."""
    return name.startswith("ept://") or Path(name).name == EPT


def ept_address(name: str) -> str:
    """The path or address of the description of an EPT source."""
    name = name.removeprefix("ept://")
    name = name if name.endswith(EPT) else f"{name.rstrip('/')}/{EPT}"
    return name if "://" in name else os.path.abspath(name)


def is_las(name: str) -> bool:
    """Whether an input is a LAS, LAZ or COPC file, as its name says."""
    return named_las(name) and "://" not in name


def is_folder(target: str) -> bool:
    """Whether an output is a folder: one that is there, or a name that ends with a slash, or has
    neither suffix nor '#'.
    """
    path = Path(target)
    named = "#" not in path.name and not path.suffix and not path.exists()
    return path.is_dir() or target.endswith(("/", os.sep)) or named


def _output_name(source: str, copc: bool) -> str:
    """The input's name; COPC becomes plain LAZ unless it is written as COPC."""
    name = Path(source).name
    return name[: -len(".copc.laz")] + ".laz" if named_copc(name) and not copc else name


def in_folders(sources: Sequence[str], names: Sequence[str]) -> list[str]:
    """The names of outputs in a folder; where two are equal, with the inputs' folders below their
    common one.
    """
    if len(set(names)) == len(names) or any("://" in source for source in sources):
        return list(names)
    folders = [os.path.dirname(os.path.abspath(source)) for source in sources]
    shared = os.path.commonpath(folders)
    inside = (os.path.relpath(folder, shared) for folder in folders)
    return [
        os.path.normpath(os.path.join(folder, name))
        for folder, name in zip(inside, names, strict=True)
    ]


def outputs_of(sources: Sequence[str], target: str, copc: bool = False) -> list[str]:
    """An output for each input, with its name in place of ``#``; for ``#`` alone, with its suffix
    (see :func:`in_folders`).

    `copc`: COPC inputs may be written as COPC, where this PDAL can.
    """
    path = Path(target)
    if path.name == "#":
        names = [_output_name(source, copc and pdal_env.knows_copc()) for source in sources]
        outputs = [str(path.parent / name) for name in in_folders(sources, names)]
    else:
        outputs = named_outputs(
            target, [Path(_output_name(source, False)).stem for source in sources]
        )
    first: dict[str, str] = {}
    for source, output in zip(sources, outputs, strict=True):
        if (other := first.setdefault(output, source)) is not source:
            raise PipelineError(
                "two inputs have the same name and would be written to one file",
                found=f"{other} and {source}: {output}",
                cure="Name a folder (with a slash at its end), which keeps the inputs' folders; or "
                "rename one",
            )
    return outputs


def named_outputs(target: str, names: Sequence[str]) -> list[str]:
    """A file's name with each name in place of ``#``; PipelineError where several would be written
    to one file.
    """
    path = Path(target)
    if "#" not in path.name and len(names) > 1:
        raise PipelineError(
            "several inputs or tiles would be written to one file",
            found=f"{len(names)} to {target}",
            cure="Name a folder (with a slash at its end), or put '#' where the name of the input "
            "or tile should be, e.g. "
            "classified_#.laz. To merge inputs into one file, use a pipeline",
        )
    return [str(path.with_name(path.name.replace("#", name))) for name in names]


def reader_of(source: str, tag: str) -> dict[str, Any]:
    """A reader; it also reads the extra dimensions of LAS 1.0-1.3, which PDAL leaves out by
    default.
    """
    stage: dict[str, Any] = {"filename": str(source), "tag": tag}
    if named_las(source) and not named_copc(source):
        stage |= {"type": "readers.las", "use_eb_vlr": True}
    return pdal_env.typed([stage])[0]


def writer_of(target: str) -> dict[str, Any]:
    """A writer that keeps the input's header, where it is a LAS file."""
    stage: dict[str, Any] = {"filename": target, "tag": "output"}
    if named_las(target):
        kind = "writers.copc" if named_copc(target) and pdal_env.knows_copc() else "writers.las"
        stage |= {"type": kind, "forward": "all"}
    return stage


def overridden(stage: dict[str, Any], overrides: Iterable[Override]) -> dict[str, Any]:
    """A stage with the overrides of its type."""
    return apply_overrides(
        [stage], [o for o in overrides if not o.by_tag and o.selector == stage["type"]]
    )[0]


def check_octrees(stages: list[dict[str, Any]]) -> None:
    """Refuse damaged octrees of COPC and EPT inputs; StageError."""
    for stage in stages:
        if stage["type"] == "readers.ept":
            check_ept(ept_address(str(stage.get("filename", ""))))
        elif stage["type"] == "readers.copc" and pdal_env.knows_copc():
            for path in reader_files(stage, las=True):
                check_copc(path)


def stage_files(stage: Stage) -> list[str]:
    """Files that a stage of ours reads; a model that is both read and written is among them."""
    written = {output.path for output in stage.outputs()}
    if stage.type.startswith("writers."):  # whose outputs may be named after it
        written.add(stage.options["filename"])
    given = [
        (o.kind, stage.options[o.name])
        for o in stage.all_options()
        if o.kind in ("filename", "model")
    ]
    models = [find(name) for kind, name in given if name and kind == "model"]
    files = [name for kind, name in given if kind != "model" and name and name not in written]
    return [*models, *files, *stage.inputs()]
