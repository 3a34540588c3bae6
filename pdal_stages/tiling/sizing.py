"""The size of tiles and the number of workers that a bound for memory allows."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

from ..base.errors import OptionError
from ..base.memory import free_memory
from ..stages.base import Blocks as StageBlocks
from .settings import TilingOptions
from .sources import Extent

#: Memory of a worker: programs and model, a point of a tile with its halo, a point of an output file that is put
#: together, and the `memory` option of our stages. See docs/large-areas.md.
BASE, TILE_POINT, FILE_POINT, BLOCKS = 350 << 20, 285, 250, 512 << 20
#: Of a point of a file that is trained on in one piece, voxels and samples' surroundings included.
TRAIN_POINT = 400
#: Of a cell of the raster of which a block is made before the tiles.
_CELL = 200
#: Blocks are at most so many times as wide as they would be by themselves: what is beyond gains little, and one takes long.
_WIDEST = 4
#: Of the process that hands out the work.
PARENT = 350 << 20
#: Points of a larger file are put together in parts of so many.
MOST_AT_ONCE = 4_000_000
#: Points of a tile at most where its size is chosen here: it is lost when it fails, and progress goes by tiles.
_MOST_OF_A_TILE = 3_000_000
#: Sides to choose from, in units of the coordinates: round numbers, from 1 to 800,000.
_SIDES = [
    round(mantissa * 10**power, 6) for power in range(0, 6) for mantissa in (1, 1.5, 2, 2.5, 3, 4, 5, 6, 8)
]


@dataclass(frozen=True)
class Density:
    """How many points the inputs have, and how close."""

    points: int
    largest: int  #: points of the largest input
    area: float  #: square units of the coordinates, of the inputs' boxes
    each: float  #: points a square unit, of the inputs that are dense among them

    @classmethod
    def of(cls, extents: Iterable[Extent]) -> Density:
        """Of inputs, as their headers tell."""
        rows = []
        for extent in extents:
            x0, y0, x1, y1 = extent.box
            if extent.count:
                rows.append(
                    (extent.count / max((x1 - x0) * (y1 - y0), 1e-6), extent.count, (x1 - x0) * (y1 - y0))
                )
        total, area = sum(row[1] for row in rows), sum(row[2] for row in rows)
        # The density that a twentieth of all points exceed: a single odd file does not decide.
        dense, beyond = 0.0, 0
        for each, count, _ in sorted(rows, reverse=True):
            dense, beyond = each, beyond + count
            if beyond * 20 > total:
                break
        return cls(total, max((row[1] for row in rows), default=0), area, dense)

    def read_by(self, side: float, halo_units: float) -> int:
        """Points of a tile of this side with its surroundings."""
        return min(self.points, math.ceil(self.each * (side + 2 * halo_units) ** 2))


def block_bytes(blocks: StageBlocks, area_m2: float) -> float:
    """Memory that a block takes which is made before the tiles, of so many square meters of points at most."""
    return min((blocks.side + 2 * blocks.reach) ** 2, area_m2) / blocks.cell**2 * _CELL


def widened(
    blocks: StageBlocks, area_m2: float, room: float, workers: int, most: float = math.inf
) -> StageBlocks:
    """Blocks of twice the side, and twice again, as far as a worker has room for one; their surroundings cost half as much.

    As long as each worker gets one, in a survey of so many square meters, up to a side of `most` meters. `room`: see
    :func:`room_of_worker`.
    """
    most = min(most, _WIDEST * blocks.side)
    while True:
        twice = blocks._replace(side=2 * blocks.side)
        if (
            twice.side > most
            or BASE + block_bytes(twice, area_m2) > room
            or workers * twice.side**2 > area_m2
        ):
            return blocks
        blocks = twice


def room_of_worker(options: TilingOptions) -> float:
    """Memory that each worker may take, bytes."""
    whole = options.memory or free_memory() // 2
    workers = 0 if options.scheduler else options.local_workers
    return (whole - PARENT) / workers if workers else whole


def worker_bytes(points_read: float, largest_file: float, block: float = 0.0) -> float:
    """Memory of a worker for tiles of so many points and outputs of so many; `block`: see :func:`block_bytes`."""
    of_file = min(largest_file, MOST_AT_ONCE) * FILE_POINT
    return BASE + max(points_read * TILE_POINT + BLOCKS, of_file, block)


def fits_whole(points: int, memory: int | None, point: int = TILE_POINT) -> bool:
    """Whether a cloud can be worked on in one piece, which takes so many bytes a point."""
    return BASE + BLOCKS + points * point <= (memory or free_memory() // 2)


def settled(
    options: TilingOptions, density: Density, halo_units: float, per_file: bool, block: float = 0.0
) -> TilingOptions:
    """The options with a side of tiles and a number of workers that the memory allows; the halo is in the coordinates' unit.

    Raises
    ------
    OptionError
        Where no tile fits.
    """
    whole = options.memory or free_memory() // 2
    largest = density.largest if per_file else 0
    local = 0 if options.scheduler else options.local_workers
    fixed = options.workers is not None or local <= 1
    sides = [options.tile] if options.tile is not None else _sides(density)
    for workers in [local] if fixed else range(local, 0, -1):
        room = (whole - PARENT) / workers if workers else whole
        fitting = [s for s in sides if worker_bytes(density.read_by(s, halo_units), largest, block) <= room]
        if not fitting:
            continue
        side = fitting[-1] if options.tile is not None else _enough(fitting, density, workers)
        # Most of a small tile is halo, which costs as much: rather fewer workers.
        if side >= halo_units or side == sides[-1] or fixed or workers == 1:
            return replace(options, tile=side, workers=options.workers if options.scheduler else workers)
    if options.memory is None and options.tile is not None:
        return options  # as it was asked for
    least = worker_bytes(density.read_by(sides[0], halo_units), largest, block) * max(
        1, local if fixed else 1
    )
    raise OptionError(
        "the memory does not suffice for tiles" + ("" if options.tile is None else " of this size"),
        found=f"{whole / 1e9:.1f} GB; about {(least + (PARENT if local else 0)) / 1e9:.1f} GB are needed",
        cure="Give more with --memory, or fewer --workers"
        + (", or a smaller --tile" if options.tile else ""),
    )


def _sides(density: Density) -> list[float]:
    """Sides worth trying: of tiles with a few points at least, and not too many."""
    fair = [s for s in _SIDES if density.each * s * s <= _MOST_OF_A_TILE]
    return fair or _SIDES[:1]


def _enough(sides: list[float], density: Density, workers: int) -> float:
    """The largest side that gives every worker some tiles."""
    if workers <= 1:
        return sides[-1]
    fair = math.sqrt(density.area / (3 * workers))
    return max([s for s in sides if s <= fair] or sides[:1])
