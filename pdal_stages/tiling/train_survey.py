"""Train on surveys, one after the other; each must fit into memory."""

from __future__ import annotations

import fnmatch
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import cast

from ..base import las
from ..base.distinct import DistinctPoints
from ..base.errors import OptionError, StageError
from ..base.files import check_outputs
from ..base.json_types import StageJson
from ..base.las_points import columns_of_files, layout_there
from ..base.memory import free_memory
from ..base.messages import Message, Report, drop_repeated
from ..classifier.model import Model
from ..classifier.training import train
from ..classifier.training_clouds import TrainingCloud
from ..classifier.training_options import TrainingOptions
from ..pipeline import pdal as pdal_env
from ..pipeline.expansion import check_shared_dimensions, stage_files
from ..pipeline.json_source import Override, overridden
from ..pipeline.pdal import reader_of
from ..pipeline.run import Pipeline
from ..pipeline.runtime import points_of_views
from ..pipeline.spatial_reference import check_readers, text_of
from ..stages.points import Points
from ..stages.preprocessing import preparation_of
from ..stages.registry import stage_from
from ..stages.train_model import TrainModel

#: Bytes of a point in training, with voxels and neighborhoods of samples: 20 million
#: points took 7,922 MiB (docs/train.md).
TRAIN_POINT = 400


def surveys_of(files: Sequence[str], grouped: Sequence[str] = ()) -> dict[str, list[str]]:
    """Return name -> files of each survey.

    `grouped` are ``NAME=PATTERN``, of file names, whole paths, or folders; any other file is a
    survey by itself. OptionError where a group is malformed or empty, or a file is in two.
    """
    surveys: dict[str, list[str]] = {}
    for group in grouped:
        name, _, patterns = group.partition("=")
        wanted = [part.strip() for part in patterns.split(",") if part.strip()]
        surveys[name] = [file for file in files if any(_like(file, part) for part in wanted)]
        if not (name.strip() and surveys[name]):
            raise OptionError(
                "a survey is written NAME=PATTERN, and has files",
                found=group,
                cure=f"For example north='north/*.laz'. There are {', '.join(files[:5])}",
            )
    named = [file for inside in surveys.values() for file in inside]
    if twice := [file for file in files if named.count(file) > 1]:
        raise OptionError("a file is in two surveys", found=twice[0])
    for file in files:
        if file not in named:
            name = Path(file).stem
            surveys.setdefault(name if name not in surveys else file, []).append(file)
    return surveys


def _like(file: str, pattern: str) -> bool:
    inside = Path(pattern).is_dir() and Path(pattern).resolve() in Path(file).resolve().parents
    return inside or fnmatch.fnmatch(file, pattern) or fnmatch.fnmatch(Path(file).name, pattern)


@dataclass(frozen=True)
class TrainTask:
    """Inputs and options of a training."""

    files: Sequence[str]  #: labeled inputs
    model: str  #: the file to write
    overrides: Sequence[Override] = ()
    #: of ``writers.classifiermodel``
    stage_options: Mapping[str, object] = field(default_factory=dict)
    #: the files of each survey, whose points are not neighbors of each other's
    surveys: Mapping[str, Sequence[str]] = field(default_factory=dict)
    named: Sequence[str] = ()  #: what the files were named by: patterns, tile indexes

    @cached_property
    def _writer(self) -> StageJson:
        """Return the training stage as in a pipeline."""
        writer = {"type": TrainModel.type, "filename": self.model, "files": list(self.files)}
        return overridden({**writer, **self.stage_options}, self.overrides)

    @cached_property
    def stage(self) -> TrainModel:
        """Return the stage that trains."""
        return cast(TrainModel, stage_from(self._writer))

    @property
    def _each(self) -> Mapping[str, Sequence[str]]:
        """Return the files of each survey; all under an empty name where there are no surveys."""
        return self.surveys or {"": self.files}

    def _check_memory(self) -> None:
        """Refuse surveys whose points would not fit into memory, as far as headers tell."""
        free = free_memory()
        for files in self._each.values():
            headers = [las.header_there(name) for name in files]
            points = sum(header.count for header in headers if header)
            if points * TRAIN_POINT > free:
                raise StageError(
                    f"{points:,} points to train on do not fit into memory",
                    where=files[0],
                    found=f"{free / 1e9:.1f} GB are free; {TRAIN_POINT} bytes a point are needed",
                    cure="Take fewer files (samples are few), or name --surveys, of which one is "
                    "read after the other",
                )

    def run(self) -> list[Message]:
        """Train and write the model; return messages."""
        base = self.stage.training.base
        if base is None:
            preparation = preparation_of(self.stage.wished)
        else:
            preparation = base.info.get("preparation") or []
        heights = [overridden(options, self.overrides) for options in preparation]
        stage = self.stage.after(heights)
        warning = stage.check_upstream()
        pdal_env.bindings()  # reports what is wrong with PDAL before any work
        check_outputs(stage.outputs(), [*self.files, *self.named, *stage_files(stage)])
        report = Report()
        self._check_memory()
        model = self._train(heights, report)
        stage.finish(model, report)
        messages = [Message(warning)] if warning else []
        # A message that the preparation has as well comes once.
        return drop_repeated([*messages, *report.messages])

    def _read(self, files: Sequence[str], heights: Sequence[StageJson]) -> Points:
        """Read the points with heights."""
        readers = [reader_of(file, f"input{i}") for i, file in enumerate(files, 1)]
        messages = check_readers(readers)
        stages = [*map(dict, heights)] or [{"type": "filters.merge"}]  # one end of all readers
        pipeline = Pipeline([*readers, *stages], self._other_overrides)
        layouts = {path: layout for path in files if (layout := layout_there(path)) is not None}
        check_shared_dimensions(pipeline.expanded, layouts, self.stage)
        if pipeline.is_read_here:
            pipeline.settle_inputs(pdal=False)
            columns = columns_of_files(files)
            wkt = next(filter(None, (text_of(reader)[0] for reader in readers)), "")
            points = self.stage.points(pipeline.run_here(columns, wkt), wkt=wkt)
        else:
            pipeline.execute()
            points = points_of_views(pipeline.arrays, pipeline.metadata, self.stage.points)
        if not points.count:
            raise StageError("there are no points to train on", where=", ".join(files[:3]))
        points.report.warnings += messages + pipeline.log_messages[:10] + pipeline.messages
        return points

    def _train(self, heights: Sequence[StageJson], report: Report) -> Model:
        """Train on all points of a survey at once, one survey after the other."""
        training: TrainingOptions | None = None
        distinct = DistinctPoints()

        def clouds() -> Iterator[TrainingCloud]:
            nonlocal training
            for name, files in self._each.items():
                points = self._read(files, heights)
                options = self.stage.training_on(points)
                training = training or options
                _check_same(options.dimensions, training.dimensions)
                cloud = self.stage.cloud_of(points, options, distinct)
                report.merge(points.report)
                yield replace(cloud, name=name, survey=name) if name else cloud

        every = clouds()
        first = next(every)  # what is trained on follows from its dimensions
        several = chain([first], every)
        return train(several if self.surveys else [*several], training)

    @property
    def _other_overrides(self) -> list[Override]:
        """Return the overrides of other stages than the one that trains."""
        return [override for override in self.overrides if override.selector != TrainModel.type]


def _check_same(names: Sequence[str], before: Sequence[str]) -> None:
    if list(names) != list(before):
        raise StageError(
            "the files do not have the same dimensions",
            found=f"{', '.join(names)}; before: {', '.join(before)}",
            cure="Name those that all have: --writers.classifiermodel.dimensions=HeightAboveGround",
        )
