"""The pipeline behind ``train``, and training on several surveys.

Surveys do not see each other: each is read by itself, in its own reference system.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ..base.errors import OptionError, StageError
from ..base.progress import Progress
from ..base.report import Report
from ..classifier import TrainingCloud, train
from ..classifier.summary import FILE_NUMBER
from ..stages.classifiermodel import ClassifierModel
from ..stages.heights import preparation_of
from ..stages.points import Points
from . import pdal as pdal_env
from .inputs_outputs import overridden, reader_of
from .lowering import lower_stage
from .overrides import Override
from .references import check_readers
from .run import Pipeline
from .runtime import python_filter, wkt_of

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
    return cast(ClassifierModel, lower_stage(dict(given)).stage)


def heights_for(stage: ClassifierModel) -> list[dict[str, Any]]:
    """The stages that make what it reads: those of the model it builds on, or heights."""
    base = stage.training.base
    return preparation_of(stage.wished) if base is None else base.info.get("preparation") or []


def numbered(stage: ClassifierModel, files: int) -> bool:
    """Whether the score is by file, so that points need their file's number."""
    by_itself = stage.groups or stage.survey or stage.algorithm != "random_forest"
    return files > 1 and not by_itself


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


def check_surveys(given: Mapping[str, Any]) -> None:
    """Refuse a stage that tells surveys, or groups, by a dimension as well."""
    if given.get("survey") or given.get("groups"):
        raise OptionError(
            "surveys are told by files or by a dimension, not both",
            found=", ".join(f"{k}={given[k]}" for k in ("survey", "groups") if given.get(k)),
        )


def train_surveys(
    surveys: Mapping[str, Sequence[str]], model: str, overrides: Sequence[Override] = (), **options: Any
) -> list[str]:
    """Train a model on surveys, one of which is in memory at a time; what is to be told.

    Points of different surveys are not neighbors, and surveys weigh alike. The score is by survey.

    Raises
    ------
    StageError
    """
    files = [file for group in surveys.values() for file in group]
    writer = {"type": "writers.classifiermodel", "filename": model, "files": files, **options}
    given = overridden(writer, overrides)
    check_surveys(given)
    stage = lowered_writer(given)
    heights = [overridden(one, overrides) for one in heights_for(stage)]
    told: list[str] = []
    if (said := stage.follows(heights)) is not None:
        told.append(said)
    pdal_env.bindings()  # says what is wrong with PDAL before any work
    report = Report()
    training: Any = None

    def reading(name: str, group: Sequence[str], bar: Progress) -> Callable[[], TrainingCloud]:
        def read() -> TrainingCloud:
            nonlocal training
            points = _points(group, heights, overrides, stage)
            found = stage.training_on(points)
            training = training or found
            if found.dimensions != training.dimensions:
                raise StageError(
                    "the surveys do not have the same dimensions",
                    where=name,
                    found=f"{', '.join(found.dimensions)}; before: {', '.join(training.dimensions)}",
                    cure="Name those that all have: --writers.classifiermodel.dimensions=HeightAboveGround",
                )
            bar.update(1)
            cloud = replace(stage.cloud_of(points, training), name=name, survey=name)
            report.merge(points.report)
            return cloud

        return read

    with Progress(len(surveys), "reading", "surveys") as bar:
        (first, group), *others = surveys.items()
        start = reading(first, group, bar)()  # what all are trained on follows from its dimensions
        clouds = (one for one in [lambda: start, *(reading(name, group, bar) for name, group in others)])
        made = train(clouds, training)
    stage.finish(made, report)
    return [*told, *report.messages]


def _points(
    group: Sequence[str],
    heights: Sequence[Mapping[str, Any]],
    overrides: Sequence[Override],
    stage: ClassifierModel,
) -> Points:
    """A survey's points, with heights."""
    readers = [reader_of(file, f"input{i}") for i, file in enumerate(group, 1)]
    told = check_readers(readers)
    own = [one for one in overrides if one.selector != stage.type]
    pipeline = Pipeline([*readers, *map(dict, heights)], own)
    pipeline.execute()
    if not any(map(len, pipeline.arrays)):
        raise StageError("there are no points to train on", where=", ".join(group[:3]))
    points = points_in(stage, pipeline.arrays, pipeline.metadata)
    points.report.warnings += told
    return points


def points_in(stage: ClassifierModel, arrays: Sequence[NDArray], metadata: dict[str, Any]) -> Points:
    """The points of PDAL's views as the stage sees them; `metadata` is PDAL's. There is one point at least."""
    arrays = [array for array in arrays if len(array)]
    names = arrays[0].dtype.names or ()
    columns = {name: np.concatenate([array[name] for array in arrays]) for name in names}
    flags = pdal_env.flags_inside_classification(names, metadata)
    readers_said = [v for k, v in metadata.get("metadata", {}).items() if k.startswith("readers.")]
    node = readers_said[0] if readers_said else None
    wkt = wkt_of(node[0] if isinstance(node, list) else node)
    return stage.points(columns, wkt=wkt, legacy_flags=flags)
