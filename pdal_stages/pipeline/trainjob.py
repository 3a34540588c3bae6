"""The pipeline behind ``train``."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, cast

from ..classifier.summary import FILE_NUMBER
from ..stages.heights import preparation_of
from .ends import overridden, reader_of
from .lowering import lower_stage
from .overrides import Override
from .runtime import python_filter

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
    from ..stages.classifiermodel import ClassifierModel

    writer = {"type": "writers.classifiermodel", "filename": model, **options}
    stage = cast(ClassifierModel, lower_stage(overridden(writer, overrides)).stage)
    base = stage.training.base
    heights = preparation_of(stage.wished) if base is None else base.info.get("preparation") or []
    readers = [reader_of(name, f"input{i}") for i, name in enumerate(sources, 1)]
    if len(readers) == 1 or stage.groups or stage.survey or stage.algorithm != "random_forest":
        return [*readers, *heights, writer]
    number = python_filter("pdal_stages_file_number", _NUMBER, {}, {FILE_NUMBER: "uint32_t"})
    return [*readers, number, *heights, {**writer, "groups": FILE_NUMBER}]
