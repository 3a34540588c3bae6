"""The grid of tiles, the user's options of them, and the size that memory allows."""

from __future__ import annotations

import bisect
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..base import checks
from ..base.errors import OptionError, StageError
from ..base.memory import free_memory
from ..base.threads import available_threads
from ..stages.base import Blocks

#: Most tiles of a run.
MOST_TILES = 1_000_000
#: Larger column and row numbers are not exact.
_FARTHEST = 2.0**52

Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class TileGrid:
    """Square tiles of one size.

    Tile (i, j) holds ``i*size <= x - origin < (i+1)*size``, and likewise y.
    """

    size: float  #: side of a tile, in the unit of the coordinates
    #: A line of the grid, along either axis. Zero, so that tiles are the same in every run, but for
    #: a cloud that one tile can hold.
    origin: float = 0.0

    def index(self, coordinate: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the column or row of every coordinate, as int64 of the same shape.

        The edges decide, not the quotient: a point on an edge belongs to the tile it begins,
        whatever the division rounds to, so each point has exactly one tile.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            where = np.floor((coordinate - self.origin) / self.size)
        if where.size and not np.abs(where).max() < _FARTHEST:  # not finite too
            raise StageError(
                "coordinates are too large for tiles of this size",
                found=f"{coordinate[np.abs(where).argmax()]:g}, tiles of {self.size:g}",
                cure="Take larger tiles, or repair the coordinates",
            )
        where -= coordinate < where * self.size + self.origin
        where += coordinate >= (where + 1.0) * self.size + self.origin
        return where.astype(np.int64)

    def box(self, tile: tuple[int, int], halo_units: float = 0.0) -> Box:
        """Return (min x, min y, max x, max y) of a tile, grown on each side by a halo."""
        x0, y0, x1, y1 = (n * self.size + self.origin for n in (*tile, tile[0] + 1, tile[1] + 1))
        return x0 - halo_units, y0 - halo_units, x1 + halo_units, y1 + halo_units

    def scaled(self, by: float) -> TileGrid:
        """Return a grid of the same origin whose tiles are larger by a factor."""
        return TileGrid(self.size * by, self.origin)

    def name(self, tile: tuple[int, int]) -> str:
        """Return the south-west corner as text, e.g. ``500000_5400500``."""
        return "_".join(f"{n * self.size + self.origin:.10g}" for n in tile)

    def covering(self, box: Box) -> list[tuple[int, int]]:
        """Return the tiles that a box touches, row by row; StageError for too many."""
        x0, y0, x1, y1 = (int(self.index(np.array([v]))[0]) for v in box)
        check_number((x1 - x0 + 1) * (y1 - y0 + 1), f"bounds {box}, tiles of {self.size:g}")
        return [(i, j) for j in range(y0, y1 + 1) for i in range(x0, x1 + 1)]


def check_number(tiles: int, place: str) -> None:
    """Refuse more tiles than a run may have."""
    if tiles > MOST_TILES:
        raise StageError(
            f"more than {MOST_TILES:,} tiles",
            found=place,
            cure="Take larger tiles, or repair the bounding box in the header",
        )


def touching(boxes: list[Box] | NDArray[np.float64], box: Box) -> list[int]:
    """Return the numbers of the boxes that share a point with a box, edges included."""
    b = np.asarray(boxes, np.float64).reshape(-1, 4)
    return np.flatnonzero(((b[:, :2] <= box[2:]) & (b[:, 2:] >= box[:2])).all(axis=1)).tolist()


def inside(a: Box, b: Box) -> bool:
    """Return whether box a lies in box b."""
    return a[0] >= b[0] and a[1] >= b[1] and a[2] <= b[2] and a[3] <= b[3]


def union(boxes: list[Box] | NDArray[np.float64]) -> Box:
    """Return the box around boxes."""
    if not len(boxes):
        return (math.inf, math.inf, -math.inf, -math.inf)
    low = np.asarray(boxes)[:, :2].min(axis=0)
    high = np.asarray(boxes)[:, 2:].max(axis=0)
    return (float(low[0]), float(low[1]), float(high[0]), float(high[1]))


# ---- options and memory -------------------------------------------------------------------------

#: Ways to cut the output.
PER = ("file", "tile")
#: Largest side of a tile, in units of the coordinates, and buffer: more than the Earth's
#: circumference in feet.
LARGEST_TILE = 1e9
#: Smallest side of a tile, in units of the coordinates: a common step of coordinates, within which
#: points have one place.
SMALLEST_TILE = 1e-3
# The bytes of memory follow measured peaks of workers, which a run's report has as
# `peak_mb_of_a_worker`; docs/large-areas.md says how they add up.
#: Bytes of a worker for programs and model.
BASE = 350 << 20
#: Bytes of a point of a tile with its halo.
TILE_POINT = 285
#: Bytes of a point of an output file that is assembled.
FILE_POINT = 250
#: Bytes that our stages take for blocks of points, at most by default.
STAGES = 512 << 20
#: Bytes of a raster cell of a block of a far-reaching stage.
_CELL = 110
#: Larger output files are assembled in parts of this many points, so that memory does not grow with
#: the file.
MOST_AT_ONCE = 4_000_000
#: Bytes of the main process.
PARENT = 350 << 20
#: Most points of a tile of automatic size: larger ones gained nothing (docs/large-areas.md), a
#: failed tile is lost, and progress is counted in tiles.
_MOST_OF_A_TILE = 3_000_000
#: A square of a round before the last is as many times wider than its halo: what is read twice is
#: then about a half, as (1 + 2/8)² is 1.56.
_HALOS_OF_A_SQUARE = 8
#: Sides to choose from, in units of the coordinates: round numbers, from 1 to 8,000,000.
_SIDES = [
    mantissa * 10.0**power for power in range(7) for mantissa in (1, 1.5, 2, 2.5, 3, 4, 5, 6, 8)
]


@dataclass(frozen=True)
class TilingOptions:
    """Options of a run in tiles."""

    #: side of a tile, in the unit of the coordinates; by default as large as the memory allows
    tile: float | None = None
    workers: int | None = None  #: processes, 0 works in this one; default: one for every two cores
    #: address of a running Dask scheduler, ``tcp://host:8786``, instead of processes on this
    #: machine
    scheduler: str = ""
    #: what has an output of its own: each input ``file``, in its order of points, or each ``tile``
    per: str = "file"
    #: meters of halo for PDAL filters that look at neighbors, beside what our stages ask for
    buffer: float | None = None
    #: bytes for all local processes together, with a scheduler for each worker; default: half of
    #: the free memory
    memory: int | None = None
    resume: bool = False  #: keep what an earlier run finished
    #: with `resume`: replace outputs that were edited since they were written
    overwrite: bool = False
    #: most points of a tile that is read again with a wider halo (not tuned)
    most_points: int = 5_000_000

    def __post_init__(self) -> None:
        """Check the options; OptionError where they are wrong or contradict each other."""
        # 20 and 20.0 are one run
        if self.tile is not None:
            side = checks.number("--tile", self.tile, SMALLEST_TILE, LARGEST_TILE)
            object.__setattr__(self, "tile", side)
        if self.memory is not None:
            checks.whole("--memory", self.memory, 1, unit="bytes")
        if self.workers is not None:
            checks.whole("--workers", self.workers, 0, available_threads(), unit="cores")
        if self.workers is not None and self.scheduler:
            raise OptionError(
                "--workers starts processes on this machine, and --scheduler uses others",
                cure="Give one of them",
            )
        checks.one_of("--per", self.per, PER)
        if self.buffer is not None:
            checks.number("--buffer", self.buffer, 0, LARGEST_TILE, unit="meters")

    @property
    def local_workers(self) -> int:
        """Return the number of worker processes on this machine."""
        return max(1, available_threads() // 2) if self.workers is None else self.workers

    @property
    def threads(self) -> int:
        """Return the threads of each local worker, together not more than there are cores."""
        return max(1, available_threads() // max(1, self.local_workers))


@dataclass(frozen=True)
class Extent:
    """The extent of an input, according to its header."""

    count: int  #: points
    box: Box


@dataclass(frozen=True)
class Density:
    """Number and density of the inputs' points."""

    points: int
    largest: int  #: points of the largest input
    area: float  #: square units of the coordinates, of the inputs' boxes
    each: float  #: points per square unit, of the denser inputs
    box: Box  #: of all inputs

    @classmethod
    def measure(cls, extents: Iterable[Extent]) -> Density:
        """Return the density of inputs with these extents."""
        boxes = [(*extent.box, extent.count) for extent in extents if extent.count]
        x0, y0, x1, y1, count = np.array(boxes, np.float64).reshape(-1, 5).T
        with np.errstate(over="ignore"):  # of odd headers
            area = (x1 - x0) * (y1 - y0)
        each = count / np.maximum(area, 1e-6)
        # The density that a twentieth of all points exceed: a single odd file does not decide.
        order = np.argsort(-each)
        dense = each[order][20 * np.cumsum(count[order]) > count.sum()]
        return cls(
            int(count.sum()),
            int(count.max(initial=0)),
            float(area.sum()),
            float(dense[0]) if len(dense) else 0.0,
            union([box[:4] for box in boxes]),
        )

    def grid_around(self) -> TileGrid | None:
        """Return the grid of the smallest tiles of which one holds all inputs, if any does.

        Where the lines of a grid at zero cut the inputs, as coordinates on both sides of zero, the
        grid is shifted.
        """
        grids = (TileGrid(side, shift * side) for side in _SIDES for shift in (0.0, -0.5))
        for grid in grids:
            column, row = (grid.index(np.array(self.box[axis::2])) for axis in (0, 1))
            if column[0] == column[1] and row[0] == row[1]:
                return grid
        return None

    def is_fair(self, side: float) -> bool:
        """Return whether tiles of this side are not too large to be made at once."""
        return self.each * side**2 <= _MOST_OF_A_TILE

    @property
    def alone(self) -> int:
        """Return the points of the only tile of a small survey."""
        return self.points

    def read_by(self, side: float, halo_units: float) -> int:
        """Return the points of a tile of this side with its halo."""
        return min(self.points, math.ceil(self.each * (side + 2 * halo_units) ** 2))


def block_bytes(blocks: Blocks, area_m2: float) -> float:
    """Return the bytes of a block of a far-reaching stage, with at most `area_m2` of points."""
    return min((blocks.side + 2 * blocks.reach) ** 2, area_m2) / blocks.cell**2 * _CELL


def worker_bytes(points_read: float, largest_file: float, block: float = 0.0) -> float:
    """Return the bytes of a worker that reads so many points of a tile and of an output file.

    `block` is the result of :func:`block_bytes`.
    """
    assembled = min(largest_file, MOST_AT_ONCE) * FILE_POINT
    return BASE + max(points_read * TILE_POINT + STAGES, assembled, block)


def fits_whole(points: int, memory: int | None) -> bool:
    """Return whether a cloud fits into memory in one piece."""
    return BASE + STAGES + points * TILE_POINT <= (memory or free_memory() // 2)


def choose_tiles(
    options: TilingOptions, density: Density, halo_units: float, block: float = 0.0
) -> tuple[TilingOptions, TileGrid]:
    """Choose tiles and the number of workers that fit into memory, or refuse."""
    whole = options.memory or free_memory() // 2
    local = 0 if options.scheduler else options.local_workers
    fixed = options.workers is not None or local <= 1
    # Tiles with a few points at least, and not too many.
    fair = [side for side in _SIDES if density.is_fair(side)] or _SIDES[:1]
    sides = fair if options.tile is None else [options.tile]
    largest = density.largest if options.per == "file" else 0

    def needed(side: float) -> float:
        return worker_bytes(density.read_by(side, halo_units), largest, block)

    # A small survey in one tile needs neither surroundings nor rounds before.
    may_be_alone = options.tile is None and not options.scheduler
    small = 0 < density.points <= _MOST_OF_A_TILE
    alone = density.grid_around() if may_be_alone and small else None
    if alone is not None:
        free = whole - (PARENT if local else 0)
        if worker_bytes(density.alone, largest) <= free:
            workers = local if fixed else min(local, 1)
            return replace(options, tile=alone.size, workers=workers), alone
    for workers in [local] if fixed else range(local, 0, -1):
        room = (whole - PARENT) / workers if workers else whole
        fitting = [side for side in sides if needed(side) <= room]
        if not fitting:
            continue
        side = fitting[-1]
        if options.tile is None and workers > 1:  # some tiles for every worker
            few = math.sqrt(density.area / (3 * workers))
            side = max([each for each in fitting if each <= few] or fitting[:1])
        # Most of a small tile is halo, which costs as much: rather fewer workers.
        if side >= halo_units or side == sides[-1] or fixed or workers == 1:
            chosen = options.workers if options.scheduler else workers
            return replace(options, tile=side, workers=chosen), TileGrid(side)
    if options.memory is None and options.tile is not None:
        return options, TileGrid(options.tile)
    least = needed(sides[0]) * max(1, local if fixed else 1) + (PARENT if local else 0)
    raise OptionError(
        "there is not enough memory for tiles" + ("" if options.tile is None else " of this size"),
        found=f"{whole / 1e6:,.0f} MB; about {least / 1e6:,.0f} MB are needed",
        cure="Give more with --memory, or fewer --workers"
        + (", or a smaller --tile" if options.tile else ""),
    )


def tiles_per_square(
    options: TilingOptions, density: Density, side: float, halo_units: float
) -> int:
    """Return how many tiles of a `side` make the side of a square of rounds before the last.

    Its halo is wide, so squares are eight times as wide where as many points fit into the memory as
    a tile may have.
    """
    workers = max(1, options.local_workers)
    room = ((options.memory or free_memory() // 2) - PARENT) / workers - BASE - STAGES
    most = min(_MOST_OF_A_TILE, room / TILE_POINT)
    fair = math.sqrt(density.area / workers) if workers > 1 else math.inf  # one for each worker
    wide = math.ceil(_HALOS_OF_A_SQUARE * halo_units / side)
    fitting = bisect.bisect_right(
        range(1, wide + 1), most, key=lambda square: density.read_by(square * side, halo_units)
    )
    return max(1, min(fitting, int(min(wide, fair / side))))
