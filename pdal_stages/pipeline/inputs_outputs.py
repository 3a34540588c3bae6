"""Inputs and outputs: files by name, folder or pattern, their readers and writers, the inputs' reference systems."""

from __future__ import annotations

import glob
import os
import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..base.errors import PipelineError, StageError, optional_import, suggest
from ..base.las import header_there, named_copc, named_las, projection, read_header
from ..base.octree import check_copc, check_ept
from ..base.units import Units, name_of_wkt, parse_wkt, refuse_likely_degrees, units_of_wkt
from ..classifier.modelfile import find
from ..stages.base import Stage
from . import pdal as pdal_env
from .read import Override, apply_overrides, reader_files

#: File name of the description of an EPT source.
EPT = "ept.json"

#: Tile indexes, by suffix.
_INDEXES = (".gpkg", ".sqlite", ".shp", ".geojson")


def input_files(names: Sequence[str]) -> list[str]:
    """The inputs behind files, folders, patterns, tile indexes and EPT sources: each once, sorted by name within each."""
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
    """The files a tile index names, made by ``pdal tindex create``; relative ones from its folder, then from here."""
    from ..objects.outlines import reading

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
    """Whether an output is a folder: one that is there, or a name that ends with a slash, or has neither suffix nor '#'."""
    path = Path(target)
    named = "#" not in path.name and not path.suffix and not path.exists()
    return path.is_dir() or target.endswith(("/", os.sep)) or named


def _output_name(source: str, copc: bool) -> str:
    """The input's name; COPC becomes plain LAZ unless it is written as COPC."""
    name = Path(source).name
    return name[: -len(".copc.laz")] + ".laz" if named_copc(name) and not copc else name


def in_folders(sources: Sequence[str], names: Sequence[str]) -> list[str]:
    """The names of outputs in a folder; where two are equal, with the inputs' folders below their common one."""
    if len(set(names)) == len(names) or any("://" in source for source in sources):
        return list(names)
    folders = [os.path.dirname(os.path.abspath(source)) for source in sources]
    shared = os.path.commonpath(folders)
    inside = (os.path.relpath(folder, shared) for folder in folders)
    return [os.path.normpath(os.path.join(folder, name)) for folder, name in zip(inside, names, strict=True)]


def outputs_of(sources: Sequence[str], target: str, copc: bool = False) -> list[str]:
    """An output for each input, with its name in place of ``#``; for ``#`` alone, with its suffix (see :func:`in_folders`).

    `copc`: COPC inputs may be written as COPC, where this PDAL can.
    """
    path = Path(target)
    if path.name == "#":
        names = [_output_name(source, copc and pdal_env.knows_copc()) for source in sources]
        outputs = [str(path.parent / name) for name in in_folders(sources, names)]
    else:
        outputs = named_outputs(target, [Path(_output_name(source, False)).stem for source in sources])
    first: dict[str, str] = {}
    for source, output in zip(sources, outputs, strict=True):
        if (other := first.setdefault(output, source)) is not source:
            raise PipelineError(
                "two inputs have the same name and would be written to one file",
                found=f"{other} and {source}: {output}",
                cure="Name a folder (with a slash at its end), which keeps the inputs' folders; or rename one",
            )
    return outputs


def named_outputs(target: str, names: Sequence[str]) -> list[str]:
    """A file's name with each name in place of ``#``; PipelineError where several would be written to one file."""
    path = Path(target)
    if "#" not in path.name and len(names) > 1:
        raise PipelineError(
            "several inputs or tiles would be written to one file",
            found=f"{len(names)} to {target}",
            cure="Name a folder (with a slash at its end), or put '#' where the name of the input or tile should be, e.g. "
            "classified_#.laz. To merge inputs into one file, use a pipeline",
        )
    return [str(path.with_name(path.name.replace("#", name))) for name in names]


def reader_of(source: str, tag: str) -> dict[str, Any]:
    """A reader; it also reads the extra dimensions of LAS 1.0-1.3, which PDAL leaves out by default."""
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
    return apply_overrides([stage], [o for o in overrides if not o.by_tag and o.selector == stage["type"]])[0]


# ---- reference systems of several inputs, which must be the same: PDAL merges meters and feet as they are -

#: Stages that may bring points into one reference.
MOVING = ("filters.reprojection", "filters.projpipeline", "filters.transformation", "filters.georeference")
#: Differences between references that move coordinates by less than a meter; units are compared separately.
_ALIKE = ("+datum=WGS84", "+datum=NAD83", "+ellps=WGS84", "+ellps=GRS80")
_ASIDE = re.compile(r"\+(v?units|v?to_meter|towgs84|geoidgrids|no_defs|type|wktext)")
#: Part of the message about inputs that have none, next to others.
NO_REFERENCE = "no spatial reference;"


@dataclass(frozen=True)
class Reference:
    """The spatial reference of an input."""

    units: Units
    plane: frozenset[str] = frozenset()  #: the projection's parameters; empty where they are not known
    height: str = ""  #: the authority's code of the heights' system, where it is known
    name: str = ""
    wkt: str = ""  #: of the horizontal system, for other programs


def reference_of(reader: Mapping[str, Any], horizontal: str = "") -> Reference:
    """The reference of what a reader reads, according to PDAL; `horizontal` overrides the unit of x and y.

    The reader should be restricted to as few points as possible.
    """
    said = pdal_env.execute([dict(reader)], arrays=False).metadata.get("metadata", {})
    node: Any = next((node for kind, node in said.items() if kind.startswith("readers.")), {})
    srs = (node[0] if isinstance(node, list) else node).get("srs", {})
    wkt = str(srs.get("compoundwkt") or srs.get("wkt") or "")
    try:
        header = header_there(str(reader["filename"]))
        count, (x0, y0, x1, y1) = (header.count, header.box) if header else (0, (0.0, 0.0, 0.0, 0.0))
        middle = ((x0 + x1) / 2, (y0 + y1) / 2) if count else None
        units = units_of_wkt(wkt, horizontal=horizontal, place=middle)
        if units.assumed:
            refuse_likely_degrees(count, x0, y0, x1, y1)
    except StageError as error:
        raise error.at(str(reader["filename"])) from None
    words = str(srs.get("proj4") or "").split()
    plane = frozenset(w for w in words if w not in _ALIKE and not _ASIDE.match(w))
    root = parse_wkt(wkt)
    height = root.find("VERT_CS", "VERTCRS", "VERTICALCRS") if root else None
    across = str(srs.get("horizontal") or srs.get("wkt") or "")
    return Reference(units, plane, height.code() if height else "", name_of_wkt(wkt), across)


def reference_of_file(path: str, horizontal: str = "") -> Reference:
    """The same of a file."""
    las = {"type": "readers.las", "count": 1} if named_las(path) and read_header(path) is not None else {}
    return reference_of(pdal_env.typed([{"filename": path, **las}])[0], horizontal)


def check_one_reference(found: Mapping[str, Reference]) -> list[str]:
    """Refuse inputs, by path, with different units or reference systems; where one has none, only units are compared.

    Returns messages: which inputs have no reference, while others have one.
    """
    units: dict[object, str] = {}
    planes: dict[object, str] = {}
    heights: dict[object, str] = {}
    for path, one in found.items():
        across, upward = one.units.horizontal, one.units.vertical
        assumed = ", as there is no spatial reference" if one.units.assumed else ""
        units.setdefault((across, upward), f"{across:g} m across and {upward:g} m upward in {path}{assumed}")
        for kinds, said in ((planes, one.plane), (heights, one.height)):
            if said:
                kinds.setdefault(said, f"{one.name} in {path}")
    of_kind = {"units of length": units, "reference systems": planes, "reference systems of heights": heights}
    for what, kinds in of_kind.items():
        if len(kinds) > 1:
            raise StageError(
                f"the inputs have different {what}",
                found="; ".join(kinds.values()),
                cure="Give them one spatial reference first: pdal translate IN OUT reprojection "
                "--filters.reprojection.out_srs=EPSG:CODE",
            )
    paths = [path for path, one in found.items() if not one.name]
    if not paths or len(paths) == len(found):
        return []
    named = ", ".join(paths[:3]) + (f" and {len(paths) - 3:,} more" if len(paths) > 3 else "")
    has, taken = ("has", "it is") if len(paths) == 1 else ("have", "they are")
    return [f"{named} {has} {NO_REFERENCE} {taken} assumed to have that of the other inputs"]


def check_readers(stages: list[dict[str, Any]], horizontal: str = "") -> list[str]:
    """Refuse a pipeline whose LAS readers read different references, unless a stage moves points; returns messages."""
    if any(stage["type"] in MOVING for stage in stages):
        return []
    readers: dict[str, tuple[str, dict[str, Any]]] = {}
    for stage in stages:
        options = {k: v for k, v in stage.items() if k not in ("tag", "inputs", "filename")}
        for path in reader_files(stage, las=True):
            readers[path] = f"{projection(path)} {options}", {**options, "filename": path, "count": 1}
    kinds = dict(readers.values())
    if len(kinds) < 2:
        return []
    of_kind = {kind: reference_of(reader, horizontal) for kind, reader in kinds.items()}
    found = {path: of_kind[kind] for path, (kind, _) in readers.items()}
    return check_one_reference(found)


def check_octrees(stages: list[dict[str, Any]]) -> None:
    """Refuse damaged octrees of COPC and EPT inputs; StageError."""
    for stage in stages:
        if stage["type"] == "readers.ept":
            check_ept(ept_address(str(stage.get("filename", ""))))
        elif stage["type"] == "readers.copc" and pdal_env.knows_copc():
            for path in reader_files(stage, las=True):
                check_copc(path)


def stage_files(stage: Stage) -> list[str]:
    """Files that a stage of ours reads."""
    written = {output.path for output in stage.outputs()}
    if stage.type.startswith("writers."):  # whose outputs may be named after it
        written.add(stage.options["filename"])
    given = [(o.kind, stage.options[o.name]) for o in stage.all_options() if o.kind in ("filename", "model")]
    found = [find(name) if kind == "model" else name for kind, name in given if name]
    return [name for name in [*found, *stage.inputs()] if name not in written]
