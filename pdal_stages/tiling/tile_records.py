"""Reduce the points of a survey to a record for each tile, and compute results from the records.

Each point is read once, with no surroundings: what a tile needs of its neighbors is in their
records.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from ..base.errors import StageError
from ..base.hashing import fingerprint
from ..base.messages import print_messages
from ..base.version import build
from ..pipeline.las_files import laspy_header
from .inputs import InputSource, Survey
from .jobs import Job, Store, save_arrays
from .options import TileGrid, TilingOptions
from .plan import Round, TilePlan
from .sorted_points import coordinates, points_near
from .tiled_run import SurveyRun, workers_of

#: Reduces the points of a tile, a path and a laspy record for each input that has any there, to
#: arrays and figures that JSON can hold.
Reduce = Callable[[list[tuple[str, Any]]], tuple[dict[str, NDArray], dict[str, Any]]]
#: Reasons that are shown where tiles fail.
_MOST_REASONS = 3


def plan_of_records(name: str, files: Sequence[str]) -> TilePlan:
    """Return a plan without stages: inputs must have one reference, and nothing lies around."""
    reader = {"type": "readers.las", "filename": list(files)}
    rounds = [Round(0, 0, [], [], 0.0)]
    # Two meters that matter around a tile, so that references are compared.
    return TilePlan([reader], [{"type": name}], rounds, [], [[]], 2.0, [], "", [], name)


class RecordRun(SurveyRun):
    """A run that reduces the tiles of a survey, and computes results from the records."""

    def reduce(self, name: str, settings: Mapping[str, Any], reduce: Reduce) -> list[Job]:
        """Reduce the points of each tile; return its jobs, whose records are the figures.

        The arrays lie in :meth:`path_of` the job. `settings` are all that affects them beside the
        points.
        """
        survey, jobs = self.survey, []
        self.read_inputs()
        self._refuse_faults()
        for tile, points in survey.tiles().items():
            content = [source.content for source in survey.near(tile, 0.0)]
            mark = fingerprint(build(), name, settings, vars(survey.grid), tile, content)
            jobs.append(Job(f"{survey.grid.name(tile)}.{name}", points, tile, mark=mark))
        waiting = self._without_arrays(jobs)
        self.read_inputs({s.path for job in waiting for s in survey.near(job.tile, 0.0)})
        self._refuse_faults()

        def task_of(job: Job) -> Callable[[], Any]:
            near, target = survey.near(job.tile, 0.0), self.path_of(job)
            return partial(_reduce_tile, survey.grid, job.tile, near, reduce, target)

        self._finish("reducing tiles", waiting, task_of)
        return jobs

    def compute(
        self, what: str, jobs: Sequence[Job], task_of: Callable[[Job], Callable[[], Any]]
    ) -> None:
        """Run jobs that write arrays into :meth:`path_of` and return figures, as of records."""
        self._finish(what, self._without_arrays(jobs), task_of)

    def path_of(self, job: Job) -> str:
        """Return the file of a job's arrays."""
        return self.store.path(job.name)

    def forget(self, names: Collection[str]) -> None:
        """Remove the arrays of jobs of some names, the last parts of theirs."""
        for name in names:
            self.store.remove(f".{name}.npz")

    def _without_arrays(self, jobs: Sequence[Job]) -> Any:
        """Return the jobs that no earlier run has finished, in their order."""
        for job in jobs:
            if not os.path.exists(self.path_of(job)):
                self.store.forget(job.name)
        return self.unkept(jobs)

    def _refuse_faults(self) -> None:
        """Refuse a survey of which a file cannot be read: a result would have holes."""
        if faults := self.survey.faults:
            found = "; ".join(f"{path}: {why}" for path, why in [*faults.items()][:_MOST_REASONS])
            raise StageError(f"{len(faults)} of the inputs cannot be read", found=found)

    def _finish(self, what: str, waiting: Any, task_of: Callable[[Job], Callable[[], Any]]) -> None:
        """Run jobs; StageError where one fails."""
        count = len(waiting)
        failed = [job.reason for job in self.do(what, waiting, task_of) if job.reason]
        if failed:
            raise StageError(
                f"{len(failed)} of {count} tiles failed: nothing was written",
                found="; ".join(dict.fromkeys(failed[:_MOST_REASONS])),
                cure="Continue with --resume, for example with a smaller --tile or more --memory",
            )


@contextlib.contextmanager
def record_run(
    survey: Survey, chosen: TilingOptions, folder: Path, progress: bool | None = None
) -> Iterator[RecordRun]:
    """Open the working folder and the workers of a run whose outputs lie in a folder."""
    if not survey.density.points:
        raise StageError("the inputs have no points", found=", ".join(survey.paths[:3]))
    print_messages(*survey.messages)
    alone = chosen.tile is None and len(survey.grid.covering(survey.bounds)) == 1
    options = survey.options
    if alone and chosen.workers is None and not chosen.scheduler:
        options = replace(options, workers=0)  # another process would take longer to start
    with Store(folder) as store:
        if not chosen.resume:
            store.clear()
        store.finish("run", "", survey.layout)
        with workers_of(options, str(store.folder)) as workers:
            yield RecordRun(survey, store, workers, progress)
    if changed := survey.changed():
        print_messages(f"{changed[0]} changed during the run: run it again")


def earlier_layout(folder: Path, chosen: TilingOptions) -> dict[str, Any] | None:
    """Return the tiles of the run that this one resumes, where the user gives no size."""
    known = Store(folder).note("run") if chosen.resume and chosen.tile is None else {}
    return known if "square" in known else None


def _reduce_tile(
    grid: TileGrid,
    tile: tuple[int, int],
    sources: Sequence[InputSource],
    reduce: Reduce,
    target: str,
) -> dict[str, Any]:
    """Read the points of a tile, save the arrays they are reduced to, and return the figures."""
    arrays, figures = reduce(points_of_tile(grid, tile, sources))
    save_arrays(target, arrays)
    return figures


def points_of_tile(
    grid: TileGrid, tile: tuple[int, int], sources: Sequence[InputSource]
) -> list[tuple[str, Any]]:
    """Return the inputs with points in a tile, and these as laspy's records."""
    import laspy

    parts = []
    for source in sources:
        assert source.index is not None
        header = laspy_header(source.path)
        records = points_near(header, source.index, grid.box(tile))[1]
        x, y = coordinates(records, header)
        inside = (grid.index(x) == tile[0]) & (grid.index(y) == tile[1])
        if inside.any():
            part = records[inside], header.point_format, header.scales, header.offsets
            parts.append((source.path, laspy.ScaleAwarePointRecord(*part)))
    return parts
