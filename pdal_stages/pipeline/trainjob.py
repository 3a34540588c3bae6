"""The pipeline behind ``train``."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, cast

from ..classifier.summary import FILE_NUMBER
from ..stages.heights import preparation_of
from .ends import overridden, reader_of
from .lowering import lower_stage
from .overrides import Override
from .runtime import python_filter

if TYPE_CHECKING:
    from ..stages.classifiermodel import ClassifierModel

#: PDAL calls this for the points of one reader after the other.
_NUMBER = f"""\
import numpy as np
number = 0
def stage(ins, outs):
    global number
    number += 1
    outs["{FILE_NUMBER}"] = np.full(len(ins["X"]), number, np.uint32)
    return True
"""


def train_pipeline(
    sources: Iterable[str], model: str, overrides: Iterable[Override] = (), **options: Any
) -> list[dict[str, Any]]:
    """Read labeled files, give heights if wanted, train, write the model; of several files the score is by file."""
    writer = {"type": "writers.classifiermodel", "filename": model, **options}
    stage = lowered_writer(overridden(writer, overrides))
    heights = heights_for(stage)
    readers = [reader_of(name, f"input{i}") for i, name in enumerate(sources, 1)]
    if not numbered(stage, len(readers)):
        return [*readers, *heights, writer]
    number = python_filter("pdal_stages_file_number", _NUMBER, {}, {FILE_NUMBER: "uint32_t"})
    return [*readers, number, *heights, {**writer, "groups": FILE_NUMBER}]


def lowered_writer(given: Mapping[str, Any]) -> ClassifierModel:
    """The stage that trains."""
    return cast("ClassifierModel", lower_stage(dict(given)).stage)


def heights_for(stage: ClassifierModel) -> list[dict[str, Any]]:
    """The stages that make what it reads: those of the model it builds on, or heights."""
    base = stage.training.base
    return preparation_of(stage.wished) if base is None else base.info.get("preparation") or []


def numbered(stage: ClassifierModel, files: int) -> bool:
    """Whether the score is by file, so that points need their file's number."""
    by_itself = stage.groups or stage.survey or stage.algorithm != "random_forest"
    return files > 1 and not by_itself
