"""What is measured of an object, and the verdict: sure, or to be checked and why."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from .cells import MM
from .results import ObjectSettings
from .roofs import roof_planes

SURE, CHECK = "sure", "check"
#: A building holds a square of this side, meters; wires that were taken for one do not.
WIDE = 2.0
#: Less than such a mean reliability of its points is unsure.
RELIABLE = 0.7
#: What stands about and is no building, by reason: its width, length and height, meters, as cells show them, up to two
#: cells wider; how many times as long as wide it is at least; and how much its top slopes at most, degrees.
BOXES = {
    "vehicle": ((1.5, 3.2), (3.5, 7.0), (0.0, 2.4), 1.5, 25.0),
    "container": ((2.0, 3.7), (5.5, 13.5), (2.2, 3.8), 1.9, 6.0),
}
#: A lamp or pole that was taken for a tree: no higher, meters; its width at most such a share of its height; and in fewer
#: than `CROWN` of its cells points `DEEP` meters above each other, since an arm answers once, a crown at several heights.
POLE, SLIM, DEEP, CROWN = 15.0, 0.35, 0.8, 0.36
#: Why an object is to be checked.
REASONS = (
    "no ground near", "small", "narrow", "vehicle", "container", "low", "rough roof", "unsure points", "no facade",
    "few points", "thin crown", "wide crown", "pole", "short", "not straight",
)  # fmt: skip


class Body(NamedTuple):
    """An object's cells, row by row, and what was measured in each."""

    row: NDArray[np.int64]
    column: NDArray[np.int64]
    z: NDArray[np.float64]  # of the roof, the canopy, the wires: highest point, meters
    low: NDArray[np.float64]  # lowest point; NaN in cells without points
    ground: NDArray[np.float64]  # NaN where it is not known
    points: NDArray[np.int64]  # points
    sure: NDArray[np.float64]  # sum of reliabilities, thousandths
    told: NDArray[np.int64]  # points that have one

    @property
    def place(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        return self.row - self.row.min(), self.column - self.column.min()

    def image(self, values: NDArray) -> NDArray:
        """Values of the cells as an array (rows, columns), NaN outside."""
        out = np.full((int(np.ptp(self.row)) + 1, int(np.ptp(self.column)) + 1), np.nan)
        out[self.place] = values
        return out

    @property
    def ground_height(self) -> float:
        """The middle one of the ground's heights, NaN where there is none."""
        return float(np.nanmedian(self.ground)) if not np.isnan(self.ground).all() else math.nan

    def record(self, measures: dict[str, Any], reasons: dict[str, bool]) -> dict[str, Any]:
        """Measures, points and their mean reliability (NaN where they have none), and the verdict that follows."""
        told = int(self.told.sum())
        reliability = float(self.sure.sum()) / told / MM if told else math.nan
        reasons["unsure points"] = reliability < RELIABLE
        text = ", ".join(reason for reason, holds in reasons.items() if holds)
        verdict = {"verdict": CHECK if text else SURE, "reason": text}
        return {**measures, "points": int(self.points.sum()), "reliab": reliability, **verdict}


def building(body: Body, size: float) -> dict[str, Any]:
    """Heights, roof and verdict of a building."""
    image, ground = body.image(body.z), body.ground_height
    inside, area = ~np.isnan(image), len(body.row) * size * size
    above = body.z - (np.nanmin(body.low) if math.isnan(ground) else ground)
    edge = ~scipy.ndimage.binary_erosion(inside)[body.place]
    square = np.ones((math.ceil(WIDE / size),) * 2, bool)
    planes, slope, planar = roof_planes(image, size)
    facade = np.mean(np.nan_to_num(body.z[edge] - body.low[edge]) >= 1.5)
    ridge = float(np.percentile(above, 98))
    like = _box_like(body, ridge, slope, size) if area < 45 else ""
    return body.record(
        {
            "area": area,
            "h_eave": float(np.percentile(above[edge], 25)),
            "h_ridge": ridge,
            "ground": ground,
            "slope": slope,
            "planes": planes,
            "planar": planar,
        },
        {
            "no ground near": math.isnan(ground),
            "small": area < 10,
            "narrow": not scipy.ndimage.binary_erosion(inside, square).any(),
            like: bool(like),
            "low": ridge < 2.2,
            "rough roof": planar < 0.3 and area >= 30,
            "no facade": facade == 0 and area < 50,
        },
    )


def _box_like(body: Body, height: float, slope: float, size: float) -> str:
    """Which of `BOXES` an object may be; empty where none."""
    turns = np.radians(np.arange(0.0, 90.0, 3.0))[:, None]
    u = body.column * np.cos(turns) + body.row * np.sin(turns)
    v = body.row * np.cos(turns) - body.column * np.sin(turns)
    sides = np.array([np.ptp(u, axis=1) + 1.0, np.ptp(v, axis=1) + 1.0]) * size
    width, length = sorted(sides[:, np.argmin(np.round(sides.prod(axis=0), 6))].tolist())
    for name, (wide, long, high, ratio, flat) in BOXES.items():
        fits = (
            wide[0] <= width <= wide[1]
            and long[0] <= length <= long[1]
            and high[0] <= height <= high[1]
        )
        if fits and length >= ratio * width and slope <= flat:
            return name
    return ""


def tree(body: Body, top_row: int, top_column: int, chosen: ObjectSettings) -> dict[str, Any]:
    """Place, height, crown and likely stem of a tree, and the verdict."""
    size = chosen.cell
    area = len(body.row) * size * size
    above = body.z - body.ground
    highest = int(np.argmax(np.where(np.isnan(above), -np.inf, above)))
    height, diameter = float(above[highest]), 2.0 * math.sqrt(area / math.pi)
    deep = np.mean(np.nan_to_num(body.z - body.low) > DEEP)
    return body.record(
        {
            "x": (top_column + 0.5) * size,
            "y": (top_row + 0.5) * size,
            "height": height,
            "area": area,
            "diam": diameter,
            "dbh": chosen.dbh_factor * max(height * diameter, 0.0) ** chosen.dbh_power,
            "ground": float(body.ground[highest]),
        },
        {
            "few points": body.points.sum() < 10,
            "thin crown": diameter < 0.12 * height,
            "wide crown": diameter > 1.6 * height,
            "pole": height <= POLE and diameter < SLIM * height and bool(deep < CROWN),
        },
    )


def span(body: Body, size: float) -> dict[str, Any]:
    """Length and clearance of the wires between two masts, the path (k, 3) along them, and the verdict."""
    path = path_of(body, size)
    along = np.r_[0.0, np.cumsum(np.hypot(*np.diff(path[:, :2], axis=0).T))]
    length, clearance = float(along[-1]), body.low - body.ground
    chord = np.interp(along, along[[0, -1]], path[[0, -1], 2])
    return body.record(
        {
            "length": length,
            "h_low": float(np.nanmin(clearance)) if not np.isnan(clearance).all() else math.nan,
            "z_high": float(body.z.max()),
            "sag": float(max(0.0, np.max(chord - path[:, 2]))),
            "path": path,
        },
        {
            "short": length < 8,
            "not straight": bool(np.hypot(*(path[-1, :2] - path[0, :2])) < 0.9 * length),
        },
    )


def path_of(body: Body, size: float) -> NDArray[np.float64]:
    """A line along wires (n, 3), meters: the middle of each piece of 2 m along their main direction."""
    x, y = (body.column + 0.5) * size, (body.row + 0.5) * size
    u, v = x - x.min(), y - y.min()
    du, dv = u - u.mean(), v - v.mean()
    angle = 0.5 * math.atan2(2.0 * float(du @ dv), float(du @ du - dv @ dv))
    c, s = math.cos(angle), math.sin(angle)
    along, aside = u * c + v * s, v * c - u * s
    _, piece = np.unique(np.floor((along - along.min()) / 2.0), return_inverse=True)
    many = np.bincount(piece)
    if len(many) == 1:  # a wire seen in one place
        ends = [np.argmin(along), np.argmax(along)]
        return np.column_stack([x, y, body.z])[ends]
    if np.ptp(aside) < 4.0:  # wires side by side: one straight line between them
        aside = np.full(len(aside), aside.mean())
    u, v, z = (np.bincount(piece, weights=values) / many for values in (along, aside, body.z))
    u[[0, -1]] = along.min(), along.max()  # from one end to the other
    return np.column_stack([x.min() + u * c - v * s, y.min() + u * s + v * c, z])


def deck(body: Body, size: float) -> dict[str, Any]:
    """Area, height and clearance of a bridge deck, and the verdict."""
    area, ground, height = len(body.row) * size * size, body.ground_height, float(np.median(body.z))
    return body.record(
        {"area": area, "z": height, "clear": height - ground, "ground": ground},
        {"small": area < 20, "low": height - ground < 0.5},
    )
