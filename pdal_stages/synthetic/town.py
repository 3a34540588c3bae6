"""A generated town under a simulated flight: options, points, a LAS or LAZ file."""

from __future__ import annotations

import dataclasses
import datetime
import math
import os
from functools import lru_cache
from pathlib import Path

import numpy as np

from ..base import checks
from ..base.errors import OptionError, StageError, suggest
from ..base.files import whole_files
from ..base.las import named_las
from ..base.progress import Progress
from ..base.settings import Settings, setting
from ..base.threads import map_blocks
from ..base.version import __version__
from .districts import fill
from .solids import VEGETATION, build_scene, cast
from .townplan import block_at, heights, plan_town

ALTITUDE, SPEED = 350.0, 60.0  # meters, meters a second
SCAN_ANGLE, OVERLAP = 25.0, 0.3  # half opening in degrees, share of a swath seen twice
TURN = 240.0  # seconds from the end of a strip to the start of the next
GPS_START = 270_000_000.0  # adjusted standard GPS time: April 2020
BESIDE = 25.0  # meters beyond the square that are flown as well: what stands outside throws shadows into it

PULSES_PER_CHUNK = 60_000
SAMPLE = 20_000  # pulses that tell how many returns a pulse gives
SIDEWAYS = 45.0  # meters a beam may travel between the highest thing and the lowest ground
SPAN = 65.0  # meters a thing may stand out of its block: the wires to the next

#: The reference system of a town's file.
WKT = (
    'PROJCS["ETRS89 / UTM zone 32N",GEOGCS["ETRS89",DATUM["European_Terrestrial_Reference_System_1989",'
    'SPHEROID["GRS 1980",6378137,298.257222101,AUTHORITY["EPSG","7019"]],AUTHORITY["EPSG","6258"]],'
    'PRIMEM["Greenwich",0,AUTHORITY["EPSG","8901"]],UNIT["degree",0.0174532925199433,AUTHORITY["EPSG","9122"]],'
    'AUTHORITY["EPSG","4258"]],PROJECTION["Transverse_Mercator"],PARAMETER["latitude_of_origin",0],'
    'PARAMETER["central_meridian",9],PARAMETER["scale_factor",0.9996],PARAMETER["false_easting",500000],'
    'PARAMETER["false_northing",0],UNIT["metre",1,AUTHORITY["EPSG","9001"]],AXIS["Easting",EAST],'
    'AXIS["Northing",NORTH],AUTHORITY["EPSG","25832"]]'
)


@dataclasses.dataclass(frozen=True)
class TownOptions(Settings):
    """How to make a town; wrong values raise an OptionError."""

    size: float = setting(200.0, "number", "Side of the square, meters", 20, 20_000)
    density: float = setting(
        7.0, "number", "Returns per square meter, met within a few per cent", 0.05, 500
    )
    seed: int = setting(1, "integer", "Another number, another town", 0, 2**31 - 1)
    noise: float = setting(0.02, "number", "Standard deviation of a range, meters", 0, 0.5)
    origin: tuple = (500_000.0, 5_400_000.0, 60.0)  #: x, y of the low corner; height of the quays

    def __post_init__(self) -> None:
        super().__post_init__()
        if np.shape(self.origin) != (3,):
            raise OptionError("'origin' must be three numbers: x, y, z", found=self.origin)
        for value in self.origin:
            checks.number("each of the three numbers of 'origin'", value)


@dataclasses.dataclass
class Town:
    """Points of a town (or of a chunk of one) with what is true about them."""

    xyz: np.ndarray  # (n, 3) float64: meters, multiples of 1 mm
    classification: (
        np.ndarray
    )  # (n,) uint8: true ASPRS class; 3, 4, 5: below 0.5 m, below 2 m, above
    intensity: np.ndarray  # (n,) uint16
    return_number: np.ndarray  # (n,) uint8
    number_of_returns: np.ndarray  # (n,) uint8
    gps_time: np.ndarray  # (n,) float64: adjusted standard GPS time, unique to each pulse
    point_source_id: np.ndarray  # (n,) uint16: the strip, from 1
    scan_angle: np.ndarray  # (n,) float32: degrees, positive to the right of the flight
    height_above_ground: (
        np.ndarray
    )  # (n,) float32: above the true bare ground; of water, its surface
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


class Flight:
    """Pulses over a square of `size` meters, `spacing` meters apart below the sensor."""

    def __init__(self, seed: int, size: float, spacing: float) -> None:
        self.size, self.spacing = size, spacing
        rng, half = np.random.default_rng([seed, 0xF117]), math.radians(SCAN_ANGLE)
        self.heading = math.radians(rng.uniform(70, 110))  # from east
        swath = 2.0 * ALTITUDE * math.tan(half)
        self.reach = (
            0.5 * size * (abs(math.cos(self.heading)) + abs(math.sin(self.heading))) + BESIDE
        )
        apart = swath * (1.0 - OVERLAP)
        # At least two strips, so that every town is seen from two sides.
        self.strips = max(2, math.ceil((2 * self.reach - swath * OVERLAP) / apart))
        self.across = (np.arange(self.strips) - 0.5 * (self.strips - 1)) * apart
        self.lines = math.ceil(2 * self.reach / spacing)
        self.per_line = math.ceil(2 * half * ALTITUDE / spacing)
        # A turning polygon: every line runs from right to left.
        self.angles = half - (np.arange(self.per_line) + 0.5) * (2 * half / self.per_line)

    def parts(self, pulses: int) -> list[tuple[int, int, int]]:
        """The flight in order of time: strip, first line, line after the last, with about so many pulses each."""
        step = max(1, int(pulses / min(self.per_line, 2 * self.reach / self.spacing)))
        firsts = range(0, self.lines, step)
        return [
            (strip, n, min(n + step, self.lines)) for strip in range(self.strips) for n in firsts
        ]

    def aimed(self, part: int) -> int:
        """How many of all pulses, made so many at a time, would meet level ground inside the square."""
        return sum(
            (np.abs(self.pulses(*p)[2]) < self.size / 2).all(axis=1).sum() for p in self.parts(part)
        )

    def pulses(self, strip: int, first: int, last: int) -> list[np.ndarray]:
        """The pulses of some scan lines of a strip that come near the square, in order of time.

        Origin (n, 3) in meters from the middle of the square at its mean height, unit direction (n, 3), place (n, 2)
        where the beam would meet level ground, GPS time in seconds, scan angle in degrees (right of the flight: positive).
        """
        forward = 1.0 - 2.0 * (strip % 2)
        left = self.across[strip] - forward * ALTITUDE * np.tan(self.angles)
        step = np.flatnonzero(np.abs(left) < self.reach + 5.0)
        line, step = np.repeat(np.arange(first, last), step.size), np.tile(step, last - first)
        angle, when = self.angles[step], (line + step / self.per_line) * (self.spacing / SPEED)
        # The aircraft drifts a little to the side, and its nose goes up and down.
        along = forward * (when * SPEED - self.reach) + 1.4 * np.sin(0.7 * when + 2.0 * strip)
        side = self.across[strip] + 1.5 * np.sin(0.23 * when + strip)
        c, s, out = math.cos(self.heading), math.sin(self.heading), -forward * np.sin(angle)
        origin = np.column_stack([along * c - side * s, along * s + side * c, 0 * along + ALTITUDE])
        direction = np.column_stack([-out * s, out * c, -np.cos(angle)])
        level = origin[:, :2] - ALTITUDE / direction[:, 2:] * direction[:, :2]
        near = (np.abs(level) < self.size / 2 + BESIDE).all(axis=1)
        time = GPS_START + strip * (2 * self.reach / SPEED + TURN) + when
        return [column[near] for column in (origin, direction, level, time, np.degrees(angle))]


class FlownTown:
    """One town's plan, things and flight, ready to be cast part by part."""

    def __init__(self, options: TownOptions) -> None:
        self.options, self.plan = options, plan_town(int(options.seed))
        # Blocks are made when first needed; the latest ones are kept.
        self.block = lru_cache(1500)(lambda i, j: fill(self.plan, i, j))
        # The spacing that gives the wanted density: from the returns of a coarse flight over the middle of the town.
        sizes = min(options.size, 400.0), options.size
        trial, coarse = (
            Flight(int(options.seed), size, size / math.sqrt(SAMPLE)) for size in sizes
        )
        returns = sum(len(self.town(trial, *part)) for part in trial.parts(SAMPLE))
        density = max(returns, 1) / trial.aimed(SAMPLE) * coarse.aimed(SAMPLE) / options.size**2
        self.flight = Flight(
            int(options.seed), options.size, coarse.spacing * math.sqrt(density / options.density)
        )

    def town(self, flight: Flight, strip: int, first: int, last: int) -> Town:
        """The points of some scan lines of a strip."""
        o, turn, plan = self.options, self.plan.turn, self.plan
        rng = np.random.default_rng([int(o.seed), strip, first, last])
        origin, direction, level, time, angle = flight.pulses(strip, first, last)
        origin, direction = (
            np.column_stack([a[:, :2] @ turn, a[:, 2]]) for a in (origin, direction)
        )
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
        echo = (
            4000.0
            * echo
            * (ALTITUDE / distance) ** 2
            * np.exp(0.12 * rng.standard_normal(len(echo)))
        )
        _, start, nth, count = np.unique(
            pulse, return_index=True, return_inverse=True, return_counts=True
        )
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
    flown, pieces = FlownTown(options), []
    with Progress(int(options.density * options.size**2), "synthetic", enabled=progress) as line:
        parts = flown.flight.parts(PULSES_PER_CHUNK)
        for piece in map_blocks(lambda part: flown.town(flown.flight, *part), parts, threads):
            line.update(len(piece))
            pieces.append(piece)
    names = [f.name for f in dataclasses.fields(Town)][:-1]
    columns: dict = {
        name: np.concatenate([getattr(piece, name) for piece in pieces]) for name in names
    }
    return Town(**columns, options=options)


def write_town(town: Town, path: str | os.PathLike) -> None:
    """Write a town to a LAS or LAZ file (by its suffix), whole or not at all."""
    import laspy

    target = Path(path)
    if not named_las(target):
        raise OptionError(
            "the output's name must end in .las or .laz", where="write_town", found=str(path)
        )
    if not len(town):
        raise StageError(
            "no pulse hit this town", where="synthetic", cure="Give a larger 'size' or 'density'"
        )
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, 0.001), np.floor(np.array(town.options.origin))
    header.creation_date = datetime.date(
        2020, 7, 1
    )  # fixed, so that the same town gives the same bytes
    header.system_identifier, header.generating_software = (
        "generated town",
        f"pdal-stages {__version__}",
    )
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    header.global_encoding.wkt = True
    header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "OGC WKT", WKT.encode() + b"\0"))
    las = laspy.LasData(header, laspy.ScaleAwarePointRecord.zeros(len(town), header=header))
    las.X, las.Y, las.Z = np.round((town.xyz - header.offsets) * 1000.0).astype(np.int32).T
    for name in (
        "classification",
        "intensity",
        "return_number",
        "number_of_returns",
        "gps_time",
        "point_source_id",
    ):
        las[name] = getattr(town, name)
    las["scan_angle"] = np.round(town.scan_angle / 0.006).astype(np.int16)
    with whole_files(target) as (part,), open(part, "wb") as file:
        las.write(file, do_compress=target.suffix.lower() == ".laz")
