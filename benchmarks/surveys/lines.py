"""Set real wires and a real tower, labeled in one survey, into copies of the others.

One survey has labeled wires: AHN4's power line, whose conductors are cut into pieces of some
meters, straightened. A line that is set in is strung from such pieces: as the power line is, or as
three conductors, or as the few single ones of low voltage, over whatever the survey has there, as
dense as wires are at its density, with return numbers where it has them. Towers are copies of the
only one, turned, scaled and mirrored. All follows from the number of the copy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import laspy
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from surveys import LINE_SURVEY, SURVEYS, TOWER, WIRE

#: Strips across its line that are left out in turn when wires are scored.
STRIPS = 5


@dataclass(frozen=True)
class LineRules:
    """How lines are cut out and set in; lengths in meters. Not tuned."""

    piece: float = 5.0  #: length of the pieces of conductors
    level: float = 3.0  #: conductors farther apart in height are of different levels
    density: float = 13.75  #: points per square meter of the source
    low_tower: float = 6.0  #: above the ground the source's tower begins
    #: points per meter of a conductor at 1 point per square meter: thin and thick ones
    rate: tuple[float, float] = (0.03, 0.4)
    sparsest: float = 0.25  #: points per meter of a conductor, at least
    clear: float = 0.6  #: nothing is set as near to a point that is there
    above: float = 3.0  #: nor as low above the ground
    tower_above: float = 1.0  #: but for towers
    share_of_several: float = 0.5  #: of points on wires, those with another return below


RULES = LineRules()


@dataclass(frozen=True, eq=False)
class LabeledLine:
    """The pieces of the labeled line."""

    #: by strip: pieces (m, 3) of conductors: meters along, across and above them
    pieces: tuple[tuple[NDArray[np.float64], ...], ...]
    #: (14, 2) places of the conductors across the line and above the lowest, meters
    conductors: NDArray[np.float64]
    #: (m, 3) points of the tower: along, across, above the lowest conductor
    tower: NDArray[np.float64]
    origin: NDArray[np.float64]  #: (2,) where positions along the line are counted from
    along: NDArray[np.float64]  #: (2,) its direction
    ends: tuple[float, float]  #: first and last position along it
    strip_of_tower: int  #: the strip that the tower stands in

    def strip(self, xyz: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the strip (n,) of points of the source (n, 3)."""
        low, high = self.ends
        place = ((xyz[:, :2] - self.origin) @ self.along - low) / (high - low)
        return np.clip(np.floor(STRIPS * place), 0, STRIPS - 1).astype(np.int64)


@cache
def labeled_line(data: Path) -> LabeledLine:
    """Return the labeled line of the source."""
    points = laspy.read(data / SURVEYS[LINE_SURVEY].files[0])
    xyz = np.column_stack([points.x, points.y, points.z]).astype(float)
    codes = np.asarray(points.classification)
    wires, tower = xyz[codes == WIRE], xyz[codes == TOWER]
    origin = wires[:, :2].mean(axis=0)
    along = np.linalg.svd(wires[:, :2] - origin, full_matrices=False)[2][0]
    frame = np.column_stack([along, (-along[1], along[0])])
    local = np.column_stack([(wires[:, :2] - origin) @ frame, wires[:, 2]])
    standing = np.column_stack([(tower[:, :2] - origin) @ frame, tower[:, 2]])
    at_tower = standing[:, 0].mean()
    ends = (float(local[:, 0].min()), float(local[:, 0].max()))
    pieces: tuple[list[NDArray[np.float64]], ...] = tuple([] for _ in range(STRIPS))
    places = []
    for start in np.arange(np.ceil(ends[0]), ends[1] - RULES.piece, RULES.piece):
        if abs(start + 0.5 * RULES.piece - at_tower) < 2.0 * RULES.piece:
            continue
        here = local[(local[:, 0] >= start) & (local[:, 0] < start + RULES.piece)]
        straight = _conductors(here - [start, 0.0, 0.0])
        strip = int(STRIPS * (start - ends[0]) / (ends[1] - ends[0]))
        pieces[strip].extend(piece for piece, _ in straight)
        if len(straight) == 14:
            places.append([place for _, place in straight])
    conductors = np.median(places, axis=0)
    conductors[:, 1] -= conductors[:, 1].min()
    # At the tower the lowest conductor hangs from the lowest arm.
    lowest = local[abs(local[:, 0] - at_tower) < 2.0 * RULES.piece, 2].min()
    tower_points = standing - [at_tower, 0.0, lowest]
    strip = int(STRIPS * (at_tower - ends[0]) / (ends[1] - ends[0]))
    every = tuple(map(tuple, pieces))
    return LabeledLine(every, conductors, tower_points, origin, along, ends, strip)


def _conductors(
    points: NDArray[np.float64],
) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return the conductors of a piece of the line: straightened points, place (2,) of each.

    `points` (n, 3) are along, across and up; the lower levels hold bundles of two on each side.
    """
    out = []
    for side in (points[points[:, 1] < 0], points[points[:, 1] >= 0]):
        side = side[np.argsort(side[:, 2])]
        levels = np.split(side, np.flatnonzero(np.diff(side[:, 2]) > RULES.level) + 1)
        for level in levels:
            halves = [level]
            if len(levels) == 4 and level is not levels[-1]:
                middle = np.median(level[:, 1])
                halves = [level[level[:, 1] < middle], level[level[:, 1] >= middle]]
            for one in halves:
                if len(one) < 5:
                    continue
                fit = np.column_stack([np.ones(len(one)), one[:, 0]])
                line, *_ = np.linalg.lstsq(fit, one[:, 1:], rcond=None)
                straight = np.column_stack([one[:, 0], one[:, 1:] - fit @ line])
                out.append((straight, line[0]))
    return out


@dataclass(frozen=True, eq=False)
class Arrangement:
    """Where the conductors of a line hang."""

    conductors: NDArray[np.float64]  #: (n, 2) across the line and above the lowest, meters
    height: float  #: of the lowest above the ground at a pole, meters
    span: float  #: between poles, meters
    sag: float  #: in the middle of a span, meters
    rate: float  #: points per meter of a conductor at 1 point per square meter
    tower: float = 0.0  #: how large towers are, by the source's; 0: poles are not seen


def arrange(line: LabeledLine, random: np.random.Generator) -> Arrangement:
    """Return a line of one of three kinds: like the source, three conductors, or low voltage."""
    kind = random.integers(3)
    rate = float(np.exp(random.uniform(*np.log(RULES.rate))))
    if kind == 0:
        scale = random.uniform(0.4, 1.0)
        height, span = random.uniform(8.0, 20.0), random.uniform(150.0, 350.0)
        sag = min(span * random.uniform(0.01, 0.03), height - 5.0)
        return Arrangement(line.conductors * scale, height, span, sag, rate, scale)
    if kind == 1:
        apart, lift = random.uniform(0.8, 2.5), random.uniform(0.0, 1.5)
        places = np.array([[-apart, 0.0], [0.0, lift], [apart, 0.0]])
        height, span = random.uniform(7.0, 18.0), random.uniform(60.0, 150.0)
        sag = span * random.uniform(0.005, 0.02)
        return Arrangement(places, height, span, sag, rate, random.uniform(0.25, 0.45))
    count, apart = int(random.integers(1, 5)), random.uniform(0.2, 0.5)
    upright = random.random() < 0.5
    places = np.zeros((count, 2))
    places[:, int(upright)] = apart * np.arange(count)
    height, span = random.uniform(5.5, 10.0), random.uniform(30.0, 60.0)
    return Arrangement(places, height, span, span * random.uniform(0.005, 0.02), rate)


@dataclass(frozen=True, eq=False)
class Implant:
    """Points of a line to be set into a cloud."""

    xyz: NDArray[np.float64]  #: (m, 3) meters
    labels: NDArray[np.uint8]  #: (m,)
    several: NDArray[np.bool_]  #: (m,) whether the pulse has another return below


def string_line(
    line: LabeledLine,
    strips: Sequence[int],
    cloud: NDArray[np.float64],
    ground: NDArray[np.float64],
    density: float,
    seed: Sequence[int],
) -> Implant:
    """Return a line across a cloud (n, 3), above the `ground` (n,) at its points.

    Its conductors are of these `strips` of the source. `density` is the cloud's, points per square
    meter.
    """
    random = np.random.default_rng(list(seed))
    arrangement = arrange(line, random)
    low, high = cloud[:, :2].min(axis=0), cloud[:, :2].max(axis=0)
    middle = low + (high - low) * random.uniform(0.3, 0.7, 2)
    angle = random.uniform(0.0, np.pi)
    along = np.array([np.cos(angle), np.sin(angle)])
    across = np.array([-along[1], along[0]])
    half = 0.75 * float(np.hypot(*(high - low)))
    first = random.uniform(0.0, arrangement.span)  # position of a pole
    near = cKDTree(cloud[:, :2])

    def ground_at(xy: NDArray[np.float64]) -> NDArray[np.float64]:
        return ground[near.query(xy)[1]]

    poles = np.arange(-half + first - arrangement.span, half + arrangement.span, arrangement.span)
    feet = ground_at(middle + poles[:, None] * along)
    rate = max(arrangement.rate * density, RULES.sparsest)
    pieces = [piece for strip in strips for piece in line.pieces[strip]]
    parts = []
    for place in arrangement.conductors:
        local = _string(pieces, 2.0 * half, rate, random) - [half, 0.0, 0.0]
        part = np.clip((local[:, 0] - poles[0]) % arrangement.span / arrangement.span, 0.0, 1.0)
        hangs = np.interp(local[:, 0], poles, feet) + arrangement.height
        hangs -= 4.0 * arrangement.sag * part * (1.0 - part)
        xy = middle + local[:, :1] * along + (local[:, 1:2] + place[0]) * across
        parts.append(np.column_stack([xy, hangs + place[1] + local[:, 2]]))
    wires = np.concatenate(parts)
    towers = [
        _stand(line, arrangement, pole, foot, density, random)
        for pole, foot in zip(poles, feet, strict=True)
        if arrangement.tower
    ]
    frame = np.stack([along, across])
    standing = np.concatenate([np.zeros((0, 3)), *towers])
    standing = np.column_stack([middle + standing[:, :2] @ frame, standing[:, 2]])
    xyz = np.concatenate([wires, standing])
    labels = np.repeat(np.array([WIRE, TOWER], np.uint8), [len(wires), len(standing)])
    inside = ((xyz[:, :2] >= low) & (xyz[:, :2] <= high)).all(axis=1)
    xyz, labels = xyz[inside], labels[inside]
    height = xyz[:, 2] - ground_at(xyz[:, :2])
    kept = height > np.where(labels == TOWER, RULES.tower_above, RULES.above)
    kept &= cKDTree(cloud).query(xyz)[0] > RULES.clear
    several = random.random(len(xyz)) < RULES.share_of_several
    return Implant(xyz[kept], labels[kept], several[kept])


def _string(
    pieces: Sequence[NDArray[np.float64]],
    length: float,
    rate: float,
    random: np.random.Generator,
) -> NDArray[np.float64]:
    """Return a straight conductor (m, 3) of pieces: along it from 0, across, up; meters."""
    parts = []
    for start in np.arange(0.0, length, RULES.piece):
        wanted, chosen = rate * RULES.piece, []
        while sum(map(len, chosen)) < wanted:
            chosen.append(pieces[random.integers(len(pieces))])
        points = np.concatenate(chosen)
        kept = random.random(len(points)) < wanted / len(points)
        parts.append(points[kept] + [start, 0.0, 0.0])
    return np.concatenate(parts)


def _stand(
    line: LabeledLine,
    arrangement: Arrangement,
    pole: float,
    foot: float,
    density: float,
    random: np.random.Generator,
) -> NDArray[np.float64]:
    """Return a tower (m, 3) at a pole: along the line, across it, and its elevation."""
    scale, points = arrangement.tower, line.tower
    top = foot + arrangement.height + arrangement.conductors[:, 1].max()
    lift = scale * (points[:, 2] - line.conductors[:, 1].max())
    # What the source's tower lacks at its foot is another part of its shaft.
    missing = lift.min() + top - foot
    shaft = lift < lift.min() + RULES.low_tower * scale
    count = int(np.ceil(max(missing, 0.0) / (RULES.low_tower * scale)))
    rows = np.concatenate([np.arange(len(points)), *[np.flatnonzero(shaft)] * count])
    down = np.repeat(np.arange(count + 1), [len(points), *[int(shaft.sum())] * count])
    tower = np.column_stack([scale * points[rows, :2], lift[rows] + top])
    tower[:, 2] -= down * RULES.low_tower * scale
    # Its mirror images are as good as itself.
    images = [tower * [a, b, 1.0] for a in (1, -1) for b in (1, -1)]
    wanted = len(tower) * scale**2 * density / RULES.density
    number = min(int(np.ceil(wanted / len(tower))), 4)
    seen = np.concatenate(images[:number])
    seen = seen[random.random(len(seen)) < wanted / len(seen)]
    return seen + np.array([pole, 0.0, 0.0])


@dataclass(frozen=True)
class StrandRules:
    """Single strands that are hung over a cloud to score low-voltage lines by; lengths in meters."""

    apart: float = 12.0  #: between strands
    height: tuple[float, float] = (6.0, 10.0)  #: above the ground
    gap: tuple[float, float] = (0.4, 1.0)  #: between points, on average
    sag: float = 0.3  #: in the middle


STRANDS = StrandRules()


def hang_strands(
    line: LabeledLine,
    strip: int,
    cloud: NDArray[np.float64],
    ground: NDArray[np.float64],
    seed: int,
) -> Implant:
    """Return single strands along both axes of a cloud (n, 3), above its `ground` (n,)."""
    random = np.random.default_rng(seed)
    low, high = cloud[:, :2].min(axis=0), cloud[:, :2].max(axis=0)
    length, near = float((high - low).min()), cKDTree(cloud[:, :2])
    parts = []
    for offset in np.arange(0.5 * STRANDS.apart, length, STRANDS.apart):
        rate = 1.0 / random.uniform(*STRANDS.gap)
        local = _string(line.pieces[strip], length, rate, random)
        place = np.column_stack([local[:, 0], offset + local[:, 1]])
        xy = low + (place if random.random() < 0.5 else place[:, ::-1])
        height = np.median(ground[near.query(xy)[1]]) + random.uniform(*STRANDS.height)
        hangs = height - STRANDS.sag * np.sin(np.pi * local[:, 0] / length)
        parts.append(np.column_stack([xy, hangs + local[:, 2]]))
    xyz = np.concatenate(parts)
    kept = xyz[:, 2] - ground[near.query(xyz[:, :2])[1]] > RULES.above
    kept &= cKDTree(cloud).query(xyz)[0] > RULES.clear
    xyz = xyz[kept]
    several = random.random(len(xyz)) < RULES.share_of_several
    return Implant(xyz, np.full(len(xyz), WIRE, np.uint8), several)
