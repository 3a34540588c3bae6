"""Maps from above and a vertical section for the accuracy report, as images of bounded size."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..accuracy.labels import as_codes, same_length
from ..accuracy.measures import Accuracy
from ..accuracy.text import percent
from ..base.asprs import NOISE, class_color
from ..base.errors import StageError
from .pictures import png
from .raster import Frame
from .views import IGNORED, RIGHT, WRONG, error_view, nice_step, section_view, top_view

#: Most pixels across a map and in all of it, fewest along its longer side, and pixels across a section.
MAP_WIDTH, MAP_PIXELS, MAP_LEAST = 820, 800_000, 240
SECTION_WIDTH = 1400
#: Length and depth of a section in typical distances of neighboring points.
SECTION_LENGTH, SECTION_DEPTH = 400, 8

#: Two ends (x, y).
Line = tuple[tuple[float, float], tuple[float, float]]
#: A color and what it means.
Key = tuple[tuple[int, int, int], str]


@dataclass(frozen=True)
class Picture:
    """An image of the page, ready for the template."""

    heading: str
    alt: str
    base64: str  #: the PNG
    wide: int  #: pixels
    tall: int
    scale: tuple[float, str] | None = None  #: a bar's share of the width in percent, and its length in words
    line: str = ""  #: an SVG path drawn over it, in percent of width and height

    @classmethod
    def of(cls, view: npt.NDArray[np.uint8], heading: str, alt: str, **more: Any) -> Picture:
        data = base64.b64encode(png(view, palette=True)).decode("ascii")
        return cls(heading, alt, data, view.shape[1], view.shape[0], **more)


@dataclass(frozen=True)
class DrawnSection:
    """The vertical section in pictures."""

    caption: str
    classes: list[Key]
    views: list[Picture]


@dataclass(frozen=True)
class DrawnScene:
    """Maps and section of a scene; no maps where the points lie on one spot or in a line."""

    points: int
    compared: int
    caption: str = ""
    classes: list[Key] | None = None
    verdicts: list[Key] | None = None
    maps: tuple[Picture, ...] = ()
    in_a_row: bool = True
    section: DrawnSection | None = None


@dataclass(frozen=True)
class MapScene:
    """Points with merged classes, and which of them are compared and wrong."""

    xyz: npt.NDArray[np.float64]  #: (n, 3)
    reference: npt.NDArray[Any]  #: (n,)
    predicted: npt.NDArray[Any]  #: (n,)
    compared: npt.NDArray[np.bool_]  #: (n,)
    wrong: npt.NDArray[np.bool_]  #: (n,)

    @classmethod
    def of(cls, a: Accuracy, xyz: Any, reference: Any, predicted: Any) -> MapScene:
        """Arrays that fit together and are finite, or a StageError, with classes merged as the accuracy did."""
        given = {"xyz": xyz, "reference": reference, "predicted": predicted}
        missing = [name for name, values in given.items() if values is None]
        if missing:
            raise StageError(
                "maps need coordinates and both classifications",
                where="accuracy report",
                found="no " + " and no ".join(missing),
                cure="Give 'xyz', 'reference' and 'predicted', or none of them",
            )
        points = np.asarray(xyz, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3:
            raise StageError("'xyz' must be n x 3", where="accuracy report", found=f"shape {points.shape}")
        if not len(points):
            raise StageError("there is nothing to draw", where="accuracy report", found="0 points")
        bad = int((~np.isfinite(points).all(axis=1)).sum())
        if bad:
            raise StageError(
                f"{bad:,} of {len(points):,} points have coordinates that are not finite",
                where="accuracy report",
            )
        to = np.arange(1 << 16)
        for source, target in a.merged.items():
            to[source] = target
        ref, pred = as_codes(reference, "reference"), as_codes(predicted, "prediction")
        same_length(ref, {"prediction": pred, "list of coordinates": points})
        compared = np.isin(to[ref], a.classes) & ~np.isin(ref, list(a.left_out))
        ref, pred = to[ref], to[pred]
        return cls(points, ref, pred, compared, compared & (ref != pred))

    @property
    def spacing(self) -> float:
        """Typical distance of neighboring points."""
        return math.sqrt(float(np.prod(np.ptp(self.xyz[:, :2], axis=0))) / len(self.xyz))

    def codes(self, chosen: Any = slice(None)) -> list[int]:
        """The classes of some points, on both sides, ascending."""
        return sorted({int(c) for side in (self.reference, self.predicted) for c in np.unique(side[chosen])})


def draw_scene(a: Accuracy, scene: MapScene, unit: str = "m", section: Line | None = None) -> DrawnScene:
    """Maps of reference, prediction and errors, and a vertical section, by default where the errors are densest.

    The accuracy names the classes; `unit` is that of the coordinates.
    """
    size = np.ptp(scene.xyz[:, :2], axis=0)
    n, wrong = int(scene.compared.sum()), int(scene.wrong.sum())
    if size.min() < 0.02 * size.max() or size.max() == 0:
        return DrawnScene(len(scene.xyz), n)
    depth = SECTION_DEPTH * scene.spacing
    line = densest_line(scene, depth) if section is None else section
    x, y, z = np.ascontiguousarray(scene.xyz.T)
    width = _map_width(scene.xyz)
    frame = Frame.around(x, y, width)
    wide, tall = frame.pixel * frame.width, frame.pixel * frame.height

    def shown(codes: npt.NDArray[Any]) -> str:
        count = np.bincount(codes)
        found = sorted(np.flatnonzero(count), key=lambda c: -count[c])
        return ", ".join(f"{a.name(int(c))} {percent(count[c] / len(codes), 1)} %" for c in found[:8])

    length = nice_step(wide / 6)
    over = {
        "scale": (100 * length / wide, f"{length:g} {unit}"),
        "line": "" if line is None else _path_over(frame, line),
    }

    def classes(codes: npt.NDArray[Any], heading: str, word: str) -> Picture:
        alt = f"Map of the {word} classes from above, by number of points: {shown(codes)}"
        return Picture.of(top_view(x, y, z, codes, width=width), heading, alt, **over)

    errors = error_view(x, y, z, scene.wrong, ~scene.compared, width=width)
    alt = f"Map of the errors from above: {wrong:,} of {n:,} compared points are wrong"
    maps = (
        classes(scene.reference, "Reference", "reference"),
        classes(scene.predicted, "Prediction", "predicted"),
        Picture.of(errors, "Errors", alt, **over),
    )
    caption = (
        f"{len(x):,} points, {wide:,.0f} x {tall:,.0f} {unit}, north up; lower left corner: x "
        f"{frame.x0:.0f}, y {frame.y0:.0f}. Each pixel of {frame.pixel:.2g} {unit} shows its highest point; on the "
        "map of errors a wrong point lies above right ones."
    )
    if line is not None:
        caption += " The line marks the vertical section below."
    return DrawnScene(
        len(x),
        n,
        caption,
        _keys(a, scene.codes()),
        [(RIGHT, "right"), (WRONG, "wrong"), *([(IGNORED, "not compared")] if n < len(x) else [])],
        maps,
        wide < 1.7 * tall,
        None if line is None else draw_section(a, scene, unit, line, depth, chosen=section is None),
    )


def _keys(a: Accuracy, codes: Iterable[int]) -> list[Key]:
    return [(class_color(code), f"{code} {a.name(code)}") for code in codes]


def _map_width(xyz: npt.NDArray[np.float64]) -> int:
    """Pixels across a map: three to the distance of neighboring points, within the limits."""
    wide, tall = np.ptp(xyz[:, :2], axis=0)
    fine = 3 * wide / math.sqrt(wide * tall / len(xyz))
    most = math.sqrt(MAP_PIXELS * wide / tall)
    least = MAP_LEAST * min(1.0, wide / tall)
    width = max(16, min(max(fine, least), MAP_WIDTH, most))
    # A picture is made narrower where it would be more than 2.5 times as tall: undo that.
    return math.ceil(max(width, width * tall / wide / 2.5))


def _path_over(frame: Frame, line: Line) -> str:
    wide, tall = frame.pixel * frame.width, frame.pixel * frame.height
    ends = [(100 * (x - frame.x0) / wide, 100 * (1 - (y - frame.y0) / tall)) for x, y in line]
    return "M" + "L".join(f"{across:.2f} {down:.2f}" for across, down in ends)


# ---- in section ------------------------------------------------------------------------------------------


def densest_line(scene: MapScene, depth: float) -> Line | None:
    """Ends of the section of a given depth with most errors (most points, where all are right)."""
    low, high = scene.xyz[:, :2].min(axis=0), scene.xyz[:, :2].max(axis=0)
    marked = scene.wrong if scene.wrong.any() else scene.compared
    if not marked.any():
        return None
    p = scene.xyz[marked]
    best, line = -1, None
    for along in (0, 1):
        length = min(SECTION_LENGTH * scene.spacing, float(high[along] - low[along]))
        step = length / 4
        strip = np.floor((p[:, 1 - along] - low[1 - along]) / depth).astype(np.int64)
        part = np.floor((p[:, along] - low[along]) / step).astype(np.int64)
        parts = int(part.max()) + 1
        count = np.bincount(strip * parts + part, minlength=(int(strip.max()) + 1) * parts).reshape(-1, parts)
        total = np.cumsum(np.pad(count, ((0, 0), (1, 0))), axis=1)
        window = total[:, min(4, parts) :] - total[:, : total.shape[1] - min(4, parts)]
        i, j = np.unravel_index(int(window.argmax()), window.shape)
        if window[i, j] > best:
            best = int(window[i, j])
            across = float(low[1 - along] + (i + 0.5) * depth)
            start = min(float(low[along] + j * step), float(high[along]) - length)
            ends = ((start, across), (start + length, across))
            line = ends if along == 0 else ((across, start), (across, start + length))
    return line


def draw_section(
    a: Accuracy, scene: MapScene, unit: str, line: Line, depth: float, *, chosen: bool
) -> DrawnSection:
    """The section in pictures; `chosen` tells that the line was not given by the user."""
    inside, length = _slice(scene.xyz, line, depth)
    if not inside.any():
        raise StageError(
            "the section holds no points", where="accuracy report", found=line, cure="Move it into the cloud"
        )
    noise = inside & (np.isin(scene.reference, NOISE) | np.isin(scene.predicted, NOISE))
    scenery = inside & ~noise if (inside & ~noise).any() else inside
    low, high = heights_to_draw(scene.xyz[scenery, 2], length)
    drawn = inside & (scene.xyz[:, 2] >= low) & (scene.xyz[:, 2] <= high)
    hidden = int(inside.sum()) - int(drawn.sum())
    wrong = int(scene.wrong[drawn].sum())
    what = f"Vertical section, {length:.0f} {unit} long and {depth:.2g} {unit} deep"
    (x0, y0), (x1, y1) = line
    caption = f"{what}, from {x0:.0f}, {y0:.0f} to {x1:.0f}, {y1:.0f}; {int(drawn.sum()):,} points, heights not exaggerated."
    if chosen:
        caption += f" It lies where {'the errors are densest' if scene.wrong.any() else 'most points are'}"
        caption += f"; {wrong:,} of its points {'is' if wrong == 1 else 'are'} wrong." if wrong else "."
    if hidden:
        caption += f" Not drawn: {hidden:,} point{'s' * (hidden > 1)} far above or below the others."
    x, y, z = np.ascontiguousarray(scene.xyz[drawn].T)

    def view(codes: npt.NDArray[Any], heading: str, word: str) -> Picture:
        image = section_view(
            x, y, z, codes[drawn], start=line[0], end=line[1], thickness=depth, width=SECTION_WIDTH
        )
        return Picture.of(image, heading, f"{what}, colored by {word} class")

    views = [
        view(scene.reference, "Reference", "reference"),
        view(scene.predicted, "Prediction", "predicted"),
    ]
    return DrawnSection(caption, _keys(a, scene.codes(drawn)), views)


def heights_to_draw(z: npt.NDArray[np.float64], length: float) -> tuple[float, float]:
    """The heights that a section shows: birds, multipath and other strays would press the scene flat.

    The narrowest band with 98 % of the points, widened by half its height, but by 0.3 of the section's length at
    least and by that length at most; no farther than the points reach. One height at least is given.
    """
    z = np.sort(z)
    held = math.ceil(0.98 * len(z))
    spans = z[held - 1 :] - z[: len(z) - held + 1]
    first = int(spans.argmin())
    low, high = float(z[first]), float(z[first + held - 1])
    if high - low > length:  # a wall of strays: the densest part that can be seen
        ends = np.searchsorted(z, z + length, side="right")
        first = int((ends - np.arange(len(z))).argmax())
        return float(z[first]), float(z[ends[first] - 1])
    more = min(max(0.5 * (high - low), 0.3 * length), length)
    return max(low - more, float(z[0])), min(high + more, float(z[-1]))


def _slice(xyz: npt.NDArray[np.float64], line: Line, depth: float) -> tuple[npt.NDArray[np.bool_], float]:
    """Which points lie in the section, and its length."""
    start, end = np.asarray(line, dtype=np.float64)
    run = end - start
    length = float(np.hypot(*run))
    if not length > 0:
        raise StageError("a section needs two different ends", where="accuracy report", found=line)
    offset = xyz[:, :2] - start
    along = offset @ run / length
    across = (offset[:, 1] * run[0] - offset[:, 0] * run[1]) / length
    return (along >= 0) & (along <= length) & (np.abs(across) <= depth / 2), length
