"""Generate a town under a simulated flight: options, flight, points, a LAS or LAZ file."""

from __future__ import annotations

import dataclasses
import datetime
import math
import os
from functools import lru_cache
from pathlib import Path

import numpy as np

from ..base import checks
from ..base.asprs import HIGH_VEGETATION, LOW_VEGETATION, MEDIUM_VEGETATION
from ..base.files import whole_files
from ..base.progress import Progress
from ..base.threads import map_blocks
from .districts import VEGETATION, fill
from .ray_casting import build_scene, cast
from .townplan import block_at, heights, plan_town

# A town's points depend on these: another value gives another town for the same seed.
#: Of the aircraft above the quays, meters; above all solids.
ALTITUDE = 350.0
#: Of the aircraft, meters a second.
SPEED = 60.0
#: Half the opening of the scanner, degrees.
SCAN_ANGLE = 25.0
#: Share of a swath that the next one covers as well.
OVERLAP = 0.3
#: From the end of a strip to the start of the next, seconds.
TURN = 240.0
#: Adjusted standard GPS time of the first pulse: April 2020.
GPS_START = 270_000_000.0
#: Flown beyond the square, meters: what stands outside throws shadows into it.
BESIDE = 25.0
#: Pulses cast at a time, about.
PULSES_PER_CHUNK = 60_000
#: Pulses of the trial that shows how many returns a pulse gives.
SAMPLE = 20_000
#: Farthest that a beam travels sideways from the highest solid to the lowest ground, meters: at
#: `SCAN_ANGLE` that is enough for 96 m between them. A wider angle or higher solids need more.
SIDEWAYS = 45.0
#: Side of the square over which the trial flies at most, meters.
TRIAL_SIZE = 400.0
#: Blocks that are kept for later scan lines; not tuned.
CACHED_BLOCKS = 1500
#: Intensity of a perfect reflector that faces the sensor at `ALTITUDE`.
FULL_INTENSITY = 4000.0
#: Standard deviation of the logarithm of intensities; not measured.
SPECKLE = 0.12
#: Heights below which vegetation is low, and medium, meters.
LOW_HEIGHT = 0.5
MEDIUM_HEIGHT = 2.0
#: Scan angles in a LAS file are whole numbers of this, degrees (LAS 1.4, point formats 6 to 10).
SCAN_ANGLE_STEP = 0.006
#: Farthest that a solid reaches out of its block, meters: wires to the next one.
SPAN = 65.0

#: Corner of a town, meters: x and y of the low corner, height of the quays.
ORIGIN = np.array([500_000.0, 5_400_000.0, 60.0])
#: Reference system of a town's file.
WKT = (
    'PROJCS["ETRS89 / UTM zone 32N",GEOGCS["ETRS89",'
    'DATUM["European_Terrestrial_Reference_System_1989",SPHEROID["GRS 1980",6378137,'
    '298.257222101]],PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]],'
    'PROJECTION["Transverse_Mercator"],PARAMETER["latitude_of_origin",0],'
    'PARAMETER["central_meridian",9],PARAMETER["scale_factor",0.9996],'
    'PARAMETER["false_easting",500000],PARAMETER["false_northing",0],UNIT["metre",1],'
    'AUTHORITY["EPSG","25832"]]'
)


@dataclasses.dataclass
class Town:
    """Points of a town, or of a part of it, with their true classes and heights."""

    xyz: np.ndarray  #: (n, 3) float64, meters, multiples of 1 mm
    classification: np.ndarray  #: (n,) uint8, ASPRS; 3, 4, 5: below 0.5 m, below 2 m, above
    intensity: np.ndarray  #: (n,) uint16
    return_number: np.ndarray  #: (n,) uint8
    number_of_returns: np.ndarray  #: (n,) uint8
    gps_time: np.ndarray  #: (n,) float64, adjusted standard GPS time, unique to each pulse
    point_source_id: np.ndarray  #: (n,) uint16, the strip, from 1
    scan_angle: np.ndarray  #: (n,) float32, degrees, positive to the right of the flight
    height_above_ground: np.ndarray  #: (n,) float32, above the bare ground or the water
    size: float  #: side of the square, meters
    seed: int

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.xyz)

    x = property(lambda self: self.xyz[:, 0])
    y = property(lambda self: self.xyz[:, 1])
    z = property(lambda self: self.xyz[:, 2])

    def ground_height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the true height of the bare ground at places (n,), in the system of ``xyz``."""
        plan = plan_town(self.seed)
        local = np.column_stack([x, y]) - ORIGIN[:2] - self.size / 2
        return heights(local @ plan.turn, plan) + ORIGIN[2]


class Flight:
    """Pulses over a square of `size` meters, `spacing` meters apart below the sensor."""

    def __init__(self, seed: int, size: float, spacing: float) -> None:
        self.size, self.spacing = size, spacing
        rng, half = np.random.default_rng([seed, 0xF117]), math.radians(SCAN_ANGLE)
        self.heading = math.radians(rng.uniform(70, 110))  # from east
        swath = 2.0 * ALTITUDE * math.tan(half)
        diagonal = abs(math.cos(self.heading)) + abs(math.sin(self.heading))
        self.reach = 0.5 * size * diagonal + BESIDE
        distance = swath * (1.0 - OVERLAP)
        # At least two strips, so that every town is seen from two sides.
        self.strips = max(2, math.ceil((2 * self.reach - swath * OVERLAP) / distance))
        self.across = (np.arange(self.strips) - 0.5 * (self.strips - 1)) * distance
        self.lines = math.ceil(2 * self.reach / spacing)
        self.per_line = math.ceil(2 * half * ALTITUDE / spacing)
        # A turning polygon: every line runs from right to left.
        self.angles = half - (np.arange(self.per_line) + 0.5) * (2 * half / self.per_line)

    def parts(self, pulses: int) -> list[tuple[int, int, int]]:
        """Return parts of about `pulses` pulses by time: strip, first line, end of lines."""
        step = max(1, int(pulses / min(self.per_line, 2 * self.reach / self.spacing)))
        firsts = range(0, self.lines, step)
        return [
            (strip, n, min(n + step, self.lines)) for strip in range(self.strips) for n in firsts
        ]

    def aimed(self, part: int) -> int:
        """Count the pulses that would meet level ground inside the square, `part` at a time."""
        return sum(
            (np.abs(self.pulses(*p)[2]) < self.size / 2).all(axis=1).sum() for p in self.parts(part)
        )

    def pulses(self, strip: int, first: int, last: int) -> list[np.ndarray]:
        """Return the pulses of scan lines of a strip that come near the square, in order of time.

        Returns
        -------
        origin : (n, 3)
            Meters from the middle of the square at the height of the quays.
        direction : (n, 3)
            Unit vectors.
        level : (n, 2)
            Places where the beams would meet level ground.
        time : (n,)
            GPS time, seconds.
        angle : (n,)
            Scan angle, degrees, positive to the right of the flight.
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
    """Plan, solids and flight of a town, ready to be cast part by part."""

    def __init__(self, size: float, density: float, seed: int, noise: float) -> None:
        self.seed, self.noise, self.plan = seed, noise, plan_town(seed)
        # Blocks are made when first needed; the latest ones are kept.
        self.block = lru_cache(CACHED_BLOCKS)(lambda i, j: fill(self.plan, i, j))
        # The returns of a coarse flight over the middle of the town give the spacing.
        sizes = min(size, TRIAL_SIZE), size
        trial, coarse = (Flight(seed, side, side / math.sqrt(SAMPLE)) for side in sizes)
        returns = sum(len(self.town(trial, *part)) for part in trial.parts(SAMPLE))
        coarse_density = max(returns, 1) / trial.aimed(SAMPLE) * coarse.aimed(SAMPLE) / size**2
        self.flight = Flight(seed, size, coarse.spacing * math.sqrt(coarse_density / density))

    def town(self, flight: Flight, strip: int, first: int, last: int) -> Town:
        """Return the points of some scan lines of a strip."""
        turn, plan = self.plan.turn, self.plan
        rng = np.random.default_rng([self.seed, strip, first, last])
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
        xyz = (
            hits[:, 1:4] + self.noise * (rng.standard_normal(origin.shape) * (0.5, 0.5, 1.0))[pulse]
        )
        xyz[:, :2] = xyz[:, :2] @ turn.T + flight.size / 2
        mm = np.round(xyz * 1000.0)  # so that a file holds exactly these
        outside = (mm[:, :2] < 0).any(axis=1) | (mm[:, :2] >= 1000.0 * flight.size).any(axis=1)
        keep = ~np.isin(pulse, pulse[outside])  # a pulse has all its returns or none
        mm, pulse, distance, (code, echo) = mm[keep], pulse[keep], hits[keep, 0], hits[keep, 4:6].T
        above = mm[:, 2] / 1000.0 - heights((mm[:, :2] / 1000.0 - flight.size / 2) @ turn, plan)
        lower = [above < LOW_HEIGHT, above < MEDIUM_HEIGHT]
        plants = np.select(lower, [LOW_VEGETATION, MEDIUM_VEGETATION], HIGH_VEGETATION)
        code = np.where(code == VEGETATION, plants, code)
        speckle = np.exp(SPECKLE * rng.standard_normal(len(echo)))
        echo = FULL_INTENSITY * echo * (ALTITUDE / distance) ** 2 * speckle
        _, start, nth, count = np.unique(
            pulse, return_index=True, return_inverse=True, return_counts=True
        )
        return Town(
            xyz=(mm + ORIGIN * 1000.0) / 1000.0,
            classification=code.astype(np.uint8),
            intensity=np.clip(echo, 1, 65535).astype(np.uint16),
            return_number=(np.arange(len(pulse)) - start[nth] + 1).astype(np.uint8),
            number_of_returns=count[nth].astype(np.uint8),
            gps_time=time[pulse],
            point_source_id=np.full(len(pulse), strip + 1, dtype=np.uint16),
            scan_angle=angle[pulse].astype(np.float32),
            height_above_ground=above.astype(np.float32),
            size=flight.size,
            seed=self.seed,
        )


def make_town(
    size: float = 200.0,
    density: float = 7.0,
    seed: int = 1,
    *,
    noise: float = 0.02,
    threads: int | None = None,
    progress: bool | None = True,
) -> Town:
    """Return a generated town under a simulated flight, with true classes and heights.

    Pulses are cast as five sub-beams each through the solids of the town, so shadows, facades, roof
    edges with two returns and ground below trees come out as they do in a scan. The same options
    give the same points, whatever the number of threads.

    Parameters
    ----------
    size : float
        Side of the square, meters, 20 to 20,000.
    density : float
        Returns per square meter, 0.05 to 500; met within a few per cent.
    seed : int
        Another number, another town.
    noise : float
        Standard deviation of a range, meters, 0 to 0.5.
    threads : int, optional
    progress : bool, optional
        Whether to show progress on stderr.
    """
    size = checks.number("'size'", size, 20, 20_000, unit="m")
    density = checks.number("'density'", density, 0.05, 500, unit="points/m2")
    seed = checks.whole("'seed'", seed, 0, 2**31 - 1)
    noise = checks.number("'noise'", noise, 0, 0.5, unit="m")
    flown, pieces = FlownTown(size, density, seed, noise), []
    with Progress(int(density * size**2), "synthetic", enabled=progress) as line:
        parts = flown.flight.parts(PULSES_PER_CHUNK)
        for piece in map_blocks(lambda part: flown.town(flown.flight, *part), parts, threads):
            line.update(len(piece))
            pieces.append(piece)
    names = [f.name for f in dataclasses.fields(Town) if f.name not in ("size", "seed")]
    columns = {name: np.concatenate([getattr(each, name) for each in pieces]) for name in names}
    return Town(**columns, size=size, seed=seed)


def write_town(town: Town, path: str | os.PathLike) -> None:
    """Write a town to a LAS or LAZ file (by its suffix), whole or not at all."""
    import laspy

    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, 0.001), ORIGIN
    # A fixed date, so that the same town gives the same bytes.
    header.creation_date = datetime.date(2020, 7, 1)
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    header.global_encoding.wkt = True
    header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "OGC WKT", WKT.encode() + b"\0"))
    las = laspy.LasData(header, laspy.ScaleAwarePointRecord.zeros(len(town), header=header))
    las.xyz = town.xyz
    names = "classification intensity return_number number_of_returns gps_time point_source_id"
    for name in names.split():
        las[name] = getattr(town, name)
    las["scan_angle"] = np.round(town.scan_angle / SCAN_ANGLE_STEP).astype(np.int16)
    with whole_files(path) as (part,), open(part, "wb") as file:
        las.write(file, do_compress=Path(path).suffix.lower() == ".laz")
