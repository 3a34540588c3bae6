"""What is behind ``review``: classified files in, patches that a person should look at out."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..accuracy.expected import Patches, ReviewCells, find_patches, side_for
from ..base import checks, kinds
from ..base.errors import StageError
from ..base.files import write_whole
from ..base.las import read_header
from ..base.outputs import Output, check_outputs
from ..base.plain import print_messages
from ..base.progress import Progress
from ..base.version import __version__
from ..classifier.modelfile import STANDARD
from ..objects.outlines import vector
from ..reports.objectlayers import Layer, check_target, write_layers
from ..reports.reviewpage import review_page, styles
from ..stages.loading import loaded_model
from ..stages.preparation import PREPARATION, made_of_coordinates
from .inputs_outputs import input_files
from .parts import Part, parts_of, reads_in_parts, reference_and_wkt
from .references import check_one_reference, without_reference
from .workers import each_file

#: What is written, in this order.
LAYERS = ("patches", "tiles")


@dataclass(frozen=True)
class ReviewRequest:
    """What is reviewed, and what is written; OptionError if a number is out of bounds."""

    inputs: tuple[str, ...]  #: classified files, folders, patterns
    output: str  #: vector file
    html: str = ""  #: a page; empty for none
    json: str = ""  #: figures; empty for none
    share: float = 0.95  #: patches are written until they hold this share of the expected errors
    cell: float = 0.0  #: side of a cell, meters; 0: chosen by the density
    model: str = STANDARD  #: what gives reliabilities where the files have none
    workers: int = 1  #: files read at the same time

    def __post_init__(self) -> None:
        if self.cell:
            checks.number("'--cell'", self.cell, 0.5, 100, unit="m")
        checks.number("'--share'", self.share, 0, 1, above=True)
        checks.whole("'--workers'", self.workers, 1, 1024)

    @cached_property
    def files(self) -> list[str]:
        """All inputs."""
        return input_files(self.inputs)


@dataclass
class Review:
    """What was found; of the patches those `listed`, which come first, are written."""

    cells: ReviewCells
    patches: Patches
    listed: int
    files: list[str]

    @cached_property
    def tiles(self) -> list[dict[str, Any]]:
        """A row for each file: points, points expected wrong, patches listed, minutes to look at these; worst first."""
        n, listed, of = len(self.files), self.patches.file[: self.listed], self.cells.place[:, 0]
        points = np.bincount(of, self.cells.points.sum(axis=1), n)
        errors = np.bincount(of, self.cells.errors.sum(axis=1), n)
        minutes = np.bincount(listed, self.patches.minutes[: self.listed], n)
        rows = [
            {
                "tile": Path(name).name,
                "points": int(points[k]),
                "expected": float(errors[k]),
                "share": float(errors[k] / max(points[k], 1)),
                "patches": int(np.count_nonzero(listed == k)),
                "minutes": float(minutes[k]),
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
                "reason": p.reason[k],
                "box": [round(float(v), 3) for v in p.box[k]],
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


def review_files(request: ReviewRequest) -> Review:
    """Read the files and find the patches; StageError if one cannot be read, or there is nothing to judge."""
    references = {path: reference_and_wkt(path) for path in request.files}
    without = check_one_reference({path: one for path, (one, _) in references.items()})
    print_messages(*without_reference(without))
    side = request.cell or side_for(*_extent(request.files, references))
    found: list[ReviewCells] = []
    work = [
        (path, references[path][1], request.model, side, number) for number, path in enumerate(request.files)
    ]
    with Progress(len(work), "reading", "files") as line:
        for _, answer in each_file(cells_of, work, request.workers):
            if answer.reason:
                raise StageError(answer.reason)
            found += answer.result
            line.update(1)
    cells = ReviewCells.join(found) if found else None
    if cells is None or not len(cells):
        raise StageError(
            "no point is ground, vegetation or a building",
            found=", ".join(request.files[:3]),
            cure="Classify the files first: pdal-stages classify raw.laz classified.laz",
        )
    patches = find_patches(cells)
    held = np.cumsum(patches.errors)
    listed = int(np.searchsorted(held, request.share * held[-1])) + 1 if held[-1] > 0 else 0
    return Review(cells, patches, min(listed, len(patches)), request.files)


def cells_of(path: str, wkt: str, model: str, side: float, number: int) -> list[ReviewCells]:
    """The cells of a file, whose number it is; reliabilities are as they are there, or made now, which is said."""
    found: list[ReviewCells] = []
    whole: list[Part] = []
    for part in parts_of(path, wkt):
        if "Reliability" not in part.arrays:
            whole.append(part)
        elif len(part):
            found.append(ReviewCells.of(part.xyz, part.codes, part.arrays["Reliability"], side, number))
    if whole:
        print_messages(
            f"{path} has no Reliability: made now by the model {model}, which takes as long as classifying"
        )
        part = Part.join(whole)
        found.append(ReviewCells.of(part.xyz, part.codes, reliability_of(part, model), side, number))
    return [ReviewCells.join(found)] if found else []


def _extent(files: Sequence[str], references: dict[str, Any]) -> tuple[int, float]:
    """Points and square meters of the files, as their headers say."""
    points, area = 0, 0.0
    for path in files:
        header = read_header(path) if reads_in_parts(path) else None
        if header is not None and header.count:
            west, south, east, north = header.box
            points += header.count
            area += (east - west) * (north - south) * references[path][0].units.horizontal ** 2
    return (points, area) if area > 0 else (1, 1e-9)


def reliability_of(points: Part, model: str) -> NDArray[np.float32]:
    """The probability that a model gives to the class each point has; 1 for classes that it does not know."""
    loaded = loaded_model(model)
    made = {}
    if list(loaded.info.get("preparation") or []) == list(PREPARATION):  # else it says what it needs
        made = dict(made_of_coordinates(PREPARATION, points.xyz))
    given = {name: points.arrays[name] for name in loaded.welcome_dimensions if name in points.arrays}
    found: Any = loaded.predict(points.xyz, {**made, **given}, probabilities=True).probabilities
    place = np.full(256, -1)
    place[loaded.codes] = np.arange(len(loaded.codes))
    lower = [code for code in (3, 4) if place[code] < 0]
    place[lower] = place[5]  # vegetation as one class
    mine = place[points.codes]
    own = np.take_along_axis(found, np.maximum(mine, 0)[:, None], axis=1)[:, 0]
    return np.where(mine >= 0, own, 1.0).astype(np.float32)


def write_review(request: ReviewRequest) -> Review:
    """Review files, and write what is asked for."""
    check_target(request.output, LAYERS)
    outputs = [Output(request.output, "review")]
    outputs += [Output(request.html, "html", kinds.HTML)] if request.html else []
    outputs += [Output(request.json, "json", kinds.JSON)] if request.json else []
    check_outputs(outputs, [*request.files, *request.inputs])
    found = review_files(request)
    reference, wkt = reference_and_wkt(request.files[0])
    layers = review_layers(found, reference.units.horizontal)
    write_layers(request.output, layers, wkt, styles(found.patches.errors))
    if request.json:
        write_whole(request.json, (json.dumps(found.to_dict(), indent=1) + "\n").encode())
    if request.html:
        write_whole(request.html, review_page(found.to_dict(), _minutes(found)).encode())
    return found


def _minutes(found: Review) -> list[tuple[float, float]]:
    """(share of the expected errors, minutes to look at the patches that hold it)."""
    held, spent = np.cumsum(found.patches.errors), np.cumsum(found.patches.minutes)
    if not len(held) or held[-1] <= 0:
        return []
    shares = (0.25, 0.5, 0.75, 0.9)
    places = [min(int(np.searchsorted(held, share * held[-1])), len(spent) - 1) for share in shares]
    return [(share, float(spent[place])) for share, place in zip(shares, places, strict=True)]


def review_layers(found: Review, across: float = 1.0) -> dict[str, Layer]:
    """Layers ``patches``, best first, and ``tiles``; coordinates in units of `across` meters."""
    shapely = vector("shapely")
    patches, n, corners = found.patches, found.listed, found.cells.corners / across
    boxes = shapely.box(*corners.T)
    order = np.argsort(patches.of_cell, kind="stable")
    ends = np.searchsorted(patches.of_cell[order], np.arange(n + 1))
    shapes = [shapely.union_all(boxes[order[a:b]]) for a, b in pairwise(ends)]
    columns = {
        name: np.array([row[name] for row in found.rows], kind)
        for name, kind in (
            ("rank", int),
            ("expected", float),
            ("points", int),
            ("area", float),
            ("seconds", float),
        )
    }
    columns["per_minute"] = np.round(patches.errors[:n] / patches.minutes[:n], 1)
    columns |= {name: np.array([row[name] for row in found.rows], object) for name in ("reason", "tile")}
    columns["done"] = np.zeros(n, np.int32)
    number = {Path(name).name: k for k, name in reversed(list(enumerate(found.files)))}
    outlines, kept = [], []
    for row in found.tiles:
        at = found.cells.place[:, 0] == number[row["tile"]]
        if at.any():
            outlines.append(shapely.box(*corners[at, :2].min(axis=0), *corners[at, 2:].max(axis=0)))
            kept.append(row)
    tiles = {
        "tile": np.array([row["tile"] for row in kept], object),
        "points": np.array([row["points"] for row in kept], np.int64),
        "expected": np.round([row["expected"] for row in kept], 1),
        "percent": np.round([100.0 * row["share"] for row in kept], 2),
        "patches": np.array([row["patches"] for row in kept], np.int64),
        "minutes": np.round([row["minutes"] for row in kept], 1),
    }
    layers = {"patches": (shapes, columns), "tiles": (outlines, tiles)}
    return {
        name: Layer([shapely.MultiPolygon(shapely.get_parts(s)) for s in of], "MultiPolygon", fields)
        for name, (of, fields) in layers.items()
    }
