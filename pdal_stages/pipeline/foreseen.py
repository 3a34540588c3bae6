"""What a pipeline will lack or lose, known before points are read."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from ..base.errors import DimensionError, PipelineError
from ..base.extrabytes import extra_dimensions, passed_over
from ..base.las import read_header
from ..stages import preparation
from ..stages.points import MAKERS
from . import classflags
from .filenames import reader_files
from .lowering import Lowered, LoweredStage

#: How dimensions begin that no reader has of itself, but a stage or a file's extra bytes.
_MADE = ("HeightAbove", "Ground", "Slope", "Reference")
#: Stages that make dimensions of any name, or say so in options.
_MAKES_ANY = {f"filters.{name}" for name in ("python", "matlab", "colorization", "overlay", "hag_dem")}
_DEGREES = re.compile(
    r"^\s*EPSG:\s*4\d{3}\s*$|longlat|latlong|^\s*(OGC:)?CRS:?84|^\s*(GEOGCS|GEOGCRS|GEODCRS)", re.IGNORECASE
)


def check_dimensions(lowered: Lowered) -> None:
    """Refuse a stage whose heights or labels nobody makes, and one that would get degrees.

    Raises
    ------
    DimensionError, PipelineError
    """
    for ours in lowered.ours:
        before = lowered.stages[: ours.index]
        moved = [s for s in before if s.get("type") == "filters.reprojection"]
        if moved and _DEGREES.search(str(moved[-1].get("out_srs", ""))):
            raise PipelineError(
                "the points are in degrees here; neighborhoods and grids need meters",
                where=ours.place,
                found=f"filters.reprojection to {moved[-1]['out_srs']}",
                cure="Put the reprojection after the stages of pdal_stages, or reproject to a projected reference",
            )
        wanted = [name for name in ours.stage.reads() if name.startswith(_MADE)]
        missing = [name for name in wanted if not _may_be_there(name, ours, lowered)]
        if missing:
            raise DimensionError(
                f"the dimension '{missing[0]}' is missing: no stage before makes it, and no input has it",
                where=ours.place,
                cure=getattr(ours.stage, "hint", None) or MAKERS.get(missing[0]),
            )


def _may_be_there(name: str, ours: LoweredStage, lowered: Lowered) -> bool:
    if any(name in one.stage.creates() for one in lowered.ours if one.index < ours.index):
        return True
    made_by_ours = {one.index for one in lowered.ours}
    for index, stage in enumerate(lowered.stages[: ours.index]):
        kind = str(stage.get("type") or "readers.")
        if index in made_by_ours or classflags.is_ours(stage):
            continue
        if kind.startswith("readers."):
            if _reader_may_have(name, stage):
                return True
        elif kind in _MAKES_ANY or (kind in preparation.OF_PDAL and name == "HeightAboveGround"):
            return True
        elif any(name in str(value) for key, value in stage.items() if key not in ("type", "tag")):
            return True  # filters.ferry, filters.assign
    return False


def _reader_may_have(name: str, stage: dict[str, Any]) -> bool:
    """Whether a reader may give a dimension: other formats may have any."""
    files = reader_files(stage, las=True)
    if not files:
        return True
    return name in str(stage.get("extra_dims", "")) or any(name in extra_dimensions(path) for path in files)


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:5]) + ", ..." * (len(names) > 5)


def unread_extra_dimensions(stages: Sequence[dict[str, Any]]) -> list[str]:
    """A warning for each LAS file with extra dimensions that PDAL does not read: of LAS 1.0-1.3 unless told."""
    warnings = []
    for stage in stages:
        for path in reader_files(stage, las=True):
            if names := passed_over(path):
                warnings.append(
                    f"{path}: extra dimensions that it describes in a second record are not read, and not written: "
                    f"{_some(names)}. PDAL reads the first record alone"
                )
        if str(stage.get("use_eb_vlr", "")).lower() == "true" or "extra_dims" in stage:
            continue
        for path in reader_files(stage, las=True):
            header, names = read_header(path), list(extra_dimensions(path))
            if header is not None and header.minor < 4 and names:
                warnings.append(
                    f"{path}: its extra dimensions are not read: {_some(names)}. Of LAS "
                    f'1.{header.minor} PDAL reads them where the reader has "use_eb_vlr": true'
                )
    return warnings
