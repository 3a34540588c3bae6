"""Write a review: patches and tiles as vector layers with styles for QGIS, a page, figures, lines of text."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base.files import HTML, JSON, Output, check_outputs, whole_files
from ..base.messages import count_of, duration, one_line
from ..base.vector import vector
from ..classifier.model_file import STANDARD, find
from ..pipeline.inputs_outputs import input_files
from ..pipeline.spatial_reference import reference_of_file
from ..reports.object_layers import Layer, check_target, qml, write_layers
from ..reports.page import render
from .review_files import Review, review_files

#: What is written, in this order.
LAYERS = ("patches", "tiles")
#: Rows in the page's tables, and in text.
_ROWS, _WORST = 200, 10
#: Fill colors of patches, from fewest to most expected errors; and of checked patches.
_INKS = ("255,237,160,110", "254,178,76,150", "240,59,32,170", "165,0,38,190")
_LOOKED_AT = "120,170,120,90"


def write_review(
    inputs: Sequence[str], output: str, html: str = "", json_file: str = "", **how: Any
) -> Review:
    """Review files, and write a vector file, a page and figures; `how`: see :func:`review_files`."""
    check_target(output, LAYERS)
    pages = {"html": (html, HTML), "json": (json_file, JSON)}
    outputs = [Output(path, what, kind) for what, (path, kind) in pages.items() if path]
    check_outputs(
        [Output(output, "review"), *outputs],
        [*input_files(inputs), *inputs, find(how.get("model", STANDARD))],
    )
    found = review_files(inputs, **how)
    layers = review_layers(found)
    with whole_files(*filter(None, (json_file, html))) as files:
        if json_file:
            files[0].write_bytes((json.dumps(found.to_dict(), indent=1) + "\n").encode())
        if html:
            files[-1].write_bytes(review_page(found).encode())
        write_layers(
            output, layers, reference_of_file(found.files[0]).wkt, styles(found.patches.errors)
        )
    return found


def review_layers(found: Review) -> dict[str, Layer]:
    """Layers ``patches``, best first, and ``tiles``."""
    shapely = vector("shapely")
    boxes, of = shapely.box(*(found.cells.corners / found.across).T), found.cells.place[:, 0]
    tiles = [row for row in found.tiles if row["points"]]
    order = np.argsort(found.patches.of_cell, kind="stable")
    ends = np.searchsorted(found.patches.of_cell[order], np.arange(1, found.listed + 1))
    shapes = [shapely.union_all(boxes[mine]) for mine in np.split(order, ends)[:-1]]
    outlines = [shapely.box(*shapely.total_bounds(boxes[of == row["file"]])) for row in tiles]
    patches = [{**row, "done": 0} for row in found.rows]
    return {
        name: Layer(
            [shapely.MultiPolygon(shapely.get_parts(s)) for s in drawn],
            "MultiPolygon",
            _fields(rows),
        )
        for name, drawn, rows in (("patches", shapes, patches), ("tiles", outlines, tiles))
    }


def _fields(rows: Sequence[dict[str, Any]]) -> dict[str, NDArray]:
    """Columns of a layer."""
    names = [name for name in (rows[0] if rows else {}) if name not in ("at", "file")]
    kinds_of = {name: object if isinstance(rows[0][name], str) else None for name in names}
    return {name: np.array([row[name] for row in rows], kinds_of[name]) for name in names}


# ---- presentation: a page, lines of text, styles of the layers for QGIS -----------------------------


def review_page(review: Review) -> str:
    """The page: figures, minutes of checking that find given shares of the expected errors, tiles, patches."""
    found = review.to_dict()
    points, expected = found["points"], found["expected"]
    figures = [
        ("Points judged", f"{points:,}", "", "ground, vegetation and buildings"),
        (
            "Expected wrong",
            f"{expected:,.0f}",
            "",
            f"{100 * expected / max(points, 1):.2f} % of them",
        ),
        ("Patches", f"{found['listed']:,}", "", "in the vector file, worst first"),
    ]
    held, spent = np.cumsum(review.patches.errors), np.cumsum(review.patches.minutes)
    for share in (0.25, 0.5, 0.75, 0.9) if expected > 0 else ():
        place = min(int(np.searchsorted(held, share * held[-1])), len(spent) - 1)
        figures.append(
            (f"{100 * share:.0f} % of these", duration(60 * spent[place]), "", "of looking")
        )
    return render(
        "review.html",
        title="Where to look",
        subtitle=count_of(len(found["tiles"]), "file"),
        figures=figures,
        tiles=found["tiles"][:_ROWS],
        hidden=max(0, len(found["tiles"]) - _ROWS),
        patches=found["worst"][:_ROWS],
    )


def lines(found: Mapping[str, Any]) -> list[str]:
    """The same in a few lines of text: the worst tiles and the worst patches."""
    points, expected = found["points"], found["expected"]
    out = [
        f"{points:,} points judged, {expected:,.0f} expected wrong ({100 * expected / max(points, 1):.2f} %), "
        f"{found['listed']:,} patches to look at",
        "",
        f"{'tile':<40}{'points':>14}{'expected wrong':>16}{'%':>8}{'patches':>9}{'minutes':>9}",
    ]
    for row in found["tiles"][:_WORST]:
        out.append(
            f"{one_line(row['tile'])[-40:]:<40}{row['points']:>14,}{row['expected']:>16,.0f}{row['percent']:>8.2f}"
            f"{row['patches']:>9,}{row['minutes']:>9.1f}"
        )
    if len(found["tiles"]) > _WORST:
        out.append(f"... and {len(found['tiles']) - _WORST:,} more")
    out += ["", f"{'patch':>5}{'expected':>10}{'m2':>8}  why, where"]
    for row in found["worst"][:_WORST]:
        out.append(
            f"{row['rank']:>5}{row['expected']:>10,.0f}{row['area']:>8,.0f}  {row['reason']}; "
            f"{one_line(row['tile'])} at {row['at'][0]:.1f}, {row['at'][1]:.1f}"
        )
    return out


def styles(errors: NDArray[np.float64]) -> dict[str, str]:
    """Styles: ``patches`` in four steps of expected errors, green where ``done`` is 1; ``tiles`` as outlines."""
    positive = errors[errors > 0]
    steps = np.quantile(positive, [0.5, 0.8, 0.95]) if len(positive) else np.array([1.0, 2.0, 3.0])
    low, middle, high = (f"{value:.0f}" for value in steps)
    rules = [  # some match nothing where steps coincide
        (f"below {low} points expected wrong", f"done = 0 and expected < {low}"),
        (f"{low} to {middle}", f"done = 0 and expected >= {low} and expected < {middle}"),
        (f"{middle} to {high}", f"done = 0 and expected >= {middle} and expected < {high}"),
        (f"{high} and more", f"done = 0 and expected >= {high}"),
        ("looked at", "done = 1"),
    ]
    patches = [(*rule, ink) for rule, ink in zip(rules, (*_INKS, _LOOKED_AT), strict=True)]
    tiles = [("tile", "", "0,0,0,0")]
    return {
        "patches": qml("MultiPolygon", patches, outline_color="80,40,20,255", outline_width=0.3),
        "tiles": qml("MultiPolygon", tiles, outline_color="60,60,60,255", outline_width=0.5),
    }
