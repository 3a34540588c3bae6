"""Maps from above and a vertical section for the accuracy report, as images of bounded size."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..accuracy.labels import as_codes, same_length
from ..accuracy.measures import Accuracy
from ..accuracy.text import percent
from ..base.asprs import class_color
from ..base.errors import StageError
from . import html
from .pictures import png

#: Most pixels across a map and in all of it, fewest along its longer side, and pixels across a section.
MAP_WIDTH, MAP_PIXELS, MAP_LEAST = 820, 800_000, 240
SECTION_WIDTH = 1400
#: Length and depth of a section in typical distances of neighboring points.
SECTION_LENGTH, SECTION_DEPTH = 400, 8

Line = tuple[tuple[float, float], tuple[float, float]]


@dataclass(frozen=True)
class Scene:
    """Points with merged classes, and which of them are compared and wrong."""

    xyz: npt.NDArray[np.float64]
    reference: npt.NDArray[Any]
    predicted: npt.NDArray[Any]
    compared: npt.NDArray[np.bool_]
    wrong: npt.NDArray[np.bool_]


def map_sections(
    accuracy: Accuracy,
    xyz: npt.ArrayLike | None,
    reference: npt.ArrayLike | None,
    predicted: npt.ArrayLike | None,
    unit: str = "m",
    section: Line | None = None,
) -> str:
    """Sections of the report with maps and a vertical section, as markup.

    Parameters
    ----------
    accuracy : Accuracy
        Says which classes are compared and merged.
    xyz : (n, 3) array
    reference, predicted : (n,) arrays
        Class codes before any merge.
    unit : str
        Unit of the coordinates.
    section : ((x, y), (x, y)), optional
        Ends of the vertical section; by default where the errors are densest.
    """
    scene = _scene(accuracy, xyz, reference, predicted)
    size = np.ptp(scene.xyz[:, :2], axis=0)
    if size.min() < 0.02 * size.max() or size.max() == 0:
        text = f"No map: the {len(scene.xyz):,} points lie on one spot or in a line."
        return html.section("Maps", html.paragraph(text))
    line, depth, chosen = _section_line(scene, section)
    return _maps(accuracy, scene, unit, line) + _section(accuracy, scene, unit, line, depth, chosen)


def _scene(a: Accuracy, xyz: Any, reference: Any, predicted: Any) -> Scene:
    missing = [
        name
        for name, values in (("xyz", xyz), ("reference", reference), ("predicted", predicted))
        if values is None
    ]
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
            f"{bad:,} of {len(points):,} points have coordinates that are not finite", where="accuracy report"
        )
    to = np.arange(1 << 16)
    for source, target in a.merged.items():
        to[source] = target
    ref, pred = as_codes(reference, "reference"), as_codes(predicted, "prediction")
    same_length(ref, {"prediction": pred, "list of coordinates": points})
    ref, pred = to[ref], to[pred]
    compared = np.isin(ref, a.classes)
    return Scene(points, ref, pred, compared, compared & (ref != pred))


# ---- from above ------------------------------------------------------------------------------------------


def _maps(a: Accuracy, s: Scene, unit: str, line: Line | None) -> str:
    from .raster import Frame
    from .views import IGNORED, RIGHT, WRONG, error_view, top_view

    x, y, z = np.ascontiguousarray(s.xyz.T)
    width = _width(s.xyz)
    frame = Frame.around(x, y, width)
    wide, tall = frame.pixel * frame.width, frame.pixel * frame.height
    overlay = _overlay(frame, line) if line is not None else ""
    ignored = [int(c) for c in np.unique(s.reference[~s.compared])]
    n, wrong = int(s.compared.sum()), int(s.wrong.sum())

    def shown(codes: npt.NDArray[Any]) -> str:
        count = np.bincount(codes)
        found = sorted(np.flatnonzero(count), key=lambda c: -count[c])
        return ", ".join(f"{a.name(int(c))} {percent(count[c] / len(codes), 1)} %" for c in found[:8])

    bar = _scale(wide, unit)
    figures = []
    for heading, codes, alt in (
        ("Reference", s.reference, "Map of the reference classes from above, by number of points: "),
        ("Prediction", s.predicted, "Map of the predicted classes from above, by number of points: "),
    ):
        view = top_view(x, y, z, codes, width=width)
        figures.append(_figure(view, alt + shown(codes), heading, bar, overlay))
    view = error_view(x, y, z, s.predicted, s.reference, ignore=ignored, width=width)
    alt = f"Map of the errors from above: {wrong:,} of {n:,} compared points are wrong"
    figures.append(_figure(view, alt, "Errors", bar, overlay))

    keys = [(class_color(c), f"{c} {a.name(c)}") for c in _codes_of(s)]
    verdict = [(RIGHT, "right"), (WRONG, "wrong"), *([(IGNORED, "not compared")] if ignored else [])]
    note = (
        f"{len(x):,} points, {wide:,.0f} x {tall:,.0f} {unit}, north up. Each pixel of {frame.pixel:.2g} "
        f"{unit} shows its highest point; on the map of errors a wrong point lies above right ones."
    )
    if line is not None:
        note += " The line marks the vertical section below."
    parts = [
        html.legend(keys),
        html.legend(verdict),
        html.grid(*figures, least=_least(wide / tall), kind="row" if wide < 1.7 * tall else ""),
    ]
    if n != a.points:
        parts.append(html.paragraph(f"The maps show {n:,} of the {a.points:,} compared points.", "note"))
    return html.section("Maps", *parts, note=note)


def _width(xyz: npt.NDArray[np.float64]) -> int:
    """Pixels across a map: three to the distance of neighboring points, within the limits."""
    wide, tall = np.ptp(xyz[:, :2], axis=0)
    fine = 3 * wide / math.sqrt(wide * tall / len(xyz))
    most = math.sqrt(MAP_PIXELS * wide / tall)
    least = MAP_LEAST * min(1.0, wide / tall)
    width = max(16, min(max(fine, least), MAP_WIDTH, most))
    # A picture is made narrower where it would be more than 2.5 times as tall: undo that.
    return math.ceil(max(width, width * tall / wide / 2.5))


def _least(ratio: float) -> int:
    """Columns at least this wide: three maps side by side, or below each other where they are flat."""
    return 300 if ratio < 1.7 else 620


def _codes_of(s: Scene) -> list[int]:
    return sorted({int(c) for c in np.unique(s.reference)} | {int(c) for c in np.unique(s.predicted)})


def _figure(view: npt.NDArray[np.uint8], alt: str, heading: str, bar: str = "", overlay: str = "") -> str:
    tall, wide = view.shape[:2]
    picture = html.image(png(view, palette=True), alt, wide, tall, overlay)
    # A map is no taller than the window, so that it can be seen whole.
    style = f"max-width:calc(92vh*{wide / tall:.3f})" if tall > wide else ""
    return f'<figure style="{style}"><h3>{html.escape(heading)}</h3>{picture}{bar}</figure>'


def _scale(wide: float, unit: str) -> str:
    from .views import nice_step

    length = nice_step(wide / 6)
    share = 100 * length / wide
    return f'<div class="scale"><i style="width:{share:.2f}%"></i>{length:g} {html.escape(unit)}</div>'


def _overlay(frame: Any, line: Line) -> str:
    wide, tall = frame.pixel * frame.width, frame.pixel * frame.height
    (x0, y0), (x1, y1) = line
    ends = [(100 * (x - frame.x0) / wide, 100 * (1 - (y - frame.y0) / tall)) for x, y in ((x0, y0), (x1, y1))]
    way = "L".join(f"{u:.2f} {v:.2f}" for u, v in ends)
    stroke = 'fill="none" vector-effect="non-scaling-stroke"'
    return "".join(
        f'<path d="M{way}" stroke="{color}" stroke-width="{thick}" {stroke}/>'
        for color, thick in (("#fff", 4), ("#000", 1.8))
    )


# ---- in section ------------------------------------------------------------------------------------------


def _section_line(s: Scene, given: Line | None) -> tuple[Line | None, float, bool]:
    """Ends and depth of the section, and whether they were chosen here."""
    low, high = s.xyz[:, :2].min(axis=0), s.xyz[:, :2].max(axis=0)
    size = high - low
    spacing = math.sqrt(size[0] * size[1] / len(s.xyz))
    depth = SECTION_DEPTH * spacing
    if given is not None:
        return given, depth, False
    marked = s.wrong if s.wrong.any() else s.compared
    if not marked.any():
        return None, 0.0, False
    best, line = -1, None
    for along in (0, 1):
        length = min(SECTION_LENGTH * spacing, float(size[along]))
        step = length / 4
        p = s.xyz[marked]
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
    return line, depth, True


def _section(a: Accuracy, s: Scene, unit: str, line: Line | None, depth: float, chosen: bool) -> str:
    if line is None:
        return ""
    from .views import section_view

    inside, length = _slice(s.xyz, line, depth)
    if not inside.any():
        raise StageError(
            "the section holds no points", where="accuracy report", found=line, cure="Move it into the cloud"
        )
    # Points far above or below the rest (birds, multipath) would press the scene flat.
    z = s.xyz[inside, 2]
    bottom, top = np.quantile(z, [0.001, 0.999])
    reach = max(float(top - bottom), 0.02 * length)
    inside &= (s.xyz[:, 2] >= bottom - 0.25 * reach) & (s.xyz[:, 2] <= top + 0.25 * reach)
    cut = len(z) - int(inside.sum())
    if reach > 3 * length:  # higher than long: nothing to see in it
        return ""
    x, y, z = np.ascontiguousarray(s.xyz[inside].T)

    def draw(codes: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
        return section_view(
            x, y, z, codes[inside], start=line[0], end=line[1], thickness=depth, width=SECTION_WIDTH
        )

    wrong = int(s.wrong[inside].sum())
    what = f"Vertical section, {length:.0f} {unit} long and {depth:.2g} {unit} deep"
    (x0, y0), (x1, y1) = line
    note = (
        f"{what}, from {x0:.0f}, {y0:.0f} to {x1:.0f}, {y1:.0f}; {len(x):,} points, heights not exaggerated."
    )
    if chosen:
        note += " It lies where the errors are densest" if s.wrong.any() else " It lies where most points are"
        note += f": {wrong:,} points of it are wrong." if wrong else "."
    if cut:
        note += f" {cut:,} points far above or below the others are not drawn."
    codes = sorted({int(c) for part in (s.reference, s.predicted) for c in np.unique(part[inside])})
    return html.section(
        "Section",
        html.legend([(class_color(c), f"{c} {a.name(c)}") for c in codes]),
        html.strip(
            _figure(draw(s.reference), f"{what}, coloured by reference class", "Reference"),
            _figure(draw(s.predicted), f"{what}, coloured by predicted class", "Prediction"),
            label="Vertical section",
        ),
        note=note,
    )


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
