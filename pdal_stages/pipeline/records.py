"""What outputs say of themselves beside points: of extra dimensions, and of the reference system, as their inputs did."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..base.extrabytes import describe, descriptions
from ..base.projection import Projection, projection_of, put_back
from .filenames import LAS_WRITERS, readers_files
from .references import MOVING

#: Options of readers and writers that say another reference.
_SAY = ("a_srs", "override_srs", "default_srs", "spatialreference", "out_srs", "srs_vlr_order")


def keep_records(
    made: Path, writer: dict[str, Any], stages: Sequence[dict[str, Any]], meanings: Mapping[str, str]
) -> None:
    """Put meanings of extra dimensions into a LAS file that was written; with `forward`, what inputs say of theirs too.

    With `forward` it also gets the records of its inputs' reference system, if all inputs have the same. Not where a stage
    may have changed the reference system, and not in COPC, whose records have places of their own.
    """
    if made.suffix.lower() not in (".las", ".laz"):
        return
    forward = str(writer.get("forward", ""))
    forwards = "all" in forward or "vlr" in forward
    files = readers_files(list(stages), las=True) if forwards else []
    texts = {name: text for file in reversed(files) for name, text in descriptions(file).items()}
    describe(made, texts | {name: text.encode() for name, text in meanings.items()})
    if not forwards or writer.get("type") != LAS_WRITERS[0]:
        return
    if any(stage.get("type") in MOVING or any(option in stage for option in _SAY) for stage in stages):
        return
    wanted = _of_inputs(stages)
    if wanted is not None:
        put_back(made, wanted)


def _of_inputs(stages: Sequence[dict[str, Any]]) -> Projection | None:
    files = readers_files(list(stages), las=True)
    if len(files) != len(readers_files(list(stages))):
        return None  # others have no records
    first = projection_of(files[0]) if files else None
    return first if first is not None and all(projection_of(name) == first for name in files[1:]) else None
