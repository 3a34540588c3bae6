"""What ``"extra_dims": "all"`` means, where PDAL before 2.3 would take the flags of LAS 1.4 for an extra dimension too."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from ..base.extrabytes import extra_dimensions
from ..base.las import WAVES, read_header
from . import pdal as pdal_env
from .filenames import is_writer, reader_files, writes_las
from .writerlimits import las_version

#: PDAL's filters that add no dimension which the point formats lack.
_ADD_NOTHING = {
    f"filters.{name}"
    for name in (
        "merge", "crop", "range", "expression", "reprojection", "transformation", "splitter", "chipper", "divider",
        "outlier", "elm", "smrf", "pmf", "csf", "sample", "decimation", "head", "tail", "sort", "mortonorder",
        "randomize", "assign", "groupby", "returns", "voxelcenternearestneighbor", "stats", "info", "hexbin", "locate",
    )
}  # fmt: skip
_GIVE_HEIGHTS = ("filters.hag_nn", "filters.hag_delaunay", "filters.hag_dem")
#: Dimensions that some point formats lack: which have them, and PDAL's type.
_OF_FORMATS: dict[str, tuple[tuple[int, ...], str]] = {
    "GpsTime": ((1, 3, 4, 5, 6, 7, 8, 9, 10), "double"),
    "Red": ((2, 3, 5, 7, 8, 10), "uint16_t"),
    "Green": ((2, 3, 5, 7, 8, 10), "uint16_t"),
    "Blue": ((2, 3, 5, 7, 8, 10), "uint16_t"),
    "Infrared": ((8, 10), "uint16_t"),
}
#: Those that all have, in PDAL's writer.
_OF_ALL = (
    "X", "Y", "Z", "Intensity", "ReturnNumber", "NumberOfReturns", "ScanChannel", "ScanDirectionFlag",
    "EdgeOfFlightLine", "Classification", "UserData", "ScanAngleRank", "PointSourceId",
)  # fmt: skip
_NAME = re.compile(r"[A-Za-z_]\w*")
_FLAGS = "ClassFlags"


def settle(stages: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The stages, with ``all`` as a list in writers of LAS 1.4 that would write `ClassFlags` beside the flags themselves.

    Where it cannot be known which dimensions there will be, they stay as they are.
    """
    out = list(stages)
    if pdal_env.knows_class_flags():
        return out
    named = [
        number
        for number, stage in enumerate(out)
        if str(stage.get("extra_dims", "")).strip() == "all" and is_writer(stage, out) and writes_las(stage)
    ]
    found = _dimensions(out) if named else None
    if not found or _FLAGS not in found:
        return out
    for number in named:
        format_id = las_version(out[number], out[:number])[1]
        wanted = [
            f"{name}={found[name]}"
            for name in found  # in PDAL's order, too: as readers and filters add them
            if name != _FLAGS and not (name in _OF_FORMATS and format_id in _OF_FORMATS[name][0])
        ]
        if format_id >= 6:
            out[number] = {k: v for k, v in out[number].items() if k != "extra_dims"}
            if wanted:
                out[number]["extra_dims"] = ",".join(wanted)
    return out


def _dimensions(stages: Sequence[dict[str, Any]]) -> dict[str, str] | None:
    """Dimensions there will be beyond those that all point formats have, with their types; None where not all are known."""
    found: dict[str, str] = {}
    for stage in stages:
        kind = str(stage.get("type") or "")
        if is_writer(stage, list(stages)) or kind.startswith("writers."):
            continue
        if not kind or kind.startswith("readers."):
            added = _of_reader(stage)
        elif kind == "filters.python":
            listed = stage.get("add_dimension", [])
            pairs = [one.partition("=") for one in ([listed] if isinstance(listed, str) else listed)]
            added = {name.strip(): type_name.strip() or "double" for name, _, type_name in pairs}
        elif kind in _GIVE_HEIGHTS:
            added = {"HeightAboveGround": "double"}
        elif kind == "filters.ferry":
            added = _of_ferry(stage, found)
        else:
            added = {} if kind in _ADD_NOTHING else None
        if added is None or not all(map(_NAME.fullmatch, added)):
            return None
        for name, type_name in added.items():
            if found.setdefault(name, type_name) != type_name:
                return None  # PDAL would take the wider
    return {name: kind for name, kind in found.items() if name not in _OF_ALL}


def _of_reader(stage: Mapping[str, Any]) -> dict[str, str] | None:
    files = reader_files(dict(stage), las=True)
    if not files or "extra_dims" in stage:
        return None
    found: dict[str, str] = {}
    for path in files:
        header = read_header(path)
        if header is None or header.point_format in WAVES:
            return None
        found |= {n: kind for n, (ids, kind) in _OF_FORMATS.items() if header.point_format in ids}
        if header.point_format >= 6:
            found[_FLAGS] = "uint8_t"
        if header.minor >= 4 or str(stage.get("use_eb_vlr", "")).lower() == "true":
            found |= {n: kind for n, kind in extra_dimensions(path).items() if n != _FLAGS}
    return found


def _of_ferry(stage: Mapping[str, Any], known: Mapping[str, str]) -> dict[str, str] | None:
    listed = stage.get("dimensions", "")
    found: dict[str, str] = {}
    for pair in listed.split(",") if isinstance(listed, str) else listed:
        source, arrow, target = (part.strip() for part in str(pair).partition("=>"))
        kind = {"Classification": "uint8_t", "Z": "double", "": "double", **known}.get(source)
        if not arrow or kind is None:
            return None
        if target not in _OF_ALL:
            found[target] = kind
    return found
