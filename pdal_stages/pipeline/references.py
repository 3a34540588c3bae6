"""The reference systems of several inputs, which must be one: PDAL merges points of meters and of feet as they are."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ..base.errors import StageError
from ..base.las import projection, read_header
from ..base.units import Units, name_of_wkt, parse_wkt, units_of_wkt
from . import pdal as pdal_env
from .filenames import is_writer, readers_files

#: Stages that may give points of several references one.
MOVING = ("filters.reprojection", "filters.projpipeline", "filters.transformation", "filters.georeference")
#: What differs between references whose coordinates lie within a meter: units are compared apart.
_ALIKE = ("+datum=WGS84", "+datum=NAD83", "+ellps=WGS84", "+ellps=GRS80")
_ASIDE = tuple(
    f"+{word}"
    for word in [
        "units",
        "vunits",
        "to_meter",
        "vto_meter",
        "towgs84",
        "geoidgrids",
        "no_defs",
        "type",
        "wktext",
    ]
)


#: In what is said of inputs that have none, beside others.
NO_REFERENCE = "no spatial reference;"


@dataclass(frozen=True)
class Reference:
    """What an input's coordinates mean."""

    units: Units
    plane: frozenset[str] = frozenset()  #: the projection's parameters; empty where they are not known
    height: str = ""  #: the authority's code of the heights' system, where it is known
    name: str = ""
    wkt: str = ""  #: of the horizontal system, for other programs


def reference_of(reader: Mapping[str, Any], horizontal: str = "") -> Reference:
    """The reference of what a reader reads, as PDAL says; `horizontal`: the unit of x and y, where it is known better.

    The reader is restricted to as few points as it can be.

    Raises
    ------
    PipelineError
        If PDAL cannot read it.
    StageError
        If its coordinates are degrees.
    """
    said = pdal_env.execute([dict(reader)], arrays=False).metadata.get("metadata", {})
    node: Any = next((node for kind, node in said.items() if kind.startswith("readers.")), {})
    srs = (node[0] if isinstance(node, list) else node).get("srs", {})
    wkt = str(srs.get("compoundwkt") or srs.get("wkt") or "")
    try:
        units = units_of_wkt(wkt, horizontal=horizontal, place=_place(str(reader["filename"])))
    except StageError as error:
        raise error.at(str(reader["filename"])) from None
    words = str(srs.get("proj4") or "").split()
    plane = frozenset(w for w in words if w not in _ALIKE and not w.startswith(_ASIDE))
    root = parse_wkt(wkt)
    height = root.find("VERT_CS", "VERTCRS", "VERTICALCRS") if root else None
    across = str(srs.get("horizontal") or srs.get("wkt") or "")
    return Reference(units, plane, height.code() if height else "", name_of_wkt(wkt), across)


def reference_of_file(path: str, horizontal: str = "") -> Reference:
    """The same of a file."""
    las = read_header(path) is not None if path.lower().endswith((".las", ".laz")) else False
    return reference_of({"filename": path} | ({"type": "readers.las", "count": 1} if las else {}), horizontal)


def _place(path: str) -> tuple[float, float] | None:
    """The middle of a LAS file."""
    with contextlib.suppress(OSError, ValueError):
        if (header := read_header(path)) is not None:
            x0, y0, x1, y1 = header.box
            return (x0 + x1) / 2, (y0 + y1) / 2
    return None


def check_one_reference(found: Mapping[str, Reference]) -> list[str]:
    """Refuse inputs, by path, of different units or reference systems; where one names none, only units are compared.

    What is to be told is given back: which inputs have no reference, while others have one.
    """
    units: dict[object, str] = {}
    planes: dict[object, str] = {}
    heights: dict[object, str] = {}
    for path, one in found.items():
        across, upward = one.units.horizontal, one.units.vertical
        assumed = ", as no reference says otherwise" if one.units.assumed else ""
        units.setdefault((across, upward), f"{across:g} m across and {upward:g} m upward in {path}{assumed}")
        if one.plane:
            planes.setdefault(one.plane, f"{one.name} in {path}")
        if one.height:
            heights.setdefault(one.height, f"{one.name} in {path}")
    kinds_of = {
        "units of length": units,
        "reference systems": planes,
        "reference systems of heights": heights,
    }
    for what, kinds in kinds_of.items():
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
    return [f"{named} {has} {NO_REFERENCE} {taken} taken to have that of the other inputs"]


def check_readers(stages: list[dict[str, Any]], horizontal: str = "") -> list[str]:
    """Refuse a pipeline whose LAS readers read different references, unless a stage moves points; what is to be told."""
    if any(stage.get("type") in MOVING for stage in stages):
        return []
    readers: dict[str, tuple[str, dict[str, Any]]] = {}
    for stage in [stage for stage in stages if not is_writer(stage, stages)]:
        options = {k: v for k, v in stage.items() if k not in ("tag", "inputs", "filename")}
        options.setdefault("type", "readers.las")
        for path in readers_files([stage], las=True):
            readers[path] = f"{projection(path)} {options}", {**options, "filename": path, "count": 1}
    kinds = dict(readers.values())
    if len(kinds) < 2:
        return []
    of_kind = {kind: reference_of(reader, horizontal) for kind, reader in kinds.items()}
    found = {path: of_kind[kind] for path, (kind, _) in readers.items()}
    return check_one_reference(found)
