"""Scan the generated town from simulated flight strips: options, returns, a LAS or LAZ file."""

from __future__ import annotations

import dataclasses
import datetime
import functools
import itertools
import math
import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..base import checks
from ..base.asprs import GROUND, HIGH_VEGETATION, LOW_VEGETATION, MEDIUM_VEGETATION
from ..base.files import whole_files
from ..base.progress import Progress
from ..base.threads import map_blocks
from .blocks import HIGHEST, PITCH, VEGETATION, Solid, TownBlock, cover, ground

# A town's points depend on these: another value gives another town for the same seed.
#: Of the aircraft above the middle of the heights, meters.
ALTITUDE = 200.0
#: From the line below a strip to the next one, meters.
STRIP_SPACING = 130.0
#: From the line below a strip to the strip's edges, meters.
SWATH_HALF = 93.0
#: Of the aircraft, meters a second.
SPEED = 60.0
#: From the start of a strip to the start of the next, seconds.
STRIP_SECONDS = 1000.0
#: Adjusted standard GPS time of the first pulse: April 2020.
GPS_START = 270_000_000.0
#: Flown beyond the square, meters: beams of these pulses reach into it.
BESIDE = 25.0
#: Pulses on a side of the trial that shows how many returns a pulse gives.
TRIAL = 100
#: From town coordinates (u, v) to meters east and north: edges of tiles are no walls.
TURN = np.array([[math.cos(0.15), -math.sin(0.15)], [math.sin(0.15), math.cos(0.15)]])
#: Returns closer than that are one, meters: half the length of a pulse of 4 ns.
SEPARATION = 0.6
#: Most returns of a pulse.
MAX_RETURNS = 5
#: Share of pulses that end at a leaf or a wire that they meet.
ENDING = 0.35
#: Half the width of a beam, meters: as near it meets a wire.
BEAM_HALF = 0.12
#: Sag of a wire in its middle, as a share of its length.
SAG = 0.02
#: Steepest beam, meters across a meter of height.
STEEPEST = SWATH_HALF / ALTITUDE
#: Intensity of a perfect reflector.
FULL_INTENSITY = 4000.0
#: Standard deviation of the logarithm of intensities; not measured.
SPECKLE = 0.12
#: Heights below which vegetation is low, and medium, meters.
LOW_HEIGHT = 0.5
MEDIUM_HEIGHT = 2.0
#: Scan angles in a LAS file are whole numbers of this, degrees (LAS 1.4, point formats 6 to 10).
SCAN_ANGLE_STEP = 0.006

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
        uv = (np.column_stack([x, y]) - ORIGIN[:2]) @ TURN
        return ground(uv, self.seed) + ORIGIN[2]


@dataclasses.dataclass
class Pulses:
    """Pulses that are aimed at one block; a beam is at ``place + z * drift`` at height z."""

    place: NDArray[np.float64]  #: (n, 2) town coordinates at height 0
    drift: NDArray[np.float64]  #: (n, 2) meters across a meter of height
    time: NDArray[np.float64]  #: (n,) GPS time, seconds
    strip: NDArray[np.uint16]  #: (n,) from 1
    angle: NDArray[np.float64]  #: (n,) degrees

    def at(self, rows: NDArray, z: NDArray | float) -> NDArray[np.float64]:
        """Return the places (m, 2) of some beams at heights (m,)."""
        return self.place[rows] + self.drift[rows] * np.reshape(z, (-1, 1))


def pulses_at(i: int, j: int, size: float, spacing: float) -> Pulses:
    """Return the pulses of all strips that are aimed at a block, `spacing` meters apart."""
    corners = PITCH * np.array([(i + p, j + q) for p in (0, 1) for q in (0, 1)]) @ TURN.T
    low, high = np.maximum(corners.min(0), -BESIDE), np.minimum(corners.max(0), size + BESIDE)
    parts = []
    for strip in range(math.ceil((size + 2 * BESIDE) / STRIP_SPACING)):
        middle = STRIP_SPACING * (strip + 0.3)
        west, east = max(low[0], middle - SWATH_HALF), min(high[0], middle + SWATH_HALF)
        column, line = (
            np.arange(math.ceil(a / spacing), max(math.ceil(b / spacing), math.ceil(a / spacing)))
            for a, b in ((west, east), (low[1], high[1]))
        )
        column, line = (axis.ravel() for axis in np.meshgrid(column, line))
        mixed = column * 12.9898 + line * 78.233 + strip  # a pulse has one place in all blocks
        odd = np.sin(np.column_stack([mixed, mixed + 1.0])) * 43758.5453 % 1.0 - 0.5
        xy = (np.column_stack([column, line]) + odd) * spacing
        drift = np.column_stack([(middle - xy[:, 0]) / ALTITUDE, np.zeros(len(xy))])
        across = (column * spacing - middle + STRIP_SPACING) / (2 * STRIP_SPACING)  # 0 to 1
        time = GPS_START + strip * STRIP_SECONDS + (line + across) * spacing / SPEED
        angle = np.degrees(np.arctan2(xy[:, 0] - middle, ALTITUDE))
        number = np.full(len(xy), strip + 1, np.uint16)
        parts.append((xy @ TURN, drift @ TURN, time, number, angle))
    columns = Pulses(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    inside = (np.floor(columns.place / PITCH) == (i, j)).all(axis=1)
    return Pulses(*(getattr(columns, f.name)[inside] for f in dataclasses.fields(columns)))


def crossing(solid: Solid, pulses: Pulses, rows: NDArray) -> tuple[NDArray, NDArray]:
    """Return the heights at which some beams enter and leave a solid; it is missed if not above."""
    drift, away = pulses.drift[rows], pulses.place[rows] - solid.middle
    if solid.shape == "wire":
        length, enter = 2 * solid.half[0], np.full(len(rows), solid.low)
        for _ in range(3):  # the beam's place follows from the height, and the height from it
            along = (away[:, 0] + enter * drift[:, 0]) / length + 0.5
            sag = 4 * SAG * length * along * (1 - along)
            enter = solid.low + along * (solid.high - solid.low) - sag
        hit = (along > 0) & (along < 1) & (abs(away[:, 1] + enter * drift[:, 1]) < BEAM_HALF)
        return enter, np.where(hit, enter - 0.1, np.inf)
    if solid.shape == "ball":  # |place| = 1, where the ball has the radius 1
        half = np.array([*solid.half, 0.5 * (solid.high - solid.low)])
        start = np.column_stack([away, np.full(len(rows), -0.5 * (solid.low + solid.high))]) / half
        step = np.column_stack([drift, np.ones(len(rows))]) / half
        a, b, c = (step**2).sum(1), (start * step).sum(1), (start**2).sum(1) - 1.0
        root = b * b - a * c
        missed = root <= 0
        root = np.sqrt(np.maximum(root, 0.0))
        return (root - b) / a, np.where(missed, np.inf, (-root - b) / a)
    enter, leave = np.full(len(rows), solid.high), np.full(len(rows), solid.low)
    for axis in (0, 1):
        slope = np.where(abs(drift[:, axis]) < 1e-9, 1e-9, drift[:, axis])
        ends = [(side * solid.half[axis] - away[:, axis]) / slope for side in (-1, 1)]
        enter, leave = np.minimum(enter, np.maximum(*ends)), np.maximum(leave, np.minimum(*ends))
        for pitch in (solid.pitch[axis], -solid.pitch[axis]) if solid.pitch[axis] else ():
            roof = (solid.peak[axis] - pitch * away[:, axis]) / (1 + pitch * drift[:, axis])
            enter = np.minimum(enter, roof)
    return enter, leave


@dataclasses.dataclass
class Returns:
    """Returns of pulses, in order of the pulse and from the top down."""

    pulse: NDArray[np.int64]  #: (n,) row of the pulse
    z: NDArray[np.float64]  #: (n,)
    code: NDArray[np.int64]  #: (n,) class, or VEGETATION
    reflectance: NDArray[np.float64]  #: (n,)
    passes: NDArray[np.bool_]  #: (n,) whether a part of the beam goes on

    def only(self, kept: NDArray) -> Returns:
        """Return some of the returns, by a mask or in an order."""
        return Returns(*(getattr(self, f.name)[kept] for f in dataclasses.fields(self)))

    def earlier(self, counted: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Count, for each return, the earlier ones of its pulse for which a mask holds."""
        total: NDArray[np.int64] = np.cumsum(counted) - counted
        return total - total[np.searchsorted(self.pulse, self.pulse)]


def cast(pulses: Pulses, solids: list[Solid], seed: int, rng: np.random.Generator) -> Returns:
    """Return the returns of pulses from the ground and solids."""
    every = np.arange(len(pulses.place))
    z = np.zeros(len(every))
    for _ in range(6):  # slopes are gentle, so steps converge
        z = ground(pulses.at(every, z), seed)
    reflectance, grass = cover(pulses.at(every, z))
    grass *= rng.random(len(every))
    grass[grass < 0.08] = 0.0
    code = np.where(grass > 0, VEGETATION, GROUND)
    met = [(every, z + grass, code, reflectance, np.zeros(len(every), bool))]
    level = float(np.mean(z)) if len(z) else 0.0
    places = pulses.at(every, level)
    order = np.argsort(places[:, 0])
    u, v = places[order].T
    for solid in solids:
        reach = STEEPEST * max(abs(solid.low - level), abs(solid.high - level)) + 1.0
        (west, south), (east, north) = np.array(solid.middle) + np.outer((-1, 1), solid.half)
        first, last = np.searchsorted(u, (west - reach, east + reach))
        beside = (v[first:last] > south - reach) & (v[first:last] < north + reach)
        near = order[first:last][beside]
        if not len(near):
            continue
        enter, leave = crossing(solid, pulses, near)
        hit = enter > leave
        if solid.extinction:  # Beer and Lambert
            enter = enter - rng.exponential(1 / solid.extinction, len(near))
            hit &= enter > leave
        passes = solid.extinction > 0 or solid.shape == "wire"
        rest = (np.full(hit.sum(), value) for value in (solid.code, solid.reflectance, passes))
        met.append((near[hit], enter[hit], *rest))
    returns = Returns(*(np.concatenate(column) for column in zip(*met, strict=True)))
    returns = returns.only(np.lexsort((-returns.z, returns.pulse)))
    ends = ~returns.passes | (rng.random(len(returns.z)) < ENDING)
    returns = returns.only(returns.earlier(ends) == 0)
    same = np.diff(returns.pulse, prepend=-1) == 0
    same &= np.diff(returns.z, prepend=np.inf) > -SEPARATION
    returns = returns.only(~same)
    return returns.only(returns.earlier(np.full(len(returns.z), True)) < MAX_RETURNS)


class FlownTown:
    """Blocks and flight of a town, ready to be scanned block by block."""

    def __init__(self, size: float, seed: int, noise: float) -> None:
        self.size, self.seed, self.noise = size, seed, noise
        corners = np.array([(x, y) for x in (0, size) for y in (0, size)], float) @ TURN
        (i0, j0), (i1, j1) = (
            np.floor(edge / PITCH).astype(int).tolist()
            for edge in (corners.min(0) - BESIDE, corners.max(0) + BESIDE)
        )
        self.aimed = list(itertools.product(range(i0, i1 + 1), range(j0, j1 + 1)))
        self.block = functools.lru_cache(1500)(lambda i, j: TownBlock(seed, i, j).solids)

    def solids(self, i: int, j: int) -> list[Solid]:
        """Return the solids that beams at a block may meet."""
        edge = STEEPEST * HIGHEST
        low, high = np.array([i, j]) * PITCH - edge, np.array([i + 1, j + 1]) * PITCH + edge
        near = itertools.product((i - 1, i, i + 1), (j - 1, j, j + 1))
        listed = itertools.chain.from_iterable(self.block(*each) for each in near)
        return [
            s
            for s in listed
            if ((np.array(s.middle) + s.half > low) & (np.array(s.middle) - s.half < high)).all()
        ]

    def scan(self, i: int, j: int, spacing: float) -> Town:
        """Return the points of the pulses that are aimed at a block."""
        rng = np.random.default_rng([self.seed, i + 2**20, j + 2**20, 1])
        pulses = pulses_at(i, j, self.size, spacing)
        returns = cast(pulses, self.solids(i, j), self.seed, rng)
        xyz = np.column_stack([pulses.at(returns.pulse, returns.z) @ TURN.T, returns.z])
        # One error per pulse, mostly in height, so that its returns stay in order.
        error = rng.standard_normal((len(pulses.place), 3)) * (0.5, 0.5, 1.0)
        mm = np.round((xyz + self.noise * error[returns.pulse]) * 1000.0)  # as a file holds them
        outside = (mm[:, :2] < 0).any(axis=1) | (mm[:, :2] >= 1000.0 * self.size).any(axis=1)
        keep = ~np.isin(
            returns.pulse, returns.pulse[outside]
        )  # a pulse has all its returns or none
        returns, mm = returns.only(keep), mm[keep]
        above = mm[:, 2] / 1000.0 - ground(mm[:, :2] / 1000.0 @ TURN, self.seed)
        lower = [above < LOW_HEIGHT, above < MEDIUM_HEIGHT]
        plants = np.select(lower, [LOW_VEGETATION, MEDIUM_VEGETATION], HIGH_VEGETATION)
        number = returns.earlier(np.full(len(above), True)) + 1
        count = np.bincount(returns.pulse, minlength=len(pulses.place))[returns.pulse]
        echo = FULL_INTENSITY * returns.reflectance / count
        echo *= np.exp(SPECKLE * rng.standard_normal(len(echo)))
        return Town(
            xyz=(mm + ORIGIN * 1000.0) / 1000.0,
            classification=np.where(returns.code == VEGETATION, plants, returns.code).astype(
                np.uint8
            ),
            intensity=np.clip(echo, 1, 65535).astype(np.uint16),
            return_number=number.astype(np.uint8),
            number_of_returns=count.astype(np.uint8),
            gps_time=pulses.time[returns.pulse],
            point_source_id=pulses.strip[returns.pulse],
            scan_angle=pulses.angle[returns.pulse].astype(np.float32),
            height_above_ground=above.astype(np.float32),
            size=self.size,
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
    """Return a generated town, scanned from flight strips, with true classes and heights.

    Beams are slanted, so there are facades and shadows; leaves and wires let a part of them
    through, so pulses have up to five returns. The same options give the same points, whatever the
    number of threads.

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
    flown = FlownTown(size, seed, noise)

    def scan(spacing: float, shown: bool | None) -> list[Town]:
        pieces = []
        with Progress(len(flown.aimed), "synthetic", enabled=shown) as line:
            for piece in map_blocks(
                lambda at: flown.scan(at[0], at[1], spacing), flown.aimed, threads
            ):
                line.update(1)
                pieces.append(piece)
        return pieces

    trial = size / TRIAL
    count = sum(len(piece) for piece in scan(trial, False))
    pieces = scan(trial * math.sqrt(count / size**2 / density), progress)
    names = [f.name for f in dataclasses.fields(Town) if f.name not in ("size", "seed")]
    columns = {name: np.concatenate([getattr(each, name) for each in pieces]) for name in names}
    order = np.argsort(columns["gps_time"], kind="stable")
    return Town(**{name: column[order] for name, column in columns.items()}, size=size, seed=seed)


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
