"""What is behind ``review``: classified files in, patches that a person should look at out."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base import checks, kinds
from ..base.errors import StageError
from ..base.files import write_whole
from ..base.las import read_header
from ..base.outputs import Output, check_outputs
from ..base.plain import print_messages
from ..base.progress import Progress
from ..base.version import __version__
from ..models import STANDARD
from ..objects.outlines import vector
from ..reports.objectlayers import Layer, check_target, write_layers
from ..reports.reviewlayers import patch_style, tile_style
from ..reports.reviewpage import PatchView, draw_patch, review_page
from ..review import (
    Outlook,
    Patches,
    Records,
    Settings,
    find_patches,
    outlook,
    side_for,
    standard_calibration,
)
from ..review.patches import REASONS
from ..stages.heights import PREPARATION, made_of_coordinates
from ..stages.loading import loaded_model
from .inputs_outputs import input_files
from .parts import Part, parts_of, reads_in_parts, reference_and_wkt
from .processes import each_file
from .references import check_one_reference, without_reference

#: Classes by which a model's own class is known under another code.
_SAME = {3: 5, 4: 5}
#: What is written, in this order.
LAYERS = ("patches", "tiles")
#: Meters of surroundings in a picture.
_MARGIN = 6.0


@dataclass(frozen=True)
class ReviewRequest:
    """What is reviewed, and what is written.

    Attributes
    ----------
    inputs : tuple of str
        Classified files, folders, patterns.
    output : str
        Vector file.
    html, json : str
        A page with pictures, and figures; empty for none.
    share : float
        Patches are written until they hold this share of the expected errors.
    pictures : int
        Patches that the page shows.
    model : str
        What gives reliabilities where the files have none.
    settings : Settings
        Its cell is chosen by the density where it is 0.
    workers : int
        Files read at the same time.
    """

    inputs: tuple[str, ...]
    output: str
    html: str = ""
    json: str = ""
    share: float = 0.95
    pictures: int = 40
    model: str = STANDARD
    settings: Settings = field(default_factory=lambda: Settings(cell=0.0))
    workers: int = 1

    @cached_property
    def files(self) -> list[str]:
        """All inputs."""
        return input_files(self.inputs)


def request_of(
    inputs: Sequence[str],
    output: str,
    *,
    html: str | None = None,
    cell: float | None = None,
    **more: Any,
) -> ReviewRequest:
    """What a command asks for; the page lies beside the vector file where `html` is None.

    Raises
    ------
    OptionError
        If a number is out of bounds.
    """
    page = str(Path(output).with_suffix(".html")) if html is None else html
    if cell is not None:
        cell = checks.number("'--cell'", cell, 0.5, 100, unit="m")
    checks.number("'--share'", more.get("share", 1.0), 0, 1, above=True)
    checks.whole("'--pictures'", more.get("pictures", 0), 0, 10_000)
    checks.whole("'--workers'", more.get("workers", 1), 1, 1024)
    return ReviewRequest(tuple(inputs), output, page, settings=Settings(cell=cell or 0.0), **more)


@dataclass
class Review:
    """What was found.

    Attributes
    ----------
    seen : Outlook
    patches : Patches
    listed : int
        Patches that are written: those that come first.
    files : list of str
    settings : Settings
    """

    seen: Outlook
    patches: Patches
    listed: int
    files: list[str]
    settings: Settings

    @property
    def points(self) -> int:
        """All that were judged."""
        return int(self.seen.records.points[:, :3].sum())

    @cached_property
    def tiles(self) -> list[dict[str, Any]]:
        """A row for each file: points, points expected wrong, patches listed, minutes to look at these; worst first."""
        records, patches = self.seen.records, self.patches
        n = len(self.files)
        points = np.bincount(records.tile, records.points[:, :3].sum(axis=1), n)
        errors = np.bincount(records.tile, self.seen.total, n)
        mine = patches.tile[: self.listed]
        number = np.bincount(mine, minlength=n)
        minutes = np.bincount(mine, patches.minutes[: self.listed], n)
        rows = [
            {
                "tile": Path(name).name,
                "points": int(points[k]),
                "expected": float(errors[k]),
                "share": float(errors[k] / max(points[k], 1)),
                "patches": int(number[k]),
                "minutes": float(minutes[k]),
            }
            for k, name in enumerate(self.files)
        ]
        return sorted(rows, key=lambda row: (-row["expected"], row["tile"]))

    def to_dict(self) -> dict[str, Any]:
        """Figures, for JSON."""
        patches = self.patches
        return {
            "version": __version__,
            "points": self.points,
            "expected": float(patches.errors.sum()),
            "patches": len(patches),
            "listed": self.listed,
            "settings": asdict(self.settings),
            "tiles": self.tiles,
            "worst": [self.row(number) for number in range(min(self.listed, 1000))],
        }

    def row(self, number: int) -> dict[str, Any]:
        """A patch as plain values."""
        p = self.patches
        return {
            "rank": number + 1,
            "tile": Path(self.files[p.tile[number]]).name,
            "expected": round(float(p.errors[number]), 1),
            "points": int(p.points[number]),
            "area": float(p.area[number]),
            "seconds": round(60.0 * float(p.minutes[number]), 1),
            "reason": ", ".join(REASONS[word] for word in p.reasons[number]),
            "box": [round(float(v), 3) for v in p.box[number]],
        }


def review_files(request: ReviewRequest) -> Review:
    """Read the files and find the patches.

    Raises
    ------
    StageError
        If a file cannot be read, or there is nothing to judge.
    """
    references = {path: reference_and_wkt(path) for path in request.files}
    without = check_one_reference({path: one for path, (one, _) in references.items()})
    print_messages(*without_reference(without))
    side = request.settings.cell or side_for(*_extent(request.files, references))
    records: list[Records] = []
    work = [
        (path, references[path][1], request.model, side, number) for number, path in enumerate(request.files)
    ]
    with Progress(len(work), "reading", "files") as line:
        for _, answer in each_file(records_of, work, request.workers):
            if answer.reason:
                raise StageError(answer.reason)
            records += answer.result
            if len(records) >= 8:
                records = [Records.join(records)]
            line.update(1)
    if not records:
        raise StageError("there are no points to review", found=", ".join(request.files[:3]))
    joined = Records.join(records)
    if not joined.points[:, :3].any():
        raise StageError(
            "no point is ground, vegetation or a building",
            found=", ".join(request.files[:3]),
            cure="Classify the files first: pdal-stages classify raw.laz classified.laz",
        )
    settings = replace(request.settings, cell=side)
    seen = outlook(joined, standard_calibration())
    patches = find_patches(seen, settings)
    held = np.cumsum(patches.errors)
    listed = int(np.searchsorted(held, request.share * held[-1])) + 1 if held[-1] > 0 else 0
    return Review(seen, patches, min(listed, len(patches)), request.files, settings)


def records_of(path: str, wkt: str, model: str, side: float, number: int) -> list[Records]:
    """What the cells of a file say, in one record at most; `number` is the file's."""
    rates = standard_calibration().rates
    out: list[Records] = []
    for part in complete_parts(path, wkt, model):
        if len(part):
            reliability, height = (part.arrays[name] for name in ("Reliability", "HeightAboveGround"))
            strip = part.arrays.get("PointSourceId")
            made = Records.of(
                part.xyz, part.codes, reliability, height, side, rates, tile=number, strip=strip
            )
            out = [Records.join([*out, made])]
    return out


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


def complete_parts(path: str, wkt: str, model: str) -> Any:
    """The points of a file with reliabilities and heights: as they are there, or made now, which is said."""
    missing: list[str] | None = None
    whole: list[Part] = []
    for part in parts_of(path, wkt):
        if missing is None:
            missing = [n for n in ("Reliability", "HeightAboveGround") if n not in part.arrays]
            if missing:
                print_messages(
                    f"{path} has no {' and no '.join(missing)}: made now"
                    + (
                        f" by the model {model}, which takes as long as classifying"
                        * ("Reliability" in missing)
                    )
                )
        if missing:
            whole.append(part)
        else:
            yield part
    if whole:
        yield completed(Part.join(whole), model)


def completed(points: Part, model: str) -> Part:
    """The points with heights above ground, and with the probability that the model gives to the class each has."""
    arrays = dict(points.arrays)
    made = dict(made_of_coordinates(PREPARATION, points.xyz))
    arrays.setdefault("HeightAboveGround", made["HeightAboveGround"])
    if "Reliability" not in arrays:
        loaded = loaded_model(model)
        if list(loaded.info.get("preparation") or []) != list(PREPARATION):
            made = {}  # the model says what it needs, or how it is made
        given = {name: arrays[name] for name in loaded.welcome_dimensions if name in arrays}
        found = loaded.predict(points.xyz, {**made, **given}, probabilities=True)
        place = np.full(256, -1)
        place[loaded.codes] = np.arange(len(loaded.codes))
        for code, known in _SAME.items():
            if place[code] < 0:
                place[code] = place[known]
        mine = place[points.codes]
        probability: Any = found.probabilities
        own = np.take_along_axis(probability, np.maximum(mine, 0)[:, None], axis=1)[:, 0]
        arrays["Reliability"] = np.where(mine >= 0, own, 1.0).astype(np.float32)
    return Part(points.xyz, points.codes, arrays)


# ---- writing -----------------------------------------------------------------------------------------------


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
    write_layers(
        request.output, layers, wkt, {"patches": patch_style(found.patches.errors), "tiles": tile_style()}
    )
    if request.json:
        write_whole(request.json, (json.dumps(found.to_dict(), indent=1) + "\n").encode())
    if request.html:
        views = draw_worst(found, request.pictures)
        page = review_page(found.to_dict(), views, minutes=_minutes(found))
        write_whole(request.html, page.encode())
    return found


def _minutes(found: Review) -> list[tuple[float, float]]:
    """(share of the expected errors, minutes to look at the patches that hold it)."""
    held, spent = np.cumsum(found.patches.errors), np.cumsum(found.patches.minutes)
    if not len(held) or held[-1] <= 0:
        return []
    places = [int(np.searchsorted(held, share * held[-1])) for share in (0.25, 0.5, 0.75, 0.9)]
    return [
        (share, float(spent[min(place, len(spent) - 1)]))
        for share, place in zip((0.25, 0.5, 0.75, 0.9), places, strict=True)
    ]


def review_layers(found: Review, across: float = 1.0) -> dict[str, Layer]:
    """Layers ``patches``, best first, and ``tiles``; coordinates in units of `across` meters."""
    shapely = vector("shapely")
    patches, n = found.patches, found.listed
    corners = cell_corners(found) / across
    boxes = shapely.box(*corners.T)
    mine = np.flatnonzero(patches.of_cell < n)
    order = mine[np.argsort(patches.of_cell[mine], kind="stable")]
    ends = np.searchsorted(patches.of_cell[order], np.arange(n + 1))
    shapes = [shapely.union_all(boxes[order[a:b]]) for a, b in pairwise(ends)]
    rows = [found.row(k) for k in range(n)]
    columns = {
        "rank": np.arange(1, n + 1),
        "expected": np.round(patches.errors[:n], 1),
        "points": patches.points[:n],
        "area": patches.area[:n],
        "seconds": np.round(60.0 * patches.minutes[:n], 1),
        "per_minute": np.round(patches.errors[:n] / patches.minutes[:n], 1),
        "reason": np.array([row["reason"] for row in rows], object),
        "tile": np.array([row["tile"] for row in rows], object),
        "done": np.zeros(n, np.int32),
    }
    whole = Layer([_many(shape) for shape in shapes], "MultiPolygon", columns)
    outlines, kept = [], []
    for row in found.tiles:
        number = next(k for k, name in enumerate(found.files) if Path(name).name == row["tile"])
        at = found.seen.records.tile == number
        if at.any():
            low, high = corners[at, :2].min(axis=0), corners[at, 2:].max(axis=0)
            outlines.append(_many(shapely.box(*low, *high)))
            kept.append(row)
    tiles = {
        "tile": np.array([row["tile"] for row in kept], object),
        "points": np.array([row["points"] for row in kept], np.int64),
        "expected": np.round([row["expected"] for row in kept], 1),
        "percent": np.round([100.0 * row["share"] for row in kept], 2),
        "patches": np.array([row["patches"] for row in kept], np.int64),
        "minutes": np.round([row["minutes"] for row in kept], 1),
    }
    return {"patches": whole, "tiles": Layer(outlines, "MultiPolygon", tiles)}


def cell_corners(found: Review) -> NDArray[np.float64]:
    """(cells, 4) west, south, east, north, meters."""
    from ..review.cells import rows_and_columns

    records = found.seen.records
    row, column = rows_and_columns(records.key)
    return np.stack([column, row, column + 1, row + 1], axis=1) * records.side


def _many(shape: Any) -> Any:
    return shape if shape.geom_type == "MultiPolygon" else vector("shapely").MultiPolygon([shape])


def draw_worst(found: Review, most: int) -> list[PatchView]:
    """Pictures of the first patches, in their order."""
    n = min(most, found.listed)
    patches, corners = found.patches, cell_corners(found)
    wide = patches.box[:n] + np.array([-_MARGIN, -_MARGIN, _MARGIN, _MARGIN])
    held: list[list[NDArray]] = [[] for _ in range(n)]
    with Progress(len(found.files), "drawing", "files") as line:
        for path in found.files:
            reference, wkt = reference_and_wkt(path)
            if _may_hold(path, wide / reference.units.horizontal):
                for part in parts_of(path, wkt):
                    x, y = part.xyz[:, 0], part.xyz[:, 1]
                    for number, (west, south, east, north) in enumerate(wide):
                        at = np.flatnonzero((x >= west) & (x <= east) & (y >= south) & (y <= north))
                        if len(at):
                            held[number].append(np.column_stack([part.xyz[at], part.codes[at]]))
            line.update(1)
    views = []
    for number in range(n):
        if held[number]:
            cells = corners[patches.of_cell == number]
            hottest = found.seen.total[patches.of_cell == number]
            views.append(draw_patch(found.row(number), np.concatenate(held[number]), cells, hottest))
    return views


def _may_hold(path: str, boxes: NDArray[np.float64]) -> bool:
    """Whether the header of a file says that points may lie in one of the boxes."""
    header = read_header(path) if reads_in_parts(path) else None
    if header is None:
        return True
    west, south, east, north = header.box
    return bool(
        (
            (boxes[:, 0] <= east) & (boxes[:, 2] >= west) & (boxes[:, 1] <= north) & (boxes[:, 3] >= south)
        ).any()
    )
