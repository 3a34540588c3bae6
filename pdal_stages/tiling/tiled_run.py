"""Run pipelines in tiles: plan, read the inputs, run rounds and tiles, assemble outputs."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

from ..base.errors import DependencyError, StageError
from ..base.files import create_folder, sweep
from ..base.jit import count_cached_kernels
from ..base.json_types import StageJson
from ..base.las_points import Layout
from ..base.messages import print_messages
from ..pipeline.expansion import check_shared_dimensions
from ..pipeline.json_source import Override
from ..pipeline.pdal_facts import check_flags, check_inputs, check_units
from ..pipeline.run import Pipeline
from .estimate import estimate
from .inputs import InputSource, Survey
from .jobs import InterruptedRun, Store, TiledRun, WritingJob
from .options import TilingOptions
from .plan import TilePlan, make_plan
from .plan_run import PlanRun
from .round_jobs import RoundJobs
from .survey_run import workers_of
from .write_outputs import plan_copy


def run_tiled(
    source: str | Path | list | dict | Pipeline,
    tile: float | TilingOptions,
    overrides: Iterable[Override] = (),
    *,
    dry_run: bool = False,
    progress: bool | None = None,
    **options: Any,
) -> TiledRun:
    """Run a pipeline in tiles.

    Parameters
    ----------
    source : str, Path, list, dict or Pipeline
        As for :class:`pdal_stages.Pipeline`, or such an object.
    tile : float or TilingOptions
        Side of the tiles, in the unit of the coordinates; or all options.
    overrides : iterable of Override
    dry_run : bool
        Only find the tiles: only headers are read, and nothing is written.
    progress : bool, optional
        Whether to show progress on stderr.
    **options
        The other fields of :class:`TilingOptions`.

    Returns
    -------
    TiledRun
        Failures of tiles do not raise: see :attr:`TiledRun.failures`.

    Raises
    ------
    StageError
        For errors before any tile, or in every tile.
    InterruptedRun
        A KeyboardInterrupt with what was done until then.
    """
    chosen = tile if isinstance(tile, TilingOptions) else TilingOptions(tile, **options)
    pipeline = source if isinstance(source, Pipeline) else Pipeline(source, overrides)
    plan = make_plan(pipeline, chosen.buffer)
    return run_plan(plan, chosen, dry_run=dry_run, progress=progress, pipeline=pipeline)


def run_plan(
    plan: TilePlan,
    chosen: TilingOptions,
    *,
    dry_run: bool = False,
    progress: bool | None = None,
    finished: Callable[[WritingJob], None] | None = None,
    pipeline: Pipeline | None = None,
) -> TiledRun:
    """Run a plan; see :func:`run_tiled`.

    `finished` is called with every output that was written. `pipeline` is first validated on one
    input.
    """
    started = time.monotonic()
    folder = Path(plan.writers[0]["filename"]).absolute().parent
    resumed = chosen.resume and chosen.tile is None
    survey = Survey(plan, chosen, Store(folder).grids() if resumed else None)
    plan = replace(plan, copied=plan.copied and chosen.per == "file")
    if not plan.copied:
        _refuse_misread(plan, survey, chosen.per == "tile")
    _refuse_uncopied(plan, survey)
    if pipeline is not None:
        _refuse_lacking(pipeline, survey)
    if pipeline is not None and not plan.copied:
        _try_on_an_input(pipeline, survey, len(plan.readers))
    if dry_run:
        return estimate(plan, survey)
    create_folder(folder, "the output")
    if plan.makes and progress is not False and not chosen.scheduler and not count_cached_kernels():
        print_messages("compiling for this processor first, once: it takes a minute or two")
    folders = {folder, *(Path(path).parent for paths in survey.outputs for path in paths)}
    with Store(folder) as store:
        if not chosen.resume:
            store.clear()
        store.finish("run", survey.grids.to_json())
        try:
            with workers_of(survey.options, str(store.folder)) as workers:
                run = PlanRun(plan, survey, store, workers, progress)
                run.read_inputs()
                run.find_jobs()
                rounds = RoundJobs(run)
                if chosen.resume:
                    run.take_over()
                    squares = {*chain(*rounds.squares_without_record)}
                    run.read_inputs(run.inputs_of_waiting(squares))
                interrupted = True
                with contextlib.suppress(KeyboardInterrupt):
                    rounds.make()
                    run.make_outputs(finished)
                    run.forget()
                    interrupted = False
        finally:
            for each in (*folders, store.kept):
                sweep(each)  # left by workers that were killed
    result = run.result(time.monotonic() - started)
    if interrupted:
        raise InterruptedRun(result)
    return result


def _refuse_misread(plan: TilePlan, survey: Survey, together: bool) -> None:
    """Refuse inputs that PDAL would misread, `together` or one by one."""
    readers = [{**source.reader, "filename": source.path} for source in survey.readable()]
    for stages in [readers] if together else [[reader] for reader in readers]:
        for check in (check_inputs, check_units, check_flags):
            check([*stages, *plan.per_output])


def _refuse_uncopied(plan: TilePlan, survey: Survey) -> None:
    """Refuse inputs of which no copy can be written with what stages create."""
    for source, layout in _layouts(survey):
        plan_copy(plan, source, layout, ".las", {})


def _refuse_lacking(pipeline: Pipeline, survey: Survey) -> None:
    """Refuse inputs without a dimension that stages read and others have."""
    layouts = {source.path: layout for source, layout in _layouts(survey)}
    check_shared_dimensions(pipeline.expanded, layouts)


def _layouts(survey: Survey) -> Iterator[tuple[InputSource, Layout]]:
    """Yield inputs with their layouts; reading the others reports what is wrong with them."""
    for source in survey.readable():
        try:
            layout = source.layout
        except StageError:
            continue
        yield source, layout


def _try_on_an_input(pipeline: Pipeline, survey: Survey, readers: int) -> None:
    """Let PDAL prepare the pipeline on one input: what is wrong fails before any tile."""
    source = pipeline.source
    inputs = survey.readable()
    reader: StageJson = {**inputs[0].reader, "filename": inputs[0].path}
    tags = [stage.get("tag") for stage in source.stages[:readers]]
    stages = [{**reader, "tag": tag} if tag else dict(reader) for tag in tags]
    with contextlib.suppress(DependencyError):  # the program pdal is not there to ask
        trial = replace(source, stages=[*stages, *source.stages[readers:]])
        Pipeline(trial, ready=pipeline.expanded.ours).prepare()
