"""Tasks handed out until all are done or given up: tiles, and outputs as soon as the last of their tiles is there."""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable

from ..base.errors import StageError
from ..base.progress import Progress
from .outcome import FileJob, TileJob
from .pace import Pace
from .pool import Pool, last_tries
from .store import Store
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
    waiting: deque[TileJob | FileJob] = deque(job for job in jobs if job.state == "waiting")
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
