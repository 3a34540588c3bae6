"""The command ``review``: from classified files to patches that a person should check."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..accuracy.expected import Patches, ReviewCells, find_patches, side_for
from ..base import checks
from ..base.asprs import NOISE
from ..base.errors import StageError
from ..base.files import HTML, JSON, Output, check_outputs, whole_files
from ..base.las import read_header
from ..base.messages import counted, duration, one_line, print_messages
from ..base.version import __version__
from ..classifier.model import loaded_model
from ..classifier.model_file import STANDARD, find
from ..objects.outlines import vector
from ..reports.objectlayers import Layer, check_target, qml, write_layers
from ..reports.page import render
from ..stages.points import Points
from .inputs_outputs import input_files
from .las_chunks import can_read_chunks, read_columns
from .spatial_reference import check_one_reference, reference_of_file
from .workers import each_file

#: Dimensions that are read where they are there.
WANTED = ("Reliability", "ReturnNumber", "NumberOfReturns")
#: What is written, in this order.
LAYERS = ("patches", "tiles")
#: Rows in the page's tables, and in text.
_ROWS, _WORST = 200, 10
#: Fill colors of patches, from fewest to most expected errors; and of checked patches.
_INKS = ("255,237,160,110", "254,178,76,150", "240,59,32,170", "165,0,38,190")
_LOOKED_AT = "120,170,120,90"


@dataclass
class Review:
    """The result; the first `listed` patches are written. Coordinates are reported in units of `across` meters, as in the
    files."""

    cells: ReviewCells
    patches: Patches
    listed: int
    files: list[str]
    across: float = 1.0

    @cached_property
    def tiles(self) -> list[dict[str, Any]]:
        """A row for each file: points, expected errors, patches listed, minutes to check them; worst first."""
        n, listed, of = len(self.files), self.patches.file[: self.listed], self.cells.place[:, 0]
        points = np.bincount(of, self.cells.points.sum(axis=1), n)
        errors = np.bincount(of, self.cells.errors.sum(axis=1), n)
        minutes = np.bincount(listed, self.patches.minutes[: self.listed], n)
        rows = [
            {
                "tile": Path(name).name,
                "points": int(points[k]),
                "expected": round(float(errors[k]), 3),
                "percent": round(100.0 * float(errors[k] / max(points[k], 1)), 2),
                "patches": int(np.count_nonzero(listed == k)),
                "minutes": round(float(minutes[k]), 1),
                "file": k,
            }
            for k, name in enumerate(self.files)
        ]
        return sorted(rows, key=lambda row: (-row["expected"], row["tile"]))

    @cached_property
    def rows(self) -> list[dict[str, Any]]:
        """The patches listed, as plain values."""
        p = self.patches
        return [
            {
                "rank": k + 1,
                "tile": Path(self.files[p.file[k]]).name,
                "expected": round(float(p.errors[k]), 1),
                "points": int(p.points[k]),
                "area": float(p.area[k]),
                "seconds": round(60.0 * float(p.minutes[k]), 1),
                "per_minute": round(float(p.errors[k] / p.minutes[k]), 1),
                "reason": p.reason[k],
                "at": [round(float(v) / self.across, 3) for v in p.at[k]],
            }
            for k in range(self.listed)
        ]

    def to_dict(self) -> dict[str, Any]:
        """Figures, for JSON."""
        return {
            "version": __version__,
            "points": int(self.cells.points.sum()),
            "expected": float(self.patches.errors.sum()),
            "patches": len(self.patches),
            "listed": self.listed,
            "cell": self.cells.side,
            "tiles": self.tiles,
            "worst": self.rows[:1000],
        }


def review_files(
    inputs: Sequence[str],
    share: float = 0.95,
    cell: float = 0.0,
    model: str = STANDARD,
    workers: int = 1,
) -> Review:
    """Read classified files and find the patches.

    They are listed until they hold a `share` of the expected errors. Cells are `cell` meters wide, or as the density says
    (0). The `model` gives reliabilities where files have none; `workers` read files at the same time.
    """
    if cell:
        checks.number("'--cell'", cell, 0.5, 100, unit="m")
    checks.number("'--share'", share, 0, 1, above=True)
    files = input_files(inputs)
    references = {path: reference_of_file(path) for path in files}
    print_messages(*check_one_reference(references))
    side = cell or side_for(*_extent(files, references))
    found: list[ReviewCells] = []
    work = [(path, references[path].wkt, model, side, number) for number, path in enumerate(files)]
    for cells_of_file in each_file(cells_of, work, workers):
        found += cells_of_file
    headers = map(read_header, files)
    if all(header is not None and not header.count for header in headers):
        nothing = np.empty(0)
        found = [ReviewCells.of(np.empty((0, 3)), nothing.astype(np.uint8), nothing, side)]
    elif not any(map(len, found)):
        raise StageError(
            "no point is ground, vegetation or a building",
            found=", ".join(files[:3]),
            cure="Classify the files first: pdal-stages classify raw.laz classified.laz",
        )
    cells = ReviewCells.join(found)
    patches = find_patches(cells)
    held = np.cumsum(patches.errors)
    some = len(held) and held[-1] > 0
    listed = int(np.searchsorted(held, share * held[-1])) + 1 if some else 0
    return Review(
        cells, patches, min(listed, len(patches)), files, references[files[0]].units.horizontal
    )


def cells_of(path: str, wkt: str, model: str, side: float, number: int) -> list[ReviewCells]:
    """The cells of a file with its number; missing reliabilities are computed, with a message."""
    found: list[ReviewCells] = []
    whole: list[dict[str, NDArray]] = []
    for part in parts_of(path, wkt):
        if "Reliability" not in part:
            whole.append(part)
        elif len(part["codes"]):
            found.append(
                ReviewCells.of(part["xyz"], part["codes"], part["Reliability"], side, number)
            )
    if whole:
        print_messages(
            f"{path} has no Reliability: now computed by the model {model}, which takes as long as classifying"
        )
        every = {name: np.concatenate([part[name] for part in whole]) for name in whole[0]}
        found.append(
            ReviewCells.of(every["xyz"], every["codes"], reliability_of(every, model), side, number)
        )
    return [ReviewCells.join(found)] if found else []


def parts_of(path: str, wkt: str) -> Iterator[dict[str, NDArray]]:
    """The points of a file that are neither noise nor withheld, in its order.

    Each part has ``xyz`` (n, 3) in meters, ``codes`` (n,), and those of the dimensions :data:`WANTED` that exist.
    """
    for arrays, flags in read_columns(path, WANTED):
        points = Points(arrays, wkt=wkt, legacy_flags=flags)
        codes = points.class_codes
        kept = ~np.isin(codes, NOISE) & ~points.flag("Withheld").astype(bool)
        more = {name: np.asarray(points.dimension(name))[kept] for name in WANTED if name in arrays}
        yield {"xyz": points.xyz[kept], "codes": codes[kept], **more}


def _extent(files: Sequence[str], references: dict[str, Any]) -> tuple[int, float]:
    """Points and square meters of the files, as their headers say."""
    points, area = 0, 0.0
    for path in files:
        header = read_header(path) if can_read_chunks(path) else None
        if header is not None and header.count:
            west, south, east, north = header.box
            points += header.count
            area += (east - west) * (north - south) * references[path].units.horizontal ** 2
    return (points, area) if area > 0 else (1, 1e-9)


def reliability_of(points: Mapping[str, NDArray], model: str) -> NDArray[np.float32]:
    """The probability that a model gives to the class of each point; 1 for classes that it does not know."""
    loaded = loaded_model(model)
    given = {name: points[name] for name in loaded.optional_dimensions if name in points}
    found: Any = loaded.predict(points["xyz"], given, probabilities=True).probabilities
    place = np.full(256, -1)
    place[loaded.codes] = np.arange(len(loaded.codes))
    lower = [code for code in (3, 4) if place[code] < 0]
    place[lower] = place[5]  # vegetation as one class
    mine = place[points["codes"]]
    own = np.take_along_axis(found, np.maximum(mine, 0)[:, None], axis=1)[:, 0]
    return np.where(mine >= 0, own, 1.0).astype(np.float32)


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
        subtitle=counted(len(found["tiles"]), "file"),
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
