"""Flags of LAS 1.0-1.3 on their way to other formats, and beside LAS 1.4.

PDAL before 2.6 reads them as the upper bits of the class, and writes class and flags of LAS 1.4 from two dimensions.
Written as they were read, a withheld point of class 2 would become one of class 130.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from uuid import uuid4

from ..base.asprs import LEGACY_LIMIT
from ..base.errors import PipelineError
from ..stages import registry
from . import pdal as pdal_env
from .filenames import is_writer, reader_files, writes_las
from .runtime import python_filter
from .writerlimits import las_headers, las_version

_SPLIT = f"""\
def stage(ins, outs):
    both = ins["Classification"]
    outs["Classification"] = both & {LEGACY_LIMIT}
    outs["ClassFlags"] = both >> {LEGACY_LIMIT.bit_length()}
    return True
"""
# The dimension that flags have in LAS 1.4 would become an extra one of LAS 1.2, so they wait in Python, a piece for each
# view; PDAL runs a stage for all views before the next.
_TAKE_OFF = f"""\
import sys
def stage(ins, outs):
    both = ins["Classification"]
    if pdalargs["wanted"]:
        waiting = sys.__dict__.setdefault("_pdal_stages_flags", {{}}).setdefault(pdalargs["pair"], [])
        waiting.append(both & {0xFF ^ LEGACY_LIMIT})
    outs["Classification"] = both & {LEGACY_LIMIT}
    return True
"""
_PUT_BACK = """\
import sys
def stage(ins, outs):
    waiting = sys._pdal_stages_flags[pdalargs["pair"]]
    outs["Classification"] = ins["Classification"] | waiting.pop(0)
    if not waiting:
        del sys._pdal_stages_flags[pdalargs["pair"]]
    return True
"""
_LABEL = "pdal_stages_class_flags"
_CURE = (
    'Write the older files as LAS 1.4 first: pdal-stages pipeline, with the file and {"type": "writers.las", "filename": '
    '"new.laz", "forward": "all", "extra_dims": "all", "minor_version": 4, "dataformat_id": 6} (7 with colors)'
)


@dataclass(frozen=True)
class Parting:
    """What must be done with the flags of a pipeline.

    Attributes
    ----------
    way : str
        ``split``: into two dimensions, right after the readers of LAS 1.0-1.3; ``around``: taken off before each writer
        of another format than LAS, and put back after it; empty where they come through as they are.
    old : tuple of bool
        Of each reader, whether it reads LAS 1.0-1.3.
    mixed : bool
        Whether there is LAS 1.4 beside it.
    """

    way: str = ""
    old: tuple[bool, ...] = ()
    mixed: bool = False


def parting(stages: Sequence[dict[str, Any]], *, with_ours: bool = False) -> Parting:
    """What must be done so that flags are neither lost nor become classes; `with_ours`: there are stages of ours besides.

    Raises
    ------
    PipelineError
        Where writers of LAS 1.2 and 1.4 would need both.
    """
    if pdal_env.splits_class_flags():
        return Parting()
    stages = list(stages)
    writers = [n for n, stage in enumerate(stages) if is_writer(stage, stages)]
    readers = _readers(stages)
    formats = [{header.point_format <= 5 for header in las_headers([stages[n]])} for n in readers]
    old = tuple(True in found for found in formats)
    known = set().union(*formats)
    if True not in known:
        return Parting()
    # Stages of ours know flags inside the class.
    given = [n for n in writers if stages[n].get("type") not in registry.stages()]
    fit = [n for n in given if _holds_both(stages[n], stages[:n])]
    if known == {True}:
        alone = not with_ours and not any(stage.get("type") in registry.stages() for stage in stages)
        if len(fit) == len(given) or (
            alone and not any(writes_las(stages[n]) for n in given if n not in fit)
        ):
            return Parting()  # without stages of ours, text and rasters come out as PDAL makes them
        if not fit:
            return Parting("split", old)
        if not any(writes_las(stages[n]) for n in given if n not in fit):
            return Parting("around", old)
    elif not fit:
        return Parting("split", old, mixed=True)
    raise PipelineError(
        "this PDAL cannot bring the flags (synthetic, key-point, withheld) of LAS 1.0-1.3 into a pipeline with LAS 1.4",
        found=f"PDAL {pdal_env.dotted_version()}, "
        + ("writers of both" if known == {True} else "readers of both, and a writer of point formats 0 to 5"),
        cure=_CURE
        if known == {True}
        else 'Give the writer "minor_version": 4 and "dataformat_id": 6 (7 with colors)',
    )


def wired(stages: list[dict[str, Any]]) -> Iterator[tuple[dict[str, Any], int | None]]:
    """The stages with their numbers, and between them, without one, the filters that part classes from flags."""
    plan = parting(stages)
    if plan.way == "around":
        yield from around(stages)
    elif plan.way == "split" and (plan.mixed or any("inputs" in stage for stage in stages)):
        yield from _split_each(stages, plan.old)
    else:
        last = _readers(stages)[-1] if plan.way else None
        for number, stage in enumerate(stages):
            yield stage, number
            if number == last:
                yield splitter(), None


def splitter(**wiring: Any) -> dict[str, Any]:
    """A filter that gives flags the dimension that they have in LAS 1.4."""
    return {**python_filter(_LABEL, _SPLIT, {}, {"ClassFlags": "uint8_t"}), **wiring}


def is_ours(stage: Mapping[str, Any]) -> bool:
    """Whether a filter is one of those made here."""
    return str(stage.get("module", "")).startswith(_LABEL)


def around(stages: list[dict[str, Any]]) -> Iterator[tuple[dict[str, Any], int | None]]:
    """The stages, with flags taken off before each writer of another format than LAS, and put back where others follow."""
    instead: dict[str, list[str]] = {}
    bare = {n for n, s in enumerate(stages) if is_writer(s, stages) and not writes_las(s)}
    bare -= {n for n in bare if stages[n].get("type") in registry.stages()}
    for number, stage in enumerate(stages):
        stage = _rewired(stage, instead)
        if number not in bare:
            yield stage, number
            continue
        pair = f"{_LABEL}_{uuid4().hex[:12]}"
        follows = not bare.issuperset(range(number, len(stages)))
        before = python_filter(f"{pair}_off", _TAKE_OFF, {"pair": pair, "wanted": follows}, {})
        if "inputs" in stage:
            before["inputs"] = stage["inputs"]
            stage = {key: value for key, value in stage.items() if key != "inputs"}
        yield before, None
        yield stage, number
        if follows:
            yield {**python_filter(f"{pair}_on", _PUT_BACK, {"pair": pair}, {}), "tag": f"{pair}_on"}, None
            if "tag" in stage:
                instead[str(stage["tag"])] = [f"{pair}_on"]


def _split_each(
    stages: list[dict[str, Any]], old: Sequence[bool]
) -> Iterator[tuple[dict[str, Any], int | None]]:
    """The stages, with a filter after each old file, and with inputs where PDAL would take the stage before."""
    instead: dict[str, list[str]] = {}
    pending: list[str] = []  # what PDAL would give a stage that names no inputs
    places = dict(zip(_readers(stages), old, strict=True))
    for number, stage in enumerate(stages):
        if number in places:
            mine: list[str] = []
            for one in _each_file(stage) if places[number] else [stage]:
                made_up = one is not stage or "tag" not in stage
                tag = f"{_LABEL}_in_{number}_{len(mine)}" if made_up else str(stage["tag"])
                yield {**one, "tag": tag}, number
                if any(header.point_format <= 5 for header in las_headers([one])):
                    yield splitter(inputs=[tag], tag=f"{tag}_split"), None
                    tag += "_split"
                mine.append(tag)
            pending += mine
            if "tag" in stage:
                instead[str(stage["tag"])] = mine
            continue
        stage = _rewired(stage, instead)
        if "inputs" not in stage and any(tag.endswith("_split") for tag in pending):
            stage = {**stage, "inputs": pending}
        if number < max(places):  # may be an input beside readers that follow
            stage.setdefault("tag", f"{_LABEL}_at_{number}")
        yield stage, number
        pending = [str(stage["tag"])] if "tag" in stage else []


def _readers(stages: list[dict[str, Any]]) -> list[int]:
    return [
        number
        for number, stage in enumerate(stages)
        if (stage.get("type") or "readers.").startswith("readers.") and not is_writer(stage, stages)
    ]


def _each_file(reader: dict[str, Any]) -> list[dict[str, Any]]:
    """A reader for each file of a pattern."""
    files = reader_files(reader)
    return [{**reader, "filename": name} for name in files] if len(files) > 1 else [reader]


def _rewired(stage: dict[str, Any], instead: Mapping[str, list[str]]) -> dict[str, Any]:
    """A stage whose inputs are others now."""
    if "inputs" not in stage:
        return stage
    names = [stage["inputs"]] if isinstance(stage["inputs"], str) else stage["inputs"]
    return {**stage, "inputs": [new for name in names for new in instead.get(str(name), [str(name)])]}


def _holds_both(writer: dict[str, Any], before: Sequence[dict[str, Any]]) -> bool:
    """Whether a writer puts class and flags into one byte, as they were read."""
    if writer.get("type") == "writers.copc" or not writes_las(writer):
        return False
    return las_version(writer, before)[1] <= 5
