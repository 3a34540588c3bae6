"""Pipelines behind the short commands: classify, train, accuracy."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ..base.asprs import LEGACY_LIMIT
from ..base.errors import DimensionError, StageError
from ..base.outputs import check_outputs
from .filenames import stage_files
from .overrides import Override


def classify_pipeline(
    source: str, target: str, model: str, *, where: str | None = None
) -> list[dict[str, Any]]:
    """Read, give heights if the model wants them, classify, write with everything else kept."""
    from ..stages.modelclassifier import loaded_model

    stages: list[dict[str, Any]] = [_reader(source, "input")]
    if "HeightAboveGround" in loaded_model(model).required_dimensions:
        stages.append({"type": "filters.hag_minima"})
    classifier: dict[str, Any] = {"type": "filters.modelclassifier", "model": model}
    if where:
        classifier["where"] = where
    stages.append(classifier)
    stages.append(_writer(target))
    return stages


def train_pipeline(sources: Iterable[str], model: str, **options: Any) -> list[dict[str, Any]]:
    """Read labelled files, give heights if wanted, train, write the model."""
    from ..stages.classifiermodel import ClassifierModel

    writer = {"filename": model, **options}
    stages: list[dict[str, Any]] = [_reader(name, f"input{i}") for i, name in enumerate(sources, 1)]
    if "HeightAboveGround" in ClassifierModel(writer).reads():
        stages.append({"type": "filters.hag_minima"})
    stages.append({"type": ClassifierModel.type, **writer})
    return stages


def accuracy_pipeline(source: str, dimension: str, reference: str, **outputs: str) -> list[dict[str, Any]]:
    """Read, compare two dimensions."""
    return [
        _reader(source, "input"),
        {"type": "filters.accuracy", "dimension": dimension, "reference": reference, **outputs},
    ]


def attach_reference(
    source: str,
    reference: str,
    dimension: str,
    reference_dimension: str,
    overrides: Iterable[Override] = (),
    **outputs: str,
) -> None:
    """Compare two files that hold the same points in the same order.

    Raises
    ------
    StageError
        If they do not hold the same points.
    """
    from ..stages.accuracy import AccuracyStage
    from . import pdal as pdal_env
    from .overrides import apply_overrides
    from .run import Pipeline

    (given,) = apply_overrides([{"type": AccuracyStage.type, **outputs}], overrides)
    compared = {"dimension": "Classification", "reference": "Reference", "horizontal_unit": "m"}
    stage = AccuracyStage({k: v for k, v in given.items() if k != "type"} | compared)
    check_outputs(stage.outputs(), [source, reference, *stage_files(stage)])
    both: list[Any] = []
    for name in (source, reference):
        pipeline = Pipeline([_reader(name, "input")])
        pipeline.execute()
        array: Any = np.concatenate(pipeline.arrays) if pipeline.arrays else np.empty(0)
        both.append(array)
        names = array.dtype.names or ()
        if "Classification" in names and pdal_env.flags_inside_classification(names, pipeline.metadata):
            array["Classification"] &= LEGACY_LIMIT
    mine, true = both
    if len(mine) != len(true):
        raise StageError(
            "the two files do not hold the same points",
            found=f"{len(mine):,} points in {source}, {len(true):,} in {reference}",
            cure="Compare files of the same points, or keep the labels with filters.ferry while classifying",
        )
    for axis in "XYZ":
        apart = np.abs(mine[axis] - true[axis])
        if apart.size and apart.max() > 0.01:
            raise StageError(
                "the two files do not hold the same points in the same order",
                found=f"{int(np.count_nonzero(apart > 0.01)):,} points differ in {axis}",
                cure="Keep the labels with filters.ferry while classifying instead",
            )
    for array, name, file in ((mine, dimension, source), (true, reference_dimension, reference)):
        if name not in (array.dtype.names or ()):
            raise DimensionError(f"the dimension '{name}' is missing", where=file)
    arrays = {name: np.ascontiguousarray(mine[name]) for name in mine.dtype.names}
    arrays["Classification"], arrays["Reference"] = mine[dimension], true[reference_dimension]
    stage.run(stage.points(arrays))


def _reader(source: str, tag: str) -> dict[str, Any]:
    """A reader; of LAS 1.0-1.3 it takes the extra dimensions too, which PDAL leaves out unless told."""
    stage: dict[str, Any] = {"filename": str(source), "tag": tag}
    if Path(source).suffix.lower() in (".las", ".laz") and not str(source).lower().endswith(".copc.laz"):
        stage.update({"type": "readers.las", "use_eb_vlr": True})
    return stage


def _writer(target: str) -> dict[str, Any]:
    """A writer that keeps the input's header and all dimensions, where it is a LAS file."""
    stage: dict[str, Any] = {"filename": target, "tag": "output"}
    if Path(target).suffix.lower() in (".las", ".laz"):
        stage.update({"type": "writers.las", "forward": "all", "extra_dims": "all"})
    return stage
