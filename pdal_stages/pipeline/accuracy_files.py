"""The command ``accuracy``: two class dimensions of files, or files against reference files of the
same points.
"""

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
from ..stages.accuracy import AccuracyStage
from ..stages.points import Points
from ..stages.registry import stage_from
from .classify_request import ClassifyRequest
from .inputs_outputs import in_folders, input_files, reader_of, stage_files
from .overrides import Override, apply_overrides
from .run import Pipeline
from .runtime import points_of_views

#: What to do where the true classes are not known.
WHAT_IS_TRUE = (
    "Say where the true classes are: --reference FILE, of the same points, or "
    "--reference-dimension NAME, which "
    "filters.ferry may have kept before classifying"
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
    own = [one for one in overrides if not model or one.selector == AccuracyStage.type]
    if model:
        wanted["model"] = model
    (given,) = apply_overrides([wanted], own)
    renamed = {"dimension": "Classification", "reference": "Reference"}
    stage = cast(AccuracyStage, stage_from({**given, **renamed}))
    read = [*listed["files"], *sources, *references, *stage_files(stage)]
    check_outputs(stage.outputs(), read)
    others = tuple(one for one in overrides if one not in own)
    parts = []
    kept = {"X", "Y", "Z", "Reliability", "Margin"}
    kept |= {span.dimension for span in stage.ignore.spans} if stage.ignore else set()
    with Progress(len(pairs), "reading" if not model else "classifying", "files") as bar:
        for source, reference in pairs:
            if model:
                ferry = {"type": "filters.ferry", "dimensions": f"{reference_dimension}=>{_TRUTH}"}
                mine = _read(source, [ferry, *ClassifyRequest(model, others).stages], others)
                judged, true = _codes(mine, "Classification", source), _codes(mine, _TRUTH, source)
            else:
                mine = _read(source)
                judged, other = _codes(mine, dimension, source), mine
                if reference:
                    other = _read(reference)
                    _refuse_other_points(mine, other, source, reference)
                true = _codes(other, reference_dimension, reference or source)
            arrays = {name: values for name, values in mine.arrays.items() if name in kept}
            arrays |= {
                "Withheld": mine.flag("Withheld"),
                "Classification": judged,
                "Reference": true,
            }
            parts.append((Path(source).name, stage.points(arrays, wkt=mine.wkt)))
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


#: Dimension that keeps the files' own classes while a model assigns new ones.
_TRUTH = "TrueClass"


def paired(sources: Sequence[str], references: Sequence[str]) -> list[tuple[str, str]]:
    """Files with their references: of the same name, or the longest name inside theirs (c_town:
    town).

    Names are looked for in the same folder (`in_folders`) where a name comes twice.
    """
    if len(sources) == len(references) == 1:
        return [(sources[0], references[0])]
    by_name = dict(zip(_places_and_names(references), references, strict=True))
    pairs: dict[str, str] = {}
    for source, (place, stem) in zip(sources, _places_and_names(sources), strict=True):
        inside = [one for one in by_name if one[0] == place and one[1] in stem]
        if not inside:
            raise StageError(
                "a file has no reference with its name",
                found=source,
                cure="Name the references like the files they belong to, not "
                + ", ".join([os.path.join(*one) for one in by_name][:5]),
            )
        reference = by_name[max(inside, key=lambda one: len(one[1]))]
        if reference in pairs:
            raise StageError(
                "two files have the same reference",
                found=f"{pairs[reference]} and {source}: {reference}",
            )
        pairs[reference] = source
    return [(source, reference) for reference, source in pairs.items()]


def _places_and_names(files: Sequence[str]) -> list[tuple[str, str]]:
    """The folders, empty where no name comes twice, and names without suffix."""
    return [os.path.split(name) for name in in_folders(files, [Path(file).stem for file in files])]


def _read(
    source: str, stages: Sequence[dict[str, Any]] = (), overrides: Sequence[Override] = ()
) -> Points:
    """All points of a file, after some stages."""
    pipeline = Pipeline([reader_of(source, "input"), *stages], overrides)
    pipeline.execute()
    return points_of_views(pipeline.arrays, pipeline.metadata)


def _codes(points: Points, name: str, source: str) -> NDArray[np.uint8]:
    """A dimension of class codes."""
    if name not in points.arrays:
        raise DimensionError(
            f"the dimension '{name}' is missing",
            where=source,
            found=", ".join(points.arrays),
            cure=f"{suggest(name, points.arrays)}{WHAT_IS_TRUE}",
        )
    return points.codes_of(name)


def _refuse_other_points(mine: Points, true: Points, source: str, reference: str) -> None:
    named = [name for name in ("X", "Y", "Z") if name in mine.arrays and name in true.arrays]
    if mine.count != true.count:
        found = f"{mine.count:,} points in {source}, {true.count:,} in {reference}"
    else:
        apart = [np.count_nonzero(np.abs(mine.arrays[n] - true.arrays[n]) > 0.01) for n in named]
        found = (
            f"{max(apart, default=0):,} points of {source} and {reference} lie apart"
            if any(apart)
            else ""
        )
    if found:
        raise StageError(
            "the two files do not hold the same points in the same order",
            found=found,
            cure="Compare files of the same points, or keep the labels with filters.ferry while "
            "classifying",
        )
