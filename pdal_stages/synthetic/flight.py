"""The flight: parallel strips, scan lines, pulses; and how close they must be for a wanted density."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

SPEED = 60.0  # metres a second
TURN = 240.0  # seconds from the end of a strip to the start of the next
GPS_START = 270_000_000.0  # adjusted standard GPS time: April 2020


@dataclass(frozen=True)
class Chunk:
    """Scan lines ``first`` to ``last`` (excluded) of one strip."""

    strip: int
    first: int
    last: int


class Flight:
    """Pulses over a square, as a function of the spacing between them.

    Parameters
    ----------
    size, elevation : float
        Side of the square; mean height of its ground.
    altitude : float
        Flying height above that.
    scan_angle : float
        Half of the scanner's opening, degrees.
    overlap : float
        Share of the swath that the next strip covers again.
    heading : float
        Direction of flight in radians from east.
    spacing : float
        Metres between scan lines, and between pulses below the sensor.
    """

    def __init__(self, size, elevation, altitude, scan_angle, overlap, heading, spacing) -> None:
        self.size, self.elevation, self.altitude = size, elevation, altitude
        self.half_angle, self.heading = math.radians(scan_angle), heading
        self.spacing = spacing
        swath = 2.0 * altitude * math.tan(self.half_angle)
        c, s = abs(math.cos(heading)), abs(math.sin(heading))
        # Half extent of the square along and across the flight, and what pitch and roll may take away.
        self.reach = 0.5 * size * (c + s) + 4.0 + 0.01 * altitude
        apart = swath * (1.0 - overlap)
        # At least two strips, so that every town is seen from two sides.
        self.strips = max(2, math.ceil((2 * self.reach - swath * overlap) / apart))
        self.across = (np.arange(self.strips) - 0.5 * (self.strips - 1)) * apart
        self.lines = math.ceil(2 * self.reach / spacing)
        self.per_line = math.ceil(2 * self.half_angle / (spacing / altitude))
        self.line_time = spacing / SPEED
        self.strip_time = 2 * self.reach / SPEED + TURN

    @property
    def pulses(self) -> int:
        """Pulses sent, with those outside the square."""
        return self.strips * self.lines * self.per_line

    def chunks(self, pulses: int) -> list[Chunk]:
        """The flight in order of time, in pieces of about so many pulses near the square."""
        seen = min(self.per_line, int(2.2 * self.reach / self.spacing))
        step = max(1, pulses // max(1, seen))
        return [
            Chunk(strip, first, min(first + step, self.lines))
            for strip in range(self.strips)
            for first in range(0, self.lines, step)
        ]

    def _steps(self, strip: int) -> tuple[int, int]:
        """The part of every scan line that can reach the square: first step, and the one after the last."""
        side = (-1.0 if strip % 2 else 1.0) * self.across[strip]  # metres the square lies to the right
        margin = self.reach + 30.0
        left = math.atan((side - margin) / self.altitude) - 0.01  # 0.008 is the most the aircraft rolls
        right = math.atan((side + margin) / self.altitude) + 0.01
        each = 2 * self.half_angle / self.per_line
        low = math.floor((self.half_angle - right) / each)
        high = math.ceil((self.half_angle - left) / each)
        return min(max(low, 0), self.per_line), min(max(high, 0), self.per_line)

    def inside(self, hit: np.ndarray, margin: float = 0.0) -> np.ndarray:
        """Which places lie in the square, or within `margin` metres of it."""
        return ((hit > -margin) & (hit < self.size + margin)).all(axis=1)

    def fire(self, chunk: Chunk, every: int = 1, *, aimed: bool = False):
        """The pulses of a chunk whose beams pass near the square.

        With `every`, only a scattered sample: one pulse in so many. With `aimed`, only the number of
        pulses whose beam would meet level ground inside the square.

        Returns
        -------
        origin, direction : (n, 3) float64
            Local metres; unit vectors.
        ids : (n,) uint64
        time, angle : (n,) float64
            GPS time in seconds; scan angle in degrees, positive to the right of the flight.
        edge : (n,) bool
            Last pulse of its scan line.
        """
        low, high = self._steps(chunk.strip)
        line = np.repeat(np.arange(chunk.first, chunk.last), high - low)
        step = np.tile(np.arange(low, high), chunk.last - chunk.first)
        if every > 1:
            ids = (chunk.strip * self.lines + line) * self.per_line + step
            # A scattered sample: whole numbers times an odd constant, upper bits.
            mixed = (ids.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(40)
            keep = mixed % np.uint64(every) == 0
            line, step = line[keep], step[keep]
        ids = (chunk.strip * self.lines + line) * self.per_line + step
        # A turning polygon: every line runs from right to left.
        angle = self.half_angle - (step + 0.5) * (2 * self.half_angle / self.per_line)
        when = line * self.line_time + step * (self.line_time / self.per_line)
        # The aircraft rolls, pitches and drifts a little.
        phase = 1.7 * chunk.strip
        roll = 0.006 * np.sin(0.9 * when + phase) + 0.002 * np.sin(3.1 * when)
        pitch = 0.004 * np.sin(0.7 * when + 2.0 * phase)
        drift = 1.5 * np.sin(0.23 * when + phase)
        back = chunk.strip % 2 == 1  # strips are flown to and fro
        along = when * SPEED - self.reach
        tilt = angle + roll
        cross = self.across[chunk.strip] + drift
        # Directions in the flight's frame: along, to the left, up.
        d_along, d_left, d_up = np.sin(pitch), -np.sin(tilt) * np.cos(pitch), -np.cos(tilt) * np.cos(pitch)
        if back:
            along, d_along, d_left = -along, -d_along, -d_left
        c, s = math.cos(self.heading), math.sin(self.heading)
        origin = np.empty((line.size, 3))
        origin[:, 0] = 0.5 * self.size + along * c - cross * s
        origin[:, 1] = 0.5 * self.size + along * s + cross * c
        origin[:, 2] = self.elevation + self.altitude
        direction = np.column_stack([d_along * c - d_left * s, d_along * s + d_left * c, d_up])
        hit = origin[:, :2] + (self.altitude / -d_up)[:, None] * direction[:, :2]
        if aimed:
            return int(self.inside(hit).sum())
        near = self.inside(hit, 25.0)
        time = GPS_START + chunk.strip * self.strip_time + when
        return (
            origin[near],
            np.ascontiguousarray(direction[near]),
            ids[near].astype(np.uint64),
            time[near],
            np.degrees(angle[near]),
            step[near] == self.per_line - 1,
        )
