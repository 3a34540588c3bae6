"""Expand our pipeline JSON to plain PDAL JSON: stages of ours become ``filters.python`` in place.

The pipeline is never split, so the LAS header, metadata, spatial reference, tags and
inputs work as in PDAL.
"""

from __future__ import annotations

import copy
import itertools
import uuid
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from ..base.dimensions import known
from ..base.errors import DimensionError, PipelineError, StageError
from ..base.json_types import StageJson
from ..base.las_points import Layout, layout_there
from ..base.messages import Message, count_of
from ..classifier.model_file import find
from ..features.registry import BY_NAME
from ..stages import preprocessing
from ..stages.base import Stage
from ..stages.points import MAKERS
from ..stages.registry import PDAL_OWN, stage_from, stage_type, stage_types
from .inputs_outputs import is_reader, readers_files
from .json_source import PipelineSource
from .pdal_facts import check_class_codes, check_copc_outputs
from .runtime import BY_LABEL, TRAMPOLINE, ExpandedStage, python_filter
from .spatial_reference import fault_of_reference

#: Stages after which several views are what the user asked for.
SPLITS = {
    f"filters.{name}"
    for name in ("splitter", "chipper", "divider", "groupby", "returns", "separatescanline")
}


@dataclass
class Expanded:
    """A plain PDAL pipeline, those of its stages that are ours, and warnings for the user."""

    stages: list[StageJson]
    ours: list[ExpandedStage] = field(default_factory=list)
    warnings: list[Message] = field(default_factory=list)


def expand(
    source: PipelineSource, ready: Sequence[ExpandedStage] = (), copied: bool = False
) -> Expanded:
    """Expand a pipeline.

    `ready` are its stages of ours, in order, where an earlier pipeline with the same stages has
    made them. `copied`: its output is a copy of the input, without PDAL.
    """
    stages = copy.deepcopy(source.stages)
    places = [source.where(number) for number in range(len(stages))]
    _refuse_several_ends(stages, places)
    check_copc_outputs(stages)
    out = Expanded([])
    readers = [number for number, stage in enumerate(stages) if is_reader(stage)]
    names = [str(stages[number].get("filename", "")) for number in readers]
    several = len(readers) > 1 or any(c in name for name in names for c in "*?[")
    for index, stage in enumerate(stages):
        if stage["type"] not in stage_types():
            out.stages.append(stage)
            continue
        try:
            if _may_be_apart(stages, index, several):
                merge: StageJson = {"type": "filters.merge"}
                if "inputs" in stage:
                    merge |= {"inputs": stage["inputs"], "tag": f"pdal_stages_merge_{index}"}
                    stage["inputs"] = [merge["tag"]]
                out.stages.append(merge)
            if ready:
                known = ready[len(out.ours)]
                expanded = expand_stage(stage, index, len(out.stages), known.stage)
                expanded.context = known.context
            else:
                derived = stage_type(stage["type"]).from_pipeline(stage, stages[:index])
                expanded = expand_stage({**derived, **stage}, index, len(out.stages))
        except StageError as error:
            raise error.prefixed(places[index]) from None
        out.ours.append(expanded)
        out.stages.append(expanded.plain)
    if not ready:
        _place_upstream(out)
    check_class_codes(out.stages, out.ours, copied)
    return out


# ---- how PDAL wires stages -----------------------------------------------------------------------


def _may_be_apart(stages: Sequence[StageJson], number: int, several: bool) -> bool:
    """Return whether points may reach a stage in several views, and nobody wants them apart.

    The plugin, which sees PDAL's stages instead of JSON, decides by `viewsOf` of ``stage.cpp``.
    `several`: there are several input files. A stage that makes one thing of all points never wants
    them apart; filters.crop splits, too, where it has several areas.
    """
    kinds = [stage["type"] for stage in stages[:number]]
    split = not SPLITS.isdisjoint(kinds)
    gathers = stage_type(stages[number]["type"]).needs_all_points()
    if gathers and (split or "filters.crop" in kinds):
        return kinds[-1] != "filters.merge"
    joined = "inputs" not in stages[number] and {*kinds[-1:]} <= {"filters.merge", *stage_types()}
    return several and not split and not joined


def _refuse_several_ends(stages: Sequence[StageJson], where: Sequence[str]) -> None:
    """Refuse several ends: PDAL runs only what leads to the first, and says nothing of others."""
    tagged: dict[str, int] = {}
    waiting: list[int] = []  # stages that the next one takes points from
    used: set[int] = set()
    for number, stage in enumerate(stages):
        named = stage.get("inputs") or []
        tags = [str(tag) for tag in ([named] if isinstance(named, str) else named)]
        if any(tag not in tagged for tag in tags):  # which PDAL refuses
            return
        reads = is_reader(stage)
        used.update([] if reads else [tagged[tag] for tag in tags] or waiting)
        waiting = [*(waiting if reads else []), number]
        if "tag" in stage:
            tagged[str(stage["tag"])] = number
    ends = [number for number in range(len(stages)) if number not in used]
    if len(ends) > 1:
        named_ends = (
            f"{stages[n]['type']} {stages[n].get('filename', '')}".strip() + f" ({where[n]})"
            for n in ends
        )
        raise PipelineError(
            "the pipeline has several ends, and PDAL runs only what leads to the first of them",
            found=", ".join(itertools.islice(named_ends, 5)),
            cure="Write one file after the other (a writer passes its points on, so leave its "
            "'inputs' out), or add a last stage that takes all ends as inputs, e.g. "
            '{"type": "filters.merge", "inputs": [...]}',
        )


# ---- the dimensions that stages read, and whether they will exist --------------------------------


def settle_upstream(
    stage: Stage, before: Sequence[tuple[StageJson, Mapping[str, str]]]
) -> tuple[Stage, bool]:
    """Return a stage placed after those that created what it reads.

    The second value tells whether any of them created what it creates, too. `before` are the
    earlier stages in order, as written, each with the dimensions it creates:
    :meth:`Stage.creates`, or :func:`heights_of` for PDAL's own.
    """
    # Noise is marked in `Classification`, too: it is no preprocessing.
    wanted = set(stage.reads()) - {"Classification"}
    ground = preprocessing.GROUND_OF_PDAL if "HeightAboveGround" in wanted else ()
    makers = [
        preprocessing.entry(plain)
        for plain, creates in before
        if wanted & set(creates) or plain.get("type") in ground
    ]
    created_before = any(set(creates) & set(stage.creates()) for _, creates in before)
    return stage.after(makers), created_before


def heights_of(stage: StageJson) -> dict[str, str]:
    """Return the dimensions that a PDAL stage creates and ours may read: name -> PDAL type."""
    makes = stage.get("type") in preprocessing.HEIGHTS_OF_PDAL
    return {"HeightAboveGround": "double"} if makes else {}


def _place_upstream(expanded: Expanded) -> None:
    """Place each of our stages after the earlier ones that created what it reads."""
    numbered = {ours.index: ours for ours in expanded.ours}
    before: list[tuple[StageJson, Mapping[str, str]]] = []
    for index, plain in enumerate(expanded.stages):
        if (ours := numbered.get(index)) is None:
            before.append((plain, heights_of(plain)))
            continue
        ours.stage, created_before = settle_upstream(ours.stage, before)
        if created_before:
            ours.update_context(created_before=True)
            plain["pdalargs"]["created_before"] = True
        if ours.stage.upstream:
            plain["pdalargs"]["preparation"] = list(ours.stage.upstream)
        if (warning := ours.stage.check_upstream()) is not None:
            expanded.warnings.append(Message(warning))
        before.append((ours.as_written, ours.stage.creates()))


#: Stages of PDAL that may create dimensions of any name.
_CREATES_ANY = {
    f"filters.{name}" for name in ("python", "matlab", "colorization", "overlay", "hag_dem")
}


def check_dimensions(expanded: Expanded) -> None:
    """Refuse stages that read heights or labels that nothing provides, or would get degrees."""
    of_ours = {ours.index: ours.stage.creates() for ours in expanded.ours}
    for ours in expanded.ours:
        before = list(enumerate(expanded.stages[: ours.index]))
        # Scripts only get the reader's reference
        moved = [s.get("out_srs", "") for _, s in before if s["type"] == "filters.reprojection"]
        if moved and (fault := fault_of_reference(str(moved[-1]))):
            raise PipelineError(
                fault,
                where=ours.stage.place,
                found=f"filters.reprojection to {moved[-1]}",
                cure="Put the reprojection after the stages of pdal_stages, or reproject to a "
                "projected reference",
            )
        for name in ours.stage.reads():
            if _is_created(name) and not _may_be_made(name, before, of_ours):
                raise DimensionError(
                    f"the dimension '{name}' is missing: no stage before creates it, and no input "
                    "has it",
                    where=ours.stage.place,
                    cure=ours.stage.hint or MAKERS.get(name),
                )


#: Dimensions that LAS 1.4 added, in lower case: points of earlier files without them have 0 there.
_ZERO_WHERE_ABSENT = ("overlap", "scanchannel", "classflags")


def check_shared_dimensions(
    expanded: Expanded, layouts: Mapping[str, Layout], last: Stage | None = None
) -> None:
    """Refuse files, by path, that lack a dimension which a stage reads, where others have it.

    Points of several files together would have 0 there. `last` is a stage after all of the
    pipeline.
    """
    of_ours = {ours.index: ours.stage.creates() for ours in expanded.ours}
    with_points = {
        path: {*map(str.lower, layout.fields)}
        for path, layout in layouts.items()
        if layout.header.count
    }
    readings = [(ours.index, ours.stage) for ours in expanded.ours]
    readings += [(len(expanded.stages), last)] if last else []
    for index, stage in readings:
        before = [(n, s) for n, s in enumerate(expanded.stages[:index]) if not is_reader(s)]
        for name in (*stage.reads(), *stage.optional_reads()):
            lacking = [path for path, names in with_points.items() if name.lower() not in names]
            harmless = name.lower() in _ZERO_WHERE_ABSENT or _may_be_made(name, before, of_ours)
            if harmless or not 0 < len(lacking) < len(with_points):
                continue
            raise DimensionError(
                f"the dimension '{name}' is missing in {count_of(len(lacking), 'input')}, and "
                "others have it",
                where=stage.place,
                found=f"{lacking[0]} without it",
                cure="Run those that have it by themselves, or give it to all",
            )


def _may_be_made(
    name: str, before: Iterable[tuple[int, StageJson]], of_ours: Mapping[int, Mapping[str, str]]
) -> bool:
    """Return whether one of the stages before, by their indexes, may make a dimension.

    `of_ours` are the dimensions that stages of ours make, by index. The name is in any case.
    """
    return any(
        name.lower() in map(str.lower, of_ours[index])
        if index in of_ours
        else _may_create(name, stage)
        for index, stage in before
    )


def _is_created(name: str) -> bool:
    """Return whether a dimension comes only from a stage or from extra bytes."""
    feature = any(name.startswith(f"{feature}_") for feature in BY_NAME)
    return feature or (known(name) is not None and name != "Classification")


def _may_create(name: str, stage: StageJson) -> bool:
    """Return whether a stage of PDAL may create a dimension; readers but those of LAS may."""
    if is_reader(stage):
        files = readers_files([stage], las=True)
        named = name in str(stage.get("extra_dims", ""))
        layouts = filter(None, map(layout_there, files))
        return not files or named or any(name in layout.extra_by_name for layout in layouts)
    if stage["type"] in _CREATES_ANY or name in heights_of(stage):
        return True
    return any(name in str(value) for key, value in stage.items() if key not in ("type", "tag"))


# ---- one stage -----------------------------------------------------------------------------------


def stage_files(stage: Stage) -> list[str]:
    """Return the files that a stage of ours reads, also a model that is both read and written."""
    written = {output.path for output in stage.outputs()}
    if stage.type.startswith("writers."):  # whose outputs may be named after it
        written.add(stage.options["filename"])
    files: list[str] = []
    for option in stage.all_options():
        name = stage.options[option.name]
        if name and option.kind == "model":
            files.append(find(name))
        elif name and option.kind == "filename" and name not in written:
            files.append(name)
    return [*files, *stage.inputs()]


def expand_stage(
    as_written: StageJson, number: int = 0, index: int = 0, stage: Stage | None = None
) -> ExpandedStage:
    """Return a stage of ours, checked, and the ``filters.python`` that stands for it."""
    stage = stage or stage_from(as_written)
    options = {k: v for k, v in as_written.items() if k not in ("type", *PDAL_OWN)}
    label = f"pdal_stages_{stage.type.replace('.', '_')}_{uuid.uuid4().hex[:12]}"
    arguments = {"stage": stage.type, "label": label, "options": options}
    if as_written.get("tag"):
        arguments["tag"] = as_written["tag"]
    plain = python_filter(label, TRAMPOLINE, arguments, stage.creates())
    plain |= {key: as_written[key] for key in PDAL_OWN if key in as_written}
    BY_LABEL[label] = expanded = ExpandedStage(stage, number, index, as_written, plain)
    return expanded


def fuse_scripts(stages: Sequence[StageJson]) -> list[StageJson]:
    """Return an expanded pipeline with one filter for stages of ours that follow one another.

    For each filter PDAL copies all dimensions of all points, up to a tenth of a job's time. What
    tags and inputs wire stays as it is; a stage that forgets dimensions is the last of its filter.
    """
    out: list[StageJson] = []
    for stage in stages:
        before = out[-1] if out else {}
        wired = (before.keys() - {"inputs"} | stage.keys()).intersection(PDAL_OWN)
        if not wired and all(str(each.get("module")) in BY_LABEL for each in (before, stage)):
            several = before["pdalargs"].get("stages", [before["pdalargs"]])
            last = BY_LABEL.get(several[-1]["label"])
            if not (isinstance(last, ExpandedStage) and last.stage.forgets):
                adds = [*dict.fromkeys(before["add_dimension"] + stage["add_dimension"])]
                arguments = {"stages": [*several, stage["pdalargs"]]}
                out[-1] = {**before, "pdalargs": arguments, "add_dimension": adds}
                continue
        out.append(stage)
    return out
