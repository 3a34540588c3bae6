"""Spatial references of inputs, which must be the same: PDAL merges meters and feet as they are."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from typing import Any

from ..base.errors import PipelineError, StageError
from ..base.las import header_there, named_las, projection_digest
from ..base.units import Units, name_of_wkt, parse_wkt, refuse_likely_degrees, units_of_wkt
from . import pdal as pdal_env
from .inputs_outputs import readers_files
from .runtime import reader_metadata, wkt_of

#: Stages that may bring points into one reference.
MOVING = (
    "filters.reprojection",
    "filters.projpipeline",
    "filters.transformation",
    "filters.georeference",
)
#: Differences between references that move coordinates by less than a meter; units are compared
#: separately.
_ALIKE = ("+datum=WGS84", "+datum=NAD83", "+ellps=WGS84", "+ellps=GRS80")
_ASIDE = re.compile(r"\+(v?units|v?to_meter|towgs84|geoidgrids|no_defs|type|wktext)")
#: Part of the message about inputs that have none, next to others.
NO_REFERENCE = "no spatial reference;"


@dataclass(frozen=True)
class Reference:
    """The spatial reference of an input."""

    units: Units
    plane: frozenset[str] = frozenset()  #: the projection's parameters; empty where not known
    height: str = ""  #: the authority's code of the heights' system, where it is known
    name: str = ""
    wkt: str = ""  #: of the whole system, with the heights' where the file names one


def reference_of(reader: Mapping[str, Any], horizontal: str = "", vertical: str = "") -> Reference:
    """Return the reference of what a reader reads, according to PDAL.

    `horizontal` and `vertical` override the unit of x and y, and of z. The reader should be
    restricted to as few points as possible.
    """
    # Without extra bytes: of a file with odd ones, all of it would be copied for a single point.
    plain = {"ignore_vlr": "LASF_Spec/4"} if reader["type"] == "readers.las" else {}
    path = str(reader["filename"])
    run = pdal_env.execute([plain | dict(reader)], arrays=False)
    srs = reader_metadata(run.metadata).get("srs", {})
    wkt = wkt_of(srs)
    if not wkt and "GDAL failure" in run.log:
        reason, cure = pdal_env.log_lines(run.log)[-1], pdal_env.REFERENCE_CURE
        raise PipelineError(pdal_env.BROKEN_REFERENCE, where=path, found=reason, cure=cure)
    header = header_there(path)
    count, box = (header.count, header.box) if header else (0, (0.0, 0.0, 0.0, 0.0))
    middle = ((box[0] + box[2]) / 2, (box[1] + box[3]) / 2) if count else None
    try:
        units = units_of_wkt(wkt, horizontal=horizontal, vertical=vertical, place=middle)
        if units.assumed:
            refuse_likely_degrees(count, *box)
    except StageError as error:
        raise error.at(path) from None
    words = str(srs.get("proj4") or "").split()
    plane = frozenset(w for w in words if w not in _ALIKE and not _ASIDE.match(w))
    root = parse_wkt(wkt)
    height = root.find("VERT_CS", "VERTCRS", "VERTICALCRS") if root else None
    return Reference(units, plane, height.code() if height else "", name_of_wkt(wkt), wkt)


@cache
def fault_of_reference(name: str) -> str:
    """Return why coordinates in a reference, as PDAL takes its name, suit no stage; else empty.

    PDAL is asked for a single point, and reports a name that it does not know itself.
    """
    box = "([1, 2], [1, 2], [1, 2])"
    point = {"type": "readers.faux", "mode": "constant", "count": 1, "bounds": box}
    with suppress(PipelineError):
        run = pdal_env.execute([{**point, "override_srs": name}], arrays=False)
        try:
            units_of_wkt(wkt_of(reader_metadata(run.metadata)))
        except StageError as error:
            return error.what
    return ""


def plane_unit(stages: Iterable[Mapping[str, Any]], metadata: Mapping[str, Any]) -> float | None:
    """Return meters per unit of x and y from a run's `metadata` of PDAL; None if not known."""
    if any(stage["type"] in MOVING or "a_srs" in stage for stage in stages):
        return None
    with suppress(StageError):
        if wkt := wkt_of(reader_metadata(metadata)):
            return units_of_wkt(wkt).horizontal
    return None


def reference_of_file(path: str, horizontal: str = "", vertical: str = "") -> Reference:
    """Return the reference of a file; see :func:`reference_of`."""
    las = named_las(path) and header_there(path) is not None
    one_point = {"type": "readers.las", "count": 1} if las else {}
    reader = pdal_env.with_types([{"filename": path, **one_point}])[0]
    return reference_of(reader, horizontal, vertical)


def check_one_reference(references: Mapping[str, Reference]) -> list[str]:
    """Refuse inputs, by path, with different units or reference systems.

    Where one has no reference, only units are compared. Return messages: which inputs have no
    reference, while others have one.
    """
    kinds: dict[str, dict[object, str]] = {
        "units of length": {},
        "reference systems": {},
        "reference systems of heights": {},
    }
    for path, reference in references.items():
        across, upward = reference.units.horizontal, reference.units.vertical
        assumed = ", as there is no spatial reference" if reference.units.assumed else ""
        text = f"{across:g} m across and {upward:g} m upward in {path}{assumed}"
        named = f"{reference.name} in {path}"
        values = ((across, upward), text), (reference.plane, named), (reference.height, named)
        for inputs, (value, shown) in zip(kinds.values(), values, strict=True):
            if value:
                inputs.setdefault(value, shown)
    for what, inputs in kinds.items():
        if len(inputs) > 1:
            raise StageError(
                f"the inputs have different {what}",
                found="; ".join(inputs.values()),
                cure="Give them one spatial reference first: pdal translate IN OUT reprojection "
                "--filters.reprojection.out_srs=EPSG:CODE",
            )
    paths = [path for path, reference in references.items() if not reference.name]
    if not paths or len(paths) == len(references):
        return []
    listed = ", ".join(paths[:3]) + (f" and {len(paths) - 3:,} more" if len(paths) > 3 else "")
    has, taken = ("has", "it is") if len(paths) == 1 else ("have", "they are")
    return [f"{listed} {has} {NO_REFERENCE} {taken} assumed to have that of the other inputs"]


def check_readers(stages: list[dict[str, Any]], horizontal: str = "") -> list[str]:
    """Refuse a pipeline whose LAS readers read different references; return messages.

    A pipeline with a stage that moves points (:data:`MOVING`) is not checked.
    """
    if any(stage["type"] in MOVING for stage in stages):
        return []
    kinds: dict[str, dict[str, Any]] = {}  # PDAL is asked once for equal references
    kind_of: dict[str, str] = {}
    for stage in stages:
        options = {k: v for k, v in stage.items() if k not in ("tag", "inputs", "filename")}
        for path in readers_files([stage], las=True):
            kind_of[path] = f"{projection_digest(path)} {options}"
            kinds[kind_of[path]] = {**options, "filename": path, "count": 1}
    if len(kinds) < 2:
        return []
    of_kind = {kind: reference_of(reader, horizontal) for kind, reader in kinds.items()}
    return check_one_reference({path: of_kind[kind] for path, kind in kind_of.items()})
