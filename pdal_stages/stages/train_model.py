"""``writers.classifiermodel``: train a classifier on labeled points [B16, W18]."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..base.distinct import DistinctPoints
from ..base.errors import ModelError, OptionError
from ..base.files import MODEL, Output
from ..base.json_types import JsonObject, StageJson
from ..base.messages import Report, Topic
from ..classifier import model_description
from ..classifier.calibration import calibrate_on_base
from ..classifier.class_map import ClassMap
from ..classifier.input_dimensions import (
    CHECKED,
    DEFAULT_DIMENSIONS,
    optional_dimensions,
    required_dimensions,
)
from ..classifier.interface import Trainer, kinds, trainer_of
from ..classifier.model import Model, loaded_model
from ..classifier.model_file import digest_of, find
from ..classifier.training import train
from ..classifier.training_clouds import TrainingCloud
from ..classifier.training_options import RECIPES, TrainingOptions, describe_recipes, with_recipe
from .base import Stage, StageContext, files_read
from .checked_points import select_checked
from .options import UNWANTED, Option, Selection, option, option_of
from .points import Points
from .preprocessing import check as check_preprocessing

#: The part of a model's description that fits in a pipeline's metadata.
_SHOWN = ("strategy", "classes", "accuracy", "parameters")
#: Most files that a model names.
_NAMED = 20
#: The word for the dimensions that follow from what the points have.
AUTO = "auto"


class TrainModel(Stage, settings=TrainingOptions):
    """Train a model on labeled points."""

    type = "writers.classifiermodel"
    summary = "Train a classifier on the labeled points that reach it, and write one model file"
    source = "[B16] sections 3.3-4.2, [W18] section 4.3, [WM19] for alsnet"
    instead_of_tiles = "Train without --tile, or with the command pdal-stages train"
    where_help = "Samples are drawn from the points inside; all points are neighbors"
    needs_points = "train on"
    filename: str = option("filename", None, "The model file to write", required=True)
    label: str = option("string", "Classification", "Dimension that holds the labels")
    recipe: list | None = option(
        "list",
        None,
        f"Set the options as a paper does ({', '.join(RECIPES)}); of several the last one counts; "
        "options given beside them replace theirs",
    )
    base: str | None
    seed: int
    algorithm: str
    dimensions: list = option_of(
        TrainingOptions,
        "dimensions",
        default=(AUTO,),
        help="Dimensions of the points to use as features as well; auto: HeightAboveGround and, "
        "where the points have them, Ground, HeightAboveOpening_5, HeightAboveOpening_17 and "
        "returns",
        may_be_empty=True,
    )
    checked_only: bool = option(
        "boolean",
        True,
        f"If points have the dimension {CHECKED} (from the command corrections), and it is not 0 "
        "everywhere, draw samples only where it is 1",
    )
    ignore: Selection = option(
        "selection",
        UNWANTED,
        "Points to leave out, even as neighbors: labels (unless 'classes' names them), ranges of "
        "other dimensions such as ReturnNumber[0:0], or the word withheld",
        may_be_empty=True,
    )
    files: list = option(
        "list", (), "Input files that the model file names; default: those of the readers"
    )

    @classmethod
    def all_options(cls) -> tuple[Option, ...]:
        """Return the options; those of `algorithm` are the kinds that are registered now."""
        return tuple(
            replace(option, choices=tuple(kinds())) if option.name == "algorithm" else option
            for option in super().all_options()
        )

    @classmethod
    def complete(cls, raw_options: JsonObject) -> JsonObject:
        """Return the options with those of the recipe that they name."""
        return with_recipe(raw_options)

    @classmethod
    def from_pipeline(
        cls, raw_options: Mapping[str, object], before: Sequence[StageJson]
    ) -> JsonObject:
        """Return options that follow from the stages before."""
        return {"files": files_read(before)}

    @classmethod
    def describe_choices(cls) -> str:
        """Return a text on options whose words stand for several values."""
        return describe_recipes()

    def check_upstream(self) -> str | None:
        """Return a warning about the stages upstream; None where they fit."""
        try:
            check_preprocessing(self.upstream)
        except ModelError as error:
            error.cure = (
                f"Write a pipeline with the same stages, {', '.join(self._upstream_types)}, before "
                "filters.modelclassifier"
            )
            return (
                f"{self.type}: the model will not hold the stages before it, so `classify` cannot "
                f"run them by itself: {str(error).removesuffix('.')}"
            )
        return None

    @property
    def _upstream_types(self) -> list[str]:
        """Return the types of the stages upstream."""
        return [str(stage["type"]) for stage in self.upstream]

    @cached_property
    def training(self) -> TrainingOptions:
        """Return the options of training."""
        values = {field.name: getattr(self, field.name) for field in fields(TrainingOptions)}
        if self.automatic:
            values["dimensions"] = DEFAULT_DIMENSIONS
        values["ignore"] = self.ignore.codes
        values["base"] = None if self.base is None else loaded_model(self.base)
        return TrainingOptions(**values)

    @property
    def _trainer(self) -> Trainer:
        return trainer_of(self.algorithm)

    @property
    def automatic(self) -> bool:
        """Return whether the dimensions follow from what the points have."""
        return list(self.dimensions) == [AUTO]

    @property
    def wished(self) -> tuple[str, ...]:
        """Return the dimensions that preprocessing should create for the training."""
        names = required_dimensions(self.training.inputs)
        return (*names, *self._trainer.optional_inputs) if self.automatic else names

    def training_on(self, points: Points) -> TrainingOptions:
        """Return the options of training, with the dimensions that the points have."""
        if not self.automatic:
            return self.training
        more = self._trainer.optional_inputs
        there = [name for name, sources in more.items() if set(sources) <= points.arrays.keys()]
        return replace(self.training, dimensions=(*DEFAULT_DIMENSIONS, *there))

    def check(self) -> None:
        """Refuse options that contradict each other."""
        self.training.inputs  # noqa: B018  words that mean nothing are refused
        if self.label in required_dimensions(self.training.inputs):
            raise OptionError(
                f"option 'dimensions' names the label itself, '{self.label}'",
                found=", ".join(map(str, self.dimensions)),
                cure="Leave it out: the points to classify do not have it",
            )
        if self.training.classes is not None:
            ClassMap.parse(self.training.classes)

    def outputs(self) -> list[Output]:
        """Return the files that are written."""
        return [Output(self.filename, "model", MODEL)]

    def reads(self) -> list[str]:
        """Return the dimensions that the points must have."""
        return [self.label, *required_dimensions(self.training.inputs)]

    def run(self, points: Points, context: StageContext) -> dict[str, NDArray]:
        """Train on the points and write the model."""
        training = self.training_on(points)
        self.finish(train([self.cloud_of(points, training)], training), points.report)
        return {}

    @property
    def named(self) -> str:
        """Return the names of the input files, as the model file holds them."""
        names = [Path(name).name for name in self.files]
        return ", ".join([*names[:_NAMED], *["..."] * (len(names) > _NAMED)]) or "the points"

    def cloud_of(
        self, points: Points, training: TrainingOptions, distinct: DistinctPoints | None = None
    ) -> TrainingCloud:
        """Return the points as a cloud to train on, without those that came before.

        `distinct` knows the points of clouds before this one.
        """
        needed = required_dimensions(training.inputs)
        dimensions = {name: points.dimension(name) for name in needed}
        dimensions |= {
            n: points.arrays[n] for n in optional_dimensions(training.inputs) if n in points.arrays
        }
        cloud = TrainingCloud(
            xyz=points.xyz,
            labels=points.codes_of(self.label),
            dimensions=dimensions,
            name=self.named,
            mask=self._mask(points),
        )
        # Class codes are left to the trainer: they may be labels.
        gone = points.ignored(replace(self.ignore, codes=()))
        again = ~(distinct or DistinctPoints()).first(points.arrays)
        if repeated := np.count_nonzero(again):
            points.report.note(
                f"{repeated:,} of {points.count:,} points come twice, at the same place and time, "
                "and are counted once"
            )
            gone |= again
        return cloud.part(np.flatnonzero(~gone)) if gone.any() else cloud

    def finish(self, model: Model, report: Report) -> None:
        """Write the model and report its scores and limits."""
        by_hand = self.check_upstream() is not None
        preprocessing = [] if by_hand else check_preprocessing(self.upstream)
        if self.base is None:
            model.record_preprocessing(preprocessing)
        else:
            model.info["preparation"] = preprocessing
            model.info["base"] = {"name": Path(self.base).stem, "sha256": digest_of(self.base)}
            if "checked" in report.figures and "sureness" in model.info:
                before = loaded_model(self.base).info
                model.info["sureness"] = calibrate_on_base(
                    model.info["sureness"], before, find(self.base)
                )
        if by_hand:
            model.info["by_hand"] = self._upstream_types
        model.save(self.filename)
        self._report(model, report)

    def _report(self, model: Model, report: Report) -> None:
        """Report the scores of a model, and samples that it cannot learn from."""
        shown = {key: value for key, value in model.info.items() if key in _SHOWN}
        report.figures |= {"model": self.filename, **shown}
        for code, (all_, held) in model.info["training"].get("held_by_base", {}).items():
            report.warn(
                f"the base assigns {held:,} of {all_:,} samples of class {code} to classes "
                "without labels, where they stay: label some of those classes too"
            )
        if unscored := model.info["training"].get("unscored"):
            report.warn(unscored)
        if model_description.held_out(model.info):
            report.figures["score"] = model_description.score(model.info)
            report.note(report.figures["score"], Topic.SCORE)

    def _mask(self, points: Points) -> NDArray[np.bool_] | None:
        """Return which points (n,) samples are drawn from; None for all."""
        if CHECKED not in points.arrays or not self.checked_only:
            return points.mask
        known = [] if self.base is None else loaded_model(self.base).codes.tolist()
        chosen = select_checked(points, points.codes_of(self.label), known, self.seed)
        return points.mask if chosen is None else chosen
