"""What a run would do, from the headers of its inputs alone: ``--dry-run``."""

from __future__ import annotations

from .outcome import TiledRun, TileJob
from .sizing import Density, worker_bytes
from .survey import Survey
from .tileplan import TilePlan, outputs_for

#: For the estimate of a dry run, with the model that comes with the package: points of its own that a core does in a second,
#: and points that it only reads, as halo (benchmarks/tiling.py).
_RATE, _READ_RATE = 40_000, 250_000
#: Bytes that a run keeps of a point until its output is written.
_KEPT = 20
#: Bytes that the rounds before the tiles keep of a cell of a raster of 1,024 x 1,024, until all tiles are done.
_KEPT_OF_CELL = 82


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
    held = worker_bytes(read, density.largest if survey.per == "file" else 0)
    summary = survey.figures(plan) | {
        "workers": options.local_workers,
        "threads_per_worker": options.threads,
        "points": count,
        "points_of_largest_tile": max((job.points for job in listed), default=0),
        "points_read_by_a_tile": read,
        "memory_mb_of_a_worker": held / 2**20,
        "assumed_points_per_core_second": _RATE,
        "core_hours": (count / _RATE + _beside(listed, read) / _READ_RATE) / 3600,
        "disk_gb": (
            _kept_of_cells(plan, density.area * survey.unit**2) + count * _KEPT * (survey.per == "file")
        )
        / 1e9,
        "states": {"waiting": len(listed)},
    }
    return TiledRun(listed, [], survey.unreadable, [], survey.messages, summary)


def _kept_of_cells(plan: TilePlan, area: float) -> float:
    """Bytes that the rounds before the tiles keep of so many square meters."""
    return 0.0 if plan.first is None else area / (plan.first.blocks.side / 1024) ** 2 * _KEPT_OF_CELL


def _beside(tiles: list[TileJob], read: int) -> int:
    """Points that are read as surroundings, all tiles together."""
    return sum(max(0, read - tile.points) for tile in tiles)
