"""A tiled run: find inputs, index them, run tiles, put outputs together, report."""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..base.errors import DependencyError, StageError
from ..base.files import sweep
from ..base.jit import kept_kernels
from ..base.plain import print_messages
from ..pipeline.las_output import files_with_flags_to_split
from ..pipeline.overrides import Override
from ..pipeline.read import PipelineSource
from ..pipeline.run import Pipeline
from ..stages.points import HOLDS_NOWHERE
from ..stages.polygons import TOUCH_NONE
from .cluster import open_workers
from .dispatch import run_all, run_first_round
from .estimate import estimate
from .oneformat import following
from .outcome import FileJob, InterruptedRun, TiledRun, TileJob, summarize
from .rasters import remarks
from .settings import TilingOptions
from .sources import InputSource
from .store import Store
from .survey import Survey
from .tileplan import TilePlan, make_plan, outputs_for
from .worklist import Worklist


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
        As for :class:`pdal_stages.Pipeline`, or one that was made already.
    tile : float or TilingOptions
        Side of the tiles, in the unit of the coordinates; or all options.
    overrides : iterable of Override
    dry_run : bool
        Only find the tiles; nothing is read but headers, nothing written.
    progress : bool, optional
        Whether to show progress on stderr.
    **options
        The other fields of :class:`TilingOptions`.

    Returns
    -------
    TiledRun
        With the failures of tiles, which do not raise: look at :attr:`TiledRun.failures`.

    Raises
    ------
    StageError
        For what is wrong before any tile, or with every tile.
    InterruptedRun
        A KeyboardInterrupt with what was done until then.

    Examples
    --------
    >>> from pdal_stages.tiling import run_tiled
    >>> run = run_tiled("classify.json", 500, workers=2)             # doctest: +SKIP
    >>> run.failures                                                 # doctest: +SKIP
    []
    """
    chosen = tile if isinstance(tile, TilingOptions) else TilingOptions(tile, **options)
    pipeline = source if isinstance(source, Pipeline) else Pipeline(source, overrides, whole=False)
    return run_plan(
        make_plan(pipeline, chosen.buffer),
        chosen,
        dry_run=dry_run,
        progress=progress,
        source=pipeline.source,
    )


def run_plan(
    plan: TilePlan,
    chosen: TilingOptions,
    *,
    dry_run: bool = False,
    progress: bool | None = None,
    finished: Callable[[TileJob | FileJob], None] | None = None,
    source: PipelineSource | None = None,
) -> TiledRun:
    """Run what was planned; see :func:`run_tiled`. `finished` hears of every output that was written.

    `source`: the pipeline as the user gave it, which is tried on an input first.
    """
    started = time.monotonic()
    folder = Path(plan.writers[0]["filename"]).absolute().parent
    if chosen.resume and chosen.tile is None:  # the free memory may be another today
        chosen = replace(chosen, tile=Store(folder).side())
    survey = Survey(plan, chosen, Store(folder).side("block") if chosen.resume else None)
    plan, chosen = survey.plan, survey.options
    if survey.per == "tile":  # whose outputs have points of all readers
        plan = replace(plan, tail=following(plan.tail, survey.paths))
        files_with_flags_to_split([*plan.readers, *plan.tail])
    survey.messages += remarks(plan.tail, chosen.tile if survey.per == "tile" else None)
    if source is not None:
        readable = [each for each in survey.sources if each.path not in survey.unreadable]
        _try_on_an_input(source, readable, len(plan.readers))
    if dry_run:
        return estimate(plan, survey)
    if not folder.is_dir():
        raise StageError("the folder of the output does not exist", found=str(folder), cure="Create it first")
    if plan.makes and progress is not False and not chosen.scheduler and not kept_kernels():
        print_messages("compiling for this processor first, once: it takes a minute or two")
    folders = {folder}
    if survey.per == "file":  # refused now, not after reading all inputs
        named = outputs_for(plan, survey.names, survey.paths)
        folders |= {Path(path).parent for paths in named for path in paths}
    with Store(folder) as store:
        if not chosen.resume:
            store.clear()
        store.keep_sides(survey.grid.size, None if plan.first is None else plan.first.blocks.side)
        try:
            with open_workers(chosen, str(store.folder)) as workers:
                store.forget_copies([survey.mark_of(path) for path in survey.paths])
                survey.read_inputs(store, workers, progress)
                work = Worklist(plan, survey)
                if chosen.resume:
                    work.take_over(store)
                    survey.read_inputs(store, workers, progress, work.inputs())
                with contextlib.suppress(KeyboardInterrupt):
                    interrupted = True
                    run_first_round(work, store, workers, progress)
                    run_all(work, store, workers, progress, finished)
                    interrupted = False
                    work.forget_results(store)
                    store.forget_copies()
        finally:
            for each in folders:
                sweep(each)  # what workers left that were killed
    summary = survey.figures(plan) | {"workers": workers.slots, "threads_per_worker": workers.threads}
    summary |= summarize(work.jobs, survey.costs, time.monotonic() - started)
    survey.messages += _messages_of_tiles(work)
    short = [job.name for job in work.jobs if job.state == "done" and job.record.get("short")]
    if short:
        survey.messages.append(
            f"{len(short)} tile{'s have' if len(short) > 1 else ' has'} points whose neighborhoods or terrain reach farther "
            f"than could be read within {chosen.most_points:,} points; they may differ from an untiled run: "
            + ", ".join(short[:5])
        )
    run = TiledRun(work.jobs, work.outputs, survey.unreadable, survey.changed(), survey.messages, summary)
    if interrupted:
        raise InterruptedRun(run)
    return run


#: Most different warnings of tiles that a run repeats.
_MOST_MESSAGES = 20


def _messages_of_tiles(work: Worklist) -> list[str]:
    """Warnings and notes of tiles, once each, the most frequent first."""
    of_tiles = [
        set(job.record.get("messages", ()))
        for job in work.jobs
        if job.state == "done" and job.record.get("points")
    ]
    found: Counter[str] = Counter()
    for lines in (of_tiles, [set(messages) for messages in work.messages_before]):
        for text, n in Counter(text for each in lines for text in each).items():
            if not text.startswith((HOLDS_NOWHERE, TOUCH_NONE)):
                found[text] += n
            elif n == len(lines):  # that there is nothing to do in some tiles is as it should be
                found[text] = max(found[text], n)
    messages = [f"{text} ({n} tile{'s' * (n != 1)})" for text, n in found.most_common(_MOST_MESSAGES)]
    return messages + (
        [f"and {len(found) - _MOST_MESSAGES} more; see --report"] if len(found) > _MOST_MESSAGES else []
    )


def _try_on_an_input(source: PipelineSource, inputs: list[InputSource], readers: int) -> None:
    """Let PDAL prepare the pipeline on one input: stages that lack dimensions and unknown options fail before any tile."""
    first = next((one for one in inputs if one.kind == "las"), None)
    if first is None:
        return
    reader: dict[str, Any] = {**first.reader, "type": "readers.las", "filename": first.path}
    tags = [stage.get("tag") if isinstance(stage, dict) else None for stage in source.stages[:readers]]
    stages = [{**reader, "tag": tag} if tag else dict(reader) for tag in tags]
    with contextlib.suppress(DependencyError):  # the program pdal is not there to ask
        Pipeline(replace(source, stages=[*stages, *source.stages[readers:]]), whole=False).prepare()
