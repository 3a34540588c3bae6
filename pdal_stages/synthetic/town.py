"""A generated town under a simulated flight: options, points, chunks."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from functools import lru_cache

import numpy as np

from ..base import checks
from ..base.errors import OptionError, suggest
from ..base.progress import Progress
from ..base.threads import map_blocks
from .districts import fill
from .flight import Flight
from .raycast import cast
from .solids import VEGETATION, build_scene
from .townplan import block_at, heights, plan_town

PULSES_PER_CHUNK = 60_000
SAMPLE = 20_000  # pulses that tell how many returns a pulse gives
SIDEWAYS = 45.0  # meters a beam may travel between the highest thing and the lowest ground
SPAN = 65.0  # meters a thing may stand out of its block: the wires to the next


def _option(default, what: str, low=None, high=None):
    return dataclasses.field(default=default, metadata={"low": low, "high": high, "what": what})


@dataclasses.dataclass(frozen=True)
class TownOptions:
    """How to make a town; wrong values raise an OptionError."""

    size: float = _option(200.0, "side of the square, meters", 20, 20_000)
    density: float = _option(7.0, "returns per square meter, met within a few per cent", 0.05, 500)
    seed: int = _option(1, "another number, another town", 0, 2**31 - 1)
    altitude: float = _option(350.0, "flying height, meters", 150, 4_000)
    scan_angle: float = _option(25.0, "half opening of the scanner, degrees", 3, 35)
    overlap: float = _option(0.3, "share of a swath seen twice", 0, 0.8)
    noise: float = _option(0.02, "standard deviation of a range, meters", 0, 0.5)
    origin: tuple = _option((500_000.0, 5_400_000.0, 60.0), "x, y of the low corner; height of the quays")
    srs: str = _option("EPSG:25832", "of files: EPSG:25828 to EPSG:25838, or none")

    def __post_init__(self) -> None:
        for option in dataclasses.fields(self)[:-2]:
            check = checks.whole if option.name == "seed" else checks.number
            limits = option.metadata["low"], option.metadata["high"]
            check(f"'{option.name}'", getattr(self, option.name), *limits)
        if np.shape(self.origin) != (3,):
            raise OptionError("'origin' must be three numbers: x, y, z", found=self.origin)
        for value in self.origin:
            checks.number("each of the three numbers of 'origin'", value)


@dataclasses.dataclass
class Town:
    """Points of a town (or of a chunk of one) with what is true about them."""

    xyz: np.ndarray  # (n, 3) float64: meters, multiples of 1 mm
    classification: np.ndarray  # (n,) uint8: true ASPRS class; 3, 4, 5: below 0.5 m, below 2 m, above
    intensity: np.ndarray  # (n,) uint16
    return_number: np.ndarray  # (n,) uint8
    number_of_returns: np.ndarray  # (n,) uint8
    gps_time: np.ndarray  # (n,) float64: adjusted standard GPS time, unique to each pulse
    point_source_id: np.ndarray  # (n,) uint16: the strip, from 1
    scan_angle: np.ndarray  # (n,) float32: degrees, positive to the right of the flight
    height_above_ground: np.ndarray  # (n,) float32: above the true bare ground; of water, its surface
    options: TownOptions

    def __len__(self) -> int:
        return len(self.xyz)

    x = property(lambda self: self.xyz[:, 0])
    y = property(lambda self: self.xyz[:, 1])
    z = property(lambda self: self.xyz[:, 2])

    def ground_height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """True height of the bare ground at any coordinates of the town (same system as ``xyz``)."""
        plan = plan_town(int(self.options.seed))
        local = np.column_stack([x, y]) - self.options.origin[:2] - self.options.size / 2
        return heights(local @ plan.turn, plan) + self.options.origin[2]


class FlownTown:
    """One town's plan, things and flight, ready to be cast part by part."""

    def __init__(self, options: TownOptions) -> None:
        self.options, self.plan = options, plan_town(int(options.seed))
        # Blocks are made when first needed; the latest ones are kept.
        self.block = lru_cache(1500)(lambda i, j: fill(self.plan, i, j))
        # The spacing that gives the wanted density: from the returns of a coarse flight over the middle of the town.
        sizes = min(options.size, 400.0), options.size
        trial, coarse = (Flight(options, size, size / math.sqrt(SAMPLE)) for size in sizes)
        returns = sum(len(self.town(trial, *part)) for part in trial.parts(SAMPLE))
        density = max(returns, 1) / trial.aimed(SAMPLE) * coarse.aimed(SAMPLE) / options.size**2
        self.flight = Flight(options, options.size, coarse.spacing * math.sqrt(density / options.density))

    def town(self, flight: Flight, strip: int, first: int, last: int) -> Town:
        """The points of some scan lines of a strip."""
        o, turn, plan = self.options, self.plan.turn, self.plan
        rng = np.random.default_rng([int(o.seed), strip, first, last])
        origin, direction, level, time, angle = flight.pulses(strip, first, last)
        origin, direction = (np.column_stack([a[:, :2] @ turn, a[:, 2]]) for a in (origin, direction))
        hits = np.zeros((0, 7))
        if len(origin):
            low, high = (level @ turn).min(axis=0) - SIDEWAYS, (level @ turn).max(axis=0) + SIDEWAYS
            (i0, j0, _), (i1, j1, _) = block_at(*(low - SPAN), plan), block_at(*(high + SPAN), plan)
            sites = [self.block(i, j) for i in range(i0, i1 + 1) for j in range(j0, j1 + 1)]
            hits = cast(origin, direction, build_scene(sites, low, high), plan, rng)
        pulse = hits[:, 6].astype(np.int64)
        # One error per pulse, mostly in height, so that its returns stay in order.
        xyz = hits[:, 1:4] + o.noise * (rng.standard_normal(origin.shape) * (0.5, 0.5, 1.0))[pulse]
        xyz[:, :2] = xyz[:, :2] @ turn.T + flight.size / 2
        mm = np.round(xyz * 1000.0)  # whole numbers, so that a file's coordinates are exactly these
        outside = (mm[:, :2] < 0).any(axis=1) | (mm[:, :2] >= 1000.0 * flight.size).any(axis=1)
        keep = ~np.isin(pulse, pulse[outside])  # a pulse has all its returns or none
        mm, pulse, distance, (code, echo) = mm[keep], pulse[keep], hits[keep, 0], hits[keep, 4:6].T
        above = mm[:, 2] / 1000.0 - heights((mm[:, :2] / 1000.0 - flight.size / 2) @ turn, plan)
        code = np.where(code == VEGETATION, np.select([above < 0.5, above < 2.0], [3, 4], 5), code)
        echo = 4000.0 * echo * (o.altitude / distance) ** 2 * np.exp(0.12 * rng.standard_normal(len(echo)))
        _, start, nth, count = np.unique(pulse, return_index=True, return_inverse=True, return_counts=True)
        return Town(
            xyz=(mm + np.round(np.array(o.origin) * 1000.0)) / 1000.0,
            classification=code.astype(np.uint8),
            intensity=np.clip(echo, 1, 65535).astype(np.uint16),
            return_number=(np.arange(len(pulse)) - start[nth] + 1).astype(np.uint8),
            number_of_returns=count[nth].astype(np.uint8),
            gps_time=time[pulse],
            point_source_id=np.full(len(pulse), strip + 1, dtype=np.uint16),
            scan_angle=angle[pulse].astype(np.float32),
            height_above_ground=above.astype(np.float32),
            options=o,
        )


def town_chunks(options: TownOptions, *, threads: int | None = None, progress: bool = True) -> Iterator[Town]:
    """The town piece by piece, in order of time, in memory that does not grow with its size.

    The pieces joined are exactly what :func:`make_town` gives for the same options.
    """
    flown = FlownTown(options)
    total, parts = int(options.density * options.size**2), flown.flight.parts(PULSES_PER_CHUNK)
    with Progress(total, "synthetic", enabled=progress) as line:
        for piece in map_blocks(lambda part: flown.town(flown.flight, *part), parts, threads):
            line.update(len(piece))
            yield piece


def make_town(size=200.0, density=7.0, seed=1, *, threads=None, progress=True, **changes) -> Town:
    """A generated town under a simulated flight, with true classes and heights.

    Pulses are cast as five sub-beams each through the solids of the town, so shadows, facades, roof edges with two
    returns and ground below trees come out as they do in a scan. Other options are the fields of :class:`TownOptions`;
    wrong ones raise an OptionError. The same options give the same points, whatever the number of threads.
    """
    known = [f.name for f in dataclasses.fields(TownOptions)]
    for name in set(changes) - set(known):
        cure = suggest(name, known) + f"The options are {', '.join(known)}"
        raise OptionError(f"unknown option '{name}'", where="synthetic", cure=cure)
    options = TownOptions(size, density, seed, **changes)
    pieces = list(town_chunks(options, threads=threads, progress=progress))
    names = [f.name for f in dataclasses.fields(Town)][:-1]
    columns: dict = {name: np.concatenate([getattr(piece, name) for piece in pieces]) for name in names}
    return Town(**columns, options=options)
