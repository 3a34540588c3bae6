"""Train on a survey: in one piece where it fits into memory, else in tiles, with equal results."""

from __future__ import annotations

import fnmatch
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import chain, count
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ..base.errors import OptionError, StageError
from ..base.files import check_outputs, work_folder
from ..base.messages import Report
from ..classifier.input_dimensions import CHECKED
from ..classifier.model import Model
from ..classifier.model_description import FILE_NUMBER
from ..classifier.training import reach, train
from ..classifier.training_clouds import TiledCloud, TrainingCloud
from ..classifier.training_options import TrainingOptions
from ..pipeline import las_files
from ..pipeline import pdal as pdal_env
from ..pipeline.expansion import stage_files
from ..pipeline.inputs_outputs import is_las
from ..pipeline.json_source import Override, overridden
from ..pipeline.pdal import reader_of
from ..pipeline.run import Pipeline
from ..pipeline.runtime import Callbacks, points_of_views
from ..pipeline.spatial_reference import check_readers
from ..stages.points import Points
from ..stages.preprocessing import preparation_of
from ..stages.registry import stage_from
from ..stages.train_model import TrainModel
from .inputs import las_extent
from .jobs import load_arrays, save_arrays, written
from .options import TilingOptions, fits_whole
from .plan import plan_of_files
from .tiled_run import run_plan
from .write_outputs import NewValues, PieceResults, of_own_points, read_with

#: Bytes of a point in training in one piece, with voxels and neighborhoods of samples: 20 million
#: points took 7,922 MiB (docs/train.md).
TRAIN_POINT = 400
#: Failed tiles that a message names.
_NAMED = 3


def _training_stage(options: Mapping[str, Any]) -> TrainModel:
    """Make the stage that trains."""
    return cast(TrainModel, stage_from(options))


def surveys_of(files: Sequence[str], grouped: Sequence[str] = ()) -> dict[str, list[str]]:
    """Return name -> files of each survey.

    `grouped` are ``NAME=PATTERN``; any other file is a survey by itself. OptionError where a group
    is malformed or empty, or a file is in two.
    """
    surveys: dict[str, list[str]] = {}
    survey_of: dict[str, str] = {}
    for group in grouped:
        name, _, pattern = group.partition("=")
        if not (name.strip() and pattern.strip()):
            raise OptionError(
                "surveys are written NAME=PATTERN",
                found=group,
                cure="For example north='north/*.laz'",
            )
        parts = [part.strip() for part in pattern.split(",") if part.strip()]
        surveys[name] = [f for f in files if any(_like(f, part) for part in parts)]
        if not surveys[name]:
            raise OptionError(
                "a survey has no files", found=group, cure=f"There are {', '.join(files[:5])}"
            )
        for file in surveys[name]:
            if survey_of.setdefault(file, name) != name:
                raise OptionError(
                    "a file is in two surveys", found=f"{file}: {survey_of[file]} and {name}"
                )
    for file in files:
        if file not in survey_of:
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
    stage_options: Mapping[str, Any] = field(default_factory=dict)
    options: TilingOptions = field(default_factory=TilingOptions)
    #: the files of each survey, whose points are not neighbors of each other's
    surveys: Mapping[str, Sequence[str]] = field(default_factory=dict)
    survey: str = ""  #: the survey of all files
    named: Sequence[str] = ()  #: what the files were named by: patterns, tile indexes

    @cached_property
    def _writer(self) -> dict[str, Any]:
        """Return the training stage as in a pipeline, which scores several files by file."""
        files = list(self.files)
        writer = {
            "type": TrainModel.type,
            "filename": self.model,
            "files": files,
            **self.stage_options,
        }
        writer = overridden(writer, self.overrides)
        grouping = {name: value for name in ("survey", "groups") if (value := writer.get(name))}
        if grouping and (self.surveys or self.survey):
            raise OptionError(
                "surveys are given by files or by a dimension, not by both",
                found=", ".join(f"{name}={value}" for name, value in grouping.items()),
            )
        forest = writer.get("algorithm", TrainingOptions.algorithm) == "random_forest"
        if len(files) > 1 and forest and not (grouping or self.surveys or self.survey):
            writer["groups"] = FILE_NUMBER
        return writer

    def _each(self) -> list[TrainTask]:
        """Return a task for each survey; this one where there are none."""
        return [
            replace(self, files=files, surveys={}, survey=name)
            for name, files in self.surveys.items()
        ] or [self]

    @cached_property
    def stage(self) -> TrainModel:
        """Return the stage that trains."""
        return _training_stage(self._writer)

    def in_one_piece(self) -> bool:
        """Return whether the points of each survey fit into memory, or cannot be cut into tiles.

        False where the user wants tiles.
        """
        if not all(map(is_las, self.files)) or self.stage.algorithm != "random_forest":
            return True
        if self.options.tile is not None:
            return False
        try:
            return all(
                fits_whole(
                    sum(las_extent(f).count for f in files), self.options.memory, TRAIN_POINT
                )
                for files in (task.files for task in self._each())
            )
        except StageError:
            return True  # reading it reports the error

    def run(self) -> list[str]:
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
        model = (self._whole if self.in_one_piece() else self._tiled)(heights, report)
        stage.finish(model, report)
        messages = [*filter(None, [warning]), *report.messages]
        # A message that the preparation has as well comes once.
        return [text for text in messages if not any(text.endswith(f": {m}") for m in messages)]

    def _read(self, heights: Sequence[Mapping[str, Any]], stage: TrainModel) -> Points:
        """Read the points with heights, and with file numbers where the score groups by file."""
        readers = [reader_of(file, f"input{i}") for i, file in enumerate(self.files, 1)]
        messages = check_readers(readers)
        numbers = count(1)

        def number(module: Any, ins: Mapping[str, NDArray], outs: dict[str, NDArray]) -> None:
            """Set the number of a file; PDAL calls it for one reader after the other."""
            outs[FILE_NUMBER] = np.full(len(ins["X"]), next(numbers), np.uint32)

        callbacks = Callbacks()
        grouped = stage.groups == FILE_NUMBER
        numbered = [callbacks.filter(number, {FILE_NUMBER: "uint32_t"})] if grouped else []
        pipeline = Pipeline([*readers, *numbered, *map(dict, heights)], self._other_overrides)
        pipeline.execute()
        if not any(map(len, pipeline.arrays)):
            raise StageError("there are no points to train on", where=", ".join(self.files[:3]))
        points = points_of_views(pipeline.arrays, pipeline.metadata, stage.points)
        points.report.warnings += [
            *messages,
            *(f"PDAL says: {line}" for line in pipeline.log_lines[:10]),
        ]
        points.report.warnings += pipeline.messages
        return points

    def _whole(self, heights: Sequence[Mapping[str, Any]], report: Report) -> Model:
        """Train on all points of a survey at once, one survey after the other."""
        each = self._each()
        training: Any = None

        def clouds() -> Iterator[TrainingCloud]:
            nonlocal training
            for task in each:
                points = task._read(heights, self.stage)
                options = self.stage.training_on(points)
                training = training or options
                _check_same(options.dimensions, training.dimensions)
                cloud = self.stage.cloud_of(points, options)
                report.merge(points.report)
                if task.survey:
                    yield replace(cloud, name=task.survey, survey=task.survey)
                else:
                    yield cloud

        every = clouds()
        first = next(every)  # what is trained on follows from its dimensions
        return train([first, *every] if len(each) == 1 else chain([first], every), training)

    @property
    def _other_overrides(self) -> list[Override]:
        """Return the overrides of other stages than the one that trains."""
        return [override for override in self.overrides if override.selector != TrainModel.type]

    # ---- in tiles --------------------------------------------------------------------------------

    def _tiled(self, heights: Sequence[Mapping[str, Any]], report: Report) -> Model:
        """Train on the points of one survey after the other, read in tiles."""
        clouds: list[TiledCloud] = []
        dimensions: list[str] | None = None
        with work_folder(self.model) as folder:
            for number, task in enumerate(self._each()):
                subfolder = folder / f"survey{number}"
                subfolder.mkdir()
                survey_report, cloud, names = task._in_tiles(subfolder, heights)
                _check_same(names, dimensions or names)
                dimensions = names
                report.merge(survey_report)
                clouds.append(cloud)
            training = self.stage.training
            if self.stage.automatic:
                training = replace(training, dimensions=tuple(dimensions or ()))
            tiles = (tile for cloud in clouds for tile in cloud.clouds(reach(training)))
            return train(tiles, training, folder=folder)

    def _in_tiles(
        self, folder: Path, heights: Sequence[Mapping[str, Any]]
    ) -> tuple[Report, TiledCloud, list[str]]:
        """Return a report, the points with heights as a tiled cloud, and dimensions to train on."""
        tiles = folder / "tiles"
        tiles.mkdir()
        tail = {"type": "writers.null", "filename": str(tiles / "#.npz")}
        stages = [*map(dict, heights), tail]
        plan, _ = plan_of_files(self.files, stages, self._other_overrides)
        numbers: dict[str, int] = {}
        if self.stage.groups == FILE_NUMBER:
            for number, name in enumerate(self.files, 1):
                numbers[os.path.abspath(name)] = number
        plan = replace(plan, takes=partial(take_points, self._writer, numbers), name=self.model)
        run = run_plan(plan, replace(self.options, per="tile"))
        if run.failures:
            named = "; ".join(f"{what}: {why}" for what, why in run.failures[:_NAMED])
            more = f", and {len(run.failures) - _NAMED} more" if len(run.failures) > _NAMED else ""
            raise StageError(
                "not all points could be read, so nothing was trained", found=named + more
            )
        ignored = sum(job.record.get("ignored", 0) for job in run.tiles)
        report = Report({"points": run.summary["points"], "ignored": ignored}, list(run.messages))
        side = run.summary["tile"] * run.summary["meters_per_unit"]
        tiled = TiledCloud(folder / "cloud", side)
        dimensions: list[str] | None = None
        for job in run.tiles:
            if "dimensions" in job.record:
                assert job.outputs is not None
                _check_same(job.record["dimensions"], dimensions or job.record["dimensions"])
                dimensions = job.record["dimensions"]
                arrays, name = load_arrays(job.outputs[0]), self.survey or self.stage.named
                cloud = TrainingCloud(arrays["xyz"], arrays["labels"], name=name)
                tiled.put(job.tile, cloud.with_arrays(arrays))
            for path in job.outputs or ():
                Path(path).unlink(missing_ok=True)
        if dimensions is None:
            raise StageError(
                "there are no points to train on", where=", ".join(self.files[:_NAMED])
            )
        return report, tiled, dimensions


def _check_same(names: Sequence[str], before: Sequence[str]) -> None:
    if list(names) != list(before):
        raise StageError(
            "the files do not have the same dimensions",
            found=f"{', '.join(names)}; before: {', '.join(before)}",
            cure="Name those that all have: --writers.classifiermodel.dimensions=HeightAboveGround",
        )


def take_points(
    writer: Mapping[str, Any],
    numbers: Mapping[str, int],
    results: list[PieceResults],
    outputs: list[str],
    scratch: str,
) -> dict[str, Any]:
    """Save a tile's own points for training, in place of writers (:attr:`TilePlan.takes`).

    `writer` is the stage that trains; `numbers` are those of inputs by path, where points are to
    have the number of their input.
    """
    stage = _training_stage(writer)
    readers = [{**result.piece.reader, "filename": result.piece.path} for result in results]
    new = []
    for result in results:
        values, number = of_own_points(result), numbers.get(result.piece.source.path)
        if number is not None:
            numbered = (None, np.full(len(result.piece.index), number, np.uint32))
            values = NewValues(values.kept, {**values.values, FILE_NUMBER: numbered})
        new.append(values)
    callbacks = Callbacks()
    flags = las_files.files_with_flags_to_split(readers)
    stages, _ = read_with(callbacks, readers, new, flags)
    run = pdal_env.execute(stages)
    if not run.count:
        return {"outputs": []}
    points = points_of_views(run.arrays, run.metadata, stage.points)
    run.arrays.clear()
    training = stage.training_on(points)
    if stage.checked_only and np.any(points.arrays.get(CHECKED, 0)):
        raise StageError(
            "points that a person checked are trained on in one piece",
            cure="Give only the files that have any, without --tile, or more --memory",
        )
    save_arrays(outputs[0], stage.cloud_of(points, training).arrays)
    return {
        "outputs": written(outputs),
        "written": run.count,
        "messages": points.report.messages,
        "ignored": int(points.report.figures.get("ignored", 0)),
        "dimensions": list(training.dimensions),
    }
