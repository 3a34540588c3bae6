"""Write a review: vector layers with styles for QGIS, a web page, JSON and lines of text."""

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
from ..reports.page import render
from ..reports.vector_files import Layer, check_target, qml, write_layers
from .review_files import Review, review_files

#: Layers of the vector file.
LAYERS = ("patches", "tiles")
#: Rows in the page's tables.
PAGE_ROWS = 200
#: Rows in the text.
TEXT_ROWS = 10
#: Fill colors (red, green, blue, opacity) of patches, from fewest to most expected errors.
PATCH_COLORS = ("255,237,160,110", "254,178,76,150", "240,59,32,170", "165,0,38,190")
#: Fill color of patches that were checked.
DONE_COLOR = "120,170,120,90"


def write_review(
    inputs: Sequence[str], output: str, html: str = "", json_file: str = "", **options: Any
) -> Review:
    """Review files, and write a vector file and, where named, a page and a JSON file.

    `options` are those of :func:`review_files`.
    """
    check_target(output, LAYERS)
    pages = {"html": (html, HTML), "json": (json_file, JSON)}
    outputs = [Output(path, what, kind) for what, (path, kind) in pages.items() if path]
    check_outputs(
        [Output(output, "review"), *outputs],
        [*input_files(inputs), *inputs, find(options.get("model", STANDARD))],
    )
    review = review_files(inputs, **options)
    layers = review_layers(review)
    with whole_files(*filter(None, (json_file, html))) as files:
        if json_file:
            files[0].write_bytes((json.dumps(review.to_dict(), indent=1) + "\n").encode())
        if html:
            files[-1].write_bytes(review_page(review).encode())
        wkt = reference_of_file(review.files[0]).wkt
        write_layers(output, layers, wkt, styles(review.patches.errors))
    return review


def review_layers(review: Review) -> dict[str, Layer]:
    """Return the layers ``patches``, the best first, and ``tiles``."""
    shapely = vector("shapely")
    boxes = shapely.box(*(review.cells.corners / review.unit).T)
    file, of_cell = review.cells.place[:, 0], review.patches.of_cell
    order = np.argsort(of_cell, kind="stable")
    ends = np.searchsorted(of_cell[order], np.arange(1, review.listed + 1))
    shapes = [shapely.union_all(boxes[cells]) for cells in np.split(order, ends)[:-1]]
    tiles = [row for row in review.tiles if row["points"]]
    outlines = [shapely.box(*shapely.total_bounds(boxes[file == row["file"]])) for row in tiles]
    patches = [{**row, "done": 0} for row in review.rows]
    layers = {}
    for name, drawn, rows in (("patches", shapes, patches), ("tiles", outlines, tiles)):
        polygons = [shapely.MultiPolygon(shapely.get_parts(shape)) for shape in drawn]
        layers[name] = Layer(polygons, "MultiPolygon", _columns(rows))
    return layers


def _columns(rows: Sequence[dict[str, Any]]) -> dict[str, NDArray]:
    """Return the columns of a layer from its rows."""
    names = [name for name in (rows[0] if rows else {}) if name not in ("at", "file")]
    types = {name: object if isinstance(rows[0][name], str) else None for name in names}
    return {name: np.array([row[name] for row in rows], types[name]) for name in names}


def review_page(review: Review) -> str:
    """Return a page: counts, time that finds shares of the expected errors, tiles, patches."""
    result = review.to_dict()
    points, expected = result["points"], result["expected"]
    percent = f"{100 * expected / max(points, 1):.2f} % of them"
    figures = [
        ("Points judged", f"{points:,}", "", "ground, vegetation and buildings"),
        ("Expected wrong", f"{expected:,.0f}", "", percent),
        ("Patches", f"{result['listed']:,}", "", "in the vector file, worst first"),
    ]
    errors, minutes = np.cumsum(review.patches.errors), np.cumsum(review.patches.minutes)
    for share in (0.25, 0.5, 0.75, 0.9) if expected > 0 else ():
        place = min(int(np.searchsorted(errors, share * errors[-1])), len(minutes) - 1)
        time = duration(60 * minutes[place])
        figures.append((f"{100 * share:.0f} % of these", time, "", "of looking"))
    return render(
        "review.html",
        title="Where to look",
        subtitle=count_of(len(result["tiles"]), "file"),
        figures=figures,
        tiles=result["tiles"][:PAGE_ROWS],
        hidden=max(0, len(result["tiles"]) - PAGE_ROWS),
        patches=result["worst"][:PAGE_ROWS],
    )


def lines(result: Mapping[str, Any]) -> list[str]:
    """Return the worst tiles and patches of ``Review.to_dict`` as lines of text."""
    points, expected = result["points"], result["expected"]
    percent = 100 * expected / max(points, 1)
    out = [
        f"{points:,} points judged, {expected:,.0f} expected wrong ({percent:.2f} %), "
        f"{result['listed']:,} patches to look at",
        "",
        f"{'tile':<40}{'points':>14}{'expected wrong':>16}{'%':>8}{'patches':>9}{'minutes':>9}",
    ]
    for row in result["tiles"][:TEXT_ROWS]:
        out.append(
            f"{one_line(row['tile'])[-40:]:<40}{row['points']:>14,}{row['expected']:>16,.0f}"
            f"{row['percent']:>8.2f}{row['patches']:>9,}{row['minutes']:>9.1f}"
        )
    if len(result["tiles"]) > TEXT_ROWS:
        out.append(f"... and {len(result['tiles']) - TEXT_ROWS:,} more")
    out += ["", f"{'patch':>5}{'expected':>10}{'m2':>8}  why, where"]
    for row in result["worst"][:TEXT_ROWS]:
        out.append(
            f"{row['rank']:>5}{row['expected']:>10,.0f}{row['area']:>8,.0f}  {row['reason']}; "
            f"{one_line(row['tile'])} at {row['at'][0]:.1f}, {row['at'][1]:.1f}"
        )
    return out


def styles(errors: NDArray[np.float64]) -> dict[str, str]:
    """Return styles of the layers for QGIS.

    Patches have four steps of expected errors, and another color where ``done`` is 1; tiles are
    outlines.
    """
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
    colors = (*PATCH_COLORS, DONE_COLOR)
    patches = [(*rule, color) for rule, color in zip(rules, colors, strict=True)]
    tiles = [("tile", "", "0,0,0,0")]
    return {
        "patches": qml("MultiPolygon", patches, outline_color="80,40,20,255", outline_width=0.3),
        "tiles": qml("MultiPolygon", tiles, outline_color="60,60,60,255", outline_width=0.5),
    }
