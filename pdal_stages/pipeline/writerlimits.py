"""What LAS writers can hold of our stages' results: class codes and numbers of dimensions, said before any work."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from typing import Any

from ..base.asprs import LEGACY_LIMIT
from ..base.errors import DimensionError, OptionError, PipelineError
from ..base.las import LasHeader, read_header
from ..stages.base import CodeLimit, Stage
from . import pdal as pdal_env
from .filenames import reader_files, writes_las

#: A variable-length record of LAS holds 65,535 bytes; an extra dimension's description takes 192.
_MOST_EXTRA = 65_535 // 192


def check_writers(stages: list[dict[str, Any]], ours: list[tuple[Stage, str, int]]) -> None:
    """Class codes must fit the LAS files written later, and extra dimensions one LAS record.

    `ours` are our stages in the lowered pipeline, what messages call them, and where they are.

    Raises
    ------
    OptionError, DimensionError
        Naming the stage.
    """
    for stage, place, index in ours:
        largest, extra = stage.largest_class(), len(stage.creates())
        for writer in stages[index + 1 :]:
            if not writes_las(writer):
                continue
            limit = _code_limit(writer, stages[:index])
            if limit is not None:
                stage.code_limit = limit
                if largest > limit.largest:
                    raise OptionError(limit.what, where=place, found=f"code {largest}", cure=limit.cure)
            if extra > _MOST_EXTRA and str(writer.get("extra_dims", "")).strip() == "all":
                raise DimensionError(
                    f"LAS cannot hold so many extra dimensions: one record describes {_MOST_EXTRA} of them",
                    where=place,
                    found=f"{extra} features",
                    cure="Take fewer neighborhoods or features, write to a format without the limit (writers.text, "
                    "writers.tiledb), or use writers.classifiermodel and filters.modelclassifier, which need no "
                    "dimensions",
                )


def check_copc(stages: list[dict[str, Any]]) -> None:
    """Refuse a plain LAZ file under the name of a COPC file."""
    for stage in stages:
        name, kind = str(stage.get("filename", "")), stage.get("type", "")
        last = stage is stages[-1] and len(stages) > 1
        if not name.lower().endswith(".copc.laz") or not (kind == "writers.las" or (last and not kind)):
            continue
        if not pdal_env.writes_copc():
            raise PipelineError(
                f"PDAL {pdal_env.dotted_version()} cannot write COPC",
                found=name,
                cure="Name the output .laz, or use PDAL 2.4 or later",
            )
        if kind:
            raise PipelineError(
                "writers.las writes plain LAZ, not COPC", found=name, cure='Use "type": "writers.copc"'
            )


#: Drivers that number features themselves: PDAL before 2.5 gives them the same feature again.
_NUMBERED = ("gpkg", "sqlite")


def check_vectors(stages: list[dict[str, Any]]) -> None:
    """Refuse vector formats that an old PDAL can write no second point to, which it says at the end of its work."""
    for stage in stages:
        name = str(stage.get("filename", ""))
        # Without a driver an old PDAL makes a folder of Shapefiles, whatever the name.
        driver = str(stage.get("ogrdriver", "")) or name.rpartition(".")[2]
        if stage.get("type") != "writers.ogr" or driver.lower() not in _NUMBERED:
            continue
        if not pdal_env.writes_numbered_features():
            raise PipelineError(
                f"PDAL {pdal_env.dotted_version()} cannot write points as {driver}: it gives all of them one number",
                where="writers.ogr",
                found=name,
                cure="Write a Shapefile or GeoJSON and convert it with ogr2ogr, or use PDAL 2.5 or later",
            )


def _code_limit(writer: dict[str, Any], before: list[dict[str, Any]]) -> CodeLimit | None:
    """The largest class code that a LAS writer can hold; None where that is any."""
    if writer.get("type") == "writers.copc":
        return None
    minor, format_id = las_version(writer, before)
    if format_id <= 5:
        return CodeLimit(
            LEGACY_LIMIT,
            f"class codes above {LEGACY_LIMIT} do not fit the LAS file that writers.las would write "
            f"(LAS 1.{minor}, dataformat_id {format_id})",
            'Give writers.las "minor_version": 4 and "dataformat_id": 6 (7 with colors, 8 with near infrared)',
        )
    return None


def compresses(writer: dict[str, Any]) -> bool:
    """Whether a writer of LAS writes LAZ."""
    named = str(writer.get("filename", "")).lower().endswith(".laz")
    return named or str(writer.get("compression", "")).lower() not in ("", "none", "false")


def las_version(writer: dict[str, Any], before: Iterable[dict[str, Any]]) -> tuple[int, int]:
    """(minor_version, dataformat_id) the writer will use: its options, the forwarded header, PDAL's defaults."""
    minor, format_id = _whole(writer.get("minor_version")), _whole(writer.get("dataformat_id"))
    forward = str(writer.get("forward", ""))
    headers = las_headers(before)
    if headers and ("all" in forward or "header" in forward or "minor_version" in forward):
        if minor is None and len({h.minor for h in headers}) == 1:
            minor = headers[0].minor
        if format_id is None and len({h.point_format for h in headers}) == 1:
            format_id = headers[0].point_format
    if minor is None or format_id is None:  # PDAL is asked only then: it is another process
        defaults = pdal_env.las_writer_defaults()
        minor = defaults[0] if minor is None else minor
        format_id = defaults[1] if format_id is None else format_id
    return minor, format_id


def _whole(value: Any) -> int | None:
    """An option of PDAL's as a whole number; what is not one is left for PDAL to refuse."""
    try:
        return None if value is None else int(value)
    except (TypeError, ValueError, OverflowError):
        return None


def las_headers(readers: Iterable[dict[str, Any]]) -> list[LasHeader]:
    """Headers of the LAS files that stages read, as far as they can be read here."""
    found = []
    for path in [name for stage in readers for name in reader_files(stage, las=True)]:
        with contextlib.suppress(OSError, ValueError):
            found.append(read_header(path))
    return [header for header in found if header is not None]
