"""What a run would do, from the headers of its inputs alone: ``--dry-run``."""

from __future__ import annotations

from .outcome import TiledRun, TileJob
from .sizing import Density, worker_bytes
from .survey import Survey
from .tileplan import TilePlan, outputs_for

#: CPU seconds of a core for a point of a tile, for one that is only read around a tile, and for one in all other steps.
_OWN, _AROUND, _OTHER = 8.0e-6, 1.3e-6, 5.0e-6
#: Bytes that a run keeps of a point until its output is written.
_KEPT = 20
#: Bytes that the rounds before the tiles keep of a point, and of a cell of a raster of 1,024 x 1,024, until all tiles are
#: done.
_KEPT_BEFORE, _KEPT_OF_CELL = 24, 112


def estimate(plan: TilePlan, survey: Survey) -> TiledRun:
    """Tiles and points as the headers tell."""
    grid, options = survey.grid, survey.options
    jobs = {tile: TileJob(tile, grid.name(tile), 0, []) for tile in survey.tiles()}
    for source in survey.sources:
        header = survey.extents.get(source.path)
        if header is None or not header.count:
            continue
        x0, y0, x1, y1 = header.box
        for tile in grid.covering(header.box):
            a = grid.box(tile)
            wide = max(min(a[2], x1) - max(a[0], x0), 0.0) or (x1 == x0)
            high = max(min(a[3], y1) - max(a[1], y0), 0.0) or (y1 == y0)
            share = wide * high / (max(x1 - x0, 1e-9) * max(y1 - y0, 1e-9))
            jobs[tile].points += round(header.count * min(1.0, share))
            jobs[tile].sources.append(source)
    listed = list(jobs.values())
    names = survey.names if survey.per == "file" else [job.name for job in listed]
    outputs_for(plan, names, survey.paths)
    count = sum(header.count for header in survey.extents.values())
    density = Density.of(survey.extents.values())
    read = density.read_by(grid.size, survey.halo_units)
    held = worker_bytes(read, density.largest if survey.per == "file" else 0, survey.block_bytes)
    seconds = count * (_OWN + _OTHER) + sum(max(0, read - tile.points) for tile in listed) * _AROUND
    kept = count * _KEPT * (survey.per == "file") + _kept_before(plan, count, density.area * survey.unit**2)
    summary = survey.figures(plan) | {
        "workers": options.local_workers,
        "threads_per_worker": options.threads,
        "points": count,
        "points_of_largest_tile": max((job.points for job in listed), default=0),
        "points_read_by_a_tile": read,
        "memory_mb_of_a_worker": held / 2**20,
        "points_per_core_second": count / seconds if seconds else 0.0,
        "core_hours": seconds / 3600,
        "disk_gb": kept / 1e9,
        "states": {"waiting": len(listed)},
    }
    return TiledRun(listed, [], survey.unreadable, [], survey.messages, summary)


def _kept_before(plan: TilePlan, count: int, area: float) -> float:
    """Bytes that the rounds before the tiles keep of so many points on so many square meters."""
    if plan.first is None:
        return 0.0
    return count * _KEPT_BEFORE + area / plan.first.blocks.cell**2 * _KEPT_OF_CELL
