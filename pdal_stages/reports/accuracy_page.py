"""Accuracy report: a web page about a classification and its reference, with maps from above."""

from __future__ import annotations

import datetime
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from jinja2 import Environment, PackageLoader, StrictUndefined

from ..accuracy.measures import Accuracy
from ..accuracy.text import percent
from ..base.asprs import class_color, class_name
from ..base.files import write_whole
from ..base.json_types import JsonObject
from ..base.messages import plain
from ..base.version import __version__
from .pictures import IGNORED, RIGHT, WRONG, embed, error_colors, nice_step, paint, shading, surface

# Values without a reason are not tuned.
#: Files that get maps; three maps of each are in the page, which a browser must still open.
MAX_PLACES = 12
#: Width of a map, pixels.
MAX_WIDTH = 820
#: Pixels of a map in total, which bounds the size of the page.
MAX_PIXELS = 800_000
#: Width of a map, pixels, however narrow the place is: as narrow as a picture may be.
MIN_WIDTH = 16
#: Shorter side of a place / its longer one below which it is a line, and gets no map.
MIN_SIDES = 0.02
#: Widest scale bar, about, as a part of the map's width: one in this number.
SCALE_PART = 6
#: Width of maps / their height below which the page shows them in a row.
MAX_IN_A_ROW = 1.7


@dataclass(frozen=True)
class Place:
    """Points of a file with both classifications before any merge."""

    name: str
    xyz: npt.NDArray[np.float64]  #: (n, 3) meters
    reference: npt.NDArray  #: (n,) class codes
    predicted: npt.NDArray  #: (n,) class codes


def write_accuracy_report(
    path: str | os.PathLike[str],
    accuracy: Accuracy,
    *,
    places: Sequence[Place] = (),
    title: str = "Classification accuracy",
    subtitle: str = "",
    importances: Mapping[str, float] | None = None,
    settings: JsonObject | None = None,
) -> Path:
    """Write an accuracy report, whole or not at all, and return the file.

    Parameters
    ----------
    path : str or path
        The HTML file. Images are inside it.
    accuracy : Accuracy
    places : sequence of Place, optional
        Points to draw maps of; the first :data:`MAX_PLACES` get maps. Their size is bounded, so
        millions of points do not make the page large.
    title, subtitle : str
        The page's heading and the line below it.
    importances : mapping of name to share, optional
        Importances of features or groups of features, given by the model.
    settings : mapping, optional
        What was compared and how (files, reference system, model, options); may be nested.

    Raises
    ------
    StageError
        Arrays of different lengths, or a file that cannot be written.
    """
    names = [place.name if len(places) > 1 else "" for place in places[:MAX_PLACES]]
    maps = [_maps(accuracy, place) for place in places[:MAX_PLACES]]
    ordered = sorted((importances or {}).items(), key=lambda item: (-item[1], item[0]))
    page = render_page(
        "accuracy.html",
        title=title,
        subtitle=subtitle,
        a=accuracy,
        scenes=list(zip(names, maps, strict=True)),
        hidden=max(0, len(places) - MAX_PLACES),
        importances=[(name, float(share)) for name, share in ordered],
        settings=settings,
    )
    return write_whole(path, page.encode())


def _maps(a: Accuracy, place: Place) -> JsonObject:
    """Return maps of reference, prediction and errors; none of points at one place or in a line."""
    points = np.asarray(place.xyz, dtype=np.float64)
    compared, wrong = a.verdicts(place.reference, place.predicted)
    true, labels = a.merge(place.reference), a.merge(place.predicted)
    width, height = np.ptp(points[:, :2], axis=0)
    n = int(compared.sum())
    out: JsonObject = {"points": len(points), "compared": n, "maps": []}
    if min(width, height) < MIN_SIDES * max(width, height) or max(width, height) == 0:
        return out
    x, y, z = points.T
    pixels = math.ceil(min(MAX_WIDTH, math.sqrt(MAX_PIXELS * width / height)))
    s = surface(x, y, z, max(MIN_WIDTH, pixels))
    light, (rows, columns) = shading(s), s.which.shape
    length = nice_step(columns * s.pixel / SCALE_PART)
    scale = (100 * length / (columns * s.pixel), f"{length:g} m")

    def picture(heading: str, alt: str, colors: npt.NDArray[np.uint8]) -> JsonObject:
        return {"heading": heading, "alt": alt, "scale": scale, **embed(paint(s, colors, light))}

    alt = f"Map of the errors from above: {wrong.sum():,} of {n:,} compared points are wrong"
    codes = np.union1d(true, labels).tolist()
    palette = np.array([class_color(code) for code in codes], np.uint8)
    classes = [palette[np.searchsorted(codes, s.per_pixel(v, codes[0]))] for v in (true, labels)]
    verdicts = [(RIGHT, "right"), (WRONG, "wrong"), (IGNORED, "not compared")]
    return {
        **out,
        "caption": f"{len(points):,} points, {columns * s.pixel:,.0f} x {rows * s.pixel:,.0f} m, "
        f"north up; lower left corner: x {s.x0:.0f}, y {s.y0:.0f}. Each pixel of {s.pixel:.2g} m "
        "shows its highest point; on the map of errors a wrong point lies above right ones.",
        "classes": [(class_color(code), f"{code} {a.name(code)}") for code in codes],
        "verdicts": verdicts[: 2 + (n < len(points))],
        "maps": [
            picture("Reference", "Map of the reference classes from above", classes[0]),
            picture("Prediction", "Map of the predicted classes from above", classes[1]),
            picture("Errors", alt, error_colors(s, x, y, z, wrong, ~compared)),
        ],
        "in_a_row": columns < MAX_IN_A_ROW * rows,
    }


def render_page(template: str, **context: Any) -> str:
    """Return a page, self-contained and without scripts; all values are escaped."""
    context = {"version": __version__, "date": _today(), **context}
    page = _templates().get_template(template).render(context)
    # Names of files may hold bytes that are not UTF-8, or control characters.
    return plain(page.encode(errors="backslashreplace").decode())


@lru_cache(maxsize=1)
def _templates() -> Environment:
    environment = Environment(
        loader=PackageLoader(__package__),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(percent=percent, count=lambda n: f"{n:,}", flat=flat)
    environment.globals.update(class_color=class_color, class_name=class_name)
    return environment


def flat(values: Mapping[str, object], prefix: str = "") -> list[tuple[str, str]]:
    """Return names and values as text: nested mappings get dotted names, numbers six digits."""
    out: list[tuple[str, str]] = []
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            out += flat(value, f"{prefix}{key}.")
        else:
            out.append((f"{prefix}{key}", _text(value)))
    return out


def _text(value: object) -> str:
    if isinstance(value, Mapping | list | tuple | set | frozenset):
        return ", ".join(map(_text, value)) or "none"
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1e5 else f"{value:.6g}"
    return "none" if value is None else str(value)


def _today() -> str:
    """Return the date, or the day that the environment sets with ``SOURCE_DATE_EPOCH``."""
    epoch = os.environ.get("SOURCE_DATE_EPOCH", "")
    if epoch.isdigit():
        return datetime.datetime.fromtimestamp(int(epoch), datetime.timezone.utc).date().isoformat()
    return datetime.date.today().isoformat()
