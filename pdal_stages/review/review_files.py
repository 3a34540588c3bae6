"""Review: read classified files, find the patches that a person should check, and write them.

A review becomes vector layers with styles for QGIS, JSON and lines of text.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base import checks
from ..base.asprs import NOISE
from ..base.distinct import DistinctPoints
from ..base.errors import StageError
from ..base.files import JSON, Output, check_outputs, write_json
from ..base.json_types import JsonObject
from ..base.las import read_header
from ..base.messages import one_line, print_messages
from ..base.vector import vector
from ..base.version import __version__
from ..classifier.model import loaded_model
from ..classifier.model_file import STANDARD, find
from ..pipeline.distinct_files import DistinctFiles
from ..pipeline.inputs_outputs import input_files
from ..pipeline.point_files import can_read_chunks, read_columns
from ..pipeline.spatial_reference import Reference, check_one_reference, reference_of_file
from ..reports.vector_files import Layer, check_target, qml, write_layers
from ..stages.points import Points
from .doubts import inputs_against
from .expected_errors import Patches, ReviewCells, cell_side, find_patches

#: Dimensions that are read where they exist.
DIMENSIONS = ("Reliability", "ReturnNumber", "NumberOfReturns")
#: Patches in the JSON file: more than a person checks in an hour, at 5 s or more each.
JSON_ROWS = 1000
#: Layers of the vector file.
LAYERS = ("patches", "tiles")
#: Rows in the text: few enough for a terminal.
TEXT_ROWS = 10
#: Quantiles of patches' expected errors at which the colors change; not tuned.
COLOR_QUANTILES = (0.5, 0.8, 0.95)
#: Fill colors (red, green, blue, opacity) of patches, from fewest to most expected errors.
PATCH_COLORS = ("255,237,160,110", "254,178,76,150", "240,59,32,170", "165,0,38,190")
#: Fill color of patches that were checked.
DONE_COLOR = "120,170,120,90"


@dataclass
class Review:
    """Patches of classified files; the first `listed` are written."""

    cells: ReviewCells
    patches: Patches
    listed: int
    files: list[str]
    unit: float = 1.0  #: of the files' coordinates, in which places are reported, meters
    against: list[str] = field(
        default_factory=list
    )  #: by patch, as far as known, what speaks against its class

    @cached_property
    def tiles(self) -> list[JsonObject]:
        """A row for each file, the one with most expected errors first."""
        n, listed = len(self.files), self.patches.file[: self.listed]
        file = self.cells.place[:, 0]
        points = np.bincount(file, self.cells.points.sum(axis=1), n)
        errors = np.bincount(file, self.cells.errors.sum(axis=1), n)
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
    def rows(self) -> list[JsonObject]:
        """A row for each listed patch."""
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
                "against": self.against[k] if k < len(self.against) else "",
                "at": [round(float(v) / self.unit, 3) for v in p.at[k]],
            }
            for k in range(self.listed)
        ]

    def to_dict(self) -> JsonObject:
        """Return counts, tiles and the first patches as JSON types."""
        return {
            "version": __version__,
            "points": int(self.cells.points.sum()),
            "expected": float(self.patches.errors.sum()),
            "patches": len(self.patches),
            "listed": self.listed,
            "cell": self.cells.side,
            "tiles": self.tiles,
            "worst": self.rows[:JSON_ROWS],
        }


def review_files(
    inputs: Sequence[str],
    share: float = 0.95,
    cell: float = 0.0,
    model: str = STANDARD,
    workers: int = 1,
) -> Review:
    """Read classified files and find the patches to check.

    Parameters
    ----------
    inputs : sequence of str
        Files, folders or patterns.
    share : float
        Patches are listed until they hold this share of the expected errors.
    cell : float
        Side of a cell, meters; 0 chooses by the density of points.
    model : str
        Model that computes the reliabilities of files without.
    workers : int
        Files read at the same time.

    Raises
    ------
    StageError
        Where no point is ground, vegetation or a building.
    """
    if cell:
        checks.number("'--cell'", cell, 0.5, 100, unit="m")
    checks.number("'--share'", share, 0, 1, above=True)
    files = input_files(inputs)
    references = {path: reference_of_file(path) for path in files}
    print_messages(*check_one_reference(references))
    points, area = _points_and_area(files, references)
    side = cell or cell_side(points, area)
    work = [(path, references[path].wkt, model, side, number) for number, path in enumerate(files)]
    distinct = DistinctFiles(files)
    results = distinct.results(cells_of_file, work, workers)
    parts = [part for cells in results for part in cells]
    print_messages(*distinct.messages)
    if not points:
        nothing = np.empty(0, np.uint8)
        parts = [ReviewCells.from_points(np.empty((0, 3)), nothing, nothing, side)]
    elif not any(map(len, parts)):
        raise StageError(
            "no point is ground, vegetation or a building",
            found=", ".join(files[:3]),
            cure="Classify the files first: pdal-stages classify raw.laz classified.laz",
        )
    cells = ReviewCells.join(parts)
    patches = find_patches(cells)
    errors = np.cumsum(patches.errors)
    listed = 0
    if len(errors) and errors[-1] > 0:
        listed = min(int(np.searchsorted(errors, share * errors[-1])) + 1, len(patches))
    return Review(cells, patches, listed, files, references[files[0]].units.horizontal)


def cells_of_file(
    path: str,
    wkt: str,
    model: str,
    side: float,
    number: int,
    distinct: DistinctPoints | None = None,
) -> list[ReviewCells]:
    """Return the cells of a file; reliabilities that it lacks are computed, with a message."""
    cells: list[ReviewCells] = []
    unrated: list[dict[str, NDArray]] = []
    for part in read_points(path, wkt, distinct):
        if "Reliability" not in part:
            unrated.append(part)
        elif len(part["codes"]):
            values = part["xyz"], part["codes"], part["Reliability"]
            cells.append(ReviewCells.from_points(*values, side, number))
    if unrated:
        print_messages(
            f"{path} has no Reliability: it is computed with the model {model}, which takes as "
            "long as classifying"
        )
        points = {name: np.concatenate([part[name] for part in unrated]) for name in unrated[0]}
        values = points["xyz"], points["codes"], compute_reliability(points, model)
        cells.append(ReviewCells.from_points(*values, side, number))
    return [ReviewCells.join(cells)] if cells else []


def read_points(
    path: str, wkt: str, distinct: DistinctPoints | None = None
) -> Iterator[dict[str, NDArray]]:
    """Yield the points of a file that are neither noise nor withheld, in its order, once each.

    Each part has ``xyz`` (n, 3) in meters, ``codes`` (n,), and those of :data:`DIMENSIONS` that
    exist.
    """
    distinct = distinct or DistinctPoints()
    for columns, flags in read_columns(path, (*DIMENSIONS, "GpsTime")):
        first = distinct.first(columns)
        arrays = {name: values[first] for name, values in columns.items()}
        points = Points(arrays, wkt=wkt, legacy_flags=flags)
        codes = points.class_codes
        kept = ~np.isin(codes, NOISE) & ~points.flag("Withheld").astype(bool)
        existing = [name for name in DIMENSIONS if name in arrays]
        columns = {name: np.asarray(points.dimension(name))[kept] for name in existing}
        try:
            if points.reliability is not None:
                columns["Reliability"] = points.reliability[kept]
        except StageError as error:
            raise error.at(path) from None
        yield {"xyz": points.xyz[kept], "codes": codes[kept], **columns}


def _points_and_area(
    files: Sequence[str], references: Mapping[str, Reference]
) -> tuple[int, float]:
    """Return the number of points and the area, m2, that headers of files report."""
    points, area = 0, 0.0
    for path in files:
        header = read_header(path) if can_read_chunks(path) else None
        if header is not None and header.count:
            west, south, east, north = header.box
            points += header.count
            area += (east - west) * (north - south) * references[path].units.horizontal ** 2
    return points, area


def compute_reliability(points: Mapping[str, NDArray], model_name: str) -> NDArray[np.float32]:
    """Return a model's probability (n,) of each point's class, 1 for unknown classes."""
    model = loaded_model(model_name)
    dimensions = {name: points[name] for name in model.optional_dimensions if name in points}
    result: Any = model.predict(points["xyz"], dimensions, probabilities=True)
    column_of_code = np.full(256, -1)
    column_of_code[model.codes] = np.arange(len(model.codes))
    lower = [code for code in (3, 4) if column_of_code[code] < 0]
    column_of_code[lower] = column_of_code[5]  # vegetation as one class
    column = column_of_code[points["codes"]]
    known = np.maximum(column, 0)[:, None]
    probability = np.take_along_axis(result.probabilities, known, axis=1)[:, 0]
    return np.where(column >= 0, probability, 1.0).astype(np.float32)


def write_review(
    inputs: Sequence[str],
    output: str,
    json_file: str = "",
    reasons: int | None = None,
    **options: Any,
) -> Review:
    """Review files, and write a vector file and, where named, a JSON file.

    For the first patches, `reasons` of them or all, the inputs of the model that speak most against
    their class are named. `options` are those of :func:`review_files`.
    """
    check_target(output, LAYERS)
    outputs = [Output(output, "review")] + [Output(json_file, "json", JSON)] * bool(json_file)
    check_outputs(outputs, [*input_files(inputs), *inputs, find(options.get("model", STANDARD))])
    review = review_files(inputs, **options)
    count = review.listed if reasons is None else min(reasons, review.listed)
    review.against = [""] * count
    for number in np.unique(review.patches.file[:count]).tolist():
        name_doubts(review, number, options.get("model", STANDARD))
    layers = review_layers(review)
    wkt = reference_of_file(review.files[0]).wkt
    write_layers(output, layers, wkt, styles(review.patches.errors))
    if json_file:
        write_json(json_file, review.to_dict(), "json")
    return review


def name_doubts(review: Review, number: int, model: str) -> None:
    """Name what speaks against the class of the patches of a file; its number is among the files.

    Where nothing can be told, a message says why.
    """
    rows = np.flatnonzero(review.patches.file[: len(review.against)] == number)
    path = review.files[number]
    try:
        parts = [*read_points(path, reference_of_file(path).wkt)]
        points = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        points.setdefault("Reliability", np.zeros(len(points["codes"])))
        places, side = review.patches.at[rows], review.cells.side
        texts = inputs_against(points, places, side, loaded_model(model))
        for row, text in zip(rows.tolist(), texts, strict=True):
            review.against[row] = text
    except StageError as error:
        print_messages(f"what speaks against the classes in {path} is not known: {error}")


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
    square = review.unit**2  # as the geometry; of the text and the JSON it is m2
    patches = [{**row, "area": row["area"] / square, "done": 0} for row in review.rows]
    layers = {}
    for name, drawn, rows in (("patches", shapes, patches), ("tiles", outlines, tiles)):
        polygons = [shapely.MultiPolygon(shapely.get_parts(shape)) for shape in drawn]
        layers[name] = Layer(polygons, "MultiPolygon", _columns(rows))
    return layers


def _columns(rows: Sequence[JsonObject]) -> dict[str, NDArray]:
    """Return the columns of a layer from its rows."""
    names = [name for name in (rows[0] if rows else {}) if name not in ("at", "file")]
    types = {name: object if isinstance(rows[0][name], str) else None for name in names}
    return {name: np.array([row[name] for row in rows], types[name]) for name in names}


def lines(result: JsonObject) -> list[str]:
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
        out += [f"{'':>25}against it: {row['against']}"] if row["against"] else []
    return out


def styles(errors: NDArray[np.float64]) -> dict[str, str]:
    """Return styles of the layers for QGIS.

    Patches have four steps of expected errors, and another color where ``done`` is 1; tiles are
    outlines.
    """
    positive = errors[errors > 0]
    steps = np.quantile(positive, COLOR_QUANTILES) if len(positive) else np.array([1.0, 2.0, 3.0])
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
