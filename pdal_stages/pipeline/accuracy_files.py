"""The command ``accuracy``: class dimensions of files against those of reference files."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ..base.errors import DimensionError, StageError, suggest
from ..base.files import check_outputs
from ..base.progress import Progress
from ..base.report import Report
from ..base.units import Units, units_of_wkt
from ..stages.accuracy import AccuracyStage
from ..stages.points import Points
from ..stages.registry import stage_from
from .classify_request import ClassifyRequest
from .expansion import stage_files
from .inputs_outputs import in_folders, input_files
from .json_source import Override, apply_overrides
from .pdal import reader_of
from .run import Pipeline
from .runtime import points_of_views

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
    model: str = "",
    **outputs: str,
) -> list[str]:
    """Compare files with others that hold the same points in the same order, paired by name.

    Returns messages for the user. Both are files, folders or patterns; `outputs` are options of
    ``filters.accuracy``. Without references the true classes are another dimension of the files;
    with a `model` its classes are judged, and the files' own are the truth.
    """
    files = input_files(sources)
    pairs = paired(files, input_files(references)) if references else [(file, "") for file in files]
    listed = {"files": [name for pair in pairs for name in pair if name]}
    wanted: dict[str, Any] = {"type": "filters.accuracy", **listed, **outputs}
    of_accuracy = [each for each in overrides if not model or each.selector == AccuracyStage.type]
    if model:
        wanted["model"] = model
    (options,) = apply_overrides([wanted], of_accuracy)
    renamed = {"dimension": "Classification", "reference": "Reference"}
    stage = cast(AccuracyStage, stage_from({**options, **renamed}))
    read = [*listed["files"], *sources, *references, *stage_files(stage)]
    check_outputs(stage.outputs(), read)
    others = tuple(each for each in overrides if each not in of_accuracy)
    parts = []
    kept = {"X", "Y", "Z", "Reliability"}
    kept |= {span.dimension for span in stage.ignore.spans} if stage.ignore else set()
    with Progress(len(pairs), "reading" if not model else "classifying", "files") as bar:
        for source, reference in pairs:
            if model:
                points, judged, true = _classified(source, model, reference_dimension, others)
            else:
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


#: Points of two files that are farther apart along an axis are not the same; formats round
#: coordinates. In meters, and of degrees as many as that is along a meridian.
_FAR_APART_M = 0.01
_METERS_PER_DEGREE = 111_000.0
#: Dimension that keeps the files' own classes while a model assigns new ones.
_TRUTH = "TrueClass"

#: Points of a file, their judged and their true classes (n,).
Judged = tuple[Points, NDArray[np.uint8], NDArray[np.uint8]]


def _classified(
    source: str, model: str, reference_dimension: str, overrides: Sequence[Override]
) -> Judged:
    """Return the points of a file with the classes of a model and the file's own."""
    ferry = {"type": "filters.ferry", "dimensions": f"{reference_dimension}=>{_TRUTH}"}
    points = _read(source, [ferry, *ClassifyRequest(model, tuple(overrides)).stages], overrides)
    return points, _codes(points, "Classification", source), _codes(points, _TRUTH, source)


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

    ``c_town`` is paired with ``town``. Where a name comes twice, names are looked for in the same
    folder (`in_folders`).
    """
    if len(sources) == len(references) == 1:
        return [(sources[0], references[0])]
    by_name = dict(zip(_places_and_names(references), references, strict=True))
    pairs: dict[str, str] = {}
    for source, (place, stem) in zip(sources, _places_and_names(sources), strict=True):
        inside = [key for key in by_name if key[0] == place and key[1] in stem]
        if not inside:
            names = ", ".join([os.path.join(*key) for key in by_name][:5])
            cure = f"Name the references like the files they belong to, not {names}"
            raise StageError("a file has no reference with its name", found=source, cure=cure)
        reference = by_name[max(inside, key=lambda key: len(key[1]))]
        if (other := pairs.setdefault(reference, source)) is not source:
            both = f"{other} and {source}: {reference}"
            raise StageError("two files have the same reference", found=both)
    return [(source, reference) for reference, source in pairs.items()]


def _places_and_names(files: Sequence[str]) -> list[tuple[str, str]]:
    """Return folders, empty where no name comes twice, and names without suffix."""
    return [os.path.split(name) for name in in_folders(files, [Path(file).stem for file in files])]


def _read(
    source: str, stages: Sequence[dict[str, Any]] = (), overrides: Sequence[Override] = ()
) -> Points:
    """Return all points of a file, after some stages."""
    pipeline = Pipeline([reader_of(source, "input"), *stages], overrides)
    pipeline.execute()
    return points_of_views(pipeline.arrays, pipeline.metadata)


def _codes(points: Points, name: str, source: str) -> NDArray[np.uint8]:
    """Return a dimension of class codes."""
    if name not in points.arrays:
        what, names = f"the dimension '{name}' is missing", ", ".join(points.arrays)
        cure = f"{suggest(name, points.arrays)}{WHAT_IS_TRUE}"
        raise DimensionError(what, where=source, found=names, cure=cure)
    return points.codes_of(name)


def _refuse_other_points(judged: Points, true: Points, source: str, reference: str) -> None:
    """Refuse a reference that holds other points, or the same in another order."""
    difference = f"{judged.count:,} points in {source}, {true.count:,} in {reference}"
    if judged.count == true.count:
        try:
            units = units_of_wkt(judged.wkt)
        except StageError:  # degrees; their heights are in meters
            units = Units(_METERS_PER_DEGREE, 1.0)
        meters = {"X": units.horizontal, "Y": units.horizontal, "Z": units.vertical}
        axes = [axis for axis in meters if axis in judged.arrays and axis in true.arrays]
        away = [
            abs(judged.arrays[axis] - true.arrays[axis]) * meters[axis] > _FAR_APART_M
            for axis in axes
        ]
        number = max(map(np.count_nonzero, away), default=0)
        if not number:
            return
        difference = f"{number:,} points of {source} and {reference} lie apart"
    what = "the two files do not hold the same points in the same order"
    cure = (
        "Compare files of the same points, or keep the labels with filters.ferry while classifying"
    )
    raise StageError(what, found=difference, cure=cure)
