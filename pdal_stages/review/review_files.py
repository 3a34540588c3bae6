"""Read classified files and find the patches that a person should check."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..base import checks
from ..base.asprs import NOISE
from ..base.errors import StageError
from ..base.las import read_header
from ..base.messages import print_messages
from ..base.version import __version__
from ..classifier.load_model import loaded_model
from ..classifier.model_file import STANDARD
from ..pipeline.inputs_outputs import input_files
from ..pipeline.las_chunks import can_read_chunks, read_columns
from ..pipeline.spatial_reference import check_one_reference, reference_of_file
from ..pipeline.workers import each_file
from ..stages.points import Points
from .expected_errors import Patches, ReviewCells, find_patches, side_for

#: Dimensions that are read where they are there.
WANTED = ("Reliability", "ReturnNumber", "NumberOfReturns")


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
