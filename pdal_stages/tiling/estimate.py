"""Estimate a run before any point is read (``--dry-run``)."""

from __future__ import annotations

from .inputs import Survey
from .jobs import TiledRun, TileJob
from .options import worker_bytes
from .plan import TilePlan, outputs_for

# These estimate a dry run's need of disk; the true number depends on the dimensions of the stages.
#: Bytes on disk for the results of a point of each round.
_KEPT = 60
#: Bytes on disk for a cell of the raster of a far-reaching stage.
_KEPT_OF_CELL = 112


def estimate(plan: TilePlan, survey: Survey) -> TiledRun:
    """Estimate a run from the headers of inputs: tiles, points, memory and disk (``--dry-run``)."""
    grid, options, density = survey.grid, survey.options, survey.density
    tiles = [TileJob(grid.name(tile), points, tile) for tile, points in survey.tiles().items()]
    if options.per == "tile":
        outputs_for(plan, survey.paths, [job.name for job in tiles])
    count, read = density.points, density.read_by(grid.size, survey.halo_units)
    kept = float(count * _KEPT * len(plan.rounds))
    if plan.blocks is not None:
        kept += density.area * (survey.unit / plan.blocks.cell) ** 2 * _KEPT_OF_CELL
    largest = density.largest if options.per == "file" else 0
    summary = survey.figures(plan) | {
        "workers": options.local_workers,
        "threads_per_worker": options.threads,
        "points": count,
        "points_read_by_a_tile": read,
        "memory_mb_of_a_worker": worker_bytes(read, largest, survey.block_bytes) / 2**20,
        "disk_gb": kept / 1e9,
        "states": {"waiting": len(tiles)},
    }
    return TiledRun(tiles, [], survey.faults, [], [*map(str, survey.messages)], summary)
