"""Spatial references of several inputs, which must be the same: PDAL merges meters and feet as they
are.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from ..base.errors import PipelineError, StageError
from ..base.las import header_there, named_las, projection, read_header
from ..base.units import Units, name_of_wkt, parse_wkt, refuse_likely_degrees, units_of_wkt
from . import pdal as pdal_env
from .runtime import reader_metadata, wkt_of
from .stage_files import reader_files

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
    plane: frozenset[str] = (
        frozenset()
    )  #: the projection's parameters; empty where they are not known
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
    run = pdal_env.execute([plain | dict(reader)], arrays=False)
    srs = reader_metadata(run.metadata).get("srs", {})
    wkt = wkt_of(srs)
    if not wkt and "GDAL failure" in run.log:
        raise PipelineError(
            pdal_env.BROKEN_REFERENCE,
            where=str(reader["filename"]),
            found=pdal_env.log_lines(run.log)[-1],
            cure=pdal_env.REFERENCE_CURE,
        )
    try:
        header = header_there(str(reader["filename"]))
        count, (x0, y0, x1, y1) = (
            (header.count, header.box) if header else (0, (0.0, 0.0, 0.0, 0.0))
        )
        middle = ((x0 + x1) / 2, (y0 + y1) / 2) if count else None
        units = units_of_wkt(wkt, horizontal=horizontal, vertical=vertical, place=middle)
        if units.assumed:
            refuse_likely_degrees(count, x0, y0, x1, y1)
    except StageError as error:
        raise error.at(str(reader["filename"])) from None
    words = str(srs.get("proj4") or "").split()
    plane = frozenset(w for w in words if w not in _ALIKE and not _ASIDE.match(w))
    root = parse_wkt(wkt)
    height = root.find("VERT_CS", "VERTCRS", "VERTICALCRS") if root else None
    return Reference(units, plane, height.code() if height else "", name_of_wkt(wkt), wkt)


def plane_unit(stages: Iterable[Mapping[str, Any]], metadata: Mapping[str, Any]) -> float | None:
    """Return the unit of x and y, in meters, that a pipeline's readers give its writers; None where
    that is not known.

    `metadata` is PDAL's, of the run.
    """
    if any(stage["type"] in MOVING or "a_srs" in stage for stage in stages):
        return None
    with suppress(StageError):
        if wkt := wkt_of(reader_metadata(metadata)):
            return units_of_wkt(wkt).horizontal
    return None


def reference_of_file(path: str, horizontal: str = "", vertical: str = "") -> Reference:
    """Return the reference of a file; see :func:`reference_of`."""
    las = (
        {"type": "readers.las", "count": 1}
        if named_las(path) and read_header(path) is not None
        else {}
    )
    return reference_of(pdal_env.typed([{"filename": path, **las}])[0], horizontal, vertical)


def check_one_reference(found: Mapping[str, Reference]) -> list[str]:
    """Refuse inputs, by path, with different units or reference systems; where one has none, only
    units are compared.

    Returns messages: which inputs have no reference, while others have one.
    """
    units: dict[object, str] = {}
    planes: dict[object, str] = {}
    heights: dict[object, str] = {}
    for path, one in found.items():
        across, upward = one.units.horizontal, one.units.vertical
        assumed = ", as there is no spatial reference" if one.units.assumed else ""
        units.setdefault(
            (across, upward), f"{across:g} m across and {upward:g} m upward in {path}{assumed}"
        )
        for kinds, said in ((planes, one.plane), (heights, one.height)):
            if said:
                kinds.setdefault(said, f"{one.name} in {path}")
    of_kind = {
        "units of length": units,
        "reference systems": planes,
        "reference systems of heights": heights,
    }
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
    """Refuse a pipeline whose LAS readers read different references, unless a stage moves points;
    returns messages.
    """
    if any(stage["type"] in MOVING for stage in stages):
        return []
    readers: dict[str, tuple[str, dict[str, Any]]] = {}
    for stage in stages:
        options = {k: v for k, v in stage.items() if k not in ("tag", "inputs", "filename")}
        for path in reader_files(stage, las=True):
            readers[path] = (
                f"{projection(path)} {options}",
                {**options, "filename": path, "count": 1},
            )
    kinds = dict(readers.values())
    if len(kinds) < 2:
        return []
    of_kind = {kind: reference_of(reader, horizontal) for kind, reader in kinds.items()}
    found = {path: of_kind[kind] for path, (kind, _) in readers.items()}
    return check_one_reference(found)
