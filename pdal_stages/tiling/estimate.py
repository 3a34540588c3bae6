"""What a run would do, from the headers of its inputs alone: ``--dry-run``."""

from __future__ import annotations

from .file_task import MOST_AT_ONCE
from .outcome import TiledRun, TileJob
from .settings import TilingOptions
from .survey import Survey
from .tileplan import TilePlan, outputs_for

#: Memory of a worker, as docs/large-areas.md has it.
#: Programs and model, a tile's point, a file's point, and the `memory` option of our stages.
_BASE_MB, _TILE_BYTES, _FILE_BYTES, _BLOCKS_MB = 350, 350, 250, 512
#: Points a core does in a second, for the estimate of a dry run; the figure of the default features.
_RATE = 5_000


def estimate(plan: TilePlan, survey: Survey, options: TilingOptions) -> TiledRun:
    """Tiles and points as the headers tell."""
    grid, area = survey.grid, 0.0
    jobs = {tile: TileJob(tile, grid.name(tile), 0, []) for tile in survey.tiles()}
    for source in survey.sources:
        header = survey.extents.get(source.path)
        if header is None or not header.count:
            continue
        x0, y0, x1, y1 = header.box
        area += (x1 - x0) * (y1 - y0)
        for tile in grid.covering(header.box):
            a = grid.box(tile)
            wide = max(min(a[2], x1) - max(a[0], x0), 0.0) or (x1 == x0)
            high = max(min(a[3], y1) - max(a[1], y0), 0.0) or (y1 == y0)
            share = wide * high / (max(x1 - x0, 1e-9) * max(y1 - y0, 1e-9))
            jobs[tile].points += round(header.count * min(1.0, share))
            jobs[tile].sources.append(source)
    listed = list(jobs.values())
    names = [s.stem for s in survey.sources] if survey.per == "file" else [job.name for job in listed]
    outputs_for(plan, names, survey.paths)
    count = sum(header.count for header in survey.extents.values())
    side = grid.size + 2 * survey.halo
    read = min(count, round(count / area * side * side if area else 0.0))
    a_file = count / max(len(survey.extents), 1) if survey.per == "file" else 0
    held = max(read * _TILE_BYTES + _BLOCKS_MB * 2**20, min(a_file, MOST_AT_ONCE) * _FILE_BYTES)
    summary = survey.figures(plan) | {
        "workers": options.local_workers,
        "threads_per_worker": options.threads,
        "points": count,
        "points_of_largest_tile": max((job.points for job in listed), default=0),
        "points_read_by_a_tile": read,
        "memory_mb_of_a_worker": _BASE_MB + held / 2**20,
        "assumed_points_per_core_second": _RATE,
        "core_hours": count / _RATE / 3600,
        "states": {"waiting": len(listed)},
    }
    return TiledRun(listed, [], survey.unreadable, [], survey.notes, summary)
