"""Labeled files read for training: which belong to which survey, with heights, as the stage that trains sees them."""

from __future__ import annotations

import fnmatch
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from ..base.errors import OptionError, StageError
from ..classifier.summary import FILE_NUMBER
from ..stages.classifiermodel import ClassifierModel
from ..stages.points import Points
from ..stages.preparation import preparation_of
from .expansion import expand_stage
from .inputs_outputs import check_readers, reader_of
from .read import Override
from .run import Pipeline
from .runtime import points_of_views, python_filter

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


def lowered_writer(given: Mapping[str, Any]) -> ClassifierModel:
    """The stage that trains."""
    return cast(ClassifierModel, expand_stage(dict(given)).stage)


def heights_for(stage: ClassifierModel) -> list[dict[str, Any]]:
    """The stages that make what it reads: those of the model it builds on, or heights."""
    base = stage.training.base
    return preparation_of(stage.wished) if base is None else base.info.get("preparation") or []


def surveys_of(files: Sequence[str], grouped: Sequence[str] = ()) -> dict[str, list[str]]:
    """Name -> files of each survey.

    Parameters
    ----------
    files : sequence of str
    grouped : sequence of str
        ``NAME=PATTERN``: files whose path or name is like the pattern are of that survey; each other one is its own.

    Raises
    ------
    OptionError
        If a group is not written so, or has no file, or a file is in two.
    """
    out: dict[str, list[str]] = {}
    of: dict[str, str] = {}
    for one in grouped:
        name, mark, pattern = one.partition("=")
        if not (mark and name.strip() and pattern.strip()):
            raise OptionError(
                "surveys are written NAME=PATTERN", found=one, cure="For example north='north/*.laz'"
            )
        parts = [part.strip() for part in pattern.split(",") if part.strip()]
        mine = [f for f in files if any(_like(f, part) for part in parts)]
        if not mine:
            raise OptionError("a survey has no files", found=one, cure=f"There are {', '.join(files[:5])}")
        for file in mine:
            if of.setdefault(file, name) != name:
                raise OptionError("a file is in two surveys", found=f"{file}: {of[file]} and {name}")
        out[name] = mine
    for file in files:
        if file not in of:
            name = Path(file).stem
            out.setdefault(name if name not in out else file, []).append(file)
    return out


def _like(file: str, pattern: str) -> bool:
    inside = Path(pattern).is_dir() and Path(pattern).resolve() in Path(file).resolve().parents
    return inside or fnmatch.fnmatch(file, pattern) or fnmatch.fnmatch(Path(file).name, pattern)


def read_points(
    files: Sequence[str],
    heights: Sequence[Mapping[str, Any]],
    overrides: Sequence[Override],
    stage: ClassifierModel,
) -> Points:
    """The points of some files, with heights, and with the files' numbers where they are held out by these."""
    readers = [reader_of(file, f"input{i}") for i, file in enumerate(files, 1)]
    told = check_readers(readers)
    number = python_filter("pdal_stages_file_number", _NUMBER, {}, {FILE_NUMBER: "uint32_t"})
    numbers = [number] if stage.groups == FILE_NUMBER else []
    own = [one for one in overrides if one.selector != stage.type]
    pipeline = Pipeline([*readers, *numbers, *map(dict, heights)], own)
    pipeline.execute()
    if not any(map(len, pipeline.arrays)):
        raise StageError("there are no points to train on", where=", ".join(files[:3]))
    points = points_of_views(pipeline.arrays, pipeline.metadata, stage.points)
    points.report.warnings += [*told, *(f"PDAL says: {line}" for line in pipeline.log_lines[:10])]
    points.report.warnings += pipeline.messages
    return points
