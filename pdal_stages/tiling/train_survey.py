"""Training on a survey: in one piece where it fits into memory, otherwise in tiles, with the same
model.
"""

from __future__ import annotations

import fnmatch
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
from ..base.report import Report
from ..classifier.model import Model
from ..classifier.model_description import FILE_NUMBER
from ..classifier.training import reach, train
from ..classifier.training_clouds import TiledCloud, TrainingCloud
from ..classifier.training_options import TrainingOptions
from ..pipeline import las_output
from ..pipeline import pdal as pdal_env
from ..pipeline.inputs_outputs import is_ept, is_las, overridden, reader_of, stage_files
from ..pipeline.overrides import Override
from ..pipeline.run import Pipeline
from ..pipeline.runtime import Callbacks, points_of_views
from ..pipeline.spatial_reference import check_readers
from ..stages.checked_points import CheckedChoice, CheckedPoints
from ..stages.points import Points
from ..stages.preprocessing import preparation_of
from ..stages.registry import stage_from
from ..stages.train_model import TrainModel
from .checkpoint import load_arrays, save_arrays, written
from .inputs import find_sources, read_extent
from .options import TilingOptions, fits_whole
from .plan import plan_of_files, readers_of
from .tiled_run import run_plan
from .write_outputs import NewValues, PieceResults, of_own_points, read_with

#: Memory of a point in training in one piece, with voxels and neighborhoods of samples.
TRAIN_POINT = 400
#: Arrays of points that a person checked, and of others that the base model is sure of: see
#: :mod:`..stages.checked_points`.
_WANTED, _SURE = "PdalStagesWanted", "PdalStagesSure"
#: Failed tiles that a message names.
_NAMED = 3


def _training_stage(given: Mapping[str, Any]) -> TrainModel:
    """The stage that trains."""
    return cast(TrainModel, stage_from(given))


def surveys_of(files: Sequence[str], grouped: Sequence[str] = ()) -> dict[str, list[str]]:
    """Name -> files of each survey; `grouped` are ``NAME=PATTERN``, and any other file is a survey
    by itself.

    OptionError where a group is malformed or empty, or a file is in two.
    """
    out: dict[str, list[str]] = {}
    of: dict[str, str] = {}
    for one in grouped:
        name, mark, pattern = one.partition("=")
        if not (mark and name.strip() and pattern.strip()):
            raise OptionError(
                "surveys are written NAME=PATTERN",
                found=one,
                cure="For example north='north/*.laz'",
            )
        parts = [part.strip() for part in pattern.split(",") if part.strip()]
        mine = [f for f in files if any(_like(f, part) for part in parts)]
        if not mine:
            raise OptionError(
                "a survey has no files", found=one, cure=f"There are {', '.join(files[:5])}"
            )
        for file in mine:
            if of.setdefault(file, name) != name:
                raise OptionError(
                    "a file is in two surveys", found=f"{file}: {of[file]} and {name}"
                )
        out[name] = mine
    for file in files:
        if file not in of:
            name = Path(file).stem
            out.setdefault(name if name not in out else file, []).append(file)
    return out


def _like(file: str, pattern: str) -> bool:
    inside = Path(pattern).is_dir() and Path(pattern).resolve() in Path(file).resolve().parents
    return inside or fnmatch.fnmatch(file, pattern) or fnmatch.fnmatch(Path(file).name, pattern)


@dataclass(frozen=True)
class TrainTask:
    """Inputs and options of a training."""

    files: Sequence[str]  #: labeled inputs
    model: str  #: the file to write
    overrides: Sequence[Override] = ()
    given: Mapping[str, Any] = field(
        default_factory=dict
    )  #: options of ``writers.classifiermodel``
    options: TilingOptions = field(default_factory=TilingOptions)
    #: the files of each survey, whose points are not neighbors of each other's
    surveys: Mapping[str, Sequence[str]] = field(default_factory=dict)
    survey: str = ""  #: the survey of all files
    named: Sequence[str] = ()  #: what the files were named by: patterns, tile indexes

    @cached_property
    def _writer(self) -> dict[str, Any]:
        """The training stage as in a pipeline; several files are scored by file, unless specified
        otherwise.
        """
        files = list(self.files)
        writer = {
            "type": TrainModel.type,
            "filename": self.model,
            "files": files,
            **self.given,
        }
        writer = overridden(writer, self.overrides)
        told = {name: value for name in ("survey", "groups") if (value := writer.get(name))}
        if told and (self.surveys or self.survey):
            raise OptionError(
                "surveys are given by files or by a dimension, not by both",
                found=", ".join(f"{name}={value}" for name, value in told.items()),
            )
        forest = writer.get("algorithm", TrainingOptions.algorithm) == "random_forest"
        if len(files) > 1 and forest and not (told or self.surveys or self.survey):
            writer["groups"] = FILE_NUMBER
        return writer

    def _each(self) -> list[TrainTask]:
        """A task for each survey; this one where there are none."""
        named = self.surveys.items()
        return [replace(self, files=files, surveys={}, survey=name) for name, files in named] or [
            self
        ]

    def _points(self) -> int:
        """The number of points of the files, from their headers."""
        return sum(read_extent(source).count for source in find_sources(readers_of(self.files)))

    @cached_property
    def stage(self) -> TrainModel:
        """The stage that trains."""
        return _training_stage(self._writer)

    def in_one_piece(self) -> bool:
        """Whether all points fit into the memory, those of each survey by themselves, or cannot be
        cut into tiles.

        Not where tiles are asked for.
        """
        can_be_cut = all(is_las(name) or is_ept(name) for name in self.files)
        if not can_be_cut or self.stage.algorithm != "random_forest":
            return True
        if self.options.tile is not None:
            return False
        try:
            return all(
                fits_whole(one._points(), self.options.memory, TRAIN_POINT) for one in self._each()
            )
        except StageError:
            return True  # said when it is read

    def run(self) -> list[str]:
        """Train and write the model; returns messages."""
        base = self.stage.training.base
        made_by = (
            preparation_of(self.stage.wished)
            if base is None
            else base.info.get("preparation") or []
        )
        heights = [overridden(one, self.overrides) for one in made_by]
        stage = self.stage.after(heights)
        told = [warning] if (warning := stage.check_upstream()) is not None else []
        pdal_env.bindings()  # says what is wrong with PDAL before any work
        check_outputs(stage.outputs(), [*self.files, *self.named, *stage_files(stage)])
        report = Report()
        made = (self._whole if self.in_one_piece() else self._tiled)(heights, report)
        stage.finish(made, report)
        said = [*told, *report.messages]  # once what the preparation says as well
        return [one for one in said if not any(one.endswith(f": {other}") for other in said)]

    def _read(self, heights: Sequence[Mapping[str, Any]], stage: TrainModel) -> Points:
        """The points with heights, and with file numbers where these are the groups of the
        score.
        """
        readers = [reader_of(file, f"input{i}") for i, file in enumerate(self.files, 1)]
        told = check_readers(readers)
        own = [one for one in self.overrides if one.selector != stage.type]
        numbers = count(1)

        def number(module: Any, ins: Mapping[str, NDArray], outs: dict[str, NDArray]) -> None:
            """PDAL calls it for the points of one reader after the other."""
            outs[FILE_NUMBER] = np.full(len(ins["X"]), next(numbers), np.uint32)

        callbacks = Callbacks()
        grouped = stage.groups == FILE_NUMBER
        numbered = [callbacks.filter(number, {FILE_NUMBER: "uint32_t"})] if grouped else []
        pipeline = Pipeline([*readers, *numbered, *map(dict, heights)], own)
        pipeline.execute()
        if not any(map(len, pipeline.arrays)):
            raise StageError("there are no points to train on", where=", ".join(self.files[:3]))
        points = points_of_views(pipeline.arrays, pipeline.metadata, stage.points)
        points.report.warnings += [
            *told,
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
                found = self.stage.training_on(points)
                training = training or found
                _check_same(found.dimensions, training.dimensions)
                cloud = self.stage.cloud_of(points, found)
                report.merge(points.report)
                if task.survey:
                    yield replace(cloud, name=task.survey, survey=task.survey)
                else:
                    yield from (one for _, one in self.stage.surveys(cloud))

        made = clouds()
        first = next(made)  # what is trained on follows from its dimensions
        return train([first, *made] if len(each) == 1 else chain([first], made), training)

    # ---- in tiles ----------------------------------------------------------------------------------------

    def _tiled(self, heights: Sequence[Mapping[str, Any]], report: Report) -> Model:
        clouds: list[TiledCloud] = []
        dimensions: list[str] | None = None
        with work_folder(self.model) as folder:
            for number, task in enumerate(self._each()):
                made = folder / f"survey{number}"
                made.mkdir()
                found, parts, names = task._in_tiles(made, heights)
                _check_same(names, dimensions or names)
                dimensions = names
                report.merge(found)
                clouds += parts
            training = self.stage.training
            if self.stage.automatic:
                training = replace(training, dimensions=tuple(dimensions or ()))
            tiles = (tile for cloud in clouds for tile in cloud.clouds(reach(training)))
            return train(tiles, training, folder=folder)

    def _in_tiles(
        self, folder: Path, heights: Sequence[Mapping[str, Any]]
    ) -> tuple[Report, list[TiledCloud], list[str]]:
        """A report; the points with heights, as tiled clouds; and the dimensions to train on."""
        tiles = folder / "tiles"
        tiles.mkdir()
        tail = {"type": "writers.null", "filename": str(tiles / "#.npz")}
        own = [one for one in self.overrides if one.selector != self.stage.type]
        plan, _ = plan_of_files(self.files, [*map(dict, heights), tail], own)
        numbers: dict[str, int] = {}
        if self.stage.groups == FILE_NUMBER:
            for number, name in enumerate(self.files, 1):
                numbers[find_sources(readers_of([name]))[0].path] = number
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
        clouds: dict[float, TiledCloud] = {}
        dimensions: list[str] | None = None
        looked = (job.record["looked"] for job in run.tiles if "looked" in job.record)
        choice = (
            self.stage.choice(looked) or None
        )  # what samples are drawn from, where a person checked any
        if choice:
            choice.report_to(report)
        for job in run.tiles:
            if "dimensions" in job.record:
                assert job.outputs is not None
                _check_same(job.record["dimensions"], dimensions or job.record["dimensions"])
                dimensions = job.record["dimensions"]
                for value, cloud in self.stage.surveys(
                    _read_back(job.outputs[0], self.stage.named, choice)
                ):
                    if value not in clouds:
                        clouds[value] = TiledCloud(folder / f"cloud{len(clouds)}", side)
                    if self.survey:
                        cloud = replace(cloud, name=self.survey, survey=self.survey)
                    clouds[value].put(job.tile, cloud)
            for path in job.outputs or ():
                Path(path).unlink(missing_ok=True)
        if dimensions is None:
            raise StageError(
                "there are no points to train on", where=", ".join(self.files[:_NAMED])
            )
        return report, [clouds[value] for value in sorted(clouds)], dimensions


def _check_same(found: Sequence[str], before: Sequence[str]) -> None:
    if list(found) != list(before):
        raise StageError(
            "the files do not have the same dimensions",
            found=f"{', '.join(found)}; before: {', '.join(before)}",
            cure="Name those that all have: --writers.classifiermodel.dimensions=HeightAboveGround",
        )


def _read_back(path: str, name: str, choice: CheckedChoice | None) -> TrainingCloud:
    """The points of a tile, as :func:`take_points` wrote them."""
    arrays = load_arrays(path)
    wanted, sure = (arrays.pop(f"d/{mark}", np.zeros(0, np.bool_)) for mark in (_WANTED, _SURE))
    if choice is not None:
        arrays["mask"] = choice.mask(CheckedPoints(wanted, sure, arrays["labels"]), arrays["xyz"])
    return TrainingCloud(arrays["xyz"], arrays["labels"], name=name).with_arrays(arrays)


def take_points(
    writer: Mapping[str, Any],
    numbers: Mapping[str, int],
    results: list[PieceResults],
    outputs: list[str],
    scratch: str,
) -> dict[str, Any]:
    """Save a tile's own points for training, in place of a pipeline's writers
    (:attr:`TilePlan.takes`).

    `writer` is the stage that trains; `numbers` are those of inputs by path, where points are to
    have the number of theirs.
    """
    stage = _training_stage(writer)
    readers = [{**result.piece.reader, "filename": result.piece.path} for result in results]
    new = []
    for result in results:
        found, number = of_own_points(result), numbers.get(result.piece.source.path)
        if number is not None:
            numbered = (None, np.full(len(result.piece.index), number, np.uint32))
            found = NewValues(found.kept, {**found.values, FILE_NUMBER: numbered})
        new.append(found)
    callbacks = Callbacks()
    flags = las_output.files_with_flags_to_split(readers)
    stages, _ = read_with(callbacks, readers, new, flags)
    run = pdal_env.execute(stages)
    if not run.count:
        return {"outputs": []}
    points = points_of_views(run.arrays, run.metadata, stage.points)
    run.arrays.clear()
    training = stage.training_on(points)
    marks: dict[str, NDArray] = {}
    looked: dict[str, Any] = {}
    if stage.checked_only:
        checked, counts = stage.checked_points(points)
        marks, looked = {_WANTED: checked.wanted, _SURE: checked.sure}, {"looked": counts}
    save_arrays(outputs[0], stage.cloud_of(points, training, marks).arrays)
    return {
        "outputs": written(outputs),
        "written": run.count,
        "messages": points.report.messages,
        "ignored": int(points.report.figures.get("ignored", 0)),
        "dimensions": list(training.dimensions),
        **looked,
    }
