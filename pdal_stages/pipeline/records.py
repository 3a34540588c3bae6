"""Outputs get the records of their inputs' reference system back, where nothing changed it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..base.projection import Projection, projection_of, put_back
from .filenames import LAS_WRITERS, is_writer, readers_files
from .references import MOVING

#: Options of readers and writers that say another reference.
_SAY = ("a_srs", "override_srs", "default_srs", "spatialreference", "out_srs", "srs_vlr_order")


def keep_records(made: Path, writer: dict[str, Any], stages: Sequence[dict[str, Any]]) -> None:
    """Put the inputs' records into a file that a LAS writer wrote with `forward`, if all inputs have the same.

    Not where a stage may have changed the reference system, and not in COPC, whose records have places of their own.
    """
    forward = str(writer.get("forward", ""))
    if writer.get("type") != LAS_WRITERS[0] or not ("all" in forward or "vlr" in forward):
        return
    if made.suffix.lower() not in (".las", ".laz") or any(
        stage.get("type") in MOVING or any(option in stage for option in _SAY) for stage in stages
    ):
        return
    wanted = _of_inputs(list(stages))
    if wanted is not None:
        put_back(made, wanted)


def _of_inputs(stages: list[dict[str, Any]]) -> Projection | None:
    reading = [stage for stage in stages if not is_writer(stage, stages)]
    files = readers_files(reading, las=True)
    if len(files) != len(readers_files(reading)):
        return None  # others have no records
    first = projection_of(files[0]) if files else None
    return first if first is not None and all(projection_of(name) == first for name in files[1:]) else None
