"""Tasks handed out until all are done or given up: tiles, and outputs as soon as the last of their tiles is there."""

from __future__ import annotations

import contextlib
import os
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

from ..base.errors import StageError
from ..base.progress import Progress
from ..base.version import build
from ..pipeline.workers import TaskResult, run_tasks
from .firstround import BlockTask, FirstRoundTask, block_grid, blocks_around, blocks_of, tiles_around
from .grid import Box
from .outcome import Costs, FileJob, TileJob
from .store import Store, block_file, fingerprint, left_file
from .worklist import Worklist

#: A run stops when so many tiles failed for one reason and none succeeded.
_HOPELESS = 10


def run_all(
    work: Worklist,
    store: Store,
    workers: Any,
    show: bool | None,
    finished: Callable[[TileJob | FileJob], None] | None = None,
) -> None:
    """Do all waiting tiles and outputs; their states, records and reasons are set. `finished` hears of outputs.

    Raises
    ------
    StageError
        If the first tiles all fail for one reason.
    """
    jobs = work.jobs
    to_do = [job for job in jobs if job.state == "waiting"]
    for job in to_do:
        store.forget(job.name)
    waiting: deque[TileJob | FileJob] = deque(to_do)
    done = good = sum(job.state == "kept" for job in jobs)
    failures: list[str] = []
    users: dict[tuple[int, int], list[FileJob]] = {}
    for out in work.outputs:
        for job in out.jobs:
            users.setdefault(job.tile, []).append(out)
        _make_ready(out, waiting)
    total = sum(item.points for item in waiting if isinstance(item, TileJob))
    failed = 0
    with Progress(total, f"{done} of {len(jobs)} tiles", enabled=show) as progress:
        for item, answer in run_tasks(workers, waiting, work.tasks(store, workers.threads)):
            work.survey.costs.add("tiles" if isinstance(item, TileJob) else "outputs", answer.cost)
            if answer.reason:
                item.state, item.reason = "failed", answer.reason
            else:
                item.state, item.record = "done", answer.result | answer.cost
                with contextlib.suppress(StageError, OSError):  # no room: a later run does it again
                    work.keep(store, item)
            if finished is not None and item.state == "done" and item.outputs:
                progress.clear()
                finished(item)
            if isinstance(item, FileJob):
                progress.update(0)
                continue
            if answer.reason:
                failed += 1
                progress.total -= item.points
            else:
                done += 1
            progress.label = f"{done} of {len(jobs)} tiles" + (f", {failed} failed" if failed else "")
            progress.update(0 if answer.reason else item.points)
            for out in users.get(item.tile, ()):
                _make_ready(out, waiting)
            if answer.reason:
                failures.append(answer.reason)
            else:
                good += 1
            if not good and len(failures) >= _HOPELESS and len(set(failures)) == 1:
                raise StageError(
                    f"the first {len(failures)} tiles all failed for one reason, so the run was stopped",
                    found=answer.reason,
                )


def _make_ready(out: FileJob, waiting: deque) -> None:
    """Put an output to work when the last of its tiles is there."""
    if out.state != "waiting" or any(job.state == "waiting" for job in out.jobs):
        return
    failed = [job for job in out.jobs if job.state == "failed"]
    if failed:
        others = f", and {len(failed) - 1} more of its tiles" if len(failed) > 1 else ""
        out.state, out.reason = "failed", f"tile {failed[0].name} failed{others}"
        if all(job.blocked_by for job in failed):
            out.blocked_by = failed[0].blocked_by
    else:
        out.state = "ready"
        waiting.appendleft(out)


@dataclass
class _Item:
    """A tile or a block of the rounds before, to be made."""

    at: tuple[int, int]
    name: str  #: of its file
    mark: str
    task: Callable[[], Callable[[], Any]]
    points: int = 0


def run_first_round(work: Worklist, store: Store, workers: Any, show: bool | None) -> None:
    """Make what tiles that are to be run need, but what an earlier run left; tiles near one that fails fail too.

    Raises
    ------
    StageError
        If all fail for one reason.
    """
    first, survey = work.plan.first, work.survey
    if first is None or len(work.jobs) == 1:
        store.forget_left()
        return
    grid, unit = survey.grid, survey.unit
    by_tile = {job.tile: job for job in work.jobs}
    blocks = blocks_of(first, grid, unit, by_tile)
    # An earlier run may have had other inputs.
    store.forget_left([job.name for job in work.jobs], blocks)
    running = [job for job in work.jobs if job.state == "waiting"]
    around = work.farthest * unit + first.blocks.around
    needed = {
        block
        for job in running
        for block in blocks_around(first, grid.box(job.tile), unit, around)
        if block in blocks
    }
    near = {block: list(tiles_around(first, grid, unit, block, by_tile)) for block in needed}
    tiles = [by_tile[tile] for tile in sorted({tile for found in near.values() for tile in found})]

    def fail(box: Box, around_m: float, reason: str) -> None:
        for job in running:
            wide = grid.box(job.tile, around_m / unit)
            apart = wide[0] > box[2] or wide[2] < box[0] or wide[1] > box[3] or wide[3] < box[1]
            if job.state == "waiting" and not apart:
                job.state, job.reason = "failed", reason

    def first_task(job: TileJob) -> Callable[[], Any]:
        sources = [s for s in survey.near(job.tile, halo) if s.path not in survey.unreadable]
        with_index = [work.with_index(s) for s in sources]
        return FirstRoundTask(context, first, job.tile, with_index, str(store.left(job.name))).run

    def block_task(block: tuple[int, int]) -> Callable[[], Any]:
        left = [str(store.left(by_tile[t].name)) for t in near[block] if t not in failed]
        return BlockTask(context.plan, block, left, str(store.block(block)), context.scratch).run

    halo = first.halo_m / unit
    context = work.context(store, workers.threads)
    before = work.plan.head[: first.at + 1]
    marks: dict[tuple[int, int], str] = {}
    items = []
    for job in tiles:
        sources = [s for s in survey.near(job.tile, halo) if s.path not in survey.unreadable]
        marks[job.tile] = fingerprint(
            build(),
            before,
            survey.stamps_of(before),
            [job.tile, grid.size, first.halo_m, unit, first.kept, first.blocks.side],
            [[s.path, survey.stamps[s.path], s.reader] for s in sources],
        )
        items.append(
            _Item(job.tile, left_file(job.name), marks[job.tile], partial(first_task, job), job.points)
        )
    failed: set[tuple[int, int]] = set()
    made = partial(_made, store=store, workers=workers, show=show, costs=survey.costs)
    for item, answer in made(items, "lowest points of cells"):
        if answer.reason:
            failed.add(item.at)
            fail(grid.box(item.at), first.far_m, answer.reason)
        else:
            work.messages_before.append(answer.result["messages"])
    items = []
    for block, found in sorted(near.items()):
        made_of = [marks[tile] for tile in found if tile not in failed]
        mark = fingerprint(build(), before[-1], unit, block, first.blocks.side, made_of)
        items.append(_Item(block, block_file(block), mark, partial(block_task, block)))
    for item, answer in made(items, "ground by blocks"):
        if answer.reason:
            x0, y0, x1, y1 = (side / unit for side in block_grid(first).box(item.at))
            fail((x0, y0, x1, y1), context.plan.halo_m + first.blocks.around, answer.reason)


def _made(
    items: list[_Item],
    what: str,
    *,
    store: Store,
    workers: Any,
    show: bool | None,
    costs: Costs,
) -> Iterator[tuple[_Item, TaskResult]]:
    """Do what is not there from an earlier run, and yield it; StageError where all fail for one reason."""
    waiting: deque[_Item] = deque()
    for item in items:
        known = store.finished(item.name)
        if known is None or known["fingerprint"] != item.mark or not os.path.exists(store.tiles / item.name):
            store.forget(item.name)
            waiting.append(item)
    count, failures = len(waiting), []
    points = sum(item.points for item in waiting)
    with Progress(points or count, what, "points" if points else "blocks", enabled=show) as progress:
        for item, answer in run_tasks(workers, waiting, lambda item: item.task()):
            costs.add("first_rounds", answer.cost)
            progress.update(item.points or 1)
            if answer.reason:
                failures.append(answer.reason)
            else:
                with contextlib.suppress(StageError, OSError):  # no room: a later run does it again
                    store.finish(item.name, item.mark, {})
            yield item, answer
    if count and len(failures) == count and len(set(failures)) == 1:
        raise StageError("all tiles failed for one reason, so the run was stopped", found=failures[0])
