"""Tasks handed out until all are done or given up: tiles, and outputs as soon as the last of their tiles is there."""

from __future__ import annotations

import contextlib
import math
import os
from collections import deque
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass

from ..base.errors import StageError
from ..base.progress import Progress
from ..base.version import build
from .firstround import FirstRoundTask
from .grid import TileGrid
from .outcome import FileJob, TileJob
from .pace import Pace
from .pool import Pool, last_tries
from .store import Store, fingerprint
from .worklist import Worklist

#: A run stops when so many tiles failed for one reason and none succeeded.
_HOPELESS = 10


def run_all(
    work: Worklist,
    store: Store,
    pool: Pool,
    retries: int,
    show: bool | None,
    finished: Callable[[TileJob | FileJob], None] | None = None,
) -> None:
    """Do all waiting tiles and outputs; their states, reports and reasons are set. `finished` hears of outputs.

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
    pace = Pace(
        total, sum(out.points for out in work.outputs if out.state in ("waiting", "ready")), pool.slots
    )
    failed = 0
    with Progress(total, f"{done} of {len(jobs)} tiles", enabled=show) as progress:
        for item, answer in last_tries(pool, waiting, work.tasks(store, pool.threads), retries):
            if answer.reason:
                item.state, item.reason = "failed", answer.reason
            else:
                item.state, item.report = "done", answer.result | answer.cost
                with contextlib.suppress(StageError, OSError):  # no room: a later run does it again
                    work.keep(store, item)
            if finished is not None and item.state == "done" and item.outputs:
                progress.clear()
                finished(item)
            kind = "tile" if isinstance(item, TileJob) else "output"
            pace.finished(kind, item.points, answer.cost.get("seconds", 0.0))
            progress.seconds_left = pace.seconds_left()
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
    """A tile of the round, to be done."""

    job: TileJob
    mark: str
    tries: int = 0


def run_first_round(work: Worklist, store: Store, pool: Pool, retries: int, show: bool | None) -> None:
    """Make what tiles that are to be run need, but what an earlier run left; tiles near one that fails fail too.

    Raises
    ------
    StageError
        If all fail for one reason.
    """
    first, survey = work.plan.first, work.survey
    store.forget_left([job.name for job in work.jobs])  # an earlier run may have had other inputs
    if first is None or len(work.jobs) == 1:
        return
    grid, halo_units = survey.grid, first.halo_m / survey.unit
    far = first.far_m / survey.unit
    by_tile = {job.tile: job for job in work.jobs}
    users: dict[tuple[int, int], list[TileJob]] = {}
    for job in work.jobs:
        if job.state == "waiting":
            for tile in _around(grid, job.tile, far, by_tile):
                users.setdefault(tile, []).append(job)
    waiting: deque[_Item] = deque()
    for tile in users:
        read = [s for s in survey.near(tile, halo_units) if s.path not in survey.unreadable]
        mark = fingerprint(
            build(),
            work.plan.head[: first.at + 1],
            survey.stamps_of(work.plan.head[: first.at + 1]),
            [tile, grid.size, first.halo_m, survey.unit],
            [[s.path, survey.stamps[s.path], s.reader] for s in read],
        )
        known = store.finished(_name(by_tile[tile].name))
        if (
            known is None
            or known["fingerprint"] != mark
            or not os.path.exists(store.left(by_tile[tile].name))
        ):
            store.forget(_name(by_tile[tile].name))
            waiting.append(_Item(by_tile[tile], mark))
    context = work.context(store, pool.threads)

    def task_of(item: _Item) -> FirstRoundTask:
        sources = [s for s in survey.near(item.job.tile, halo_units) if s.path not in survey.unreadable]
        with_index = [work.with_index(s) for s in sources]
        return FirstRoundTask(context, first, item.job.tile, with_index, str(store.left(item.job.name)))

    count, failures = len(waiting), []
    with Progress(
        sum(item.job.points for item in waiting), "lowest points of cells", enabled=show
    ) as progress:
        for item, answer in last_tries(pool, waiting, task_of, retries):
            progress.update(item.job.points)
            if answer.reason:
                failures.append(answer.reason)
                for job in users[item.job.tile]:
                    if job.state == "waiting":
                        job.state, job.reason = "failed", answer.reason
                continue
            with contextlib.suppress(StageError, OSError):  # no room: a later run does it again
                store.finish(_name(item.job.name), item.mark, {})
    if count and len(failures) == count and len(set(failures)) == 1:
        raise StageError("all tiles failed for one reason, so the run was stopped", found=failures[0])


def _name(tile: str) -> str:
    """What the store calls what is left of a tile."""
    return f"{tile}.first"


def _around(
    grid: TileGrid, tile: tuple[int, int], far: float, known: Collection[tuple[int, int]]
) -> Iterator[tuple[int, int]]:
    """The known tiles that a tile with surroundings of `far` touches."""
    reach = math.ceil(far / grid.size)
    if (2 * reach + 1) ** 2 > len(known):
        yield from (t for t in known if max(abs(t[0] - tile[0]), abs(t[1] - tile[1])) <= reach)
        return
    for j in range(tile[1] - reach, tile[1] + reach + 1):
        for i in range(tile[0] - reach, tile[0] + reach + 1):
            if (i, j) in known:
                yield i, j
