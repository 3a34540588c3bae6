"""From a pipeline to what each tile runs: readers, a head that sees neighbors, a tail that writes."""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..base.errors import OptionError, PipelineError, StageError
from ..pipeline.lowering import PDAL_OWN
from ..pipeline.optionfile import settled
from ..pipeline.overrides import Override
from ..pipeline.run import Pipeline
from ..stages import registry
from ..stages.base import Stage
from .settings import TilingOptions

#: Dimensions that follow a point through a tile's pipeline.
ROW, SOURCE, MARGIN = "PdalStagesRow", "PdalStagesSource", "PdalStagesMargin"

#: PDAL's filters that look at one point at a time.
PER_POINT = {
    f"filters.{name}"
    for name in (
        *("assign", "colorization", "crop", "expression", "ferry", "hag_dem", "info", "merge", "mongo"),
        *("mongoexpression", "overlay", "projpipeline", "range", "reprojection", "transformation"),
    )
}
#: Of them, those that move points: tiles are cut before, so they may only come after all stages of ours.
_MOVING = {"filters.reprojection", "filters.transformation", "filters.projpipeline"}
#: Filters whose result depends on all points at once.
_GLOBAL = {
    f"filters.{name}"
    for name in (
        *(
            "chipper",
            "colorinterp",
            "cpd",
            "divider",
            "fps",
            "georeference",
            "gpstimeconvert",
            "groupby",
            "head",
        ),
        *("hexbin", "icp", "iqr", "locate", "mad", "mortonorder", "randomize", "relaxationdartthrowing"),
        *("returns", "shell", "sort", "splitter", "stats", "tail", "teaser"),
    )
}
#: Stages of ours whose result depends on all points at once, and what to do instead.
_OUR_GLOBAL = {
    "writers.classifiermodel": "Train without --tile: only samples are computed, so memory goes to the points alone",
    "filters.accuracy": "Write the files first, then compare them: pdal-stages accuracy FILE --reference-dimension "
    "Reference",
}
#: Stages of ours whose `where` only chooses the points to compute.
_WHERE_CHOOSES = {"filters.multiscalefeatures", "filters.modelclassifier"}


@dataclass
class TilePlan:
    """What a tiled run does to each tile.

    Attributes
    ----------
    readers : list of dict
        The pipeline's readers, as given.
    head : list of dict
        Stages that see neighbors: run on a tile and its surroundings.
    tail : list of dict
        Stages that look at single points, and the writers: run on the points of one output.
    halo : float
        Metres of surroundings.
    creates : list of str or None
        Dimensions the head changes; None where PDAL's filters in it make that unknown.
    unit : str
        `horizontal_unit` of our stages, empty for the spatial reference's.
    notes : list of str
        What the user should know.
    name : str
        The pipeline's file, or what else its source is called.
    """

    readers: list[dict[str, Any]]
    head: list[dict[str, Any]]
    tail: list[dict[str, Any]]
    halo: float
    creates: list[str] | None
    unit: str = ""
    notes: list[str] = field(default_factory=list)
    name: str = ""

    @property
    def writers(self) -> list[dict[str, Any]]:
        return [s for s in self.tail if str(s["type"]).startswith("writers.")]


def make_plan(source: Any, overrides: Iterable[Override], options: TilingOptions) -> TilePlan:
    """Check that a pipeline can be run in tiles, and cut it.

    Raises
    ------
    PipelineError, OptionError
        For pipelines whose result tiles cannot give, with the reason and the cure.
    """
    pipeline = Pipeline(source, overrides)  # every error of ours, before any tile
    stages = [_object(s, i, len(pipeline.source.stages)) for i, s in enumerate(pipeline.source.stages)]
    where = [pipeline.source.where(i) for i in range(len(stages))]
    readers, filters, writers = _sections(stages, where)
    last = -1
    for place, stage in enumerate(filters):
        _refuse_global(stage, where[len(readers) + place], options)
        if stage["type"] in registry.stages() or stage["type"] not in PER_POINT:
            last = place
    head, tail = filters[: last + 1], filters[last + 1 :]
    for place, stage in enumerate(head):
        if stage["type"] in _MOVING:
            raise PipelineError(
                f"{stage['type']} moves points before stages that see neighbors, and tiles are cut before it",
                where=where[len(readers) + place],
                cure="Reproject the files first, or put it after the last stage of pdal_stages",
            )
    kinds = [registry.stages().get(s["type"]) for s in head]
    ours = [None if k is None else k(given_options(s), s["type"]) for k, s in zip(kinds, head, strict=True)]
    reaches = [_reach(stage, made, options) for stage, made in zip(head, ours, strict=True)]
    unit = next((s.horizontal_unit for s in ours if s is not None and s.horizontal_unit), "")
    ready = _prepare(head, ours, reaches)
    foreign = [
        s["type"] for s, k in zip(head, kinds, strict=True) if k is None and s["type"] != "filters.merge"
    ]
    creates: list[str] | None = None
    if not foreign:
        creates = list(dict.fromkeys(name for s in ours if s is not None for name in s.creates()))
    notes = []
    if any(k is None and t not in PER_POINT for k, t in zip(kinds, (s["type"] for s in head), strict=True)):
        notes.append(
            "filters of PDAL that look at neighbors were given --buffer; whether it suffices for a seamless result "
            "only they know"
        )
    return TilePlan(
        readers, ready, [*tail, *writers], sum(reaches), creates, unit, notes, pipeline.source.name
    )


def _object(stage: Any, index: int, count: int) -> dict[str, Any]:
    """A stage as an object with a type; bare names become readers and the writer that PDAL would take."""
    out = copy.deepcopy(stage) if isinstance(stage, dict) else {"filename": stage}
    if not out.get("type"):
        writes = 0 < index == count - 1
        name = str(out.get("filename", ""))
        if writes:
            out["type"] = _driver(name, "writers")
        else:
            out["type"] = "readers.ept" if name.endswith("ept.json") else _driver(name, "readers")
    return settled(out) if out["type"] in registry.stages() else out


def _driver(name: str, kind: str) -> str:
    suffix = Path(name).suffix.lower()
    if suffix in (".las", ".laz"):
        return f"{kind}.las"
    known = {".txt": "text", ".csv": "text", ".ply": "ply", ".bpf": "bpf", ".tif": "gdal", ".pcd": "pcd"}
    if suffix in known:
        return f"{kind}.{known[suffix]}"
    raise PipelineError(
        f"the {kind[:-1]} of '{name}' is not known by its name", cure=f'Give the stage a type: "{kind}.las"'
    )


def _sections(
    stages: list[dict[str, Any]], where: list[str]
) -> tuple[list[dict[str, Any]], list[dict[str, Any]], list[dict[str, Any]]]:
    kinds = [str(s["type"]).partition(".")[0] for s in stages]
    order = {"readers": 0, "filters": 1, "writers": 2}
    ranks = [
        1 if s["type"] in registry.stages() else order.get(k, 1) for s, k in zip(stages, kinds, strict=True)
    ]
    tags: set[str] = set()
    for place, (stage, rank) in enumerate(zip(stages, ranks, strict=True)):
        if place and rank < ranks[place - 1]:
            raise PipelineError(
                "a pipeline in tiles is a row: readers, then filters, then writers",
                where=where[place],
                found=f"{stage['type']} after {stages[place - 1]['type']}",
            )
        wanted = stage.pop("inputs", None)
        if wanted is not None and rank:
            names = {wanted} if isinstance(wanted, str) else set(map(str, wanted))
            before = {str(s.get("tag")) for s, r in zip(stages[:place], ranks[:place], strict=True) if r == 0}
            if names != before and names != {str(stages[place - 1].get("tag"))}:
                raise PipelineError(
                    "a pipeline in tiles is a row; this stage takes only some of the points before it",
                    where=where[place],
                    found=f"inputs {sorted(names)}",
                    cure="Run one pipeline for each branch",
                )
        if "tag" in stage:
            tags.add(str(stage["tag"]))
    readers = [s for s, r in zip(stages, ranks, strict=True) if r == 0]
    filters = [s for s, r in zip(stages, ranks, strict=True) if r == 1]
    writers = [s for s, r in zip(stages, ranks, strict=True) if r == 2]
    if not readers:
        raise PipelineError("the pipeline has no reader, so there is nothing to cut into tiles")
    if not any(s["type"] in _OUR_GLOBAL for s in filters):
        if not writers:
            raise PipelineError(
                "the pipeline has no writer", cure="End it with a file name, e.g. classified_#.laz"
            )
        for stage in writers:
            if not isinstance(stage.get("filename"), str) or "://" in stage["filename"]:
                raise PipelineError("in tiles, a writer writes files", where=stage["type"])
    for stage in readers:
        for name in ("count", "start", "bounds", "polygon", "resolution"):
            if name in stage:
                raise PipelineError(
                    f"option '{name}' of a reader cannot be combined with --tile",
                    where=stage["type"],
                    found=stage[name],
                    cure="Cut the input first, with pdal translate",
                )
    return readers, filters, writers


def _refuse_global(stage: dict[str, Any], where: str, options: TilingOptions) -> None:
    kind = stage["type"]
    if kind in _OUR_GLOBAL:
        raise PipelineError(
            f"{kind} needs all points at once, so it cannot be run in tiles",
            where=where,
            cure=_OUR_GLOBAL[kind],
        )
    if kind in _GLOBAL:
        raise PipelineError(f"{kind} needs all points at once, so it cannot be run in tiles", where=where)
    if kind not in registry.stages() and kind not in PER_POINT and options.buffer is None:
        raise PipelineError(
            f"{kind} may look at neighbors, and PDAL does not say how far",
            where=where,
            cure="Give --buffer METRES, wide enough for it (0 if it looks at single points)",
        )


def given_options(stage: dict[str, Any]) -> dict[str, Any]:
    """A stage's options without those that every stage of PDAL has."""
    return {k: v for k, v in stage.items() if k not in ("type", *PDAL_OWN)}


def _reach(stage: dict[str, Any], made: Stage | None, options: TilingOptions) -> float:
    if made is None:
        return 0.0 if stage["type"] in PER_POINT else float(options.buffer or 0.0)
    if made.type == "filters.multiscalefeatures":
        _needs_thresholds(stage, made)
    return made.halo()


def _needs_thresholds(stage: dict[str, Any], made: Any) -> None:
    plan = made.plan
    copt = any(n.kind == "copt" for n in plan.neighborhoods)
    if not (plan.shapes or copt):
        return
    path = made.bins
    if path and Path(path).exists():
        return
    what = "shape distributions" if plan.shapes else "copt"
    raise OptionError(
        f"the thresholds of {what} are fitted to the points, so every tile would have its own",
        where=stage["type"],
        found=f"bins {path!r}, which does not exist" if path else "no option 'bins'",
        cure='Give "bins": "thresholds.json", and run the pipeline once without --tile on one typical file, which '
        "writes it; a model file has its thresholds within",
    )


def _prepare(head, ours, reaches) -> list[dict[str, Any]]:
    """The head for a tile: absolute paths, and only points computed that someone will see."""
    out = []
    for place, (stage, made) in enumerate(zip(head, ours, strict=True)):
        stage = dict(stage)
        if made is not None:
            for option in made.all_options():
                if option.kind == "filename" and stage.get(option.name):
                    stage[option.name] = str(Path(stage[option.name]).absolute())
            later = sum(reaches[place + 1 :]) + made.inner_reach()
            if made.type in _WHERE_CHOOSES:
                seen = f"{MARGIN} <= {later!r}" if later > 0 else f"{MARGIN} < 0"
                stage["where"] = f"({made.where}) && ({seen})" if made.where else seen
        out.append(stage)
    return out


def later_reaches(head: list[dict[str, Any]], options_buffer: float) -> list[float]:
    """For each stage of a head, how far outside the tile its results are still used, metres."""
    reaches = []
    for stage in head:
        kind = registry.stages().get(stage["type"])
        if kind is None:
            reaches.append(0.0 if stage["type"] in PER_POINT else options_buffer)
        else:
            reaches.append(kind(given_options(stage)).halo())
    return [sum(reaches[i + 1 :]) for i in range(len(reaches))]


def outputs_for(plan: TilePlan, names: list[str]) -> list[list[Path]]:
    """Paths of each writer for every name put in place of '#'.

    Raises
    ------
    PipelineError
        Where several outputs would have one name.
    """
    found: list[list[Path]] = []
    for writer in plan.writers:
        text = str(writer["filename"])
        if "#" not in Path(text).name and len(names) > 1:
            raise PipelineError(
                f"{len(names)} files will be written, and the writer has one name",
                where=writer["type"],
                found=text,
                cure="Put '#' where the name of the tile or input file shall stand, e.g. "
                f"{Path(text).stem}_#{Path(text).suffix}",
            )
        if "#" in str(Path(text).parent):
            raise PipelineError(
                "'#' stands in the file's name, not in its folder", where=writer["type"], found=text
            )
        path = Path(text).absolute()
        found.append([path.with_name(path.name.replace("#", n)) for n in names])
    flat = [p for paths in found for p in paths]
    twice = sorted(str(p) for p, n in Counter(flat).items() if n > 1)
    if twice:
        raise PipelineError(
            "two inputs would be written to the same file",
            found=twice[0],
            cure="Give input files different names, or use --per tile",
        )
    return found


def check_not_inputs(outputs: Iterable[Path], inputs: Iterable[str]) -> None:
    """Refuse to write over what is being read."""
    real = {str(Path(p).resolve()) for p in inputs}
    for path in outputs:
        if str(path.resolve()) in real:
            raise StageError("the output is one of the inputs", found=str(path), cure="Give it another name")
