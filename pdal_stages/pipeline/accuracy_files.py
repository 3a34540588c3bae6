"""The command ``accuracy``: class dimensions of files against those of reference files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from ..base.errors import DimensionError, StageError, suggest
from ..base.files import check_outputs
from ..base.json_types import StageJson
from ..base.las import header_there
from ..base.las_check import check_readable
from ..base.las_points import LasColumns, Layout
from ..base.messages import Message, Report
from ..base.progress import Progress
from ..base.units import METERS_PER_DEGREE, is_geographic
from ..stages.accuracy import AccuracyStage
from ..stages.points import Points
from ..stages.registry import stage_from
from .expansion import stage_files
from .inputs_outputs import input_files, is_las
from .json_source import Override, apply_overrides
from .pdal import reader_of
from .run import Pipeline
from .runtime import points_of_views
from .spatial_reference import text_of

#: What to do where the true classes are not known.
WHAT_IS_TRUE = (
    "Say where the true classes are: --reference FILE, of the same points, or "
    "--reference-dimension NAME, which filters.ferry may have kept before classifying"
)


def compare_files(
    sources: Sequence[str],
    references: Sequence[str],
    dimension: str,
    reference_dimension: str,
    overrides: Sequence[Override] = (),
    **outputs: str,
) -> list[Message]:
    """Compare files with others that hold the same points in the same order, paired by name.

    Returns messages for the user. Both are files, folders or patterns; `outputs` are options of
    ``filters.accuracy``. Without references the true classes are another dimension of the files.
    """
    files = input_files(sources)
    pairs = paired(files, input_files(references)) if references else [(file, "") for file in files]
    listed = {"files": [name for pair in pairs for name in pair if name]}
    wanted: StageJson = {"type": "filters.accuracy", **listed, **outputs}
    (options,) = apply_overrides([wanted], overrides)
    renamed = {"dimension": "Classification", "reference": "Reference"}
    stage = cast(AccuracyStage, stage_from({**options, **renamed}))
    read = [*listed["files"], *sources, *references, *stage_files(stage)]
    check_outputs(stage.outputs(), read)
    parts = []
    kept = {"X", "Y", "Z", "Reliability"}
    kept |= {span.dimension for span in stage.ignore.spans} if stage.ignore else set()
    with Progress(len(pairs), "reading", "files") as bar:
        for source, reference in pairs:
            points, judged, true = _paired(source, reference, dimension, reference_dimension)
            arrays = {name: values for name, values in points.arrays.items() if name in kept}
            arrays |= {"Classification": judged, "Reference": true}
            arrays["Withheld"] = points.flag("Withheld")
            parts.append((Path(source).name, stage.points(arrays, wkt=points.wkt)))
            bar.update(1)
    if not any(points.count for _, points in parts):
        raise StageError("there are no points to compare", found=", ".join(files[:3]))
    shared = set.intersection(*(set(points.arrays) for _, points in parts))
    for _, points in parts:
        points.arrays = {name: values for name, values in points.arrays.items() if name in shared}
    report = Report()
    stage.compare([part for part in parts if part[1].count], report)
    for _, points in parts:
        report.merge(points.report)
    return report.messages


#: Points of two files that are farther apart along an axis, in meters, are not the same: formats
#: round coordinates to as much.
_FAR_APART_M = 0.01

#: Points of a file, their judged and their true classes (n,).
Judged = tuple[Points, NDArray[np.uint8], NDArray[np.uint8]]


def _paired(source: str, reference: str, dimension: str, reference_dimension: str) -> Judged:
    """Return the points of a file with its classes and those of its reference, if it has one."""
    points = _read(source)
    judged, other = _codes(points, dimension, source), points
    if reference:
        other = _read(reference)
        _refuse_other_points(points, other, source, reference)
    return points, judged, _codes(other, reference_dimension, reference or source)


def paired(sources: Sequence[str], references: Sequence[str]) -> list[tuple[str, str]]:
    """Return files with their references: of the same name, or the longest one inside theirs.

    ``c_town`` is paired with ``town``.
    """
    if len(sources) == len(references) == 1:
        return [(sources[0], references[0])]
    by_name = {Path(reference).stem: reference for reference in references}
    pairs: dict[str, str] = {}
    for source in sources:
        inside = [name for name in by_name if name in Path(source).stem]
        if not inside:
            cure = f"Name the references like the files they belong to, not {', '.join(by_name)}"
            raise StageError("a file has no reference with its name", found=source, cure=cure)
        reference = by_name[max(inside, key=len)]
        if (other := pairs.setdefault(reference, source)) is not source:
            both = f"{other} and {source}: {reference}"
            raise StageError("two files have the same reference", found=both)
    return [(source, reference) for reference, source in pairs.items()]


def _read(source: str) -> Points:
    """Return all points of a file."""
    if is_las(source):
        check_readable(source)
        wkt, _ = text_of({"type": "readers.las", "filename": source})
        return Points(LasColumns([(Layout.of_file(source), source)]), wkt=wkt)
    pipeline = Pipeline([reader_of(source, "input")])
    pipeline.execute()
    return points_of_views(pipeline.arrays, pipeline.metadata)


def _codes(points: Points, name: str, source: str) -> NDArray[np.uint8]:
    """Return a dimension of class codes."""
    if name not in points.arrays:
        what, names = f"the dimension '{name}' is missing", ", ".join(points.arrays)
        cure = f"{suggest(name, points.arrays)}{WHAT_IS_TRUE}"
        raise DimensionError(what, where=source, found=names, cure=cure)
    return points.codes_of(name)


def _tolerances(points: Points, *files: str) -> list[float]:
    """Return how far apart the same point may lie in two files, for each axis in its unit.

    It is one step of the coarser coordinates where both are LAS files, else `_FAR_APART_M`.
    """
    headers = [header_there(file) for file in files]
    steps = [header.scales for header in headers if header is not None]
    if len(steps) == len(files):
        return [max(scales) for scales in zip(*steps, strict=True)]
    try:
        across, upward = points.units.horizontal, points.units.vertical
    except StageError:  # degrees, or meters from the earth's center
        geocentric = points.wkt and not is_geographic(points.wkt)
        across, upward = 1.0 if geocentric else METERS_PER_DEGREE, 1.0
    return [_FAR_APART_M / unit for unit in (across, across, upward)]


def _refuse_other_points(judged: Points, true: Points, source: str, reference: str) -> None:
    """Refuse a reference that holds other points, or the same in another order."""
    difference = f"{judged.count:,} points in {source}, {true.count:,} in {reference}"
    if judged.count == true.count:
        limits = dict(zip("XYZ", _tolerances(judged, source, reference), strict=True))
        axes = [axis for axis in limits if axis in judged.arrays and axis in true.arrays]
        away = [np.abs(judged.arrays[axis] - true.arrays[axis]) > limits[axis] for axis in axes]
        number = max(map(np.count_nonzero, away), default=0)
        if not number:
            return
        difference = f"{number:,} points of {source} and {reference} lie apart"
    what = "the two files do not hold the same points in the same order"
    cure = (
        "Compare files of the same points, or keep the labels with filters.ferry while classifying"
    )
    raise StageError(what, found=difference, cure=cure)
