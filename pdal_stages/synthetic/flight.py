"""The flight: parallel strips flown to and fro, scan lines across them, pulses along the lines."""

from __future__ import annotations

import math

import numpy as np

SPEED = 60.0  # meters a second
TURN = 240.0  # seconds from the end of a strip to the start of the next
GPS_START = 270_000_000.0  # adjusted standard GPS time: April 2020
MARGIN = 25.0  # meters beyond the square that are flown as well: what stands outside throws shadows into it


class Flight:
    """Pulses over a square of `size` meters, `spacing` meters apart below the sensor."""

    def __init__(self, options, size: float, spacing: float) -> None:
        self.size, self.altitude, self.spacing = size, options.altitude, spacing
        rng, half = np.random.default_rng([int(options.seed), 0xF117]), math.radians(options.scan_angle)
        self.heading = math.radians(rng.uniform(70, 110))  # from east
        swath = 2.0 * self.altitude * math.tan(half)
        self.reach = 0.5 * size * (abs(math.cos(self.heading)) + abs(math.sin(self.heading))) + MARGIN
        apart = swath * (1.0 - options.overlap)
        # At least two strips, so that every town is seen from two sides.
        self.strips = max(2, math.ceil((2 * self.reach - swath * options.overlap) / apart))
        self.across = (np.arange(self.strips) - 0.5 * (self.strips - 1)) * apart
        self.lines = math.ceil(2 * self.reach / spacing)
        self.per_line = math.ceil(2 * half * self.altitude / spacing)
        # A turning polygon: every line runs from right to left.
        self.angles = half - (np.arange(self.per_line) + 0.5) * (2 * half / self.per_line)

    def parts(self, pulses: int) -> list[tuple[int, int, int]]:
        """The flight in order of time: strip, first line, line after the last, with about so many pulses each."""
        step = max(1, int(pulses / min(self.per_line, 2 * self.reach / self.spacing)))
        firsts = range(0, self.lines, step)
        return [(strip, n, min(n + step, self.lines)) for strip in range(self.strips) for n in firsts]

    def aimed(self, part: int) -> int:
        """How many of all pulses, made so many at a time, would meet level ground inside the square."""
        return sum((np.abs(self.pulses(*p)[2]) < self.size / 2).all(axis=1).sum() for p in self.parts(part))

    def pulses(self, strip: int, first: int, last: int) -> list[np.ndarray]:
        """The pulses of some scan lines of a strip that come near the square, in order of time.

        Origin (n, 3) in meters from the middle of the square at its mean height, unit direction (n, 3), place (n, 2)
        where the beam would meet level ground, GPS time in seconds, scan angle in degrees (right of the flight: positive).
        """
        forward = 1.0 - 2.0 * (strip % 2)
        left = self.across[strip] - forward * self.altitude * np.tan(self.angles)
        step = np.flatnonzero(np.abs(left) < self.reach + 5.0)
        line, step = np.repeat(np.arange(first, last), step.size), np.tile(step, last - first)
        angle, when = self.angles[step], (line + step / self.per_line) * (self.spacing / SPEED)
        # The aircraft drifts a little to the side, and its nose goes up and down.
        along = forward * (when * SPEED - self.reach) + 1.4 * np.sin(0.7 * when + 2.0 * strip)
        side = self.across[strip] + 1.5 * np.sin(0.23 * when + strip)
        c, s, out = math.cos(self.heading), math.sin(self.heading), -forward * np.sin(angle)
        origin = np.column_stack([along * c - side * s, along * s + side * c, 0 * along + self.altitude])
        direction = np.column_stack([-out * s, out * c, -np.cos(angle)])
        level = origin[:, :2] - self.altitude / direction[:, 2:] * direction[:, :2]
        near = (np.abs(level) < self.size / 2 + MARGIN).all(axis=1)
        time = GPS_START + strip * (2 * self.reach / SPEED + TURN) + when
        return [column[near] for column in (origin, direction, level, time, np.degrees(angle))]
