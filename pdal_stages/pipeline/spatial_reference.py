"""Spatial references of inputs, which must be the same: PDAL merges meters and feet as they are."""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from ..base.errors import OptionError, PipelineError, StageError
from ..base.json_types import JsonObject, StageJson
from ..base.las import (
    PROJECTION,
    header_there,
    named_las,
    projection_digest,
    records_of,
)
from ..base.las_check import check_readable
from ..base.messages import Message, Topic
from ..base.units import (
    SYSTEMS,
    Units,
    name_of_wkt,
    parse_wkt,
    refuse_likely_degrees,
    units_of_wkt,
)
from . import pdal as pdal_env
from .inputs_outputs import LAS_READERS, readers_files
from .pdal_errors import BROKEN_REFERENCE, NAME_CURE, REFERENCE_CURE
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


@dataclass(frozen=True)
class Reference:
    """The spatial reference of an input."""

    units: Units
    wkt: str = ""  #: of the whole system, with the heights' where the file names one
    note: str = ""  #: a message about it

    @property
    def name(self) -> str:
        """Return its name; empty without one."""
        return name_of_wkt(self.wkt)

    @property
    def plane(self) -> frozenset[str]:
        """Return the parameters of its projection, as PDAL has them; empty without one."""
        return described(self.wkt)[1] if self.wkt else frozenset()

    @property
    def height(self) -> str:
        """Return the authority's code of the heights' system; empty where it is not known."""
        root = parse_wkt(self.wkt)
        vertical = root.find("VERT_CS", "VERTCRS", "VERTICALCRS") if root else None
        return vertical.code() if vertical else ""


@cache
def described(reference: str) -> tuple[str, frozenset[str]]:
    """Return the well-known text of a reference and its projection's parameters, as PDAL has them.

    `reference` is well-known text or a name such as ``EPSG:25832+5783``.
    """
    run = pdal_env.execute([{**pdal_env.ONE_POINT, "override_srs": reference}], arrays=False)
    return _wkt_and_plane(reader_metadata(run.metadata).get("srs", {}))


def _wkt_and_plane(srs: JsonObject) -> tuple[str, frozenset[str]]:
    words = str(srs.get("proj4") or "").split()
    return wkt_of(srs), frozenset(w for w in words if w not in _ALIKE and not _ASIDE.match(w))


@cache
def _wkt_of_keys(*records: tuple[int, bytes]) -> str:
    """Return the well-known text of GeoTIFF keys.

    PDAL reads it from a file of one point made for this: LAS 1.2, where every PDAL reads them.
    """
    parts = [
        struct.pack("<H16sHH32x", 0, PROJECTION, number, len(data)) + data
        for number, data in records
    ]
    head = bytearray(227)
    head[:4], head[24:26] = b"LASF", bytes((1, 2))
    offset = 227 + sum(map(len, parts))
    struct.pack_into("<HIIBHI", head, 94, 227, offset, len(parts), 0, 20, 1)
    struct.pack_into("<12d", head, 131, 1, 1, 1, *([0] * 9))
    with TemporaryDirectory(prefix="pdal-stages-") as folder:
        path = os.path.join(folder, "keys.las")
        Path(path).write_bytes(bytes(head) + b"".join(parts) + bytes(20))
        run = pdal_env.execute([{"type": "readers.las", "filename": path}], arrays=False)
    wkt = wkt_of(reader_metadata(run.metadata).get("srs", {}))
    if not wkt and "GDAL failure" in run.log:
        raise _broken(pdal_env.log_lines(run.log)[-1])
    return wkt


def _broken(reason: str) -> PipelineError:
    return PipelineError(BROKEN_REFERENCE, found=reason, cure=REFERENCE_CURE)


#: Numbers of the records of GeoTIFF keys: the directory, its numbers, its texts.
_KEYS = (34735, 34736, 34737)
#: Number of the record with well-known text.
_WKT = 2112


def projection_records(path: str) -> list[tuple[int, bytes]]:
    """Return the records of a LAS file's spatial reference, by number."""
    return [(record.number, data) for record, data in records_of(path, PROJECTION)]


def reference_of_las(path: str) -> tuple[str, str]:
    """Return the well-known text of a LAS file's reference, and a message about it.

    The text where the header's flag says so, else the GeoTIFF keys; the other one where there is
    only that.
    """
    held = projection_records(path)
    text = next((plain for number, data in held if number == _WKT and (plain := _text(data))), "")
    keys = [(number, data) for number, data in held if number in _KEYS]
    if not any(number == _KEYS[0] and len(data) > 8 for number, data in keys):
        keys = []  # a directory of none
    if text and not _is_whole(text) and not described(text)[0]:
        raise _broken(text[:60])
    if not (text and keys):
        return text or (_wkt_of_keys(*keys) if keys else ""), ""
    of_keys = _wkt_of_keys(*keys)
    header = header_there(path)
    says_wkt = header is not None and header.says_wkt
    taken, other = (text, of_keys) if says_wkt else (of_keys, text)
    if other and described(taken)[1] != described(other)[1]:
        kinds = ("its text", "its GeoTIFF keys")
        first, second = kinds if says_wkt else kinds[::-1]
        return taken, (
            f"{path} names two spatial references: {first} ({name_of_wkt(taken)}) is taken, as its "
            f"header says, not {second} ({name_of_wkt(other)})"
        )
    return taken or other, ""


def _is_whole(wkt: str) -> bool:
    """Return whether well-known text is plainly a system with its units; else PDAL judges it."""
    root = parse_wkt(wkt)
    if root is None or root.keyword not in SYSTEMS or not wkt.rstrip().endswith(("]", ")")):
        return False
    plane = root.find("PROJCS", "PROJCRS", "PROJECTEDCRS", "LOCAL_CS", "ENGCRS")
    globe = root.find("GEOGCS", "GEOGCRS", "GEODCRS", "GEODETICCRS", "GEOGRAPHICCRS", "GEOCCS")
    return plane.unit() is not None if plane else globe is not None


def _text(data: bytes) -> str:
    return data.split(b"\0")[0].decode("utf-8", "replace").strip()


def text_of(reader: StageJson) -> tuple[str, str]:
    """Return the well-known text of the reference of what a reader reads, and a message about it.

    Of LAS files it is what their records say, or the reader's ``override_srs`` or
    ``default_srs``; of others what PDAL says of as few points as possible.
    """
    path, note = str(reader["filename"]), ""
    if reader["type"] not in LAS_READERS or header_there(path) is None:
        run = pdal_env.execute([dict(reader)], arrays=False)
        return _wkt_and_plane(reader_metadata(run.metadata).get("srs", {}))[0], ""
    check_readable(path)  # PDAL, which may be asked for another file, crashes of damaged ones
    wkt, note = ("", "") if reader.get("override_srs") else reference_of_las(path)
    option = "override_srs" if reader.get("override_srs") else "default_srs"
    if wkt or not reader.get(option):
        return wkt, note
    try:
        return described(str(reader[option]))[0], note
    except PipelineError as error:
        what = f"option '{option}' names no reference system that PDAL knows"
        raise OptionError(what, where=reader["type"], found=error.found, cure=NAME_CURE) from None


def reference_of(reader: StageJson, horizontal: str = "", vertical: str = "") -> Reference:
    """Return the reference of what a reader reads; see :func:`text_of`.

    `horizontal` and `vertical` override the unit of x and y, and of z.
    """
    path = str(reader["filename"])
    header = header_there(path) if reader["type"] in LAS_READERS else None
    try:
        wkt, note = text_of(reader)
        count, box = (header.count, header.box) if header else (0, (0.0, 0.0, 0.0, 0.0))
        middle = ((box[0] + box[2]) / 2, (box[1] + box[3]) / 2) if count else None
        units = units_of_wkt(wkt, horizontal=horizontal, vertical=vertical, place=middle)
        if units.assumed:
            refuse_likely_degrees(count, *box)
    except StageError as error:
        raise error.at(path) from None
    return Reference(units, wkt, note)


@cache
def fault_of_reference(name: str) -> str:
    """Return why coordinates in a reference, as PDAL takes its name, suit no stage; else empty.

    PDAL reports a name that it does not know itself.
    """
    with suppress(PipelineError):
        wkt, _ = described(name)
        try:
            units_of_wkt(wkt)
        except StageError as error:
            return error.what
    return ""


def reference_of_file(path: str, horizontal: str = "", vertical: str = "") -> Reference:
    """Return the reference of a file; see :func:`reference_of`."""
    las = named_las(path) and header_there(path) is not None
    kind = {"type": "readers.las"} if las else {}
    reader = pdal_env.with_types([{"filename": path, **kind}])[0]
    return reference_of(reader, horizontal, vertical)


def records_for(named: str, path: str) -> list[tuple[int, bytes]]:
    """Return the records that name a reference system in a copy of a LAS file.

    LAS 1.4 takes any as well-known text; earlier versions take systems with a code of EPSG's, as
    GeoTIFF keys.
    """
    wkt, _ = described(named)
    header = header_there(path)
    if header is not None and header.minor >= 4:
        return [(_WKT, wkt.encode() + b"\0")]
    codes = re.fullmatch(r"EPSG:(\d+)(?:\+(\d+))?", named.strip(), re.IGNORECASE)
    root = parse_wkt(wkt)
    if codes is None or root is None or root.find("PROJCS", "PROJCRS") is None:
        raise PipelineError(
            "LAS 1.0 to 1.3 names a projected reference system by EPSG's code",
            where=path,
            found=named,
            cure="Give its code (EPSG:CODE, or EPSG:CODE+CODE with that of the heights), or "
            "convert the file to LAS 1.4 first",
        )
    heights = [(4096, int(codes[2]))] if codes[2] else []
    keys = [(1024, 1), (1025, 1), (3072, int(codes[1])), *heights]
    rows = [(1, 1, 0, len(keys)), *((key, 0, 1, value) for key, value in keys)]
    return [(_KEYS[0], b"".join(struct.pack("<4H", *row) for row in rows))]


def check_one_reference(references: Mapping[str, Reference]) -> list[Message]:
    """Refuse inputs, by path, with different units or reference systems.

    Where one has no reference, only units are compared. Return messages: which inputs have no
    reference, while others have one.
    """
    kinds: dict[str, dict[object, str]] = {
        "units of length": {},
        "reference systems": {},
        "reference systems of heights": {},
    }
    several = len({reference.wkt for reference in references.values()}) > 1
    for path, reference in references.items():
        across, upward = reference.units.horizontal, reference.units.vertical
        assumed = ", as there is no spatial reference" if reference.units.assumed else ""
        text = f"{across:g} m across and {upward:g} m upward in {path}{assumed}"
        named = f"{reference.name} in {path}"
        plane = reference.plane if several else frozenset()
        values = ((across, upward), text), (plane, named), (reference.height, named)
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
    text = f"{listed} {has} no spatial reference; {taken} assumed to have that of the other inputs"
    return [Message(text, Topic.NO_REFERENCE)]


def check_readers(stages: list[StageJson], horizontal: str = "") -> list[Message]:
    """Refuse a pipeline whose LAS readers read different references; return messages.

    A pipeline with a stage that moves points (:data:`MOVING`) is not checked.
    """
    if any(stage["type"] in MOVING for stage in stages):
        return []
    kinds: dict[str, StageJson] = {}  # PDAL is asked once for equal references
    kind_of: dict[str, str] = {}
    for stage in stages:
        options = {k: v for k, v in stage.items() if k not in ("tag", "inputs", "filename")}
        for path in readers_files([stage], las=True):
            kind_of[path] = f"{projection_digest(path)} {options}"
            kinds[kind_of[path]] = {**options, "filename": path}
    if len(kinds) < 2:
        return []
    of_kind = {kind: reference_of(reader, horizontal) for kind, reader in kinds.items()}
    return check_one_reference({path: of_kind[kind] for path, kind in kind_of.items()})
