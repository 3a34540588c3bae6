"""Maps from above for the accuracy report, as images of bounded size."""

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
from ..base.asprs import class_color
from ..base.errors import StageError
from .pictures import png
from .raster import Frame
from .views import IGNORED, RIGHT, WRONG, error_view, nice_step, top_view

#: Most pixels across a map and in all of it, fewest along its longer side.
MAP_WIDTH, MAP_PIXELS, MAP_LEAST = 820, 800_000, 240

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
class DrawnScene:
    """Maps of a scene; none where the points lie on one spot or in a line."""

    points: int
    compared: int
    caption: str = ""
    classes: list[Key] | None = None
    verdicts: list[Key] | None = None
    maps: tuple[Picture, ...] = ()
    in_a_row: bool = True


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

    def codes(self) -> list[int]:
        """The classes of the points, on both sides, ascending."""
        return sorted({int(c) for side in (self.reference, self.predicted) for c in np.unique(side)})


def draw_scene(a: Accuracy, scene: MapScene, unit: str = "m") -> DrawnScene:
    """Maps of reference, prediction and errors.

    The accuracy names the classes; `unit` is that of the coordinates.
    """
    size = np.ptp(scene.xyz[:, :2], axis=0)
    n, wrong = int(scene.compared.sum()), int(scene.wrong.sum())
    if size.min() < 0.02 * size.max() or size.max() == 0:
        return DrawnScene(len(scene.xyz), n)
    x, y, z = np.ascontiguousarray(scene.xyz.T)
    width = _map_width(scene.xyz)
    frame = Frame.around(x, y, width)
    wide, tall = frame.pixel * frame.width, frame.pixel * frame.height

    def shown(codes: npt.NDArray[Any]) -> str:
        count = np.bincount(codes)
        found = sorted(np.flatnonzero(count), key=lambda c: -count[c])
        return ", ".join(f"{a.name(int(c))} {percent(count[c] / len(codes), 1)} %" for c in found[:8])

    length = nice_step(wide / 6)
    over = {"scale": (100 * length / wide, f"{length:g} {unit}")}

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
    return DrawnScene(
        len(x),
        n,
        caption,
        _keys(a, scene.codes()),
        [(RIGHT, "right"), (WRONG, "wrong"), *([(IGNORED, "not compared")] if n < len(x) else [])],
        maps,
        wide < 1.7 * tall,
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
