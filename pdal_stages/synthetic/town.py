"""A generated town under a simulated flight: options, points, chunks."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace

import numpy as np

from ..base.errors import OptionError
from ..base.jit import CompilationNote
from ..base.progress import Progress
from ..base.threads import map_blocks, resolve_threads
from .blocks import Blocks
from .flight import Chunk, Flight
from .materials import REFLECTANCE
from .plan import Plan
from .raycast import MAX_RETURNS, cast
from .scene import build_scene

PULSES_PER_CHUNK = 60_000
REACH = 45.0  # metres a beam may travel sideways between the highest thing and the lowest ground


@dataclass(frozen=True)
class TownOptions:
    """How to make a town; see :func:`make_town`."""

    size: float = 200.0
    density: float = 7.0
    seed: int = 1
    altitude: float = 350.0
    scan_angle: float = 25.0
    overlap: float = 0.3
    noise: float = 0.02
    outliers: float = 0.0
    origin: tuple[float, float, float] = (500_000.0, 5_400_000.0, 60.0)
    srs: str = "EPSG:25832"

    def __post_init__(self) -> None:
        def need(name: str, low: float, high: float, unit: str) -> None:
            value = getattr(self, name)
            try:
                fine = not isinstance(value, bool) and low <= float(value) <= high
            except (TypeError, ValueError):
                fine = False
            if not fine:
                raise OptionError(
                    f"'{name}' must be a number from {low:g} to {high:g}{unit}",
                    where="synthetic",
                    found=value,
                )

        need("size", 20, 20_000, " metres")
        need("density", 0.05, 500, " points per square metre")
        need("altitude", 150, 4_000, " metres")
        need("scan_angle", 3, 35, " degrees to each side")
        need("overlap", 0, 0.8, " (a share of the swath)")
        need("noise", 0, 0.5, " metres")
        need("outliers", 0, 0.05, " (a share of the pulses)")
        if (
            isinstance(self.seed, bool)
            or not isinstance(self.seed, (int, np.integer))
            or not 0 <= self.seed < 2**31
        ):
            raise OptionError(
                "'seed' must be a whole number from 0 to 2147483647", where="synthetic", found=self.seed
            )
        try:
            origin = tuple(float(c) for c in self.origin)
        except (TypeError, ValueError):
            origin = ()
        if len(origin) != 3 or not all(math.isfinite(c) for c in origin):
            raise OptionError("'origin' must be three numbers: x, y, z", where="synthetic", found=self.origin)
        if not isinstance(self.srs, str):
            raise OptionError(
                "'srs' must be text such as EPSG:25832, or 'none'", where="synthetic", found=self.srs
            )


@dataclass
class Town:
    """Points of a town (or of a chunk of one) with what is true about them.

    Attributes
    ----------
    xyz : (n, 3) float64
        Coordinates in metres, multiples of 1 mm.
    classification : (n,) uint8
        True ASPRS class. Vegetation is split by the height above ground: 3 below 0.5 m, 4 below 2 m, 5.
    intensity : (n,) uint16
    return_number, number_of_returns : (n,) uint8
    gps_time : (n,) float64
        Adjusted standard GPS time; unique to each pulse.
    point_source_id : (n,) uint16
        The strip, from 1.
    scan_angle : (n,) float32
        Degrees, positive to the right of the flight.
    edge_of_flight_line : (n,) bool
        Last pulse of its scan line (lines run from right to left).
    height_above_ground : (n,) float32
        True height above the bare ground (water: above its surface).
    material : (n,) uint8
        Index into :data:`pdal_stages.synthetic.materials.NAMES`.
    options : TownOptions
    """

    xyz: np.ndarray
    classification: np.ndarray
    intensity: np.ndarray
    return_number: np.ndarray
    number_of_returns: np.ndarray
    gps_time: np.ndarray
    point_source_id: np.ndarray
    scan_angle: np.ndarray
    edge_of_flight_line: np.ndarray
    height_above_ground: np.ndarray
    material: np.ndarray
    options: TownOptions = field(default_factory=TownOptions)

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def x(self) -> np.ndarray:
        return self.xyz[:, 0]

    @property
    def y(self) -> np.ndarray:
        return self.xyz[:, 1]

    @property
    def z(self) -> np.ndarray:
        return self.xyz[:, 2]

    def subset(self, which: np.ndarray) -> Town:
        """The points picked by a mask or by indices."""
        return Town(**{name: getattr(self, name)[which] for name in _COLUMNS}, options=self.options)

    def ground_height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """True height of the bare ground at any coordinates of the town (same system as ``xyz``)."""
        ox, oy, oz = self.options.origin
        plan = Plan(self.options.size, int(self.options.seed), 0.0)
        return plan.heights(np.asarray(x) - ox, np.asarray(y) - oy) + oz


_COLUMNS = tuple(f.name for f in fields(Town) if f.name != "options")


class _Survey:
    """One town's plan, blocks and flight, ready to be cast chunk by chunk."""

    def __init__(self, options: TownOptions) -> None:
        self.options = options
        self.plan = Plan(options.size, int(options.seed), 0.0)
        self.blocks = Blocks(self.plan)
        heading = math.radians(np.random.default_rng([int(options.seed), 0xF117]).uniform(70, 110))
        self._heading = heading
        self.flight = self._flight(1.0 / math.sqrt(options.density))
        with CompilationNote():  # one scan line, so that the note is about compiling alone
            self.cast_lines(self.flight, Chunk(0, self.flight.lines // 2, self.flight.lines // 2 + 1))
        self.flight = self._flight(self._spacing())

    def _flight(self, spacing: float) -> Flight:
        o = self.options
        return Flight(o.size, 0.0, o.altitude, o.scan_angle, o.overlap, self._heading, spacing)

    def _spacing(self) -> float:
        """Pulse spacing that gives the wanted density of returns, from a scattered sample of pulses."""
        o = self.options
        spacing = 1.0 / math.sqrt(o.density)
        for _ in range(2):
            flight = self._flight(spacing)
            step = max(1, math.ceil(60.0 / spacing))
            parts = [
                Chunk(s, n, min(n + step, flight.lines))
                for s in range(flight.strips)
                for n in range(0, flight.lines, step)
            ]
            if len(parts) > 60:  # a large town: some of its parts
                picked = np.random.default_rng([int(o.seed), 0x5A3]).choice(len(parts), 60, replace=False)
                parts = [parts[n] for n in sorted(picked)]
            sent = step * len(parts) * min(flight.per_line, 2 * flight.reach / spacing)
            every = max(1, int(sent / 60_000))
            returns = pulses = 0
            for part in parts:
                got = self.cast_lines(flight, part, every)
                returns += len(got["height"])
                pulses += got["aimed"]
            # Pulses aimed into the square go with the square of the spacing: count them on a coarse flight.
            coarse = self._flight(max(spacing, o.size / 400.0))
            aimed = sum(coarse.fire(Chunk(s, 0, coarse.lines), aimed=True) for s in range(coarse.strips))
            aimed *= (coarse.spacing / spacing) ** 2
            density = returns / max(pulses, 1) * aimed / o.size**2
            spacing *= math.sqrt(max(density, 1e-6) / o.density)
        return spacing

    def cast_lines(self, flight: Flight, chunk: Chunk, every: int = 1) -> dict:
        """Returns of some scan lines of a strip, local metres."""
        o = self.options
        origin, direction, ids, time, angle, edge = flight.fire(chunk, every)
        n = len(origin)
        xyz = np.empty((n * MAX_RETURNS, 3))
        byte = np.empty((n * MAX_RETURNS, 6), dtype=np.uint8)
        height, pulse = np.empty(n * MAX_RETURNS), np.empty(n * MAX_RETURNS, dtype=np.int64)
        count = aimed = 0
        if n:
            hit = origin[:, :2] + (flight.altitude / -direction[:, 2])[:, None] * direction[:, :2]
            aimed = int(flight.inside(hit).sum())
            x0, y0 = hit.min(axis=0) - REACH
            x1, y1 = hit.max(axis=0) + REACH
            pieces = [self.blocks.get(i, j) for i, j in self.plan.blocks_in(x0, y0, x1, y1, 30.0)]
            scene = build_scene(pieces, x0, y0, x1, y1)
            setting = np.array([0.35e-3, o.noise, o.outliers, o.size, o.altitude, 0.015, 0.0, 0.0])
            count, _ = cast(
                origin,
                direction,
                ids,
                scene,
                self.plan.ground,
                REFLECTANCE,
                setting,
                int(o.seed),
                xyz,
                byte,
                height,
                pulse,
            )
        pulse = pulse[:count]
        return {
            "xyz": xyz[:count],
            "byte": byte[:count],
            "height": height[:count],
            "time": time[pulse],
            "angle": angle[pulse],
            "edge": edge[pulse],
            "aimed": aimed,
        }

    def town(self, chunk: Chunk) -> Town:
        got = self.cast_lines(self.flight, chunk)
        byte = got["byte"]
        # Millimetres, as whole numbers, so that the file's coordinates are exactly these.
        mm = np.round(got["xyz"] * 1000.0) + np.round(np.array(self.options.origin) * 1000.0)
        return Town(
            xyz=mm / 1000.0,
            classification=byte[:, 0].copy(),
            intensity=byte[:, 4].astype(np.uint16) * np.uint16(256) + byte[:, 5],
            return_number=byte[:, 1].copy(),
            number_of_returns=byte[:, 2].copy(),
            gps_time=got["time"],
            point_source_id=np.full(len(byte), chunk.strip + 1, dtype=np.uint16),
            scan_angle=got["angle"].astype(np.float32),
            edge_of_flight_line=got["edge"],
            height_above_ground=got["height"].astype(np.float32),
            material=byte[:, 3].copy(),
            options=self.options,
        )


def _options(options: TownOptions | None, changes: dict) -> TownOptions:
    known = {f.name for f in fields(TownOptions)}
    for name in changes:
        if name not in known:
            from ..base.errors import suggest

            raise OptionError(
                f"unknown option '{name}'",
                where="synthetic",
                cure=suggest(name, known) + f"The options are {', '.join(sorted(known))}",
            )
    return replace(options, **changes) if options is not None else TownOptions(**changes)


def town_chunks(
    options: TownOptions | None = None, *, threads: int | None = None, progress: bool = True, **changes
) -> Iterator[Town]:
    """The town piece by piece, in order of time, in memory that does not grow with its size.

    Takes the options of :func:`make_town`; the pieces joined are exactly its result.
    """
    chosen = _options(options, changes)
    resolve_threads(threads)
    survey = _Survey(chosen)
    chunks = survey.flight.chunks(PULSES_PER_CHUNK)
    total = int(chosen.density * chosen.size**2)
    with Progress(total, "synthetic", enabled=None if progress else False) as line:
        for piece in map_blocks(survey.town, chunks, threads):
            line.update(len(piece))
            if len(piece):
                yield piece


def make_town(
    size: float = 200.0,
    density: float = 7.0,
    seed: int = 1,
    *,
    threads: int | None = None,
    progress: bool = True,
    **changes,
) -> Town:
    """A generated town under a simulated flight, with true classes and heights.

    Streets with kerbs and cars, houses of many roof shapes, closed blocks with courtyards, a church, halls,
    parks with a pond, a canal with quays and bridges, a railway bank, a hill, trees that let the beam
    through, hedges, poles, pylons and wires. Pulses are cast as five sub-beams each through that geometry, so
    shadows, facades, roof edges with two returns and ground below trees come out as they do in a scan.

    Parameters
    ----------
    size : float
        Side of the square in metres.
    density : float
        All returns per square metre of the whole square, met within a few per cent.
    seed : int
        The same seed and options give the same points, whatever the number of threads.
    altitude, scan_angle, overlap : float
        Flying height in metres (350), half opening in degrees (25), share of the swath seen twice (0.3).
    noise : float
        Standard deviation of a range in metres (0.02).
    outliers : float
        Share of pulses that get a low outlier (class 7) or a bird (class 18); 0.
    origin : (x, y, z)
        Coordinates of the south-west corner, and mean height of the ground.
    srs : str
        ``EPSG:`` code for the files written, or ``none``.
    threads : int, optional
        See :func:`pdal_stages.base.threads.resolve_threads`.

    Returns
    -------
    Town

    Raises
    ------
    OptionError
        Where an option is unknown or out of range.
    """
    chosen = _options(None, {"size": size, "density": density, "seed": seed, **changes})
    pieces = list(town_chunks(chosen, threads=threads, progress=progress))
    if not pieces:
        raise OptionError(
            "no pulse hit this town", where="synthetic", cure="Give a larger 'size' or 'density'"
        )
    return Town(
        **{name: np.concatenate([getattr(p, name) for p in pieces]) for name in _COLUMNS}, options=chosen
    )
