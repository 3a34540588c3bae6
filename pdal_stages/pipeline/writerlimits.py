"""What LAS writers can hold of our stages' results: class codes and numbers of dimensions, said before any work."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..base.asprs import LEGACY_LIMIT
from ..base.errors import DimensionError, OptionError
from ..base.las import LasHeader, read_header
from ..stages.base import Stage
from . import pdal as pdal_env

_LAS_WRITERS = ("writers.las", "writers.copc")
#: A variable-length record of LAS holds 65,535 bytes; an extra dimension's description takes 192.
_MOST_EXTRA = 65_535 // 192


def check_writers(stages: list[dict[str, Any]], ours: list[tuple[Stage, str, int]]) -> None:
    """Class codes must fit the LAS files written later, and extra dimensions one LAS record.

    Parameters
    ----------
    stages : list of dict
        The lowered pipeline.
    ours : list of (Stage, str, int)
        Stages of ours, what messages call them, and where they are.

    Raises
    ------
    OptionError, DimensionError
        Naming the stage.
    """
    for stage, place, index in ours:
        largest, extra = stage.largest_class(), len(stage.creates())
        for writer in stages[index + 1 :]:
            if not _writes_las(writer):
                continue
            if largest > LEGACY_LIMIT:
                _check_codes(place, largest, writer, stages[:index])
            if extra > _MOST_EXTRA and str(writer.get("extra_dims", "")).strip() == "all":
                raise DimensionError(
                    f"LAS cannot hold so many extra dimensions: one record describes {_MOST_EXTRA} of them",
                    where=place,
                    found=f"{extra} features",
                    cure="Take fewer neighborhoods or features, write to a format without the limit (writers.text, "
                    "writers.tiledb), or use writers.classifiermodel and filters.modelclassifier, which need no "
                    "dimensions",
                )


def _writes_las(stage: dict[str, Any]) -> bool:
    type_name = stage.get("type", "")
    suffix = Path(str(stage.get("filename", ""))).suffix.lower()
    return type_name in _LAS_WRITERS or (not type_name and suffix in (".las", ".laz"))


def _check_codes(place: str, largest: int, writer: dict[str, Any], before: list[dict[str, Any]]) -> None:
    if writer.get("type") == "writers.copc":
        return
    minor, format_id = _las_version(writer, before)
    if format_id <= 5:
        raise OptionError(
            f"class codes above {LEGACY_LIMIT} do not fit the LAS file that writers.las would write "
            f"(LAS 1.{minor}, dataformat_id {format_id})",
            where=place,
            found=f"code {largest}",
            cure='Give writers.las "minor_version": 4 and "dataformat_id": 6 (7 with colours, 8 with near infrared)',
        )
    compressed = str(writer.get("compression", "")).lower() not in ("", "none", "false") or str(
        writer.get("filename", "")
    ).lower().endswith(".laz")
    if compressed and not pdal_env.writes_extended_classes_to_laz():
        raise OptionError(
            f"this PDAL cannot write class codes above {LEGACY_LIMIT} to LAZ 1.4: they would come out wrong",
            where=place,
            found=f"code {largest}, PDAL {'.'.join(map(str, pdal_env.version()))}",
            cure="Write .las and compress it afterwards, or use PDAL 2.3 or later",
        )


def _las_version(writer: dict[str, Any], before: list[dict[str, Any]]) -> tuple[int, int]:
    """(minor_version, dataformat_id) the writer will use: its options, the forwarded header, PDAL's defaults."""
    minor, format_id = pdal_env.las_writer_defaults()
    forward = str(writer.get("forward", ""))
    headers = [h for h in (_las_header(s) for s in before) if h is not None]
    if headers and ("all" in forward or "header" in forward or "minor_version" in forward):
        if len({h.minor for h in headers}) == 1:
            minor = headers[0].minor
        if len({h.point_format for h in headers}) == 1:
            format_id = headers[0].point_format
    return _whole(writer.get("minor_version"), minor), _whole(writer.get("dataformat_id"), format_id)


def _whole(value: Any, otherwise: int) -> int:
    """An option of PDAL's as a whole number; what is not one is left for PDAL to refuse."""
    try:
        return otherwise if value is None else int(value)
    except (TypeError, ValueError, OverflowError):
        return otherwise


def _las_header(stage: dict[str, Any]) -> LasHeader | None:
    """The header of a LAS file that a stage reads; None where it cannot be read here."""
    if stage.get("type", "") not in ("", "readers.las", "readers.copc"):
        return None
    path = Path(str(stage.get("filename", "")))
    try:
        return read_header(path) if path.is_file() else None  # a pipe or device must not be read here
    except (OSError, ValueError):
        return None
