"""Our pipeline JSON to plain PDAL JSON: each stage of ours becomes a ``filters.python`` in place.

The pipeline is never split, so the LAS header, metadata, spatial reference, tags and
inputs work as PDAL makes them work.
"""

from __future__ import annotations

import copy
import uuid
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..base.asprs import LEGACY_LIMIT
from ..base.errors import DimensionError, OptionError, PipelineError, StageError, suggest
from ..base.las import LasHeader, read_header
from ..stages import preparation, registry
from ..stages.base import Stage
from .optionfile import settled
from .read import PipelineSource
from .runtime import TRAMPOLINE, known, place, python_filter

#: Options of every PDAL stage that a lowered stage hands on.
PDAL_OWN = ("tag", "inputs", "user_data", "log")
#: Stages after which several views are what the user asked for.
_SPLITTERS = {"filters.splitter", "filters.chipper", "filters.divider", "filters.groupby", "filters.returns"}
_LAS_WRITERS = ("writers.las", "writers.copc")
#: A variable-length record of LAS holds 65,535 bytes; an extra dimension's description takes 192.
_MOST_EXTRA = 65_535 // 192


@dataclass
class LoweredStage:
    """One of our stages after lowering.

    Attributes
    ----------
    stage : Stage
    place : str
        Its type and tag, for messages.
    label : str
        The unique `module` label, under which the runtime knows it.
    number, index : int
        Place in the given and in the lowered list.
    given : dict
        The stage as it was written, with the options of its `option_file`.
    plain : dict
        The ``filters.python`` that PDAL runs.
    """

    stage: Stage
    place: str
    label: str
    number: int
    index: int
    given: dict[str, Any]
    plain: dict[str, Any]


@dataclass
class Lowered:
    """A plain PDAL pipeline, which of its stages are ours, and what the user should know of it."""

    stages: list[dict[str, Any]]
    ours: list[LoweredStage] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)

    @property
    def halo(self) -> float:
        """Metres of neighboring points a tile needs for all of our stages, one after the other."""
        return sum(ours.stage.halo() for ours in self.ours)


def lower(source: PipelineSource) -> Lowered:
    """Lower a pipeline.

    Raises
    ------
    PipelineError, OptionError
        Where a stage type or option of ours is wrong; PDAL's own stages are left to PDAL.
    """
    stages: list[dict[str, Any]] = []
    for index, given in enumerate(source.stages):
        stages.append(_as_object(given))
        _refuse_near_miss(stages[-1], source.where(index))
    views = _Views()
    out = Lowered([])
    tags = {str(s["tag"]) for s in stages if "tag" in s}
    for index, stage in enumerate(stages):
        type_name = stage.get("type", "")
        where = source.where(index)
        if type_name not in registry.stages():
            views.add(stage, last=0 < index == len(stages) - 1)
            out.stages.append(stage)
            continue
        try:
            if views.unmerged(stage):
                merge: dict[str, Any] = {"type": "filters.merge"}
                if "inputs" in stage:
                    merge["inputs"] = stage.pop("inputs")
                    merge["tag"] = _fresh_tag(tags)
                    stage["inputs"] = [merge["tag"]]
                views.add(merge)
                out.stages.append(merge)
            taken = registry.get(type_name).from_pipeline(stage, stages[:index])
            lowered = lower_stage({**taken, **stage}, index, len(out.stages))
        except StageError as error:
            raise error.within(where) from None
        views.add(stage)
        out.ours.append(lowered)
        out.stages.append(lowered.plain)
    _tell_preparations(out)
    _check_writers(out)
    return out


def _tell_preparations(lowered: Lowered) -> None:
    """Each stage of ours hears which stages before it made what it reads."""
    for ours in lowered.ours:
        wanted = set(ours.stage.reads())
        makers = {one.index: one for one in lowered.ours if wanted & set(one.stage.creates())}
        made = []
        for index, stage in enumerate(lowered.stages[: ours.index]):
            if index in makers:
                made.append(preparation.entry({"type": makers[index].stage.type, **makers[index].given}))
            elif "HeightAboveGround" in wanted and stage.get("type") in preparation.OF_PDAL:
                made.append(preparation.entry(stage))
        if made:
            ours.plain["pdalargs"]["preparation"] = made
        if (remark := ours.stage.follows(made)) is not None:
            lowered.remarks.append(remark)


def _as_object(given: Any) -> dict[str, Any]:
    """File names stand for readers and writers; PDAL tells which, so they stay without a type."""
    if isinstance(given, dict):
        return copy.deepcopy(given)
    return {"filename": given}


def _refuse_near_miss(stage: dict[str, Any], where: str) -> None:
    """A mistyped type of ours would reach PDAL, whose message cannot name our stages."""
    type_name = stage.get("type", "")
    if type_name in registry.stages() or not type_name:
        return
    near = suggest(type_name, registry.stages())
    ours = {name.partition(".")[2] for name in registry.stages()}
    word = type_name.rpartition(".")[2]
    if word in ours or (near and _distance_is_typo(type_name)):
        raise PipelineError(f"there is no stage '{type_name}'", where=where, cure=near or None)


def _distance_is_typo(type_name: str) -> bool:
    """Whether a type is a misspelling of one of ours, not another PDAL stage such as filters.hag_nn."""
    import difflib

    close = difflib.get_close_matches(type_name, list(registry.stages()), n=1, cutoff=0.88)
    return bool(close)


def lower_stage(given: dict[str, Any], number: int = 0, index: int = 0) -> LoweredStage:
    """One stage of ours, checked, and the ``filters.python`` that stands for it."""
    kind = registry.get(given["type"])
    named = place(kind.type, given.get("tag"))
    try:
        given = settled(given)
    except StageError as error:
        raise error.within(named) from None
    options = {k: v for k, v in given.items() if k not in ("type", *PDAL_OWN)}
    stage = kind(options, named)
    label = f"pdal_stages_{kind.type.replace('.', '_')}_{uuid.uuid4().hex[:12]}"
    arguments = {"stage": kind.type, "label": label, "options": options}
    if given.get("tag"):
        arguments["tag"] = given["tag"]
    plain = python_filter(label, TRAMPOLINE, arguments, stage.creates())
    plain.update({key: given[key] for key in PDAL_OWN if key in given})
    known(label, stage)
    return LoweredStage(stage, named, label, number, index, given, plain)


def _fresh_tag(tags: set[str]) -> str:
    number = 1
    while f"pdal_stages_merge_{number}" in tags:
        number += 1
    tags.add(f"pdal_stages_merge_{number}")
    return f"pdal_stages_merge_{number}"


class _Views:
    """Follows PDAL's wiring to see where points of several readers are still apart."""

    def __init__(self) -> None:
        self._waiting: list[int] = []  # views of stages not yet taken as an input
        self._tagged: dict[str, int] = {}

    def _inputs(self, stage: dict[str, Any]) -> int:
        names = stage.get("inputs")
        if names is None:
            return sum(self._waiting)
        names = [names] if isinstance(names, str) else names
        return sum(self._tagged.get(str(n), 1) for n in names)

    def unmerged(self, stage: dict[str, Any]) -> bool:
        """Whether views of more than one reader would reach the stage."""
        return self._inputs(stage) > 1

    def add(self, stage: dict[str, Any], last: bool = False) -> None:
        type_name = str(stage.get("type", ""))
        filename = str(stage.get("filename", ""))
        # A bare file name is read, unless it is the last stage of several: then it is written.
        reader = type_name.startswith("readers.") or (not type_name and not last)
        if reader:
            count = 2 if any(c in filename for c in "*?[") else 1
            self._waiting.append(count)
        else:
            count = self._inputs(stage)
            if type_name == "filters.merge" or type_name in _SPLITTERS:
                count = 1  # one cloud, or pieces the user asked for
            if "inputs" not in stage:
                self._waiting = []
            self._waiting.append(count)
        if "tag" in stage:
            self._tagged[str(stage["tag"])] = count


def _check_writers(lowered: Lowered) -> None:
    """Class codes must fit the LAS files written later, and extra dimensions one LAS record."""
    for ours in lowered.ours:
        largest, extra = ours.stage.largest_class(), len(ours.stage.creates())
        for writer in lowered.stages[ours.index + 1 :]:
            if not _writes_las(writer):
                continue
            if largest > LEGACY_LIMIT:
                _check_codes(ours, largest, writer, lowered.stages[: ours.index])
            if extra > _MOST_EXTRA and str(writer.get("extra_dims", "")).strip() == "all":
                raise DimensionError(
                    f"LAS cannot hold so many extra dimensions: one record describes {_MOST_EXTRA} of them",
                    where=ours.place,
                    found=f"{extra} features",
                    cure="Take fewer neighborhoods or features, write to a format without the limit (writers.text, "
                    "writers.tiledb), or use writers.classifiermodel and filters.modelclassifier, which need no "
                    "dimensions",
                )


def _writes_las(stage: dict[str, Any]) -> bool:
    type_name = stage.get("type", "")
    suffix = Path(str(stage.get("filename", ""))).suffix.lower()
    return type_name in _LAS_WRITERS or (not type_name and suffix in (".las", ".laz"))


def _check_codes(
    ours: LoweredStage, largest: int, writer: dict[str, Any], before: list[dict[str, Any]]
) -> None:
    from . import pdal as pdal_env

    if writer.get("type") == "writers.copc":
        return
    minor, format_id = _las_version(writer, before)
    if format_id <= 5:
        raise OptionError(
            f"class codes above {LEGACY_LIMIT} do not fit the LAS file that writers.las would write "
            f"(LAS 1.{minor}, dataformat_id {format_id})",
            where=ours.place,
            found=f"code {largest}",
            cure='Give writers.las "minor_version": 4 and "dataformat_id": 6 (7 with colours, 8 with near infrared)',
        )
    compressed = str(writer.get("compression", "")).lower() not in ("", "none", "false") or str(
        writer.get("filename", "")
    ).lower().endswith(".laz")
    if compressed and not pdal_env.writes_extended_classes_to_laz():
        raise OptionError(
            f"this PDAL cannot write class codes above {LEGACY_LIMIT} to LAZ 1.4: they would come out wrong",
            where=ours.place,
            found=f"code {largest}, PDAL {'.'.join(map(str, pdal_env.version()))}",
            cure="Write .las and compress it afterwards, or use PDAL 2.3 or later",
        )


def _las_version(writer: dict[str, Any], before: list[dict[str, Any]]) -> tuple[int, int]:
    """(minor_version, dataformat_id) the writer will use: its options, the forwarded header, PDAL's defaults."""
    from . import pdal as pdal_env

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
    """An option of PDAL's as a whole number; what is none is left for PDAL to refuse."""
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
