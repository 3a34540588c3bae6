"""Plan a pipeline in tiles: what runs on tiles, in which rounds, and what on each output."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from ..base.errors import PipelineError
from ..base.files import LAS, Output, check_outputs
from ..base.json_types import JsonObject, StageJson
from ..base.messages import Message
from ..classifier.model_file import shipped
from ..pipeline.copies import read_here
from ..pipeline.inputs_outputs import named_outputs, outputs_of, writes_las
from ..pipeline.json_source import Override
from ..pipeline.run import Pipeline
from ..stages.base import Blocks
from .options import Box, TileGrid
from .planned_stage import PlannedStage, check_ends, check_in_tiles, check_linear
from .rounds import Round, RoundStage, cut_into_rounds, make_round

#: Dimension that follows a point through a tile's pipeline: its row in the piece of its input.
ROW = "PdalStagesRow"
#: The number of the piece.
INPUT = "PdalStagesInput"
#: Meters outside the tile; negative inside.
OUTSIDE = "PdalStagesOutside"

#: Fields of a plan on which not all results depend. Each job has a part of the first (its inputs,
#: its stages, its output), which its own digest holds; the second tell what was read and how it is
#: reported, of which the digests of inputs and stages know all that matters.
_APART = {"readers", "in_tiles", "rounds", "per_output", "files", "sees_m", "creates"}
_APART |= {"messages", "name", "extra_dims", "makes"}


@dataclass(frozen=True)
class TilePlan:
    """The plan of a tiled run."""

    readers: list[StageJson]  #: as written
    #: Stages up to the last that sees neighbors: they run on a tile and its halo.
    in_tiles: list[StageJson]
    rounds: list[Round]  #: these in parts; the last one, which may be empty, runs on the tiles
    #: Stages that process single points, and the writers: run on the points of one output.
    per_output: list[StageJson]
    #: Files that each stage reads, in tiles and then per output: models, maps and more.
    files: list[list[str]]
    sees_m: float  #: meters around a tile within which points may matter
    one_reference: bool  #: whether all inputs must have the same reference system
    #: Dimensions that stages in tiles change; None where unknown because of PDAL's filters in it.
    creates: list[str] | None
    unit: str  #: `horizontal_unit` of our stages; empty: the unit of the spatial reference
    messages: list[Message]  #: messages for the user
    name: str  #: the pipeline's file, or another name of its source
    #: Created dimensions that LAS files get besides the input's own; None leaves it to the writer.
    extra_dims: dict[str, str] | None = None
    #: Dimensions that our stages create and outputs hold, with PDAL's types; files without points
    #: get them, too.
    makes: dict[str, str] = field(default_factory=dict)
    where: str | None = None  #: the points that stages act on, as they come in
    read_here: bool = False  #: PDAL does not read the points, and all stages in tiles are ours
    copied: bool = False  #: outputs are copies of inputs, without PDAL

    def shared_fields(self) -> JsonObject:
        """Return the fields on which results of all rounds depend; a new one is among them."""
        return {name: value for name, value in vars(self).items() if name not in _APART}

    @property
    def writers(self) -> list[StageJson]:
        """Return the stages that write files."""
        return [s for s in self.per_output if s["type"].startswith("writers.")]

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
        count, rounds = len(self.in_tiles), self.rounds
        if tiles == 1:
            rounds = [Round(0, count, [RoundStage(0.0, 0.0)] * count, self.halo_m)]
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


def make_plan(pipeline: Pipeline, buffer: float | None = None) -> TilePlan:
    """Check that a pipeline can be run in tiles, and plan it.

    `buffer` tells how far PDAL's filters look, in meters. PipelineError or OptionError, with the
    reason and the cure, where tiles cannot give its result.
    """
    source = pipeline.source
    expanded = {each.number: each for each in pipeline.expanded.ours}
    stages = []
    for index, written in enumerate(source.stages):
        ours = expanded.get(index)
        options = dict(ours.as_written if ours else written)
        stages.append(PlannedStage(options, source.where(index), ours.stage if ours else None))
    check_linear(stages)
    readers, filters, writers = ([s for s in stages if s.rank == rank] for rank in (0, 1, 2))
    check_ends(readers, filters, writers)
    end = max((n for n, stage in enumerate(filters, 1) if stage.sees_neighbors), default=0)
    for number, stage in enumerate(filters):
        check_in_tiles(stage, number < end, buffer)
    whole, per_output = filters[:end], [*filters[end:], *writers]
    in_tiles = [part for stage in whole for part in stage.parts()]
    reaches = [stage.reach(buffer) for stage in in_tiles]
    sees_m = make_round(in_tiles, reaches, 0, len(in_tiles)).halo_m
    ours_in_tiles = [stage.ours for stage in whole if stage.ours is not None]
    makes = {name: kind for stage in ours_in_tiles for name, kind in stage.creates().items()}
    foreign = any(stage.ours is None and stage.type != "filters.merge" for stage in in_tiles)
    return TilePlan(
        readers=[stage.options for stage in readers],
        in_tiles=[_for_workers(stage) for stage in in_tiles],
        rounds=cut_into_rounds(in_tiles, reaches),
        per_output=[stage.options for stage in per_output],
        files=[stage.files for stage in [*in_tiles, *per_output]],
        sees_m=sees_m,
        one_reference=bool(in_tiles and sees_m),
        creates=None if foreign else list(makes),
        makes=makes,
        unit=next((s.horizontal_unit for s in ours_in_tiles if s.horizontal_unit), ""),
        messages=list(pipeline.expanded.warnings),
        name=source.name,
        read_here=read_here([*source.stages[: len(readers)], *(s.options for s in in_tiles)]),
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


def _for_workers(stage: PlannedStage) -> StageJson:
    """Return a stage with absolute paths, which every worker finds.

    A shipped model keeps its name, as its path differs between hosts.
    """
    options = dict(stage.options)
    for option in stage.ours.all_options() if stage.ours is not None else ():
        name = options.get(option.name)
        if name and option.kind in ("filename", "model") and name not in shipped():
            options[option.name] = os.path.abspath(name)
    return options


def outputs_for(
    plan: TilePlan, inputs: Sequence[str], tiles: Sequence[str] | None = None
) -> list[list[str]]:
    """Return each writer's output for every input, or tile by name; StageError if not writable."""
    paths_of_writers = []
    for writer in plan.writers:
        name = os.path.abspath(writer["filename"])
        if Path(name).name == "#" and not writes_las(writer):
            raise PipelineError(
                "the file name '#' alone takes the input's suffix, which is of LAS files",
                found=f"{writer['type']} writes {writer['filename']}",
                cure="Put a suffix after it, e.g. #.laz or #.txt",
            )
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
