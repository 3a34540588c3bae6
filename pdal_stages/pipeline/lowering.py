"""Our pipeline JSON to plain PDAL JSON: each stage of ours becomes a ``filters.python`` in place.

The pipeline is never split, so the LAS header, metadata, spatial reference, tags and
inputs work as PDAL makes them work.
"""

from __future__ import annotations

import copy
import difflib
import itertools
import json
import re
import shlex
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from ..base.errors import DimensionError, OptionError, PipelineError, StageError, suggest
from ..base.las import extra_dimensions, read_header
from ..stages import preparation, registry
from ..stages.base import Stage
from ..stages.points import MAKERS
from . import pdal as pdal_env
from .filenames import is_reader, reader_files
from .las_output import check_copc, check_writers, files_with_flags_to_split, flag_splitter
from .read import PipelineSource
from .runtime import TRAMPOLINE, made, place, python_filter

#: Options of every PDAL stage that a lowered stage hands on.
PDAL_OWN = ("tag", "inputs", "user_data", "log")
#: Stages after which there is one view, or several are what the user asked for.
_ONE_VIEW = {f"filters.{name}" for name in ("merge", "splitter", "chipper", "divider", "groupby", "returns")}


@dataclass
class LoweredStage:
    """One of our stages after lowering."""

    stage: Stage
    place: str  #: its type and tag, for messages
    label: str  #: the unique `module` label, under which the runtime knows it
    number: int  #: its place in the given list
    index: int  #: its place in the lowered list
    given: dict[str, Any]  #: the stage as it was written, with the options of its `option_file`
    plain: dict[str, Any]  #: the ``filters.python`` that PDAL runs


@dataclass
class Lowered:
    """A plain PDAL pipeline, which of its stages are ours, and what the user should know of it."""

    stages: list[dict[str, Any]]
    ours: list[LoweredStage] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def lower(source: PipelineSource, whole: bool = True) -> Lowered:
    """Lower a pipeline; not `whole`: to be cut into tiles, whose outputs part flags from classes themselves.

    Raises
    ------
    PipelineError, OptionError
        Where a stage type or option of ours is wrong; PDAL's own stages are left to PDAL.
    """
    stages: list[dict[str, Any]] = []
    for place_of, given in enumerate(source.stages):
        # File names stand for readers and writers; PDAL tells which, so they stay without a type.
        stages.append(copy.deepcopy(given) if isinstance(given, dict) else {"filename": given})
        _refuse_near_miss(stages[-1], source.where(place_of))
    views = _Views()
    out = Lowered([])
    run = run_by_pdal(stages)
    if len(run) < len(stages):
        places = [source.where(number) for number in range(len(stages))]
        out.warnings.append(_warning_of_ends(stages, run, places))
        stages = [stages[number] for number in run]
    check_copc(stages)
    out.warnings += unread_extra_dimensions(stages)
    has_ours = any(stage.get("type") in registry.stages() for stage in stages)
    flags = files_with_flags_to_split(stages, has_ours) if whole else []
    readers = [number for number in range(len(stages)) if is_reader(stages, number)]
    if flags and (readers[-1] >= len(readers) or any("inputs" in stage for stage in stages)):
        raise PipelineError(
            "this PDAL brings the flags (synthetic, key-point, withheld) of LAS 1.0-1.3 into other files only where all "
            "readers stand first and no stage has 'inputs'",
            found=f"PDAL {pdal_env.dotted_version()}",
            cure="Leave 'inputs' out, write one file at a time, or use PDAL 2.6",
        )
    tags = {str(s["tag"]) for s in stages if "tag" in s}
    for index, stage in enumerate(stages):
        type_name = stage.get("type", "")
        if type_name not in registry.stages():
            views.add(stage, last=0 < index == len(stages) - 1)
            out.stages.append(stage)
            if flags and index == readers[-1]:
                out.stages.append(flag_splitter(flags))
            continue
        where = source.where(run[index])
        try:
            if views.reaching(stage) > 1:  # points of several readers
                merge: dict[str, Any] = {"type": "filters.merge"}
                if "inputs" in stage:
                    merge["inputs"] = stage.pop("inputs")
                    names = (f"pdal_stages_merge_{number}" for number in itertools.count(1))
                    merge["tag"] = next(name for name in names if name not in tags)
                    tags.add(merge["tag"])
                    stage["inputs"] = [merge["tag"]]
                views.add(merge)
                out.stages.append(merge)
            taken = registry.get(type_name).from_pipeline(stage, stages[:index])
            lowered = lower_stage({**taken, **stage}, run[index], len(out.stages))
        except StageError as error:
            raise error.within(where) from None
        views.add(stage)
        out.ours.append(lowered)
        out.stages.append(lowered.plain)
    _follow_preparations(out)
    check_writers(out.stages, [(ours.stage, ours.place, ours.index) for ours in out.ours])
    return out


# ---- which stages PDAL runs ----------------------------------------------------------------------


def run_by_pdal(stages: Sequence[dict[str, Any]]) -> list[int]:
    """The numbers of the stages that lead to the first end of a pipeline; PDAL runs no others."""
    tagged: dict[str, int] = {}
    waiting: list[int] = []
    inputs: list[list[int]] = []
    for number, stage in enumerate(stages):
        named = stage.get("inputs") or []
        chosen = [named] if isinstance(named, str) else named
        if any(str(tag) not in tagged for tag in chosen):
            return list(range(len(stages)))  # for PDAL to refuse
        if is_reader(stages, number):
            inputs.append([])
            waiting = [*waiting, number]
        else:
            inputs.append([tagged[str(tag)] for tag in chosen] or waiting)
            waiting = [number]
        if "tag" in stage:
            tagged[str(stage["tag"])] = number
    taken = {one for several in inputs for one in several}
    found: set[int] = set()
    left = [next(number for number in range(len(stages)) if number not in taken)]
    while left:
        number = left.pop()
        found.add(number)
        left += [one for one in inputs[number] if one not in found]
    return sorted(found)


def _warning_of_ends(stages: Sequence[dict[str, Any]], run: Sequence[int], where: Sequence[str]) -> str:
    """The warning about stages that PDAL leaves out; an error if no writer would run at all."""
    left = [number for number in range(len(stages)) if number not in run]
    names = [" ".join(str(stages[n][key]) for key in ("type", "filename") if key in stages[n]) for n in left]
    named = ", ".join(f"{name} ({where[n]})" for n, name in list(zip(left, names, strict=True))[:5])
    what = "a pipeline with several ends: PDAL runs only what leads to the first of them"
    cure = (
        "Write one file after the other (a writer hands on what it gets, so leave its 'inputs' out), or put a last "
        'stage there that has all ends as inputs, e.g. {"type": "filters.merge", "inputs": [...]}'
    )
    writing = {n for n, stage in enumerate(stages) if str(stage.get("type", "")).startswith("writers.")}
    if writing and not writing & set(run):
        raise PipelineError(what, where=where[run[-1]], found=f"not run: {named}", cure=cure)
    return f"{what}. Not run: {named}. {cure}"


# ---- what stages read, and whether it will be there ----------------------------------------------


class Upstream(NamedTuple):
    """What the stages before one are to it."""

    preparation: list[dict[str, Any]]  #: those that made what it reads
    makes_again: bool  #: whether one makes what it makes too
    warning: str | None  #: for the user


def settle_upstream(stage: Stage, before: Sequence[tuple[Mapping[str, Any], Mapping[str, str]]]) -> Upstream:
    """Let a stage know which stages before it made what it reads.

    `before` are the stages before it in their order, as they are written, each with what :meth:`Stage.creates` says of it;
    for PDAL's own, :func:`heights_of`.
    """
    wanted = set(stage.reads()) - {"Classification"}  # which noise is marked in, too: it is no preparation
    made = [preparation.entry(given) for given, creates in before if wanted & set(creates)]
    stage.makes_again = bool({name for _, creates in before for name in creates} & set(stage.creates()))
    return Upstream(made, stage.makes_again, stage.follows(made))


def heights_of(stage: Mapping[str, Any]) -> dict[str, str]:
    """What a stage of PDAL's own makes that ours may read."""
    return {"HeightAboveGround": "double"} if stage.get("type") in preparation.OF_PDAL else {}


def _follow_preparations(lowered: Lowered) -> None:
    """Let each stage of ours know which stages before it made what it reads."""
    numbered = {ours.index: ours for ours in lowered.ours}
    before: list[tuple[Mapping[str, Any], Mapping[str, str]]] = []
    for index, plain in enumerate(lowered.stages):
        ours = numbered.get(index)
        if ours is None:
            before.append((plain, heights_of(plain)))
            continue
        upstream = settle_upstream(ours.stage, before)
        if upstream.makes_again:
            ours.plain["pdalargs"]["makes_again"] = True
        if upstream.preparation:
            ours.plain["pdalargs"]["preparation"] = upstream.preparation
        if upstream.warning is not None:
            lowered.warnings.append(upstream.warning)
        before.append(({"type": ours.stage.type, **ours.given}, ours.stage.creates()))


#: How dimensions begin that no reader has of itself, but a stage or a file's extra bytes.
_MADE = ("HeightAbove", "Ground", "Slope", "Reference")
#: Stages of PDAL that make dimensions of any name, or name them in files.
_MAKES_ANY = {f"filters.{name}" for name in ("python", "matlab", "colorization", "overlay", "hag_dem")}


_DEGREES = re.compile(
    r"^\s*EPSG:\s*4\d{3}\s*$|longlat|latlong|^\s*(OGC:)?CRS:?84|^\s*(GEOGCS|GEOGCRS|GEODCRS)", re.IGNORECASE
)


def check_dimensions(lowered: Lowered) -> None:
    """Refuse a stage that reads heights or labels that no stage makes and no input has, and one that would get degrees.

    Raises
    ------
    DimensionError, PipelineError
    """
    of_ours = {ours.index: ours.stage.creates() for ours in lowered.ours}
    for ours in lowered.ours:
        before = list(enumerate(lowered.stages[: ours.index]))
        moved = [stage for _, stage in before if stage.get("type") == "filters.reprojection"]
        if moved and _DEGREES.search(
            str(moved[-1].get("out_srs", ""))
        ):  # scripts are told the reader's reference
            raise PipelineError(
                "the points are in degrees here; neighborhoods and grids need meters",
                where=ours.place,
                found=f"filters.reprojection to {moved[-1]['out_srs']}",
                cure="Put the reprojection after the stages of pdal_stages, or reproject to a projected reference",
            )
        for name in ours.stage.reads():
            if name.startswith(_MADE) and not any(
                name in of_ours[index] if index in of_ours else _may_make(name, stage)
                for index, stage in before
            ):
                raise DimensionError(
                    f"the dimension '{name}' is missing: no stage before makes it, and no input has it",
                    where=ours.place,
                    cure=getattr(ours.stage, "hint", None) or MAKERS.get(name),
                )


def _may_make(name: str, stage: Mapping[str, Any]) -> bool:
    """Whether a stage of PDAL may make a dimension: readers of other formats than LAS may make any."""
    kind = str(stage.get("type") or "readers.")
    if kind.startswith("readers."):
        files = reader_files(dict(stage), las=True)
        named = name in str(stage.get("extra_dims", ""))
        return not files or named or any(name in extra_dimensions(path) for path in files)
    if kind in _MAKES_ANY or name in heights_of(stage):
        return True
    return any(name in str(value) for key, value in stage.items() if key not in ("type", "tag"))


def unread_extra_dimensions(stages: Sequence[dict[str, Any]]) -> list[str]:
    """A warning for each file of LAS 1.0-1.3 with extra dimensions, which PDAL reads only when told."""
    warnings = []
    for stage in stages:
        if str(stage.get("use_eb_vlr", "")).lower() == "true" or "extra_dims" in stage:
            continue
        for path in reader_files(stage, las=True):
            header, names = read_header(path), list(extra_dimensions(path))
            if header is not None and header.minor < 4 and names:
                listed = ", ".join(names[:5]) + ", ..." * (len(names) > 5)
                warnings.append(
                    f"{path}: its extra dimensions are not read: {listed}. Of LAS 1.{header.minor} PDAL reads them "
                    'where the reader has "use_eb_vlr": true'
                )
    return warnings


# ---- one stage -----------------------------------------------------------------------------------


def _refuse_near_miss(stage: dict[str, Any], where: str) -> None:
    """A mistyped type of ours would reach PDAL, whose message cannot name our stages."""
    type_name = stage.get("type", "")
    if type_name in registry.stages() or not type_name:
        return
    ours = list(registry.stages())
    # Nearer than another of PDAL's stages, such as filters.hag_nn.
    misspelt = difflib.get_close_matches(type_name, ours, n=1, cutoff=0.88)
    if misspelt or type_name.rpartition(".")[2] in {name.partition(".")[2] for name in ours}:
        raise PipelineError(
            f"there is no stage '{type_name}'", where=where, cure=suggest(type_name, ours) or None
        )


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
    made[label] = stage
    return LoweredStage(stage, named, label, number, index, given, plain)


def settled(stage: Mapping[str, Any]) -> dict[str, Any]:
    """A stage of ours with `option_file` and `where_merge` answered, which every PDAL stage has.

    Options of the pipeline go before those of the file.

    Raises
    ------
    OptionError
        If the file cannot be read, or `where_merge` asks for what cannot be.
    """
    options = dict(stage)
    if "option_file" in options:
        options = {**_option_file(options.pop("option_file")), **options}
    if "where_merge" in options:
        word = str(options.pop("where_merge")).strip().lower()
        if word not in ("auto", "true", "false"):
            raise OptionError("option 'where_merge' must be one of 'auto', 'true', 'false'", found=repr(word))
        if word == "false":
            raise OptionError(
                "option 'where_merge' cannot be false here: points outside 'where' stay beside the others, as neighbors",
                cure='Leave it out, and tell the points apart afterwards, e.g. with {"type": "filters.expression"}',
            )
    return options


def _option_file(path: Any) -> dict[str, Any]:
    """An option file as PDAL has them: a JSON object, or words ``--name=value``."""
    try:
        text = Path(path).read_text(encoding="utf-8-sig").strip()
        if not text:
            raise ValueError("it is empty")
        found = json.loads(text) if text.startswith("{") else _words(shlex.split(text))
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise OptionError("the option file cannot be read", found=f"{str(path)[:200]!r}: {error}") from None
    if wired := {"type", "tag", "inputs"} & set(found):
        raise OptionError(
            "an option file sets options, not how stages are joined",
            found=f"{path}: {', '.join(sorted(wired))}",
        )
    return found


def _words(words: list[str]) -> dict[str, str]:
    found, waiting = {}, iter(words)
    for word in waiting:
        name, equals, value = word.partition("=")
        if not name.startswith("--"):
            raise ValueError(f"'{word}' does not begin with --name")
        if not (value := value if equals else next(waiting, "")):
            raise ValueError(f"'{word}' has no value")
        found[name[2:]] = value
    return found


class _Views:
    """Follows PDAL's wiring to see where points of several readers are still apart."""

    def __init__(self) -> None:
        self._waiting: list[int] = []  # views of stages not yet taken as an input
        self._tagged: dict[str, int] = {}

    def reaching(self, stage: dict[str, Any]) -> int:
        """How many views reach a stage."""
        names = stage.get("inputs")
        if names is None:
            return sum(self._waiting)
        names = [names] if isinstance(names, str) else names
        return sum(self._tagged.get(str(n), 1) for n in names)

    def add(self, stage: dict[str, Any], last: bool = False) -> None:
        type_name = str(stage.get("type", ""))
        filename = str(stage.get("filename", ""))
        # A bare file name is read, unless it is the last stage of several: then it is written.
        reader = type_name.startswith("readers.") or (not type_name and not last)
        if reader:
            count = 2 if any(c in filename for c in "*?[") else 1
        else:
            # One cloud, or pieces the user asked for, are one.
            count = 1 if type_name in _ONE_VIEW else self.reaching(stage)
            if "inputs" not in stage:
                self._waiting = []
        self._waiting.append(count)
        if "tag" in stage:
            self._tagged[str(stage["tag"])] = count
