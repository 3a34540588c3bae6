"""A stage of a pipeline as tiles see it: how far it looks, and whether it can be run in them."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace

from ..base.errors import PipelineError
from ..base.json_types import StageJson
from ..pipeline.expansion import stage_files
from ..pipeline.inputs_outputs import named_files
from ..pipeline.spatial_reference import MOVING
from ..stages.base import Stage
from ..stages.registry import stage_from

# A filter of PDAL that neither list has, such as one that a later version adds, is taken to look
# at neighbors: it needs --buffer.
#: PDAL's filters that process each point by itself.
_PER_POINT = (
    "assign colorization crop expression ferry hag_dem info merge mongo mongoexpression overlay "
    "projpipeline range reprojection transformation"
)
#: Filters whose result depends on all points at once.
_GLOBAL = (
    "chipper colorinterp cpd divider fps georeference gpstimeconvert groupby head hexbin icp iqr "
    "locate mad mortonorder randomize relaxationdartthrowing returns shell sort splitter stats "
    "tail teaser"
)
#: Options of readers that select points or files, or change them.
_SELECTING = "count start bounds polygon resolution where sql srs_column t_srs"


@dataclass(frozen=True)
class PlannedStage:
    """A stage of a pipeline that is to run in tiles."""

    options: StageJson  #: as written, with the type
    where: str  #: its line or number, for messages
    ours: Stage | None

    @property
    def type(self) -> str:
        """Return its type, such as ``filters.csf``."""
        return self.options["type"]

    @property
    def rank(self) -> int:
        """Return 0 for readers, 1 for filters and all of ours, 2 for writers."""
        if self.ours is not None:
            return 1
        return {"readers": 0, "writers": 2}.get(self.type.partition(".")[0], 1)

    @property
    def sees_neighbors(self) -> bool:
        """Return whether it looks at neighbors, or may."""
        return self.ours is not None or self.type.removeprefix("filters.") not in _PER_POINT.split()

    @property
    def files(self) -> list[str]:
        """Return the existing files that it reads: of PDAL's stages all that options name."""
        read = [] if self.ours is None else stage_files(self.ours)
        paths = map(os.path.abspath, (*named_files([self.options]), *read))
        return [path for path in dict.fromkeys(paths) if os.path.exists(path)]

    def parts(self) -> list[PlannedStage]:
        """Return the stages that do its work in rounds one after the other; itself if it is one.

        The first one alone has its tag: PDAL refuses a tag that two stages have.
        """
        if self.ours is None:
            return [self]
        out: list[PlannedStage] = []
        for changes in self.ours.parts() or ({},):
            changed = {**self.options, **changes} | ({"tag": None} if out else {})
            options = {name: value for name, value in changed.items() if value is not None}
            stage = stage_from(options).after(self.ours.upstream) if changes else self.ours
            out.append(replace(self, options=options, ours=stage))
        return out

    def sees_results_of(self, earlier: PlannedStage) -> bool:
        """Return whether an earlier step's results at neighbors can change a point's."""
        return self.ours is None or earlier.ours is None or self.ours.sees_results_of(earlier.ours)

    def reach(self, buffer: float | None) -> float:
        """Return meters around a point within which others affect its result."""
        if self.ours is not None:
            return self.ours.halo_m()
        return float(buffer or 0.0) if self.sees_neighbors else 0.0


def check_linear(stages: list[PlannedStage]) -> None:
    """Refuse pipelines that branch; in a linear one, `inputs` are redundant and removed."""
    readers = {str(stage.options.get("tag")) for stage in stages if stage.rank == 0}
    for number, stage in enumerate(stages):
        before = stages[number - 1] if number else None
        if before and stage.rank < before.rank:
            raise PipelineError(
                "a pipeline in tiles is linear: readers, then filters, then writers",
                where=stage.where,
                found=f"{stage.type} after {before.type}",
                cure="Put the writers last; run what comes after one on its files, by another "
                "pipeline",
            )
        wanted = stage.options.pop("inputs", None) or []
        names = {wanted} if isinstance(wanted, str) else set(map(str, wanted))
        if names and before and names not in (readers, {str(before.options.get("tag"))}):
            raise PipelineError(
                "in tiles a stage takes all points of those before it",
                where=stage.where,
                found=f"inputs {sorted(names)}",
                cure="Run one pipeline for each branch",
            )


def check_ends(
    readers: list[PlannedStage], filters: list[PlannedStage], writers: list[PlannedStage]
) -> None:
    """Refuse a pipeline without a reader or writer, and what these cannot do in tiles."""
    if not readers:
        raise PipelineError("the pipeline has no reader, so there is nothing to cut into tiles")
    if not writers and not any(
        stage.ours is not None and stage.ours.instead_of_tiles for stage in filters
    ):
        cure = "End it with a file name, e.g. classified_#.laz"
        raise PipelineError("the pipeline has no writer", cure=cure)
    for stage in writers:
        if not isinstance(stage.options.get("filename"), str) or "://" in stage.options["filename"]:
            raise PipelineError("in tiles, writers write local files", where=stage.type)
        if stage.type == "writers.gdal":
            raise PipelineError(
                "rasters are not written in tiles: each would lack the points beyond its edge",
                where=stage.where,
                cure="Write LAS files, and give these to PDAL: pdal pipeline "
                "pipelines/terrain-and-surface.json",
            )
    for stage in readers:
        for name in _SELECTING.split():
            if name in stage.options:
                raise PipelineError(
                    f"option '{name}' of a reader cannot be combined with --tile",
                    where=stage.type,
                    found=stage.options[name],
                    cure="Cut the input first, with pdal translate",
                )


def check_in_tiles(stage: PlannedStage, before_neighbors: bool, buffer: float | None) -> None:
    """Refuse stages that need all points at once, whose reach is unknown, or that move points."""
    instead = stage.ours.instead_of_tiles if stage.ours is not None else ""
    if instead or stage.type.removeprefix("filters.") in _GLOBAL.split():
        raise PipelineError(
            f"{stage.type} needs all points at once, so it cannot be run in tiles",
            where=stage.where,
            cure=instead or "Leave it out, or run the pipeline without --tile",
        )
    if stage.ours is None and stage.sees_neighbors and buffer is None:
        raise PipelineError(
            f"{stage.type} may look at neighbors, and PDAL does not say how far",
            where=stage.where,
            cure="Give --buffer METERS, wide enough for it (0 if it looks at single points)",
        )
    if before_neighbors and stage.type in MOVING:
        raise PipelineError(
            f"{stage.type} moves points, but tiles are cut before it, and stages after it see "
            "neighbors",
            where=stage.where,
            cure="Reproject the files first, or put it after the last stage of pdal_stages",
        )
