"""What is measured of an object, and the verdict: sure, or to be checked and why."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from .cells import MM
from .planes import roof_planes

SURE, CHECK = "sure", "check"
#: The reason of an object that is larger than what is looked at in one piece.
CUT = "cut off"
#: A building holds a square of this side, meters; wires that were taken for one do not.
WIDE = 2.0
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
    "few points", "thin crown", "wide crown", "pole", "short", "not straight", CUT,
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

    def image(self, values: NDArray) -> NDArray:
        """Values of the cells as an array (rows, columns), NaN outside."""
        out = np.full((int(np.ptp(self.row)) + 1, int(np.ptp(self.column)) + 1), np.nan)
        out[self.row - self.row.min(), self.column - self.column.min()] = values
        return out

    def edge(self) -> NDArray[np.bool_]:
        """Whether each cell lies at the object's edge."""
        inside = ~np.isnan(self.image(np.zeros(len(self.row))))
        inner = scipy.ndimage.binary_erosion(inside)
        return ~inner[self.row - self.row.min(), self.column - self.column.min()]

    def holds_square(self, side: int) -> bool:
        """Whether a square of so many cells a side lies inside."""
        inside = ~np.isnan(self.image(np.zeros(len(self.row))))
        return bool(scipy.ndimage.binary_erosion(inside, np.ones((side, side), bool)).any())

    @property
    def reliability(self) -> float:
        """Mean reliability of the points, NaN where they have none."""
        told = int(self.told.sum())
        return float(self.sure.sum()) / told / MM if told else math.nan

    @property
    def ground_height(self) -> float:
        """The middle one of the ground's heights, NaN where there is none."""
        known = self.ground[~np.isnan(self.ground)]
        return float(np.median(known)) if known.size else math.nan


def judged(reasons: Sequence[object]) -> dict[str, object]:
    """The verdict that follows from reasons to check."""
    return {"verdict": CHECK if reasons else SURE, "reason": ", ".join(map(str, reasons))}


def building(body: Body, size: float) -> dict[str, object]:
    """Heights, roof and verdict of a building."""
    area, ground, edge = len(body.row) * size * size, body.ground_height, body.edge()
    above = body.z - (ground if not math.isnan(ground) else np.nanmin(body.low))
    planes, slope, planar = roof_planes(body.image(body.z), size)
    depth = body.z[edge] - body.low[edge]
    facade = float(np.mean(np.nan_to_num(depth) >= 1.5))
    ridge = float(np.percentile(above, 98))
    reasons = []
    if math.isnan(ground):
        reasons.append("no ground near")
    if area < 10:
        reasons.append("small")
    if not body.holds_square(math.ceil(WIDE / size)):
        reasons.append("narrow")
    if area < 45 and (like := _box_like(body, ridge, slope, size)):
        reasons.append(like)
    if ridge < 2.2:
        reasons.append("low")
    if planar < 0.3 and area >= 30:
        reasons.append("rough roof")
    if body.reliability < 0.7:
        reasons.append("unsure points")
    if facade == 0 and area < 50:
        reasons.append("no facade")
    return {
        "area": area,
        "h_eave": float(np.percentile(above[edge], 25)),
        "h_ridge": ridge,
        "ground": ground,
        "slope": slope,
        "planes": planes,
        "planar": planar,
        "points": int(body.points.sum()),
        "reliab": body.reliability,
        **judged(reasons),
    }


def _box_like(body: Body, height: float, slope: float, size: float) -> str:
    """Which of `BOXES` an object may be; empty where none."""
    turns = np.radians(np.arange(0.0, 90.0, 3.0))[:, None]
    u = body.column * np.cos(turns) + body.row * np.sin(turns)
    v = body.row * np.cos(turns) - body.column * np.sin(turns)
    sides = (np.ptp(u, axis=1) + 1.0) * size, (np.ptp(v, axis=1) + 1.0) * size
    best = int(np.argmin(np.round(sides[0] * sides[1], 6)))
    width, length = sorted((float(sides[0][best]), float(sides[1][best])))
    for name, (wide, long, high, ratio, flat) in BOXES.items():
        fits = wide[0] <= width <= wide[1] and long[0] <= length <= long[1] and high[0] <= height <= high[1]
        if fits and length >= ratio * width and slope <= flat:
            return name
    return ""


def tree(body: Body, top_row: int, top_column: int, size: float) -> dict[str, object]:
    """Place, height and crown of a tree, and the verdict."""
    area = len(body.row) * size * size
    above = body.z - body.ground
    highest = int(np.argmax(np.where(np.isnan(above), -np.inf, above)))
    height, diameter = float(above[highest]), 2.0 * math.sqrt(area / math.pi)
    points = int(body.points.sum())
    reasons = []
    if points < 10:
        reasons.append("few points")
    if diameter < 0.12 * height:
        reasons.append("thin crown")
    if diameter > 1.6 * height:
        reasons.append("wide crown")
    if height <= POLE and diameter < SLIM * height:
        deep = np.nan_to_num(body.z - body.low) > DEEP
        if np.mean(deep) < CROWN:
            reasons.append("pole")
    if body.reliability < 0.7:
        reasons.append("unsure points")
    return {
        "x": (top_column + 0.5) * size,
        "y": (top_row + 0.5) * size,
        "height": height,
        "area": area,
        "diam": diameter,
        "ground": float(body.ground[highest]),
        "points": points,
        "reliab": body.reliability,
        **judged(reasons),
    }


def span(body: Body, size: float) -> dict[str, object]:
    """Length and clearance of the wires between two masts, and the verdict."""
    path = path_of(body, size)
    length = float(np.hypot(*np.diff(path[:, :2], axis=0).T).sum())
    clearance = body.low - body.ground
    known = clearance[~np.isnan(clearance)]
    ends = np.hypot(*(path[-1, :2] - path[0, :2]))
    reasons = []
    if length < 8:
        reasons.append("short")
    if ends < 0.9 * length:
        reasons.append("not straight")
    if body.reliability < 0.7:
        reasons.append("unsure points")
    return {
        "length": length,
        "h_low": float(known.min()) if known.size else math.nan,
        "z_high": float(body.z.max()),
        "sag": float(max(0.0, np.max(_chord(path) - path[:, 2]))),
        "points": int(body.points.sum()),
        "reliab": body.reliability,
        **judged(reasons),
    }


def _chord(path: NDArray) -> NDArray:
    """Heights of a straight line between the ends at the places of a path."""
    along = np.r_[0.0, np.cumsum(np.hypot(*np.diff(path[:, :2], axis=0).T))]
    share = along / along[-1] if along[-1] > 0 else along
    return path[0, 2] + share * (path[-1, 2] - path[0, 2])


def path_of(body: Body, size: float) -> NDArray[np.float64]:
    """A line along wires (n, 3), meters: the middle of each piece of 2 m along their main direction."""
    x, y = (body.column + 0.5) * size, (body.row + 0.5) * size
    origin = np.array([x.min(), y.min()])
    u, v = x - origin[0], y - origin[1]
    du, dv = u - u.mean(), v - v.mean()
    angle = 0.5 * math.atan2(2.0 * float(du @ dv), float(du @ du - dv @ dv))
    along = u * math.cos(angle) + v * math.sin(angle)
    piece = np.floor((along - along.min()) / 2.0).astype(np.int64)
    _, piece = np.unique(piece, return_inverse=True)
    many = np.bincount(piece)
    aside = v * math.cos(angle) - u * math.sin(angle)
    if np.ptp(aside) < 4.0:  # wires side by side: one straight line between them
        aside = np.full(len(aside), aside.mean())
    middle = [np.bincount(piece, weights=values) / many for values in (along, aside, body.z)]
    if len(many) > 1:  # from one end to the other
        middle[0][[0, -1]] = along.min(), along.max()
    path = np.column_stack(
        [
            origin[0] + middle[0] * math.cos(angle) - middle[1] * math.sin(angle),
            origin[1] + middle[0] * math.sin(angle) + middle[1] * math.cos(angle),
            middle[2],
        ]
    )
    if len(path) == 1:  # a wire seen in one place
        first, last = np.argmin(along), np.argmax(along)
        path = np.array([[x[first], y[first], body.z[first]], [x[last], y[last], body.z[last]]])
    return path


def deck(body: Body, size: float) -> dict[str, object]:
    """Area, height and clearance of a bridge deck, and the verdict."""
    area, ground = len(body.row) * size * size, body.ground_height
    height = float(np.median(body.z))
    reasons = []
    if area < 20:
        reasons.append("small")
    if not math.isnan(ground) and height - ground < 0.5:
        reasons.append("low")
    if body.reliability < 0.7:
        reasons.append("unsure points")
    return {
        "area": area,
        "z": height,
        "clear": height - ground,
        "ground": ground,
        "points": int(body.points.sum()),
        "reliab": body.reliability,
        **judged(reasons),
    }
