"""Plan a pipeline in tiles: readers, a head that sees neighbors, a tail that writes."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ..base.errors import PipelineError
from ..base.files import LAS, Output, check_outputs
from ..base.json_types import StageJson
from ..classifier.model_file import shipped
from ..pipeline.copies import read_here
from ..pipeline.expansion import stage_files
from ..pipeline.inputs_outputs import named_files, named_outputs, outputs_of, writes_las
from ..pipeline.json_source import Override
from ..pipeline.run import Pipeline
from ..pipeline.spatial_reference import MOVING
from ..stages.base import Blocks, Stage
from .options import Box, TileGrid

#: Dimension that follows a point through a tile's pipeline: its row in the piece of its input.
ROW = "PdalStagesRow"
#: The number of the piece.
INPUT = "PdalStagesInput"
#: Meters outside the tile; negative inside.
OUTSIDE = "PdalStagesOutside"
#: Meters; stages that look farther see saved results of the stages before them, which would
#: otherwise be computed again in a wide halo. The shipped model looks 48, bridges 367; in between
#: the value was not tuned.
_FAR_M = 64.0
# A filter of PDAL that neither list has, such as one that a later version adds, is taken to look
# at neighbors: it needs --buffer.
#: PDAL's filters that process each point by itself.
_PER_POINT = (
    "assign colorization crop expression ferry hag_dem info merge mongo mongoexpression overlay "
    "projpipeline range "
    "reprojection transformation"
)
#: Filters whose result depends on all points at once.
_GLOBAL = (
    "chipper colorinterp cpd divider fps georeference gpstimeconvert groupby head hexbin icp iqr "
    "locate mad mortonorder "
    "randomize relaxationdartthrowing returns shell sort splitter stats tail teaser"
)
#: Options of readers that select points or files, or change them.
_SELECTING = "count start bounds polygon resolution where sql srs_column t_srs"


@dataclass(frozen=True)
class Round:
    """Steps of the head that run on all tiles, or larger squares, before later steps do."""

    begin: int  #: index of its first step in the head
    end: int  #: index after its last step
    #: Of each step, meters outside the tile within which later ones of the round use its results.
    used_m: list[float]
    #: Of each, how far around the points that it reads they must lie for the steps before it to be
    #: right.
    upstream_m: list[float]
    halo_m: float  #: of each tile
    #: Dimensions that the steps before `end` change, saved for the next round. Empty: there are
    #: none, or the next round runs these steps again.
    kept: list[str] = field(default_factory=list)
    #: Of the far-reaching stage at `end`: squares that are computed of all points.
    blocks: Blocks | None = None


@dataclass(frozen=True)
class TilePlan:
    """The plan of a tiled run."""

    readers: list[StageJson]  #: as written
    head: list[StageJson]  #: stages that see neighbors: run on a tile and its halo
    rounds: list[Round]  #: the head in parts; the last one, which may be empty, runs on the tiles
    #: Stages that process single points, and the writers: run on the points of one output.
    tail: list[StageJson]
    #: Files that each stage reads, of the head and then of the tail: models, maps and more.
    files: list[list[str]]
    sees_m: float  #: meters around a tile within which points may matter
    #: Dimensions that the head changes; None where unknown because of PDAL's filters in it.
    creates: list[str] | None
    unit: str  #: `horizontal_unit` of our stages; empty: the unit of the spatial reference
    messages: list[str]  #: messages for the user
    name: str  #: the pipeline's file, or another name of its source
    #: Created dimensions that LAS files get besides the input's own; None leaves it to the writer.
    extra_dims: dict[str, str] | None = None
    #: Dimensions that our stages create and outputs hold, with PDAL's types; files without points
    #: get them, too.
    makes: dict[str, str] = field(default_factory=dict)
    where: str | None = None  #: the points that stages act on, as they come in
    read_here: bool = False  #: PDAL does not read the points, and all stages of the head are ours
    copied: bool = False  #: outputs are copies of inputs, without PDAL

    @property
    def writers(self) -> list[StageJson]:
        """Return the stages that write files."""
        return [s for s in self.tail if s["type"].startswith("writers.")]

    @property
    def halo_m(self) -> float:
        """Return the widest halo in meters, but for the first of several rounds."""
        return max(part.halo_m for part in self.rounds[1:] or self.rounds)

    @property
    def blocks(self) -> Blocks | None:
        """Return the blocks of the far-reaching stage, if there is one."""
        return next((part.blocks for part in self.rounds if part.blocks), None)

    def adapt(self, tiles: int, tiles_per_square: int) -> TilePlan:
        """Return the plan for a number of tiles; nothing lies around a single one."""
        count, rounds = len(self.head), self.rounds
        if tiles == 1:
            rounds = [Round(0, count, [0.0] * count, [0.0] * count, self.halo_m)]
        elif tiles_per_square == 1 and len(rounds) > 1 and rounds[-1].begin == count:
            rounds = rounds[:-1]  # the last squares are tiles
        return replace(self, rounds=rounds)


@dataclass(frozen=True)
class RunContext:
    """Facts that all tasks of a run have in common."""

    plan: TilePlan
    grid: TileGrid
    squares: TileGrid  #: of the rounds before the last
    unit: float  #: meters per unit of the coordinates
    bounds: Box  #: of all inputs
    threads: int
    most_points: int  #: a tile is not read with a wider halo that holds more
    wkt: str  #: the spatial reference of the inputs
    scratch: str  #: folder for temporary files
    kept: str  #: folder with the results of rounds

    def grid_of(self, number: int) -> TileGrid:
        """Return the grid that a round runs on."""
        return self.grid if number + 1 == len(self.plan.rounds) else self.squares


@dataclass(frozen=True)
class _Step:
    """One stage of the pipeline."""

    options: dict[str, Any]  #: as written, with the type
    where: str  #: its line or number, for messages
    ours: Stage | None

    @property
    def type(self) -> str:
        return self.options["type"]

    @property
    def rank(self) -> int:
        """Return 0 for readers, 1 for filters and all of ours, 2 for writers."""
        return (
            {"readers": 0, "writers": 2}.get(self.type.partition(".")[0], 1)
            if self.ours is None
            else 1
        )

    @property
    def sees_neighbors(self) -> bool:
        return self.ours is not None or self.type.removeprefix("filters.") not in _PER_POINT.split()

    @property
    def files(self) -> list[str]:
        """Return the existing files that it reads: of PDAL's stages all that options name."""
        read = [] if self.ours is None else stage_files(self.ours)
        paths = map(os.path.abspath, (*named_files([self.options]), *read))
        return [path for path in dict.fromkeys(paths) if os.path.exists(path)]

    def sees_results_of(self, earlier: _Step) -> bool:
        """Return whether an earlier step's results at neighbors can change a point's."""
        return self.ours is None or earlier.ours is None or self.ours.sees_results_of(earlier.ours)

    def reach(self, buffer: float | None) -> float:
        """Return meters around a point within which others affect its result."""
        if self.ours is not None:
            return self.ours.halo_m()
        return float(buffer or 0.0) if self.sees_neighbors else 0.0


def make_plan(pipeline: Pipeline, buffer: float | None = None) -> TilePlan:
    """Check that a pipeline can be run in tiles, and plan it.

    `buffer` tells how far PDAL's filters look, in meters. PipelineError or OptionError, with the
    reason and the cure, where tiles cannot give its result.
    """
    source = pipeline.source
    ours = {expanded.number: expanded for expanded in pipeline.expanded.ours}
    steps = []
    for index, stage in enumerate(source.stages):
        expanded = ours.get(index)
        options = dict(expanded.as_written if expanded else stage)
        steps.append(_Step(options, source.where(index), expanded.stage if expanded else None))
    _check_linear(steps)
    readers, filters, writers = ([s for s in steps if s.rank == rank] for rank in (0, 1, 2))
    _check_ends(readers, filters, writers)
    end = max((n for n, step in enumerate(filters, 1) if step.sees_neighbors), default=0)
    for number, step in enumerate(filters):
        _check_local(step, number < end, buffer)
    head, tail = filters[:end], filters[end:]
    reaches = [step.reach(buffer) for step in head]
    sees_m = _round(head, reaches, 0, end).halo_m
    stages = [step.ours for step in head if step.ours is not None]
    makes = {name: kind for stage in stages for name, kind in stage.creates().items()}
    foreign = any(step.ours is None and step.type != "filters.merge" for step in head)
    return TilePlan(
        readers=[step.options for step in readers],
        head=[_for_workers(step) for step in head],
        rounds=_rounds(head, reaches),
        tail=[step.options for step in [*tail, *writers]],
        files=[step.files for step in [*head, *tail, *writers]],
        sees_m=sees_m,
        creates=None if foreign else list(makes),
        makes=makes,
        unit=next(filter(None, (stage.horizontal_unit for stage in stages)), ""),
        messages=list(pipeline.expanded.warnings),
        name=source.name,
        read_here=read_here([*source.stages[: len(readers)], *(step.options for step in head)]),
        copied=pipeline.copied,
    )


def plan_of_files(
    files: Sequence[str],
    stages: Sequence[StageJson],
    overrides: Iterable[Override],
    buffer: float | None = None,
) -> tuple[TilePlan, Pipeline]:
    """Plan stages after a reader of files; return the pipeline with the first one, too."""
    # PDAL reads extra dimensions of LAS 1.0-1.3 only with the last option.
    reader = {"type": "readers.las", "filename": files[0], "tag": "input", "use_eb_vlr": True}
    pipeline = Pipeline([reader, *stages], overrides, may_copy=True)
    plan = make_plan(pipeline, buffer)
    plan.readers[0]["filename"] = list(files)
    return plan, pipeline


def _round(head: list[_Step], reaches: list[float], begin: int, end: int, **facts: Any) -> Round:
    """Return a round of some steps that look as far as `reaches` (meters) tell."""
    steps, reaches = head[begin:end], reaches[begin:end]
    used, upstream = [0.0] * len(steps), [0.0] * len(steps)
    for n, step in enumerate(steps):
        seen = [k for k in range(n) if step.sees_results_of(steps[k])]
        upstream[n] = max((reaches[k] + upstream[k] for k in seen), default=0.0)
    for n in range(len(steps) - 1, -1, -1):
        for m in range(n + 1, len(steps)):
            reach = reaches[m] if steps[m].sees_results_of(steps[n]) else 0.0
            used[n] = max(used[n], used[m] + reach)
    halo = max((u + reach for u, reach in zip(used, reaches, strict=True)), default=0.0)
    return Round(begin, end, used, upstream, halo, **facts)


def _rounds(head: list[_Step], reaches: list[float]) -> list[Round]:
    """Cut the head before stages that look far: they see saved results of those before.

    Blocks serve the first far-reaching stage, which then needs no halo.
    """
    rounds: list[Round] = []
    begin, open_ended = 0, False
    for at, step in enumerate(head):
        only = not open_ended and not any(part.blocks for part in rounds)
        blocks = step.ours.blocks() if step.ours is not None and only else None
        kept = _kept(head[:at])
        if blocks is not None or (kept is not None and at > begin and reaches[at] > _FAR_M):
            rounds.append(_round(head, reaches, begin, at, kept=kept or [], blocks=blocks))
            begin = begin if kept is None else at
        if blocks is not None:
            reaches = [*reaches[:at], 0.0, *reaches[at + 1 :]]
        open_ended = open_ended or (step.ours is not None and step.ours.open_ended)
    rounds.append(_round(head, reaches, begin, len(head)))
    kept = _kept(head)
    if kept and rounds[-1].halo_m > _FAR_M:  # on squares, of which tiles then take their points
        rounds[-1] = replace(rounds[-1], kept=kept)
        rounds.append(_round(head, reaches, len(head), len(head)))
    return rounds


def _kept(before: list[_Step]) -> list[str] | None:
    """Return the dimensions that stages change, if saving these is enough; else None."""
    if any(step.ours is None and step.type != "filters.merge" for step in before):
        return None  # which may drop points
    return sorted({name for step in before if step.ours for name in step.ours.creates()})


def _check_linear(steps: list[_Step]) -> None:
    """Refuse pipelines that branch; in a linear one, `inputs` are redundant and removed."""
    readers = {str(step.options.get("tag")) for step in steps if step.rank == 0}
    for number, step in enumerate(steps):
        before = steps[number - 1] if number else None
        if before and step.rank < before.rank:
            raise PipelineError(
                "a pipeline in tiles is linear: readers, then filters, then writers",
                where=step.where,
                found=f"{step.type} after {before.type}",
            )
        wanted = step.options.pop("inputs", None) or []
        names = {wanted} if isinstance(wanted, str) else set(map(str, wanted))
        if names and before and names not in (readers, {str(before.options.get("tag"))}):
            raise PipelineError(
                "in tiles a stage takes all points of those before it",
                where=step.where,
                found=f"inputs {sorted(names)}",
                cure="Run one pipeline for each branch",
            )


def _check_ends(readers: list[_Step], filters: list[_Step], writers: list[_Step]) -> None:
    if not readers:
        raise PipelineError("the pipeline has no reader, so there is nothing to cut into tiles")
    if not writers and not any(
        step.ours is not None and step.ours.instead_of_tiles for step in filters
    ):
        cure = "End it with a file name, e.g. classified_#.laz"
        raise PipelineError("the pipeline has no writer", cure=cure)
    for step in writers:
        if not isinstance(step.options.get("filename"), str) or "://" in step.options["filename"]:
            raise PipelineError("in tiles, writers write local files", where=step.type)
        if step.type == "writers.gdal":
            raise PipelineError(
                "rasters are not written in tiles: each would lack the points beyond its edge",
                where=step.where,
                cure="Write LAS files, and give these to PDAL: pdal pipeline "
                "pipelines/terrain-and-surface.json",
            )
    for step in readers:
        for name in _SELECTING.split():
            if name in step.options:
                raise PipelineError(
                    f"option '{name}' of a reader cannot be combined with --tile",
                    where=step.type,
                    found=step.options[name],
                    cure="Cut the input first, with pdal translate",
                )


def _check_local(step: _Step, in_head: bool, buffer: float | None) -> None:
    """Refuse stages that need all points at once, whose reach is unknown, or that move points."""
    instead = step.ours.instead_of_tiles if step.ours is not None else ""
    if instead or step.type.removeprefix("filters.") in _GLOBAL.split():
        raise PipelineError(
            f"{step.type} needs all points at once, so it cannot be run in tiles",
            where=step.where,
            cure=instead or "Leave it out, or run the pipeline without --tile",
        )
    if step.ours is None and step.sees_neighbors and buffer is None:
        raise PipelineError(
            f"{step.type} may look at neighbors, and PDAL does not say how far",
            where=step.where,
            cure="Give --buffer METERS, wide enough for it (0 if it looks at single points)",
        )
    if in_head and step.type in MOVING:
        raise PipelineError(
            f"{step.type} moves points, but tiles are cut before it, and stages after it see "
            "neighbors",
            where=step.where,
            cure="Reproject the files first, or put it after the last stage of pdal_stages",
        )


def _for_workers(step: _Step) -> StageJson:
    """Return a stage of the head with absolute paths, which every worker finds.

    A shipped model keeps its name, as its path differs between hosts.
    """
    stage = dict(step.options)
    for option in step.ours.all_options() if step.ours is not None else ():
        name = stage.get(option.name)
        if name and option.kind in ("filename", "model") and name not in shipped():
            stage[option.name] = os.path.abspath(name)
    return stage


def outputs_for(
    plan: TilePlan, inputs: Sequence[str], tiles: Sequence[str] | None = None
) -> list[list[str]]:
    """Return each writer's output for every input, or tile by name; StageError if not writable."""
    paths_of_writers = []
    for writer in plan.writers:
        name = os.path.abspath(writer["filename"])
        paths_of_writers.append(
            outputs_of(inputs, name) if tiles is None else named_outputs(name, tiles)
        )
    kinds = [LAS if writes_las(writer) else "" for writer in plan.writers]
    every = [
        Output(path, "output", kind)
        for kind, paths in zip(kinds, paths_of_writers, strict=True)
        for path in paths
    ]
    # Missing folders will be created; a dry run checks the others.
    check_outputs([output for output in every if Path(output.path).parent.is_dir()], inputs)
    return [list(each) for each in zip(*paths_of_writers, strict=True)]
