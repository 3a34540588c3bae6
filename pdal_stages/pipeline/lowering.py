"""Our pipeline JSON to plain PDAL JSON: each stage of ours becomes a ``filters.python`` in place.

The pipeline is never split, so the LAS header, metadata, spatial reference, tags and
inputs work as PDAL makes them work.
"""

from __future__ import annotations

import copy
import difflib
import itertools
import uuid
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from ..base.errors import PipelineError, StageError, suggest
from ..stages import preparation, registry
from ..stages.base import Stage
from . import classflags, extradims, wiring
from .optionfile import settled
from .read import PipelineSource
from .runtime import TRAMPOLINE, made, place, python_filter
from .writerlimits import check_copc, check_vectors, check_writers

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

    @property
    def meanings(self) -> dict[str, str]:
        """What LAS files say of the dimensions that stages of ours make; of what several change, the last one's word."""
        return {name: text for ours in self.ours for name, text in ours.stage.meanings().items()}


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
    run = wiring.run_by_pdal(stages)
    if len(run) < len(stages):
        places = [source.where(number) for number in range(len(stages))]
        out.warnings.append(wiring.warning_of_ends(stages, run, places))
        stages = [stages[number] for number in run]
    check_copc(stages)
    check_vectors(stages)
    tags = {str(s["tag"]) for s in stages if "tag" in s}
    numbered: Iterable[tuple[dict[str, Any], int | None]] = zip(stages, itertools.count(), strict=False)
    for stage, index in classflags.wired(stages) if whole else numbered:
        type_name = stage.get("type", "")
        if index is None or type_name not in registry.stages():
            views.add(stage, last=index is not None and 0 < index == len(stages) - 1)
            out.stages.append(stage)
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
    out.stages = extradims.settle(out.stages)
    _follow_preparations(out)
    check_writers(out.stages, [(ours.stage, ours.place, ours.index) for ours in out.ours])
    return out


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
