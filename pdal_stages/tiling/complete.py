"""A run that is complete, told again from what the file system says of its files: without reading any of them.

What is compared is stricter than what ``--resume`` asks for otherwise: that no input was touched since, to its change time
and its place on the disk. Where one was, the run looks into everything as usual.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from typing import Any

from ..base.version import build
from ..pipeline.filenames import named_files
from .outcome import TiledRun
from .settings import TilingOptions
from .sources import InputSource, find_sources
from .store import Store, fingerprint
from .tileplan import TilePlan
from .worklist import Worklist


def remember(store: Store, plan: TilePlan, options: TilingOptions, work: Worklist) -> list[str]:
    """Note that all of a run is done, if it is; the files that changed meanwhile."""
    # Before it is asked what changed: so it is noted as it was, or not at all.
    now = _state(plan, options, work.survey.sources)
    changed = work.survey.changed()
    items = [*work.jobs, *work.outputs]
    missing = any(item.state not in ("done", "kept") for item in items)
    if now is None or changed or missing or work.survey.unreadable:
        return changed
    names = [out.source.key for out in work.outputs] or [job.name for job in work.jobs if job.outputs]
    figures = work.survey.figures(plan)
    store.keep_complete(
        {
            "state": now,
            "tiles": len(work.jobs),
            "outputs": names,
            "tile": work.survey.grid.size,
            "figures": figures,
        }
    )
    return changed


def told_again(store: Store, plan: TilePlan, options: TilingOptions) -> TiledRun | None:
    """What there is to say of a run of which nothing is left to be done; None where something may be."""
    started = time.monotonic()
    known = store.complete()
    if known is None or (options.tile is not None and options.tile != known["tile"]):
        return None
    if known["state"] != _state(plan, options, find_sources(plan.readers)):
        return None
    if not all(store.written(name) for name in known["outputs"]):
        return None
    seconds = time.monotonic() - started
    summary: dict[str, Any] = {
        **known["figures"],
        "workers": 0,
        "threads_per_worker": 0,
        "points": 0,
        "points_read": 0,
        "dropped": 0,
        "seconds": seconds,
        "points_per_second": 0.0,
        "cpu_seconds": 0.0,
        "cpu_seconds_by_step": {},
        "peak_mb_of_a_worker": 0.0,
        "states": {"done": 0, "kept": known["tiles"], "failed": 0},
        "classes": {},
        "left_alone": {},
    }
    message = f"nothing is to be done: all of {len(known['outputs']):,} outputs are as the last run left them"
    return TiledRun([], [], {}, [], [message], summary)


def _state(plan: TilePlan, options: TilingOptions, sources: Sequence[InputSource]) -> str | None:
    """A digest of what decides a run, with what the file system says of its files; None where that cannot be known."""
    files = []
    for path in [*(source.path for source in sources), *named_files([*plan.head, *plan.tail])]:
        try:
            status = os.stat(path)
        except OSError:
            return None  # on a server
        files.append([path, status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino])
    readers = sorted({fingerprint(source.reader) for source in sources})
    done = [plan.head, plan.tail, plan.creates, plan.beside, plan.whole_names, readers]
    return fingerprint(build(), done, options.per, options.most_points, [plan.halo_m, plan.sees_m], files)
