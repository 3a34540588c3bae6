"""Reduce the points of a survey to a record for each tile, and compute results from the records.

Each point is read once, with no surroundings: what a tile needs of its neighbors is in their
records.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..base.errors import StageError
from ..base.grid import GridWindow
from ..base.hashing import fingerprint
from ..base.json_types import JsonObject
from ..base.las_points import LasColumns
from ..base.messages import count_of, print_messages
from ..base.version import build
from .inputs import LONE_M, InputSource, LonePoints, Survey
from .jobs import Job, Store, load_arrays, save_arrays
from .options import Density, TileGrid, TilingOptions
from .plan import TilePlan
from .records import JobRecord
from .rounds import Round
from .sorted_points import points_near
from .survey_run import SurveyRun, workers_of

#: Points of an input: its path, and their dimensions by PDAL's names.
Part = tuple[str, Mapping[str, NDArray]]
#: Column and row of a tile.
Tile = tuple[int, int]
#: Returns the density by which tiles are chosen, from that of points and meters per unit.
Measure = Callable[[Density, float], Density]
#: Reasons that are shown where tiles fail.
_MOST_REASONS = 3


class LonePoint(NamedTuple):
    """A point that is left out, as it is alone."""

    path: str  #: of its input
    x: float
    y: float


@dataclass
class ReducedTile(JobRecord):
    """Figures of a tile that was reduced; subclasses add theirs."""

    _: KW_ONLY
    lone: list[LonePoint] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Take points as JSON holds them, too."""
        self.lone = [LonePoint(*each) for each in self.lone]


_Figures = TypeVar("_Figures", bound=JobRecord)
_ReducedTile = TypeVar("_ReducedTile", bound=ReducedTile)
#: Reduces the points of a tile, those of each input that has any there, to arrays and figures. Lone
#: points are to be left out of the arrays.
Reduce = Callable[[list[Part], LonePoints], tuple[dict[str, NDArray], _ReducedTile]]
#: Returns the task that computes the result of a tile from the arrays of those around it, by tile,
#: writes it to a file, and returns figures.
Compute = Callable[[Tile, dict[Tile, str], str], Callable[[], _Figures]]


@dataclass
class RecordJob(Job, Generic[_Figures]):
    """Reduce a tile, or compute a result of it, with figures."""

    _: KW_ONLY
    tile: Tile
    record: _Figures | None = None

    @property
    def figures(self) -> _Figures:
        """Return the figures of a job that is done."""
        assert self.record is not None
        return self.record


class RecordSurvey(Survey):
    """A survey whose tiles are reduced to records: inputs have one reference, nothing lies around.

    Its outputs lie in a folder.
    """

    def __init__(
        self,
        name: str,
        files: Sequence[str],
        folder: Path,
        tiling: TilingOptions | None,
        measure: Measure,
    ) -> None:
        """Find and check the inputs, and choose tiles by a measure of their density.

        A run that resumes another has its tiles, where the user gives no size.
        """
        reader = {"type": "readers.las", "filename": list(files)}
        plan = TilePlan(
            readers=[reader],
            in_tiles=[],
            rounds=[Round(0, 0, [], 0.0)],
            per_output=[],
            files=[],
            sees_m=0.0,
            one_reference=True,
            creates=[],
            unit="",
            messages=[],
            name=name,
        )
        self.folder, self._measure = folder, measure
        self.chosen = replace(tiling or TilingOptions(), per="tile")  #: as the user gives them
        resumed = self.chosen.resume and self.chosen.tile is None
        super().__init__(plan, self.chosen, Store(folder).grids() if resumed else None)

    def measure_density(self) -> Density:
        """Return the density by which tiles are chosen."""
        return self._measure(super().measure_density(), self.unit)


class RecordRun(SurveyRun):
    """A run that reduces the tiles of a survey, and computes results from the records."""

    def reduce(
        self,
        name: str,
        settings: JsonObject,
        reduce: Reduce[_ReducedTile],
        kind: type[_ReducedTile],
    ) -> list[RecordJob[_ReducedTile]]:
        """Reduce the points of each tile; return its jobs with the figures, which are of a kind.

        The arrays lie in :meth:`path_of` the job. `settings` are all that affects them beside the
        points.
        """
        survey, grid = self.survey, self.survey.grid
        self.read_inputs()
        tiles = survey.tiles()
        near = {tile: survey.near(tile, 0.0) for tile in tiles}
        lone = survey.find_lone_points()
        common = [settings, lone.keys.tolist()]
        marks = {tile: [common, [each.content for each in near[tile]]] for tile in tiles}
        jobs = self._jobs(name, tiles, marks, kind)
        waiting = self._without_arrays(jobs)
        self.read_inputs({source.path for job in waiting for source in near[job.tile]})
        if faults := survey.faults:  # a result would have holes
            seen = "; ".join(f"{path}: {why}" for path, why in [*faults.items()][:_MOST_REASONS])
            raise StageError(f"{len(faults)} of the inputs cannot be read", found=seen)

        def task_of(job: RecordJob[_ReducedTile]) -> Callable[[], _ReducedTile]:
            sources = near[job.tile]
            return partial(_reduce_tile, grid, job.tile, sources, reduce, lone, self.path_of(job))

        self._finish("reducing tiles", waiting, task_of)
        print_messages(*_name_lone([point for job in jobs for point in job.figures.lone]))
        return jobs

    def compute(
        self,
        name: str,
        reduced: Sequence[RecordJob[_ReducedTile]],
        tiles: Iterable[Tile],
        reach: float,
        compute: Compute[_Figures],
        kind: type[_Figures],
    ) -> list[RecordJob[_Figures]]:
        """Compute results of tiles from the arrays of reduced ones within a reach; return the jobs.

        Tiles with no reduced ones around have no result. The reach is in the unit of the
        coordinates.
        """
        grid, of_tile = self.survey.grid, {job.tile: job for job in reduced}
        wide = range(-math.ceil(reach / grid.size), math.ceil(reach / grid.size) + 1)
        near: dict[Tile, list[RecordJob[_ReducedTile]]] = {}
        for i, j in tiles:
            sources = [
                of_tile[i + k, j + l] for l in wide for k in wide if (i + k, j + l) in of_tile
            ]
            near |= {(i, j): sources} if sources else {}
        marks = {tile: [job.digest for job in sources] for tile, sources in near.items()}
        points = {tile: of_tile[tile].points if tile in of_tile else 1 for tile in near}
        jobs = self._jobs(name, points, marks, kind)

        def task_of(job: RecordJob[_Figures]) -> Callable[[], _Figures]:
            files = {each.tile: self.path_of(each) for each in near[job.tile]}
            return compute(job.tile, files, self.path_of(job))

        self._finish(name, self._without_arrays(jobs), task_of)
        return jobs

    def path_of(self, job: Job) -> str:
        """Return the file of a job's arrays."""
        return self.store.path(job.name)

    def arrays(self, jobs: Iterable[Job], *names: str) -> Iterator[dict[str, NDArray]]:
        """Yield arrays of jobs, those of one at a time."""
        return (load_arrays(self.path_of(job), names) for job in jobs)

    def _jobs(
        self,
        name: str,
        points: Mapping[Tile, int],
        marks: Mapping[Tile, object],
        kind: type[_Figures],
    ) -> list[RecordJob[_Figures]]:
        """Return jobs for tiles with their numbers of points, and with what affects each."""
        grid, common = self.survey.grid, [build(), name, vars(self.survey.grid)]
        return [
            RecordJob(
                f"{grid.name(tile)}.{name}",
                number,
                tile=tile,
                digest=fingerprint(common, tile, marks[tile]),
                record_type=kind,
            )
            for tile, number in points.items()
        ]

    def _without_arrays(self, jobs: Sequence[RecordJob[_Figures]]) -> deque[RecordJob[_Figures]]:
        """Return the jobs that no earlier run has finished, in their order."""
        for job in jobs:
            if not os.path.exists(self.path_of(job)):
                self.store.forget(job.name)
        return self.unkept(jobs)

    def _finish(
        self,
        what: str,
        waiting: deque[RecordJob[_Figures]],
        task_of: Callable[[RecordJob[_Figures]], Callable[[], _Figures]],
    ) -> None:
        """Run jobs; StageError where one fails."""
        failed = [job.reason for job in self.do(what, waiting, task_of) if job.reason]
        if failed:
            raise StageError(
                f"{count_of(len(failed), 'tile')} failed: nothing was written",
                found="; ".join(dict.fromkeys(failed[:_MOST_REASONS])),
                cure="Continue with --resume, for example with a smaller --tile or more --memory",
            )


@contextlib.contextmanager
def record_run(survey: RecordSurvey, progress: bool | None = None) -> Iterator[RecordRun]:
    """Open the working folder and the workers of a run."""
    if not survey.density.points:
        raise StageError("the inputs have no points", found=", ".join(survey.paths[:3]))
    print_messages(*survey.messages)
    chosen, options = survey.chosen, survey.options
    alone = chosen.tile is None and len(survey.grid.covering(survey.bounds)) == 1
    if alone and chosen.workers is None and not chosen.scheduler:
        options = replace(options, workers=0)  # another process would take longer to start
    with Store(survey.folder) as store:
        if not chosen.resume:
            store.clear()
        store.finish("run", survey.grids.to_json())
        with workers_of(options, str(store.folder)) as workers:
            yield RecordRun(survey, store, workers, progress)
        store.remove(".npz")
    if changed := survey.changed():
        print_messages(f"{changed[0]} changed during the run: run it again")


def cells_in_tile(grid: TileGrid, tile: Tile, side: float) -> GridWindow:
    """Return the cells of a side whose centers lie in a tile; a window of none where there is none.

    The side is in the unit of the coordinates.
    """
    sides = []
    for number, low in zip(tile, grid.box(tile)[:2], strict=True):
        cells = math.floor(low / side) - 1 + np.arange(math.ceil(grid.size / side) + 3.0)
        sides.append(cells[grid.index((cells + 0.5) * side) == number].astype(np.int64))
    return GridWindow.enclosing(*sides)


def _reduce_tile(
    grid: TileGrid,
    tile: Tile,
    sources: Sequence[InputSource],
    reduce: Reduce[_ReducedTile],
    lone: LonePoints,
    target: str,
) -> _ReducedTile:
    """Read the points of a tile, save the arrays they are reduced to, and return the figures."""
    parts = points_of_tile(grid, tile, sources)
    arrays, figures = reduce(parts, lone)
    save_arrays(target, arrays)
    for path, part in parts:
        alone = lone.among(part["X"], part["Y"])
        places = np.column_stack([part["X"][alone], part["Y"][alone]])
        figures.lone += [LonePoint(path, *place) for place in places.tolist()]
    return figures


def _name_lone(points: Sequence[LonePoint]) -> list[str]:
    """Return a message about points that are left out of rasters as they are alone, if any are."""
    return [
        f"{count_of(len(points), 'point')} left out of rasters: fewer than two others lie within "
        f"{LONE_M:g} m, the first at {x:.2f} {y:.2f} of {path}"
        for path, x, y in points[:1]
    ]


def points_of_tile(grid: TileGrid, tile: Tile, sources: Sequence[InputSource]) -> list[Part]:
    """Return the inputs with points in a tile, and the dimensions of these."""
    parts: list[Part] = []
    for source in sources:
        assert source.index is not None
        layout = source.layout
        records = points_near(layout, source.index, grid.box(tile))[1]
        x, y = (layout.fields[axis].read(records) for axis in "XY")
        inside = (grid.index(x) == tile[0]) & (grid.index(y) == tile[1])
        if inside.any():
            parts.append((source.path, LasColumns([(layout, records[inside])])))
    return parts
